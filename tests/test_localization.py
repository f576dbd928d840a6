"""Problem 2: localization by markers alone, and two fusions with odometry."""

from dataclasses import replace

import numpy as np
import pytest
from numeric import (
    aruco,
    assert_consistent,
    central_differences,
    decided,
    map_nees,
    mean_nees,
    only,
    seen_from,
    short,
    sightings,
    standing,
    trials,
    true_markers,
    vehicle,
    wheel_nees,
)
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import block_diag

from slamlib import fuse, fuse_increments, localize
from slamlib.core import increments, odometry, se2
from slamlib.core.errors import DatasetError
from slamlib.core.evaluation import anees, ate, nees
from slamlib.core.increments import TYPICAL_SLIP
from slamlib.core.odometry import dead_reckoning
from slamlib.solve import problem_solution
from slamlib.studies import montecarlo
from slamlib.studies.simulation import TABLE_2


def test_sightings_that_are_late_as_stated_are_at_the_poses_of_their_time():
    clean, _ = short(3, 600)
    clean = replace(clean, aruco=clean.aruco.select(clean.aruco.pose < 590))
    late = aruco(vehicle(sighting_lag=4.0)(clean), pose=clean.aruco.pose + 4)
    assert_allclose(fuse(late).poses, fuse(clean).poses, atol=1e-9)
    assert_array_equal(localize(late.sightings).frame, localize(clean.sightings).frame)


def test_a_delay_that_nobody_stated_costs_the_fusion_nothing():
    clean, truth = short(3)
    clean = replace(clean, aruco=clean.aruco.select(clean.aruco.pose < 1990))
    late = aruco(clean, pose=clean.aruco.pose + 5)
    assert_allclose(fuse(late).poses, fuse(clean).poses, atol=1e-9)
    assert ate(fuse(late).poses, truth.poses, aligned=True) < 0.02


@pytest.mark.parametrize("slip", [-1.0, 1.0, float("nan"), "a"])
def test_a_slip_that_cannot_be_is_refused(slip):
    with pytest.raises(DatasetError, match="fuse: expected a number from 0 to 0.1 .* for slip"):
        fuse(short(1, 100)[0], slip)


def test_perfect_data_give_the_exact_poses_map_and_wheels():
    dataset, truth = short(1, 1000, noise=False)
    for each in (fuse(dataset, slip=1e-3), fuse(dataset)):
        assert_allclose(each.poses, truth.poses, atol=1e-9)
        assert_allclose(each.wheel, [0.1, 0.1, 0.4], atol=1e-9)
    found = localize(dataset.aruco)
    error = se2.difference(found.poses, truth.poses[found.frame])
    assert_allclose(error, 0, atol=1e-9)
    assert_allclose(
        found.marker_in_world, true_markers(truth, found.marker), atol=1e-9)


def test_two_increments_by_hand():
    """One marker 1 m ahead, three poses on a line, headings known.

    With C = s^2 I for the position and almost no heading error, the increment between two poses has
    the variance 2 s^2. So has the third pose, because it depends on the first and the last sighting
    only; without the shared error it has 4 s^2. The map has the error of the first sighting, s^2.
    """
    s = 0.01
    readings = sightings([0, 10, 20], [4, 4, 4], [[1.0, 0, 0], [0.9, 0, 0], [0.8, 0, 0]],
                         np.diag([s**2, s**2, 1e-16]))
    found = localize(readings)
    naive = localize(readings, shared_errors=False)
    assert_allclose(found.poses[:, 0], [0, 0.1, 0.2], atol=1e-12)
    assert_allclose(found.covariances[:, 0, 0] / s**2, [0, 2, 2], atol=1e-9)
    assert_allclose(naive.covariances[:, 0, 0] / s**2, [0, 2, 4], atol=1e-9)
    assert_allclose(found.marker_covariance[0, 0, 0] / s**2, 1, atol=1e-9)


