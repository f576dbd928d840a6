"""Doubts about a whole drive, from increments by markers against increments by odometry.

Files whose columns, signs or units are wrong give increments that disagree in a way that is
known in advance. Each such hypothesis predicts the increments by markers from those by the wheels;
it is accepted if its robust cost is decisively lower than that of the file as it is, and if most
increments then agree. Everything here takes the files as they are, before any graph is built.

A camera or wheels with exchanged axes or signs transform an increment [x, y, heading] to

    [A (x, y), det(A) heading],    A one of the eight symmetries of a square.

Increments do not tell whose axes they are: exchanged wheels and a camera mirrored in y and theta
are the same A. Ranges to antennas tell it where the antennas' guessed places are better than that.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib import counts, increments, se2
from slamlib.doubt import Doubt
from slamlib.localization.marker_increments import consecutive_increments
from slamlib.localization.units import path_and_antennas, range_units, sighting_units, sigma_units
from slamlib.sightings import GATE, MAX_HEADING_SIGMA, sightings_by_frame

GENEROUS_SLIP = 1e-2      # sqrt(m), slip of the wheels that explains a difference
GENEROUS_WHEEL = 0.03     # relative standard deviation of the wheel parameters, likewise
SPAN = 1.0                # m, distance over which increments are compared
MANY_POSES = 200_000      # of a longer drive, the first ones are looked at
MAX_FRAMES = 20           # between the poses of an increment
MIN_INCREMENTS = 10       # fewer of them decide nothing
MOVING = 5.0              # sigmas of distance or turn, by markers or wheels, from no motion
DECISIVE = 10.0           # log odds by which a hypothesis explains the increments better
MOST = 0.7                # share of the increments that agree with an accepted hypothesis
AGREEMENT = 7.8147             # squared Mahalanobis distance of increments that agree: the 95 %
                               # quantile of chi-squared with 3 degrees of freedom
CONTRADICTING = 4.0       # standard errors of the mean agreement of headings and positions below 0
BETTER_FIT = 3.0          # ratio of the ranges' median residuals that decides between two paths


@dataclass(frozen=True)
class _Axes:
    """One way to exchange axes or signs, and what in the files explains it."""

    A: tuple              # 2 x 2, of an increment's x and y
    seen: str             # how the vehicle moves by the markers, beside the wheels
    sightings: str        # what mends x and y of the sightings
    wheels: str = ""      # name of the doubt about the wheels; empty if they do not explain it
    counts: str = ""      # what mends the counts of the wheels
    look: str = ""        # at what in encoderReading.txt


AS_IT_IS = _Axes(((1, 0), (0, 1)), "moves as", "")
AXES = (
    _Axes(((1, 0), (0, -1)), "turns the other way than", "the other sign of y",
          "wheels-swapped", "the columns exchanged", "the order of right and left"),
    _Axes(((-1, 0), (0, 1)), "drives and turns the other way than", "the other sign of x",
          "wheels-reversed", "both signs reversed", "the signs of the counts"),
    _Axes(((-1, 0), (0, -1)), "drives the other way than", "the other signs of x and y",
          "wheels-reversed", "both signs reversed and the columns exchanged",
          "the signs of the counts and the order of right and left"),
    _Axes(((0, -1), (1, 0)), "moves to the left where it moves forwards",
          "axes turned by a right angle"),
    _Axes(((0, 1), (-1, 0)), "moves to the right where it moves forwards",
          "axes turned by a right angle"),
    _Axes(((0, 1), (1, 0)), "turns the other way, and moves to the left where it moves forwards,",
          "x and y exchanged"),
    _Axes(((0, -1), (-1, 0)),
          "turns the other way, and moves to the right where it moves forwards,",
          "x and y exchanged, with the other signs"))


@dataclass(frozen=True)
class _Compared:
    """Increments between n pairs of frames, of the moving vehicle, by markers and by wheels."""

    by_markers: np.ndarray           # (n, 3) m and rad
    by_wheels: np.ndarray            # (n, 3)
    covariance_markers: np.ndarray   # (n, 3, 3)
    covariance_wheels: np.ndarray    # (n, 3, 3), generous
    weight: float                    # 1 / number of increments that overlap

    def squared_distances(self, A):
        """Squared Mahalanobis distances (n,) if the wheels' axes are transformed by A (2, 2)."""
        B = np.zeros((3, 3))
        B[:2, :2], B[2, 2] = A, np.linalg.det(A)
        r = self.by_markers - self.by_wheels @ B.T
        r[:, 2] = se2.wrap(r[:, 2])
        W = self.covariance_markers + B @ self.covariance_wheels @ B.T
        return np.einsum("ni,ni->n", r, np.linalg.solve(W, r[..., None])[..., 0])

    def sigma(self):
        """Median standard deviations (2,) of distance and turn by markers, m and rad."""
        variance = np.median(np.diagonal(self.covariance_markers, axis1=1, axis2=2), axis=0)
        return np.sqrt([variance[0] + variance[1], variance[2]])

    def cost(self, squared):
        """Robust cost in units of log odds: Cauchy's, of squared Mahalanobis distances (n,)."""
        return self.weight * GATE / 2 * np.sum(np.log1p(squared / GATE))


