from dataclasses import replace

import numpy as np
import pytest
from numeric import as_points, central_differences, decided, map_nees, wheel_nees

from slamlib import se2, studies
from slamlib.dataset import ArucoReadings
from slamlib.evaluation import ate, nees, nees_band
from slamlib.localization import fuse, localize
from slamlib.odometry import dead_reckoning
from slamlib.simulation import simulate


def test_perfect_data_give_the_exact_poses_map_and_wheels():
    dataset, truth = simulate("short", seed=1, noise=False)
    for fused in (fuse(dataset, slip=1e-3), fuse(dataset)):
        np.testing.assert_allclose(fused.poses, truth.poses, atol=1e-9)
        np.testing.assert_allclose(fused.wheel, [0.1, 0.1, 0.4], atol=1e-9)
    found = localize(dataset.aruco)
    error = se2.difference(found.poses, truth.poses[found.frame])
    np.testing.assert_allclose(error, 0, atol=1e-9)
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, found.marker)]
    np.testing.assert_allclose(found.marker_in_world, true_map, atol=1e-9)


def test_two_increments_by_hand():
    """One marker 1 m ahead, three poses on a line, headings known.

    With C = s^2 I for the position and almost no heading error, the increment between two poses has
    the variance 2 s^2. So has the third pose, because it depends on the first and the last sighting
    only; without the shared error it has 4 s^2. The map has the error of the first sighting, s^2.
    """
    s = 0.01
    z = np.array([[1.0, 0, 0], [0.9, 0, 0], [0.8, 0, 0]])
    readings = ArucoReadings(np.array([0, 10, 20]), np.full(3, 4), z,
                             np.tile(np.diag([s**2, s**2, 1e-16]), (3, 1, 1)))
    found, naive = localize(readings), localize(readings, shared_errors=False)
    np.testing.assert_allclose(found.poses[:, 0], [0, 0.1, 0.2], atol=1e-12)
    np.testing.assert_allclose(found.covariances[:, 0, 0] / s**2, [0, 2, 2], atol=1e-9)
    np.testing.assert_allclose(naive.covariances[:, 0, 0] / s**2, [0, 2, 4], atol=1e-9)
    np.testing.assert_allclose(found.marker_covariance[0, 0, 0] / s**2, 1, atol=1e-9)


def test_covariances_are_those_of_all_sightings_through_numerical_derivatives():
    """Four frames of a winding path with three markers, and the last two with another one.

    C = sum over the sightings of D C_s D^T: D are derivatives of poses and markers by each
    sighting, whose covariances are not diagonal.
    """
    rng = np.random.default_rng(0)
    poses = np.array([[0, 0, 0], [0.3, 0.1, 0.9], [0.4, 0.5, 2.0], [0.1, 0.6, 3.3]])
    markers = np.array([[2.0, 1.0, 0.5], [-1.0, 2.0, -2.0], [1.0, -1.5, 3.0],
                        [-1.0, -1.0, 1.0]])
    frame = np.repeat(np.arange(4), [3, 3, 4, 4])
    marker = np.r_[np.tile(np.arange(3), 2), np.tile(np.arange(4), 2)]
    root = 0.01 * rng.normal(size=(14, 3, 3))
    readings = ArucoReadings(10 * frame, marker, se2.between(poses[frame], markers[marker]),
                             root @ np.swapaxes(root, 1, 2) + 1e-5 * np.eye(3))
    found = localize(readings)
    expected_poses, expected_map = np.zeros((2, 4, 3, 3))
    for k in range(14):
        def moved(change, k=k):
            z = readings.marker_in_vehicle.copy()
            z[k] += change
            again = localize(replace(readings, marker_in_vehicle=z))
            return np.concatenate([again.poses, again.marker_in_world])
        D = central_differences(moved, np.zeros(3), 1e-5)
        C = D @ readings.covariance[k] @ np.swapaxes(D, 1, 2)
        expected_poses += C[:4]
        expected_map += C[4:]
    scale = np.abs(expected_poses).max()
    np.testing.assert_allclose(found.covariances, expected_poses, atol=1e-5 * scale)
    np.testing.assert_allclose(found.marker_covariance, expected_map, atol=1e-5 * scale)


OPTIONS = [{"mislabelled": 0.03}, {"slip": 3e-3}]


def rms(values):
    return np.sqrt(np.mean(values**2))


def trial(seed, poses, **options):
    """Errors of markers alone and of the fusion on one drive, their NEES, and the slip found."""
    dataset, truth = simulate("short", seed, **options)
    dataset, truth = dataset.first(poses), replace(truth, poses=truth.poses[:poses])
    alone, fused = localize(dataset.aruco), fuse(dataset)
    frame, true = alone.frame, truth.poses[alone.frame]
    found = {"ArUco": (alone.poses, alone.covariances),
             "fused": (fused.poses[frame], fused.covariances[frame])}
    values = {name: nees(*each, true) for name, each in found.items()}
    return {f"{name} ate": ate(each[0], true) for name, each in found.items()} | {
        f"{name} nees": np.nanmean(each) for name, each in values.items()} | {
        f"{name} last nees": each[-1] for name, each in values.items()} | {
        "odometry ate": ate(dead_reckoning(dataset.ticks, dataset.vehicle)[frame], true),
        "map nees": map_nees(alone, truth).mean(), "wheel nees": wheel_nees(fused, truth),
        "slip": fused.slip}


