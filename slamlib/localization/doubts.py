"""Doubts about a whole drive, from increments by markers and increments by odometry.

Files with wrong columns, signs or units give increments that disagree in a known way. Each such
hypothesis predicts the increments by markers from those by the wheels. It is accepted if its robust
cost is lower than that of the unchanged files by MIN_LOG_ODDS, and if most increments then agree.

A camera or wheels with exchanged axes or signs transform an increment [x, y, heading] to

    [A (x, y), det(A) heading],    A one of the eight symmetries of a square.

Increments alone do not determine which sensor is wrong: exchanged wheels and a camera mirrored in y
and theta have the same A. Ranges decide it if the guesses of the antennas are accurate enough.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib import counts, increments, se2
from slamlib.doubt import Doubt
from slamlib.localization.marker_increments import consecutive_increments
from slamlib.localization.units import (
    median_motions,
    path_and_antennas,
    range_units,
    sighting_units,
    sigma_units,
)
from slamlib.sightings import GATE, MAX_HEADING_SIGMA, sightings_by_frame

GENEROUS_SLIP = 1e-2      # sqrt(m), slip of the wheels that explains a difference
GENEROUS_WHEEL = 0.03     # relative standard deviation of the wheel parameters, likewise
SPAN = 1.0                # m, distance over which increments are compared
MAX_POSES = 200_000       # number of poses, the first ones of a drive, that are examined
MAX_FRAMES = 20           # number of frames between the poses of an increment
MIN_INCREMENTS = 10       # number of increments for a decision
MIN_MOTION_SIGMAS = 5.0   # sigmas of distance or turn from which on the vehicle moves
MIN_LOG_ODDS = 10.0       # log odds by which a hypothesis explains the increments better
MIN_AGREEING_SHARE = 0.7  # share of the increments that agree with an accepted hypothesis
AGREEMENT_GATE = 7.8147   # squared Mahalanobis distance of increments that agree: the 95 %
                          # quantile of chi-squared with 3 degrees of freedom
MIN_DISAGREEMENT = 4.0   # standard errors of the mean agreement of headings and positions below 0
MIN_FIT_RATIO = 3.0       # ratio of the ranges' median residuals that decides between two paths


@dataclass(frozen=True)
class _Axes:
    """A transformation of axes or signs, and the changes of the files that undo it."""

    A: tuple              # 2 x 2, of an increment's x and y
    motion: str           # of the vehicle by the markers, compared with the wheels
    sightings: str = ""   # change of x and y in ArucoReading.txt
    wheels: tuple = ()    # kind of doubt, change of the counts, and what to look at; empty if no
                          # error of the counts explains A


AXES = (
    _Axes(A=((1, 0), (0, 1)), motion="moves as"),
    _Axes(A=((1, 0), (0, -1)), motion="turns the other way than",
          sightings="the other sign of y",
          wheels=("wheels-swapped", "the columns exchanged", "the order of right and left")),
    _Axes(A=((-1, 0), (0, 1)), motion="drives and turns the other way than",
          sightings="the other sign of x",
          wheels=("wheels-reversed", "both signs reversed", "the signs of the counts")),
    _Axes(A=((-1, 0), (0, -1)), motion="drives the other way than",
          sightings="the other signs of x and y",
          wheels=("wheels-reversed", "both signs reversed and the columns exchanged",
                  "the signs of the counts and the order of right and left")),
    _Axes(A=((0, -1), (1, 0)), motion="moves to the left where it moves forwards",
          sightings="axes turned by a right angle"),
    _Axes(A=((0, 1), (-1, 0)), motion="moves to the right where it moves forwards",
          sightings="axes turned by a right angle"),
    _Axes(A=((0, 1), (1, 0)),
          motion="turns the other way, and moves to the left where it moves forwards,",
          sightings="x and y exchanged"),
    _Axes(A=((0, -1), (-1, 0)),
          motion="turns the other way, and moves to the right where it moves forwards,",
          sightings="x and y exchanged, with the other signs"))
CONTRADICTION = Doubt("camera-mirrored", (
    "While the vehicle turns, the markers' positions and headings theta turn against each other: "
    "look at the signs of x, y and theta in ArucoReading.txt."))


@dataclass(frozen=True)
class _Compared:
    """Increments of the moving vehicle between n pairs of frames, by markers and by wheels."""

    marker_increments: np.ndarray    # (n, 3) m and rad
    wheel_increments: np.ndarray     # (n, 3)
    covariance_markers: np.ndarray   # (n, 3, 3)
    covariance_wheels: np.ndarray    # (n, 3, 3), with GENEROUS_SLIP and GENEROUS_WHEEL
    weight: float                    # 1 / number of increments that overlap

    def squared_distances(self, A):
        """Squared Mahalanobis distances (n,) if the wheels' axes are transformed by A (2, 2)."""
        B = np.zeros((3, 3))
        B[:2, :2], B[2, 2] = A, np.linalg.det(A)
        r = self.marker_increments - self.wheel_increments @ B.T
        r[:, 2] = se2.wrap(r[:, 2])
        W = self.covariance_markers + B @ self.covariance_wheels @ B.T
        return np.einsum("ni,ni->n", r, np.linalg.solve(W, r[..., None])[..., 0])

    def sigma(self):
        """Median standard deviations (2,) of distance and turn by markers, in m and rad."""
        variance = np.median(np.diagonal(self.covariance_markers, axis1=1, axis2=2), axis=0)
        return np.sqrt([variance[0] + variance[1], variance[2]])

    def cost(self, squared):
        """Robust cost in log odds: Cauchy's, of squared Mahalanobis distances (n,)."""
        return self.weight * GATE / 2 * np.sum(np.log1p(squared / GATE))


