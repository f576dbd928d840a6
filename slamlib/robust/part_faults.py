"""Faults of a part of a drive, by increments of the vehicle that markers and wheels measure.

Wheels may be exchanged, or one or both reversed, for a while: then increments by markers and by
wheels agree with other counts, or, but for one wheel, with other axes. Increments [x, y, heading]
with other axes or signs are [A (x, y), det(A) heading], A one of the eight symmetries of a square.
The stretch is the one in which they contradict each other less by most in all. Such counts are
mended.

Rows may lose counts, or have them late or twice. A wheel then stops for a few rows, or turns far
more than in those around. It is mended if increments by markers agree better then.

Something may move the camera: from then on, it is elsewhere in the vehicle than stated. A camera
that is off by c = [x, y, turn] changes the position of an increment [p, h] by

    e = (R(h) - 1) [x, y] - turn R(90 degrees) p.

For each moment, weighted least squares tell c before and after it, and how much smaller the squared
residuals are than with one c (generalised likelihood ratio: Basseville and Nikiforov,
Detection of Abrupt Changes, 1993, section 2.4).

Where wheels slip on a patch of the ground, both seem to have other radii there. The stretch is the
one with the greatest likelihood ratio, and its counts are not used.
"""

import logging
from dataclasses import replace
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from slamlib.core import increments, odometry, se2
from slamlib.core.marker_increments import (
    common_sightings,
    distance_and_turn,
    distance_and_turn_sigmas,
    robust_increments,
)
from slamlib.core.records import Dataset
from slamlib.core.sightings import GATE, MEDIAN_CHI2, sightings_by_frame

log = logging.getLogger(__name__)

MIN_COUNT = 10            # increments for a decision
SPAN = 1.0                # m, over which increments are compared
MAX_INTERVAL = 3.0        # ratio of the encoder steps between two frames to the usual number
OVERLAP = 4               # number of increments at each place, at least
MAX_FRAMES = 20           # over which increments are compared
MIN_MOTION_SIGMAS = 5.0   # sigmas by markers of distance or turn, from which on the vehicle moves
# Markers and wheels agree within the sum of these
AGREEMENT_RATIO = 0.1     # of an increment
AGREEMENT_SIGMAS = 3.0    # sigmas of the increment by markers
MIN_AGREEING_SHARE = 0.7  # of the increments with an accepted A
MAX_GAP = 20              # rows in which a wheel that moves has no counts
MIN_SPEED = 5             # counts in a row, of a wheel that moves
MOSTLY = 0.6              # of the rows with counts that are behind rows without any
USUAL = 0.9               # probability of the quantile of the pauses between these rows
SLOW = 0.5                # of the median speed, below which a wheel may stop
AROUND = 5                # rows before and after
PEAK = 1.5                # ratio of counts in a row to those in most rows around it
MIN_MENDED_GAIN = 10.0    # of squared residuals, each up to a limit, by what is mended
MIN_GAIN_SIGMAS = 2.5     # sigmas of the number of increments that agree in addition
MIN_SPANS = 3.0           # of increments, that a stretch is longer; one jump spoils two
FINER = 20                # times, in which the search for the ends of a stretch becomes finer
MAX_STRETCH = 0.5         # of the drive, in which wheels are exchanged; else the camera may be
MIN_BUMP_GAIN = 35.0      # of squared residuals, by a camera that was moved
MAX_BUMP = 0.3            # m and rad, of a motion of the camera
BUMP_SIGMA = 0.2          # m and rad, of a camera about its stated place, before and after
DELAYS = range(-30, 31)   # encoder steps, of a delay of the whole drive
MAX_DELAY_COST = 0.7      # of the squared residuals, each up to a limit, without this delay
REWEIGHTED = 4            # times, by the residuals
MIN_WHEELS_GAIN = 25.0    # of squared residuals, by other wheels in a stretch
STRETCH_LENGTHS = 30      # number of lengths that are tried
MAX_WHEELS_STRETCH = 0.3  # of the increments, longest such stretch
WHEELS_SIGMA = 0.05       # relative, of the distances by the wheels there
MAX_SCALE = 5.0           # of the squared residuals; beyond it wheels slip everywhere
# The matrices A.
AXES = np.array([np.diag(signs) @ order for order in (np.eye(2), np.eye(2)[::-1])
                 for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1))])
