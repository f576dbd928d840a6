"""The linearised graph: normal equations, GTSAM's equal ones, and blocks of the inverse."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, C, L, X
from numeric import known_noise
from scipy.special import chdtri

from slamlib import sightings, slam
from slamlib.checks import files
from slamlib.simulation import simulate
from slamlib.slam import factors, graph, linear, noise
from slamlib.slam.calibration import ENTRIES, OFFSET, WHEELS
from slamlib.slam.covariances import marginal_covariances
from slamlib.slam.fit import LATE_KERNEL, optimize
from slamlib.slam.initialization import odometry_state, state_from_poses
from slamlib.slam.linear import NormalEquations, laplace_approximation
from slamlib.slam.measurements import WEAK_SIGMA, AcceptedMeasurements, Noise, measure
from slamlib.slam.noise import BOUNDS, equations_of_first_frames
from slamlib.slam.pipeline import fit_from_odometry
from slamlib.slam.problem import build_problem

GROUPS = frozenset(entry.group for entry in ENTRIES) | {"antenna-offsets"}


def dense(equations, noise):
    """The whole information matrix (n + q, n + q), and the gradient (n + q,)."""
    data, border, *_ = equations.sums(noise)
    H, n = equations.structure.matrix(data).toarray(), len(equations.structure.diagonal)
    B, D, g = border[:n, :-1], border[n:, :-1], border[:, -1]
    return np.block([[H, B], [B.T, D]]), g


def released(problem, groups):
    """The Problem in which groups of the calibration are hardly known."""
    sigma = problem.measurements.calibration.sigma_without(groups)
    return replace(problem, sigma=sigma, released=frozenset(groups))


def test_gtsam_has_the_same_error_and_takes_the_same_step():
    """Far from the optimum, with kernels, points, wrong labels, late ranges and any calibration.

    GTSAM evaluates, linearises and eliminates its factors one by one.
    """
    dataset, _ = simulate("short", seed=4, mislabelled=0.02, late_ranges=0.2)
    points = np.isin(dataset.aruco.marker, dataset.aruco.marker[:3])
    covariance = dataset.aruco.covariance.copy()
    covariance[points, 2] = covariance[points, :, 2] = [0, 0, 4.0]
    m = measure(replace(dataset.first(700), aruco=replace(dataset.aruco, covariance=covariance)
                        .select(dataset.aruco.pose < 700)))
    assert 0 < np.count_nonzero(m.oriented) < len(m.oriented)
    state = odometry_state(m, "arc")
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(3.0)
    accepted = AcceptedMeasurements(m, m.unit_weights, cauchy, LATE_KERNEL)
    problem = replace(build_problem(m, "arc", Noise(2e-3, 1.5, 0.7)), accepted=accepted)
    equations = NormalEquations(problem, state)
    values = graph.values(problem, state)
    others = factors.odometry_error(problem.odometry, state.poses, state.c[WHEELS])[0]
    others = problem.odometry.whitening(2e-3)[0] @ others[..., None]
    expected = graph.nonlinear_graph(problem).error(values) + np.sum(others**2) / 2 \
        + equations.linearized[1].error
    assert np.isclose(equations.error, expected, rtol=1e-12)
    step = graph.gtsam_step(problem, state)
    np.testing.assert_allclose(equations.step(), step, rtol=1e-5, atol=1e-6 * np.abs(step).max())
    rng = np.random.default_rng(0)
    for groups in ({"range-offset"}, {"camera-offset", "tag-offset"}, GROUPS):
        free = released(problem, groups)
        off = replace(state, c=state.c + 0.1 * free.sigma * rng.normal(size=len(state.c)))
        for start in (state, off):
            step = graph.gtsam_step(free, start)
            assert len(step) == len(m.structure.diagonal) + free.active.sum()
            np.testing.assert_allclose(NormalEquations(free, start).step(), step, rtol=1e-5,
                                       atol=1e-6 * np.abs(step).max())


def test_markers_without_accepted_sightings_have_a_weak_prior_and_move_nothing_else():
    """Two markers with a heading, of consecutive ids, and a point; GTSAM takes the same step."""
    dataset, _ = simulate("short", seed=4)
    C = dataset.aruco.covariance.copy()
    points = dataset.aruco.marker == dataset.aruco.marker[0]
    C[points, 2] = C[points, :, 2] = [0, 0, 4.0]
    m = measure(replace(dataset, aruco=replace(dataset.aruco, covariance=C)).first(500))
    point, = np.flatnonzero(~m.oriented)
    first = next(j for j in range(len(m.marker) - 1) if m.oriented[j:j + 2].all())
    left = [point, first, first + 1]
    weight = np.r_[~np.isin(m.marker_row, left), np.ones(len(m.ranges.row), bool)].astype(float)
    problem = replace(build_problem(m, "arc", Noise()), accepted=AcceptedMeasurements(m, weight))
    np.testing.assert_array_equal(problem.accepted.unsupported, sorted(left))
    state = odometry_state(m, "arc")
    equations = NormalEquations(problem, state)
    H, rows = equations.structure.matrix(equations.sums(Noise())[0]).toarray(), []
    for j in left:
        own = equations.structure.rows([len(m.frame) + j], 2 + m.oriented[j])[0]
        np.testing.assert_allclose(H[np.ix_(own, own)], np.eye(len(own)) / WEAK_SIGMA**2)
        assert np.count_nonzero(H[own]) == len(own)
        rows.extend(own)
    others = np.setdiff1d(np.arange(len(H)), rows)
    step, expected = equations.step()[others], graph.gtsam_step(problem, state)[others]
    np.testing.assert_allclose(step, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("poses", [1, 15, 400])
def test_selected_blocks_are_those_of_the_dense_inverse(poses):
    """A part of a drive without a separator, and with many."""
    dataset, _ = simulate("short", seed=4)
    m = measure(dataset.first(poses))
    problem = released(build_problem(m, "arc", Noise()), {"range-offset"} if poses > 1 else ())
    equations = NormalEquations(problem, odometry_state(m, "arc"))
    found = marginal_covariances(equations, Noise(2e-3, 1.5, 0.7))
    H, _ = dense(equations, Noise(2e-3, 1.5, 0.7))
    np.testing.assert_allclose(H, H.T, rtol=1e-9, atol=1e-6)
    n, rows = len(equations.structure.diagonal), equations.structure.rows
    unit = np.r_[np.ones(n), problem.sigma[problem.active]]
    expected = np.linalg.inv(H) * np.outer(unit, unit)
    sigma = np.sqrt(np.diag(expected))
    expected /= np.outer(sigma, sigma)
    for i, block in enumerate(found.pairs):
        at = np.concatenate([rows([i], 3)[0], rows([i + 1], 3)[0], np.arange(n, n + 3)])
        np.testing.assert_allclose(block / np.outer(sigma[at], sigma[at]), expected[np.ix_(at, at)],
                                   atol=1e-6)
    places = [rows([len(m.frame) + j], len(block))[0]
              for j, block in enumerate([*found.markers, *found.antennas])]
    active, zero = problem.active, ~problem.active
    assert not found.c[zero].any() and not found.c[:, zero].any()
    for at, block in zip([*places, np.arange(n, len(H))], [
            *found.markers, *found.antennas, found.c[np.ix_(active, active)]], strict=True):
        np.testing.assert_allclose(block / np.outer(sigma[at], sigma[at]), expected[np.ix_(at, at)],
                                   atol=1e-6)


def test_the_first_frames_are_a_drive_of_their_own(monkeypatch):
    """Equal to the equations of the drive cut there, but for the rounding of the whole drive."""
    dataset, _ = simulate("short", seed=4, mislabelled=0.02, late_ranges=0.2)
    m = measure(dataset)
    weight = (np.arange(len(m.unit_weights)) % 7 > 0).astype(float)
    problem = released(build_problem(m, "arc", Noise(2e-3, 1.5, 0.7)), GROUPS)
    problem = replace(problem, accepted=AcceptedMeasurements(m, weight, range_kernel=LATE_KERNEL))
    state = odometry_state(m, "arc")
    monkeypatch.setattr(noise, "MIN_MEASUREMENTS", 50)
    monkeypatch.setattr(noise, "LEARNING_FRAMES", 60)
    part = equations_of_first_frames(NormalEquations(problem, state))
    cut = measure(dataset.first(int(m.frame[59]) + 1))
    np.testing.assert_array_equal(part.problem.measurements.frame, cut.frame)
    np.testing.assert_array_equal(part.problem.measurements.frame, m.frame[:60])
    rows, kept = m.sightings.row < 60, m.ranges.row < 60
    np.testing.assert_array_equal(part.problem.measurements.sightings.z, m.sightings.z[rows])
    np.testing.assert_array_equal(part.problem.accepted.weight, np.r_[
        weight[:len(m.marker_row)][rows], weight[len(m.marker_row):][kept]])
    whole = NormalEquations(problem, state)
    np.testing.assert_allclose(part.linearized[0].e,
                               whole.linearized[0].e[whole.linearized[0].row < 60], rtol=1e-12)
    np.testing.assert_allclose(part.linearized[2].e,
                               whole.linearized[2].e[whole.linearized[2].row < 60], rtol=1e-12)
    assert np.isfinite(part.step()).all()
    monkeypatch.setattr(noise, "LEARNING_FRAMES", len(m.frame))
    assert equations_of_first_frames(whole) is whole
    monkeypatch.undo()
    monkeypatch.setattr(noise, "LEARNING_FRAMES", 60)
    assert equations_of_first_frames(whole) is whole                  # too few ranges there


def test_noise_of_a_sensor_that_starts_late_is_learned(monkeypatch):
    """Sigmas of sightings that are six times too small; the first frames have ranges only."""
    dataset, _ = simulate("short", 2)
    aruco = dataset.aruco.select(dataset.aruco.pose > 1000)
    dataset = replace(dataset, aruco=replace(aruco, covariance=aruco.covariance / 36))
    whole = slam.estimate(dataset)
    monkeypatch.setattr(noise, "LEARNING_FRAMES", 40)
    found = slam.estimate(dataset)
    assert np.isclose(found.noise.sightings, whole.noise.sightings, rtol=1e-3)
    assert 5 < found.noise.sightings < 7 and found.rejected.mean() < 0.02


PRECISION = np.array([[40.0, 12.0, 0.0], [12.0, 90.0, -20.0], [0.0, -20.0, 60.0]])
CENTRE = np.log([2e-3, 1.3, 0.8])


def gaussian(x):
    """A log density of the three logarithms, with its maximum 7 at CENTRE."""
    return 7.0 - (x - CENTRE) @ PRECISION @ (x - CENTRE) / 2


@pytest.mark.parametrize("free", [[0, 1, 2], [0, 2], [0]])
def test_differences_of_a_quadratic_are_exact(free):
    """Also where only some components are free, and where the correlation is known."""
    free, x = np.array(free), CENTRE + [0.1, -0.2, 0.15]
    steps = np.array([0.2, 0.1, 0.05])[free]
    expected = -PRECISION[np.ix_(free, free)]
    scale = np.sqrt(-np.diag(expected))
    for correlation in (None, -expected / np.outer(scale, scale)):
        gradient, hessian = noise._differences(
            gaussian, x, gaussian(x), free, steps, correlation)
        np.testing.assert_allclose(gradient, -(PRECISION @ (x - CENTRE))[free], rtol=1e-9)
        np.testing.assert_allclose(hessian, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("free", [[0, 1, 2], [0, 1]])
@pytest.mark.parametrize("start", [[0.1, 0.0, 0.1], [2.5, -2.0, 1.5]])
def test_newtons_method_finds_mode_and_covariance_of_a_gaussian(free, start):
    """What is not free keeps its start, and its covariance is zero."""
    free, x = np.array(free), CENTRE + start
    given = np.setdiff1d(range(3), free)
    mode, value, covariance = noise._mode(
        gaussian, x, gaussian(x), free, np.full(len(free), 0.1))
    H, cross = PRECISION[np.ix_(free, free)], PRECISION[np.ix_(free, given)]
    expected = CENTRE[free] - np.linalg.solve(H, cross @ (x - CENTRE)[given])
    np.testing.assert_allclose(mode[free], expected, atol=1e-6)
    np.testing.assert_array_equal(mode[given], x[given])
    assert np.isclose(value, gaussian(mode)) and value > gaussian(x)
    np.testing.assert_allclose(covariance[np.ix_(free, free)], np.linalg.inv(H), rtol=1e-6)
    assert not covariance[given].any() and not covariance[:, given].any()


def test_newtons_method_stays_within_the_bounds_and_never_descends():
    """A mode beyond the bound of the slip, and a density that is not concave at the start."""
    beyond = CENTRE.copy()
    beyond[0] = BOUNDS[1, 0] + 1.0
    mode, *_ = noise._mode(
        lambda x: -50 * np.sum((x - beyond)**2), CENTRE, -1e3, np.arange(3), np.full(3, 0.1))
    np.testing.assert_allclose(mode, [BOUNDS[1, 0], *beyond[1:]], atol=1e-6)

    def two_hills(x):
        off = x[0] - CENTRE[0]
        return float(np.logaddexp(-8 * (off - 1)**2, 1 - 8 * (off + 1)**2))

    mode, value, _ = noise._mode(two_hills, CENTRE + [0.05, 0, 0],
                                 two_hills(CENTRE + [0.05, 0, 0]), np.array([0]),
                                 np.array([0.1]))
    assert value >= two_hills(CENTRE + [0.05, 0, 0])
    assert abs(abs(mode[0] - CENTRE[0]) - 1) < 0.05


@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_points_of_the_posterior_have_its_moments(scale):
    """Along the slip by points, across by a wider noise: log-normal root mean squares.

    A narrow posterior is one point.
    """
    C = scale * np.array([[0.25, 0.06, 0.0], [0.06, 0.04, 0.01], [0.0, 0.01, 0.09]])
    information = np.linalg.inv(C)
    points = noise._points(
        lambda x: -(x - CENTRE) @ information @ (x - CENTRE) / 2, CENTRE, 0.0, C)
    weights, noises = zip(*points)
    assert len(points) == (5 if scale == 1 else 1) and np.isclose(sum(weights), 1)
    logs = np.array([noise.logarithms for noise in noises])
    if scale < 1:
        np.testing.assert_allclose(logs[0], CENTRE + np.diag(C), rtol=1e-12)
        return
    rest = np.diag(C) - C[0]**2 / C[0, 0]                       # given the slip
    np.testing.assert_allclose(weights @ logs, CENTRE + rest, atol=1e-6)
    spread = logs - CENTRE - rest
    np.testing.assert_allclose(np.einsum("p,pi,pj->ij", weights, spread, spread),
                               np.outer(C[0], C[0]) / C[0, 0], rtol=0.02, atol=1e-12)


def test_gates_are_quantiles_of_chi_squared():
    """They are numbers in the code because scipy.special takes long to import."""
    assert np.allclose([sightings.GATE, sightings.POINT_GATE], chdtri([3, 2], 1e-3), rtol=1e-12)
    assert np.isclose(files.AGREEMENT_GATE, chdtri(3, 0.05), rtol=1e-5)


def test_where_cholesky_fails_qr_gives_the_same_solution(monkeypatch):
    dataset, _ = simulate("short", seed=4)
    fit = fit_from_odometry(measure(known_noise(dataset.without("uwb").first(400), 1e-3)))
    poses = fit.state.poses + [0.01, 0, 0]
    start = state_from_poses(fit.problem.measurements, poses, np.zeros((len(poses), 3, 3)))
    expected = optimize(fit.problem, start).state

    class Failing:
        """A linearised graph whose Cholesky decomposition fails."""

        def __init__(self, graph):
            self.graph = graph

        def eliminateMultifrontal(self, ordering):             # noqa: N802, GTSAM's name
            raise RuntimeError("Indeterminate linear system")

        def __getattr__(self, name):
            return getattr(self.graph, name)

    linearize = graph.linearize
    monkeypatch.setattr(graph, "linearize", lambda *arguments: Failing(linearize(*arguments)))
    monkeypatch.setattr(linear, "decomposition", lambda H: None)
    np.testing.assert_allclose(optimize(fit.problem, start).state.poses, expected.poses, atol=1e-8)


def test_the_normal_equations_are_those_of_gtsams_linear_graph():
    """Solution and log determinant, for the noise of the problem and for another one."""
    dataset, _ = simulate("short", seed=4, mislabelled=0.02, late_ranges=0.2)
    fit = fit_from_odometry(measure(known_noise(dataset.first(600), 1e-3)))
    accepted = replace(fit.problem.accepted, range_kernel=None, range_bias=0.0)
    problem = replace(fit.problem, accepted=accepted, noise=Noise(2e-3, 1.5, 0.7))
    equations = NormalEquations(replace(problem, noise=Noise(1e-3)), fit.state)
    delta, found = laplace_approximation(equations, problem.noise)
    linear = graph.linearize(problem, fit.state)
    tree = linear.eliminateMultifrontal()
    solution, m = tree.optimize(), problem.measurements
    for i in (0, 7, len(m.frame) - 1):
        np.testing.assert_allclose(delta[equations.structure.rows([i], 3)[0]], solution.at(X(i)),
                                   rtol=1e-5, atol=1e-8)      # both square the condition number
    S = 3 * np.count_nonzero(accepted.sighting_weight)
    expected = -linear.error(solution) - tree.logDeterminant() \
        - np.sum(np.linalg.slogdet(problem.odometry.covariance(2e-3))[1]) / 2 \
        - S * np.log(1.5) - np.count_nonzero(accepted.range_weight) * np.log(0.7)
    assert np.isclose(found, expected, atol=1e-6)


def test_marginal_covariances_equal_gtsams():
    dataset, _ = simulate("short", seed=4, mislabelled=0.02, late_ranges=0.2)
    vehicle = replace(dataset.vehicle, sigma_range_offset=0.2)
    m = measure(known_noise(replace(dataset, vehicle=vehicle), 1e-3))
    fit = fit_from_odometry(m)
    marginal = marginal_covariances(fit.equations, fit.problem.noise)
    active = fit.problem.active
    assert active.sum() == 4 and active[WHEELS].all() and active[OFFSET]
    tree = graph.linearize(fit.problem, fit.state).eliminateMultifrontal()
    for i in range(0, len(marginal.pairs), 13):
        expected = tree.jointMarginalCovariance([X(i), X(i + 1), C(0)]).fullMatrix()[:9, :9]
        unit = np.r_[np.ones(6), fit.problem.sigma[WHEELS]]
        expected = expected * np.outer(unit, unit)
        scale = np.outer(*2 * [np.sqrt(np.diag(expected))])
        np.testing.assert_allclose(marginal.pairs[i] / scale, expected / scale, atol=1e-6)
    for j, found in enumerate(marginal.markers):
        np.testing.assert_allclose(found, tree.marginalCovariance(L(j)), rtol=1e-5,
                                   atol=1e-6 * found.max())
    for k, found in enumerate(marginal.antennas):
        np.testing.assert_allclose(found, tree.marginalCovariance(A(k)), rtol=1e-5, atol=1e-9)
    unit = fit.problem.sigma[active]
    np.testing.assert_allclose(marginal.c[np.ix_(active, active)] / np.outer(unit, unit),
                               tree.marginalCovariance(C(0)), rtol=1e-5, atol=1e-7)
