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
with it. Where all markers change at once and none of them is known, the motion is unknown.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.marker_increments import robust_increments
from slamlib.core.sightings import GATE, sightings_by_frame

# Noise of odometry, generous
SLIP = 0.03                  # sqrt(m), of a wheel after one metre
FLOOR = 3e-3                 # m and rad, of an increment
LAGS = np.arange(-12, 13, 2)         # poses, by which all sightings may be late
LEVER = 0.12                 # m, by which the camera may be elsewhere than stated
# Decisions; gains are of twice the log likelihood
SUSPECT = 7.8                # 95 % quantile of chi-squared with three degrees of freedom
MEDIAN_SQUARED = 2.366       # its median
MIN_GAIN = 12.0              # by a jump
MIN_LAG_GAIN = 50.0          # by a lag
MAX_LAG_COST = 0.8           # of that without it; with slip a wrong lag costs 0.95
PAIRS = 2                    # of sightings of each marker that tell of a jump: one may be wrong
NEAREST = 24                 # number of these pairs, by the frames between them
MAX_VARIANCE = 1.0           # m^2, of the place after a jump
WELL_INSIDE = 0.15, 0.85      # quantiles of x and of y at which markers are seen
MIN_MISSED = 6               # number of sightings that should be there, and are not
# Jumps in odometry
USUAL = 0.9                  # probability of the quantile of motions that is a usual one
MIN_JUMP = 0.1               # m and rad, least standard deviation of the motion
MAX_UNSUPPORTED = 2          # number of jumps; sensors that have more of them may be poor
UNKNOWN_SIGMA = np.array([10.0, 10.0, np.pi])  # m, m, rad, if no marker tells
SPIKE = 3.0                  # ratio to the counts of fast steps, above which a step is the jump
SPIKE_CHANCE = 1e6           # of a jump in such a step, relative to others


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

    @property
    def are_few(self):
        """Whether there are jumps, but few that no spike of the counts supports."""
        supported = self.chance[self.end] - self.chance[self.start] >= SPIKE_CHANCE
        return len(self.start) > 0 and np.sum(~supported) <= MAX_UNSUPPORTED

    def share(self, start, end):
        """Probabilities (m, g) that the jumps are in increments between encoder poses (m,)."""
        begin, end = np.maximum(start[:, None], self.start), np.minimum(end[:, None], self.end)
        return np.where(begin < end, self.chance[end] - self.chance[begin], 0.0) \
            / (self.chance[self.end] - self.chance[self.start])

    def added(self, start, end):
        """Motions (m, 3) to add to such increments, in the axes of their ends, and covariances."""
        share = self.share(start, end)
        return (share @ se2.between(self.by_odometry, self.increment),
                (share @ self.sigma**2)[:, :, None] * np.eye(3))

    def joined_by(self, start, end, increment, by_odometry, count):
        """The Jumps and one more, of `count` encoder poses."""
        k = np.searchsorted(self.start, start)
        sigma = _sigma_of(se2.compose(increment, se2.inverse(by_odometry)))
        chance = self.chance if len(self.start) else np.arange(float(count))
        return replace(self, chance=chance, **{
            name: np.insert(getattr(self, name), k, each, axis=0) for name, each in (
                ("start", start), ("end", end), ("increment", increment),
                ("by_odometry", by_odometry), ("sigma", sigma))})

    def mended(self, pose, poses, begin=0):
        """Poses (f, 3) of the encoder poses (f,), with these increments instead of odometry's.

        Jumps up to the encoder pose `begin` are mended already.
        """
        for start, end, increment in zip(self.start, self.end, self.increment):
            if begin < end <= pose[-1]:
                i, k = np.searchsorted(pose, [start, end])
                poses = _moved(poses, k, se2.compose(poses[i], increment))
        return poses


NO_JUMPS = Jumps(*np.zeros((2, 0), int), *np.zeros((3, 0, 3)), chance=np.zeros(1))   # none at all


def _sigma_of(jump):
    """Standard deviations (3,) of a motion that may be as large as the jump (3,)."""
    return np.maximum(np.r_[[np.hypot(*jump[:2])] * 2, abs(jump[2])], MIN_JUMP)


