"""Encoder counts that run on since the start, where the format has those since the pose before."""

import numpy as np

from slamlib import se2

MOST_REVOLUTIONS = 10.0  # revolutions of a wheel in one step
SMOOTH = 0.1  # largest change from row to row of a counter, in MOST_REVOLUTIONS
WRAP = 2**16  # values of a counter of 16 bits
MIN_PAIRS = 10  # pairs of sightings that decide
MANY = 20_000  # sightings; of more, the first ones decide
MOVING = 5.0  # standard deviations by which a wheel's way is above the noise of a pair
LESS = 5.0  # ratio of the ways by counts and by markers from which they contradict
MIN_ROWS = 4  # rows after the first that may be judged at all
FALLING = 0.02  # share of the rows that are smaller than the one before
LEAP = 0.5  # share of the last row's size by which two rows in succession differ
GROWING = 1.15  # ratio of the mean sizes of the last and the middle third
ALIKE = 2.0  # and up to which they agree
FAST = 0.5  # revolutions in one step, from which counts that change gradually are doubted
RUN = 10  # rows over which they change one way
JUMP = 4.0  # ratio of a jump of the counter to steps nearby and to a large step of the drive
FALL = 3.0  # the same, of one against the direction of the step before and of the one after
NEARBY = 5  # rows before and after
LARGE = 0.9  # quantile of the steps of wheels that turn


def since_previous(table, vehicle, aruco):
    """Counts since the pose before (n, 2) int64, and notes (list of str) if they had to be made.

    Raises DatasetError if the first row is not 0, a step is above MOST_REVOLUTIONS, or counts since
    the start jump.

    Parameters
    ----------
    table : dialects.Table of the encoders, with whole numbers.
    vehicle : Vehicle
    aruco : ArucoReadings or None
    """
    ticks = table.numbers[:, 1:]
    most = MOST_REVOLUTIONS * vehicle.ticks_per_revolution
    if reason := run_on(ticks, vehicle, aruco):
        steps = differences(ticks)
        jump = jumps(steps) | (abs(steps) > most)
        row, wheel = np.unravel_index(np.argmax(jump), jump.shape)
        table.require(~jump.any(axis=1), "counts since the start that run on, but from the row "
                      f"before, the count jumps from {ticks[row - 1, wheel]:.0f} to "
                      f"{ticks[row, wheel]:.0f}: the counter restarted or overflowed, or rows are "
                      "missing")
        return steps.astype(np.int64), [
            f"{table.source.name} holds counts since the start ({reason}): the difference of each "
            "row from the one before was taken."]
    table.require(~ticks[:1].any(axis=1), "'1 0 0' as the first row (no step leads to pose 1; "
                  "counts are since the previous pose, not since the start)")
    table.require((abs(ticks) <= most).all(axis=1),
                  f"at most {MOST_REVOLUTIONS:g} wheel revolutions ({most:g} ticks) in one "
                  "step (counts since the previous pose, not since the start)")
    return ticks.astype(np.int64), []


def run_on(counts, vehicle, aruco):
    """How the rows (n, 2) of an encoder file are known to be counts since the start, or "".

    The result is a reason, a part of a sentence. Counts since the pose before are never taken for
    others: a reason excludes them.

    1. Bound. They would be above MOST_REVOLUTIONS, of which a step has no tenth: a wheel does not
       speed up to ten revolutions in a step by less than one from row to row.
    2. Overflow. Rows change by less than 1 % of 2^16, but for jumps by 2^16 less such a change: no
       wheel falls from thousands of counts in a step to none in one row, and to the count.
    3. Markers. Between two sightings of a marker, at which increments of the pose are known without
       the wheels, wheels would go LESS times farther than markers say, and differences of rows
       agree with them within the factor ALIKE (medians). Differences have one sign between most of
       the sightings: those of counts since the pose before are noise about a constant speed.

    Parameters
    ----------
    counts : (n, 2), right and left.
    vehicle : Vehicle
    aruco : ArucoReadings or None
    """
    steps = np.diff(counts, axis=0)
    most = MOST_REVOLUTIONS * vehicle.ticks_per_revolution
    if len(steps) == 0:
        return ""
    if abs(counts).max() > most and abs(steps).max() <= SMOOTH * most:
        return f"one row has {abs(counts).max():g}, no two in succession differ by a tenth of that"
    if abs(steps).max() > WRAP / 2 and abs(wrapped(steps)).max() < WRAP / 100 \
            and np.ptp(counts) < WRAP:
        return "they overflow at 16 bits"
    return _by_markers(counts, vehicle, aruco)


