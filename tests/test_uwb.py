"""Problem 4: range factors, kernels, start values and covariances of the antennas."""

import re
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest
from numeric import (
    aligned_ate,
    assert_consistent,
    central_differences,
    known_noise,
    short,
    slam_trial,
    trials,
    true_markers,
    uwb,
    vehicle,
)
from numpy.testing import assert_allclose, assert_array_equal

from slamlib import estimate
from slamlib.core.errors import DatasetError
from slamlib.core.kernels import KERNELS, ONE_SIDED_BIAS
from slamlib.core.odometry import dead_reckoning
from slamlib.core.records import AntennaGuess, Dataset, UwbReadings
from slamlib.core.se2 import compose, sigmas
from slamlib.core.vehicle import Vehicle
from slamlib.robust import factors, initialization, result
from slamlib.robust.calibration import RANGES, SIGHTINGS, stated_calibration
from slamlib.robust.initialization import (
    AntennaRanges,
    second_moment,
    trilaterate,
)
from slamlib.robust.linear import consistency_factor
from slamlib.robust.measurements import Accepted, measure
from slamlib.studies import comparisons
from slamlib.studies.simulation import manoeuvre

# A vehicle of exact odometry, so that only the geometry of the ranges matters.
EXACT = Vehicle(sigma_right_radius=1e-9, sigma_left_radius=1e-9, sigma_wheelbase=1e-9,
                sigma_heading=1e-9, ticks_per_revolution=1e9)


def drive(legs, place, guess):
    """A Dataset with exact odometry and exact ranges to antenna 7, and its path (n, 3).

    `legs` of `manoeuvre`; true and guessed `place` in m; a range of sigma 5 cm every ten rows.
    """
    ticks = np.rint(manoeuvre(legs, EXACT)).astype(int)
    poses = dead_reckoning(ticks, EXACT, model="arc")
    at = np.arange(0, len(poses), 10)
    r = np.hypot(*(poses[at, :2] - place).T)
    ranges = UwbReadings(at, np.full(len(at), 7), r, np.full(len(at), 0.05))
    guesses = AntennaGuess(np.array([7]), np.array([guess]))
    return Dataset("drive", EXACT, ticks, None, ranges, guesses), poses


def located(dataset):
    """The Dataset whose exact ranges are where the one-sided kernel expects them.

    Of noisy ranges it weighs late ones less, so the mean that it finds is less than theirs: the
    ranges that it takes as exact are shorter by 0.0758 sigmas.
    """
    bias = ONE_SIDED_BIAS["asymmetric Tukey"]
    return uwb(dataset, range=dataset.uwb.range + bias * dataset.uwb.sigma)


def range_derivatives(z, pose, place, c, motion, velocity):
    """Errors (50, 1) of ranges, each to an antenna of its own, and their derivatives."""
    return factors.range_error(z[:, 0], pose, motion, velocity, place[:, :2], np.arange(50), c)


def sighting_derivatives(z, pose, place, c, motion, velocity):
    """Errors (50, 3) of sightings, every second one of a point, and their derivatives.

    The later half is by a camera that was moved.
    """
    number = np.arange(50)
    return factors.sighting_error(
        z, pose, motion, velocity, place, c, number % 2 == 0, number >= 25)


@pytest.mark.parametrize("error, kind, size", [
    (range_derivatives, RANGES, 2), (sighting_derivatives, SIGHTINGS, 3)])
def test_derivatives_against_central_differences(error, kind, size):
    """By poses, places and calibration, of sensors that the vehicle has moved since."""
    rng = np.random.default_rng(0)
    pose, place, z, motion, velocity = (
        rng.normal(0, scale, (50, 3)) for scale in (2, 5, 3, 0.3, 0.1))
    place[:, size:] = 0
    place[1::2, 2] = 0                                                  # points have no heading
    c = stated_calibration(Vehicle(), np.arange(50)).stated
    c = c + rng.uniform(0, 0.3, len(c))

    def moved(x):
        there = compose(place, np.pad(x[3:], (0, 3 - size)))
        return error(z, compose(pose, x[:3]), there, c, motion, velocity)[0]

    _, by_pose, by_place, _ = error(z, pose, place, c, motion, velocity)
    numeric = central_differences(moved, np.zeros(3 + size))
    assert_allclose(np.concatenate([by_pose, by_place], axis=2), numeric, atol=1e-7)
    still = partial(error, z, pose, place, motion=motion, velocity=0 * velocity)
    numeric = central_differences(lambda c: still(c)[0], c)   # a delay moves nothing that stands
    assert_allclose(still(c)[3], numeric[..., kind], atol=1e-7)