def find_jumps(dataset):
    """The Jumps of a Dataset, by its sightings as the stated camera has them."""
    s = sightings_by_frame(dataset.sightings)
    if len(s.frame) < 2:
        return NO_JUMPS
    order = np.lexsort((s.row, s.marker))
    s = replace(s, **{name: getattr(s, name)[order] for name in ("row", "marker", "z", "C")})
    # Sightings that are late contradict odometry wherever the speed changes.
    path = odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc")
    late = [s.frame - round(dataset.vehicle.sighting_lag) - lag for lag in LAGS]
    drives = [_Drive.without_jumps(path[np.clip(each, 0, len(path) - 1)], dataset.vehicle.wheelbase)
              for each in late]
    cost = [_cost(_compared(s, each)[2]).sum() for each in drives]
    stated, best = len(LAGS) // 2, int(np.argmin(cost))
    best = best if cost[best] < min(
        cost[stated] - MIN_LAG_GAIN, MAX_LAG_COST * cost[stated]) else stated
    found = (_jumps(dataset, s, drives[each]) for each in sorted({stated, best}))
    return replace(min(found, key=lambda jumps: len(jumps.start)), lag=LAGS[best])


def _jumps(dataset, s, drive):
    """The Jumps by a _Drive, and sightings sorted by marker, then frame."""
    first, second, squared = _compared(s, drive)
    close = _compared(s, drive, slip=0.0)[2][second - first == 1]
    scale = max(1.0, np.median(close) / MEDIAN_SQUARED) if len(close) else 1.0
    suspects, rank = _suspects(first, second, squared / scale, len(drive.way) - 1)
    agreeing = (second - first < 4) & (squared < GATE * scale)
    breaks = _breaks(s, drive.poses, first[agreeing], second[agreeing])
    scaled = replace(s, C=scale * s.C)
    found, contradicted = _bridged(scaled, drive, suspects, breaks, rank)
    dead = _dead(dataset.ticks, s.frame, contradicted)
    if len(dead):
        found, _ = _bridged(scaled, drive, np.union1d(suspects, dead), breaks, rank, dead)
    if not found:
        return NO_JUMPS
    k, increment, by_odometry, sigma = map(np.array, zip(*found))
    counts = np.abs(dataset.ticks).max(axis=1)
    spike = counts > SPIKE * np.quantile(counts, 0.99)
    return Jumps(start=s.frame[k], end=s.frame[k + 1], increment=increment, by_odometry=by_odometry,
                 sigma=sigma, chance=np.cumsum(np.where(spike, SPIKE_CHANCE, 1.0)))


def _bridged(s, drive, suspects, breaks, rank, dead=()):
    """Ascending list of step, increment, that by odometry, and sigma of each jump.

    Also a list of the steps that any pair contradicts. Steps are taken by their `rank` (f-1,).
    Those in `breaks` and `dead` are jumps, also if the markers do not tell how long they are.
    """
    found, contradicted, steps = [], [], np.union1d(suspects, breaks).astype(int)
    moves = np.abs(se2.between(drive.poses[:-1], drive.poses[1:]))
    usual = np.maximum(np.quantile(moves, USUAL, axis=0)[[0, 0, 2]], MIN_JUMP)
    drive = drive.with_variance(steps, *UNKNOWN_SIGMA[1:]**2)
    steps = steps[np.argsort(rank[steps], kind="stable")]
    for i, k in enumerate(steps.tolist()):
        if rank[k] > -np.inf:                    # all pairs that tell of it may span others, too
            drive = drive.with_variance(steps[i:], 2 * usual[0]**2, usual[2]**2)
        known = drive.with_variance(k, 0.0, 0.0)
        jump, covariance, gain, told = _jump(s, known, k)
        contradicted += [k] if gain > MIN_GAIN else []
        if not told and k not in breaks and k not in dead:
            drive = drive if gain > MIN_GAIN else known        # one pair, maybe a wrong label
            continue
        drive = known
        sigma = _sigma_of(jump)
        if covariance is None:
            sigma = UNKNOWN_SIGMA if k in breaks else 2 * usual
            covariance = np.diag(sigma**2)
        by_odometry = se2.between(drive.poses[k], drive.poses[k + 1])
        increment = se2.compose(jump, by_odometry)
        found.append((k, increment, by_odometry, sigma))
        drive = drive.with_variance(k, np.trace(covariance[:2, :2]), covariance[2, 2])
        drive = replace(drive, poses=_moved(
            drive.poses, k + 1, se2.compose(drive.poses[k], increment)))
    return sorted(found, key=lambda jump: jump[0]), contradicted


