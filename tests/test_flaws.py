"""Drives that are not as their files say: the estimate holds, or a doubt names what is wrong."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numeric import aruco, assert_consistent, short, uwb, vehicle

from slamlib import estimate, solve
from slamlib.core.se2 import sigmas
from slamlib.robust.calibration import CAMERA, SIGHTING_LAG
from slamlib.robust.file_doubts import doubts_before_solving
from slamlib.robust.measurements import Noise
from slamlib.robust.solution_doubts import (
    GROUPS,
    _rejection_doubts,
    contradiction_doubts,
    solution_doubts,
)


def sightings_of(variances, covariance=0.0):
    """A change of all sightings: variances of x, y and heading, and covariance of the last two."""
    C = np.diag(variances)
    C[1, 2] = C[2, 1] = covariance
    return lambda d: aruco(d, covariance=np.broadcast_to(C, d.aruco.covariance.shape))


def one_sighting(*variances):
    """A change of one sighting in the middle of a drive."""
    def change(d):
        covariance = d.aruco.covariance.copy()
        covariance[len(covariance) // 2] = np.diag(variances)
        return aruco(d, covariance=covariance)
    return change


def range_sigmas(sigma, rows=slice(None)):
    def change(d):
        sigmas = d.uwb.sigma.copy()
        sigmas[rows] = sigma
        return uwb(d, sigma=sigmas)
    return change


LEGAL = {                                      # within the limits, and far from what is usual
    "an unknown heading of pose 1": vehicle(sigma_heading=10.0),
    "very certain wheels": vehicle(
        sigma_right_radius=1e-9, sigma_left_radius=1e-9, sigma_wheelbase=1e-9),
    "unknown wheels": vehicle(sigma_right_radius=0.1, sigma_left_radius=0.1, sigma_wheelbase=0.4),
    "the most certain range": range_sigmas(1e-9, rows=30),
    "the most uncertain ranges": range_sigmas(1e4),
    "the most certain sighting": one_sighting(1e-18, 1e-18, 1e-18),
    "the most uncertain sightings": sightings_of([1e8, 1e8, 1e14]),
    "a sighting of a direction": one_sighting(1e-18, 1e8, 1e-18),
    "sightings of a distance": sightings_of([1e8, 1e-18, 1e14]),
    "correlations of almost 1": sightings_of([1e-4, 1e-4, 1e-4], 1e-4 - 1e-15)}


@pytest.mark.slow
def test_offsets_of_the_camera_have_the_standard_deviations_that_they_state():
    """Eight clean drives of two slips, with a camera and a delay that are hardly known."""
    time, place = [], []
    for seed in range(8):
        dataset, _ = short(seed, slip=1e-3 + 2e-3 * (seed % 2))
        found = estimate(vehicle(
            sigma_sighting_lag=10.0, sigma_camera_x=0.2, sigma_camera_y=0.2,
            sigma_camera_turn=0.2)(dataset.without("uwb")))
        time.append(found.c[SIGHTING_LAG]**2 / found.c_covariance[SIGHTING_LAG, SIGHTING_LAG])
        off = found.c[CAMERA]
        place.append(off @ np.linalg.solve(found.c_covariance[CAMERA, CAMERA], off))
    for squared, dof in ((time, 1), (place, 3)):
        assert_consistent(squared, dof, probability=0.99)


@pytest.mark.slow
@pytest.mark.parametrize("case", LEGAL)
def test_every_problem_is_solved_within_the_limits(case):
    """Finite covariances, not negative; SLAM's errors as they state, or its rejections are told."""
    dataset, truth = short(1, 300)
    dataset = LEGAL[case](dataset)
    doubts_before_solving(dataset)                         # without a warning
    for found in solve.solutions(dataset):
        assert isinstance(found, solve.Solution), found.reason
        known = np.isfinite(found.poses[:, 0])
        sigma = sigmas(found.covariances[known])                # NaN of negative variances
        assert known.any() and (sigma >= 0).all()
        if found.problem in ("problem3", "problem4"):
            errors = np.abs(found.poses - truth.poses)
            assert (errors < 5 * sigma + 0.02).all() or "sightings-rejected" in [
                doubt.what for doubt in found.doubts]


@pytest.fixture(scope="module")
def found():
    """SlamResult of a small clean drive, of which nothing is doubted but its few ranges."""
    found = estimate(short(61, 100)[0])
    return replace(found, doubts={})


@pytest.mark.parametrize("field, change", [
    ("covariances", np.nan), ("c_covariance", -1.0), ("marker_covariance", np.inf)])
