"""Increments of the vehicle between a pair of frames, from their common markers.

With Z_j and Z'_j the sightings of marker j from the earlier and the later frame, and C_j and C'_j
their covariances, the increment Delta, the later frame in the earlier one, minimises the sum of
r_j^T W_j^-1 r_j over the accepted sightings, with

    r_j = Z_j - Delta Z'_j,    W_j = C_j + J'_j C'_j J'_j^T,    J'_j = d(Delta Z'_j) / d Z'_j.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.sightings import GATE, MAX_HEADING_SIGMA, sightings_by_frame

INCREMENT_ITERATIONS = 8, 6   # numbers of Gauss-Newton iterations: Cauchy weights, then the gate
INCREMENT_STEP_TOLERANCE = 1e-10  # m and rad; iterations end after a smaller step
SPEED_RATIO = 3.0             # ratio of the largest plausible speed to the usual speed
POINT_PAIRS = 60              # pairs of points that give hypotheses, of every pair of frames
MIN_TURN_RATE = 1e-3          # rad per encoder step; smaller differences of turn rates are ignored
MIN_GAP = 5.0                 # m, driven between two sightings of the markers of a return
MAX_RETURN_FRAMES = 400       # frames, evenly chosen, among which returns are sought
MIN_COMMON_MARKERS = 2        # markers that both frames of a return see, and that agree


@dataclass(frozen=True)
class MarkerIncrements:
    """Increments of l pairs of frames from p common sightings, which are sorted by pair."""

    pair: np.ndarray         # (p,) pair of frames of each common sighting
    first: np.ndarray        # (p,) row of the sighting from the earlier frame
    second: np.ndarray       # (p,) row of the sighting from the later frame
    accepted: np.ndarray     # (p,) bool, within the gate of a usable increment
    J_first: np.ndarray     # (p, 3, 3) derivative of the increment by the earlier sighting
    J_second: np.ndarray    # (p, 3, 3) derivative of the increment by the later sighting
    increment: np.ndarray    # (l, 3) later in earlier frame, m and rad; NaN if undetermined
    covariance: np.ndarray   # (l, 3, 3)
    usable: np.ndarray       # (l,) bool, the increment is determined and plausible


def consecutive_increments(sightings):
    """MarkerIncrements from every frame of Sightings to the next, usable if plausibly slow.

    With a single common marker there is no redundancy to reject a wrong label. The usual speed is
    the larger of the 99th percentile over increments on which two or more markers agree and the
    90th percentile over all. An increment is implausible if its speed, less three standard
    deviations, exceeds SPEED_RATIO times the usual one and its velocity differs from the previous
    and the next one. Speeds are in m and rad per encoder step, the difference of `sightings.frame`.
    """
    steps = np.diff(sightings.frame)[:, None]
    pair, first, second = common_sightings(sightings.row, sightings.marker)
    found = robust_increments(sightings.z, sightings.C, pair, first, second, len(steps))
    agreed = found.usable & (np.bincount(pair[found.accepted], minlength=len(steps)) > 1)
    if not agreed.any():
        return found
    velocity = found.increment / steps
    speed = distance_and_turn(velocity)
    bound = SPEED_RATIO * np.maximum(
        np.percentile(speed[agreed], 99, axis=0),
        np.percentile(speed[found.usable], 90, axis=0, method="lower"))
    fast = (speed > bound + 3 * distance_and_turn_sigmas(found.covariance) / steps).any(axis=1)
    change = distance_and_turn(np.diff(velocity, axis=0))   # less than half the larger velocity?
    similar = (change < np.maximum(speed[:-1], speed[1:]) / 2 + [0, MIN_TURN_RATE]).all(axis=1)
    similar = np.r_[False, similar, False]
    usable = found.usable & ~(fast & ~(similar[:-1] | similar[1:]))
    return replace(found, usable=usable, accepted=found.accepted & usable[pair])


def common_sightings(row, marker, span=1):
    """pair, first and second of `MarkerIncrements`, for pairs of frames that are `span` apart.

    `row` and `marker` (s,) are frame and marker id of every sighting, sorted by both.
    """
    markers, label = np.unique(marker, return_inverse=True)
    key, later_key = row * len(markers) + label, (row + span) * len(markers) + label
    _, first, second = np.intersect1d(later_key, key, assume_unique=True, return_indices=True)
    return row[first], first, second


def robust_increments(z, C, pair, first, second, count):
    """MarkerIncrements of `count` pairs of frames, robust against wrong labels.

    The best of several hypotheses (`_best_hypothesis`) is refined by Gauss-Newton with Cauchy
    weights, then by Gauss-Newton on the sightings within GATE: with J_j = d(Delta Z'_j) / d Delta,

        Delta <- Delta + C_Delta sum_j J_j^T W_j^-1 r_j,    C_Delta = (sum_j J_j^T W_j^-1 J_j)^-1.

    The derivatives by the sightings are D_j = C_Delta J_j^T W_j^-1 by Z_j and D'_j = -D_j J'_j by
    Z'_j. An increment is usable if the standard deviation of its heading is below
    MAX_HEADING_SIGMA. `z` (s, 3), m and rad, and `C` (s, 3, 3) are sightings and their covariances,
    `pair`, `first` and `second` (p,) those of MarkerIncrements, sorted by pair.
    """
    z1, C1, z2, C2 = z[first], C[first], z[second], C[second]
    increment = _best_hypothesis(z1, C1, z2, C2, pair, count)
    for gated, iterations in enumerate(INCREMENT_ITERATIONS):
        for _ in range(iterations):
            r, J_delta, J_second, information, squared = _residuals(
                increment[pair], z1, C1, z2, C2)
            weight = squared < GATE if gated else 1 / (1 + squared / GATE)
            gain = J_delta.mT @ information * weight[:, None, None]
            total = np.zeros((count, 3, 4))
            np.add.at(total, pair, gain @ np.concatenate([J_delta, r[..., None]], axis=2))
            regular, covariance = se2.regular(total[..., :3]), np.full((count, 3, 3), np.nan)
            covariance[regular] = np.linalg.inv(total[regular, :, :3])
            step = (covariance @ total[..., 3:])[..., 0]
            increment = increment + step
            if not np.nanmax(np.abs(step), initial=0) > INCREMENT_STEP_TOLERANCE:
                break
    increment[:, 2] = se2.wrap(increment[:, 2])
    usable = covariance[:, 2, 2] < MAX_HEADING_SIGMA**2
    D = covariance[pair] @ gain
    return MarkerIncrements(
        pair=pair, first=first, second=second, accepted=(weight > 0) & usable[pair],
        J_first=D, J_second=-D @ J_second, usable=usable, covariance=covariance,
        increment=np.where(usable[:, None], increment, np.nan))


def _residuals(increment, z1, C1, z2, C2):
    """r, J, J', W^-1 and r^T W^-1 r of each common sighting."""
    J_delta, J_second = se2.compose_jacobians(increment, z2)
    r = se2.difference(z1, se2.compose(increment, z2))
    information = np.linalg.inv(C1 + J_second @ C2 @ J_second.mT)
    return r, J_delta, J_second, information, np.einsum("ni,nij,nj->n", r, information, r)


def _best_hypothesis(z1, C1, z2, C2, pair, count):
    """The hypothesis with the smallest Cauchy cost for every pair, (count, 3).

    Hypotheses are no motion, the increment from each marker with a heading, and, in pairs without
    such a marker, the increment from two positions, of which at most POINT_PAIRS are tried.
    """
    oriented = (C1[:, 2, 2] + C2[:, 2, 2]) < MAX_HEADING_SIGMA**2
    points = [np.zeros((2, 0), int)]
    for k in np.setdiff1d(pair, pair[oriented]):
        two = np.searchsorted(pair, k) + np.array(np.triu_indices(np.sum(pair == k), 1))
        points.append(two[:, ::two.shape[1] // (POINT_PAIRS + 1) + 1])
    i, j = np.concatenate(points, axis=1)
    hypothesis = np.concatenate([
        se2.compose(z1[oriented], se2.inverse(z2[oriented])),
        _increment_of_two_points(z1[i, :2], z1[j, :2], z2[i, :2], z2[j, :2])])
    pair_of = np.concatenate([pair[oriented], pair[i]])        # those of a pair follow each other
    _, first, which = np.unique(pair_of, return_index=True, return_inverse=True)
    number = np.arange(len(pair_of)) - first[which]
    best, least = np.zeros((count, 3)), np.full(count, np.inf)
    for k in range(-1, number.max(initial=-1) + 1):
        tried = best.copy()
        tried[pair_of[number == k]] = hypothesis[number == k]
        *_, squared = _residuals(tried[pair], z1, C1, z2, C2)
        cost = np.bincount(pair, np.log1p(squared / GATE), count)
        best, least = np.where((cost < least)[:, None], tried, best), np.minimum(cost, least)
    return best


def _increment_of_two_points(p1, q1, p2, q2):
    """Delta from the positions (n, 2) of two markers: direction p to q and midpoint coincide."""
    d1, d2 = q1 - p1, q2 - p2
    turn = np.arctan2(d1[:, 1], d1[:, 0]) - np.arctan2(d2[:, 1], d2[:, 0])
    shift = (p1 + q1) / 2 - np.einsum("nij,nj->ni", se2.rotation(turn), (p2 + q2) / 2)
    return np.column_stack([shift, turn])


def distance_and_turn(increment):
    """Distance in m and size of the turn in rad, (..., 2), of increments (..., 3)."""
    return np.stack([np.linalg.norm(increment[..., :2], axis=-1),
                     np.abs(se2.wrap(increment[..., 2]))], axis=-1)


def distance_and_turn_sigmas(covariance):
    """Standard deviations (n, 2) of them, in m and rad, by covariances (n, 3, 3)."""
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2) @ [[1, 0], [1, 0], [0, 1]])


@dataclass(frozen=True)
class Returns:
    """Pairs of frames that see the same markers after a loop, and the motion between them."""

    start: np.ndarray        # (m,) pose index from 0 of the earlier frame
    end: np.ndarray          # (m,) pose index of the later frame, ascending
    motion: np.ndarray       # (m, 3) later in earlier frame, by these markers, m and rad
    covariance: np.ndarray   # (m, 3, 3) of the motion, by the covariances of the sightings

    def discrepancies(self, poses):
        """Motions (m, 3) by poses (n, 3) minus these, in the axes of the earlier frames."""
        return se2.difference(se2.between(poses[self.start], poses[self.end]), self.motion)


def returns(dataset):
    """The Returns of a Dataset after at least MIN_GAP of driving; none without markers.

    They show the error of every method without loop closures, without truth. A frame returns to the
    earlier frame with which it has most markers in common. Errors of returns are correlated: they
    share sections of odometry, and sightings.
    """
    s = sightings_by_frame(dataset.sightings)
    travelled = odometry.cumulative(np.abs(odometry.steps(dataset.ticks, dataset.vehicle)[0]))
    every = len(s.frame) // MAX_RETURN_FRAMES + 1
    sighting, frame = s.table()[::every], s.frame[::every]
    seen, distance = (sighting >= 0).astype(int), travelled[frame]
    common = (seen @ seen.T) * (distance[:, None] - distance >= MIN_GAP)  # later, earlier frames
    later = np.flatnonzero((common >= MIN_COMMON_MARKERS).any(axis=1))
    earlier = common[later].argmax(axis=1) if len(later) else later
    pair, which = np.nonzero(seen[earlier] & seen[later])
    found = robust_increments(s.z, s.C, pair, sighting[earlier[pair], which],
                              sighting[later[pair], which], len(later))
    ok = found.usable & (np.bincount(pair, found.accepted, len(later)) >= MIN_COMMON_MARKERS)
    return Returns(start=frame[earlier[ok]], end=frame[later[ok]], motion=found.increment[ok],
                   covariance=found.covariance[ok])
