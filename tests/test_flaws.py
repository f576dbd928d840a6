"""Drives that are not as their files say: the estimate holds, or a doubt names what is wrong."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numeric import known_noise

from slamlib import se2, slam, solve
from slamlib.checks.files import doubts_before_solving
from slamlib.dataset import Vehicle, read_dataset, read_truth
from slamlib.evaluation import anees, ate, nees_band
from slamlib.simulation import simulate
from slamlib.slam import drive_doubts
from slamlib.slam.calibrations import CameraOffsets, SharedError, _estimate, _velocities
from slamlib.slam.measurements import Noise
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
    "covariances a hundredth": (lambda d: aruco(d, covariance=d.aruco.covariance / 100),
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
    assert what in names(doubts_before_solving(WRONG_FILES[what](dataset)))


@cache
def by_right_files(seed):
    """SlamResult of problem 3 on the short drive whose files are right."""
    return slam.estimate(simulate("short", seed)[0].without("uwb"))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [61, 62, 63])
@pytest.mark.parametrize("flaw", WRONG_SIZES)
def test_wrong_sizes_are_mended_or_named(flaw, seed):
    """Problems 3 and 4 on short drives: as accurate as on the right files, and said."""
    dataset, truth = simulate("short", seed)
    spoil, what = WRONG_SIZES[flaw]
    right, spoilt = by_right_files(seed), spoil(dataset)
    of_ranges = spoilt.aruco is dataset.aruco and spoilt.vehicle is dataset.vehicle
    markers = right if of_ranges else slam.estimate(spoilt.without("uwb"))
    both = slam.estimate(spoilt, previous=markers)
    assert names(markers.drive_doubts, both.drive_doubts) == {what}
    assert not doubts_before_solving(spoilt)
    if what != "wheel-parameters":
        for found in (markers, both):
            assert anees(found.poses, found.covariances, truth.poses) < 6
            assert ate(found.poses, truth.poses, aligned=True) < 1.2 * ate(
                right.poses, truth.poses, aligned=True)


@pytest.mark.slow
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


def test_a_slip_that_was_given_is_not_explained_by_other_wheels():
    """Radii 3 % off: only a slip that was learned is a reason to try other wheels."""
    dataset = simulate("short", 501)[0].without("uwb").first(800)
    spoilt = replace(dataset, vehicle=replace(dataset.vehicle, right_radius=0.103,
                                              left_radius=0.103))
    assert "wheel-parameters" in names(slam.estimate(spoilt).drive_doubts)
    given = slam.estimate(known_noise(spoilt, 1e-2), model="arc")
    assert given.slip == 1e-2 and "wheel-parameters" not in names(given.drive_doubts)


@pytest.mark.slow
def test_markers_of_another_size_are_named_with_the_wheels():
    """Lengths by markers 5 % too large: the same as wheels that are larger than stated."""
    dataset, _ = simulate("short", 61)
    z, C = dataset.aruco.marker_in_vehicle * [1.05, 1.05, 1], dataset.aruco.covariance
    doubts = slam.estimate(aruco(dataset, marker_in_vehicle=z, covariance=C)).drive_doubts
    (doubt,) = [doubt for doubt in doubts if doubt.what == "wheel-parameters"]
    assert "ArucoReading.txt are 4." in doubt.sentence and "too small" not in doubt.sentence


@pytest.mark.slow
@pytest.mark.parametrize("poses", [-3, 3, 10])
def test_sightings_that_are_late_are_named(poses):
    """Three short drives: at three poses the offset is right, at ten it is nearly."""
    for seed in (61, 62, 63):
        dataset, _ = simulate("short", seed)
        found = slam.estimate(late(dataset, poses).without("uwb"))
        offset, sigma = found.camera.time.estimate[0], found.camera.time.sigma[0]
        assert abs(offset - poses) < 3 * sigma < 3
        assert names(found.drive_doubts) == {"time-offset"}


@pytest.mark.slow
@pytest.mark.parametrize("place", [(0.1, 0.0, 0.0), (0.0, 0.1, 0.0), (0.0, 0.0, 0.05)])
def test_a_camera_that_is_not_in_the_origin_is_named(place):
    dataset, _ = simulate("short", 61)
    z = se2.between(np.array(place), dataset.aruco.marker_in_vehicle)
    C = se2.rotate_covariance(dataset.aruco.covariance, -place[2])
    found = slam.estimate(aruco(dataset, marker_in_vehicle=z, covariance=C).without("uwb"))
    np.testing.assert_allclose(found.camera.place.estimate, place, atol=0.03)
    assert "camera-offset" in names(found.drive_doubts)


def test_without_sightings_nothing_is_known_of_the_camera():
    dataset = known_noise(simulate("short", 61)[0].first(300).without("aruco"), 1e-3)
    found = slam.estimate(dataset, model="arc")
    for error, count in ((found.camera.time, 1), (found.camera.place, 3)):
        np.testing.assert_array_equal(error.estimate, np.zeros(count))
        np.testing.assert_array_equal(error.sigma, np.full(count, np.inf))
        assert error.gain == 0


@pytest.mark.slow
def test_sightings_that_are_late_are_named_on_the_long_path():
    for seed in (61, 62, 63):
        dataset, _ = simulate("long", seed)
        found = slam.estimate(late(dataset, 3).without("uwb"))
        assert names(found.drive_doubts) == {"time-offset"}


@pytest.mark.slow
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
        assert not names(doubts_before_solving(dataset), found.drive_doubts,
                         both.drive_doubts)


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


@pytest.mark.slow
@pytest.mark.parametrize("case", LEGAL)
def test_every_problem_is_solved_within_the_limits(case):
    """Finite covariances that are not negative, and of SLAM errors as those that they state."""
    dataset, truth = read_dataset(SHORT), read_truth(SHORT)
    dataset = LEGAL[case](dataset.first(300))
    doubts_before_solving(dataset, truth)                  # without a warning
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


def late_by(poses, sigma=0.2, gain=20.0):
    return SharedError(np.array([poses]), np.array([sigma]), gain)


def placed_at(x=0.0, y=0.0, turn=0.0, gain=0.0):
    return SharedError(np.array([x, y, turn]), np.array([0.001, 0.002, 0.003]), gain)


def solved(noise=(1e-3, 1.0, 1.0), noise_sigma=(0.1, 0.02, 0.03), late=0.0, **changes):
    """What the doubts read of a SlamResult that agrees with its files, but for these changes."""
    return SimpleNamespace(**dict(
        wheel=Vehicle().wheel, noise=Noise(*noise), slip=noise[0],
        noise_sigma=np.array(noise_sigma), range_weight=np.repeat([0.0, 1.0], [0, 20]),
        range_calibration=np.array([0.0, 1.0]), range_calibration_covariance=np.zeros((2, 2)),
        range_calibration_sigma=np.zeros(2), doubts={},
        camera=CameraOffsets(late_by(late, gain=0.0), placed_at())) | changes)


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
        doubts = drive_doubts.noise_doubts(solved(noise, sigmas))
        assert len(doubts) == (said is not None)
        if said:
            assert f"The {name} {said} as much as {file} states" in doubts[0].sentence
            assert "covariances were obtained" in doubts[0].sentence


@pytest.mark.parametrize("late, reason", [
    (1, "covariances were obtained"), (2, "covariances were obtained"),
    (3, "15% of them are far too long")])
def test_late_ranges_are_the_reason_for_their_scatter_if_they_are_more_than_a_tenth(late, reason):
    weight = np.repeat([0.4, 0.6], [late, 20 - late])
    doubt, = drive_doubts.noise_doubts(solved((1e-3, 1.0, 2.0), range_weight=weight))
    assert doubt.what == "range-noise" and reason in doubt.sentence
    doubt, = drive_doubts.noise_doubts(solved((1e-3, 2.0, 1.0), range_weight=weight))
    assert doubt.what == "marker-noise" and "covariances were obtained" in doubt.sentence


@pytest.mark.parametrize("factor, sigma, said", [
    (1.05, 0.01, "are confirmed (factor 1.05 ± 0.01)"), (0.95, 0.01, "are confirmed"),
    (1.2, 0.1, "are confirmed"), (1.2, 0.05, "were multiplied by 1.20 ± 0.06"),
    (0.8, 0.05, "were multiplied by 0.80 ± 0.04"), (1.0, 0.0, "are multiplied by 1, as given"),
    (0.75, 0.0, "are multiplied by 0.75, as given")])
def test_stated_noise_is_confirmed_within_a_tenth_or_three_standard_deviations(
        factor, sigma, said):
    assert said in slam.confirmation(solved((1e-3, factor, 9.0), (9.0, sigma, 9.0)), "sightings")
    assert said in slam.confirmation(solved((1e-3, 9.0, factor), (9.0, 9.0, sigma)), "ranges")


@pytest.mark.parametrize("time, said", [
    (late_by(3.0), "3.0 ± 0.2 poses late"), (late_by(-3.0), "3.0 ± 0.2 poses early"),
    (late_by(0.6), "0.6 ± 0.2 poses late"), (late_by(12.0), "12 poses or more late"),
    (late_by(0.4), None), (late_by(3.0, gain=6.0), None)])
def test_late_sightings_are_named_from_half_a_pose_on(time, said):
    doubts = drive_doubts.geometry_doubts(Vehicle(), solved(camera=CameraOffsets(
        time, placed_at())))
    assert [doubt.what for doubt in doubts] == ["time-offset"] * (said is not None)
    if said:
        assert said in doubts[0].sentence
        assert f"too {'small' if 'early' in said else 'large'}" in doubts[0].sentence


@pytest.mark.parametrize("place, named", [
    (placed_at(x=0.01, gain=9.0), True), (placed_at(y=-0.01, gain=9.0), True),
    (placed_at(turn=0.01, gain=9.0), True), (placed_at(0.004, -0.004, 0.004, 9.0), False),
    (placed_at(x=0.01, gain=8.8), False)])
def test_a_camera_elsewhere_is_named_from_five_millimetres_on(place, named):
    doubts = drive_doubts.geometry_doubts(Vehicle(), solved(camera=CameraOffsets(
        late_by(0.0, gain=0.0), place)))
    assert [doubt.what for doubt in doubts] == ["camera-offset"] * named
    if named:
        assert "x = {:.3f} ± 0.001 m, y = {:.3f} ± 0.002 m and turned by {:.3f} ± 0.003".format(
            *place.estimate) in doubts[0].sentence


def test_of_explanations_that_exclude_each_other_the_likeliest_are_named():
    """One of them alone if it leads by more than NEARLY; a wheel k sigmas off costs k^2 / 2."""
    late, wheels = "time-offset", "wheel-parameters"
    for gain, expected in ((30.0, [late]), (20.0, [late, wheels]), (15.0, [wheels, late]),
                           (10.0, [wheels])):
        found = solved(wheel=np.array([0.1, 0.1, 0.4006]), camera=CameraOffsets(
            late_by(3.0, gain=gain), placed_at()))
        doubts = drive_doubts.geometry_doubts(Vehicle(), found)
        assert [doubt.what for doubt in doubts] == expected, gain


def test_wheels_that_are_far_off_are_given_in_millimetres_and_standard_deviations():
    wheel = np.array([0.1005, 0.0997, 0.3994])                      # 5, -3 and -6 sigmas
    doubt, = drive_doubts.geometry_doubts(Vehicle(), solved(wheel=wheel))
    assert "right_radius is 100.5 mm (stated: 100.0 ± 0.1 mm) and wheelbase is 399.4 mm" \
        in doubt.sentence and "left_radius" not in doubt.sentence
    assert "up to 6 standard deviations" in doubt.sentence
    assert not drive_doubts.geometry_doubts(Vehicle(), solved(wheel=Vehicle().wheel - 3e-4))


@pytest.mark.parametrize("radii, said", [
    ((0.105, 0.105), "5.0% too large"), ((0.095, 0.095), "5.0% too small"),
    ((0.106, 0.104), "5.0% too large"), ((0.106, 0.102), ""), ((0.105, 0.1), "")])
def test_radii_that_are_off_by_one_factor_may_be_the_size_of_the_markers(radii, said):
    sentence = drive_doubts.marker_size(Vehicle(), np.array([*radii, 0.5]))
    assert said in sentence and bool(sentence) == bool(said)


def test_slip_that_no_wheel_has_is_named_unless_it_was_given():
    doubt, = drive_doubts.slip_doubts(solved((0.03, 1.0, 1.0)))
    assert "slips by 30 mm" in doubt.sentence
    assert not drive_doubts.slip_doubts(solved((0.02, 1.0, 1.0)))
    assert not drive_doubts.slip_doubts(solved((0.03, 1.0, 1.0), np.zeros(3)))


@pytest.mark.parametrize("offset, scale, named", [
    (0.40, 1.0, True), (-0.40, 1.0, True), (0.38, 1.0, False), (0.0, 1.04, True),
    (0.0, 1.038, False), (0.3, 1.03, True)])
def test_ranges_are_named_as_not_as_stated_from_a_decisive_gain_on(offset, scale, named):
    """Sigmas of 0.1 m and 0.01: half the squared distance from [0, 1] must exceed 7.6."""
    found = solved(range_calibration=np.array([offset, scale]),
                   range_calibration_covariance=np.diag([0.1**2, 0.01**2]),
                   range_calibration_sigma=np.array([0.1, 0.01]))
    doubts = drive_doubts.calibration_doubts(found)
    assert len(doubts) == named
    if named:
        assert f"are {offset:.3f} ± 0.100 m plus {scale:.4f} ± 0.0100 times" in doubts[0].sentence


def test_many_rejected_sightings_and_markers_of_which_most_are_rejected_are_named():
    """Sightings of markers 11, 12 and 13: ten, four and forty; of 13 hardly any is rejected."""
    label = np.repeat([0, 1, 2], [10, 4, 40])
    measurements = SimpleNamespace(marker_row=label, marker=np.array([11, 12, 13]),
                                   sightings=SimpleNamespace(contradicting=0))

    def said(*rejected_of_each):
        rejected = np.concatenate([np.arange(np.sum(label == k)) < count
                                   for k, count in enumerate(rejected_of_each)])
        return [doubt.sentence for doubt in drive_doubts.sighting_doubts(measurements, rejected)]

    assert said(5, 0, 0) == [] and said(0, 4, 1) == []
    sentence, = said(6, 0, 0)
    assert "6 of 54 sightings contradict" in sentence and "of marker 11 contradict" in sentence
    sentence, = said(0, 4, 2)
    assert "6 of 54 sightings contradict" in sentence and "of marker" not in sentence
    sentence, = said(6, 4, 21)
    assert "31 of 54 sightings" in sentence and "of markers 11, 13 contradict" in sentence


def test_a_turn_that_the_wheels_hardly_know_is_named_where_it_is():
    """Turns to 0.3, 1.3 and 1.2 rad: by the wheel parameters and, in quadrature, by slip."""
    by_w = np.zeros((3, 3, 3))
    by_w[:, 2] = [[0.3, 0, 0], [0.3, 0.4, 0], [0, 0, 1.2]]

    def problem(slip):
        return SimpleNamespace(
            measurements=SimpleNamespace(frame=np.array([0, 10, 30, 70])),
            noise=SimpleNamespace(slip=slip), odometry=SimpleNamespace(
                J_w=by_w,
                covariance=lambda slip: np.diag([0, 0, slip**2]) * [[[0]], [[1]], [[0]]]))

    doubt, = drive_doubts.turn_doubts(problem(1.2))
    assert "Between poses 11 and 31" in doubt.sentence and "to 1.3 rad" in doubt.sentence
    doubt, = drive_doubts.turn_doubts(problem(0.1))
    assert "Between poses 31 and 71" in doubt.sentence and "to 1.2 rad" in doubt.sentence
    by_w[2, 2] = 0
    assert not drive_doubts.turn_doubts(problem(0.1))


def test_the_velocity_at_a_frame_is_that_over_the_frames_around_it():
    """Straight ahead at 2 cm per step, frames that are not evenly spaced; at the ends one-sided."""
    frame = np.array([0, 5, 6, 20, 21, 22, 40, 50, 90])
    poses = np.column_stack([0.02 * frame * np.cos(0.5), 0.02 * frame * np.sin(0.5),
                             np.full(len(frame), 0.5)])
    found = _velocities(SimpleNamespace(frame=frame), SimpleNamespace(poses=poses))
    np.testing.assert_allclose(found, np.tile([0.02, 0, 0], (len(frame), 1)), atol=1e-15)
    poses[4:] += [1.0, 0, 0]                       # a jump, which three frames to each side see
    found = _velocities(SimpleNamespace(frame=frame), SimpleNamespace(poses=poses))
    jumped = np.flatnonzero(np.hypot(*(found[:, :2] - [0.02, 0]).T) > 1e-12)
    np.testing.assert_array_equal(jumped, [1, 2, 3, 4, 5, 6])
    standing = _velocities(SimpleNamespace(frame=np.array([3])), SimpleNamespace(poses=poses[:1]))
    np.testing.assert_array_equal(standing, [[0, 0, 0]])


def test_a_shared_error_is_estimated_by_the_information_that_others_leave():
    """Estimate -C g, log likelihood g^T C g / 2; nothing where others explain it all."""
    information = np.array([[4.0, 1.0], [1.0, 9.0]]) * 1e4
    gradient, C = np.array([300.0, -200.0]), np.linalg.inv(information)
    found = _estimate(2 * information, information, gradient)
    np.testing.assert_allclose(found.estimate, -C @ gradient)
    np.testing.assert_allclose(found.sigma, np.sqrt(np.diag(C)))
    assert np.isclose(found.gain, gradient @ C @ gradient / 2)
    nothing = _estimate(information, 1e-12 * information, gradient)
    assert nothing.gain == 0 and not nothing.estimate.any() and np.isinf(nothing.sigma).all()
