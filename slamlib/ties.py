"""Increments between poses from the markers that both of them see, many at once and robustly.

A tie is a pair of measured poses (frames) with common sightings. All arrays over common sightings
are sorted by tie; `link` says which tie each belongs to.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from slamlib import se2

GATE = chi2.ppf(0.999, 3)    # squared Mahalanobis length from which a sighting is an outlier
GATE_OF_POINTS = chi2.ppf(0.999, 2)     # the same for a sighting without orientation
SUDDEN = 3.0                 # times the 99th percentile of the agreed speeds: not a motion
LOST_HEADING = 0.5           # rad, sigma: what knows less of the turn cannot tie two poses


@dataclass(frozen=True)
class Sightings:
    """Sightings of markers, at most one of a marker in each frame, sorted by frame and marker."""

    index: np.ndarray        # (s,) row of the dataset's sightings
    row: np.ndarray          # (s,) row of `frame`
    marker: np.ndarray       # (s,) marker id
    z: np.ndarray            # (s, 3) marker in vehicle
    C: np.ndarray            # (s, 3, 3)
    frame: np.ndarray        # (f,) index from 0 of every measured pose


@dataclass(frozen=True)
class Ties:
    """Increments of l ties from p common sightings."""

    increment: np.ndarray    # (l, 3) later frame in the earlier one; NaN where there is none
    covariance: np.ndarray   # (l, 3, 3)
    usable: np.ndarray       # (l,) bool
    kept: np.ndarray         # (p,) bool, common sightings that agree with the increment
    by_first: np.ndarray     # (p, 3, 3) d increment / d sighting from the earlier frame
    by_second: np.ndarray    # (p, 3, 3) d increment / d sighting from the later frame


def gather(aruco, also=()):
    """The Sightings of an ArucoReadings or None; `also` are frames too, seen markers or not."""
    if aruco is None:
        none = np.zeros(0, int)
        return Sightings(none, none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)),
                         np.unique(also).astype(int))
    index, z, C = merge_repeated(aruco)
    frame = np.union1d(aruco.pose[index], also).astype(int)
    return Sightings(index, np.searchsorted(frame, aruco.pose[index]), aruco.marker[index], z, C, frame)


def tie_consecutive(sightings):
    """Ties of every frame with the next one.

    Returns
    -------
    ties : Ties, f - 1 of them.
    link, first, second : (p,) as from `common_sightings`.
    """
    earlier = np.arange(len(sightings.frame) - 1)
    pairs = common_sightings(sightings.row, sightings.marker, earlier, earlier + 1)
    return plausible_ties(sightings.z, sightings.C, *pairs, np.diff(sightings.frame)), *pairs


def merge_repeated(aruco):
    """Sightings with one row for each marker at each pose.

    Several sightings of one marker at one pose are averaged by information if they agree within
    GATE of their mean, and left out if they do not: one of them is not of this marker.

    Returns
    -------
    index : (s,) rows of `aruco`, sorted by pose and marker id.
    z : (s, 3) marker in vehicle.
    C : (s, 3, 3) covariance.
    """
    order = np.lexsort((aruco.marker, aruco.pose))
    key = np.stack([aruco.pose[order], aruco.marker[order]], -1)
    begins = np.flatnonzero(np.r_[True, np.any(key[1:] != key[:-1], axis=1)])
    ends = np.r_[begins[1:], len(order)]
    z, C = aruco.marker_in_vehicle[order], aruco.covariance[order]
    agrees = np.ones(len(begins), bool)
    for i in np.flatnonzero(ends - begins > 1):
        same = slice(begins[i], ends[i])
        information = np.linalg.inv(C[same])
        deviation = z[same] - z[begins[i]]
        deviation[:, 2] = se2.wrap(deviation[:, 2])
        mean_covariance = np.linalg.inv(information.sum(0))
        mean = mean_covariance @ np.einsum("nij,nj->i", information, deviation)
        agrees[i] = np.max(_squared(deviation - mean, information)) < GATE
        z[begins[i]] += mean
        C[begins[i]] = mean_covariance
    begins = begins[agrees]
    return order[begins], z[begins], C[begins]


def common_sightings(row, marker, earlier, later):
    """Sightings of the same marker from two frames each.

    Parameters
    ----------
    row, marker : (s,) frame and marker of every sighting, sorted by frame, then by marker.
    earlier, later : (l,) the frames to tie.

    Returns
    -------
    link, first, second : (p,) which tie, and the sightings from its earlier and its later frame.
    """
    _, label = np.unique(marker, return_inverse=True)
    sorted_by, width = np.lexsort((label, row)), len(label) + 1
    key = (row * width + label)[sorted_by]
    later_begins, later_ends = (np.searchsorted(row, later, side) for side in ("left", "right"))
    link, second = _ranges(later_begins, later_ends)
    wanted = np.asarray(earlier)[link] * width + label[second]
    at = np.minimum(np.searchsorted(key, wanted), max(0, len(key) - 1))
    found = key[at] == wanted if len(key) else np.zeros(0, bool)
    return link[found], sorted_by[at[found]], second[found]


def plausible_ties(z, C, link, first, second, steps):
    """Ties of consecutive frames, of which none may imply a sudden motion.

    Where two or more markers agree on an increment, it is a motion of the vehicle. Sudden is what is
    SUDDEN times as fast (per encoder step, plus three sigma) as the 99th percentile of those and as
    nine tenths of all increments, and unlike the increment before and the one after. Wrong labels
    are like that: they lead away and back. A sudden increment is estimated again from the common
    sightings that are not, and there is no tie if none is left.

    Parameters
    ----------
    z, C : (s, 3), (s, 3, 3) sightings and covariances.
    link, first, second : (p,) as from `common_sightings`.
    steps : (l,) encoder steps between the frames of each tie.

    Returns
    -------
    Ties
    """
    ties = estimate_ties(z, C, link, first, second, len(steps))
    agreed = ties.usable & (np.bincount(link[ties.kept], minlength=len(steps)) > 1)
    if not agreed.any():
        return ties
    speed = np.abs(_polar(ties.increment)) / steps[:, None]
    bound = SUDDEN * np.maximum(np.percentile(speed[agreed], 99, axis=0),
                                np.percentile(speed[ties.usable], 90, axis=0, method="lower"))
    sudden = ties.usable & _is_sudden(ties.increment, ties.covariance, steps, bound)
    velocity = ties.increment / steps[:, None]
    alike = np.r_[False, _are_alike(velocity[:-1], velocity[1:]), False]
    sudden &= ~(alike[:-1] | alike[1:])
    single, single_covariance = _single_increments(z, C, first, second)
    allowed = ~(sudden[link] & _is_sudden(single, single_covariance, steps[link], bound))
    if allowed.all():
        return ties
    again = estimate_ties(z, C, link[allowed], first[allowed], second[allowed], len(steps))
    kept = np.zeros(len(link), bool)
    by_first, by_second = np.zeros((2, len(link), 3, 3))
    kept[allowed], by_first[allowed], by_second[allowed] = \
        again.kept, again.by_first, again.by_second
    usable = again.usable & ~(sudden & _is_sudden(again.increment, again.covariance, steps, bound))
    return Ties(again.increment, again.covariance, usable, kept & usable[link], by_first, by_second)


def estimate_ties(z, C, link, first, second, count):
    """Increments of `count` ties from their common sightings, robust against wrong labels.

    Hypotheses (no motion; what each marker alone says; where markers have no orientation, what each
    two of them say) are ranked by the Cauchy cost of all common sightings, the best one is refined by
    Gauss-Newton with Cauchy weights, then by Gauss-Newton on the sightings within GATE.

    Parameters and returns as of `plausible_ties`.
    """
    z1, C1, z2, C2 = z[first], C[first], z[second], C[second]
    increment = _best_hypothesis(z1, C1, z2, C2, link, count)
    for round in range(14):
        r, information, J_delta, J_second = _residuals(increment[link], z1, C1, z2, C2)
        squared = _squared(r, information)
        weight = 1 / (1 + squared / GATE) if round < 8 else (squared < GATE).astype(float)
        gain = np.swapaxes(J_delta, 1, 2) @ information * weight[:, None, None]
        H = _sum_by(link, gain @ J_delta, count)
        covariance = _inverse_where_regular(H)
        step = _sum_by(link, np.einsum("nij,nj->ni", gain, r), count)
        increment = increment + np.einsum("nij,nj->ni", covariance, step)
    increment[:, 2] = se2.wrap(increment[:, 2])
    kept = weight > 0
    with np.errstate(invalid="ignore"):
        usable = covariance[:, 2, 2] < LOST_HEADING**2
    increment = np.where(usable[:, None], increment, np.nan)
    by_first = covariance[link] @ gain
    return Ties(increment, covariance, usable, kept & usable[link], by_first, -by_first @ J_second)


def _residuals(increment, z1, C1, z2, C2):
    """r and W^-1 of the module docstring of localization, and the derivatives of Delta Z'."""
    J_delta, J_second = se2.compose_jacobians(increment, z2)
    r = z1 - se2.compose(increment, z2)
    r[:, 2] = se2.wrap(r[:, 2])
    W = C1 + J_second @ C2 @ np.swapaxes(J_second, 1, 2)
    return r, np.linalg.inv(W), J_delta, J_second


