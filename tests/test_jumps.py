"""Increments of odometry that contradict the markers: found, freed, bridged and told."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from numeric import (
    aligned_ate,
    aruco,
    as_points,
    carried,
    counts,
    mean_nees,
    only,
    seen_from,
    short,
    sightings,
    standing,
    vehicle,
)
from numpy.testing import assert_allclose

from slamlib import estimate
from slamlib.core import se2
from slamlib.core.evaluation import ate
from slamlib.core.odometry import dead_reckoning
from slamlib.core.records import Dataset
from slamlib.robust import jumps
from slamlib.robust.choices import with_stretched
from slamlib.robust.factors import odometry_error, preintegrate_odometry
from slamlib.robust.fused import fuse
from slamlib.robust.initialization import odometry_state
from slamlib.robust.linear import build_problem
from slamlib.robust.measurements import measure
from slamlib.robust.solution_doubts import _encoder_doubts, fusion_doubts, solution_doubts
from slamlib.studies.simulation import TABLE_2, manoeuvre, simulate

drive = cache(simulate)
MARKERS = np.array([[1.0, 0.0, 0.3], [0.5, 0.8, -2.0], [0.0, -1.0, 1.0]])


def seen(poses, markers=MARKERS):
    """A vehicle whose counts are 0 sees all markers from poses (f, 3), one encoder step apart."""
    return looking(np.zeros((len(poses), 2), int), np.arange(len(poses)), poses, markers)


def looking(ticks, frame, poses, markers, sees=np.isfinite):
    """A Dataset of sightings z of markers from poses (f, 3) in frames (f,), of those that `sees`.

    `sees` is a function of their z (f, m, 3).
    """
    z = se2.between(poses[:, None], markers)
    row, marker = np.nonzero(np.all(sees(z), axis=-1))
    readings = sightings(frame[row], marker, z[row, marker], 1e-4 * np.eye(3))
    return Dataset("looks", TABLE_2, ticks, readings, None, None)


def test_a_jump_of_a_vehicle_that_stands_is_found_where_it_is():
    """And a second one; between them, frames that see nothing of the kind."""
    poses = np.zeros((12, 3))
    poses[4:] = [0.4, 0.3, 0.5]
    poses[9:] = [-0.2, 0.3, 0.5]
    found = jumps.find_jumps(seen(poses))
    assert found.start.tolist() == [3, 8] and found.end.tolist() == [4, 9]
    assert_allclose(
        found.increment, se2.between(poses[[3, 8]], poses[[4, 9]]), atol=1e-6)
    assert_allclose(found.by_odometry, 0)
    assert_allclose(found.sigma, [[0.5, 0.5, 0.5], [0.6, 0.6, 0.1]], atol=1e-6)
    assert_allclose(found.mended(np.arange(12), np.zeros((12, 3))), poses, atol=1e-6)


def test_a_step_that_stretches_odometry_is_one_more_jump():
    """The larger one of two; none while poses are those by odometry."""
    poses = np.zeros((12, 3))
    problem = build_problem(measure(seen(poses)), "arc")
    state = odometry_state(problem.measurements, "arc")
    assert with_stretched(SimpleNamespace(problem=problem, state=state)) is None
    poses[4:, :2] = [0.4, 0.3]
    poses[9:, :2] = [0.4, 0.4]
    state = replace(state, poses=poses)
    found = with_stretched(SimpleNamespace(problem=problem, state=state))
    assert found.start.tolist() == [3] and found.end.tolist() == [4]
    assert_allclose(found.increment, [[0.4, 0.3, 0]])
    assert_allclose(found.by_odometry, 0)


@pytest.mark.parametrize("contradicted, dead", [([3], []), ([2, 3, 7], [1, 2, 3, 4, 5, 6, 7])])
def test_a_dead_wheel_by_hand(contradicted, dead):
    """Zeros from row 10 to 26; of the other wheel from 35 on: steps 2 to 4 and 7 are silent."""
    ticks, frame = np.ones((41, 2), int), np.arange(0, 41, 5)
    ticks[10:27, 0] = ticks[35:, 1] = 0
    assert jumps._dead(ticks, frame, contradicted).tolist() == dead


def test_a_jump_is_where_most_contradicting_pairs_span_it():
    """Rooms A, B, again A, B; carried from B to A. No marker is seen from two rooms."""
    poses = np.zeros((40, 3))
    poses[20:] = [0.4, 0.3, 0.5]
    dataset = seen(poses, np.tile(MARKERS, (2, 1)))
    in_room = dataset.aruco.pose // 10 % 2 == dataset.aruco.marker // 3
    found = jumps.find_jumps(only(dataset, in_room))
    assert_allclose(found.mended(np.arange(40), np.zeros((40, 3))), poses, atol=1e-6)


def test_a_jump_is_not_over_a_pair_that_agrees():
    """Rooms A, B, A, then carried to B. The last two frames in A see two different markers."""
    poses = np.zeros((40, 3))
    poses[21:] = [0.4, 0.3, 0.5]
    dataset = seen(poses, np.tile(MARKERS, (2, 1)))
    pose, marker = dataset.aruco.pose, dataset.aruco.marker
    in_b = (pose > 20) | (4 < pose) & (pose < 10)
    is_seen = np.where(np.isin(pose, [19, 20]), marker == pose - 19, marker // 3 == in_b)
    found = jumps.find_jumps(only(dataset, is_seen))
    assert found.start.tolist() == [20] and (found.sigma < jumps.UNKNOWN_SIGMA).all()
    assert_allclose(found.mended(np.arange(40), np.zeros((40, 3))), poses, atol=1e-6)


def test_shares_of_a_jump_by_hand():
    """A jump in one of four steps; in the second of the steps 3, 4, 5 and 6 wheels slip."""
    jump = np.array([0.4, 0.0, 0.2])
    found = jumps.NO_JUMPS.joined_by(2, 6, jump, 0 * jump, count=9)
    start = np.array([0, 2, 3, 0, 6])
    end = np.array([2, 3, 6, 8, 8])
    assert_allclose(found.share(start, end)[:, 0], [0, 0.25, 0.75, 1, 0])
    motion, covariance = found.added(start, end)
    assert_allclose(motion[1], jump / 4)
    assert_allclose(covariance[1], np.diag([0.04, 0.04, 0.01]))
    slips = replace(found, chance=np.cumsum([1, 1, 1, 1, 1e6, 1, 1, 1, 1]))
    assert_allclose(slips.share(start, end)[:, 0], [0, 0, 1, 1, 0], atol=1e-5)


FAULTS = {                                                # and the largest ratio of the ATE
    "carried": (lambda d: carried(d, 1001, 1301), np.inf),
    "pushed by 6 cm": (lambda d: carried(d, 1001, 1007), 1.5),
    "one wheel dead": (counts(slice(1003, 1053), lambda ticks: ticks * [0, 1]), 1.5),
    "dead for a third": (counts(slice(1334, None), lambda ticks: 0 * ticks), 4.0)}


@pytest.fixture(scope="module")
def clean():
    """A drive, its truth, and the aligned ATE of problem 3."""
    dataset, truth = short(3)
    return dataset, truth, aligned_ate(estimate(dataset.without("uwb")), truth)


@pytest.mark.slow
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_of_odometry_is_told_and_costs_little(name, clean):
    fault, most = FAULTS[name]
    dataset, truth = fault(clean[0]), clean[1]
    lost = slice(1001, 1001 + len(truth.poses) - len(dataset.ticks))
    truth = replace(truth, poses=np.delete(truth.poses, lost, axis=0))
    result = estimate(dataset.without("uwb"))
    assert mean_nees(result, truth) < 6 and aligned_ate(result, truth) < most * clean[2]
    told = {doubt.what: doubt.sentence for doubt in solution_doubts(result)}
    assert "between poses 1" in told["encoder"]
    both = estimate(dataset, previous=result)
    assert mean_nees(both, truth) < 6 and both.jumps is result.jumps
    assert mean_nees(fuse(dataset), truth) < 6


def pushed(dataset, truth, pose, motion):
    """The drive whose vehicle somebody moves at a pose, by a motion (3,) in its axes."""
    before = truth.poses[pose]
    after = se2.between(before, truth.poses[pose:])
    poses = truth.poses.copy()
    poses[pose:] = se2.compose(se2.compose(before, motion), after)
    seen_at = dataset.aruco.pose
    back = se2.between(poses[seen_at], truth.poses[seen_at])
    z = se2.compose(back, dataset.aruco.marker_in_vehicle)
    return aruco(dataset, marker_in_vehicle=z), replace(truth, poses=poses)


@pytest.mark.parametrize("pose", [805, 1505])
def test_a_small_push_is_found_with_the_slip_that_was_learned(pose):
    """By 3 cm to the side; ten or twelve sightings were rejected instead, without a word."""
    dataset, truth = short(3, rounds=2)
    dataset, truth = pushed(dataset, truth, pose, np.array([0, 0.03, 0]))
    found = estimate(dataset.without("uwb"))
    assert [doubt.what for doubt in solution_doubts(found)] == ["encoder"]
    assert found.jumps.start < pose <= found.jumps.end
    assert mean_nees(found, truth) < 4 and aligned_ate(found, truth) < 0.0025


def test_a_small_push_is_found_on_a_long_drive():
    """By 3 cm; 16 of 5,366 sightings were rejected without a word, and it was 11 mm off."""
    dataset, truth = pushed(*simulate("long", seed=3), 6001, np.array([0, 0.03, 0]))
    found = estimate(dataset.without("uwb"))
    assert [doubt.what for doubt in solution_doubts(found)] == ["encoder"]
    assert mean_nees(found, truth) < 4 and ate(found.poses, truth.poses) < 0.007


@pytest.mark.parametrize("seed", [6, 7, 8])
def test_the_fusion_finds_small_spins_of_a_wheel_all_at_once(seed):
    """Of 5 cm each; by one of them alone, or none as before, it was 0.8 to 0.9 m off."""
    dataset, truth = short(seed, rounds=2)
    rows = np.concatenate([np.arange(first, first + 10) for first in (803, 1603, 2403)])
    spun = counts(rows, lambda ticks: ticks + [64, 0])(dataset).without("uwb")
    found = fuse(spun)
    assert mean_nees(found, truth) < 6
    assert ate(found.poses, truth.poses) < 1.5 * ate(fuse(dataset).poses, truth.poses)
    assert {doubt.what for doubt in fusion_doubts(found, dataset.vehicle)} == {"encoder"}


@pytest.mark.slow
def test_a_push_that_no_marker_saw_is_found_at_the_solution():
    """In 200 poses without markers, which a second round bridges; else slip seems tenfold."""
    dataset, truth = short(2, rounds=2, slip=3e-4)
    truth = replace(truth, poses=np.delete(truth.poses, slice(1103, 1109), axis=0))
    dataset = carried(dataset, 1103, 1109).without("uwb")
    unseen = np.abs(dataset.aruco.pose - 1140) <= 100
    found = estimate(only(dataset, ~unseen))
    assert [doubt.what for doubt in solution_doubts(found)] == ["encoder"]
    assert found.jumps.start < 1103 < found.jumps.end and found.slip < 5e-4
    assert mean_nees(found, truth) < 6


def test_jumps_are_found_in_the_vehicle_s_axes_of_a_camera_that_is_turned(clean):
    """Its place is stated; in the camera's own axes good increments contradict the markers."""
    dead = FAULTS["one wheel dead"][0](clean[0]).without("uwb")
    turned = vehicle(camera_turn=np.pi / 2)(seen_from(dead, (0.0, 0.0, np.pi / 2)))
    found = estimate(turned)
    assert mean_nees(found, clean[1]) < 6 and aligned_ate(found, clean[1]) < 1.5 * clean[2]