def may_run_on(counts, vehicle):
    """True if rows (n, 2) may be counts since the start.

    1. Their size grows until the end, hardly ever falls and never leaps. So do increments of a
       vehicle that speeds up until the end.
    2. Or they reach FAST from 0 gradually and, but for jumps, stay gradual: rows in succession
       differ by at most SMOOTH of the largest, mostly with one sign over RUN rows. A vehicle may
       then stand or drive back. Increments at constant speed differ by noise about zero.
    """
    return _grow(abs(counts[1:]).sum(axis=1)) or _gradual(counts, vehicle)


def _grow(size):
    if len(size) < MIN_ROWS:
        return False
    steps = np.diff(size)
    _, middle, end = (part.mean() for part in np.array_split(size, 3))
    return bool(np.mean(steps < 0) < FALLING and abs(steps).max() < LEAP * size[-1]
                and end > GROWING * middle)


def _gradual(counts, vehicle):
    most = abs(counts).max()
    if len(counts) <= RUN or most < FAST * vehicle.ticks_per_revolution:
        return False
    steps = differences(counts)
    jump = jumps(steps)
    jump[1] = False                     # a vehicle that drives at once
    gradual = abs(np.where(jump, 0, steps)).max() <= SMOOTH * most
    over_run = abs(counts[RUN:] - counts[:-RUN]).sum() / RUN
    return bool(gradual and over_run > abs(steps).sum() / ALIKE)


def jumps(steps):
    """Where (n, 2) steps of a counter are above JUMP or FALL times those nearby and a large one.

    So are those of a counter that restarts or overflows. A wheel changes its speed gradually.
    """
    size = abs(steps)
    nearby = np.zeros_like(size)
    for k in range(1, NEARBY + 1):
        np.maximum(nearby[k:], size[:-k], out=nearby[k:])
        np.maximum(nearby[:-k], size[k:], out=nearby[:-k])
    large = np.quantile(size[size > 0], LARGE) if size.any() else 0
    against = np.zeros(size.shape, bool)
    against[1:-1] = (steps[1:-1] * steps[:-2] < 0) & (steps[1:-1] * steps[2:] < 0)
    return size > np.where(against, FALL, JUMP) * np.maximum(nearby, large)


def differences(counts):
    """Counts (n, 2) since the pose before, from those since the start; 0 in the first row."""
    steps = np.diff(counts, axis=0, prepend=counts[:1])
    overflowing = len(steps) and abs(steps).max() > WRAP / 2 and np.ptp(counts) < WRAP
    return wrapped(steps) if overflowing else steps


def wrapped(steps):
    """Differences of counters of 16 bits, in [-2^15, 2^15)."""
    return (steps + WRAP / 2) % WRAP - WRAP / 2


def _by_markers(counts, vehicle, aruco):
    if aruco is None:
        return ""
    aruco = aruco.select(slice(MANY))
    order = np.lexsort([aruco.pose, aruco.marker])
    pose, marker, z = (each[order] for each in (aruco.pose, aruco.marker, aruco.marker_in_vehicle))
    variance = aruco.covariance[order][:, [0, 1], [0, 1]].sum(axis=1)
    a = np.flatnonzero((marker[1:] == marker[:-1]) & (pose[1:] > pose[:-1]))
    motion = se2.compose(z[a], se2.inverse(z[a + 1]))      # the later pose in the vehicle's frame
    # Ways of both wheels together: s + t and s - t of the way s and half the base times turn t.
    seen = np.maximum(2 * np.hypot(*motion[:, :2].T),
                      vehicle.wheelbase * abs(se2.wrap(motion[:, 2])))
    way = 2 * np.pi / vehicle.ticks_per_revolution * vehicle.wheel[:2]
    steps = differences(counts)
    steps = np.where(jumps(steps), 0, steps)

    def between(rows):
        """Sum (p, 2) of rows after the first and until the second sighting, in m."""
        total = np.cumsum(rows, axis=0)
        return (total[pose[a + 1]] - total[pose[a]]) * way

    by_counts, net, gross = (abs(between(rows)).sum(axis=1) for rows in (
        counts, steps, abs(steps)))
    moving = gross > MOVING * np.sqrt(variance[a] + variance[a + 1])
    if np.count_nonzero(moving) < MIN_PAIRS:
        return ""
    by_counts, net, gross, seen = (np.median(each[moving]) for each in (
        by_counts, net, gross, seen))
    if by_counts > LESS * seen and seen / ALIKE < net < ALIKE * seen and net > gross / ALIKE:
        return (f"between sightings of a marker, the wheels go {seen / 2:.3g} m by the markers, "
                f"{net / 2:.3g} m by the differences of rows, and else {by_counts / 2:.3g} m")
    return ""
