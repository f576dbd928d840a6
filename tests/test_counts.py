"""Counts since the start and exchanged columns are found where that is certain, and only there."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_dataset import error_of, write

from slamlib import counts
from slamlib.checks.files import doubts_before_solving
from slamlib.dataset import Vehicle, read_dataset
from slamlib.simulation import manoeuvre, simulate, write_dataset

simulated = cache(simulate)


def cut(dataset, begin, count):
    """A part of a drive, with the sightings in it."""
    ticks, seen = dataset.ticks[begin:begin + count].copy(), dataset.aruco
    ticks[0] = 0
    seen = seen.select((seen.pose >= begin) & (seen.pose < begin + count))
    return replace(dataset, ticks=ticks, uwb=None, antenna_guess=None,
                   aruco=replace(seen, pose=seen.pose - begin) if len(seen.pose) else None)


@pytest.mark.slow
def test_real_increments_are_never_taken_for_counts_since_the_start():
    """Two hundred drives, cuts of them, and the same driven backward; no doubt either."""
    rng = np.random.default_rng(0)
    for seed in range(200):
        drive, _ = simulate("short", seed, slip=rng.choice([0, 1e-3, 1e-2]))
        lengths = rng.choice([5, 10, 50, 200, 1000], 3)
        for part in (drive, *(cut(drive, rng.integers(2000 - n), n) for n in lengths)):
            for ticks in (part.ticks, -part.ticks):
                assert counts.cumulative_reason(ticks, part.vehicle, part.aruco) == ""
                assert not counts.may_be_cumulative(ticks, part.vehicle)
                assert not counts.jumps(ticks).any()


DRIVES = {
    "at constant speed": np.full((100, 2), 132), "on the spot": np.tile([50, -50], (100, 1)),
    "with one wheel still": np.tile([0, 132], (100, 1)), "not at all": np.zeros((100, 2)),
    "from rest to constant speed": np.minimum(np.arange(100), 40)[:, None] * [3, 3],
    "after a rest": np.repeat([[0, 0], [132, 90]], 50, axis=0),
    "to and fro": np.repeat([[132, 132], [-132, -132]], 50, axis=0),
    "fast": np.full((100, 2), 79_999), "with one wrong row": np.r_[
        np.full((50, 2), 132), [[79_999, 132]], np.full((50, 2), 132)]}


@pytest.mark.parametrize("drive", DRIVES)
def test_increments_of_any_drive_are_taken_as_such(drive, tmp_path):
    ticks = np.r_[np.zeros((1, 2)), DRIVES[drive]].astype(int)
    write(tmp_path / "encoderReading.txt", "\n".join(
        f"{i} {right} {left}" for i, (right, left) in enumerate(ticks, start=1)))
    dataset = read_dataset(tmp_path)
    np.testing.assert_array_equal(dataset.ticks, ticks)
    assert dataset.notes == () and doubts_before_solving(dataset) == []


def slow(dataset, factor=20):
    """The drive at a speed that is smaller by a factor."""
    total = np.repeat(dataset.ticks, factor, axis=0)[factor - 1:].cumsum(axis=0) // factor
    seen = dataset.aruco
    return replace(dataset, ticks=np.diff(total, axis=0, prepend=total[:1]), uwb=None,
                   aruco=replace(seen, pose=seen.pose * factor))


def resting(dataset):
    """The drive with a rest in the middle of its first 200 poses."""
    drive, rest = cut(dataset, 0, 200), 300
    seen = drive.aruco
    return replace(drive, ticks=np.insert(drive.ticks, 100, np.zeros((rest, 2), int), axis=0),
                   aruco=replace(seen, pose=np.where(seen.pose < 100, seen.pose, seen.pose + rest)))


RUN_ON = {                               # a drive, and what its counts since the start begin with
    "a whole drive": (lambda d: d, 0, "one row has"),
    "a counter that does not begin at zero": (lambda d: d, [123456, -7], "one row has"),
    "200 poses": (lambda d: cut(d, 0, 200), 0, "between sightings of a marker"),
    "from another count": (lambda d: cut(d, 0, 200), [32311, 29874],
                           "between sightings of a marker"),
    "backward": (lambda d: replace(cut(d, 0, 200), ticks=-cut(d, 0, 200).ticks), 0, "between"),
    "a slow drive": (lambda d: cut(slow(d), 0, 3000), 0, "between sightings of a marker"),
    "a rest": (resting, 0, "between sightings of a marker")}


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("case", RUN_ON)
def test_counts_since_the_start_are_differenced_with_a_note(case, seed, tmp_path):
    change, begin, reason = RUN_ON[case]
    dataset = change(simulated("short", seed)[0])
    write_dataset(tmp_path / "drive", replace(
        dataset, ticks=dataset.ticks.cumsum(axis=0) + np.array(begin)))
    found = read_dataset(tmp_path / "drive")
    np.testing.assert_array_equal(found.ticks, dataset.ticks)
    note, = found.notes
    assert note.startswith(f"encoderReading.txt holds counts since the start ({reason}")
    assert doubts_before_solving(found) == doubts_before_solving(dataset)


@pytest.mark.parametrize("begin, low", [(60_000, 0), (30_000, -2**15), (3000, 0)])
@pytest.mark.parametrize("sign", [1, -1])
def test_counters_of_16_bits_overflow(begin, low, sign, tmp_path):
    drive = simulated("short", 0)[0]
    ticks = sign * drive.ticks[:500]
    counter = (ticks.cumsum(axis=0) + begin - low) % 2**16 + low
    assert abs(np.diff(counter, axis=0)).max() > 2**15
    write(tmp_path / "encoderReading.txt", "\n".join(
        f"{i} {right} {left}" for i, (right, left) in enumerate(counter, start=1)))
    dataset = read_dataset(tmp_path)
    np.testing.assert_array_equal(dataset.ticks, ticks)
    assert "they overflow at 16 bits" in dataset.notes[0]


@pytest.mark.parametrize("change", [
    *(lambda d, n=n: cut(d, 0, n) for n in (5, 8, 50, 200)), resting,
    lambda d: replace(cut(d, 0, 200), ticks=-cut(d, 0, 200).ticks)])
def test_undecided_counts_are_doubted(change):
    """Without markers: a vehicle that speeds up for as long is possible, but not likely."""
    drive = change(simulated("short", 0)[0])
    drive = replace(drive, aruco=None, ticks=drive.ticks.cumsum(axis=0))
    assert counts.cumulative_reason(drive.ticks, drive.vehicle, None) == ""
    doubt, = doubts_before_solving(drive)
    assert doubt.what == "counts-since-start"
    assert f"up to {abs(drive.ticks).max()} in one row" in doubt.sentence


def restarted(counter, row):
    return np.r_[counter[:row], counter[row:] - counter[row]]


def without(counter, begin, end):
    return np.r_[counter[:begin], counter[end:]]


JUMPS = {        # what happens to a counter, and the first line that jumps, where it is known
    "restart after 5 rows": (lambda c: restarted(c, 5), 6),
    "restart after 300 rows": (lambda c: restarted(c, 300), 301),
    "restart after 1000 rows": (lambda c: restarted(c, 1000), 1001),
    "two restarts": (lambda c: restarted(restarted(c, 1000), 300), 301),
    "lost rows": (lambda c: without(c, 150, 200), 151),
    "a count at the start": (lambda c: np.r_[c[:1], c[1:] + 30_000], 2),
    **{f"modulo {m}": (lambda c, m=m: c % m, None) for m in (8000, 2**13, 2**14, 2**15, 2**17)},
    "15 bits with a sign": (lambda c: (c + 2**14) % 2**15 - 2**14, None)}


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("case", JUMPS)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_counter_that_jumps_is_refused(case, seed, sign, tmp_path):
    """The reader gives no step of thousands of counts to a wheel that makes hundreds."""
    change, line = JUMPS[case]
    drive = simulated("short", seed)[0]
    counter = change(sign * drive.ticks.cumsum(axis=0))
    step = np.diff(counter, axis=0)
    row = 1 + np.flatnonzero((abs(step) > 2 * abs(drive.ticks).max()).any(axis=1))[0]
    assert line in (None, row + 1)
    wheel = np.argmax(abs(step[row - 1]) > 2 * abs(drive.ticks).max())
    seen = drive.aruco.select(drive.aruco.pose < len(counter))
    write_dataset(tmp_path / "drive", replace(drive, ticks=counter, aruco=seen, uwb=None))
    assert (f"encoderReading.txt, line {row + 1}: expected counts since the start that run on, but "
            f"from the row before, the count jumps from {counter[row - 1, wheel]} to "
            f"{counter[row, wheel]}: the counter restarted or overflowed, or rows are missing, "
            f"found '{row + 1} ") in error_of(read_dataset, tmp_path / "drive")


def forth(rows=300):
    """Counts since the pose before of a drive with rounding and a slip of the wheels."""
    slip = np.random.default_rng(0).normal(0, 2, (rows, 2)).cumsum(axis=0) / 10
    return np.r_[[[0, 0]], np.rint(132 + slip)].astype(int)


@pytest.mark.parametrize("ticks", [
    np.r_[forth(), np.zeros((300, 2), int)], np.r_[forth(), -forth()],
    np.r_[forth(), np.zeros((1000, 2), int), forth(100)], [1, -1] * forth(), [1, 0] * forth(),
    -np.r_[forth(50), np.zeros((50, 2), int)]],
    ids=["stands at the end", "to and fro", "stops", "on the spot", "one wheel", "backward"])
@pytest.mark.parametrize("change", [
    lambda c: c, lambda c: restarted(c, 250 if len(c) > 250 else 90),
    lambda c: (c + 2**13) % 2**14 - 2**13],
    ids=["as it is", "restarted", "overflows"])
def test_undecided_counts_of_a_vehicle_that_stops_or_turns_back_are_doubted(
        ticks, change, tmp_path):
    """Without markers, and without a row of more than 10 revolutions."""
    counter = change(ticks.cumsum(axis=0))
    write(tmp_path / "encoderReading.txt", "\n".join(
        f"{i} {right} {left}" for i, (right, left) in enumerate(counter, start=1)))
    dataset = read_dataset(tmp_path)
    np.testing.assert_array_equal(dataset.ticks, counter)
    doubt, = doubts_before_solving(dataset)
    assert doubt.what == "counts-since-start"
    assert f"change gradually from row to row, up to {abs(counter).max()} in" in doubt.sentence


def test_manoeuvres_are_never_taken_for_counts_since_the_start():
    """Two hundred open paths with rests and turns back, at 1 cm to 1 m in a step, with noise."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        legs = [(rng.uniform(-5, 10), rng.uniform(-3, 3)) for _ in range(rng.integers(1, 6))]
        total = manoeuvre(legs, step=rng.choice([0.01, 0.1, 1.0])).cumsum(axis=0)
        ticks = np.diff(np.rint(total), axis=0, prepend=0).astype(int)
        rest = np.zeros((rng.integers(100), 2), int)
        ticks = np.insert(ticks, [rng.integers(1, len(ticks) + 1)] * len(rest), rest, axis=0)
        assert counts.cumulative_reason(ticks, Vehicle(), None) == ""
        assert not counts.may_be_cumulative(ticks, Vehicle())
        assert not counts.jumps(ticks).any()