def _dead(ticks, frame, contradicted):
    """Steps from frame to frame in which a wheel is dead.

    It counts nothing there, in a run of zeros in which half of the steps are in `contradicted`.
    """
    dead, told = np.zeros(len(ticks), bool), np.isin(np.arange(len(frame) - 1), contradicted)
    for zero in (ticks == 0).T:
        run, total = np.cumsum(~zero), odometry.cumulative(zero)     # a run has one number
        silent = total[frame[1:] + 1] - total[frame[:-1] + 1] == np.diff(frame)
        steps, wrong = (np.bincount(run[frame[1:]], some, len(ticks) + 1)
                        for some in (silent, silent & told))
        dead |= zero & (wrong > 0)[run] & (2 * wrong >= steps)[run]
    total = odometry.cumulative(dead)
    return np.flatnonzero(total[frame[1:] + 1] > total[frame[:-1] + 1])


@dataclass(frozen=True)
class _Drive:
    """Odometry at the frames."""

    poses: np.ndarray        # (f, 3)
    way: np.ndarray          # (f,) m, travelled so far
    variance: np.ndarray     # (f-1, 2) of a jump in each step, m^2 and rad^2
    wheelbase: float         # m

    @classmethod
    def without_jumps(cls, poses, wheelbase):
        way = odometry.cumulative(np.hypot(*np.diff(poses[:, :2], axis=0).T))
        return cls(poses, way, np.zeros((len(poses) - 1, 2)), wheelbase)

    def with_variance(self, steps, place, turn):
        """The _Drive with jumps of these variances, m^2 and rad^2, in `steps`, (m,) or one."""
        variance = self.variance.copy()
        variance[steps] = place, turn
        return replace(self, variance=variance)

    def motions(self, start, end, slip=SLIP):
        """Motions (m, 3) between frames (m,), and their covariances (m, 3, 3), roughly."""
        move, way = se2.between(self.poses[start], self.poses[end]), self.way[end] - self.way[start]
        total = odometry.cumulative(self.variance)
        place, turn = np.abs(total[end] - total[start]).T
        turn = turn + 2 * np.abs(way) * (slip / self.wheelbase)**2 + FLOOR**2
        place = place + turn * np.sum(move[:, :2]**2, axis=1) / 3 + FLOOR**2 \
            + (2 * LEVER * np.sin(se2.wrap(move[:, 2]) / 2))**2
        along = place + np.abs(way) * slip**2 / 2
        return move, np.stack([along, place, turn], -1)[:, None] * np.eye(3)


def _moved(poses, k, pose):
    """Poses (f, 3) of which pose k and the later ones have moved with pose k to `pose` (3,)."""
    return np.concatenate([poses[:k], se2.compose(pose, se2.between(poses[k], poses[k:]))])


def _compared(s, drive, slip=SLIP):
    """Frames (m,) of each sighting and of the next one of its marker, and their chi-squared."""
    k = np.flatnonzero(s.marker[:-1] == s.marker[1:])
    first, second = s.row[k], s.row[k + 1]
    z, C = se2.compose_uncertain(*drive.motions(first, second, slip), s.z[k + 1], s.C[k + 1])
    return first, second, se2.squared_distances(s.z[k], z, s.C[k] + C)


def _cost(squared):
    """Cauchy cost, twice a negative log likelihood, of squared Mahalanobis distances (m,)."""
    return GATE * np.log1p(squared / GATE)