# By number of AXES: increments (n, 3) by wheels @ MOTIONS are (8, 1, n, 3) with these axes.
MOTIONS = np.zeros((8, 1, 3, 3))
MOTIONS[:, 0, :2, :2] = AXES.mT
MOTIONS[:, 0, 2, 2] = np.linalg.det(AXES)
# Changes of counts (n, 2) @ them: by number of the first four AXES, with the same effect as these;
# behind AXES, the same after the right wheel was reversed.
EXCHANGE = np.eye(2)[::-1]
COUNT_CHANGES = {0: np.eye(2), 1: EXCHANGE, 2: -np.eye(2), 3: -EXCHANGE}
RIGHT_REVERSED = np.array([-1, 1])
COUNT_CHANGES |= {len(AXES) + k: np.diag(RIGHT_REVERSED) @ change
                  for k, change in COUNT_CHANGES.items()}


@lru_cache(maxsize=2)
def moving_increments(
        dataset: Dataset) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Increments of the moving vehicle between n pairs of frames about SPAN apart.

    Those over a long time without sightings are left out: odometry says too little of them.
    Returns those by markers (n, 3) and by wheels (n, 3), the standard deviations of distance and
    turn by markers (n, 2), and the encoder poses of each pair of frames (n, 2), from 0.
    """
    s, common, wheels, poses = _compared(dataset)
    by_markers = robust_increments(s.z, s.C, *common, len(wheels))
    sigma = distance_and_turn_sigmas(by_markers.covariance)
    size = np.maximum(distance_and_turn(by_markers.increment), distance_and_turn(wheels))
    moving = by_markers.usable & (size > MIN_MOTION_SIGMAS * sigma).any(axis=1)
    if len(poses):
        span = len(s.frame) - len(poses)                 # frames between those of a pair
        usual = span * np.median(np.diff(s.frame))
        moving &= poses[:, 1] - poses[:, 0] <= MAX_INTERVAL * usual
    return by_markers.increment[moving], wheels[moving], sigma[moving], poses[moving]


def with_headings_reversed(dataset: Dataset) -> np.ndarray:
    """The increments by markers (n, 3) of `moving_increments`, for theta of the opposite sign."""
    mirror = np.diag([1.0, 1.0, -1.0])
    return _by_changed(dataset, lambda z, C: (z @ mirror, mirror @ C @ mirror))


def with_sightings_inverted(dataset: Dataset) -> np.ndarray:
    """The same for sightings that are the vehicle, as a marker sees it."""
    return _by_changed(dataset, lambda z, C: (se2.inverse(z), C))


def _by_changed(dataset, change):
    """The increments by markers (n, 3) of `moving_increments`, of z and C that `change` returns."""
    s, common, wheels, poses = _compared(dataset)
    by_markers = robust_increments(*change(s.z, s.C), *common, len(wheels))
    moving = np.isin(poses[:, 0], moving_increments(dataset)[3][:, 0])
    return by_markers.increment[moving]


def _compared(dataset):
    """Sightings, and what `robust_increments` needs of them, for all pairs of frames.

    Also the increments by wheels between each pair, and its encoder poses.
    """
    s = sightings_by_frame(dataset.sightings)
    path = _path(dataset)[s.frame]
    other = _path(dataset, RIGHT_REVERSED)[s.frame]      # one of both may turn on the spot
    span = min(_span(path), _span(other))
    common = np.array(common_sightings(s.row, s.marker, span))
    overlapping = common[:, common[0] % max(1, span // OVERLAP) == 0]
    poses = np.column_stack([s.frame[:-span], s.frame[span:]])
    return s, overlapping, se2.between(path[:-span], path[span:]), poses


def _path(dataset, signs=1):
    """Poses (n, 3) by odometry, with other `signs` (2,) of the counts."""
    return odometry.dead_reckoning(signs * dataset.ticks, dataset.vehicle, model="arc")


def with_other_axes(dataset: Dataset, wheels: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Increments by wheels (12, 1, n, 3), by number of AXES and COUNT_CHANGES.

    From those as stated, `wheels` (n, 3), between encoder poses (n, 2).
    """
    one_reversed = _increments(_path(dataset, RIGHT_REVERSED), poses)
    return np.concatenate([wheels @ MOTIONS, one_reversed @ MOTIONS[:4]])