def test_covariances_are_those_of_all_sightings_through_numerical_derivatives():
    """C = D C_s D^T: D are derivatives of poses and markers by all sightings."""
    readings = short(3, 41, noise=False)[0].aruco

    def places(z):
        found = localize(replace(readings, marker_in_vehicle=z.reshape(-1, 3)))
        return np.concatenate([found.poses, found.marker_in_world])

    D = central_differences(places, readings.marker_in_vehicle.ravel(), 1e-5)
    expected = D @ block_diag(*readings.covariance) @ D.mT
    found = localize(readings)
    covariances = np.concatenate([found.covariances, found.marker_covariance])
    assert_allclose(covariances, expected, atol=1e-5 * expected.max())
    assert len(found.poses) == 5 and len(found.marker) > 3


def trial(seed, **options):
    """Errors of markers alone and of the fusion on one drive, their NEES, and the slip found."""
    dataset, truth = short(seed, **options)
    alone = localize(dataset.aruco)
    fused = fuse(dataset)
    frame = alone.frame
    true = truth.poses[frame]
    by_odometry = dead_reckoning(dataset.ticks, dataset.vehicle)[frame]
    numbers = {"odometry ate": ate(by_odometry, true), "map nees": map_nees(alone, truth).mean(),
               "wheel nees": wheel_nees(fused, truth), "slip": fused.slip}
    for name, poses, C in (("ArUco", alone.poses, alone.covariances),
                           ("fused", fused.poses[frame], fused.covariances[frame])):
        numbers |= montecarlo.judged(name, poses, C, true)
        numbers[f"{name} last nees"] = nees(poses, C, true)[-1]
    return numbers


@pytest.mark.slow
def test_monte_carlo_is_consistent():
    """Means over 24 drives with wrong labels lie in the band of the mean of 24 independent NEES.

    A mean over the poses of a drive varies less than a single NEES. Six means are in their bands
    together with 95 % probability if each is with 1 - 0.05 / 6 (Bonferroni). The ATE is below 0.6
    of that of odometry, and the learned slip is near the truth. Images are twice as far apart as
    usual.
    """
    runs = trials(trial, range(200, 224), mislabelled=0.03, step=2)
    for name in ("ArUco nees", "ArUco last nees", "map nees", "fused nees", "fused last nees",
                 "wheel nees"):
        assert_consistent(runs[name], probability=1 - 0.05 / 6)
    for method in ("ArUco", "fused"):
        assert np.median(runs[f"{method} ate"] / runs["odometry ate"]) < 0.6
        assert decided(0.6**2 * runs["odometry ate"]**2 - runs[f"{method} ate"]**2)
    assert decided(runs["ArUco ate"]**2 - runs["fused ate"]**2)
    assert np.sqrt(np.mean(runs["ArUco ate"]**2)) < 0.1                         # m, on 20 m
    assert 0.8 < np.exp(np.mean(np.log(runs["slip"]))) / 1e-3 < 1.25


def seen_in(frames):
    """Exact ArucoReadings of a straight drive that sees these markers (digits) in its frames."""
    pose, marker = np.array([(10 * f, int(digit)) for f, digits in enumerate(frames.split())
                             for digit in digits]).T
    in_world = np.column_stack([marker, -0.5 * marker, 0.7 * marker])
    vehicle = np.outer(0.01 * pose, [1, 0, 0])
    return sightings(pose, marker, se2.between(vehicle, in_world), 1e-4 * np.eye(3))


@pytest.mark.parametrize("frames, known", [                # markers seen in each frame
    ("12 12 3 1", [0, 1]), ("12 12 3 1 1", [0, 1, 3, 4]), ("12", [0]), ("12 2 3 12", [0, 1, 3]),
    ("12 12 34 34 34 21 1", [0, 1, 5, 6]),
    ("12 1234 34 12", [0, 1, 2, 3]), ("9 12 12", [1, 2])])