def test_antenna_from_known_poses_by_hand():
    """The information is the sum of u u^T / sigma^2 over unit directions u, plus the guess's."""
    place = np.array([2.0, 5.0])
    dataset, poses = drive([(4.0, 2.0), (3.0, -1.0)], place, (2.5, 4.0))
    found = estimate(known_noise(located(dataset), 1e-5), model="arc")
    u = (place - poses[dataset.uwb.pose, :2]) / dataset.uwb.range[:, None]
    expected = np.linalg.inv(u.T @ u / 0.05**2 + np.eye(2) / 5.0**2)
    assert_allclose(found.antenna_in_world[0], place, atol=2e-5)  # biased by the guess
    assert_allclose(found.antenna_covariance[0], expected, rtol=1e-2,
                               atol=1e-2 * expected.max())
    assert not found.doubts and (found.range_weight > 0.999).all()


@pytest.mark.parametrize("without, tolerance", [("uwb", 1e-9), ("", 1e-8), ("aruco", 1e-7)])
def test_perfect_data_gives_the_exact_answer(without, tolerance):
    """As exactly as steps end at an error that is not zero: that of a biased kernel is not."""
    dataset, truth = short(1, noise=False)
    dataset = located(dataset)
    if without:
        dataset = dataset.without(without)
    found = estimate(known_noise(dataset, 1e-3), model="arc")
    for values, expected in (
            (found.poses, truth.poses), (found.wheel, [0.1, 0.1, 0.4]),
            (found.marker_in_world, true_markers(truth, found.marker)),
            (found.antenna_in_world, truth.antenna_in_world[:len(found.antenna)])):
        assert_allclose(values, expected, atol=tolerance)
    assert not found.rejected.any()


@pytest.fixture(scope="module")
def late():
    """800 poses of a drive with late ranges, by how many sigmas each is late, and problem 4."""
    dataset, _ = short(9, 800, late_ranges=0.15)
    off = dataset.uwb.range - short(9, 800)[0].uwb.range
    return dataset, off / dataset.uwb.sigma, estimate(dataset)


def test_problem_4_from_problem_3_is_that_from_odometry(late):
    dataset, _, alone = late
    after = estimate(dataset, previous=estimate(dataset.without("uwb")))
    off = np.abs(after.poses - alone.poses)
    assert (off < 0.05 * sigmas(alone.covariances) + 1e-6).all()
    assert_allclose(after.antenna_in_world, alone.antenna_in_world, atol=1e-3)


def test_late_ranges_only_are_down_weighted_and_counted(late):
    _, off, found = late
    assert (found.range_weight[off > 8] < 0.1).all() and (off > 8).sum() > 8
    assert np.mean(found.range_weight[off == 0] > 0.5) > 0.98
    assert 0.08 < np.mean(found.range_weight < 0.5) < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("first, options, names", [
    (700, {"late_ranges": 0.15}, ["nees", "nees between", "map nees"]),
    (800, {"late_ranges": 0.15, "markers": False}, ["nees", "last nees"])])
def test_monte_carlo_is_consistent(first, options, names):
    """12 drives: NEES of poses, interpolated poses, map, antennas and wheels in their bands.

    Jointly with probability 95 % (Bonferroni). Ranges alone hardly determine the slip.
    """
    runs = trials(slam_trial, range(first, first + 12), **options)
    probability = 1 - 0.05 / (len(names) + 2)
    for name in [*names, "wheel nees"]:
        assert_consistent(runs[name], 3, probability)
    assert_consistent(runs["antenna nees"], 2, probability)
    assert np.sqrt(np.mean(runs["ate"]**2)) < 0.06
    if "map nees" in names:
        assert runs["ate"].max() < 0.05 and runs["antenna error"].max() < 0.15
        assert runs["doubts"].sum() == 0


