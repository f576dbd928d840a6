"""Problem 2: incremental localization from the markers alone, no encoders.

Two poses that see the same markers are tied to each other. With Z_j the marker j seen from the
earlier pose, Z'_j from the later one, and Delta the later pose in the earlier pose's frame,

    r_j = Z_j - Delta Z'_j,      W_j = C_j + J' C'_j J'^T,      J' = d(Delta Z'_j) / d Z'_j,

and Delta minimizes the sum of r_j^T W_j^-1 r_j (`slamlib/ties.py`). Increments are composed into
poses.

Consecutive increments share the sightings Z' of the pose between them with opposite signs: an error
seen in one is taken back by the next. So with each pose goes the cross-covariance of its error with
the errors of the sightings made there, H_j = Cov(pose error, error of Z'_j):

    C_X' = A C_X A^T + B C_Delta B^T + S + S^T,    S = A sum_j H_j (B D_j)^T,
    H'_j = B D'_j C'_j,

with A, B the derivatives of X' = X Delta by X and Delta, and D_j, D'_j those of Delta by Z_j, Z'_j.
"""

from collections import Counter, defaultdict
from dataclasses import dataclass

import numpy as np

from slamlib import se2
from slamlib.ties import GATE, estimate_ties, gather, tie_consecutive

RETURNS = 3                  # known frames to try for a frame that is not tied to the one before


@dataclass(frozen=True)
class Localization:
    """Measured poses, as far as markers tie them to the first one, and the markers they map."""

    frame: np.ndarray               # (f,) index from 0 of every measured pose
    poses: np.ndarray               # (f, 3) in the frame of the first one; NaN where nothing ties
    covariances: np.ndarray         # (f, 3, 3)
    parent: np.ndarray              # (f,) row of the frame it was localized against, -1 for none
    outlier: np.ndarray             # (m,) bool, sightings of the dataset that others contradict
    unused: np.ndarray              # (m,) bool, sightings of markers that no neighbouring frame sees
    marker: np.ndarray              # (k,) ids of the mapped markers, ascending
    marker_in_world: np.ndarray     # (k, 3)
    marker_covariance: np.ndarray   # (k, 3, 3) of [x, y, heading] in world axes


def localize(aruco, shared_errors=True):
    """Incremental localization from the sightings of markers at successive measured poses.

    A measured pose is localized against the one before it where they share a marker, else against
    the localized pose that shares most markers with it: markers whose place is known. Such a return
    counts if two markers agree on it, or one that the measured poses beside both frames confirm.
    Where there is none the pose stays unknown until a known marker returns. The world frame is that
    of the first measured pose that is tied to the next. Outliers are left out as
    `ties.plausible_ties` says.

    Parameters
    ----------
    aruco : ArucoReadings
    shared_errors : False drops the correlation between a pose and the sightings made there, to
        show what it is worth.

    Returns
    -------
    Localization
    """
    sightings = gather(aruco)
    row, marker, z, C = sightings.row, sightings.marker, sightings.z, sightings.C
    ties, link, first, second = tie_consecutive(sightings)
    count = len(sightings.frame)
    confirmed = np.zeros(len(row), bool)
    confirmed[first[ties.kept]] = confirmed[second[ties.kept]] = True
    poses, covariances = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    root = int(np.argmax(ties.usable)) if ties.usable.any() else 0
    poses[root], covariances[root] = 0.0, 0.0
    parent = np.full(count, -1)
    cross = np.zeros((len(row), 3, 3))                                       # H_j
    sightings_of = np.split(np.arange(len(row)), np.searchsorted(row, np.arange(1, count)))
    pairs_of = np.split(np.arange(len(link)), np.searchsorted(link, np.arange(1, max(1, count - 1))))
    seen_in = defaultdict(list)                         # marker: localized frames that saw it

    for f in range(root, count):
        own = sightings_of[f]
        if f > root:
            if ties.usable[f - 1] and np.isfinite(poses[f - 1, 0]):
                parent[f], tie, pairs, l = f - 1, ties, pairs_of[f - 1], f - 1
                a, b = first[pairs], second[pairs]
            else:
                found = _return_to_known(z, C, marker, confirmed, sightings_of, own, seen_in)
                if found is None:
                    continue
                (parent[f], tie, a, b), pairs, l = found, slice(None), 0
            p = parent[f]
            poses[f] = se2.compose(poses[p], tie.increment[l])
            A, B = se2.compose_jacobians(poses[p], tie.increment[l])
            covariances[f] = A @ covariances[p] @ A.T + B @ tie.covariance[l] @ B.T
            if shared_errors:
                S = A @ np.sum(cross[a] @ np.swapaxes(B @ tie.by_first[pairs], 1, 2), axis=0)
                covariances[f] += S + S.T
                cross[b] = B @ tie.by_second[pairs] @ C[b]
        for m in marker[own].tolist():
            seen_in[m].append(f)

    paired = np.zeros(len(row), bool)
    paired[first] = paired[second] = True
    outlier, unused = np.ones(len(aruco.pose), bool), np.zeros(len(aruco.pose), bool)
    outlier[sightings.index] = paired & ~confirmed
    unused[sightings.index] = ~paired
    used = np.flatnonzero(confirmed & np.isfinite(poses[row, 0]))
    return Localization(sightings.frame, poses, covariances, parent, outlier, unused, *_map_markers(
        marker[used], poses[row[used]], covariances[row[used]], z[used], C[used], cross[used]))


