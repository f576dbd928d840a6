"""Encoder counts since the start, and those of a counter that wraps around, to increments."""

import numpy as np
from scipy.ndimage import maximum_filter

MAX_REVOLUTIONS = 10.0  # revolutions of a wheel in one step
MIN_REVOLUTIONS = 0.9  # revolutions that counts since the start span
MAX_SMALL_STEP = 0.025  # of that span; larger steps from row to row are jumps of the counter
MIN_SMALL_SHARE = 0.95  # of the steps
RUN_ROWS = 10  # rows over which counts since the start mostly change with one sign
NEARBY = np.arange(-5, 6)[:, None] != 0  # rows before and after a step
JUMP_RATIO = 4.0  # ratio of a counter's jump to the steps nearby and to a large step of the drive
LARGE_STEP_QUANTILE = 0.9  # probability of the quantile of the steps that is a large step
MODULI = 2**16, 2**15  # numbers of values of counters that wrap around
MIN_MODULUS_RATIO = 32.0  # ratio of a modulus to a large step of the drive, for a decision


def incremental_counts(table, vehicle):
    """The Table of the encoders, with notes, and counts since the previous pose (n, 2) int64.

    Raises DatasetError if the first row is not 0, a step exceeds MAX_REVOLUTIONS, or counts since
    the start jump: beyond the steps nearby, because a wheel changes its speed gradually.
    """
    counts, limit = table.numbers[:, 1:], MAX_REVOLUTIONS * vehicle.ticks_per_revolution
    if not since_start(counts, vehicle):
        steps = unwrapped(counts)
        ok = abs(steps) <= np.where(np.arange(len(steps)) == 0, 0, limit)[:, None]
        said = (f"at most {MAX_REVOLUTIONS:g} wheel revolutions ({limit:g} ticks) in one step, and "
                "none in the first row (counts since the previous pose, not since the start)")
    else:
        table = table.noted(" holds counts since the start, which change gradually up to "
                            f"{abs(counts).max():.0f}: the difference of each row from the one "
                            "before was taken")
        counts = np.diff(counts, axis=0, prepend=counts[:1])
        steps = unwrapped(counts)
        nearby = maximum_filter(abs(steps), footprint=NEARBY, mode="constant")
        ok = abs(steps) <= JUMP_RATIO * np.maximum(nearby, _large_step(steps))
        said = "counts since the start that run on: the counter restarted, or rows are missing"
    table.kept(np.pad(ok, ((0, 0), (1, 0)), constant_values=True), said)
    if len(mended := np.flatnonzero(steps != counts) // 2):
        table = table.noted(f": {len(mended)} counts were mended that are 2^15 or 2^16 off, as of "
                            f"a counter that wraps around, the first in {table.place(mended[0])[0]}"
                            )
    return table, steps.astype(np.int64)


def since_start(counts, vehicle):
    """True if counts (n, 2), right and left, are since the start.

    They change gradually: small steps from row to row are most of all and reach over half of the
    span, mostly with one sign over RUN_ROWS rows; those of increments are noise about a constant
    speed. MIN_REVOLUTIONS are a short way, but no speed to which a wheel comes in so many steps.
    """
    steps, span = np.diff(counts, axis=0), np.ptp(counts, axis=0).max()
    if span < MIN_REVOLUTIONS * vehicle.ticks_per_revolution or len(steps) < RUN_ROWS:
        return False
    small = abs(steps) <= MAX_SMALL_STEP * span
    total = np.cumsum(np.where(small, steps, 0), axis=0)
    size = abs(steps[small]).sum()
    over_run = abs(total[RUN_ROWS:] - total[:-RUN_ROWS]).sum() / RUN_ROWS
    return bool(small.mean() >= MIN_SMALL_SHARE and size > span / 2 and over_run > size / 2)


def unwrapped(steps):
    """Steps (n, 2), less a modulus where that makes them as small as others."""
    for modulus in MODULI:
        off = np.flatnonzero(2 * abs(steps) > modulus)
        large = _large_step(steps) if len(off) else 0
        less = steps.flat[off] - np.sign(steps.flat[off]) * modulus
        wraps = (abs(less) <= 2 * large) & (MIN_MODULUS_RATIO * large < modulus)
        steps = steps.copy()
        steps.flat[off[wraps]] = less[wraps]
    return steps


def _large_step(steps):
    size = abs(steps[steps != 0])
    return np.quantile(size, LARGE_STEP_QUANTILE) if len(size) else 0
