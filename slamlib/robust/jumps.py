"""Jumps: intervals between two frames in which odometry contradicts the markers.

Somebody pushes or carries the vehicle, an encoder fails, rows of counts are lost: one increment is
then wrong by far more than any slip. With the increment O by odometry between two neighbouring
frames, and sightings Z before and Z' after it of the same marker, the true increment is J O with

    Z = J O Z' + noise,

where J is the identity unless there was a jump. Sightings of other frames count as well: odometry
with a generous slip transports them to the nearer of the two frames. First, each sighting is
compared with the next one of its marker. Frames between which most of these pairs disagree are
suspects. In the order of the drive, J is estimated by `robust_increments` between suspects, and
kept if it is decidedly more likely than the identity (data snooping: Baarda 1968). Later poses move
with it. Where all markers change at once and none of them is known, the motion is unknown. A step
is from a frame to the next one, and has the number of the earlier one.
"""

import logging
from bisect import bisect_left
from dataclasses import dataclass, replace
from functools import lru_cache, reduce
from operator import attrgetter

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.marker_increments import distance_and_turn, robust_increments
from slamlib.core.records import Dataset
from slamlib.core.sightings import GATE, sightings_by_frame
from slamlib.robust.part_faults import constant_delay, scale_of, size_of, slipping_rows

log = logging.getLogger(__name__)

CRAWL = 0.1                  # of the typical speed, below which counts may creep
MIN_FROZEN = 20              # ratio of the lengths of runs of equal counts, frozen and usual
# Noise of odometry, generous
SLIP = 0.03                  # sqrt(m), of a wheel after one metre
FLOOR = 3e-3                 # m and rad, of an increment
LEVER = 0.12                 # m, by which the camera may be elsewhere than stated
# The same, by the slip that a solution has learned, and of a camera that is where it is stated
SLIP_RATIO = 3.0             # of the slip to the one that was learned
KNOWN_FLOOR = 1e-3           # m and rad
KNOWN_LEVER = 0.02           # m
# Decisions; gains are of twice the log likelihood
SUSPECT = 7.8                # 95 % quantile of chi-squared with three degrees of freedom
MIN_GAIN = 12.0              # by a jump
PAIRS = 2                    # of sightings of each marker that tell of a jump: one may be wrong
NEAREST = 24                 # number of these pairs, by the frames between them
MAX_VARIANCE = 1.0           # m^2, of the place after a jump
WELL_INSIDE = 0.15, 0.85     # quantiles of x and of y at which markers are seen
SOON = 1, 2, 3               # frames later or earlier, at which these should be seen again
MIN_MISSED = 6               # number of sightings that should be there, and are not
# Jumps in odometry
USUAL = 0.9                  # probability of the quantile of motions that is a usual one
MIN_JUMP = 0.1               # m and rad, least standard deviation of the motion
MAX_BAD_FRAMES = 10          # in a row, or
MAX_BAD_SHARE = 0.15         # of all frames, if these are more
CANCELLED = 0.3              # ratio of the size of all jumps together to that of one
MIN_COST_RATIO = 1.5         # without jumps and with them, of markers seen before and after
MAX_UNSUPPORTED = 2          # number of jumps; sensors that have more of them may be poor
UNKNOWN_SIGMA = np.array([10.0, 10.0, np.pi])  # m, m, rad, if no marker tells
TOGETHER = 10                # number of successive frames, in which sightings are rejected together
SLIPPING_CHANCE = 1e6        # of a jump in a row in which wheels slip, relative to others


