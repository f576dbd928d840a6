"""Drives that are not as their files say: the estimate holds, or a doubt names what is wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamlib import localization, se2, slam, solve
from slamlib.dataset import read_dataset, read_truth
from slamlib.evaluation import anees, ate, nees_band
from slamlib.simulation import simulate
from slamlib.studies import montecarlo

SHORT = Path(__file__).parents[1] / "data" / "short"


def aruco(dataset, **changes):
    return replace(dataset, aruco=replace(dataset.aruco, **changes))


def uwb(dataset, **changes):
    return replace(dataset, uwb=replace(dataset.uwb, **changes))


def late(dataset, poses):
    """The dataset with sightings that are late."""
    moved = dataset.aruco.pose + poses
    kept = (moved >= 0) & (moved < len(dataset.ticks))
    return replace(dataset, aruco=replace(dataset.aruco, pose=moved).select(kept))


def larger_wheels(dataset):
    vehicle = dataset.vehicle
    return replace(dataset, vehicle=replace(vehicle, right_radius=0.101, left_radius=0.101))


SIGN = np.array([1, -1, -1])
WRONG_FILES = {                                # found before any graph is built
    "wheels-swapped": lambda d: replace(d, ticks=d.ticks[:, ::-1].copy()),
    "wheels-reversed": lambda d: replace(d, ticks=-d.ticks),
    "camera-mirrored": lambda d: aruco(
        d, marker_in_vehicle=d.aruco.marker_in_vehicle * SIGN,
        covariance=d.aruco.covariance * np.outer(SIGN, SIGN)),
    "odometry": lambda d: replace(d, ticks=np.zeros_like(d.ticks)),
    "units": lambda d: aruco(
        d, marker_in_vehicle=d.aruco.marker_in_vehicle * [1e3, 1e3, 1],
        covariance=d.aruco.covariance * np.outer([1e3, 1e3, 1], [1e3, 1e3, 1]))}
WRONG_SIZES = {                                # found by the graph, and mended but for the wheels
    "covariances a quarter": (lambda d: aruco(d, covariance=d.aruco.covariance / 4),
                              "marker-noise"),
    "covariances fourfold": (lambda d: aruco(d, covariance=d.aruco.covariance * 4),
                             "marker-noise"),
    "sigmas of ranges halved": (lambda d: uwb(d, sigma=d.uwb.sigma / 2), "range-noise"),
    "ranges 1.5 % too long": (lambda d: uwb(d, range=d.uwb.range * 1.015), "range-offset"),
    "wheels 1 % too large": (larger_wheels, "wheel-parameters")}


def uncorrelated(*variances):
    """A change of all sightings: other variances of x, y and heading, and no correlation."""
    return lambda d: aruco(d, covariance=np.broadcast_to(
        np.diag(variances), d.aruco.covariance.shape))


def correlated(i, j, by):
    """A change of all sightings: two coordinates, and no others, are correlated by `by`."""
    def change(d):
        C = d.aruco.covariance * np.eye(3)
        C[:, i, j] = C[:, j, i] = by * np.sqrt(C[:, i, i] * C[:, j, j])
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


def vehicle(**changes):
    return lambda d: replace(d, vehicle=replace(d.vehicle, **changes))


def range_sigmas(sigma):
    return lambda d: uwb(d, sigma=np.full_like(d.uwb.sigma, sigma))


LEGAL = {                                      # within the limits, and far from what is usual
    "an unknown heading of pose 1": vehicle(sigma_heading=10.0),
    "an uncertain heading of pose 1": vehicle(sigma_heading=0.1),
    "a very certain heading of pose 1": vehicle(sigma_heading=1e-9),
    "very certain wheels": vehicle(
        sigma_right_radius=1e-9, sigma_left_radius=1e-9, sigma_wheelbase=1e-9),
    "unknown wheels": vehicle(sigma_right_radius=0.1, sigma_left_radius=0.1, sigma_wheelbase=0.4),
    "a very certain range": one_of("uwb", range_sigmas(1e-7)),
    "the most certain range": one_of("uwb", range_sigmas(1e-9)),
    "the most uncertain ranges": range_sigmas(1e4),
    "the most certain sighting": one_of("aruco", uncorrelated(1e-18, 1e-18, 1e-18)),
    "the most uncertain sightings": uncorrelated(1e8, 1e8, 1e14),
    "a sighting of a direction": one_of("aruco", uncorrelated(1e-18, 1e8, 1e-18)),
    "sightings of a distance": uncorrelated(1e8, 1e-18, 1e14),
    "very certain sightings, and nothing else": lambda d: uncorrelated(1e-18, 1e-18, 1e-18)(
        range_sigmas(1e4)(vehicle(sigma_heading=10.0)(d))),
    "correlations of almost 1": correlated(0, 1, 1 - 1e-11),
    "correlations with heading of almost 1": correlated(1, 2, 1 - 1e-11)}


def names(*lists):
    return {doubt.what for doubts in lists for doubt in doubts}


@pytest.mark.parametrize("seed", [61, 62, 63])
@pytest.mark.parametrize("what", WRONG_FILES)
def test_wrong_files_are_named_before_a_graph_is_built(what, seed):
    dataset, _ = simulate("short", seed)
    assert what in names(localization.drive_doubts(WRONG_FILES[what](dataset)))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [61, 62, 63])
@pytest.mark.parametrize("flaw", WRONG_SIZES)
def test_wrong_sizes_are_mended_or_named(flaw, seed):
    """Problems 3 and 4 on short drives: as accurate as on the right files, and said."""
    dataset, truth = simulate("short", seed)
    spoil, what = WRONG_SIZES[flaw]
    right, spoilt = slam.estimate(dataset.without("uwb")), spoil(dataset)
    markers = slam.estimate(spoilt.without("uwb"))
    both = slam.estimate(spoilt, previous=markers)
    assert names(markers.drive_doubts, both.drive_doubts) == {what}
    assert not localization.drive_doubts(spoilt)
    if what != "wheel-parameters":
        for found in (markers, both):
            assert anees(found.poses, found.covariances, truth.poses) < 6
            assert ate(found.poses, truth.poses, aligned=True) < 1.2 * ate(
                right.poses, truth.poses, aligned=True)


@pytest.mark.parametrize("wrong, said", [
    (dict(right_radius=0.103, left_radius=0.103), "right_radius is"),
    (dict(wheelbase=0.2), "wheelbase is"),
    (dict(ticks_per_revolution=9600.0), "left_radius is")])
def test_wheels_that_are_far_off_are_named_although_slip_explains_the_path(wrong, said):
    for seed in (501, 502):
        dataset, _ = simulate("short", seed)
        spoilt = replace(dataset, uwb=None, vehicle=replace(dataset.vehicle, **wrong))
        doubt, = slam.estimate(spoilt).drive_doubts
        assert doubt.what == "wheel-parameters" and said in doubt.sentence


def test_markers_of_another_size_are_named_with_the_wheels():
    """Lengths by markers 5 % too large: the same as wheels that are larger than stated."""
    dataset, _ = simulate("short", 61)
    z, C = dataset.aruco.marker_in_vehicle * [1.05, 1.05, 1], dataset.aruco.covariance
    doubts = slam.estimate(aruco(dataset, marker_in_vehicle=z, covariance=C)).drive_doubts
    (doubt,) = [doubt for doubt in doubts if doubt.what == "wheel-parameters"]
    assert "ArucoReading.txt are 4." in doubt.sentence and "too small" not in doubt.sentence


@pytest.mark.parametrize("poses", [-3, 3, 10])
def test_sightings_that_are_late_are_named(poses):
    """Three short drives: at three poses the offset is right, at ten it is nearly."""
    for seed in (61, 62, 63):
        dataset, _ = simulate("short", seed)
        found = slam.estimate(late(dataset, poses).without("uwb"))
        offset, sigma = found.camera.time.estimate[0], found.camera.time.sigma[0]
        assert abs(offset - poses) < 3 * sigma < 3
        assert names(found.drive_doubts) == {"time-offset"}


@pytest.mark.parametrize("place", [(0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.05)])
def test_a_camera_that_is_not_in_the_origin_is_named(place):
    dataset, _ = simulate("short", 61)
    z = se2.between(np.array(place), dataset.aruco.marker_in_vehicle)
    C = se2.rotate_covariance(dataset.aruco.covariance, -place[2])
    found = slam.estimate(aruco(dataset, marker_in_vehicle=z, covariance=C).without("uwb"))
    np.testing.assert_allclose(found.camera.place.estimate, place, atol=0.03)
    assert "camera-offset" in names(found.drive_doubts)


@pytest.mark.slow
def test_sightings_that_are_late_are_named_on_the_long_path():
    for seed in (61, 62, 63):
        dataset, _ = simulate("long", seed)
        found = slam.estimate(late(dataset, 3).without("uwb"))
        assert names(found.drive_doubts) == {"time-offset"}


def test_offsets_of_the_camera_have_the_standard_deviations_that_they_state():
    """Twelve clean drives of much and of little slip."""
    offsets = []
    for seed in range(6):
        for slip in (1e-3, 1e-2):
            dataset, _ = simulate("short", seed, slip=slip)
            camera = slam.estimate(dataset.without("uwb")).camera
            offsets.append((*camera.time.estimate / camera.time.sigma, camera.place.gain))
    time, place = np.transpose(offsets)
    low, high = nees_band(12, 1, probability=0.99)
    assert low < np.mean(time**2) < high
    low, high = nees_band(12, 3, probability=0.99)
    assert low < np.mean(2 * place) < high


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.1, 0.15, 0.2])
def test_ranges_that_are_all_too_long_do_no_harm(offset):
    """Four short drives: hardly enough to decide for an offset, but its possibility is counted."""
    nees = []
    for seed in (61, 62, 101, 213):
        dataset, truth = simulate("short", seed)
        found = slam.estimate(uwb(dataset, range=dataset.uwb.range + offset))
        assert anees(found.poses, found.covariances, truth.poses) < 6
        assert names(found.drive_doubts) <= {"range-offset"}
        nees += montecarlo.antenna_error(found, truth)[1].tolist()
    assert np.median(nees) < 6


def test_contradicting_repetitions_count_as_rejected():
    """A second row, a metre off, for 40 % of the sightings."""
    dataset, _ = simulate("short", 61)
    seen = dataset.aruco
    again = seen.select(np.flatnonzero(np.arange(len(seen.pose)) % 5 < 2))
    again = replace(again, marker_in_vehicle=again.marker_in_vehicle + [1, 0, 0])
    both = replace(seen, **{name: np.concatenate([getattr(seen, name), getattr(again, name)])
                            for name in vars(seen)})
    both = both.select(np.argsort(both.pose, kind="stable"))
    found = slam.estimate(replace(dataset, aruco=both, uwb=None))
    doubt, = found.drive_doubts
    assert doubt.what == "sightings-rejected"
    assert f"{2 * len(again.pose)} of them another one of the same marker" in doubt.sentence


@pytest.mark.slow
@pytest.mark.parametrize("slip", [0.0, 1e-3, 1e-2])
@pytest.mark.parametrize("path, seeds", [("short", (71, 72, 73)), ("long", (71,))])
def test_there_is_no_doubt_about_clean_drives(path, seeds, slip):
    for seed in seeds:
        dataset, _ = simulate(path, seed, slip=slip)
        found = slam.estimate(dataset.without("uwb"))
        both = slam.estimate(dataset, previous=found)
        assert not names(localization.drive_doubts(dataset), found.drive_doubts, both.drive_doubts)


def test_markers_of_which_most_sightings_contradict_are_named():
    """The sightings of one marker scatter by a metre."""
    dataset, _ = simulate("short", 61)
    label, count = np.unique(dataset.aruco.marker, return_counts=True)
    moved = label[count.argmax()]
    rows = np.flatnonzero(dataset.aruco.marker == moved)
    z = dataset.aruco.marker_in_vehicle.copy()
    z[rows] += np.random.default_rng(0).normal(0, 1, (len(rows), 3)) * [1, 1, 0]
    found = slam.estimate(aruco(dataset, marker_in_vehicle=z).without("uwb"))
    doubts = [doubt for doubt in found.drive_doubts if doubt.what == "sightings-rejected"]
    assert len(doubts) == 1 and f"marker {moved}" in doubts[0].sentence


@pytest.mark.parametrize("case", LEGAL)
def test_every_problem_is_solved_within_the_limits(case):
    """Finite covariances that are not negative, and of SLAM errors as those that they state."""
    dataset, truth = read_dataset(SHORT), read_truth(SHORT)
    dataset = LEGAL[case](dataset.first(300))
    solve.doubts_about_drive(dataset, truth)                  # without a warning
    for solution in solve.solutions(dataset):
        assert isinstance(solution, solve.Solution), solution.reason
        known = np.isfinite(solution.poses[:, 0])
        variances = np.diagonal(solution.covariances[known], axis1=1, axis2=2)
        assert known.any() and (variances >= 0).all()
        if solution.problem in ("problem3", "problem4"):
            errors = np.abs(solution.poses - truth.poses[:300])
            assert (errors < 5 * np.sqrt(variances) + 0.02).all()


def test_a_solution_that_rounding_spoilt_is_none(monkeypatch):
    dataset, _ = simulate("short", 61)
    dataset = replace(dataset.first(100), uwb=None)
    found = slam.estimate(dataset)
    for name, value in (("covariances", np.nan), ("wheel_covariance", -1e-30),
                        ("marker_covariance", np.inf), ("log_evidence", -np.inf)):
        spoilt = replace(found, **{name: np.full_like(getattr(found, name), value)})
        monkeypatch.setattr(solve.slam, "estimate", lambda _, spoilt=spoilt: spoilt)
        failure, = solve.solutions(dataset, problems=("problem3",))
        assert "float64" in failure.reason and "a variance is negative" in failure.reason