def test_an_antenna_without_a_guess_is_told():
    dataset, _ = short(1, 400)
    guess = dataset.antenna_guess
    fewer = replace(guess, antenna=guess.antenna[1:], position=guess.position[1:])
    with pytest.raises(DatasetError, match=rf"a guess of each antenna.*\[{guess.antenna[0]}\]"):
        estimate(replace(dataset, antenna_guess=fewer))


@pytest.mark.slow
@pytest.mark.parametrize("first, right, options", [
    (0, 0.95, dict(error=10.0, poses=1000)),
    (3000, 0, dict(late_ranges=0.15, error=2.0, poses=400, markers=False)),
    (3000, 0, dict(late_ranges=0.3, error=5.0, poses=800))])
def test_every_wrong_antenna_is_in_doubt_or_inside_its_ellipse(first, right, options):
    """Bad guesses, late ranges and short drives; the ellipse is that of 99.9 %."""
    runs = trials(comparisons.guesses, range(first, first + 8), **options)
    assert runs["silently wrong"].sum() == 0 and runs["right"].mean() >= right


@pytest.mark.parametrize("turn", [0.0, 1.0])
@pytest.mark.parametrize("side", [1, -1])
def test_a_mirrored_place_is_corrected_on_a_curved_path_and_told_on_a_straight_one(turn, side):
    place = np.array([3.0, 4.0])
    dataset, _ = drive([(3.0, 0.0), (2.0, turn), (3.0, 0.0)], place, (2.5, 3.0 * side))
    found = estimate(known_noise(located(dataset), 1e-5), model="arc")
    if turn:
        assert_allclose(found.antenna_in_world[0], place, atol=1e-2)
        assert not found.doubts
    else:
        assert_allclose(found.antenna_in_world[0], place * [1, side], atol=1e-2)
        assert "as well at" in found.doubts[7] and f"{-side * 4.0:.1f}" in found.doubts[7]
        assert found.antenna_covariance[0, 1, 1] > 4**2


def test_ranges_in_the_plane_by_hand():
    """Slant ranges of 2.5 m, 1.02 times and 0.1 m too long, to antennas 2 m higher: 1.5 m.

    An error in the slant range is 2.5 / 1.5 times as large in the plane; poses add theirs.
    """
    dataset, _ = drive([(4.0, 2.0)], np.array([2.0, 5.0]), (2.5, 4.0))
    stated = vehicle(antenna_height=2.0, range_offset=0.1, range_scale=1.02)
    m = measure(stated(uwb(dataset, range=np.full(len(dataset.uwb.pose), 1.02 * 2.5 + 0.1))))
    poses, C = np.zeros((len(m.frame), 3)), np.diag([0.09, 0.03, 0.5])
    found, = initialization.ranges_by_antenna(
        m, poses, np.tile(C, (len(poses), 1, 1)), m.calibration.stated, 3.0)
    assert_allclose(found.distance, 1.5)
    assert_allclose(found.sigma, np.hypot(3 * 0.05 / 1.02 * 2.5 / 1.5, np.sqrt(0.06)))
    assert_array_equal(found.guess, [2.5, 4.0])


def exact_ranges(path, sigma):
    """AntennaRanges from a path (n, 2) to (3, 4)."""
    return AntennaRanges(path, np.hypot(*(path - [3.0, 4.0]).T), np.full(len(path), sigma),
                         np.array([3.2, 4.2]))


def test_second_moment_is_that_of_a_mixture_of_both_mirror_images():
    """Of which the other one, 8 m away, is a third as likely."""
    places = np.array([[3.0, 4.0], [3.0, -4.0]])
    C = np.diag([0.01, 0.04])
    found = second_moment(places, np.log([1, 12]), np.stack([C, 4 * C]), places[0])
    assert_allclose(found, 1.75 * C + np.diag([0, 64 / 4]))