def test_where_all_markers_change_the_later_covariance_is_that_of_not_knowing(clean):
    """After pose 800, at which several markers are near."""
    dataset = clean[0].without("uwb")
    marker = dataset.aruco.marker + 1000 * (dataset.aruco.pose > 800)
    result = estimate(aruco(dataset, marker=marker))
    assert (result.jumps.sigma == jumps.UNKNOWN_SIGMA).all() and len(result.jumps.start) == 1
    sigma = np.sqrt(result.covariances[:, 0, 0])
    assert sigma[800] < 0.1 and sigma[820] > 5
    assert any("all markers change at once" in doubt.sentence for doubt in solution_doubts(result))


def in_a_room(legs, every, sees, lag=0):
    """A Dataset among 120 markers, of those that `sees`, `lag` poses late; and its path (n, 3)."""
    ticks = np.rint(manoeuvre(legs))
    path = dead_reckoning(ticks, TABLE_2, model="arc")
    frame = np.arange(lag, len(path), every)
    rng = np.random.default_rng(3)
    markers = rng.uniform([-3, -3, -np.pi], [5, 5, np.pi], (120, 3))
    drive = looking(ticks, frame, path[frame - lag], markers, sees)
    z = drive.aruco.marker_in_vehicle
    return aruco(drive, marker_in_vehicle=z + 0.01 * rng.standard_normal(z.shape)), path


