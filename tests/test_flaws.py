"""Drives that are not as their files say: the estimate holds, or a doubt names what is wrong."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT
from numeric import aruco, known_noise, uwb, vehicle

from slamlib import estimate, solve
from slamlib.__main__ import summary_lines
from slamlib.core import se2
from slamlib.core.evaluation import nees_band
from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import read_dataset, read_truth
from slamlib.robust.calibration import (
    CAMERA,
    SIGHTING_LAG,
    SIGHTINGS,
    calibration_table,
    stated_calibration,
)
from slamlib.robust.file_doubts import doubts_before_solving
from slamlib.robust.jumps import NO_JUMPS
from slamlib.robust.measurements import Noise
from slamlib.robust.result import turn_sigma
from slamlib.robust.solution_doubts import GROUPS, solution_doubts
from slamlib.studies.simulation import simulate


def uncorrelated(*variances):
    """A change of all sightings: other variances of x, y and heading, and no correlation."""
    return lambda d: aruco(d, covariance=np.broadcast_to(
        np.diag(variances), d.aruco.covariance.shape))


def correlated(i, j):
    """A change of all sightings: two coordinates, and no others, are almost fully correlated."""
    def change(d):
        C = d.aruco.covariance * np.eye(3)
        C[:, i, j] = C[:, j, i] = (1 - 1e-11) * np.sqrt(C[:, i, i] * C[:, j, j])
        return aruco(d, covariance=C)
    return change


def one_of(sensor, change):
    """A change of one reading only, in the middle of a drive."""
    def of_one(d):
        readings, changed = getattr(d, sensor), getattr(change(d), sensor)
        half = len(readings.pose) // 2
        return replace(d, **{sensor: replace(readings, **{
            name: np.concatenate([values[:half], getattr(changed, name)[half:half + 1],
                                  values[half + 1:]])
            for name, values in vars(readings).items()})})
    return of_one


def range_sigmas(sigma):
    return lambda d: uwb(d, sigma=np.full_like(d.uwb.sigma, sigma))


LEGAL = {                                      # within the limits, and far from what is usual
    "an unknown heading of pose 1": vehicle(sigma_heading=10.0),
    "very certain wheels": vehicle(
        sigma_right_radius=1e-9, sigma_left_radius=1e-9, sigma_wheelbase=1e-9),
    "unknown wheels": vehicle(sigma_right_radius=0.1, sigma_left_radius=0.1, sigma_wheelbase=0.4),
    "the most certain range": one_of("uwb", range_sigmas(1e-9)),
    "the most uncertain ranges": range_sigmas(1e4),
    "the most certain sighting": one_of("aruco", uncorrelated(1e-18, 1e-18, 1e-18)),
    "the most uncertain sightings": uncorrelated(1e8, 1e8, 1e14),
    "a sighting of a direction": one_of("aruco", uncorrelated(1e-18, 1e8, 1e-18)),
    "sightings of a distance": uncorrelated(1e8, 1e-18, 1e14),
    "correlations of almost 1": correlated(0, 1),
    "correlations with heading of almost 1": correlated(1, 2)}


def names(*lists):
    return {doubt.what for doubts in lists for doubt in doubts}


def test_without_sightings_nothing_is_known_of_the_camera():
    dataset = known_noise(simulate("short", 61)[0].first(300).without("aruco"), 1e-3)
    stated = vehicle(camera_x=0.1, sigma_camera_x=0.02, marker_size=1.01, sighting_lag=2.0)
    for drive in (dataset, stated(dataset)):
        found = estimate(drive, model="arc")
        np.testing.assert_array_equal(found.c[SIGHTINGS], found.calibration.stated[SIGHTINGS])
        np.testing.assert_allclose(found.c_covariance[SIGHTINGS, SIGHTINGS],
                                   np.diag(found.calibration.sigma[SIGHTINGS]**2), atol=1e-15)
        assert not found.released & set(found.calibration.group[SIGHTINGS])


@pytest.mark.slow
def test_offsets_of_the_camera_have_the_standard_deviations_that_they_state():
    """Eight clean drives of two slips, with a camera and a delay that are hardly known."""
    time, place = [], []
    for seed, slip in itertools.product(range(4), (1e-3, 3e-3)):
        dataset, _ = simulate("short", seed, slip=slip)
        found = estimate(vehicle(
            sigma_sighting_lag=10.0, sigma_camera_x=0.2, sigma_camera_y=0.2,
            sigma_camera_turn=0.2)(dataset.without("uwb")))
        time.append(found.c[SIGHTING_LAG]**2 / found.c_covariance[SIGHTING_LAG, SIGHTING_LAG])
        off = found.c[CAMERA]
        place.append(off @ np.linalg.solve(found.c_covariance[CAMERA, CAMERA], off))
    for squared, dof in ((time, 1), (place, 3)):
        low, high = nees_band(8, dof, probability=0.99)
        assert low < np.mean(squared) < high, (dof, squared)


@pytest.mark.slow
@pytest.mark.parametrize("case", LEGAL)
def test_every_problem_is_solved_within_the_limits(case):
    """Finite covariances, not negative; SLAM's errors as they state, or its rejections are told."""
    short = ROOT / "data" / "short"
    dataset, truth = read_dataset(short), read_truth(short)
    dataset = LEGAL[case](dataset.first(300))
    doubts_before_solving(dataset)                         # without a warning
    for found in solve.solutions(dataset):
        assert isinstance(found, solve.Solution), found.reason
        known = np.isfinite(found.poses[:, 0])
        variances = np.diagonal(found.covariances[known], axis1=1, axis2=2)
        assert known.any() and (variances >= 0).all()
        if found.problem in ("problem3", "problem4"):
            errors = np.abs(found.poses - truth.poses[:300])
            assert (errors < 5 * np.sqrt(variances) + 0.02).all() \
                or "sightings-rejected" in names(found.doubts)