def _return_to_known(z, C, marker, confirmed, sightings_of, own, seen_in):
    """The localized frame that shares most markers with the sightings `own`, of those the latest.

    Returns the frame, the tie, and the common sightings in it and of `own`; None if there is none
    whose tie can be trusted.
    """
    shared = Counter(f for m in marker[own].tolist() for f in seen_in[m])
    for f in sorted(shared, key=lambda f: (shared[f], f), reverse=True)[:RETURNS]:
        there = sightings_of[f]
        _, a, b = np.intersect1d(marker[there], marker[own], return_indices=True)
        a, b = there[a], own[b]
        tie = estimate_ties(z, C, np.zeros(len(a), int), a, b, 1)
        sure = tie.kept & confirmed[a] & confirmed[b]
        if tie.usable[0] and (tie.kept.sum() > 1 or sure.any()):
            return f, tie, a, b
    return None


def _map_markers(marker, poses, covariances, z, C, cross):
    """Each marker where its most certain sighting puts it: ids, poses and covariances.

    The sightings of one marker err together, through the poses they are made from, so they cannot
    be averaged as if they were independent.
    """
    A, B = se2.compose_jacobians(poses, z)
    S = A @ cross @ np.swapaxes(B, 1, 2)
    covariance = (A @ covariances @ np.swapaxes(A, 1, 2) + B @ C @ np.swapaxes(B, 1, 2)
                  + S + np.swapaxes(S, 1, 2))
    in_world = se2.compose(poses, z)
    in_world[:, 2] = se2.wrap(in_world[:, 2])
    best = most_certain(marker, in_world, covariance)
    return marker[best], in_world[best], covariance[best]


def most_certain(marker, in_world, covariance):
    """For every marker, its most certain sighting of those that most of its sightings agree with.

    Parameters
    ----------
    marker : (s,) ids.
    in_world, covariance : (s, 3), (s, 3, 3) where each sighting puts its marker.

    Returns
    -------
    (k,) rows, in ascending order of marker id; most certain is of least determinant.
    """
    size, best = np.linalg.slogdet(covariance)[1], []
    for same in (np.flatnonzero(marker == i) for i in np.unique(marker)):
        apart = in_world[same, None] - in_world[same]
        apart[..., 2] = se2.wrap(apart[..., 2])
        spread = covariance[same, None] + covariance[same]
        squared = np.einsum("abi,abi->ab", apart, np.linalg.solve(spread, apart[..., None])[..., 0])
        votes = np.count_nonzero(squared < GATE, axis=1)
        best.append(min(same[votes >= votes.max() / 2], key=size.__getitem__))
    return np.array(best, int)
