"""Encoder counts since the start (cumulative), converted to counts since the previous pose."""

import numpy as np

from slamlib import se2

MAX_REVOLUTIONS = 10.0  # revolutions of a wheel in one step
MAX_CHANGE = 0.1  # largest change of a count from row to row, in MAX_REVOLUTIONS
OVERFLOW = 2**16  # number of values of a counter of 16 bits
MIN_SIGHTING_PAIRS = 10  # pairs of sightings of a marker, for a decision
MAX_SIGHTINGS = 20_000  # sightings; of more, the first ones decide
MIN_DISTANCE_SIGMAS = 5.0  # distance of the wheels between two sightings, in its sigmas by markers
CONTRADICTING_RATIO = 5.0  # ratio of distances by counts and by markers that contradict each other
MAX_AGREEMENT = 2.0  # ratio of those that agree
MIN_ROWS = 4  # rows after the first, for a doubt
MAX_FALLING = 0.02  # share of the rows that are smaller than the row before
MAX_LEAP = 0.5  # difference of two consecutive rows, as a share of the last row's size
MIN_GROWTH = 1.15  # ratio of the mean sizes in the last and in the middle third
MIN_LARGEST_COUNT = 0.5  # revolutions; smaller counts that change gradually are not doubted
RUN_ROWS = 10  # rows over which cumulative counts mostly change with one sign
JUMP_RATIO = 4.0  # ratio of a counter's jump to the steps nearby and to a large step of the drive
REVERSAL_RATIO = 3.0  # the same for a jump with the opposite sign of the steps before and after it
NEARBY_ROWS = 5  # rows before and after a step
LARGE_STEP_QUANTILE = 0.9  # probability of the quantile of the steps that is a large step


def incremental_counts(table, vehicle, aruco):
    """Counts since the previous pose (n, 2) int64, and notes (list of str) if they were converted.

    Parameters
    ----------
    table : dialects.Table of the encoders, with whole numbers.
    vehicle : Vehicle
    aruco : ArucoReadings or None

    Raises
    ------
    DatasetError : the first row is not 0, a step exceeds MAX_REVOLUTIONS, or cumulative counts
        jump.
    """
    counts = table.numbers[:, 1:]
    largest = MAX_REVOLUTIONS * vehicle.ticks_per_revolution
    if reason := cumulative_reason(counts, vehicle, aruco):
        steps = differences(counts)
        jump = jumps(steps) | (abs(steps) > largest)
        row, wheel = np.unravel_index(np.argmax(jump), jump.shape)
        table.require(~jump.any(axis=1), "counts since the start that run on, but from the row "
                      f"before, the count jumps from {counts[row - 1, wheel]:.0f} to "
                      f"{counts[row, wheel]:.0f}: the counter restarted or overflowed, or rows are "
                      "missing")
        return steps.astype(np.int64), [
            f"{table.source.name} holds counts since the start ({reason}): the difference of each "
            "row from the one before was taken."]
    table.require(~counts[:1].any(axis=1), "'1 0 0' as the first row (no step leads to pose 1; "
                  "counts are since the previous pose, not since the start)")
    table.require((abs(counts) <= largest).all(axis=1),
                  f"at most {MAX_REVOLUTIONS:g} wheel revolutions ({largest:g} ticks) in one "
                  "step (counts since the previous pose, not since the start)")
    return counts.astype(np.int64), []


def cumulative_reason(counts, vehicle, aruco):
    """Reason (str, a part of a sentence) why counts must be cumulative; "" if none is found.

    A reason excludes counts since the previous pose, so these are never converted.

    1. Bound. As increments they would exceed MAX_REVOLUTIONS, but consecutive rows differ by less
       than a tenth of that: a wheel does not reach ten revolutions a step with such changes.
    2. Overflow. Consecutive rows differ by less than 1 % of 2^16, or by 2^16 less such a change: no
       wheel falls from thousands of counts in a step to none in one row.
    3. Markers. Between two sightings of a marker the motion is known without wheels. The distance
       by the counts exceeds it CONTRADICTING_RATIO times, and that by differences of rows agrees
       within the factor MAX_AGREEMENT (medians). The differences mostly have one sign between
       sightings; those of counts since the previous pose are noise about a constant speed.

    Parameters
    ----------
    counts : (n, 2), right and left.
    vehicle : Vehicle
    aruco : ArucoReadings or None
    """
    steps = np.diff(counts, axis=0)
    largest = MAX_REVOLUTIONS * vehicle.ticks_per_revolution
    if len(steps) == 0:
        return ""
    if abs(counts).max() > largest and abs(steps).max() <= MAX_CHANGE * largest:
        return f"one row has {abs(counts).max():g}, no two in succession differ by a tenth of that"
    if _overflows(counts, steps) and abs(wrapped(steps)).max() < OVERFLOW / 100:
        return "they overflow at 16 bits"
    return _reason_by_markers(counts, vehicle, aruco)