def _best_hypothesis(z1, C1, z2, C2, link, count):
    """The hypothesis of least Cauchy cost for every tie, (count, 3)."""
    begins, ends = (np.searchsorted(link, np.arange(count), side) for side in ("left", "right"))
    oriented = (C1[:, 2, 2] + C2[:, 2, 2]) < LOST_HEADING**2
    i, j = _pairs_within(begins, ends, np.bincount(link[oriented], minlength=count) == 0)
    hypothesis = np.concatenate([
        np.zeros((count, 3)),
        se2.compose(z1[oriented], se2.inverse(z2[oriented])),
        _increment_of_two_points(z1[i, :2], z1[j, :2], z2[i, :2], z2[j, :2])])
    tie = np.concatenate([np.arange(count), link[oriented], link[i]])
    which, pair = _ranges(begins[tie], ends[tie])
    r, information, _, _ = _residuals(hypothesis[which], z1[pair], C1[pair], z2[pair], C2[pair])
    cost = np.bincount(which, np.log1p(_squared(r, information) / GATE), len(tie))
    order = np.lexsort((cost, tie))
    return hypothesis[order[np.searchsorted(tie[order], np.arange(count))]]


def _pairs_within(begins, ends, wanted):
    """All pairs i < j of common sightings of the same tie, for the wanted ties."""
    pairs = [np.add(np.triu_indices(e - b, 1), b) for b, e in zip(begins[wanted], ends[wanted])]
    return np.concatenate(pairs, axis=1) if pairs else np.zeros((2, 0), int)