def test_a_solution_that_rounding_spoilt_is_none(found, monkeypatch, field, change):
    spoilt = replace(found, **{field: change * getattr(found, field)})
    monkeypatch.setattr(solve, "estimate", lambda _: spoilt)
    dataset = found.fit.problem.measurements.dataset
    failure, = solve.solutions(dataset, problems=("problem3",))
    assert "float64" in failure.reason and "a variance is negative" in failure.reason


def with_noise(found, noise, sigma):
    """The SlamResult with other noise (3,) and standard deviations of its logarithms."""
    problem = replace(found.fit.problem, noise=Noise(*noise))
    return replace(found, fit=replace(found.fit, problem=problem),
                   noise_sigma=np.broadcast_to(sigma, 3))


def explained(found, *explanations, released=None, by=None, off=0.01):
    """The SlamResult with explanations (sets of groups), and an entry that is off its value.

    All their groups are released, or those given.
    """
    c = found.calibration.stated + off * np.isin(found.calibration.names, [by])
    prior = found.calibration.prior(released or {group for some in explanations for group in some})
    fit = replace(found.fit, explanations=tuple(map(frozenset, explanations)),
                  problem=replace(found.fit.problem, prior=prior))
    return replace(found, fit=fit, c=c, c_covariance=1e-6 * np.eye(len(c)))


def test_nothing_is_said_of_what_agrees(found):
    assert solution_doubts(found) == ()


def test_an_antenna_in_doubt_is_named_with_the_reason(found):
    doubt, = solution_doubts(replace(found, doubts={5: "only 3 of its 9 ranges agree"}))
    assert doubt.what == "antenna" and "Antenna 5 is in doubt: only 3" in doubt.sentence


@pytest.mark.parametrize("group", GROUPS)
def test_every_group_is_named_with_its_entries_and_no_others(found, group):
    doubt, = solution_doubts(explained(found, [group]))
    assert doubt.what == group and doubt.advice == GROUPS[group][1]
    assert "problem 4 uses this" in doubt.sentence and "cannot tell" not in doubt.sentence
    for name, is_named in zip(found.calibration.names, found.calibration.of_group(group)):
        assert (f"{name} = " in doubt.sentence) == is_named


def test_numbers_are_given_with_standard_deviations_and_units(found):
    doubt, = solution_doubts(explained(found, ["camera-offset"], by="camera_x", off=0.02))
    assert "By the drive camera_x = 0.0200 ± 0.0010 m (stated: 0); problem 4" in doubt.sentence


def test_explanations_that_exclude_each_other_are_all_named(found):
    """In the sentence of the one that is furthest off; what they have in common has its own."""
    wheels, size, tag = "wheel-scale", "marker-size", "tag-offset"
    of_size, of_tag = solution_doubts(
        explained(found, [wheels, tag], [size, tag], by="marker_size"))
    assert (of_size.what, of_tag.what) == (size, tag)
    assert "It may instead be one factor on both wheels: the drive cannot tell" in of_size.sentence
    assert "instead" not in of_tag.sentence
    doubt, = solution_doubts(explained(found, [wheels], [size], [tag], by="marker_size"))
    assert "instead be one factor on both wheels or the place of the UWB tag" in doubt.sentence
    doubt, = solution_doubts(explained(found, ["wheel-radii"], [wheels]))     # equally far off
    assert doubt.what == wheels


def test_what_is_stated_speaks_against_an_explanation_that_is_not_released(found):
    doubt, = solution_doubts(explained(
        found, ["marker-size"], ["wheel-scale"], released=["marker-size"], by="right_radius"))
    assert doubt.what == "marker-size"
    assert "The drive also allows one factor on both wheels, but" in doubt.sentence
    assert "instead" not in doubt.sentence


@pytest.mark.parametrize("column, name, file", [
    (1, "sightings", "ArucoReading.txt"), (2, "ranges", "UwbReading.txt")])
@pytest.mark.parametrize("factor, sigma, said", [
    (1.45, 0.02, None), (1 / 1.45, 0.02, None), (1.6, 0.13, None),
    (1.6, 0.02, "scatter 1.60 ± 0.03 times"), (0.5, 0.02, "scatter 0.50 ± 0.01 times"),
    (1.6, 0.0, None)])                                       # as given, not learned
