"""Errors with memory: shares of information, and estimates whose covariances are honest."""

from dataclasses import replace

import numpy as np
import pytest

from slamlib import slam, studies
from slamlib.checks.solution import solution_doubts
from slamlib.evaluation import nees_band
from slamlib.memory import error_memory
from slamlib.simulation import simulate
from slamlib.slam.fit import _with_shares
from slamlib.slam.graph import gtsam_step
from slamlib.slam.linear import NormalEquations
from slamlib.slam.measurements import Noise, measure
from slamlib.slam.pipeline import fit_from_odometry
from slamlib.studies.montecarlo import correlated_errors

LANDMARKS, EACH = 40, 10


def tracks(error):
    """Arguments of `error_memory` for residuals (LANDMARKS, EACH, 3), ten poses apart."""
    landmark, k = np.divmod(np.arange(LANDMARKS * EACH), EACH)
    return landmark, 10 * k, error.reshape(-1, 3), np.ones(len(k), bool)


def test_independent_errors_keep_all_their_information():
    """The landmark takes over their mean, without which they correlate by -1 / EACH."""
    error = np.random.default_rng(0).standard_normal((LANDMARKS, EACH, 3))
    found = error_memory(*tracks(error - error.mean(axis=1, keepdims=True)))
    assert (found.share == 1).all() and abs(found.correlation) < 2 * found.sigma < 1 / EACH
    assert found.sigma == pytest.approx(1 / np.sqrt(LANDMARKS * (EACH - 1) * 3))


@pytest.mark.parametrize("part", [0, 1])
def test_equal_errors_count_once(part):
    """Equal errors of unit variance; also where the landmark takes over a part of all of them."""
    error = np.random.default_rng(1).standard_normal((LANDMARKS, 1, 3))
    error *= np.sqrt((1 - part / 2) / np.mean(error**2))
    found = error_memory(*tracks(np.repeat(error, EACH, axis=1)))
    np.testing.assert_allclose(found.share, 1 / EACH)
    assert found.correlation == pytest.approx(1)


def test_shares_by_hand():
    """Pairs of equal errors: neighbours correlate by 1, the fourth of four with two others not."""
    error = np.repeat(np.random.default_rng(2).standard_normal((LANDMARKS, 5, 3)), 2, axis=1)
    landmark, pose, u, used = tracks(error / np.sqrt(np.mean(error**2)))
    used[::EACH] = False                     # the first of each landmark stays alone
    rho = [np.mean([np.sum(u[k] * u[k + lag]) / 3 for k in np.flatnonzero(used)
                    if k + lag < len(u) and landmark[k + lag] == landmark[k]]) for lag in (1, 2)]
    rho = np.array(rho) + max(0, 1 - np.mean(u[used]**2))
    assert rho[0] > 0.3 and rho[1] < 0.05
    share = error_memory(landmark, pose, u, used).share.reshape(LANDMARKS, EACH)
    np.testing.assert_allclose(share[:, 0], 1)
    np.testing.assert_allclose(share[:, [1, -1]], 1 / (1 + rho[0]))
    np.testing.assert_allclose(share[:, 2:-1], 1 / (1 + 2 * rho[0]))


@pytest.fixture(scope="module")
def remembering():
    dataset, truth = simulate("short", seed=3, memory=0.9)
    return dataset, truth, slam.estimate(replace(dataset, uwb=None))


def test_memory_is_told_and_counted(remembering):
    dataset, _, result = remembering
    assert result.correlation[0] > 0.4 and result.correlation[1] == 0
    assert result.share.sum() < len(dataset.aruco.pose) / 3 and result.noise.sightings == 1
    sentence, = (doubt.sentence for doubt in solution_doubts(result)
                 if doubt.what == "marker-memory")
    assert f"count {len(result.share)} sightings as {result.share.sum():.0f}" in sentence


def test_the_same_step_by_gtsam(remembering):
    """With shares of sightings and of ranges, the latter with their kernel."""
    fit = fit_from_odometry(measure(remembering[0]))
    rng, accepted = np.random.default_rng(0), fit.problem.accepted
    problem = replace(fit.problem, accepted=accepted.with_shares(
        rng.uniform(0.1, 1, len(each.share)) for each in accepted))
    low, shares = replace(problem, noise=Noise(1e-3, 0.3, 0.3)), [
        np.full(len(each.share), share) for each, share in zip(accepted, (0.5, 1.0))]
    found, _ = _with_shares(low, fit.state, None, shares, lambda problem, _: problem.accepted)
    assert found.noise == (1e-3, 0.6, 0.3)               # twice as large for errors with memory
    state = replace(fit.state, antennas=fit.state.antennas + 0.01)
    np.testing.assert_allclose(
        NormalEquations(problem, state).step(), gtsam_step(problem, state), atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9, 0.97])
def test_covariances_are_honest(correlation):
    """Mean NEES of every method, 3 is expected; without memory of errors it is overconfident.

    Shares of information are conservative where the correlation is far from 0 and 1.
    """
    runs = studies.run(correlated_errors, range(8), correlation=correlation, poses=1000)
    for method in ("markers", "problem 3", "problem 4", "known"):
        assert 1 < runs[f"{method} nees"].mean() < 5, method
    assert ((runs["share"] < 1) == (correlation > 0)).all()
    assert runs["residuals"].mean() < correlation + 0.05
    assert (runs["independent nees"].mean() > nees_band(8)[1]) == (correlation > 0)


@pytest.mark.slow
def test_echoes_that_stay():
    """Ranges with slowly changing errors: antennas are as far off as their covariances say."""
    squared = []
    for seed in range(3):
        dataset, truth = simulate("short", seed=seed)
        slow, rng, uwb = np.zeros(len(dataset.uwb.pose)), np.random.default_rng(seed), dataset.uwb
        for antenna in np.unique(uwb.antenna):
            rows = np.flatnonzero(uwb.antenna == antenna)
            kept = np.exp(-np.diff(uwb.pose[rows]) / 500)
            value = slow[rows[0]] = 0.2 * rng.standard_normal()
            for row, share in zip(rows[1:], kept):
                value = share * value + 0.2 * np.sqrt(1 - share**2) * rng.standard_normal()
                slow[row] = value
        result = slam.estimate(replace(dataset, uwb=replace(uwb, range=uwb.range + slow)))
        error = result.antenna_in_world - truth.antenna_in_world
        squared += [e @ np.linalg.solve(C, e) for e, C in zip(error, result.antenna_covariance)]
        assert result.released <= {"range-delay"}
    assert np.median(squared) < 8