def with_counts_mended(dataset: Dataset) -> Dataset:
    """The Dataset without `wrong_counts`, and wheels mended that are exchanged or reversed."""
    return _with_wheels_mended(without_wrong_counts(dataset))


def without_wrong_counts(dataset: Dataset) -> Dataset:
    """The Dataset without `wrong_counts`, the same one if there are none."""
    wrong = wrong_counts(dataset)
    if not wrong.any():                                  # of the same Dataset much is known
        return dataset
    return replace(dataset, ticks=dataset.ticks - wrong)


@lru_cache(maxsize=2)
def wrong_counts(dataset: Dataset) -> np.ndarray:
    """What is wrong in counts (n, 2) of rows that have lost some, have them late, or twice.

    First, encoders may be read less often than they are logged, unless the markers, late or not,
    contradict it. Then a wheel may have no counts in at most MAX_GAP rows, and many just before and
    after, or far more in a few rows than around. Each kind is mended in all its rows or in none:
    the one by which increments by markers agree best, again and again, as long as one gains enough.
    """
    markers, wheels, sigma, poses = moving_increments(dataset)
    ticks = dataset.ticks
    are_few = len(wheels) < MIN_COUNT

    def cost(ticks, delays=(0,)):
        path = _path(replace(dataset, ticks=ticks))
        late = [_increments(path, poses, steps) for steps in delays]
        return min(_cost(markers, each, sigma, _by_camera(each)) for each in late)

    def least_gain(cost):
        """MIN_MENDED_GAIN, times the mean squared residual that a cost shows if this exceeds 1."""
        return MIN_MENDED_GAIN * max(1.0, cost / (2 * len(wheels)))

    def contradict(mended):
        """Whether the markers agree with the counts as logged, but not with those `mended`."""
        as_logged = cost(ticks, DELAYS)
        return cost(mended, DELAYS) > as_logged + least_gain(as_logged)

    in_time = _mended(ticks, _read_rarely)
    if (in_time != ticks).any() and (are_few or not contradict(in_time)):
        log.info("wheels: encoders are read less often than they are logged")
        ticks = in_time
    if are_few:
        return dataset.ticks - ticks
    least = cost(ticks)
    while True:
        found = {}
        for kind in (partial(_without_gaps, all_late=True), partial(_without_gaps, all_late=False),
                     _without_peaks):
            mended = _mended(ticks, kind)
            if (mended != ticks).any():
                found[cost(mended)] = mended
        best = min(found, default=np.inf)
        if not least - best > least_gain(best):
            return dataset.ticks - ticks
        log.info("wheels: counts of single rows mended, cost %.1f, before %.1f", best, least)
        ticks = found[best]
        least = best


def _mended(ticks, kind):
    """The counts (n, 2) with those of each wheel mended by a function `kind`."""
    return np.stack([kind(counts) for counts in ticks.T], axis=1)


def _read_rarely(counts):
    """The counts (n,) of a wheel, evenly over the rows since its encoder was read before.

    It is read rarely if most of its counts are behind rows without any. A wheel that has none for
    longer than usual stands still, but in the last rows it goes on if they are fewer.
    """
    rows = np.arange(len(counts))
    read = rows[1:][counts[1:] != 0]
    if len(read) < 2:
        return counts
    pauses = np.diff(read)
    is_fast = np.median(np.abs(counts[read])) >= MIN_SPEED
    if not is_fast or np.mean(pauses > 1) <= MOSTLY:
        return counts
    usual = np.quantile(pauses, USUAL)
    since = np.maximum(read - usual, np.append(0, read[:-1]))
    after = np.cumsum(counts[read])
    before = np.append(0, after[:-1])
    knots = np.stack([since, read], axis=1).ravel()
    at_knots = np.stack([before, after], axis=1).ravel()
    total = np.interp(rows, knots, at_knots)
    in_time = np.diff(total, prepend=0)
    if len(counts) - read[-1] <= usual:
        in_time[read[-1] + 1:] = in_time[read[-1]]
    in_time[0] = counts[0]
    return in_time


