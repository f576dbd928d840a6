"""Flaws of whole files are named, and nothing else is, on drives of the simulator."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numeric import as_points, changed, vehicle

from slamlib.core.errors import DatasetError
from slamlib.core.records import AntennaGuess, Dataset, UwbReadings
from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import read_dataset
from slamlib.robust import file_doubts as files
from slamlib.robust.file_doubts import doubts_before_solving
from slamlib.studies.simulation import manoeuvre, simulate, write_dataset

SEEDS = (0, 1)
simulated = cache(simulate)


def whats(dataset):
    return [doubt.what for doubt in doubts_before_solving(dataset)]


def wheels(matrix):
    """A flaw: the counts (right, left) are mixed by a 2 x 2 matrix."""
    return lambda dataset: replace(dataset, ticks=dataset.ticks @ np.array(matrix))


def camera(*matrix):
    """A flaw: the sightings [x, y, theta] are mixed by a 3 x 3 matrix; a row stands for diag."""
    M = np.diag(np.array(matrix, float)) if np.ndim(matrix) == 1 else np.array(matrix, float)
    return lambda dataset: changed(
        dataset, "aruco", marker_in_vehicle=dataset.aruco.marker_in_vehicle @ M.T,
        covariance=M @ dataset.aruco.covariance @ M.T)


def covariances(factor):
    return lambda dataset: changed(dataset, "aruco", covariance=factor * dataset.aruco.covariance)


def another_drive(dataset):
    """The sightings are those of a long drive."""
    return replace(dataset, aruco=simulated("long", 0)[0].first(len(dataset.ticks)).aruco)


def in_unit(what, factor):
    """A flaw: some lengths are in another unit; without some sensors."""
    place = np.array([factor, factor, 1.0])

    def spoil(d):
        uwb = {key: factor * getattr(d.uwb, key) for key in ("range", "sigma") if key in what}
        aruco = {"marker_in_vehicle": place * d.aruco.marker_in_vehicle} if "xy" in what else {}
        if "covariance" in what:
            aruco["covariance"] = d.aruco.covariance * np.outer(place, place)
        sizes = {name: factor * value for name, value in vars(d.vehicle).items()
                 if "radius" in name and "radii" in what or "wheelbase" in name and "base" in what}
        d = changed(changed(d, "uwb", **uwb), "aruco", **aruco)
        d = replace(d, vehicle=replace(d.vehicle, **sizes), antenna_guess=AntennaGuess(
            d.antenna_guess.antenna, d.antenna_guess.position * (factor if "guess" in what else 1)))
        d = d.without("aruco") if "no markers" in what else d
        return d.without("uwb") if "no ranges" in what else d
    return spoil


SWAPPED, REVERSED, BACKWARDS = ([[0, 1], [1, 0]], [[-1, 0], [0, -1]], [[0, -1], [-1, 0]])
FLAWS = {
    "columns of counts": (wheels(SWAPPED), "wheels-swapped camera-mirrored",
                          "right and left"),
    "signs of counts": (wheels(REVERSED), "wheels-reversed camera-mirrored",
                        "signs of the counts"),
    "both": (wheels(BACKWARDS), "wheels-reversed camera-turned",
             "signs reversed and the columns exchanged"),
    "y and theta": (camera(1, -1, -1), "wheels-swapped camera-mirrored", "with [x, -y, -theta]"),
    "x and theta": (camera(-1, 1, -1), "wheels-reversed camera-mirrored", "with [-x, y, -theta]"),
    "y": (camera(1, -1, 1), "camera-mirrored", "with [x, -y, theta]"),
    "x": (camera(-1, 1, 1), "camera-mirrored", "with [-x, y, theta]"),
    "theta": (camera(1, 1, -1), "camera-mirrored", "with [x, y, -theta]"),
    "all": (camera(-1, -1, -1), "camera-mirrored", "with [-x, -y, -theta]"),
    "x and y": (camera(-1, -1, 1), "wheels-reversed camera-turned", "with [-x, -y, theta]"),
    "axes exchanged": (camera([0, 1, 0], [1, 0, 0], [0, 0, 1]), "camera-mirrored",
                       "with [y, x, theta]"),
    "right angle": (camera([0, -1, 0], [1, 0, 0], [0, 0, 1]), "camera-turned",
                    "with [y, -x, theta]"),
    "sightings in mm": (in_unit("xy covariance", 1e3), "units", "x and y in ArucoReading.txt"),
    "ranges in mm": (in_unit("range sigma", 1e3), "units", "UwbReading.txt"),
    "sigmas in cm": (in_unit("sigma", 100), "units", "sigma (m) in UwbReading.txt"),
    "guesses in mm": (in_unit("guess", 1e3), "units", "UwbAntennaGuess.txt"),
    "wheelbase in mm": (vehicle(wheelbase=400.0), "units", "wheelbase in vehicle.toml"),
    "vehicle in mm": (vehicle(right_radius=100.0, left_radius=100.0, wheelbase=400.0),
                      "units units", "vehicle.toml"),
    "no counts": (wheels([[0, 0], [0, 0]]), "odometry", "encoderReading.txt"),
    "another drive": (another_drive, "odometry", "of the same drive"),
}


@pytest.mark.parametrize("keywords", [{"slip": 0.0}, {"mislabelled": 0.03}])
@pytest.mark.parametrize("flaw", FLAWS)
def test_a_flaw_is_named(flaw, keywords):
    """With right covariances, and with sigmas of sightings that are half or twice as large.

    Increments cannot tell a path from its mirror image: both explanations are named.
    """
    spoil, what, said = FLAWS[flaw]
    for seed in SEEDS:
        spoilt = spoil(simulated("short", seed, **keywords)[0])
        doubts = doubts_before_solving(spoilt)
        assert [doubt.what for doubt in doubts] == what.split()
        assert any(said in doubt.sentence for doubt in doubts)
        told = {"Equally possible: " in doubt.sentence for doubt in doubts}
        assert told == {what.startswith("wheels-")}
    assert [whats(covariances(factor)(spoilt)) for factor in (0.25, 4.0)] == 2 * [what.split()]


# Drives with nothing to doubt: functions of a simulated drive and a random generator.

def wheels_off(**wrong):
    """Wheels that are not as stated, here by one percent."""
    return lambda _, rng: replace(
        simulate("short", 1, vehicle=Vehicle(**wrong))[0], vehicle=Vehicle())


def headings_unknown(rows):
    """Sightings without a heading, as its sigma of 100 rad says."""
    def change(dataset, rng):
        z = dataset.aruco.marker_in_vehicle.copy()
        z[rows, 2] = rng.uniform(-np.pi, np.pi, len(z[rows]))
        return replace(dataset, aruco=replace(as_points(dataset.aruco, rows), marker_in_vehicle=z))
    return change


def overconfident(factor, sigma):
    """Covariances that are far too small, of sightings that are worse by `sigma` in m and rad."""
    def change(dataset, rng):
        z = dataset.aruco.marker_in_vehicle
        return covariances(factor)(changed(
            dataset, "aruco", marker_in_vehicle=z + rng.normal(0, sigma, z.shape)))
    return change


def standing(dataset, rng):
    """All sightings are those of one pose, with their noise."""
    first = dataset.aruco.select(dataset.aruco.pose == 0)
    rows = np.tile(np.arange(len(first.pose)), 200)
    seen = replace(first.select(rows), pose=np.repeat(np.arange(0, 2000, 10), len(first.pose)))
    noise = np.linalg.cholesky(seen.covariance) @ rng.standard_normal((len(rows), 3, 1))
    seen = replace(seen, marker_in_vehicle=seen.marker_in_vehicle + noise[..., 0])
    return replace(dataset, ticks=0 * dataset.ticks, aruco=seen, uwb=None)


def waiting(dataset, rng):
    """The vehicle stands before it begins to drive."""
    ticks = np.concatenate([0 * dataset.ticks[:1000], dataset.ticks[1:1001]])
    moved = replace(dataset.aruco, pose=dataset.aruco.pose + 999).select(dataset.aruco.pose < 1001)
    return replace(dataset, ticks=ticks, aruco=moved, uwb=None)


RIGHT = {
    "standing": standing, "waiting": waiting,
    "a wheel": wheels_off(right_radius=0.101), "the base": wheels_off(wheelbase=0.404),
    "both wheels": wheels_off(right_radius=0.101, left_radius=0.101),
    **{f"no headings, {rows}": headings_unknown(rows)
       for rows in (slice(0, None, 2), slice(1, None, 2), slice(None))},
    **{f"{factor:g} and {sigma:g}": overconfident(factor, sigma)
       for factor in (1e-2, 1e-3, 1e-4) for sigma in (0.0, 0.03)}}


@pytest.mark.parametrize("case", RIGHT)
def test_nothing_is_doubted(case):
    for seed in SEEDS:
        drive = RIGHT[case](simulated("short", seed)[0], np.random.default_rng(seed))
        assert doubts_before_solving(drive) == []


@pytest.mark.parametrize("path", ["short", pytest.param("long", marks=pytest.mark.slow)])
@pytest.mark.parametrize("keywords", [
    {}, {"slip": 0.0}, {"slip": 1e-2}, {"mislabelled": 0.01, "late_ranges": 0.15}])
def test_a_clean_drive_gives_no_doubt(path, keywords):
    for seed in SEEDS if path == "short" else SEEDS[:1]:
        dataset = simulated(path, seed, **keywords)[0]
        for factor in (1e-4, 0.25, 1.0, 4.0) if path == "short" else (1.0,):
            assert doubts_before_solving(covariances(factor)(dataset)) == []


def test_too_little_to_decide_gives_no_doubt():
    dataset = simulated("short", 0)[0]
    for little in (dataset.first(1), dataset.first(100), dataset.without("aruco"),
                   dataset.without("aruco").without("uwb"),
                   replace(dataset, aruco=dataset.aruco.select([5])),
                   replace(dataset, aruco=dataset.aruco.select(dataset.aruco.pose < 40)),
                   replace(dataset, aruco=dataset.aruco.select(dataset.aruco.pose % 500 == 0))):
        assert doubts_before_solving(little) == []
        assert doubts_before_solving(wheels(SWAPPED)(little)) == []


def test_doubts_about_files_erase_no_others():
    """Each kind is told once; of antennas and units, each sentence."""
    kinds = ["units", "odometry", "marker-noise", "antenna", "places", "antenna", "units"]
    doubts = [files.Doubt(kind, f"Sentence {k}.") for k, kind in enumerate(kinds)]
    assert files.merged(doubts) == doubts
    again = files.Doubt("odometry", "Again.")
    assert files.merged([*doubts, again, doubts[0]]) == [doubts[0], again, *doubts[2:]]


def moved_by(length, turn, count=20):
    """Increments that turn to either side in turn, so that their mean is no turn."""
    side = np.resize([1.0, -1.0], count)
    return np.column_stack([np.full(count, 0.6 * length), 0.8 * length * side, turn * side])


@pytest.mark.parametrize("markers, wheels, disagree, said", [
    ((0.2, 0.1), (0.2, 0.1), 0, None), ((0.2, 0.1), (0.9, 0.45), 0, None),
    ((0.9, 0.45), (0.2, 0.1), 0, None),
    ((1.1, 0.1), (0.2, 0.1), 0, "x and y in ArucoReading.txt"),
    ((0.2, 0.1), (1.1, 0.1), 0, "x and y in ArucoReading.txt"),
    ((0.2, 0.01), (0.2, 0.06), 0, "wheelbase in vehicle.toml"),
    ((0.2, 0.06), (0.2, 0.01), 0, "wheelbase in vehicle.toml"),
    ((0.02, 0.01), (0.2, 0.1), 0, "radii (metres) and ticks_per_revolution"),
    ((0.02, 0.1), (0.0, 0.1), 0, None), ((0.02, 0.1), (0.005, 0.1), 0, None),
    ((0.2, 0.004), (0.2, 0.0005), 0, None), ((0.3, 0.15), (0.2, 0.1), 9, None),
    ((0.3, 0.15), (0.2, 0.1), 12, "they agree at 40% of 20 places")])
def test_units_are_named_from_a_factor_of_five_on_and_odometry_if_most_disagrees(
        markers, wheels, disagree, said):
    """Standard deviations of 1 cm and 1 mrad: from five of them on, motion is compared."""
    doubts = list(files.wrong_sizes(moved_by(*markers) + [0, 0, 2 * np.pi], moved_by(*wheels),
                                    np.tile([1e-2, 1e-3], (20, 1)), np.arange(20) >= disagree))
    kinds = [doubt.what for doubt in doubts]
    assert kinds == ["odometry" if disagree else "units"] * bool(said)
    for doubt in doubts:
        assert said in doubt.sentence
        assert ("moves by {:.4g} m and turns by {:.4g} rad by the markers, and by {:.4g} m and "
                "{:.4g} rad by the wheels").format(*markers, *wheels) in doubt.sentence


def ranges_on_a_circle(factor=1.0, guess=1.0, count=200):
    """A drive on a circle of 2 m with ranges to an antenna 10 m away, times a factor."""
    ticks = np.rint(manoeuvre([(4 * np.pi, 2 * np.pi)]))
    path = np.column_stack([2 * np.sin(np.linspace(0, 2 * np.pi, len(ticks))),
                            2 - 2 * np.cos(np.linspace(0, 2 * np.pi, len(ticks)))])
    at = np.linspace(0, len(ticks) - 1, count).astype(int)
    place = np.array([6.0, 10.0])
    r = factor * np.hypot(*(path[at] - place).T)
    return Dataset("circle", Vehicle(), ticks, None,
                   UwbReadings(at, np.full(count, 3), r, np.full(count, 0.1)),
                   AntennaGuess(np.array([3]), guess * place[None]))


@pytest.mark.parametrize("factor, guess, named", [
    (1.0, 1.0, ""), (3.0, 1.0, ""), (4.0, 1.0, "spread"), (0.25, 1.0, ""), (0.15, 1.0, "distance"),
    (0.03, 1.0, "distance"), (0.015, 1.0, "spread"), (1.0, 0.01, ""), (1.0, 4.0, ""),
    (1.0, 8.0, "distance")])
def test_units_of_ranges_are_judged_by_their_spread_and_by_the_guesses(factor, guess, named):
    """The quartiles of 2 m sin(t) are 2 sqrt(2) m apart; the path has the sigma 2 m."""
    doubts = list(files.range_units(ranges_on_a_circle(factor, guess)))
    assert len(doubts) == bool(named)
    for doubt in doubts:
        numbers = [float(number) for number in re.findall(r"[\d.]+(?= m\b)", doubt.sentence)]
        middle = np.array([0.0, 2.0])
        np.testing.assert_allclose(numbers, [
            factor * np.hypot(*(middle - [6, 10])), factor * 2 * np.sqrt(2), 2.0,
            np.hypot(*(middle - guess * np.array([6, 10])))], rtol=0.03)
        assert ("UwbReading.txt" if named == "spread" else "UwbAntennaGuess.txt") in doubt.sentence


def test_units_of_few_ranges_and_of_a_vehicle_that_stands_are_not_judged():
    drive = ranges_on_a_circle(1e3)
    for few, count in ((drive, 1), (ranges_on_a_circle(1e3, count=10), 1),
                       (ranges_on_a_circle(1e3, count=9), 0),
                       (replace(drive, ticks=0 * drive.ticks), 0), (drive.without("uwb"), 0)):
        assert len(list(files.range_units(few))) == count


LENGTHS = [
    "xy", "xy covariance", "covariance", "xy no ranges", "xy covariance no ranges", "range",
    "range sigma", "sigma", "guess", "range guess", "range sigma guess", "range no markers",
    "range sigma no markers", "guess no markers", "range sigma guess no markers",
    "xy range sigma guess", "xy covariance range sigma", "xy covariance range sigma guess", "radii",
    "base", "radii base no markers no ranges", "xy covariance range sigma guess radii base"]


@pytest.mark.parametrize("factor, count", [(100.0, 2000), (1000.0, 150)])
@pytest.mark.parametrize("what", LENGTHS)
def test_lengths_in_another_unit_are_doubted_or_refused(what, factor, count, tmp_path):
    """Of short drives of 1.5 m and 20 m; in the data they come with a vehicle of table 2."""
    write_dataset(tmp_path / "drive", in_unit(what, factor)(simulated("short", 0)[0].first(count)))
    if "radii" in what or "base" in what:
        with pytest.raises(DatasetError, match="vehicle.toml: expected a number from "):
            read_dataset(tmp_path / "drive")
    else:
        assert set(whats(read_dataset(tmp_path / "drive"))) == {"units"}


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_variances_of_headings_in_square_degrees_are_named(factor):
    """Headings of 0.5 and 1.5 degrees; in radians nobody would state the latter as known."""
    scale = np.array([1.0, 1.0, factor * np.degrees(1)])
    dataset, rng = simulated("short", 0)[0], np.random.default_rng(0)
    a, z = dataset.aruco, dataset.aruco.marker_in_vehicle.copy()
    z[:, 2] += np.sqrt((factor**2 - 1) * a.covariance[:, 2, 2]) * rng.normal(size=len(z))
    doubt, = doubts_before_solving(changed(
        dataset, "aruco", marker_in_vehicle=z, covariance=a.covariance * np.outer(scale, scale)))
    assert doubt.what == "units" and "s_thetatheta" in doubt.sentence


@pytest.mark.parametrize("larger, doubted", [(14.0, False), (16.0, True)])
def test_scatter_is_that_of_the_noise_where_the_vehicle_stands(larger, doubted):
    """Ranges of 5 m with a noise of 0.1 m to two antennas, in any order."""
    rng, count = np.random.default_rng(0), 20_000
    pose = rng.permutation(count)
    ranges = UwbReadings(pose, pose % 2, 5 + 3 * (pose % 2) + rng.normal(0, 0.1, count),
                         np.full(count, 0.1 * larger))
    doubts = list(files.sigma_units(replace(simulated("short", 0)[0], aruco=None, uwb=ranges)))
    assert len(doubts) == doubted
    assert all("scatter by 0.101 at most" in doubt.sentence for doubt in doubts)


def test_ranges_exchanged_with_their_sigmas_are_doubted():
    for count in (150, 2000):
        dataset = simulated("short", 0)[0].first(count)
        doubts = doubts_before_solving(changed(
            dataset, "uwb", range=dataset.uwb.sigma, sigma=dataset.uwb.range))
        assert {doubt.what for doubt in doubts} == {"units"}
        assert all("UwbReading.txt" in doubt.sentence for doubt in doubts)