def drive_doubts(dataset):
    """List of Doubts about the files of a drive, a Dataset; empty if too little was seen to decide.

    Kinds are units, wheels-swapped, wheels-reversed, camera-mirrored, camera-turned, odometry and
    counts-since-start. At most one flaw of sightings and counts is named, with all that explains
    it.
    """
    dataset = dataset.first(MANY_POSES)
    others, sightings = range_units(dataset) + sigma_units(dataset), sightings_by_frame(
        dataset.aruco)
    if len(sightings.frame) <= MIN_INCREMENTS:
        return _counts_doubts(dataset) + others
    found = consecutive_increments(sightings)
    contradicting = _headings_contradict(sightings, found)
    if contradicting:
        sign = np.array([1.0, 1.0, -1.0])
        sightings = replace(sightings, z=sightings.z * sign, C=sightings.C * np.outer(sign, sign))
        found = consecutive_increments(sightings)
    compared = _compare(dataset, sightings, found)
    if len(compared.by_markers) < MIN_INCREMENTS:
        return _counts_doubts(dataset) + others
    units = sighting_units(compared.by_markers, compared.by_wheels, compared.sigma())
    return units + others if units else (
        _axes_doubts(dataset, compared, contradicting) or _odometry_doubts(compared)) + others


def _counts_doubts(dataset):
    """A Doubt if counts may be those since the start; markers decide where there are enough."""
    if not counts.may_be_cumulative(dataset.ticks, dataset.vehicle):
        return []
    most = abs(dataset.ticks).max()
    return [Doubt("counts-since-start", (
        f"The counts in encoderReading.txt change gradually from row to row, up to {most} in one "
        "row: either the vehicle speeds up gradually to that, or they are counts since the start, "
        "where those since the previous pose are expected. Look at encoderReading.txt."))]


def _headings_contradict(sightings, found):
    """True if the headings of markers turn against the directions between their positions.

    While the vehicle turns one way, both turn the other way between two frames. If an odd number of
    the signs of x, y and heading is wrong, they turn against each other.
    """
    same = np.flatnonzero(np.diff(found.pair) == 0)
    a, b = found.first, found.second
    known = np.sqrt(np.maximum(sightings.C[a, 2, 2], sightings.C[b, 2, 2])) < MAX_HEADING_SIGMA
    same = same[known[same]]
    turn = se2.wrap(sightings.z[b, 2] - sightings.z[a, 2])[same]
    d = [np.diff(sightings.z[rows, :2], axis=0)[same] for rows in (a, b)]
    seen_turn = se2.wrap(np.arctan2(d[1][:, 1], d[1][:, 0]) - np.arctan2(d[0][:, 1], d[0][:, 0]))
    smaller = np.minimum(np.abs(turn), np.abs(seen_turn))
    smaller = np.minimum(smaller, np.median(smaller) if len(same) else 0)    # wrong labels
    agreement = np.sign(turn * seen_turn) * smaller
    error = np.sqrt(np.sum(agreement**2))
    return bool(len(same) >= MIN_INCREMENTS and agreement.sum() < -CONTRADICTING * error)


def _compare(dataset, sightings, found):
    """The _Compared of a Dataset, its Sightings and MarkerIncrements between consecutive frames.

    Increments by markers are composed over about SPAN, over which a turn is well above the noise.
    """
    frame, l = sightings.frame, len(found.increment)
    args = dataset.ticks, dataset.vehicle
    step, _ = increments.between_poses(*args, frame[:-1], frame[1:], "arc")
    typical = max(np.median(np.hypot(*step[:, :2].T)), SPAN / MAX_FRAMES)
    span = int(np.ceil(SPAN / typical))
    complete = np.convolve(found.usable, np.ones(span), "valid") == span if l >= span else []
    if np.count_nonzero(complete) < MIN_INCREMENTS * span:
        span, complete = 1, found.usable
    begin = np.flatnonzero(complete)
    by_markers, covariance = found.increment[begin], found.covariance[begin]
    for k in range(1, span):
        by_first, by_second = se2.compose_jacobians(by_markers, found.increment[begin + k])
        by_markers = se2.compose(by_markers, found.increment[begin + k])
        covariance = by_first @ covariance @ np.swapaxes(by_first, 1, 2) \
            + by_second @ found.covariance[begin + k] @ np.swapaxes(by_second, 1, 2)
    start, end = frame[begin], frame[begin + span]
    by_wheels, by_w = increments.between_poses(*args, start, end, "arc")
    by_w = by_w * (GENEROUS_WHEEL * dataset.vehicle.wheel)
    generous = increments.noise(*args, start, end, GENEROUS_SLIP) + by_w @ np.swapaxes(by_w, 1, 2)
    moving = _moves(by_markers, covariance) | _moves(by_wheels, generous)
    return _Compared(by_markers[moving], by_wheels[moving], covariance[moving], generous[moving],
                     1 / span)


