"""Counts since the start are refused, those of wrapped counters mended, where they are."""

from functools import cache

import numpy as np
import pytest
from test_dataset import error_of, write

from slamlib.checks.files import doubts_before_solving
from slamlib.dataset import Vehicle, read_dataset
from slamlib.simulation import simulate
from slamlib.vehicle import since_start

simulated = cache(simulate)


def written(folder, ticks):
    write(folder / "encoderReading.txt", "\n".join(
        f"{i} {right} {left}" for i, (right, left) in enumerate(np.rint(ticks).astype(int), 1)))


def test_real_increments_are_never_changed():
    """Twenty drives, cuts of them, and the same driven backward; at eight rates."""
    rng = np.random.default_rng(0)
    for seed in range(20):
        ticks = simulate("short", seed, slip=rng.choice([0, 1e-3, 1e-2]))[0].ticks
        cuts = ((begin, begin + n) for n in rng.choice([5, 10, 50, 200, 1000], 3)
                for begin in rng.integers(2000 - n, size=1))
        for begin, end in ((0, 2000), *cuts):
            for rate in (1, 2, 5, 10, 20, 50, 100, 200):
                total = ticks[begin:end].cumsum(axis=0)[::rate]
                for sign in (1, -1):
                    steps = sign * np.diff(total, axis=0, prepend=total[:1])
                    assert not since_start(steps, Vehicle())


DRIVES = {
    "at constant speed": np.full((100, 2), 132), "on the spot": np.tile([50, -50], (100, 1)),
    "with one wheel still": np.tile([0, 132], (100, 1)), "not at all": np.zeros((100, 2)),
    "from rest to constant speed": np.minimum(np.arange(100), 40)[:, None] * [3, 3],
    "after a rest": np.repeat([[0, 0], [132, 90]], 50, axis=0),
    "to and fro": np.repeat([[132, 132], [-132, -132]], 50, axis=0),
    "fast": np.full((100, 2), 31_999), "with one wrong row": np.r_[
        np.full((50, 2), 132), [[31_999, 132]], np.full((50, 2), 132)]}


@pytest.mark.parametrize("drive", DRIVES)
def test_increments_of_any_drive_are_taken_as_such(drive, tmp_path):
    ticks = np.r_[np.zeros((1, 2)), DRIVES[drive]].astype(int)
    written(tmp_path, ticks)
    dataset = read_dataset(tmp_path)
    np.testing.assert_array_equal(dataset.ticks, ticks)
    assert dataset.notes == () and doubts_before_solving(dataset) == []


def slow(ticks, factor=20):
    """The drive at a speed that is smaller by a factor."""
    total = np.repeat(ticks, factor, axis=0)[factor - 1:].cumsum(axis=0) // factor
    return np.diff(total, axis=0, prepend=total[:1])


def forth(rows=300):
    """Counts since the pose before of a drive with rounding and a slip of the wheels."""
    slip = np.random.default_rng(0).normal(0, 2, (rows, 2)).cumsum(axis=0) / 10
    return np.r_[[[0, 0]], np.rint(132 + slip)].astype(int)


RESTS = np.zeros((300, 2), int)
RUN_ON = {                               # a drive, and what its counts since the start begin with
    "a whole drive": (lambda t: t, [123456, -7]), "50 poses, fast": (lambda t: 3 * t[:50], 0),
    "backward": (lambda t: -t[:200], 0), "slow": (lambda t: slow(t)[:3000], 0),
    "a rest": (lambda t: np.insert(t, 100, RESTS, axis=0), 0),
    "stands at the end": (lambda t: np.r_[forth(), RESTS], 0),
    "to and fro": (lambda t: np.r_[forth(), -forth()], [32311, 29874]),
    "on the spot": (lambda t: [1, -1] * forth(), 0), "one wheel": (lambda t: [1, 0] * forth(), 0)}


def restarted(counter, row):
    return np.r_[counter[:row], counter[row:] - counter[row]]


JUMPS = {                                                          # what happens to a counter
    "restart after 300 rows": lambda c: restarted(c, 300),
    "two restarts": lambda c: restarted(restarted(c, 1000), 300),
    "lost rows": lambda c: np.r_[c[:150], c[200:]],
    "a count at the start": lambda c: np.r_[c[:1], c[1:] + 30_000],
    **{f"modulo {m}": (lambda c, m=m: c % m) for m in (8000, 2**13, 2**14, 2**16, 2**17)}}


@pytest.mark.parametrize("case", RUN_ON)
def test_counts_since_the_start_are_refused(case, tmp_path):
    change, begin = RUN_ON[case]
    ticks = change(simulated("short", len(case))[0].ticks)
    written(tmp_path, ticks.cumsum(axis=0) + np.array(begin))
    assert "expected counts since the previous pose, found counts since the start" in error_of(
        read_dataset, tmp_path)


@pytest.mark.parametrize("change", JUMPS)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_counter_that_jumps_is_one_since_the_start(change, sign, tmp_path):
    written(tmp_path, JUMPS[change](sign * simulated("short", len(change))[0].ticks.cumsum(axis=0)))
    assert "found counts since the start" in error_of(read_dataset, tmp_path)


@pytest.mark.parametrize("modulus", [2**15, 2**16])
@pytest.mark.parametrize("begin, low", [(60_000, 0), (30_000, -1), (3000, 0)])
@pytest.mark.parametrize("sign", [1, -1])
def test_counters_that_wrap_around_are_mended(modulus, begin, low, sign, tmp_path):
    """Differenced by who wrote the file, as wrapped."""
    ticks = sign * simulated("short", 0)[0].ticks[:1000]
    counter = (ticks.cumsum(axis=0) + begin - low * modulus // 2) % modulus + low * modulus // 2
    steps = np.diff(counter, axis=0, prepend=counter[:1])
    wraps = np.flatnonzero((steps != ticks).any(axis=1))
    assert len(wraps)
    written(tmp_path, steps)
    dataset = read_dataset(tmp_path)
    np.testing.assert_array_equal(dataset.ticks, ticks)
    note, = dataset.notes
    assert note == (f"encoderReading.txt: {len(wraps)} rows were mended whose counts are 2^15 or "
                    f"2^16 off, as of a counter that wraps around, first line {wraps[0] + 1}.")


@pytest.mark.parametrize("wrong", [3000, -16_000, 30_000, 40_000, 62_000, 70_000])
def test_other_spikes_are_no_wraps(wrong, tmp_path):
    """The gate of the odometry finds what is below MAX_REVOLUTIONS."""
    ticks = simulated("short", 0)[0].ticks[:300].copy()
    ticks[150, 0] = wrong
    written(tmp_path, ticks)
    np.testing.assert_array_equal(read_dataset(tmp_path).ticks, ticks)
    ticks[150, 0] = 99_999
    written(tmp_path, ticks)
    assert "line 151: expected at most 10 wheel revolutions" in error_of(read_dataset, tmp_path)
