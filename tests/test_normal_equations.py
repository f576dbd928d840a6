"""The linearised graph: normal equations, GTSAM's equal ones, and blocks of the inverse."""

from dataclasses import replace

import numpy as np
import pytest
from numeric import as_points, known_noise, vehicle
from scipy.special import chdtri

from slamlib.core import sightings
from slamlib.core.errors import DatasetError
from slamlib.core.graph_solution import eliminated
from slamlib.core.kernels import KERNELS
from slamlib.robust import linear, noise, solution
from slamlib.robust.calibration import ENTRIES
from slamlib.robust.covariances import marginal_covariances
from slamlib.robust.initialization import odometry_state
from slamlib.robust.linear import NormalEquations, build_problem, laplace_approximation
from slamlib.robust.measurements import WEAK_SIGMA, Noise, accept_all, measure
from slamlib.robust.optimize import optimize
from slamlib.studies.simulation import simulate

GROUPS = frozenset(entry.group for entry in ENTRIES) | {"antenna-offsets"}


def released(problem, groups):
    """The Problem in which groups of the calibration are hardly known."""
    sigma = problem.measurements.calibration.sigma_without(groups)
    return replace(problem, sigma=sigma, released=frozenset(groups))


def test_markers_without_accepted_sightings_have_a_weak_prior_and_move_nothing_else():
    """Two markers with a heading, of consecutive ids, and a point; GTSAM takes the same step."""
    dataset = vehicle(kernel="quadratic")(simulate("short", seed=4)[0])
    points = dataset.aruco.marker == dataset.aruco.marker[0]
    m = measure(replace(dataset, aruco=as_points(dataset.aruco, points, 4.0)).first(500))
    point, = np.flatnonzero(~m.oriented)
    first = np.flatnonzero(m.oriented[1:] & m.oriented[:-1])[0]
    problem, accepted = build_problem(m, "arc"), accept_all(m)
    problem = replace(problem, accepted=accepted._replace(sightings=replace(
        accepted.sightings, weight=1.0 - np.isin(m.marker_row, [point, first, first + 1]))))
    state = odometry_state(m, "arc")
    equations = NormalEquations(problem, state)
    H = equations.structure.matrix(equations.sums(problem.noise).H).toarray()
    for j in (point, first, first + 1):
        own = equations.structure.rows[len(m.frame) + j, :2 + m.oriented[j]]
        np.testing.assert_allclose(H[np.ix_(own, own)], np.eye(len(own)) / WEAK_SIGMA**2)
        assert np.count_nonzero(H[own]) == len(own)
    graph, row = solution.graph_of(problem, problem.noise), equations.structure.rows
    values = solution.values_of(problem, state, graph)
    _, step = eliminated(graph.linearize(values))
    found = equations.step()
    for key, own in zip(solution.variable_keys(problem), row):
        if values.exists(key):
            expected = step.at(key)
            np.testing.assert_allclose(found[own[:len(expected)]], expected, rtol=1e-4, atol=1e-8)


@pytest.mark.parametrize("poses", [1, 15, 400])
def test_selected_blocks_are_those_of_the_dense_inverse(poses):
    """Of one frame, of two, and of many; there also a point, and free offsets of the ranges."""
    dataset = simulate("short", seed=4)[0]
    points = dataset.aruco.marker == dataset.aruco.marker[0]
    m, given = measure(replace(
        dataset, aruco=as_points(dataset.aruco, points)).first(poses)), Noise(2e-3, 1.5, 0.7)
    problem = released(build_problem(m, "arc"), {"range-offset"} if poses > 1 else ())
    equations = NormalEquations(problem, odometry_state(m, "arc"))
    found, sums = marginal_covariances(equations, given), equations.sums(given)
    H, active = equations.structure.matrix(sums.H).toarray(), problem.active
    n, rows = len(H), equations.structure.rows
    np.testing.assert_allclose(H, H.T, rtol=1e-9, atol=1e-6)
    unit = np.r_[np.ones(n), problem.sigma[active]]
    expected = np.linalg.inv(np.block([[H, sums.border[:n, :-1]], [sums.border[:, :-1].T]])) \
        * np.outer(unit, unit)
    sigma = np.sqrt(np.diag(expected))
    wheels = np.broadcast_to(np.arange(n, n + 3), (len(found.pairs), 3))
    frames, landmarks = np.split(rows, [len(m.frame)])
    assert not found.c[~active].any() and not found.c[:, ~active].any()
    for at, blocks in (
            (np.concatenate([frames[:-1], frames[1:], wheels], axis=1), found.pairs),
            (landmarks, found.landmarks),
            (np.arange(n, len(unit))[None], found.c[np.ix_(active, active)][None])):
        scale = sigma[at][:, :, None] * sigma[at][:, None]
        np.testing.assert_allclose(
            blocks / scale, expected[at[:, :, None], at[:, None]] / scale, atol=1e-6)