def test_a_solution_that_rounding_spoilt_is_none(monkeypatch):
    dataset, _ = simulate("short", 61)
    dataset = replace(dataset.first(100), uwb=None)
    found = estimate(dataset)
    for changes in (
            {"covariances": np.nan * found.covariances}, {"c_covariance": -1e-30 * np.eye(14)},
            {"marker_covariance": np.full_like(found.marker_covariance, np.inf)},
            {"fit": replace(found.fit, log_evidence=-np.inf)}):
        spoilt = replace(found, **changes)
        monkeypatch.setattr(solve, "estimate", lambda _, spoilt=spoilt: spoilt)
        failure, = solve.solutions(dataset, problems=("problem3",))
        assert "float64" in failure.reason and "a variance is negative" in failure.reason


def solved(noise=(1e-3, 1.0, 1.0), noise_sigma=(0.1, 0.02, 0.03), explanations=(frozenset(),),
           c=None, vehicle=Vehicle(), **changes):
    """What the doubts read of a SlamResult that agrees with its files, but for these changes.

    There are two antennas; all estimates have a standard deviation of a thousandth.
    """
    calibration = stated_calibration(vehicle, np.array([5, 6]))
    table = calibration_table(
        calibration, calibration.stated if c is None else c, 1e-6 * np.eye(16),
        frozenset().union(*explanations))
    return SimpleNamespace(**dict(
        noise=Noise(*noise), slip=noise[0], noise_sigma=np.array(noise_sigma),
        range_weight=np.repeat([0.0, 1.0], [0, 20]), explanations=explanations,
        calibration_table=table, doubts={}, converged=True, antenna=np.array([5, 6]),
        share=np.ones(20), places=None, jumps=NO_JUMPS,
        agreement=(0.0, 0.0),
        rejected=np.zeros(0, bool), turn_sigma=np.zeros(0), sightings=SimpleNamespace(
            contradicting=0, marker=np.zeros(0, int), frame=np.arange(1))) | changes)


def test_nothing_is_said_of_what_agrees():
    assert solution_doubts(solved()) == ()
    doubt, = solution_doubts(solved(converged=False))
    assert doubt.what == "not-converged"
    doubt, = solution_doubts(solved(doubts={5: "only 3 of its 9 ranges agree"}))
    assert doubt.what == "antenna" and "Antenna 5 is in doubt: only 3" in doubt.sentence


@pytest.mark.parametrize("group", GROUPS)
def test_every_group_is_named_with_what_is_stated_and_found(group):
    """All its entries, and no others; nothing where its release was not decided."""
    calibration = stated_calibration(Vehicle(), np.array([5, 6]))
    found = solved(explanations=(frozenset([group]),), c=calibration.stated + 0.01)
    doubt, = solution_doubts(found)
    assert doubt.what == group and doubt.sentence.endswith(GROUPS[group][1])
    assert "problem 4 uses this" in doubt.sentence and "cannot tell" not in doubt.sentence
    found.antenna = np.zeros(0, int)
    assert "problem 3 uses this" in solution_doubts(found)[0].sentence
    for name, of in zip(calibration.names, calibration.group):
        assert (f"{name} = " in doubt.sentence) == (of == group)
    assert not solution_doubts(solved(c=calibration.stated + 0.01))