def test_frames_are_known_by_two_markers_or_one_that_adjacent_frames_confirm(frames, known):
    """In the frame of the first one that is tied to the next; of others nothing is known.

    A known marker that returns relocalizes only if adjacent frames confirm both sightings.
    """
    found = localize(seen_in(frames))
    assert_array_equal(np.flatnonzero(np.isfinite(found.poses[:, 0])), known)
    assert_array_equal(np.flatnonzero(np.isfinite(found.covariances[:, 0, 0])), known)
    assert_allclose(found.poses[known, 0], 0.1 * (np.array(known) - known[0]), atol=1e-12)
    assert not found.rejected.any() and (found.unused[0] or known[0] == 0)
    assert len(found.marker) > 0 or len(known) == 1          # nothing confirms what is seen once


def test_the_map_has_markers_that_are_confirmed_and_seen_from_known_poses():
    """Marker 5 is seen once; 3 and 4 twice, but from poses that nothing connects to the world."""
    readings = seen_in("12 125 34 34 12")
    found = localize(readings)
    assert_array_equal(np.isfinite(found.poses[:, 0]), [True, True, False, False, True])
    assert_array_equal(found.marker, [1, 2])
    assert_allclose(found.marker_in_world[:, :2], [[1, -0.5], [2, -1]], atol=1e-12)
    assert_array_equal(readings.marker[found.unused], [5, 1, 2])
    assert not found.rejected.any()


@pytest.mark.parametrize("function", [fuse, fuse_increments, localize])
def test_what_is_of_another_type_is_told(function):
    """`estimate`'s arguments are in test_slam."""
    with pytest.raises(DatasetError, match=f"{function.__name__}: expected a.*, found 'drive'"):
        function("drive")


# Fused with odometry.


@pytest.mark.parametrize("slip", [None, 2e-3])
def test_a_dataset_without_markers_is_fused_to_odometry(slip):
    """Arcs from the first frame on, and the first-order propagation with the noise of slip."""
    dataset = short(5)[0].without("aruco")
    ticks, vehicle = dataset.ticks, dataset.vehicle
    poses, covariances = odometry.first_order(ticks, vehicle, model="arc")
    fused = fuse(dataset, slip)
    pose = np.arange(len(ticks))
    assert_allclose(fused.poses, poses, atol=1e-9)
    rounding, slipping = increments.noise_in_drive(ticks, vehicle, 0 * pose, pose)
    expected = covariances + rounding + fused.slip**2 * slipping
    assert_allclose(fused.covariances, expected, atol=1e-12)
    assert fused.rejected == 0 and 1e-3 <= fused.slip < 2.1e-3
    assert_array_equal(fused.wheel, vehicle.wheel)
    assert_allclose(fused.wheel_covariance, np.diag(vehicle.sigma_wheel**2))


@pytest.mark.slow
def test_slip_is_learned_although_the_encoder_is_coarse():
    """500 counts a revolution, a frame every 10 cm: rounding is as large as slip between frames.

    Rounding as a random walk would explain the slip: a quarter of it would be learned.
    """
    coarse = replace(TABLE_2, ticks_per_revolution=500)
    slips = [fuse(short(seed, slip=1e-3, vehicle=coarse)[0]).slip for seed in range(2)]
    assert 0.7e-3 < np.exp(np.mean(np.log(slips))) < 1.5e-3


def test_sightings_that_are_not_used_are_counted():
    """Five sightings moved by a metre, one that repeats another, two of a marker that contradict.

    The hint uses no sighting of a marker that no adjacent frame sees, on the clean drive either.
    """
    dataset, _ = short(1, 1000, noise=False)
    a = dataset.aruco
    seen_before = [np.flatnonzero((a.pose == pose) & np.isin(
        a.marker, a.marker[a.pose == pose - 10]))[0] for pose in range(200, 900, 100)]
    *moved, again, other = seen_before
    spoilt = a.select(np.sort(np.r_[:len(a.pose), again, other]))
    spoilt.marker_in_vehicle[[*moved, other + 1], 0] += 1.0            # `again` comes before
    spoilt = replace(dataset, aruco=spoilt)
    assert fuse(dataset, slip=1e-3).rejected == 0
    assert fuse(spoilt, slip=1e-3).rejected == 8
    assert fuse_increments(spoilt).rejected == fuse_increments(dataset).rejected + 8