@dataclass(frozen=True)
class Jumps:
    """Increments that odometry does not know, between g pairs of neighbouring frames."""

    start: np.ndarray        # (g,) encoder poses from 0, ascending
    end: np.ndarray          # (g,)
    increment: np.ndarray    # (g, 3) by the markers: m, m, rad
    by_odometry: np.ndarray  # (g, 3)
    sigma: np.ndarray        # (g, 3) of the increment without these markers
    chance: np.ndarray       # (n,) of a jump in the steps up to each pose, up to a factor
    lag: int = 0             # poses, by which all sightings seem later than stated
    bump: float = np.inf     # encoder pose from which on the camera is elsewhere

    @property
    def groups(self) -> frozenset:
        """Groups of the calibration that they release."""
        found = set()
        if self.lag:
            found.add("time-offset")
        if self.bump < np.inf:
            found.add("camera-bump")
        return frozenset(found)

    def none(self) -> "Jumps":
        """No Jumps of the vehicle, with what these say of the camera."""
        return replace(NO_JUMPS, lag=self.lag, bump=self.bump)

    @property
    def are_few(self) -> bool:
        """Whether there are jumps, but few that no slipping wheels support."""
        unsupported = np.sum(self._chances() < SLIPPING_CHANCE)
        return len(self.start) > 0 and unsupported <= MAX_UNSUPPORTED

    @property
    def causes(self) -> int:
        """Number of runs of adjacent jumps, as of wheels that slip for a while."""
        apart = self.start[1:] > self.end[:-1]
        return np.count_nonzero(apart) + min(len(self.start), 1)

    def _chances(self):
        """Chances (g,) of each whole jump."""
        return self.chance[self.end] - self.chance[self.start]

    def share(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Probabilities (m, g) that the jumps are in increments between encoder poses (m,)."""
        common_start = np.maximum(start[:, None], self.start)
        common_end = np.minimum(end[:, None], self.end)
        chance = self.chance[common_end] - self.chance[common_start]
        return np.where(common_start < common_end, chance, 0.0) / self._chances()

    def added(self, start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Motions (m, 3) to add to such increments, in the axes of their ends, and covariances."""
        share = self.share(start, end)
        motion = share @ se2.between(self.by_odometry, self.increment)
        variance = share @ self.sigma**2
        return motion, variance[:, :, None] * np.eye(3)

    def joined_by(self, start: int, end: int, increment: np.ndarray, by_odometry: np.ndarray,
                  count: int) -> "Jumps":
        """The Jumps and one more, of `count` encoder poses."""
        jump = se2.compose(increment, se2.inverse(by_odometry))
        chance = self.chance
        if not len(self.start):
            chance = np.arange(float(count))
        return replace(self, chance=chance)._with(
            start=start, end=end, increment=increment, by_odometry=by_odometry,
            sigma=_sigma_of(jump))

    def _with(self, **jump):
        """The Jumps and one more, of which all fields with a row for each are given."""
        k = np.searchsorted(self.start, jump["start"])
        joined = {name: np.insert(getattr(self, name), k, value, axis=0)
                  for name, value in jump.items()}
        return replace(self, **joined)

    def mended(self, pose: np.ndarray, poses: np.ndarray, begin: int = 0) -> np.ndarray:
        """Poses (f, 3) of the encoder poses (f,), with these increments instead of odometry's.

        Jumps up to the encoder pose `begin` are mended already.
        """
        for start, end, increment in zip(self.start, self.end, self.increment):
            if begin < end <= pose[-1]:
                before = np.searchsorted(pose, start)
                after = np.searchsorted(pose, end)
                poses = _moved(poses, after, se2.compose(poses[before], increment))
        return poses


_NO_ROWS = np.zeros((0, 3))
NO_JUMPS = Jumps(start=np.zeros(0, int), end=np.zeros(0, int), increment=_NO_ROWS,
                 by_odometry=_NO_ROWS, sigma=_NO_ROWS, chance=np.zeros(1))


def _sigma_of(jump):
    """Standard deviations (3,) of a motion that may be as large as the jump (3,)."""
    distance = np.hypot(jump[0], jump[1])
    return np.maximum([distance, distance, np.abs(jump[2])], MIN_JUMP)


def _moved(poses, k, pose):
    """Poses (f, 3) of which pose k and the later ones have moved with pose k to `pose` (3,)."""
    later = se2.between(poses[k], poses[k:])
    return np.concatenate([poses[:k], se2.compose(pose, later)])


def crawls(ticks: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Whether the vehicle crawls, (m,) bool, from encoder poses `start` to `end`, each (m,).

    A vehicle that crawls may as well stand, while its counts (n, 2) creep: then they say nothing of
    the wheels, and the whole increment may be an error. It crawls below CRAWL of the mean speed,
    each speed weighted by its way.
    """
    counts = np.abs(ticks[1:])
    travelled = odometry.cumulative(counts.sum(axis=1))        # by both wheels
    travel = travelled[end] - travelled[start]
    speed = travel / np.maximum(end - start, 1)
    return speed * travel.sum() < CRAWL * (speed @ travel)


def frozen_rows(ticks: np.ndarray) -> np.ndarray:
    """Rows (n,), bool, in which counts (n, 2) repeat one row for far longer than is usual.

    Counts that creep may be equal for long.
    """
    speed = np.abs(ticks).sum(axis=1)
    creeps = speed * speed.sum() <= CRAWL * (speed @ speed)
    is_new = np.append(True, (ticks[1:] != ticks[:-1]).any(axis=1))
    run = np.cumsum(is_new) - 1
    length = np.bincount(run)
    frozen = length > MIN_FROZEN * np.quantile(length, 0.99)
    return frozen[run] & ~creeps


def creep_covariance(increment: np.ndarray, crawling: np.ndarray) -> np.ndarray:
    """Covariances (m, 3, 3) by which increments (m, 3) may be errors: all where it crawls (m,)."""
    creep = np.where(crawling[:, None], increment, 0.0)
    return creep[:, :, None] * creep[:, None]


@lru_cache(maxsize=2)
def find_jumps(dataset: Dataset) -> Jumps:
    """The Jumps of a Dataset, by its sightings as the stated camera has them.

    Of the last Datasets it keeps what it found, which problems 2 and 3 share.
    """
    s = _sightings_by_marker(dataset)
    if len(s.frame) < 2:
        return NO_JUMPS
    vehicle = dataset.vehicle
    path = odometry.dead_reckoning(dataset.ticks, vehicle, model="arc")
    slipping = slipping_rows(dataset) | frozen_rows(dataset.ticks)
    lag = constant_delay(dataset)
    candidates = []
    for each in sorted({0, lag}):
        poses = path[np.clip(s.frame - each, 0, len(path) - 1)]
        drive = _Drive.without_jumps(poses, vehicle.wheelbase)
        candidates.append(_found(dataset.ticks, s, drive, slipping))
    found = min(candidates, key=len)
    jumps = replace(NO_JUMPS, lag=lag)
    for jump in found:
        start = s.frame[jump.step]
        end = s.frame[jump.step + 1]
        distance, turn = distance_and_turn(jump.motion)
        log.info("jump between poses %d and %d: markers and odometry differ by %.3f m and %.3f "
                 "rad, gain %.1f, sigma %.1f m", start + 1, end + 1, distance, turn, jump.gain,
                 jump.sigma[0])
        jumps = jumps._with(start=start, end=end, increment=jump.increment,
                            by_odometry=jump.by_odometry, sigma=jump.sigma)
    chance = np.cumsum(np.where(slipping, SLIPPING_CHANCE, 1.0))
    return replace(jumps, chance=chance) if found else jumps


def _sightings_by_marker(dataset):
    """The Sightings of a Dataset, sorted by marker, then by frame."""
    s = sightings_by_frame(dataset.sightings)
    order = np.lexsort((s.row, s.marker))
    return replace(s, row=s.row[order], marker=s.marker[order], z=s.z[order], C=s.C[order])


def most_together(rejected: np.ndarray) -> int:
    """Largest number of sightings in TOGETHER successive frames, by that `rejected` in each (f,).

    Jumps that are overlooked show so; wrong labels rarely do.
    """
    return int(np.convolve(rejected, np.ones(TOGETHER)).max())


def with_overlooked(dataset: Dataset, jumps: Jumps, slip: float) -> list[Jumps]:
    """The Jumps and more of them: with all that were overlooked, and with the likeliest of these.

    With the slip that a solution has learned, in sqrt(m), also smaller ones show than before.
    """
    s = _sightings_by_marker(dataset)
    if len(s.frame) < 2:
        return []
    path = odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc")
    poses = jumps.mended(s.frame, path[s.frame])
    drive = replace(_Drive.without_jumps(poses, dataset.vehicle.wheelbase),
                    slip=SLIP_RATIO * slip, floor=KNOWN_FLOOR, lever=KNOWN_LEVER)
    found = _found(dataset.ticks, s, drive, np.zeros(len(path), bool))
    more = [jump for jump in found if s.frame[jump.step] not in jumps.start]
    more.sort(key=attrgetter("gain"))

    def joined(jumps, jump):
        return jumps.joined_by(s.frame[jump.step], s.frame[jump.step + 1], jump.increment,
                               jump.by_odometry, len(path))

    alternatives = [reduce(joined, some, jumps) for some in (more, more[-1:])]
    return alternatives[:len(more)]                      # one is all


def cauchy_cost(squared: np.ndarray) -> np.ndarray:
    """Cauchy cost, twice a negative log likelihood, of squared Mahalanobis distances (m,)."""
    return GATE * np.log1p(squared / GATE)


def _found(ticks, s, drive, slipping):
    """List of each _Jump in a _Drive, by Sightings sorted by marker, then by frame.

    All steps in which the wheels are `slipping`, a mask (n,) of the counts, are jumps.
    """
    pairs = _compared(s, drive)
    scale = _covariance_scale(s, drive)
    pairs = replace(pairs, squared=pairs.squared / scale)
    suspects = _suspects(pairs)
    rank = _rank(pairs)
    unknown = dict.fromkeys(_breaks(s, drive.poses, pairs), UNKNOWN_SIGMA)
    s = replace(s, C=scale * s.C)
    tried = _bridged(s, drive, suspects, rank, unknown)
    dead = _dead(ticks, s.frame, [jump.step for jump in tried if jump.gain > MIN_GAIN])
    dead = np.union1d(dead, np.flatnonzero(_rows_in_steps(slipping, s.frame))).tolist()
    if dead:
        unknown = dict.fromkeys(dead, 2 * _usual(drive)) | unknown
        tried = _bridged(s, drive, suspects, rank, unknown)
    found = [jump for jump in tried if jump.found]
    return _without_bad_frames(s, drive, found + _beside(s, drive, found, rank))


def _beside(s, drive, found, rank):
    """List of each _Jump in a step beside those that were `found`, as behind a late frame."""
    steps = np.array([jump.step for jump in found], int)
    beside = np.setdiff1d([steps - 1, steps + 1], steps)
    beside = beside[(beside >= 0) & (beside < len(rank))]
    moved = reduce(_Drive.with_jump, found, drive)
    return [jump for jump in _bridged(s, moved, beside, rank, {}) if jump.found]


def _without_bad_frames(s, drive, found):
    """The _Jumps but those that soon cancel: in between, sightings are wrong, or late.

    The nearest ones cancel first.
    """
    kept = sorted(found, key=attrgetter("step"))
    for most in (MAX_BAD_FRAMES, MAX_BAD_SHARE * len(drive.poses)):
        kept = _without_cancelling(s, drive, kept, most)
    return kept


def _without_cancelling(s, drive, jumps, most):
    """The _Jumps, in their order, but those that cancel within so many steps at `most`."""
    kept = []
    before = []                                          # poses of their frames, as they move them
    for jump in jumps:
        here = drive.poses[jump.step]
        if kept:
            end = se2.compose(before[-1], kept[-1].increment)
            way = se2.between(drive.poses[kept[-1].step + 1], here)
            here = se2.compose(end, way)
        kept.append(jump)
        before.append(here)
        begin = bisect_left(kept, jump.step - most, key=attrgetter("step"))
        k = _last_cancelled(s, drive, kept[begin:], np.array(before[begin:]))
        if k is not None:
            del kept[begin + k:], before[begin + k:]
    return kept


def _last_cancelled(s, drive, jumps, before):
    """Number of the last of m _Jumps that cancels, by those after it up to the end, or None.

    They cancel if they move what follows by far less than the first and the last of them do.
    `before` (m, 3) are the poses of their frames, as the jumps move them. They also cancel if the
    first and the last do as motions of the camera, which is then where it was before (within
    CANCELLED m and rad), and all jumps between them are as small. But they stay if markers seen
    before and after agree far better with them.
    """
    if len(jumps) < 2:
        return None
    motion = np.array([jump.motion for jump in jumps])
    size = size_of(motion)
    most = CANCELLED * np.minimum(size, size[-1])
    steps = np.array([jump.step for jump in jumps])
    end = se2.compose(before[-1], jumps[-1].increment)
    by_odometry = se2.between(drive.poses[steps], drive.poses[steps[-1] + 1])
    off = size_of(se2.between(by_odometry, se2.between(before, end)))
    off_as_camera = size_of(se2.compose(motion, motion[-1]))
    largest_between = 0.0
    for k in reversed(range(len(jumps) - 1)):
        if off[k] < most[k]:
            return k
        is_as_camera = max(largest_between, off_as_camera[k]) < min(most[k], CANCELLED)
        if is_as_camera and _agree_without(s, drive, jumps[k:]):
            return k
        largest_between = max(largest_between, size[k])
    return None


def _agree_without(s, drive, run):
    """Whether markers seen before and after _Jumps agree nearly as well without them."""
    first = run[0].step
    last = run[-1].step + 1
    moved = reduce(_Drive.with_jump, run, drive)
    in_place = replace(moved, poses=drive.poses)
    cost = _cost_across(s, in_place, first, last)
    return cost <= MIN_COST_RATIO * _cost_across(s, moved, first, last)


def _cost_across(s, drive, first, last):
    """Cost of the sightings of each marker up to a frame, and from another one on, by a _Drive.

    Those nearest to the two frames, of Sightings sorted by marker, then by frame.
    """
    earlier = np.flatnonzero(s.row <= first)
    later = np.flatnonzero(s.row >= last)[::-1]
    before = dict(zip(s.marker[earlier].tolist(), earlier))
    after = dict(zip(s.marker[later].tolist(), later))
    both = sorted(before.keys() & after.keys())
    k = np.array([before[marker] for marker in both], int)
    seen_later = drive.seen_from(s.row[k], s, np.array([after[marker] for marker in both], int))
    return cauchy_cost(_Motions(s.z[k], s.C[k]).squared_distances(seen_later)).sum()


def _covariance_scale(s, drive):
    """Factor of the covariances, 1 or more, with which sightings of neighbouring frames agree."""
    pairs = _compared(s, replace(drive, slip=0.0))
    squared = pairs.squared[pairs.span == 1]
    if not len(squared):
        return 1.0
    return scale_of(squared, 3)


def _usual(drive):
    """Motion (3,) of a step, m, m, rad, that few steps exceed."""
    moves = np.abs(se2.between(drive.poses[:-1], drive.poses[1:]))
    usual = np.quantile(moves, USUAL, axis=0)
    usual[1] = usual[0]                                  # a jump may be to the side
    return np.maximum(usual, MIN_JUMP)


@dataclass(frozen=True)
class _Motions:
    """Motions, or poses of markers, with covariances."""

    mean: np.ndarray         # (m, 3)
    covariance: np.ndarray   # (m, 3, 3)

    def then(self, other):
        """These _Motions, followed by others, with independent errors."""
        return _Motions(*se2.compose_uncertain(
            self.mean, self.covariance, other.mean, other.covariance))

    def squared_distances(self, other):
        """Squared Mahalanobis distances (m,) to others."""
        return se2.squared_distances(self.mean, other.mean, self.covariance + other.covariance)


@dataclass(frozen=True)
class _Drive:
    """Odometry at the frames."""

    poses: np.ndarray        # (f, 3)
    way: np.ndarray          # (f,) m, travelled so far
    variance: np.ndarray     # (f-1, 2) of a jump in each step, m^2 and rad^2
    wheelbase: float         # m
    slip: float = SLIP       # sqrt(m)
    floor: float = FLOOR     # m and rad
    lever: float = LEVER     # m

    @classmethod
    def without_jumps(cls, poses, wheelbase):
        """The _Drive of poses (f, 3), with odometry's usual noise alone."""
        way = odometry.cumulative(np.hypot(*np.diff(poses[:, :2], axis=0).T))
        return cls(poses, way, np.zeros((len(poses) - 1, 2)), wheelbase)

    def with_variance(self, steps, variance):
        """The _Drive with jumps of this variance (2,), m^2 and rad^2, in `steps`, (m,) or one."""
        variances = self.variance.copy()
        variances[steps] = variance
        return replace(self, variance=variances)

    def with_jump(self, jump):
        """The _Drive with a _Jump in its step; later poses move with it."""
        k = jump.step
        end = se2.compose(self.poses[k], jump.increment)
        moved = replace(self, poses=_moved(self.poses, k + 1, end))
        return moved.with_variance(k, jump.variance)

    def motions(self, start, end):
        """_Motions between frames, each (m,) or one, roughly."""
        move = se2.between(self.poses[start], self.poses[end])
        way = np.abs(self.way[end] - self.way[start])
        total = odometry.cumulative(self.variance)
        place, turn = np.abs(total[end] - total[start]).T        # variances, first by jumps alone
        turn = turn + 2 * way * (self.slip / self.wheelbase)**2 + self.floor**2
        squared_distance = np.sum(move[:, :2]**2, axis=1)
        half_turn = se2.wrap(move[:, 2]) / 2
        by_lever = 2 * self.lever * np.sin(half_turn)
        place = place + turn * squared_distance / 3 + self.floor**2 + by_lever**2
        along = place + way * self.slip**2 / 2
        variance = np.stack([along, place, turn], axis=-1)
        return _Motions(move, variance[:, None] * np.eye(3))

    def seen_from(self, frame, s, rows):
        """Markers of the sightings in `rows` as _Motions from frames, (m,) or one, by odometry."""
        seen = _Motions(s.z[rows], s.C[rows])
        return self.motions(frame, s.row[rows]).then(seen)


@dataclass(frozen=True)
class _Pairs:
    """Pairs of a sighting and the next one of its marker."""

    first: np.ndarray        # (m,) frame of the earlier sighting
    second: np.ndarray       # (m,) frame of the later one
    squared: np.ndarray      # (m,) Mahalanobis distance between them, by odometry
    steps: int               # number of all steps

    @property
    def span(self):
        """Numbers (m,) of steps from the earlier to the later frame."""
        return self.second - self.first

    @property
    def wrong(self):
        """True (m,) where the pair contradicts odometry."""
        return self.squared > SUSPECT

    def over(self, chosen):
        """Numbers (f-1,) of the `chosen` pairs, a mask (m,), over each step."""
        begin = np.bincount(self.first[chosen], minlength=self.steps + 1)
        end = np.bincount(self.second[chosen], minlength=self.steps + 1)
        return np.cumsum(begin - end)[:-1]


def _compared(s, drive):
    """The _Pairs of Sightings that are sorted by marker, then by frame."""
    k = _followed(s)
    first = s.row[k]
    second = s.row[k + 1]
    seen = _Motions(s.z[k], s.C[k])
    squared = seen.squared_distances(drive.seen_from(first, s, k + 1))
    return _Pairs(first, second, squared, len(s.frame) - 1)


def _followed(s):
    """Rows (m,) of such Sightings before another one of the same marker."""
    return np.flatnonzero(s.marker[:-1] == s.marker[1:])


def _suspects(pairs):
    """Steps that half of the pairs of sightings contradict.

    Only sightings at these two frames are asked, if there are any; else all pairs over it.
    """
    close = pairs.span == 1
    all_close = pairs.over(close)
    asked = np.where(all_close, all_close, pairs.over(np.ones_like(close)))
    wrong = np.where(all_close, pairs.over(close & pairs.wrong), pairs.over(pairs.wrong))
    return np.flatnonzero(_is_majority(wrong, asked))


def _is_majority(wrong, asked):
    """Where (n,) at least one and half of so many that are `asked` (n,) are `wrong` (n,)."""
    return (wrong > 0) & (2 * wrong >= asked)


def _rank(pairs):
    """Rank (f-1,) of each step: which of them is asked first for a jump.

    Those with sightings at both frames come first, then those under most pairs that contradict
    odometry, less those that agree with it. A pair over a long way does not tell where on it a jump
    was.
    """
    all_close = pairs.over(pairs.span == 1)
    return np.where(all_close, -np.inf, pairs.over(~pairs.wrong) - pairs.over(pairs.wrong))


def _breaks(s, poses, pairs):
    """Steps in which all markers change, although odometry hardly moves.

    Markers well inside the field of view should be seen again in the next few frames. At least
    MIN_MISSED such sightings are missed, on both sides, and no short one of the _Pairs that agrees
    with odometry is over the step.
    """
    short = pairs.span <= max(SOON)
    agreeing = pairs.over(short & (pairs.squared < GATE))
    later = sum(_due(s, poses, offset) for offset in SOON)
    earlier = sum(_due(s, poses, -offset) for offset in SOON)
    on_both_sides = np.minimum(later, earlier) > 1
    missed = on_both_sides & (later + earlier >= MIN_MISSED)
    return np.flatnonzero(missed & (agreeing == 0))


def _due(s, poses, offset):
    """Numbers (f-1,) of sightings that are due again `offset` frames later, over each step.

    They are due if their markers are then well inside the field of view.
    """
    low, high = np.quantile(s.z[:, :2], WELL_INSIDE, axis=0)
    count = len(poses) - 1
    wanted = s.row + offset
    frame = np.clip(wanted, 0, count)
    motion = se2.between(poses[frame], poses[s.row])
    place = se2.compose(motion, s.z)[:, :2]
    inside = (low < place) & (place < high)
    due = inside.all(axis=1) & (frame == wanted)
    begin = np.minimum(s.row, frame)[due]
    steps = begin + np.arange(abs(offset))[:, None]
    return np.bincount(steps.ravel(), minlength=count)


def _dead(ticks, frame, contradicted):
    """Steps in which a wheel is dead.

    It counts nothing there, in a run of zeros in which half of the steps are in `contradicted`.
    """
    right, left = [_in_dead_run(count == 0, frame, contradicted) for count in ticks.T]
    return np.flatnonzero(_rows_in_steps(right | left, frame))


def _in_dead_run(zero, frame, contradicted):
    """True (n,) in the runs of `zero` (n,) that the markers contradict in half of their steps."""
    run = np.cumsum(~zero)                                  # a run has one number
    silent = _rows_in_steps(zero, frame) == np.diff(frame)
    is_contradicted = np.zeros_like(silent)
    is_contradicted[contradicted] = True
    wrong = silent & is_contradicted
    run_of_step = run[frame[1:]]
    silent_steps = np.bincount(run_of_step, silent, len(zero) + 1)
    wrong_steps = np.bincount(run_of_step, wrong, len(zero) + 1)
    is_dead = _is_majority(wrong_steps, silent_steps)
    return zero & is_dead[run]


def _rows_in_steps(rows, frame):
    """Number (f-1,) of encoder rows in each step of which a mask (n,) is true."""
    count = odometry.cumulative(rows)
    return np.diff(count[frame + 1])


@dataclass(frozen=True)
class _Jump:
    """What sightings tell of a jump in a step."""

    step: int
    by_odometry: np.ndarray  # (3,) increment
    motion: np.ndarray       # (3,) J
    variance: np.ndarray     # (2,) of J, m^2 and rad^2
    sigma: np.ndarray        # (3,) of J without these sightings
    gain: float              # by J instead of the identity
    found: bool              # so also without the pair of sightings that gains most

    @property
    def increment(self):
        """J O, (3,), the increment by the sightings."""
        return se2.compose(self.motion, self.by_odometry)


def _bridged(s, drive, suspects, rank, unknown):
    """List of the _Jump of each suspect, by their `rank` (f-1,), as if those before it were right.

    Steps in `unknown` are jumps even if the markers do not tell how long they are; their standard
    deviations (3,) are then those in it.
    """
    steps = np.union1d(suspects, list(unknown)).astype(int)
    steps = steps[np.argsort(rank[steps], kind="stable")]
    usual = _usual(drive)
    drive = drive.with_variance(steps, UNKNOWN_SIGMA[1:]**2)
    tried = []
    for i, k in enumerate(steps):
        if rank[k] > -np.inf:                    # all pairs that tell of it may be over others, too
            drive = drive.with_variance(steps[i:], _place_and_turn(usual**2))
        without = drive.with_variance(k, 0.0)
        jump = _tried(s, without, k, unknown.get(k))
        tried.append(jump)
        if jump.found:
            drive = without.with_jump(jump)
        elif jump.gain <= MIN_GAIN:              # else one pair, maybe a wrong label
            drive = without
    return tried


def _tried(s, drive, step, unknown):
    """The _Jump in a step by Sightings, which is found if they tell it.

    Where they do not, the motion is that of odometry, with the sigma `unknown` (3,). The jump is
    then found if this is given.
    """
    move = drive.motions([step], [step + 1])
    sigma = UNKNOWN_SIGMA if unknown is None else unknown
    untold = _Jump(step, move.mean[0], motion=np.zeros(3), variance=_place_and_turn(sigma**2),
                   sigma=sigma, gain=0.0, found=unknown is not None)
    before, after = _around(s, step)
    seen = drive.seen_from(step, s, before)
    exact = replace(move, covariance=np.zeros((1, 3, 3)))
    later = exact.then(drive.seen_from(step + 1, s, after))

    def cost(motion):
        expected = replace(move, mean=motion).then(later)
        return cauchy_cost(seen.squared_distances(expected))

    without = cost(np.zeros(3))
    if unknown is None and without.sum() <= MIN_GAIN:    # no motion gains more
        return untold
    mean = np.concatenate([seen.mean, later.mean])
    covariance = np.concatenate([seen.covariance, later.covariance])
    first = np.arange(len(before))
    found = robust_increments(
        mean, covariance, np.zeros_like(first), first, first + len(first), count=1)
    variance = _place_and_turn(np.diagonal(found.covariance[0]))
    if not found.usable[0] or variance[0] > MAX_VARIANCE:
        return untold

    motion = found.increment[0]
    gain = without - cost(motion)
    others = gain.sum() - gain.max()
    return replace(untold, motion=motion, variance=variance, sigma=_sigma_of(motion),
                   gain=gain.sum(), found=untold.found or others > MIN_GAIN)


def _place_and_turn(variance):
    """Variances (2,) of place and turn, by those of x, y and heading (3,)."""
    return np.array([variance[0] + variance[1], variance[2]])


def _around(s, step):
    """Rows (2, m) of sightings before a step, and of others of the same markers after it.

    Of each marker the last PAIRS before it and the first ones after it; in all the NEAREST.
    """
    k = _followed(s)
    last = k[(s.row[k] <= step) & (step < s.row[k + 1])]
    first = np.concatenate([last - i for i in range(PAIRS)])
    second = np.concatenate([last + 1 + i for i in range(PAIRS)])
    exists = (first >= 0) & (second < len(s.row))
    pairs = np.stack([first, second])[:, exists]
    first, second = s.marker[pairs]
    pairs = pairs[:, first == second]
    first, second = s.row[pairs]
    nearest = np.argsort(second - first, kind="stable")[:NEAREST]
    return pairs[:, nearest]