def _moves(increment, covariance):
    """Mask (n,) of increments (n, 3) whose distance or turn is above MOVING sigmas."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    far = np.sum(increment[:, :2]**2, axis=1) > MOVING**2 * variance[:, :2].sum(axis=1)
    return far | (np.abs(se2.wrap(increment[:, 2])) > MOVING * np.sqrt(variance[:, 2]))


def _axes_doubts(dataset, compared, contradicting):
    """Doubts that axes or signs are exchanged; `contradicting` if theta's sign was reversed."""
    candidates = (AS_IT_IS, *AXES)
    squared = [compared.squared_distances(np.array(axes.A, float)) for axes in candidates]
    costs = np.array([compared.cost(each) for each in squared])
    best = costs.argmin()
    agreeing = np.mean(squared[best] < AGREEMENT)
    if agreeing < MOST or (not contradicting and costs[0] - costs[best] < DECISIVE):
        return [_contradiction()] if contradicting else []
    doubts = []
    for k in np.flatnonzero(costs < costs[best] + DECISIVE):          # the drive may be straight
        nearer = np.mean(squared[k] < squared[0])
        doubts += _explanations(dataset, candidates[k], contradicting, nearer, len(squared[k]))
    return list({doubt.what: doubt for doubt in reversed(doubts)}.values())[::-1]


def _contradiction():
    return Doubt("camera-mirrored", (
        "While the vehicle turns, the markers' positions and headings theta turn against each "
        "other: look at the signs of x, y and theta in ArucoReading.txt."))


def _explanations(dataset, axes, contradicting, nearer, count):
    """Doubts that explain transformed axes, the likeliest first.

    `nearer` is the share of the `count` increments that the transformed wheels explain better.
    """
    mirrored = np.linalg.det(axes.A) < 0
    theta = ["the other sign of theta"] if mirrored != contradicting else []
    mend = " and ".join(([axes.sightings] if axes.sightings else []) + theta)
    name = "camera-mirrored" if mirrored or contradicting else "camera-turned"
    camera = f"sightings with {mend} (look at x, y and theta in ArucoReading.txt)"
    if contradicting:
        return [Doubt(name, _contradiction().sentence + f" They agree for {camera}.")]
    seen = (f"By the markers the vehicle {axes.seen} by the wheels: with {{}}, increments by both "
            f"agree better at {nearer:.0%} of {count} places.")
    if not axes.wheels:
        return [Doubt(name, seen.format(camera))]
    wheels = f"{axes.counts} in encoderReading.txt (look at {axes.look})"
    doubts = [Doubt(axes.wheels, seen.format(wheels)), Doubt(name, seen.format(camera))]
    side, fit = _by_ranges(dataset, axes.A)
    if side is not None:
        return [replace(doubts[side], sentence=f"{doubts[side].sentence} {fit}")]
    return [replace(doubt, sentence=f"{doubt.sentence} Equally possible: {other}.")
            for doubt, other in zip(doubts, (camera, wheels))]


def _by_ranges(dataset, A):
    """0 if the path by the wheels is wrong by ranges to the guessed antennas, 1 if it is right.

    None if ranges do not decide between odometry's path and the path transformed by A. The second
    value is a sentence.
    """
    if dataset.uwb is None:
        return None, ""
    path, antennas = path_and_antennas(dataset)
    if not antennas:
        return None, ""
    fits = [np.median([np.median(np.abs(np.hypot(*(each[pose] - guess).T) - r))
                       for pose, r, guess in antennas])
            for each in (path @ np.transpose(A), path)]
    side = int(np.argmin(fits))
    if fits[1 - side] < BETTER_FIT * fits[side]:
        return None, ""
    return side, (f"The ranges to the guessed antennas differ from this path by {fits[side]:.2g} m "
                  f"(median), from the other explanation's by {fits[1 - side]:.2g} m.")


def _odometry_doubts(compared):
    """A Doubt if most increments by markers and by wheels disagree and no hypothesis says why."""
    squared = compared.squared_distances(np.eye(2))
    share = np.mean(squared > AGREEMENT)
    if share < 0.5:
        return []
    lengths, turns = zip(*((np.median(np.hypot(*each[:, :2].T)),
                            np.median(np.abs(se2.wrap(each[:, 2]))))
                           for each in (compared.by_markers, compared.by_wheels)))
    return [Doubt("odometry", (
        f"Increments of the vehicle by markers and by wheels disagree beyond their noise at "
        f"{share:.0%} of {len(squared)} places: by the markers it moves by {lengths[0]:.3g} m and "
        f"turns by {turns[0]:.3g} rad, by the wheels {lengths[1]:.3g} m and {turns[1]:.3g} rad "
        "(medians). Look whether encoderReading.txt and ArucoReading.txt are of the same drive and "
        "count the same poses."))]