@pytest.mark.parametrize("stated", [0, 14])
def test_sightings_that_are_late_are_no_jumps_and_start_at_their_delay(stated):
    """Ten poses, on lanes 1.5 m long with sharp turns between them, at which most are wrong."""
    drive, path = in_a_room(
        3 * [(1.5, 0.0), (0.4, np.pi), (1.5, 0.0), (0.4, -np.pi)], every=10, lag=10,
        sees=lambda z: np.linalg.norm(z[..., :2], axis=2, keepdims=True) < 1.0)
    drive = vehicle(sighting_lag=stated)(drive)
    before = jumps.find_jumps(drive)
    assert before.lag == 10 - stated and not len(before.start)
    found = estimate(drive)
    lag, = (row for row in found.calibration_table if row["name"] == "sighting_lag")
    assert found.released == {"time-offset"} and abs(lag["estimate"] - 10) < 4 * lag["sigma"] < 0.5
    assert found.explanations == (frozenset({"time-offset"}),)
    assert ate(found.poses, path) < 3e-3 and found.rejected.mean() < 0.01


def test_images_that_are_late_alone_or_in_a_row_are_no_jumps():
    """Odometry contradicts their sightings where they begin and, the other way, where they end."""
    clean = short(seed=21)[0].without("uwb")
    image = clean.aruco.pose // 10                       # 10 poses from one to the next
    late = np.isin(image, [20, 40, 60, 80, 100, 120, 121, 122, 140, 160])
    readings = replace(clean.aruco, pose=clean.aruco.pose + np.where(late, 6, 0))
    assert len(jumps.find_jumps(replace(clean, aruco=readings)).start) == 0



