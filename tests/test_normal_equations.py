"""The linearised graph: normal equations, GTSAM's equal ones, and blocks of the inverse."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import C
from numeric import as_points, known_noise
from scipy.special import chdtri

from slamlib import sightings
from slamlib.simulation import simulate
from slamlib.slam import factors, graph, linear, noise
from slamlib.slam.calibration import ENTRIES, OFFSET, WHEELS
from slamlib.slam.covariances import marginal_covariances
from slamlib.slam.fit import LATE_KERNEL
from slamlib.slam.graph import optimize
from slamlib.slam.initialization import odometry_state, state_from_poses
from slamlib.slam.linear import NormalEquations, build_problem, laplace_approximation
from slamlib.slam.measurements import (
    GUESS_PRIOR_SIGMA,
    WEAK_SIGMA,
    AcceptedMeasurements,
    Noise,
    measure,
)
from slamlib.slam.noise import BOUNDS
from slamlib.slam.own import gtsam_values, variable_keys
from slamlib.slam.pipeline import fit_from_odometry

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


def native_graph(problem):
    """The same factors as GTSAM has them, but odometry and sightings of points."""
    accepted, noise, model = problem.accepted, problem.noise, gtsam.noiseModel
    m, native = problem.measurements, gtsam.NonlinearFactorGraph()
    key, v, s = variable_keys(m), m.variables, m.sightings
    weight = accepted.sighting_weight * m.as_pose
    roots = m.sighting_roots[0] * (np.sqrt(weight) / noise.sightings)[:, None, None]
    for row in np.flatnonzero(weight):
        native.add(gtsam.BetweenFactorPose2(
            key[s.row[row]], key[v.markers[m.marker_row[row]]], gtsam.Pose2(*s.z[row]),
            model.Robust.Create(accepted.sighting_kernel,
                                model.Gaussian.SqrtInformation(roots[row], False))))
    r, sigmas = m.ranges, noise.ranges * m.ranges.sigma
    for row in np.flatnonzero(accepted.range_weight):
        native.add(gtsam.RangeFactor2D(
            key[r.row[row]], key[v.antennas[r.antenna[row]]],
            r.distance[row] - accepted.range_bias * sigmas[row], model.Robust.Create(
                accepted.range_kernel, model.Isotropic.Sigma(1, sigmas[row]))))
    q = int(problem.active.sum())
    native.add(gtsam.PriorFactorPose2(key[0], gtsam.Pose2(), model.Diagonal.Sigmas(m.origin_sigma)))
    native.add(gtsam.PriorFactorVector(C(0), np.zeros(q), model.Unit.Create(q)))
    for k, position in enumerate(m.guess):
        native.add(gtsam.PriorFactorPoint2(
            key[v.antennas[k]], position, model.Isotropic.Sigma(2, GUESS_PRIOR_SIGMA)))
    return native


def test_gtsam_has_the_same_error_and_takes_the_same_step():
    """Far from the optimum, with kernels, points, wrong labels, late ranges and any calibration.

    GTSAM evaluates and linearises its own factors one by one.
    """
    dataset, _ = simulate("short", seed=4, mislabelled=0.02, late_ranges=0.2)
    points = np.isin(dataset.aruco.marker, dataset.aruco.marker[:3])
    m = measure(replace(dataset, aruco=as_points(dataset.aruco, points, 4.0)).first(700))
    assert 0 < np.count_nonzero(m.oriented) < len(m.oriented)
    state = odometry_state(m, "arc")
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(3.0)
    accepted = AcceptedMeasurements(m, m.unit_weights, cauchy, LATE_KERNEL)
    problem = replace(build_problem(m, "arc", Noise(2e-3, 1.5, 0.7)), accepted=accepted)
    equations = NormalEquations(problem, state)
    values, native = gtsam_values(problem, state), native_graph(problem)
    others = factors.odometry_error(problem.odometry, state.poses, state.c[WHEELS])[0]
    others = problem.odometry.whitening(2e-3)[0] @ others[..., None]
    expected = native.error(values) + np.sum(others**2) / 2 \
        + equations.linearized[1].error
    assert np.isclose(equations.error, expected, rtol=1e-12)
    own, (poses, _, ranges, _) = native.linearize(values), equations.linearized
    for i, (J, e) in enumerate(zip([*poses.J, *ranges.J[:, :, :5]], [*poses.e, *ranges.e])):
        found = np.c_[own.at(i).jacobian()]        # of small angles its logarithm's is rounded
        np.testing.assert_allclose(np.c_[J, -e], found, atol=1e-4 * np.abs(J).max())
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
    points = dataset.aruco.marker == dataset.aruco.marker[0]
    m = measure(replace(dataset, aruco=as_points(dataset.aruco, points, 4.0)).first(500))
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


PRECISION = np.array([[40.0, 12.0, 0.0], [12.0, 90.0, -20.0], [0.0, -20.0, 60.0]])
CENTRE = np.log([2e-3, 1.3, 0.8])


def gaussian(x):
    """A log density of the three logarithms, with its maximum 7 at CENTRE."""
    return 7.0 - (x - CENTRE) @ PRECISION @ (x - CENTRE) / 2


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
    keys = variable_keys(m)
    for i in (0, 7, len(m.frame) - 1):
        np.testing.assert_allclose(delta[equations.structure.rows([i], 3)[0]], solution.at(keys[i]),
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
    keys, v = variable_keys(m), m.variables
    for i in range(0, len(marginal.pairs), 13):
        expected = tree.jointMarginalCovariance([keys[i], keys[i + 1], C(0)]).fullMatrix()[:9, :9]
        unit = np.r_[np.ones(6), fit.problem.sigma[WHEELS]]
        expected = expected * np.outer(unit, unit)
        scale = np.outer(*2 * [np.sqrt(np.diag(expected))])
        np.testing.assert_allclose(marginal.pairs[i] / scale, expected / scale, atol=1e-6)
    for j, found in enumerate(marginal.markers):
        np.testing.assert_allclose(found, tree.marginalCovariance(keys[v.markers[j]]), rtol=1e-5,
                                   atol=1e-6 * found.max())
    for k, found in enumerate(marginal.antennas):
        np.testing.assert_allclose(found, tree.marginalCovariance(keys[v.antennas[k]]), rtol=1e-5,
                                   atol=1e-9)
    unit = fit.problem.sigma[active]
    np.testing.assert_allclose(marginal.c[np.ix_(active, active)] / np.outer(unit, unit),
                               tree.marginalCovariance(C(0)), rtol=1e-5, atol=1e-7)
