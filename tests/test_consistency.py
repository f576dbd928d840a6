from dataclasses import replace

import numpy as np
import pytest

from slamlib import evaluation, increments, localization, odometry, se2
from slamlib.checks import consistency
from slamlib.simulation import simulate


def nees_of_motion(found, truth):
    true = se2.between(truth.poses[found.start], truth.poses[found.end])
    return evaluation.nees(found.motion, found.covariance, true)


def test_returns_measure_the_true_motion():
    """Without noise the markers give it exactly, also where some labels are wrong."""
    for wrong in (0.0, 0.05):
        dataset, truth = simulate("short", 3, noise=False, mislabelled=wrong)
        found = consistency.returns(dataset)
        true = se2.between(truth.poses[found.start], truth.poses[found.end])
        off = found.motion - true
        assert len(off) > 5
        np.testing.assert_allclose(np.hypot(*off[:, :2].T), 0, atol=1e-8)
        np.testing.assert_allclose(se2.wrap(off[:, 2]), 0, atol=1e-8)
        assert (found.driven >= consistency.MIN_GAP).all() and (np.diff(found.end) > 0).all()
        np.testing.assert_allclose(consistency.discrepancies(found, truth.poses), 0, atol=1e-8)


def test_a_drive_without_markers_or_that_goes_nowhere_again_has_no_returns():
    dataset, _ = simulate("short", 3)
    for each in (dataset.without("aruco"), dataset.first(700), dataset.first(1)):
        found = consistency.returns(each)
        assert found.motion.shape == (0, 3) and found.covariance.shape == (0, 3, 3)
        assert consistency.discrepancies(found, np.zeros((len(each.ticks), 3))).shape == (0, 3)
    assert len(consistency.returns(dataset, gap=1000.0).start) == 0


def test_the_covariance_of_returns_is_consistent():
    """The last return of each of 30 drives, so that they are independent."""
    nees = []
    for seed in range(30):
        dataset, truth = simulate("short", seed, slip=3e-3)
        nees.append(nees_of_motion(consistency.returns(dataset), truth)[-1])
    low, high = evaluation.nees_band(len(nees))
    assert low < np.mean(nees) < high


def odometry_at_returns(dataset):
    """Normalized squared discrepancy of odometry with slip at the last return of a drive."""
    found = consistency.returns(dataset)
    d, v = consistency.discrepancies(found, odometry.dead_reckoning(
        dataset.ticks, dataset.vehicle, model="arc")), dataset.vehicle
    _, by_w = increments.between_poses(dataset.ticks, v, found.start, found.end)
    wheels = by_w * v.sigma_wheel
    C = wheels @ np.swapaxes(wheels, 1, 2) + found.covariance + increments.noise_covariances(
        dataset.ticks, v, found.start, found.end, 1e-3)
    return evaluation.nees(d, C, np.zeros_like(d))[-1]


def test_returns_show_a_wheel_that_is_one_percent_off():
    right, wrong = [], []
    for seed in range(20):
        dataset, _ = simulate("short", seed)
        v = dataset.vehicle
        right.append(odometry_at_returns(dataset))
        wrong.append(odometry_at_returns(replace(
            dataset, vehicle=replace(v, right_radius=1.01 * v.right_radius))))
    # Medians: in one drive the wheels are off by so much that the linear covariance is too small.
    assert 1.0 < np.median(right) < 4.5                        # 2.37 is expected
    assert np.median(wrong) > 50


def test_excess_by_hand():
    best, C_best = np.zeros((4, 3)), np.tile(np.diag([1.0, 1.0, 0.01]), (4, 1, 1))
    poses = np.array([[3.0, 0, 0], [0, 0, 2 * np.pi + 0.2], [1, 1, 1], [np.nan] * 3])
    C = np.array([np.diag([10.0, 2, 1]), np.diag([2.0, 2, 0.05]), np.diag([10.0, 0.5, 1]),
                  np.diag([2.0, 2, 2])])
    before = C.copy()
    np.testing.assert_allclose(consistency.hausman_statistic(poses, C, best, C_best),
                               [1, 1, np.nan, np.nan])
    np.testing.assert_array_equal(C, before)


def test_excess_is_chi_squared_for_an_estimate_from_part_of_the_data():
    """One estimate is a measurement, the better one its average with an independent other one."""
    rng, count = np.random.default_rng(1), 500
    A, B = (S @ np.swapaxes(S, 1, 2) for S in rng.normal(size=(2, count, 3, 3)) / 10)
    a, b = ((np.linalg.cholesky(C) @ rng.normal(size=(count, 3, 1)))[..., 0] for C in (A, B))
    best_C = np.linalg.inv(np.linalg.inv(A) + np.linalg.inv(B))
    best = np.einsum("nij,nj->ni", best_C, np.einsum("nij,nj->ni", np.linalg.inv(A), a)
                     + np.einsum("nij,nj->ni", np.linalg.inv(B), b))
    low, high = evaluation.nees_band(count)
    assert low < np.nanmean(consistency.hausman_statistic(a, A, best, best_C)) < high


@pytest.mark.slow
def test_excess_shows_marker_covariances_that_are_too_small():
    """Markers alone beside their fusion with odometry, at the last frame of 12 drives."""
    def last(dataset):
        alone, fused = localization.localize(dataset.aruco), localization.fuse(dataset)
        at = alone.frame
        return consistency.hausman_statistic(alone.poses, alone.covariances, fused.poses[at],
                                  fused.covariances[at])[-1]

    right, wrong = [], []
    for seed in range(12):
        dataset = simulate("short", seed)[0].first(800)
        right.append(last(dataset))
        wrong.append(last(replace(dataset, aruco=replace(
            dataset.aruco, covariance=dataset.aruco.covariance / 4))))
    low, high = evaluation.nees_band(len(right))
    assert low < np.mean(right) < high
    assert np.nanmean(wrong) > 2 * high