@pytest.mark.parametrize("change", [
    lambda a: a, lambda a: replace(a, covariance=a.covariance / 16),
    lambda a: replace(a, pose=a.pose + 8).select(a.pose < a.pose.max() - 8),
    lambda a: as_points(a, slice(None))])
@pytest.mark.parametrize("options", [
    {}, {"slip": 0.0}, {"slip": 1e-2}, {"mislabelled": 0.03}])
def test_no_jump_in_clean_drives(change, options):
    for path, seed in (("short", 0), ("short", 1), ("short", 2), ("long", 0)):
        dataset, _ = drive(path, seed=seed, **options)
        assert not len(jumps.find_jumps(replace(dataset, aruco=change(dataset.aruco))).start)


def test_two_wrong_labels_of_the_first_image_that_agree_are_no_jump():
    """It would spare both: pose 1 alone can be anywhere. But it rejects a right one."""
    dataset = short(22, mislabelled=0.15)[0].without("uwb")
    assert len(jumps.find_jumps(dataset).start) == 1
    assert not len(estimate(dataset).jumps.start)


def test_turns_on_the_spot_under_a_camera_that_looks_ahead_are_no_breaks():
    """Within a frame or two all markers leave the image, and others come."""
    def ahead(z):
        x, y = z[..., :1], z[..., 1:2]
        return (0.2 < x) & (x < 1.9) & (np.abs(y) < 0.4 + 0.4 * x)

    drive, _ = in_a_room(3 * [(2.0, 0.0), (0.0, 2 * np.pi / 3)], every=30, sees=ahead)
    assert not len(jumps.find_jumps(drive).start)