@pytest.mark.slow
@pytest.mark.parametrize("options, poses", [*zip(OPTIONS, (2000, 1000))])
def test_monte_carlo_is_consistent(options, poses):
    """Means over 24 drives lie in the band of the mean of 24 independent NEES.

    A mean over the poses of a drive varies less than a single NEES. Six means under two options
    are in their bands together with 95 % probability if each is with 1 - 0.05 / 12 (Bonferroni).
    The ATE is below 0.6 of that of odometry, and the learned slip is near the truth.
    """
    seeds, methods = range(200, 224), ("odometry", "ArUco", "fused")
    runs = studies.run(trial, seeds, poses=poses, **options)
    low, high = nees_band(len(seeds), probability=1 - 0.05 / 12)
    for name in ("ArUco nees", "ArUco last nees", "map nees", "fused nees", "fused last nees",
                 "wheel nees"):
        assert low < runs[name].mean() < high, name
    squared = {method: runs[f"{method} ate"]**2 for method in methods}
    for method in ("ArUco", "fused"):
        assert np.median(runs[f"{method} ate"] / runs["odometry ate"]) < 0.6
        assert decided(0.6**2 * squared["odometry"] - squared[method])
    assert decided(squared["ArUco"] - squared["fused"])
    assert rms(runs["ArUco ate"]) < 0.1                                         # m, on 20 m
    assert 0.8 < np.exp(np.mean(np.log(runs["slip"]))) / options.get("slip", 1e-3) < 1.25


def seen_in(*frames):
    """Exact ArucoReadings of a straight drive that sees these markers (numbers) in its frames."""
    pose, marker = np.array([(10 * f, m) for f, markers in enumerate(frames) for m in markers]).T
    in_world = np.column_stack([marker, -0.5 * marker, 0.7 * marker])
    vehicle = np.column_stack([0.01 * pose, np.zeros((len(pose), 2))])
    return ArucoReadings(pose, marker, se2.between(vehicle, in_world),
                         np.tile(1e-4 * np.eye(3), (len(pose), 1, 1)))


@pytest.mark.parametrize("frames, known", [
    ([[1, 2], [1, 2], [3], [1]], [True, True, False, False]),
    ([[1, 2], [1, 2], [3], [1], [1]], 2 * [True] + [False] + 2 * [True]),
    ([[1, 2], [2], [3], [1], [1]], 2 * [True] + 3 * [False]),
    ([[1, 2], [2], [3], [1, 2]], 2 * [True] + [False, True]),
    ([[1, 2], [1, 2], [3, 4], [3, 4], [3, 4], [2, 1], [1]], 2 * [True] + 3 * [False] + 2 * [True]),
    ([[9], [1, 2], [1, 2]], [False, True, True])])
def test_frames_are_known_by_two_markers_or_one_that_adjacent_frames_confirm(frames, known):
    """In the frame of the first one that is tied to the next; of others nothing is known.

    A known marker that returns relocalizes only if adjacent frames confirm both sightings.
    """
    found, known = localize(seen_in(*frames)), np.array(known)
    np.testing.assert_array_equal(np.isfinite(found.poses[:, 0]), known)
    np.testing.assert_array_equal(np.isfinite(found.covariances[:, 0, 0]), known)
    np.testing.assert_allclose(
        found.poses[known, 0], 0.1 * (np.flatnonzero(known) - known.argmax()), atol=1e-12)
    assert not found.rejected.any() and (found.unused[0] or frames[0] != [9])


def test_the_map_has_markers_that_are_confirmed_and_seen_from_known_poses():
    """Marker 5 is seen once; 3 and 4 twice, but from poses that nothing connects to the world."""
    readings = seen_in([1, 2], [1, 2, 5], [3, 4], [3, 4], [1, 2])
    found = localize(readings)
    np.testing.assert_array_equal(np.isfinite(found.poses[:, 0]), [True, True, False, False, True])
    np.testing.assert_array_equal(found.marker, [1, 2])
    np.testing.assert_allclose(found.marker_in_world[:, :2], [[1, -0.5], [2, -1]], atol=1e-12)
    np.testing.assert_array_equal(readings.marker[found.unused], [5, 1, 2])
    assert not found.rejected.any()


def test_a_single_frame_and_markers_without_heading():
    dataset, truth = simulate("short", seed=2)
    first = localize(dataset.aruco.select(dataset.aruco.pose == 0))
    np.testing.assert_array_equal(first.poses, [[0, 0, 0]])
    assert len(first.marker) == 0                      # nothing confirms a marker that is seen once
    a, rng = dataset.aruco, np.random.default_rng(0)
    z = a.marker_in_vehicle.copy()
    z[:, 2] = rng.uniform(-np.pi, np.pi, len(z))
    found = localize(replace(as_points(a, slice(None)), marker_in_vehicle=z))
    assert np.isfinite(found.poses).all()
    assert ate(found.poses, truth.poses[found.frame]) < 0.5