@pytest.mark.parametrize("slip, sigma, most", [
    (4e-4, 1e-4, 16), (5e-3, 1e-4, 16), (1e-3, 0.01, 6)])
def test_slip_and_wheels_are_not_learned_from_counts_that_creep_at_a_stand(slip, sigma, most):
    """Wheels known well, or to a tenth; 500 frames that would say that they do not turn."""
    dataset, truth = short(3, 1000, slip=slip)
    stands, poses = standing(dataset, truth, rows=500, count=2)
    fused = fuse(vehicle(sigma_right_radius=sigma, sigma_left_radius=sigma)(stands))
    assert 0.7 < fused.slip / slip < 1.5
    assert_allclose(fused.wheel[:2], truth.vehicle.wheel[:2], rtol=0.01)
    assert ate(fused.poses[500:], poses[500:]) < 0.1
    assert anees(fused.poses[500:], fused.covariances[500:], poses[500:]) < most


def test_beside_slow_errors_the_fusion_believes_no_slip_below_the_typical_one():
    white, slow = [fuse(short(3, 1000, memory=rho, slip=1e-4)[0]).slip for rho in (0.0, 0.9)]
    assert white < TYPICAL_SLIP == slow


@pytest.mark.parametrize("memory, missed, most", [
    (0.0, 0, 0.0154), (0.9, 0, 0.0162), (0.9, 0.4, 0.0116)])
def test_slow_errors_of_the_sightings_are_counted_once(memory, missed, most):
    """Errors of successive sightings of a marker are alike, also if some between are missed."""
    found = []
    for seed in range(4):
        dataset, truth = short(seed, 1000, memory=memory)
        draws = np.random.default_rng(seed).random(len(dataset.aruco.pose))
        fused = fuse(only(dataset, draws > missed))
        assert fused.memory == memory
        found.append((ate(fused.poses, truth.poses), mean_nees(fused, truth)))
    off, ratio = np.mean(found, axis=0)
    assert off < most and 1.5 < ratio < 5


