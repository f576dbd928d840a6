"""Flaws of whole files are named, and nothing else is, on drives of the simulator."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slamlib import slam
from slamlib.dataset import AntennaGuess, Vehicle
from slamlib.localization import drive_doubts
from slamlib.simulation import simulate

SEEDS = (0, 1, 2)
simulated = cache(simulate)


def whats(dataset):
    return [doubt.what for doubt in drive_doubts(dataset)]


def wheels(matrix):
    """A flaw: the counts (right, left) are mixed by a 2 x 2 matrix."""
    return lambda dataset: replace(dataset, ticks=dataset.ticks @ np.array(matrix))


def camera(*matrix):
    """A flaw: the sightings [x, y, theta] are mixed by a 3 x 3 matrix; a row stands for diag."""
    M = np.diag(np.array(matrix, float)) if np.ndim(matrix) == 1 else np.array(matrix, float)

    def spoil(dataset):
        a = dataset.aruco
        return replace(dataset, aruco=replace(a, marker_in_vehicle=a.marker_in_vehicle @ M.T,
                                              covariance=M @ a.covariance @ M.T))
    return spoil


def covariances(factor):
    return lambda dataset: replace(dataset, aruco=replace(
        dataset.aruco, covariance=factor * dataset.aruco.covariance))


def ranges(factor):
    return lambda dataset: replace(dataset, uwb=replace(
        dataset.uwb, range=factor * dataset.uwb.range, sigma=factor * dataset.uwb.sigma))


def guesses(factor):
    return lambda dataset: replace(dataset, antenna_guess=AntennaGuess(
        dataset.antenna_guess.antenna, factor * dataset.antenna_guess.position))


def vehicle(**parameters):
    return lambda dataset: replace(dataset, vehicle=Vehicle(**parameters))


SWAPPED, REVERSED, BACKWARDS = ([[0, 1], [1, 0]], [[-1, 0], [0, -1]], [[0, -1], [-1, 0]])
FLAWS = {
    "columns of counts": (wheels(SWAPPED), "wheels-swapped", "right and left"),
    "signs of counts": (wheels(REVERSED), "wheels-reversed", "signs of the counts"),
    "both": (wheels(BACKWARDS), "wheels-reversed", "signs reversed and the columns exchanged"),
    "y and theta": (camera(1, -1, -1), "camera-mirrored", "of y and the other sign of theta"),
    "x and theta": (camera(-1, 1, -1), "camera-mirrored", "of x and the other sign of theta"),
    "y": (camera(1, -1, 1), "camera-mirrored", "sightings with the other sign of y (look"),
    "x": (camera(-1, 1, 1), "camera-mirrored", "sightings with the other sign of x (look"),
    "theta": (camera(1, 1, -1), "camera-mirrored", "sightings with the other sign of theta (look"),
    "x and y": (camera(-1, -1, 1), "camera-turned", "the other signs of x and y"),
    "axes exchanged": (camera([0, 1, 0], [1, 0, 0], [0, 0, 1]), "camera-mirrored",
                       "sightings with x and y exchanged (look"),
    "right angle": (camera([0, -1, 0], [1, 0, 0], [0, 0, 1]), "camera-turned", "right angle"),
    "sightings in mm": (camera(1000, 1000, 1), "units", "x and y in ArucoReading.txt"),
    "sightings in cm": (camera(100, 100, 1), "units", "x and y in ArucoReading.txt"),
    "ranges in mm": (ranges(1000), "units", "UwbReading.txt"),
    "guesses in mm": (guesses(1000), "units", "UwbAntennaGuess.txt"),
    "wheelbase in mm": (vehicle(wheelbase=400.0), "units", "wheelbase in vehicle.toml"),
    "no counts": (wheels([[0, 0], [0, 0]]), "odometry", "encoderReading.txt"),
}


def test_turns_that_only_the_wheels_have_seen_are_doubted():
    """Markers at both ends of two rounds: the heading there is known up to whole turns only."""
    dataset, _ = simulate("long", 3, rounds=2)
    pose = dataset.aruco.pose
    ends = (pose < 600) | (pose > len(dataset.ticks) - 600)
    found = slam.estimate(replace(dataset, aruco=dataset.aruco.select(ends), uwb=None))
    doubt, = (doubt for doubt in found.drive_doubts if doubt.what == "turns")
    seen = dataset.aruco.pose[ends]
    assert f"Between poses {seen[seen < 600][-1] + 1} and {seen[seen > 600][0] + 1} " \
        in doubt.sentence
    whole = slam.estimate(simulate("short", 3)[0].without("uwb"))
    assert "turns" not in {doubt.what for doubt in whole.drive_doubts}


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_flaw_is_named(flaw):
    spoil, what, said = FLAWS[flaw]
    for seed in SEEDS:
        doubt, = drive_doubts(spoil(simulated("short", seed)[0]))
        assert doubt.what == what
        assert said in doubt.sentence


def test_files_of_two_drives_are_named():
    for seed in SEEDS:
        short, long = simulated("short", seed)[0], simulated("long", seed)[0]
        assert whats(replace(short, aruco=long.first(len(short.ticks)).aruco)) == ["odometry"]


def test_a_vehicle_in_millimetres_is_named_by_sightings_and_by_ranges():
    """The markers' distances are a thousandth of the wheels', and so are the changes of ranges."""
    spoil = vehicle(right_radius=100.0, left_radius=100.0, wheelbase=400.0)
    doubts = drive_doubts(spoil(simulated("short", 0)[0]))
    assert [doubt.what for doubt in doubts] == ["units", "units"]
    assert all("vehicle.toml" in doubt.sentence for doubt in doubts)


@pytest.mark.parametrize("spoil, expected", [
    (wheels(SWAPPED), ["wheels-swapped", "camera-mirrored"]),
    (camera(1, -1, -1), ["wheels-swapped", "camera-mirrored"]),
    (wheels(REVERSED), ["wheels-reversed", "camera-mirrored"]),
    (wheels(BACKWARDS), ["wheels-reversed", "camera-turned"])])
def test_without_ranges_both_explanations_are_named(spoil, expected):
    """A path and its mirror image cannot be told apart by increments; ranges do so in FLAWS."""
    for seed in SEEDS:
        doubts = drive_doubts(spoil(simulated("short", seed)[0]).without("uwb"))
        assert [doubt.what for doubt in doubts] == expected
        assert "Equally possible: sightings with" in doubts[0].sentence
        assert "Equally possible: " in doubts[1].sentence
        assert "encoderReading.txt" in doubts[1].sentence


@pytest.mark.parametrize("path, seeds", [
    ("short", SEEDS), pytest.param("long", SEEDS, marks=pytest.mark.slow)])
@pytest.mark.parametrize("keywords", [
    {}, {"slip": 0.0}, {"slip": 1e-2}, {"mislabelled": 0.01, "late_ranges": 0.15}])
def test_a_clean_drive_gives_no_doubt(path, seeds, keywords):
    for seed in seeds:
        dataset = simulated(path, seed, **keywords)[0]
        assert drive_doubts(dataset) == []
        assert drive_doubts(covariances(4.0)(dataset)) == []
        assert drive_doubts(covariances(0.25)(dataset)) == []


@pytest.mark.parametrize("wrong", [
    {"right_radius": 0.101}, {"left_radius": 0.101}, {"wheelbase": 0.404},
    {"right_radius": 0.101, "left_radius": 0.101}])
def test_a_wheel_one_percent_off_gives_no_doubt_here(wrong):
    for seed in SEEDS:
        dataset = simulated("short", seed, vehicle=Vehicle(**wrong))[0]
        assert drive_doubts(replace(dataset, vehicle=Vehicle())) == []


@pytest.mark.parametrize("keywords", [{"slip": 0.0}, {"mislabelled": 0.01}])
@pytest.mark.parametrize("spoil", [wheels(SWAPPED), camera(1, -1, 1)])
def test_noise_hides_no_flaw(spoil, keywords):
    for seed in SEEDS:
        dataset = spoil(simulated("short", seed, **keywords)[0])
        for factor in (0.25, 1.0, 4.0):
            assert len(whats(covariances(factor)(dataset))) == 1


@pytest.mark.slow
@pytest.mark.parametrize("flaw", ["columns of counts", "signs of counts", "y", "ranges in mm"])
def test_a_flaw_is_named_on_a_long_drive(flaw):
    for seed in SEEDS:
        assert whats(FLAWS[flaw][0](simulated("long", seed)[0])) == [FLAWS[flaw][1]]


def test_too_little_to_decide_gives_no_doubt():
    dataset = simulated("short", 0)[0]
    for little in (dataset.first(1), dataset.first(100), dataset.without("aruco"),
                   dataset.without("aruco").without("uwb"),
                   replace(dataset, aruco=dataset.aruco.select([5])),
                   replace(dataset, aruco=dataset.aruco.select(dataset.aruco.pose % 500 == 0))):
        assert drive_doubts(little) == []
        assert drive_doubts(wheels(SWAPPED)(little)) == []


def test_standing_still_gives_no_doubt():
    """All sightings of a vehicle that stands are those of one pose, with their noise."""
    dataset, rng = simulated("short", 0)[0], np.random.default_rng(0)
    first = dataset.aruco.select(dataset.aruco.pose == 0)
    rows = np.tile(np.arange(len(first.pose)), 200)
    seen = replace(first.select(rows), pose=np.repeat(np.arange(0, 2000, 10), len(first.pose)))
    noise = np.linalg.cholesky(seen.covariance) @ rng.standard_normal((len(rows), 3, 1))
    seen = replace(seen, marker_in_vehicle=seen.marker_in_vehicle + noise[..., 0])
    still = replace(dataset, ticks=0 * dataset.ticks, aruco=seen)
    assert drive_doubts(still.without("uwb")) == []
    waits = np.concatenate([still.ticks[:1000], dataset.ticks[1:1001]])
    moved = replace(dataset.aruco, pose=dataset.aruco.pose + 999).select(dataset.aruco.pose < 1001)
    assert drive_doubts(replace(dataset, ticks=waits, aruco=moved, uwb=None)) == []