def test_numbers_are_given_with_standard_deviations_and_units():
    vehicle = Vehicle(sigma_camera_x=0.05, camera_y=0.1)
    c = stated_calibration(vehicle, np.array([5, 6])).stated
    c = c + 0.02 * (np.arange(16) == 3)
    doubt, = solution_doubts(solved(
        explanations=(frozenset(["camera-offset"]),), c=c, vehicle=vehicle))
    assert "camera_x = 0.02 ± 0.001 m (stated: 0 ± 0.05)" in doubt.sentence
    assert "camera_y = 0.1 ± 0.001 m (stated: 0.1)" in doubt.sentence
    assert "camera_turn = 0 ± 0.001 rad (stated: 0)" in doubt.sentence


def test_explanations_that_exclude_each_other_are_all_named():
    """In the sentence of the one that is furthest off; what they have in common has its own."""
    wheels, size, tag = "wheel-parameters", "marker-size", "tag-offset"
    c = stated_calibration(Vehicle(), np.array([5, 6])).stated
    c = c + 0.01 * (np.arange(16) == 6)                                # of the size
    found = solved(explanations=(frozenset([wheels, tag]), frozenset([size, tag])), c=c)
    said = {doubt.what: doubt.sentence for doubt in solution_doubts(found)}
    assert [*said] == [size, tag]
    assert "It may instead be the wheels: the drive cannot tell" in said[size]
    assert "instead" not in said[tag]
    found = solved(explanations=(frozenset([wheels]), frozenset([size]), frozenset([tag])), c=c)
    doubt, = solution_doubts(found)
    assert "instead be the wheels or the place of the UWB tag" in doubt.sentence


@pytest.mark.parametrize("factor, sigma, said", [
    (1.0, 0.02, None), (1.45, 0.02, None), (1 / 1.45, 0.02, None), (1.6, 0.13, None),
    (1.6, 0.02, "scatter 1.60 ± 0.03 times"), (0.5, 0.02, "scatter 0.50 ± 0.01 times"),
    (1.6, 0.0, None),                                        # as given, not learned
    (100.0, 0.02, "scatter at least 100 times"), (0.01, 0.02, "scatter at most 0.01 times"),
    (2.0, 0.13, "scatter 2.00 ± 0.26 times")])
def test_scatter_that_is_decidedly_not_as_stated_is_named(factor, sigma, said):
    """By more than a factor of 1.5 and four standard deviations; at a bound the bound is said."""
    files = {"sightings": "ArucoReading.txt", "ranges": "UwbReading.txt"}
    for column, (name, file) in enumerate(files.items(), 1):
        noise, sigmas = [1e-3, 1.0, 1.0], np.full(3, 0.02)
        noise[column], sigmas[column] = factor, sigma
        doubts = solution_doubts(solved(noise, sigmas))
        assert len(doubts) == (said is not None)
        if said:
            assert f"The {name} {said} as much as {file} states" in doubts[0].sentence
            assert "covariances were obtained" in doubts[0].sentence


@pytest.mark.parametrize("late, reason", [
    (1, "covariances were obtained"), (2, "covariances were obtained"),
    (3, "15% of them are far too long")])
def test_late_ranges_are_the_reason_for_their_scatter_if_they_are_more_than_a_tenth(late, reason):
    weight = np.repeat([0.4, 0.6], [late, 20 - late])
    doubt, = solution_doubts(solved((1e-3, 1.0, 2.0), range_weight=weight))
    assert doubt.what == "range-noise" and reason in doubt.sentence
    doubt, = solution_doubts(solved((1e-3, 2.0, 1.0), range_weight=weight))
    assert doubt.what == "marker-noise" and "covariances were obtained" in doubt.sentence


def test_slip_that_no_wheel_has_is_named_unless_it_was_given():
    doubt, = solution_doubts(solved((0.03, 1.0, 1.0)))
    assert "slips by 30 mm" in doubt.sentence
    assert not solution_doubts(solved((0.02, 1.0, 1.0)))
    assert not solution_doubts(solved((0.03, 1.0, 1.0), np.zeros(3)))