def test_a_camera_that_is_turned_is_found_where_stretches_do_not_show_it():
    """The first 20 images of each tenth of the drive are so blurred that they tell nothing."""
    dataset = short(4, path="long")[0]
    frame, number = np.unique(dataset.aruco.pose, return_inverse=True)
    blurred = number % (len(frame) // 10) < 20
    factor = np.where(blurred, 1e4, 1.0)[:, None, None]
    turned = seen_from(dataset, camera=(0.0, 0.0, 0.05))
    fused = fuse(aruco(turned, covariance=factor * turned.aruco.covariance))
    assert_allclose(fused.camera[2], 0.05, atol=0.01)


def test_a_camera_that_is_turned_is_found():
    """By 0.08 rad, as vehicle.toml does not state it; nothing is found where it is as stated."""
    dataset, truth = short(3, 1000)
    fused = fuse(seen_from(dataset, (0.0, 0.0, 0.08)))
    assert_allclose(fused.camera[2], 0.08, atol=0.005)
    assert mean_nees(fused, truth) < 6
    assert_array_equal(fuse(dataset).camera, [0, 0, 0])


@pytest.mark.parametrize("propagation", [odometry.equation2, odometry.first_order])
def test_the_hint_fuses_by_information(propagation):
    """One interval: C = (C_o^-1 + C_m^-1)^-1 and Delta = C (C_o^-1 Delta_o + C_m^-1 Delta_m)."""
    dataset = vehicle(sigma_heading=1e-9)(short(6)[0])
    dataset = only(dataset, dataset.aruco.pose <= 10)
    sure = dataset.vehicle
    fused = fuse_increments(dataset, propagation)
    marker = localize(dataset.aruco)
    poses, covariances = propagation(dataset.ticks[:11], sure, initial_covariance=np.zeros((3, 3)))
    information = [np.linalg.inv(covariances[-1]), np.linalg.inv(marker.covariances[1])]
    C = np.linalg.inv(sum(information))
    delta = C @ (information[0] @ poses[-1] + information[1] @ marker.poses[1])
    assert_allclose(fused.poses[10], delta, atol=1e-9)
    assert_allclose(fused.covariances[10], C, atol=1e-6 * np.abs(C).max())
    assert fused.covariances[0, 2, 2] == 1e-9**2
    # From there on odometry goes on alone, restarted.
    expected = propagation(dataset.ticks[10:], sure, fused.poses[10], fused.covariances[10])
    assert_allclose(fused.poses[10:], expected[0], atol=1e-12)
    assert_allclose(fused.covariances[10:], expected[1], atol=1e-15)


@pytest.mark.parametrize("keep", [
    lambda a: a.pose % 200 == 0, lambda a: np.arange(len(a.pose)) == 0])
def test_without_information_on_the_slip_the_prior_decides(keep):
    """Few frames or a single sighting: NEES of the last heading over 20 drives is in its band.

    The heading only: the distribution of position and heading is not Gaussian (notebook 1).
    """
    last = []
    for seed in range(20):
        dataset, truth = short(seed)
        fused = fuse(only(dataset, keep(dataset.aruco)))
        assert 1e-4 < fused.slip < 1e-2
        last.append((fused.poses[-1, 2] - truth.poses[-1, 2])**2 / fused.covariances[-1, 2, 2])
    assert_consistent(last, dof=1, probability=0.999)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_wheels_far_from_nominal_are_learned(seed):
    """Radii wrong by 3 % with a sigma of 5 %: increments are linearised again at the estimate."""
    dataset, truth = short(seed)
    fused = fuse(vehicle(right_radius=0.103, left_radius=0.097, sigma_right_radius=5e-3,
                         sigma_left_radius=5e-3)(dataset))
    assert abs(fused.wheel[0] - truth.vehicle.right_radius) < 5e-4
    assert ate(fused.poses, truth.poses) < 0.08
    assert mean_nees(fused, truth) < 6


def test_a_learned_slip_that_no_wheel_has_is_doubted():
    """4 cm after one metre; not a usual one, nor one that the vehicle states."""
    far = short(5, 800, slip=0.04)[0]
    doubt, = problem_solution("problem2_fused", far, fuse(far)).doubts
    assert doubt.what == "wheel-slip" and "problem 2's fusion" in doubt.sentence
    for dataset in (vehicle(slip=0.04)(far), short(5, 800)[0]):
        assert not problem_solution("problem2_fused", dataset, fuse(dataset)).doubts


def test_the_slip_and_the_factor_that_a_vehicle_gives_are_taken():
    """The slip as by the option; twice the sigmas at a factor of one half change nothing."""
    dataset, _ = short(5, 600)
    plain, option = fuse(dataset), fuse(dataset, slip=3e-3)
    known = vehicle(slip=3e-3)(dataset)
    assert_array_equal(fuse(known).poses, option.poses)
    assert option.slip == 3e-3 and fuse(known, slip=1e-3).slip == 1e-3
    doubled = aruco(dataset, covariance=4 * dataset.aruco.covariance)
    halved = fuse(vehicle(marker_noise_factor=0.5)(doubled))
    assert_allclose(halved.poses, plain.poses, rtol=0, atol=1e-12)
    for other in (option, fuse(doubled)):
        assert np.abs(other.poses - plain.poses).max() > 1e-6