def test_scatter_that_is_decidedly_not_as_stated_is_named(
        found, column, name, file, factor, sigma, said):
    """By more than a factor of 1.5 and four standard deviations."""
    noise = [1e-3, 1.0, 1.0]
    noise[column] = factor
    result = with_noise(found, noise, sigma)
    if name == "sightings":
        result = replace(result, range_weight=np.zeros(0))                # as without ranges
    sentences = [doubt.sentence for doubt in solution_doubts(result)]
    assert len(sentences) == (said is not None)
    for sentence in sentences:
        assert f"The {name} {said} as much as {file} states" in sentence


@pytest.mark.parametrize("late, is_told", [(0.08, False), (0.15, True)])
def test_late_ranges_are_told_with_their_scatter_if_they_are_more_than_a_tenth(
        found, late, is_told):
    weight = np.where(np.arange(100) < 100 * late, 0.4, 0.6)
    doubt, = solution_doubts(replace(
        with_noise(found, [1e-3, 1.0, 2.0], 0.02), range_weight=weight))
    assert doubt.what == "range-noise"
    assert ("15% of them are far too long" in doubt.sentence) == is_told


@pytest.mark.parametrize("slip, sigma, count", [(0.03, 0.1, 1), (0.02, 0.1, 0), (0.03, 0.0, 0)])
def test_slip_that_no_wheel_has_is_named_unless_it_was_given(found, slip, sigma, count):
    doubts = solution_doubts(with_noise(found, [slip, 1.0, 1.0], sigma))
    assert len(doubts) == count
    assert all("slips by 30 mm" in doubt.sentence for doubt in doubts)


@pytest.mark.parametrize("wrong, repeated, said", [
    ([4, 0, 0], 0, None), ([0, 4, 1], 0, None), ([0, 0, 5], 0, None),
    ([5, 0, 0], 0, "5 of 54 sightings contradict the rest and are left out, of marker 11 5 of 10."),
    ([0, 4, 2], 0, "6 of 54 sightings contradict the rest and are left out."),
    ([5, 4, 21], 0, "left out, of marker 11 5 of 10, of marker 13 21 of 40."),
    ([1, 0, 0], 6, "7 of 60 sightings contradict the rest and are left out, 6 by another one")])
def test_many_rejected_sightings_are_named_of_all_and_of_single_markers(wrong, repeated, said):
    """Sightings of markers 11, 12 and 13: ten, four and forty."""
    count = [10, 4, 40]
    rejected = np.concatenate([np.arange(n) < k for n, k in zip(count, wrong)])
    seen = SimpleNamespace(marker=np.repeat([11, 12, 13], count), contradicting=repeated)
    doubts = _rejection_doubts(SimpleNamespace(rejected=rejected, sightings=seen))
    sentences = [doubt.sentence for doubt in doubts]
    assert len(sentences) == (said is not None)
    assert all(said in sentence for sentence in sentences)


def test_a_fusion_that_contradicts_problem_3_is_told_with_distance_and_share():
    """Half of the poses are 5 cm and five standard deviations away."""
    poses = np.zeros((10, 3))
    poses[5:, :2] = [0.03, 0.04]
    doubt, = contradiction_doubts(poses, np.tile(1e-4 * np.eye(3), (10, 1, 1)), 0 * poses)
    assert "up to 0.05 m from problem 3, and at 50% of the poses" in doubt.sentence


def test_a_vehicle_that_stands_is_no_contradiction():
    """Of what its counts say nothing else is known: both poses are pose 1 to rounding."""
    poses = np.full((10, 3), 1e-6)
    assert not contradiction_doubts(poses, np.tile(1e-20 * np.eye(3), (10, 1, 1)), 0 * poses)


def test_markers_of_one_accepted_sighting_or_at_the_place_of_another_are_unconfirmed(found):
    """The latter as of wrong labels, if they are seen less often. The summary names them."""
    marker, count = np.unique(found.sightings.marker, return_counts=True)
    once, less, more = np.argsort(count, kind="stable")[[1, 0, -1]]
    of_once = np.flatnonzero(found.sightings.marker == marker[once])
    place = found.marker_in_world.copy()
    place[less, :2] = place[more, :2] + 0.01
    spoilt = replace(found, marker_in_world=place, rejected=np.isin(
        np.arange(len(found.rejected)), of_once[1:]))
    assert {*spoilt.unconfirmed} == {marker[once], marker[less]} and not len(found.unconfirmed)
    dataset = found.fit.problem.measurements.dataset
    row = solve.summarize(solve.problem_solution("problem3", dataset, spoilt), None)
    assert row["unconfirmed"] == spoilt.unconfirmed.tolist()