def _without_gaps(counts, all_late):
    """The counts (n,) of a wheel that never stands still for a few rows only.

    A gap are rows without counts. If `all_late`, it and the row behind it share the counts of that
    row. Else they do only where these are nearer to the counts of so many rows than to those of
    one, and any other gap gets the mean of the counts before and after it.
    """
    mended = counts.copy()
    moved = np.flatnonzero(counts)
    rows = np.diff(moved)
    is_fast = _is_fast(counts[moved])
    goes_on = is_fast[:-1] & is_fast[1:] & (np.diff(np.sign(counts[moved])) == 0)
    is_gap = goes_on & (rows > 1) & (rows <= MAX_GAP + 1)
    for k in np.flatnonzero(is_gap):
        first = moved[k] + 1
        last = moved[k + 1]
        before = mended[first - 1]                       # shared if it is behind another gap
        after = counts[last]
        if all_late or 2 * abs(after) > (1 + rows[k]) * abs(before):
            edges = np.rint(np.linspace(0, after, rows[k] + 1))
            mended[first:last + 1] = np.diff(edges)
        else:
            mended[first:last] = np.rint((before + after) / 2)
    return mended


def _without_peaks(counts):
    """The counts (n,) of a wheel, if it never turns far more in a row than in most around it."""
    around = sliding_window_view(np.pad(counts, AROUND, mode="edge"), 2 * AROUND + 1)
    usual = np.rint(np.median(around, axis=1)).astype(counts.dtype)
    is_peak = (np.abs(counts) > PEAK * np.abs(usual)) & _is_fast(usual)
    return np.where(is_peak, usual, counts)


def _is_fast(counts):
    """Where counts (n,) of a wheel are so large that it does not stop from one row to the next."""
    speed = np.abs(counts)
    usual = np.median(speed) if len(speed) else 0.0
    return speed >= max(MIN_SPEED, SLOW * usual)