def test_fast_increments_are_not_doubted_at_a_speed_that_varies():
    """From rest to 2.5 revolutions in a step, which then vary by 1 %."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        speed = np.minimum(np.arange(400), 40)[:, None] * [500, 490]
        ticks = np.rint(speed * (1 + rng.normal(0, 0.01, (400, 2)))).astype(int)
        assert not counts.may_be_cumulative(ticks, Vehicle())


def test_counts_that_end_above_the_bound_by_a_leap_are_refused(tmp_path):
    """One wrong row is no counter."""
    ticks = np.r_[np.full((50, 2), 132), [[99_999, 132]], np.full((50, 2), 132)]
    write(tmp_path / "encoderReading.txt", "1 0 0\n" + "\n".join(
        f"{i} {right} {left}" for i, (right, left) in enumerate(ticks, start=2)))
    assert "line 52: expected at most 10 wheel revolutions" in error_of(read_dataset, tmp_path)


def test_markers_decide_between_a_counter_and_a_vehicle_in_another_unit():
    """Radii in cm make increments too long, but no differences of theirs agree with markers."""
    for seed in range(3):
        drive = cut(simulated("short", seed)[0], 0, 400)
        for radius in (1.0, 2.0):
            vehicle = Vehicle(right_radius=radius, left_radius=radius)
            assert counts.cumulative_reason(drive.ticks, vehicle, drive.aruco) == ""


# Exchanged columns.


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("path, count", [("short", 2000), ("short", 300), ("long", 3000)])
@pytest.mark.parametrize("name", ["ArucoReading.txt", "UwbReading.txt"])
def test_columns_of_poses_and_landmarks_that_are_exchanged_are_refused(
        seed, path, count, name, tmp_path):
    dataset = simulated(path, seed)[0]
    write_dataset(tmp_path / "drive", dataset.first(count))
    rows = [line.split() for line in (tmp_path / "drive" / name).read_text().splitlines()]
    for order in (rows, sorted(rows, key=lambda row: int(row[1])), rows[::-1]):
        write(tmp_path / "drive" / name, "\n".join(" ".join(row) for row in order))
        assert read_dataset(tmp_path / "drive").notes == ()
        write(tmp_path / "drive" / name, "\n".join(
            " ".join([row[1], row[0], *row[2:]]) for row in order))
        message = error_of(read_dataset, tmp_path / "drive")
        assert message.startswith(f"{tmp_path / 'drive' / name}: expected the columns (pose id, ")
        assert "columns 1 and 2 look exchanged" in message