CENTRE = np.log([2e-3, 1.3, 0.8])


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
    logs = np.log(noises)
    if scale < 1:
        np.testing.assert_allclose(logs[0], CENTRE + np.diag(C), rtol=1e-12)
        return
    rest = np.diag(C) - C[0]**2 / C[0, 0]                       # given the slip
    np.testing.assert_allclose(weights @ logs, CENTRE + rest, atol=1e-6)
    spread = logs - CENTRE - rest
    np.testing.assert_allclose(np.einsum("p,pi,pj->ij", weights, spread, spread),
                               np.outer(C[0], C[0]) / C[0, 0], rtol=0.02, atol=1e-12)


@pytest.mark.parametrize("free", [[0, 1, 2], [0, 2]], ids=str)
@pytest.mark.parametrize("skew, steps, calls", [
    (0.0, 0.1, 1), (0.0, 1e-6, 1), (0.0, 0.12, 2), (0.0, 5.0, 2), (0.5, 0.1, 5)])
def test_newton_finds_the_mode_of_a_log_density_and_its_covariance(free, skew, steps, calls):
    """A quadratic takes one step, if differences are over less than two standard deviations."""
    C, values = np.diag([0.04, 0.01, 0.0025])[free][:, free], []
    C[0, 1] = C[1, 0] = 0.5 * np.sqrt(C[0, 0] * C[1, 1])

    def log_density(x):
        off = (x - CENTRE)[free]
        u = off[0] / np.sqrt(C[0, 0])
        values.append(-off @ np.linalg.inv(C) @ off / 2
                      + skew * (1 + u + u**2 / 2 - np.exp(u)))       # not at 0
        return values[-1]

    start = CENTRE + 3 * np.sqrt([0.04, 0.01, 0.0025]) * np.isin(range(3), free)
    x, value, covariance = noise._mode(
        log_density, start, log_density(start), np.array(free), np.full(len(free), steps))
    assert np.abs((x - CENTRE)[free] / np.sqrt(np.diag(C))).max() < 0.1
    assert value == log_density(x) == max(values)
    expected = np.zeros((3, 3))
    expected[np.ix_(free, free)] = C
    np.testing.assert_allclose(covariance, expected, atol=1e-6 + 0.1 * skew * C.max())
    pairs = len(free) * (len(free) - 1) // 2
    assert len(values) - 2 == calls * (2 * len(free) + pairs + 1)


def test_gates_are_quantiles_of_chi_squared():
    """They are numbers in the code because scipy.special takes long to import."""
    assert np.allclose([sightings.GATE, sightings.POINT_GATE], chdtri([3, 2], 1e-3), rtol=1e-12)


def test_singular_normal_equations_are_told(monkeypatch):
    m = measure(simulate("short", seed=4)[0].first(100))
    monkeypatch.setattr(linear, "linear_solution", lambda *_: None)
    with pytest.raises(DatasetError, match="measurements that determine every pose and landmark"):
        optimize(build_problem(m, "arc"), odometry_state(m, "arc"))


@pytest.mark.parametrize("kernel", [None, KERNELS["Cauchy"]], ids=["quadratic", "Cauchy"])
@pytest.mark.parametrize("groups", [(), GROUPS], ids=len)
def test_solution_and_evidence_are_those_of_dense_normal_equations(groups, kernel):
    """For the noise of the problem and for another one; a kernel takes part of the variance."""
    dataset = simulate("short", seed=4, mislabelled=0.02, late_ranges=0.2)[0].first(300)
    m = measure(known_noise(dataset, 1e-3))
    problem = replace(released(build_problem(m, "arc", Noise(1e-3)), groups),
                      accepted=accept_all(m, kernel))
    equations = NormalEquations(problem, odometry_state(m, "arc"))
    count = equations.counts()
    if kernel is None:
        assert count == [3 * len(m.marker_row), len(m.ranges.row)]
    for other in (problem.noise, Noise(2e-3, 1.5, 0.7)):
        delta, found = laplace_approximation(equations, other)
        sums = equations.sums(other, consistent=True)
        n = len(m.structure.diagonal)
        H = m.structure.matrix(sums.H).toarray()
        information = np.block([[H, sums.border[:n, :-1]], [sums.border[:, :-1].T]])
        unit = 1 / np.sqrt(np.diag(information))
        scaled = unit[:, None] * information * unit
        expected = -unit * np.linalg.solve(scaled, unit * sums.border[:, -1])
        np.testing.assert_allclose(delta, expected, rtol=1e-5, atol=1e-8)
        squared = sums.squared + sums.border[:, -1] @ expected
        determinant = np.linalg.slogdet(scaled)[1] - 2 * np.sum(np.log(unit))
        of_odometry = np.sum(np.linalg.slogdet(problem.odometry.covariance(other.slip))[1])
        log_factors = np.log([other.sightings, other.ranges]) @ count
        assert np.isclose(
            found, -(squared + determinant + of_odometry) / 2 - log_factors, atol=1e-5)