def may_be_cumulative(counts, vehicle):
    """True if counts (n, 2) are possibly cumulative.

    1. Their size grows until the end, hardly ever falls and never leaps. The increments of a
       vehicle that accelerates until the end look the same.
    2. Or they exceed MIN_LARGEST_COUNT and change gradually: except for jumps, consecutive rows
       differ by at most MAX_CHANGE of the largest count, mostly with one sign over RUN_ROWS rows.
       The vehicle may then stand or drive back. Increments at constant speed differ by noise.
    """
    return _grows(abs(counts[1:]).sum(axis=1)) or _is_gradual(counts, vehicle)


def _grows(size):
    if len(size) < MIN_ROWS:
        return False
    steps = np.diff(size)
    _, middle, end = (part.mean() for part in np.array_split(size, 3))
    return bool(np.mean(steps < 0) < MAX_FALLING and abs(steps).max() < MAX_LEAP * size[-1]
                and end > MIN_GROWTH * middle)


def _is_gradual(counts, vehicle):
    largest = abs(counts).max()
    if len(counts) <= RUN_ROWS or largest < MIN_LARGEST_COUNT * vehicle.ticks_per_revolution:
        return False
    steps = differences(counts)
    jump = jumps(steps)
    jump[1] = False                     # the vehicle may drive at once
    gradual = abs(np.where(jump, 0, steps)).max() <= MAX_CHANGE * largest
    over_run = abs(counts[RUN_ROWS:] - counts[:-RUN_ROWS]).sum() / RUN_ROWS
    return bool(gradual and over_run > abs(steps).sum() / MAX_AGREEMENT)


def jumps(steps):
    """Mask (n, 2) of the steps of a counter that restarts or overflows.

    They exceed the steps nearby and a large step of the drive JUMP_RATIO or REVERSAL_RATIO times,
    because a wheel changes its speed gradually.
    """
    size = abs(steps)
    nearby = np.zeros_like(size)
    for k in range(1, NEARBY_ROWS + 1):
        np.maximum(nearby[k:], size[:-k], out=nearby[k:])
        np.maximum(nearby[:-k], size[k:], out=nearby[:-k])
    large = np.quantile(size[size > 0], LARGE_STEP_QUANTILE) if size.any() else 0
    reversal = np.zeros(size.shape, bool)
    reversal[1:-1] = (steps[1:-1] * steps[:-2] < 0) & (steps[1:-1] * steps[2:] < 0)
    return size > np.where(reversal, REVERSAL_RATIO, JUMP_RATIO) * np.maximum(nearby, large)


def differences(counts):
    """Counts (n, 2) since the previous pose from cumulative ones; 0 in the first row."""
    steps = np.diff(counts, axis=0, prepend=counts[:1])
    return wrapped(steps) if len(steps) and _overflows(counts, steps) else steps


def _overflows(counts, steps):
    """True if counts (n, 2) fit into 16 bits but jump by more than half of their range."""
    return abs(steps).max() > OVERFLOW / 2 and np.ptp(counts) < OVERFLOW


def wrapped(steps):
    """Differences of counters of 16 bits, in [-2^15, 2^15)."""
    return (steps + OVERFLOW / 2) % OVERFLOW - OVERFLOW / 2


def _reason_by_markers(counts, vehicle, aruco):
    """Reason 3 of `cumulative_reason`."""
    if aruco is None:
        return ""
    aruco = aruco.select(slice(MAX_SIGHTINGS))
    order = np.lexsort([aruco.pose, aruco.marker])
    pose, marker, z = (each[order] for each in (aruco.pose, aruco.marker, aruco.marker_in_vehicle))
    variance = aruco.covariance[order][:, [0, 1], [0, 1]].sum(axis=1)
    first = np.flatnonzero((marker[1:] == marker[:-1]) & (pose[1:] > pose[:-1]))
    motion = se2.compose(z[first], se2.inverse(z[first + 1]))  # the later in the earlier pose
    # Both wheels together drive |s + b δ/2| + |s - b δ/2| = max(2 |s|, b |δ|).
    by_markers = np.maximum(2 * np.hypot(*motion[:, :2].T),
                            vehicle.wheelbase * abs(se2.wrap(motion[:, 2])))
    steps = differences(counts)
    steps = np.where(jumps(steps), 0, steps)
    metres = 2 * np.pi / vehicle.ticks_per_revolution * vehicle.wheel[:2]
    # Of both wheels together between the two sightings, in m: by counts, net and gross by steps.
    totals = (np.cumsum(rows, axis=0) for rows in (counts, steps, abs(steps)))
    by_counts, net, gross = (
        abs((total[pose[first + 1]] - total[pose[first]]) * metres).sum(axis=1) for total in totals)
    moving = gross > MIN_DISTANCE_SIGMAS * np.sqrt(variance[first] + variance[first + 1])
    if np.count_nonzero(moving) < MIN_SIGHTING_PAIRS:
        return ""
    by_counts, net, gross, by_markers = (
        np.median(distance[moving]) for distance in (by_counts, net, gross, by_markers))
    if (by_counts > CONTRADICTING_RATIO * by_markers and net > gross / MAX_AGREEMENT
            and by_markers / MAX_AGREEMENT < net < MAX_AGREEMENT * by_markers):
        return (f"between sightings of a marker, the wheels go {by_markers / 2:.3g} m by the "
                f"markers, {net / 2:.3g} m by the differences of rows, and else "
                f"{by_counts / 2:.3g} m")
    return ""