@pytest.mark.parametrize("agree, weight, radius, sigma, said", [
    (40, 1.0, 2.0, 0.05, "None"), (21, 0.4, 2.0, 0.05, "None"),
    (19, 0.4, 2.0, 0.05, "21 of its 40 ranges disagree"),
    (4, 0.4, 2.0, 0.05, "only 4 of its 40 ranges agree"),
    (5, 0.0, 2.0, 0.05, "35 of its 40 ranges disagree"),
    (40, 1.0, 2.0, 1.0, "too few or come from too few"),       # above 2.5 % of 5 m
    (40, 1.0, 0.3, 0.05, "too few or come from too few")])
def test_an_antenna_is_doubted_if_most_ranges_disagree_or_do_not_determine_it(
        agree, weight, radius, sigma, said):
    """Ranges from a circle around the origin."""
    angle = np.linspace(0, 5, 40)
    ranges = exact_ranges(radius * np.column_stack([np.cos(angle), np.sin(angle)]), sigma)
    places, costs, _ = trilaterate(ranges)
    weights = np.where(np.arange(40) < agree, 1.0, weight)
    assert said in str(result._doubt(ranges, np.array([3.0, 4.0]), weights, places, costs))


def test_two_antennas_with_one_id_are_told():
    """Half of the ranges of the first antenna are to the second; the solution takes one of both.

    Problem 4 is as accurate as ever, so nothing else tells of it.
    """
    dataset, truth = short(0)
    first, second = dataset.antenna_guess.antenna[:2].tolist()
    antenna = np.where(dataset.uwb.antenna == second, first, dataset.uwb.antenna)
    found = estimate(uwb(dataset, antenna=antenna))
    assert aligned_ate(found, truth) < 0.005
    assert [*found.doubts] == [first] and "as if two antennas had this id" in found.doubts[first]
    other = re.search(r"\((.+), (.+)\)", found.doubts[first]).groups()
    places = np.array([found.antenna_in_world[0], other], float)
    assert_allclose(np.sort(places, 0), np.sort(truth.antenna_in_world[:2], 0), atol=0.1)


def test_an_antenna_behind_a_wall_is_not_two_with_one_id():
    dataset, _ = short(1)
    behind = dataset.uwb.antenna == dataset.antenna_guess.antenna[0]
    found = estimate(uwb(dataset, range=dataset.uwb.range + 0.5 * behind))
    assert "fit another place" not in str(found.doubts)


R = np.linspace(-8, 8, 4001)


def weighted_mean(values, kernel, r):
    """Mean of values at standard normal R, by the weights of a kernel for errors r."""
    weight = np.exp(-R**2 / 2) * [kernel.weight(each) for each in r]
    return np.average(values, weights=weight)


@pytest.mark.parametrize("kernel", [
    KERNELS["asymmetric Tukey"], gtsam.noiseModel.mEstimator.Cauchy.Create(3.0)])
def test_a_kernel_takes_a_known_part_of_the_variance(kernel):
    """The mean of r^2 by the weights; without a kernel it is 1."""
    assert consistency_factor(None) == 1 > 0.98 > consistency_factor(kernel)
    assert np.isclose(consistency_factor(kernel), weighted_mean(R**2, kernel, R), rtol=1e-4)


def test_a_range_loses_weight_from_the_bias_of_the_kernel_on():
    """Two sigmas beyond it Tukey's kernel leaves (1 - (2 / 4.685)^2)^2."""
    b = ONE_SIDED_BIAS["asymmetric Tukey"]
    accepted = Accepted(np.ones(2), np.ones(2), KERNELS["asymmetric Tukey"], b)
    assert_allclose(accepted.kept(np.array([b - 3, b + 2])), [1, (1 - (2 / 4.685)**2)**2])


@pytest.mark.parametrize("name", ONE_SIDED_BIAS)
def test_ranges_without_late_ones_have_no_bias(name):
    """The mean of r - b is zero where the bias b is counted."""
    off = R - ONE_SIDED_BIAS[name]
    assert abs(weighted_mean(off, KERNELS[name], off)) < 1e-4
    assert abs(weighted_mean(R, KERNELS[name], R)) > 0.05