def _increment_of_two_points(p1, q1, p2, q2):
    """Delta with Delta (p2, q2) = (p1, q1) as well as a motion can, from positions alone."""
    d1, d2 = q1 - p1, q2 - p2
    turn = se2.wrap(np.arctan2(d1[:, 1], d1[:, 0]) - np.arctan2(d2[:, 1], d2[:, 0]))
    shift = (p1 + q1) / 2 - np.einsum("nij,nj->ni", se2.rotation(turn), (p2 + q2) / 2)
    return np.column_stack([shift, turn])


def _single_increments(z, C, first, second):
    """What each common sighting alone says of the increment, with covariance."""
    increment = se2.compose(z[first], se2.inverse(z[second]))
    by_first, by_inverse = se2.compose_jacobians(z[first], se2.inverse(z[second]))
    by_second = by_inverse @ se2.inverse_jacobian(z[second])
    covariance = (by_first @ C[first] @ np.swapaxes(by_first, 1, 2)
                  + by_second @ C[second] @ np.swapaxes(by_second, 1, 2))
    return increment, covariance


def _polar(increment):
    """Distance and turn (..., 2)."""
    return np.stack([np.hypot(increment[:, 0], increment[:, 1]), se2.wrap(increment[:, 2])], -1)


def _is_sudden(increment, covariance, steps, bound):
    """True where distance or turn exceed the bound per step by more than three sigma."""
    with np.errstate(invalid="ignore"):
        allowance = 3 * np.sqrt(np.stack([covariance[:, 0, 0] + covariance[:, 1, 1],
                                          covariance[:, 2, 2]], -1))
        return np.any(np.abs(_polar(increment)) > bound * steps[:, None] + allowance, axis=1)


def _are_alike(a, b):
    """True where two velocities (n, 3) differ by less than half of the greater, in place and turn."""
    with np.errstate(invalid="ignore"):
        place, turn = np.hypot(*(a - b)[:, :2].T), np.abs(a[:, 2] - b[:, 2])
        most = np.maximum(np.abs(_polar(a)), np.abs(_polar(b)))
        return (place < most[:, 0] / 2) & (turn < most[:, 1] / 2 + 1e-3)


def _squared(r, information):
    """r^T W^-1 r for each row."""
    return np.einsum("ni,nij,nj->n", r, information, r)


def _sum_by(link, values, count):
    """Sums of the rows of values with equal link, (count, ...)."""
    total = np.zeros((count,) + values.shape[1:])
    np.add.at(total, link, values)
    return total


def _inverse_where_regular(H):
    """Inverses of (l, 3, 3), NaN where there is none."""
    scale = np.sqrt(np.maximum(np.diagonal(H, axis1=1, axis2=2), 1e-300))
    scaled = H / (scale[:, :, None] * scale[:, None, :])
    finite = np.isfinite(H).all(axis=(1, 2))          # not where a tie has lost all its sightings
    regular = finite & (np.linalg.eigvalsh(np.where(finite[:, None, None], scaled, 0))[:, 0] > 1e-12)
    inverse = np.full_like(H, np.nan)
    inverse[regular] = np.linalg.inv(H[regular])
    return inverse


def _ranges(begins, ends):
    """The integers of many ranges: (which range, integer), both of the total length."""
    length = np.maximum(ends - begins, 0)
    which = np.repeat(np.arange(len(length)), length)
    within = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    return which, np.asarray(begins)[which] + within if len(which) else which