def _spanning(first, second, count):
    """Numbers (count,) of the pairs of frames, `first` and `second` (m,), that span each step."""
    return np.cumsum(np.bincount(first, minlength=count + 1)
                     - np.bincount(second, minlength=count + 1))[:count]


def _suspects(first, second, squared, count):
    """Steps, of `count` from frame to frame, that half of the pairs of sightings contradict.

    Only sightings at these two frames are asked, if there are any; else all pairs that span it.
    Also the rank (count,) of each step: those with such sightings come first, then those that most
    contradicting pairs span. A pair over a long way does not tell where on it a jump was.
    """
    close, wrong = second - first == 1, squared > SUSPECT
    of_close, all_of, wrong_of_close, all_wrong = (
        _spanning(first[some], second[some], count)
        for some in (close, close | True, close & wrong, wrong))
    all_of, wrong_of = np.where(of_close, [of_close, wrong_of_close], [all_of, all_wrong])
    return (np.flatnonzero((wrong_of > 0) & (2 * wrong_of >= all_of)),
            np.where(of_close > 0, -np.inf, -all_wrong))


def _breaks(s, poses, first, second):
    """Steps from frame to frame in which all markers change, although odometry hardly moves.

    Markers well inside the field of view should be seen again in the next few frames. At least
    MIN_MISSED such sightings are missed, on both sides, and no pair of sightings of frames `first`
    and `second` (m,), which agree with odometry, spans the step.
    """
    count, (low, high) = len(poses) - 1, np.quantile(s.z[:, :2], WELL_INSIDE, axis=0)
    missed = np.zeros((2, count), int)
    for step in (1, 2, 3, -1, -2, -3):
        rows = np.flatnonzero((s.row + step >= 0) & (s.row + step <= count))
        there = se2.compose(se2.between(poses[s.row[rows] + step], poses[s.row[rows]]), s.z[rows])
        inside = rows[((low < there[:, :2]) & (there[:, :2] < high)).all(axis=1)]
        crossed = s.row[inside] + np.arange(min(step, 0), max(step, 0))[:, None]
        missed[int(step < 0)] += np.bincount(crossed.ravel(), minlength=count)
    return np.flatnonzero((_spanning(first, second, count) == 0) & (missed.min(axis=0) > 1)
                          & (missed.sum(axis=0) >= MIN_MISSED))


def _jump(s, drive, k):
    """The jump (3,) between the frames k and k + 1, its covariance or None, its gain.

    Also whether it is told: without the pair that gains most.
    """
    before = np.flatnonzero((s.row[:-1] <= k) & (k < s.row[1:]) & (s.marker[:-1] == s.marker[1:]))
    rows = np.concatenate([[before - i, before + 1 + i] for i in range(PAIRS)], axis=1)
    rows = rows[:, (rows[0] >= 0) & (rows[1] < len(s.row))]
    rows = rows[:, s.marker[rows[0]] == s.marker[rows[1]]]
    rows = rows[:, np.argsort(s.row[rows[1]] - s.row[rows[0]], kind="stable")[:NEAREST]]
    if not rows.size:
        return np.zeros(3), None, 0.0, False
    move, Q = drive.motions([k], [k + 1])
    (z, C), later = (se2.compose_uncertain(
        *drive.motions(np.full(len(each), end), s.row[each]), s.z[each], s.C[each])
        for each, end in zip(rows, (k, k + 1)))
    later, first = se2.compose_uncertain(move, 0 * Q, *later), np.arange(rows.shape[1])
    found = robust_increments(*map(np.concatenate, zip((z, C), later)), 0 * first, first,
                              first + len(first), 1)
    jump, covariance = found.increment[0], found.covariance[0]
    expected = [se2.compose_uncertain(each, Q, *later) for each in (np.zeros(3), jump)]
    gain = np.subtract(*(_cost(se2.squared_distances(z, each, C + W)) for each, W in expected))
    if not found.usable[0] or np.trace(covariance[:2, :2]) > MAX_VARIANCE:
        return np.zeros(3), None, 0.0, False
    return jump, covariance, gain.sum(), gain.sum() - gain.max() > MIN_GAIN