def _with_wheels_mended(dataset):
    """The Dataset with its counts mended in a stretch in which wheels are exchanged or reversed.

    It is as it was where that is most of the drive and the camera may as well have other axes. Of
    all ends of the stretch nearby, the increments agree best with the one that is chosen.
    """
    markers, wheels, sigma, poses = moving_increments(dataset)
    if len(wheels) < MIN_COUNT:
        return dataset
    by_wheels = with_other_axes(dataset, wheels, poses)
    stretch = other_axes(contradictions(markers[None], by_wheels, sigma), poses)
    if stretch is None or not stretch.is_mended(len(dataset.ticks)):
        return dataset

    def cost(changed):
        """What still contradicts the markers."""
        by_wheels = _increments(_path(changed), poses)
        return _limited(contradictions(markers, by_wheels, sigma)).sum()

    first = stretch.first
    last = stretch.last
    reach = 2 * int(np.median(np.diff(poses)))
    for _ in range(2):
        near = np.arange(-reach, reach + 1, max(1, reach // FINER))
        first = min(first + near, key=lambda pose: cost(stretch.mended(dataset, pose, last)))
        later = last + near[::-1]                # of equal ones the last: nothing tells at the end
        last = min(later, key=lambda pose: cost(stretch.mended(dataset, first, pose)))
        reach //= FINER
    log.info("wheels: wrong from pose %d to %d, mended", first + 1, last + 1)
    return stretch.mended(dataset, first, last)


def contradictions(markers: np.ndarray, wheels: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Differences (..., n) of increments (..., n, 3) by markers and by wheels; they agree below 1.

    `sigma` (n, 2) is that of distance and turn by markers.
    """
    size = np.maximum(size_of(markers), size_of(wheels))
    tolerance = AGREEMENT_RATIO * size + AGREEMENT_SIGMAS * np.linalg.norm(sigma, axis=1)
    return size_of(markers - wheels) / tolerance


def _limited(off):
    """The `contradictions`, at most 1, as where markers tell no increment."""
    return np.where(off < 1, off, 1.0)


def size_of(increment: np.ndarray) -> np.ndarray:
    """Root of the squares of distance in m and turn in rad, (...), of increments (..., 3)."""
    return np.linalg.norm(distance_and_turn(increment), axis=-1)


def _span(path):
    """Number of frames over SPAN by the path (f, 3): MAX_FRAMES or a quarter of all at most."""
    if len(path) < 2:
        return 1
    step = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    frames = SPAN / max(np.median(step), SPAN / MAX_FRAMES)
    return max(1, min(int(frames + 0.5), len(path) // 4))


class OtherAxes(NamedTuple):
    """A stretch of a drive in which markers and wheels agree with other axes or signs."""

    axes: int                # number of AXES or COUNT_CHANGES
    is_reversed: bool        # whether theta is, too
    first: int               # encoder pose, from 0, at which it begins
    last: int                # at which it ends
    stated: np.ndarray       # (m,) bool, which increments agree as stated
    agreeing: np.ndarray     # (m,) bool, which agree with these axes

    def is_mended(self, count: int) -> bool:
        """Whether the counts are mended.

        Where a camera with other axes would have the same effect, less than half of the `count`
        poses must be in the stretch.
        """
        if self.axes >= len(AXES):
            return True
        is_by_counts = self.axes in COUNT_CHANGES and not self.is_reversed
        return is_by_counts and self.last - self.first < MAX_STRETCH * count

    def mended(self, dataset: Dataset, first: int, last: int) -> Dataset:
        """The Dataset with counts of these axes from the pose `first` to the pose `last`."""
        ticks = dataset.ticks.copy()
        rows = slice(max(first, 0) + 1, last + 1)
        ticks[rows] = ticks[rows] @ COUNT_CHANGES[self.axes]
        return replace(dataset, ticks=ticks)


def other_axes(off: np.ndarray, poses: np.ndarray) -> OtherAxes | None:
    """OtherAxes, if significantly more increments agree with them; the stretch may be the drive.

    `off` (12, k, n) are the `contradictions` of `with_other_axes`, for theta as stated and then
    reversed, of increments between these encoder poses (n, 2). In the stretch they are less by most
    in all.
    """
    agree = off < 1
    limited = _limited(off)
    k, is_reversed, begin, end = _stretch_of_most_gain(limited[0, 0] - limited)
    if end == 0 or np.ptp(poses[begin:end]) <= MIN_SPANS * np.median(np.diff(poses)):
        return None
    stated = agree[0, 0, begin:end]
    agreeing = agree[k, is_reversed, begin:end]
    gain = agreeing.sum() - stated.sum()
    gain_sigma = np.sum(agreeing != stated)**0.5
    if agreeing.mean() < MIN_AGREEING_SHARE or gain <= MIN_GAIN_SIGMAS * gain_sigma:
        return None
    return OtherAxes(int(k), bool(is_reversed), poses[begin, 0], poses[end - 1, 1], stated,
                     agreeing)


def _stretch_of_most_gain(gain):
    """Indices of axes and of reversal, begin and end of the stretch with the greatest sum of gains.

    The gain (12, k, n) is that of each increment. Of the stretches that end at an increment, the
    best one begins where the sum from the first increment on is least.
    """
    total = np.insert(np.cumsum(gain, axis=2), 0, 0, axis=2)
    of_best = total - np.minimum.accumulate(total, axis=2)
    k, is_reversed, end = np.unravel_index(of_best.argmax(), of_best.shape)
    begin = total[k, is_reversed, :end + 1].argmin()
    return k, is_reversed, begin, end


class CameraBump(NamedTuple):
    """What moved the camera during a drive."""

    pose: int                # encoder pose, from 0, of the first frame after it
    motion: np.ndarray       # (3,) of the camera, in the axes of the vehicle

    def mended(self, dataset: Dataset) -> Dataset:
        """The Dataset with its later sightings as the camera would have them at its old place."""
        aruco = dataset.aruco
        stated = dataset.vehicle
        in_camera = se2.between(stated.camera, se2.compose(self.motion, stated.camera))
        in_camera[:2] /= stated.marker_size              # in the unit of the sightings
        later = aruco.pose >= self.pose
        motion = np.where(later[:, None], in_camera, 0.0)
        return replace(dataset, aruco=replace(
            aruco,
            marker_in_vehicle=se2.compose(motion, aruco.marker_in_vehicle),
            covariance=se2.rotate_covariance(aruco.covariance, motion[:, 2])))


@lru_cache(maxsize=2)
def camera_bump(dataset: Dataset) -> CameraBump | None:
    """A possible CameraBump of a Dataset, or None if one place of the camera explains it as well.

    The moment is that step in the neighbourhood in which markers move most as the camera does.
    """
    markers, wheels, sigma, poses = moving_increments(dataset)
    if len(wheels) <= 2 * MIN_COUNT:
        return None
    k, before, after, gain = _change(markers, wheels, sigma, _by_camera(wheels))
    motion = after - before
    if gain < MIN_BUMP_GAIN or np.abs(motion).max() > MAX_BUMP:
        return None
    s = sightings_by_frame(dataset.sightings)
    path = _path(dataset)[s.frame]
    steps = se2.between(path[:-1], path[1:])
    common = np.array(common_sightings(s.row, s.marker))
    window = np.searchsorted(s.frame, [poses[k - 1, 0], poses[k, 1]])
    near = common[:, (window[0] <= common[0]) & (common[0] < window[1])]
    found = robust_increments(s.z, s.C, *near, len(steps))
    usable = np.flatnonzero(found.usable)
    if not len(usable):
        return None
    off = se2.between(steps[usable], found.increment[usable])
    covariance = found.covariance[usable]
    gains = se2.squared_norms(off, covariance) - se2.squared_norms(off - motion, covariance)
    taken = int(s.frame[1 + usable[gains.argmax()]])
    bump = CameraBump(taken + round(dataset.vehicle.sighting_lag), motion)
    log.info("camera: moved before pose %d, by %s", bump.pose + 1, np.round(motion, 3))
    return bump


@lru_cache(maxsize=2)
def constant_delay(dataset: Dataset) -> int:
    """Encoder steps by which all sightings are later than stated, 0 if it is not decidedly so."""
    markers, wheels, sigma, poses = moving_increments(dataset)
    if not len(wheels):
        return 0
    path = _path(dataset)
    cost = {}
    for steps in DELAYS:
        late = _increments(path, poses, steps)
        cost[steps] = _cost(markers, late, sigma, _by_camera(late))
    best = min(cost, key=cost.get)
    late = _increments(path, poses, best)
    if cost[best] > MAX_DELAY_COST * cost[0] or not _agree_mostly(markers, late, sigma):
        return 0
    log.info("sightings: %d steps later than stated", best)
    return best


def _agree_mostly(markers, wheels, sigma):
    """Whether there are enough increments by both, of which most agree; delays cost them little."""
    agree = contradictions(markers, wheels, sigma) < 1
    return len(agree) > 2 * MIN_COUNT and 2 * agree.sum() > len(agree)


def _increments(path, poses, late=0):
    """Increments (n, 3) by wheels, of encoder poses (n, 2) that are too large by `late` steps.

    `path` is that of all poses by wheels.
    """
    taken = np.clip(poses - late, 0, len(path) - 1)
    return se2.between(path[taken[:, 0]], path[taken[:, 1]])


def _cost(markers, wheels, sigma, by_change):
    """Squared residuals, each up to a limit, of positions of increments (n, 3) by both.

    But for one factor on those by wheels, and what all have in common by_change (n, 2, q).
    """
    e = se2.difference(markers, wheels)[:, :2, None]
    J = np.concatenate([by_change, wheels[:, :2, None]], axis=2)
    squared = _in_common(e, J, sigma[:, :1]**2 / 2)[1]
    return np.minimum(squared, GATE).sum()


def _by_camera(wheels):
    """Derivatives (n, 2, 3) of the positions of increments (n, 3) by the camera's [x, y, turn]."""
    turned = se2.rotation(wheels[:, 2]) - np.eye(2)
    across = np.stack([wheels[:, 1], -wheels[:, 0]], axis=1)
    return np.concatenate([turned, across[:, :, None]], axis=2)


def _change(markers, wheels, sigma, by_change):
    """Number of the first increment after a change, what is (q,) before and after it, and the gain.

    By increments (n, 3) of markers and wheels, sigmas (n, 2) of distance and turn by markers, and
    derivatives (n, 2, q) of positions by what changes. Wheels may be off by one factor all the
    time. The gain is that of squared residuals, in the variance that the residuals show.
    """
    e = se2.difference(markers, wheels)[:, :2, None]
    by_factor = wheels[:, :2, None]
    J = np.concatenate([by_change, by_factor], axis=2)
    variance = sigma[:, 0]**2 / 2
    weight = 1 / variance
    for _ in range(REWEIGHTED):
        weighted = weight[:, None, None] * J.mT
        common = _least_squares(np.sum(weighted @ J, axis=0), np.sum(weighted @ e, axis=0))[0]
        left = e - by_factor * common[-1]
        information = np.cumsum(weighted[:, :-1] @ by_change, axis=0)
        right = np.cumsum(weighted[:, :-1] @ left, axis=0)
        before, saved_before = _least_squares(information, right)
        after, saved_after = _least_squares(information[-1] - information, right[-1] - right)
        gain = saved_before + saved_after - saved_before[-1]
        k = MIN_COUNT + int(gain[MIN_COUNT:-MIN_COUNT].argmax())
        changed = np.where((np.arange(len(e)) <= k)[:, None, None], before[k], after[k])
        squared = np.sum((left - by_change @ changed)**2, axis=(1, 2)) / variance
        weight = _robust_weights(squared, scale_of(squared, 2)) / variance
    return k + 1, before[k, :, 0], after[k, :, 0], gain[k] / OVERLAP


def _in_common(e, J, variance, sigma=BUMP_SIGMA):
    """What errors e (n, d, 1) have in common by J (n, d, q), (q, 1), and squared residuals (n,).

    By robust least squares about 0 with a prior sigma. The residuals are in units of the variances
    (n, d) or (n, 1).
    """
    weighted = (J / variance[:, :, None]).mT
    kept = np.ones(len(e))
    for _ in range(REWEIGHTED):
        robust = kept[:, None, None] * weighted
        common = _least_squares(np.sum(robust @ J, axis=0), np.sum(robust @ e, axis=0), sigma)[0]
        squared = np.sum((e - J @ common)[:, :, 0]**2 / variance, axis=1)
        kept = _robust_weights(squared, scale_of(squared, e.shape[1]))
    return common, squared


def scale_of(squared: np.ndarray, size: int) -> float:
    """Factor, 1 or more, on variances of errors of `size` components, by their squares (n,)."""
    return max(1.0, np.median(squared) / MEDIAN_CHI2[size])


def _robust_weights(squared, scale):
    """Weights (n,) of the Cauchy kernel over a `scale` of the variances, by squared errors (n,)."""
    return 1 / (scale + squared / GATE)


def _least_squares(information, right, sigma=BUMP_SIGMA):
    """Least squares (..., q, 1) about 0 with a prior sigma, and the squared residuals they save.

    By information (..., q, q) and right-hand sides (..., q, 1) without this prior.
    """
    prior = np.eye(information.shape[-1]) / sigma**2
    found = np.linalg.solve(information + prior, right)
    return found, np.sum(right * found, axis=(-2, -1))


def slipping_rows(dataset: Dataset) -> np.ndarray:
    """Rows of counts (n,), bool, in a stretch in which both wheels seem to have other radii."""
    rows = np.zeros(len(dataset.ticks), bool)
    markers, wheels, sigma, poses = moving_increments(dataset)
    if len(wheels) <= 2 * MIN_COUNT:
        return rows
    vehicle = dataset.vehicle
    by_wheel = increments.between_poses(dataset.ticks, vehicle, *poses.T, "arc")[1]
    by_radii = by_wheel[:, :, :2] * vehicle.wheel[:2]
    variance = sigma[:, [0, 0, 1]]**2 / [2, 2, 1]
    stretch = _other_radii(se2.difference(markers, wheels), by_radii, variance)
    if stretch is not None:
        first, last = stretch
        rows[poses[first, 0] + 1:poses[last, 1] + 1] = True
        log.info("wheels: slip from pose %d to %d", poses[first, 0] + 1, poses[last, 1] + 1)
    return rows


def _other_radii(e, J, variance):
    """First and last increment of the stretch with other radii, None if there is none.

    By differences e (n, 3) of increments by markers and by wheels, their `variance` (n, 3), and
    derivatives J (n, 3, 2) by relative changes of both radii, which may be off all the time.
    """
    e = e[:, :, None]
    common, squared = _in_common(e, J, variance, WHEELS_SIGMA)
    scale = scale_of(squared, 3)
    if scale > MAX_SCALE:
        return None
    kept = _robust_weights(squared, scale)
    robust = kept[:, None, None] * (J / variance[:, :, None]).mT
    information = odometry.cumulative(robust @ J)
    right = odometry.cumulative(robust @ (e - J @ common))
    found = None
    least = MIN_WHEELS_GAIN * OVERLAP
    longest = max(MIN_COUNT, int(MAX_WHEELS_STRETCH * len(e)))
    for length in np.unique(np.geomspace(MIN_COUNT, longest, STRETCH_LENGTHS).astype(int)):
        gain = _least_squares(information[length:] - information[:-length],
                              right[length:] - right[:-length], WHEELS_SIGMA)[1]
        first = gain.argmax()
        if gain[first] > least:
            least = gain[first]
            found = first, first + length - 1
    return found
