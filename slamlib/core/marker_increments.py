"""Increments of the vehicle between a pair of frames, from their common markers.

With Z_j and Z'_j the sightings of marker j from the earlier and the later frame, and C_j and C'_j
their covariances, the increment Delta, the later frame in the earlier one, minimises the sum of
r_j^T W_j^-1 r_j over the accepted sightings, with

    r_j = Z_j - Delta Z'_j,    W_j = C_j + J'_j C'_j J'_j^T,    J'_j = d(Delta Z'_j) / d Z'_j.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib.core import se2
from slamlib.core.sightings import GATE, MAX_HEADING_SIGMA, Sightings

CAUCHY_ITERATIONS = 8         # Gauss-Newton iterations with Cauchy weights, at most
GATE_ITERATIONS = 6           # iterations after these, with the sightings within GATE, at most
INCREMENT_STEP_TOLERANCE = 1e-10  # m and rad; iterations end after a smaller step
SPEED_RATIO = 3.0             # ratio of the largest plausible speed to the usual speed
POINT_PAIRS = 60              # pairs of points, about, that give hypotheses, of each pair of frames
MIN_TURN_RATE = 1e-3          # rad per encoder step; smaller differences of turn rates are ignored


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


@dataclass(frozen=True)
class _Linearized:
    """Residuals of p common sightings by some increments, with their derivatives."""

    r: np.ndarray            # (p, 3)
    J_delta: np.ndarray      # (p, 3, 3) derivative of Delta Z' by Delta
    J_second: np.ndarray     # (p, 3, 3) derivative of Delta Z' by Z'
    information: np.ndarray  # (p, 3, 3) W^-1
    squared: np.ndarray      # (p,) r^T W^-1 r


@dataclass(frozen=True)
class _Common:
    """The p common sightings of l pairs of frames, sorted by pair."""

    pair: np.ndarray         # (p,)
    z1: np.ndarray           # (p, 3) from the earlier frame
    C1: np.ndarray           # (p, 3, 3)
    z2: np.ndarray           # (p, 3) from the later frame
    C2: np.ndarray           # (p, 3, 3)
    count: int               # l

    def linearized(self, increment):
        """The _Linearized of increments (l, 3)."""
        delta = increment[self.pair]
        expected, J_delta, J_second = se2.compose_with_jacobians(delta, self.z2)
        r = se2.difference(self.z1, expected)
        information = np.linalg.inv(self.C1 + J_second @ self.C2 @ J_second.mT)
        squared = np.einsum("ni,nij,nj->n", r, information, r)
        return _Linearized(r, J_delta, J_second, information, squared)

    def cost(self, increment):
        """Cauchy cost (l,) of increments (l, 3), each by the sightings of its pair."""
        squared = self.linearized(increment).squared
        return np.bincount(self.pair, np.log1p(squared / GATE), self.count)


def consecutive_increments(sightings: Sightings) -> MarkerIncrements:
    """MarkerIncrements from every frame of Sightings to the next, usable if plausibly slow.

    With a single common marker there is no redundancy to reject a wrong label. The usual speed is
    the larger of the 99th percentile over increments on which two or more markers agree and the
    90th percentile over all. An increment is implausible if its speed, less three standard
    deviations, exceeds SPEED_RATIO times the usual one and its velocity differs from the previous
    and the next one. Speeds are in m and rad per encoder step, the difference of `sightings.frame`.
    """
    steps = np.diff(sightings.frame)[:, None]
    common = common_sightings(sightings.row, sightings.marker)
    found = robust_increments(sightings.z, sightings.C, *common, len(steps))
    agreeing = np.bincount(found.pair, found.accepted, len(steps))
    redundant = found.usable & (agreeing > 1)
    if not redundant.any():
        return found
    velocity = found.increment / steps
    speed = distance_and_turn(velocity)
    usual = np.maximum(np.percentile(speed[redundant], 99, axis=0),
                       np.percentile(speed[found.usable], 90, axis=0, method="lower"))
    sigma = distance_and_turn_sigmas(found.covariance) / steps
    fast = (speed > SPEED_RATIO * usual + 3 * sigma).any(axis=1)
    usable = found.usable & ~(fast & _differs_from_neighbours(velocity))
    return replace(found, usable=usable, accepted=found.accepted & usable[found.pair])


def _differs_from_neighbours(velocity):
    """True (n,) where a velocity (n, 3) differs from the previous and from the next one.

    Two velocities are alike if distance and turn each differ by less than half the larger one, and
    the turn by MIN_TURN_RATE more.
    """
    speed = distance_and_turn(velocity)
    larger = np.maximum(speed[:-1], speed[1:])
    change = distance_and_turn(np.diff(velocity, axis=0))
    similar = (change < larger / 2 + [0, MIN_TURN_RATE]).all(axis=1)
    like_previous = np.append(False, similar)
    like_next = np.append(similar, False)
    return ~(like_previous | like_next)


def common_sightings(row: np.ndarray, marker: np.ndarray, span: int = 1) -> tuple:
    """pair, first and second of `MarkerIncrements`, for pairs of frames that are `span` apart.

    `row` and `marker` (s,) are frame and marker id of every sighting, sorted by both.
    """
    label = np.unique(marker, return_inverse=True)[1]
    key = row * len(marker) + label
    later_key = (row + span) * len(marker) + label
    _, first, second = np.intersect1d(later_key, key, assume_unique=True, return_indices=True)
    return row[first], first, second


def robust_increments(z: np.ndarray, C: np.ndarray, pair: np.ndarray, first: np.ndarray,
                      second: np.ndarray, count: int) -> MarkerIncrements:
    """MarkerIncrements of `count` pairs of frames, robust against wrong labels.

    The best of several hypotheses (`_best_hypothesis`) is refined by Gauss-Newton with Cauchy
    weights, then by Gauss-Newton on the sightings within GATE: with J_j = d(Delta Z'_j) / d Delta,

        Delta <- Delta + C_Delta sum_j J_j^T W_j^-1 r_j,    C_Delta = (sum_j J_j^T W_j^-1 J_j)^-1.

    The derivatives by the sightings are D_j = C_Delta J_j^T W_j^-1 by Z_j and D'_j = -D_j J'_j by
    Z'_j. An increment is usable if the standard deviation of its heading is below
    MAX_HEADING_SIGMA. `z` (s, 3), m and rad, and `C` (s, 3, 3) are sightings and their covariances,
    `pair`, `first` and `second` (p,) those of MarkerIncrements, sorted by pair.
    """
    common = _Common(pair, z[first], C[first], z[second], C[second], count)
    increment = _best_hypothesis(common)
    for weight_of, iterations in ((_cauchy_weight, CAUCHY_ITERATIONS),
                                  (_gate_weight, GATE_ITERATIONS)):
        for _ in range(iterations):
            linear = common.linearized(increment)
            weight = weight_of(linear.squared)
            J_t_information = linear.J_delta.mT @ linear.information * weight[:, None, None]
            step, covariance = _solved(common, linear, J_t_information)
            increment = increment + step
            if np.nanmax(np.abs(step), initial=0) <= INCREMENT_STEP_TOLERANCE:
                break
    increment[:, 2] = se2.wrap(increment[:, 2])
    usable = covariance[:, 2, 2] < MAX_HEADING_SIGMA**2
    D = covariance[pair] @ J_t_information              # of the last linearisation
    return MarkerIncrements(
        pair=pair, first=first, second=second, accepted=(weight > 0) & usable[pair],
        J_first=D, J_second=-D @ linear.J_second, covariance=covariance, usable=usable,
        increment=np.where(usable[:, None], increment, np.nan))


def _cauchy_weight(squared):
    """Weights (p,) of the Cauchy kernel, by squared Mahalanobis distances (p,)."""
    return 1 / (1 + squared / GATE)


def _gate_weight(squared):
    """True (p,) within the gate, by squared Mahalanobis distances (p,)."""
    return squared < GATE


def _solved(common, linear, J_t_information):
    """The step (l, 3) C_Delta sum_j J_j^T W_j^-1 r_j, and C_Delta; NaN where undetermined.

    `J_t_information` (p, 3, 3) are the weighted J_j^T W_j^-1.
    """
    information = np.zeros((common.count, 3, 3))
    np.add.at(information, common.pair, J_t_information @ linear.J_delta)
    vector = np.zeros((common.count, 3))
    np.add.at(vector, common.pair, np.matvec(J_t_information, linear.r))
    determined = se2.are_regular(information)
    covariance = np.full_like(information, np.nan)
    covariance[determined] = np.linalg.inv(information[determined])
    return np.matvec(covariance, vector), covariance


def _best_hypothesis(common):
    """The hypothesis with the smallest Cauchy cost for every pair, (l, 3).

    Hypotheses are no motion, the increment from each marker with a heading, and, in pairs without
    such a marker, the increment from two positions, of which about POINT_PAIRS are tried. All
    pairs try their first hypothesis at once, then their second, and so on.
    """
    pair, hypothesis = _hypotheses(common)
    _, begin, which = np.unique(pair, return_index=True, return_inverse=True)
    rank = np.arange(len(pair)) - begin[which]          # in its pair, whose hypotheses are adjacent
    best = np.zeros((common.count, 3))
    least = common.cost(best)
    for k in range(rank.max(initial=-1) + 1):
        kth = rank == k
        tried = best.copy()
        tried[pair[kth]] = hypothesis[kth]
        cost = common.cost(tried)
        best = np.where((cost < least)[:, None], tried, best)
        least = np.minimum(cost, least)
    return best


def _hypotheses(common):
    """Pairs (h,) and their increments (h, 3), from one marker or from two positions."""
    oriented = common.C1[:, 2, 2] + common.C2[:, 2, 2] < MAX_HEADING_SIGMA**2
    pair = common.pair[oriented]
    by_one = se2.compose(common.z1[oriented], se2.inverse(common.z2[oriented]))
    i, j = _two_of_each(common.pair, np.setdiff1d(common.pair, pair))
    earlier = common.z1[:, :2]
    later = common.z2[:, :2]
    by_two = _increment_of_two_points(earlier[i], earlier[j], later[i], later[j])
    return np.append(pair, common.pair[i]), np.concatenate([by_one, by_two])


def _two_of_each(pair, chosen):
    """Rows (2, h) of two sightings of a `chosen` pair, about POINT_PAIRS of each pair."""
    rows = [np.zeros((2, 0), int)]
    for k in chosen:
        own = np.flatnonzero(pair == k)
        two = own[np.array(np.triu_indices(len(own), 1))]
        every = two.shape[1] // (POINT_PAIRS + 1) + 1
        rows.append(two[:, ::every])
    return np.concatenate(rows, axis=1)


def _increment_of_two_points(p1, q1, p2, q2):
    """Delta from the positions (n, 2) of two markers: direction p to q and midpoint coincide."""
    turn = _direction(q1 - p1) - _direction(q2 - p2)
    turned = np.matvec(se2.rotation(turn), (p2 + q2) / 2)
    return np.column_stack([(p1 + q1) / 2 - turned, turn])


def _direction(d):
    """Angles (n,) of vectors d (n, 2)."""
    return np.arctan2(d[:, 1], d[:, 0])


def distance_and_turn(increment: np.ndarray) -> np.ndarray:
    """Distance in m and size of the turn in rad, (..., 2), of increments (..., 3)."""
    distance = np.linalg.norm(increment[..., :2], axis=-1)
    turn = np.abs(se2.wrap(increment[..., 2]))
    return np.stack([distance, turn], axis=-1)


def distance_and_turn_sigmas(covariance: np.ndarray) -> np.ndarray:
    """Bounds (n, 2) of the standard deviations of distance in m and turn in rad.

    By covariances (n, 3, 3) of the increments.
    """
    sigma = se2.sigmas(covariance)
    distance = np.linalg.norm(sigma[:, :2], axis=1)
    return np.stack([distance, sigma[:, 2]], axis=-1)