def test_the_doubt_names_three_stretches_and_counts_the_others():
    """The second one is two jumps, four poses apart."""
    poses = np.zeros((300, 3))
    poses[:, 0] = 0.3 * (np.arange(300) // 50 % 2)
    poses[100:104, 0] = 0.9
    result = SimpleNamespace(jumps=jumps.find_jumps(seen(poses)))
    sentence, = (doubt.sentence for doubt in _encoder_doubts(result))
    assert "between poses 50 and 51 the vehicle moved by 0.00 m and 0°, but the markers " \
        "say 0.30 m and 0°, which ends 0.30 m" in sentence
    assert sentence.count("between") == 3 and "and 2 more times" in sentence


@pytest.mark.parametrize("count", [2, 10])
def test_counts_that_creep_while_the_vehicle_stands_say_nothing(count):
    """10 of 127 usual counts a row: half a metre in 600 rows. Believed, they cost 0.15 m."""
    dataset, poses = standing(*short(1), rows=600, count=count, at=600, every=10)
    found = estimate(dataset)
    truth = SimpleNamespace(poses=poses)
    assert aligned_ate(found, truth) < 4e-3 and mean_nees(found, truth) < 5
    assert not solution_doubts(found)


def test_odometry_tells_no_length_not_even_where_counts_creep_at_a_stand():
    """Wheels and distances that are longer by one factor leave the errors in counts as they are."""
    dataset, poses = standing(*short(1), rows=100, count=10, at=600)
    measurements = measure(dataset)
    assert measurements.crawls.any()
    wheel = dataset.vehicle.wheel
    poses = poses[measurements.frame]

    def errors(factor, linearised):
        odometry = preintegrate_odometry(measurements, "arc", linearised * wheel)
        e = odometry_error(odometry, poses * [factor, factor, 1], factor * wheel)[0]
        return e, odometry.covariance(1e-3)

    e, Q = errors(1.0, linearised=1.0)
    for linearised in (1.0, 1.1):
        longer = errors(1.1, linearised)
        assert_allclose(longer[0], e, atol=1e-12)
        assert_allclose(longer[1], Q, atol=1e-16)


def test_sightings_that_are_noisier_far_away_are_no_jump():
    """Beyond 1.2 m by five stated standard deviations: some neighbours disagree with odometry."""
    clean = short(11)[0].without("uwb")
    z = clean.aruco.marker_in_vehicle
    errors = np.random.default_rng(5).normal(size=z.shape)
    far = np.hypot(z[:, 0], z[:, 1]) > 1.2
    noisy = z + 5 * far[:, None] * errors * se2.sigmas(clean.aruco.covariance)
    spoilt = aruco(clean, marker_in_vehicle=noisy)
    assert len(jumps.find_jumps(spoilt).start)
    found = estimate(spoilt)
    assert not len(found.jumps.start)
    assert "encoder" not in [doubt.what for doubt in solution_doubts(found)]


def test_a_vehicle_crawls_below_a_tenth_of_its_usual_speed():
    ticks = np.array([[0, 0], [100, 100], [100, 100], [9, 0], [0, -21], [0, 0]])
    found = jumps.crawls(ticks, np.arange(5), np.arange(1, 6))
    assert found.tolist() == [False, False, True, False, True]
