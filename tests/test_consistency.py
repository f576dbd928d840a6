from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from slamlib import evaluation, se2, slam
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


def test_residuals_of_right_drives_are_within_their_bands_but_those_of_a_worse_marker():
    """Of 0.1 % of the landmarks of a drive at most; of one marker the stated sigmas are halved."""
    dataset, _ = simulate("short", 1)
    seen = dataset.aruco
    marker = np.bincount(seen.marker).argmax()
    smaller = np.where(seen.marker == marker, 4.0, 1.0)[:, None, None]
    spoilt = replace(dataset, aruco=replace(seen, covariance=seen.covariance / smaller))
    for drive, worse in ((dataset, []), (spoilt, [marker])):
        found = slam.estimate(drive)
        for uwb in (None, drive.uwb):
            ids, ratio, dof = consistency.residuals_by_landmark(found, uwb)
            band = np.array([evaluation.nees_band(1, nu, 1 - 1e-3 / len(ids)) for nu in dof])
            outside = (ratio * dof < band[:, 0]) | (ratio * dof > band[:, 1])
            assert ids[outside].tolist() == (worse if uwb is None else [])
            assert np.isclose(np.sum(ratio * dof), np.sum(dof))


def test_landmarks_without_redundancy_have_no_residuals():
    """A marker with four sightings, one of them rejected, a point with two, one with one."""
    residual = np.array([[1, 2, 2], [1, 1, 1], [9, 9, 9], [2, 0, 1], [3, 1, 0], [1, 1, 0],
                         [5, 5, 5]])
    found = SimpleNamespace(
        sightings=SimpleNamespace(marker=np.array([4, 4, 4, 4, 7, 7, 9])), residual=residual,
        rejected=np.arange(7) == 2, range_weight=np.array([1, 1, 1, 0.5, 1, 1]),
        range_residual=np.arange(6.0))
    ids, ratio, dof = consistency.residuals_by_landmark(found)
    usual = (17 + 12) / (6 + 2)
    np.testing.assert_array_equal(ids, [4, 7, 9])
    np.testing.assert_allclose(ratio, [17 / 6 / usual, 12 / 2 / usual, np.nan])
    np.testing.assert_allclose(dof, [6 * usual, 2 * usual, np.nan])
    antennas = SimpleNamespace(antenna=np.array([1, 1, 1, 1, 2, 2]))
    ids, ratio, dof = consistency.residuals_by_landmark(found, antennas)
    np.testing.assert_allclose(ratio, [1, np.nan])
    np.testing.assert_allclose(dof, [(0 + 1 + 4 + 4.5), np.nan])
