"""The linearised graph: normal equations, GTSAM's equal ones, and blocks of the inverse."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numeric import as_points, known_noise, short
from numpy.testing import assert_allclose
from scipy.special import chdtri

from slamlib.core import sightings
from slamlib.core.errors import DatasetError
from slamlib.core.kernels import KERNELS
from slamlib.robust import choices, linear
from slamlib.robust.calibration import ENTRIES
from slamlib.robust.factors import linearize_measurements
from slamlib.robust.fit import residuals
from slamlib.robust.initialization import odometry_state
from slamlib.robust.linear import (
    NormalEquations,
    build_problem,
    errors_after,
    laplace_approximation,
    posterior_draws,
    retract,
)
from slamlib.robust.measurements import WEAK_SIGMA, Noise, _structure, accept_all, measure
from slamlib.robust.optimize import optimize

GROUPS = frozenset(entry.group for entry in ENTRIES) | {"antenna-offsets"}


def dense_information(structure, sums):
    """The whole information matrix, of poses, landmarks and calibration."""
    H = structure.matrix(sums.H).toarray()
    border = sums.border[:, :-1]
    return np.block([[H, border[:len(H)]], [border.T]])


def released(problem, groups):
    """The Problem in which groups of the calibration are hardly known."""
    return replace(problem, prior=problem.measurements.calibration.prior(groups))


def with_a_point(poses):
    """A drive of which the first marker is a point."""
    dataset, _ = short(4, poses)
    points = dataset.aruco.marker == dataset.aruco.marker[0]
    return replace(dataset, aruco=as_points(dataset.aruco, points))


def test_blocks_of_more_variables_than_a_32_bit_number_counts_pairs_of():
    count = 50_000
    chain = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    structure = _structure(np.ones(count, bool), chain)
    assert structure.places.nnz == 9 * (count + 2 * len(chain))
    assert len(np.unique(structure.diagonal)) == 3 * count


def test_markers_without_accepted_sightings_have_a_weak_prior_and_nothing_else():
    """Pairs of consecutive ids, and a point."""
    m = measure(with_a_point(500))
    lost = (np.arange(len(m.oriented)) // 2 % 2 == 0) | ~m.oriented
    accepted = accept_all(m)
    sightings = replace(accepted.sightings, weight=1.0 - lost[m.marker_row])
    problem = replace(build_problem(m, "arc"), accepted=accepted._replace(sightings=sightings))
    equations = NormalEquations(problem, odometry_state(m, "arc"))
    H = m.structure.matrix(equations.sums(problem.noise).H).toarray()
    for j in np.flatnonzero(lost):
        own = m.structure.rows[len(m.frame) + j, :2 + m.oriented[j]]
        assert_allclose(H[own], np.eye(len(H))[own] / WEAK_SIGMA**2)


def test_gates_are_quantiles_of_chi_squared():
    """They are numbers in the code because scipy.special takes long to import."""
    assert np.allclose([sightings.GATE, sightings.POINT_GATE], chdtri([3, 2], 1e-3), rtol=1e-12)


def test_singular_normal_equations_are_told(monkeypatch):
    m = measure(short(4, 100)[0])
    monkeypatch.setattr(linear, "linear_solution", lambda *_: None)
    with pytest.raises(DatasetError, match="measurements that determine every pose and landmark"):
        optimize(build_problem(m, "arc"), odometry_state(m, "arc"))


@pytest.mark.parametrize("kernel", [None, KERNELS["Cauchy"]])
@pytest.mark.parametrize("groups", [(), GROUPS])
def test_solution_and_evidence_are_those_of_dense_normal_equations(groups, kernel):
    """For the noise of the problem and for another one; a kernel takes part of the variance."""
    dataset, _ = short(4, 300, mislabelled=0.02, late_ranges=0.2)
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
        information = dense_information(m.structure, sums)
        gradient = sums.border[:, -1]
        unit = 1 / np.sqrt(np.diag(information))
        scaled = np.outer(unit, unit) * information
        expected = -unit * np.linalg.solve(scaled, unit * gradient)
        assert_allclose(delta, expected, rtol=1e-5, atol=1e-8)
        squared = sums.squared + gradient @ expected
        determinant = np.linalg.slogdet(scaled)[1] - 2 * np.sum(np.log(unit))
        of_odometry = np.sum(np.linalg.slogdet(problem.odometry.covariance(other.slip))[1])
        log_factors = np.log([other.sightings, other.ranges]) @ count
        assert np.isclose(
            found, -(squared + determinant + of_odometry) / 2 - log_factors, atol=1e-5)


def test_draws_have_the_covariance_of_the_posterior():
    """Whitened by the inverse root of the dense one; a covariance of N draws is off by N^-1/2."""
    m = measure(known_noise(short(4, 60)[0], 1e-3))
    problem = released(build_problem(m, "arc", Noise(1e-3)), ("marker-size", "wheel-scale"))
    equations = NormalEquations(problem, odometry_state(m, "arc"))
    information = dense_information(m.structure, equations.sums(problem.noise))
    white = np.linalg.cholesky(information).T @ posterior_draws(equations, 4000)
    covariance = white @ white.T / 4000
    assert np.abs(covariance - np.eye(len(covariance))).max() < 5 * np.sqrt(2 / 4000)
    assert_allclose(posterior_draws(equations, 4000), posterior_draws(equations, 4000))


def test_changes_of_errors_by_small_steps_are_those_of_residuals():
    dataset, _ = short(4, 300)
    m = measure(dataset)
    problem = released(build_problem(m, "arc"), GROUPS)
    state = odometry_state(m, "arc")
    factors = linearize_measurements(problem, state)
    steps = 1e-6 * np.random.default_rng(1).standard_normal((len(m.structure.diagonal), 2))
    steps = np.concatenate([steps, np.full((problem.active.sum(), 2), 1e-5)])
    for k, step in enumerate(steps.T):
        moved = residuals(problem, retract(problem, state, step))
        back = residuals(problem, retract(problem, state, -step))
        for kind, there, before in zip(factors, moved, back):
            change = errors_after(kind, m.structure, steps)[:, :, k]
            numeric = (before - there).reshape(change.shape) / 2       # measured minus expected
            assert_allclose(change, numeric, atol=1e-4 * np.abs(numeric).max())


@pytest.mark.parametrize("groups", [(), ("marker-size",), ("wheel-scale", "tag-offset")])
def test_the_last_position_is_as_certain_as_dense_normal_equations_say(groups):
    """For any groups, by one linearisation with all of them released."""
    m = measure(known_noise(short(4, 300)[0], 1e-3))
    problem = released(build_problem(m, "arc", Noise(1e-3)), groups)
    state = odometry_state(m, "arc")
    sums = NormalEquations(problem, state).sums(problem.noise)
    last = m.structure.rows[len(m.frame) - 1, :2]
    expected = np.linalg.inv(dense_information(m.structure, sums))[last, last].sum()
    likelihood = choices._likelihood(SimpleNamespace(problem=problem, state=state))
    root = choices._in_wide_sigmas(m.calibration, likelihood.L, problem.prior.root)
    assert choices._posterior(likelihood, root)[2] == pytest.approx(expected, rel=1e-4)
    assert expected > 1.1 * likelihood.variance