def doubts_before_solving(dataset):
    """List of Doubts about the files of a Dataset; empty where measurements are too few to decide.

    Kinds are units, wheels-swapped, wheels-reversed, camera-mirrored, camera-turned, odometry and
    counts-since-start. At most one error of sightings and counts is named, with all explanations.
    """
    dataset = dataset.first(MAX_POSES)
    unit_doubts = range_units(dataset) + sigma_units(dataset)
    sightings = sightings_by_frame(dataset.aruco)
    if len(sightings.frame) <= MIN_INCREMENTS:
        return _counts_doubts(dataset) + unit_doubts
    found = consecutive_increments(sightings)
    contradicting = _headings_contradict(sightings, found)
    if contradicting:
        sign = np.array([1.0, 1.0, -1.0])
        sightings = replace(sightings, z=sightings.z * sign, C=sightings.C * np.outer(sign, sign))
        found = consecutive_increments(sightings)
    compared = _compare(dataset, sightings, found)
    if len(compared.marker_increments) < MIN_INCREMENTS:
        return _counts_doubts(dataset) + unit_doubts
    return (sighting_units(compared.marker_increments, compared.wheel_increments, compared.sigma())
            or _axes_doubts(dataset, compared, contradicting)
            or _odometry_doubts(compared)) + unit_doubts


def _counts_doubts(dataset):
    """A Doubt if the counts may be those since the start; only for drives with few sightings."""
    if not counts.may_be_cumulative(dataset.ticks, dataset.vehicle):
        return []
    return [Doubt("counts-since-start", (
        "The counts in encoderReading.txt change gradually from row to row, up to "
        f"{abs(dataset.ticks).max()} in one row: either the vehicle speeds up gradually to that, "
        "or they are counts since the start, where those since the previous pose are expected. "
        "Look at encoderReading.txt."))]


def _headings_contradict(sightings, found):
    """True if headings of markers and directions between their positions turn oppositely.

    Between two frames both turn by the negative turn of the vehicle. If an odd number of the signs
    of x, y and heading is wrong, they turn oppositely.
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
    return bool(len(same) >= MIN_INCREMENTS and agreement.sum() < -MIN_DISAGREEMENT * error)


def _compare(dataset, sightings, found):
    """The _Compared of a Dataset, its Sightings and MarkerIncrements between consecutive frames.

    Increments by markers are composed over about SPAN, where turns are well above the noise.
    """
    frame = sightings.frame
    args = dataset.ticks, dataset.vehicle
    step, _ = increments.between_poses(*args, frame[:-1], frame[1:], "arc")
    typical = max(np.median(np.hypot(*step[:, :2].T)), SPAN / MAX_FRAMES)
    span = int(np.ceil(SPAN / typical))
    complete = np.convolve(found.usable, np.ones(span), "valid") == span \
        if len(found.usable) >= span else []
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
    generous = (increments.noise_covariances(*args, start, end, GENEROUS_SLIP)
                + by_w @ np.swapaxes(by_w, 1, 2))
    moving = _moves(by_markers, covariance) | _moves(by_wheels, generous)
    return _Compared(marker_increments=by_markers[moving], wheel_increments=by_wheels[moving],
                     covariance_markers=covariance[moving], covariance_wheels=generous[moving],
                     weight=1 / span)


def _moves(increment, covariance):
    """Mask (n,) of increments (n, 3) whose distance or turn is above MIN_MOTION_SIGMAS sigmas."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    far = np.sum(increment[:, :2]**2, axis=1) > MIN_MOTION_SIGMAS**2 * variance[:, :2].sum(axis=1)
    return far | (np.abs(se2.wrap(increment[:, 2])) > MIN_MOTION_SIGMAS * np.sqrt(variance[:, 2]))