def test_many_rejected_sightings_are_named_of_all_and_of_single_markers():
    """Sightings of markers 11, 12 and 13: ten, four and forty."""
    label = np.repeat([11, 12, 13], [10, 4, 40])

    def said(*rejected_of_each, repeated=0):
        rejected = np.concatenate([np.arange(np.sum(label == k)) < count
                                   for k, count in enumerate(rejected_of_each, 11)])
        return [doubt.sentence for doubt in solution_doubts(solved(
            rejected=rejected, sightings=SimpleNamespace(contradicting=repeated, marker=label,
                                                         frame=np.arange(1))))]

    assert said(4, 0, 0) == [] and said(0, 4, 1) == [] and said(0, 0, 5) == []
    for counts, of_markers in (((5, 0, 0), ", of marker 11 5 of 10:"), ((0, 4, 2), "left out:"),
                               ((5, 4, 21), ", of marker 11 5 of 10, of marker 13 21 of 40:")):
        sentence, = said(*counts)
        assert sentence.startswith(f"{sum(counts)} of 54 sightings contradict the rest and are")
        assert of_markers in sentence
    sentence, = said(1, 0, 0, repeated=6)
    assert sentence.startswith("7 of 60") and ", 6 by another one of the same marker" in sentence


def test_a_marker_at_the_place_of_another_is_unconfirmed():
    """Three successive sightings of a marker have the id of another one, which is not seen."""
    dataset = simulate("short", 61)[0]
    seen = dataset.aruco
    of = [np.flatnonzero(seen.marker == each) for each in np.unique(seen.marker)[:2]]
    marker = seen.marker.copy()
    marker[of[0][1:4]] = marker[of[1][0]]
    others = np.setdiff1d(np.arange(len(marker)), of[1])
    seen = replace(seen, marker=marker).select(others)
    found = estimate(replace(dataset, aruco=seen, uwb=None))
    assert found.unconfirmed.tolist() == [marker[of[1][0]]]


def test_a_marker_with_a_single_accepted_sighting_is_unconfirmed():
    """It has no residuals; that it is there is no doubt, but said on the terminal."""
    dataset = simulate("short", 61)[0].first(600)
    seen = dataset.aruco
    label, count = np.unique(seen.marker, return_counts=True)
    rows = np.flatnonzero(seen.marker == label[count.argmax()])
    found = estimate(replace(dataset, uwb=None, aruco=seen.select(
        np.setdiff1d(np.arange(len(seen.marker)), rows[1:]))))
    assert found.unconfirmed.tolist() == [label[count.argmax()]]
    assert not solution_doubts(found)
    row = solve.problem_solution("problem3", dataset.without("uwb"), found)
    lines = summary_lines([solve.summary_of(
        dataset, None, {"problem3": solve.summarize(row, None)}, [])])
    assert f"confirms markers {label[count.argmax()]}: seen once, or" in lines[-1]


@pytest.mark.slow
def test_a_marker_that_was_moved_halfway_is_named():
    dataset, truth = simulate("short", 5)
    seen = dataset.aruco
    marker = np.min([np.bincount(seen.marker[half], minlength=500) for half in (
        seen.pose < 1000, seen.pose >= 1000)], axis=0).argmax()
    late, z = (seen.marker == marker) & (seen.pose >= 1000), seen.marker_in_vehicle.copy()
    z[late, :2] += se2.rotation(-truth.poses[seen.pose[late], 2]) @ [0.1, 0]
    found = estimate(aruco(dataset, marker_in_vehicle=z).without("uwb"))
    doubt, = solution_doubts(found)
    assert doubt.what == "sightings-rejected" and f"of marker {marker} " in doubt.sentence


def test_a_turn_that_the_wheels_hardly_know_is_named_where_it_is():
    """Turns to 0.3, 1.3 and 1.2 rad: by the wheel parameters and, in quadrature, by slip."""
    vehicle, by_wheel = Vehicle(), np.zeros((3, 3, 3))
    by_wheel[:, 2] = np.array([[0.3, 0, 0], [0.3, 0.4, 0], [0, 0, 1.2]]) / vehicle.sigma_wheel

    def doubts(slip):
        sigma = turn_sigma(SimpleNamespace(
            measurements=SimpleNamespace(dataset=SimpleNamespace(vehicle=vehicle),
                                         frame=np.array([0, 10, 30, 70]), jumps=NO_JUMPS),
            noise=SimpleNamespace(slip=slip), odometry=SimpleNamespace(
                J_wheel=by_wheel,
                covariance=lambda slip: np.diag([0, 0, slip**2]) * [[[0]], [[1]], [[0]]])))
        return solution_doubts(solved(turn_sigma=sigma, sightings=SimpleNamespace(
            contradicting=0, marker=np.zeros(0, int), frame=np.array([0, 10, 30, 70]))))

    doubt, = doubts(1.2)
    assert "Between poses 11 and 31" in doubt.sentence and "to 1.3 rad" in doubt.sentence
    doubt, = doubts(0.1)
    assert "Between poses 31 and 71" in doubt.sentence and "to 1.2 rad" in doubt.sentence
    by_wheel[2, 2] = 0
    assert not doubts(0.1)