def _axes_doubts(dataset, compared, contradicting):
    """Doubts that axes or signs are exchanged; `contradicting` if theta's sign was reversed."""
    squared = [compared.squared_distances(np.array(axes.A, float)) for axes in AXES]
    costs = np.array([compared.cost(distances) for distances in squared])
    best = costs.argmin()
    agree = np.mean(squared[best] < AGREEMENT_GATE) >= MIN_AGREEING_SHARE
    if not agree or not (contradicting or costs[0] - costs[best] >= MIN_LOG_ODDS):
        return [CONTRADICTION] if contradicting else []
    doubts = []
    for k in np.flatnonzero(costs < costs[best] + MIN_LOG_ODDS):       # the drive may be straight
        nearer = np.mean(squared[k] < squared[0])
        doubts += _explanations(dataset, AXES[k], contradicting, nearer, len(squared[k]))
    return list({doubt.what: doubt for doubt in reversed(doubts)}.values())[::-1]


def _explanations(dataset, axes, contradicting, nearer, count):
    """Doubts that explain transformed axes, the likeliest first.

    `nearer` is the share of the `count` increments that the transformed wheels explain better.
    """
    mirrored = np.linalg.det(axes.A) < 0
    theta = "the other sign of theta" if mirrored != contradicting else ""
    change = " and ".join(filter(None, (axes.sightings, theta)))
    kind = "camera-mirrored" if mirrored or contradicting else "camera-turned"
    camera = f"sightings with {change} (look at x, y and theta in ArucoReading.txt)"
    if contradicting:
        return [Doubt(kind, f"{CONTRADICTION.sentence} They agree for {camera}.")]
    evidence = (f"By the markers the vehicle {axes.motion} by the wheels: with {{}}, increments by "
                f"both agree better at {nearer:.0%} of {count} places.")
    if not axes.wheels:
        return [Doubt(kind, evidence.format(camera))]
    wheels_kind, change, look = axes.wheels
    wheels = f"{change} in encoderReading.txt (look at {look})"
    doubts = [Doubt(wheels_kind, evidence.format(wheels)), Doubt(kind, evidence.format(camera))]
    fits = _range_residuals(dataset, axes.A)
    if max(fits) < MIN_FIT_RATIO * min(fits):
        return [replace(doubt, sentence=f"{doubt.sentence} Equally possible: {alternative}.")
                for doubt, alternative in zip(doubts, (camera, wheels))]
    doubt = doubts[np.argmin(fits)]
    return [replace(doubt, sentence=(
        f"{doubt.sentence} The ranges to the guessed antennas differ from this path by "
        f"{min(fits):.2g} m (median), from the other explanation's by {max(fits):.2g} m."))]


def _range_residuals(dataset, A):
    """Median residuals in m of ranges to the guessed antennas, by two paths; (1, 1) without ranges.

    The first path is odometry transformed by A, which is right if the wheels are wrong. The second
    one is odometry.
    """
    path, antennas = path_and_antennas(dataset)
    if not antennas:
        return 1.0, 1.0
    return [np.median([np.median(np.abs(np.hypot(*(positions[pose] - guess).T) - r))
                       for pose, r, guess in antennas])
            for positions in (path @ np.transpose(A), path)]


def _odometry_doubts(compared):
    """A Doubt if most increments by markers and by wheels disagree without an explanation."""
    squared = compared.squared_distances(np.eye(2))
    share = np.mean(squared > AGREEMENT_GATE)
    if share < 0.5:
        return []
    lengths, turns = median_motions(compared.marker_increments, compared.wheel_increments)
    return [Doubt("odometry", (
        f"Increments of the vehicle by markers and by wheels disagree beyond their noise at "
        f"{share:.0%} of {len(squared)} places: by the markers it moves by {lengths[0]:.3g} m and "
        f"turns by {turns[0]:.3g} rad, by the wheels {lengths[1]:.3g} m and {turns[1]:.3g} rad "
        "(medians). Look whether encoderReading.txt and ArucoReading.txt are of the same drive and "
        "count the same poses."))]
