"""Problem 2: incremental localization from the markers alone, without encoders.

The increment Delta between two frames is estimated from the sightings Z_j and Z'_j of their common
markers j (`marker_increments`), with covariances C_j and C'_j. Poses follow by composition,
X' = X Delta, with A = dX'/dX and B = dX'/dDelta. Consecutive increments share the sightings of the
frame between them with opposite sign: the second increment cancels their error in the first.
Therefore each pose X carries the cross-covariances H_j = Cov(error of X, error of Z_j) with the
sightings of its frame,

    C_X' = A C_X A^T + B C_Delta B^T + S + S^T,    S = A sum_j H_j (B D_j)^T,
    H'_j = B D'_j C'_j,    D_j = dDelta/dZ_j,    D'_j = dDelta/dZ'_j.

A marker sighted as Z from X is at M = X Z. With E = dM/dX, F = dM/dZ and T = E H F^T its covariance
is C_M = E C_X E^T + F C F^T + T + T^T. This is the correlated state of Smith, Self and Cheeseman,
Estimating Uncertain Spatial Relationships in Robotics, 1990, without the states of earlier frames.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slamlib.core import se2
from slamlib.core.errors import DatasetError, require
from slamlib.core.marker_increments import (
    MarkerIncrements,
    consecutive_increments,
    robust_increments,
)
from slamlib.core.records import ArucoReadings
from slamlib.core.sightings import consensus, sightings_by_frame

MAX_CANDIDATES = 3            # number of earlier frames that are tried as parent of a frame


@dataclass(frozen=True)
class Localization:
    """Poses of the frames, where markers determine them, and the map of the markers."""

    frame: np.ndarray               # (f,) pose index from 0 of every frame
    poses: np.ndarray               # (f, 3) in the first localized frame, m and rad; or NaN
    covariances: np.ndarray         # (f, 3, 3)
    rejected: np.ndarray            # (m,) bool, rejected, or a repetition (`merge_repeated`)
    unused: np.ndarray              # (m,) bool, sightings of markers that no adjacent frame sees
    marker: np.ndarray              # (k,) ids of the mapped markers, ascending
    marker_in_world: np.ndarray     # (k, 3) m and rad
    marker_covariance: np.ndarray   # (k, 3, 3) of [x, y, heading] in world axes


class _Link(NamedTuple):
    """How a frame is localized; the root has no parent."""

    frame: int
    parent: int | None = None
    increments: MarkerIncrements | None = None
    pair: int | None = None         # the increment from the parent, in `increments`

    def shared(self):
        """Rows of the sightings Z_j from parent and Z'_j from frame, and D_j and D'_j of these."""
        found = self.increments
        begin, end = np.searchsorted(found.pair, [self.pair, self.pair + 1])
        rows = slice(begin, end)
        return found.first[rows], found.second[rows], found.J_first[rows], found.J_second[rows]


@dataclass(frozen=True)
class _Path:
    """Poses of f frames, NaN where unknown, and the errors that they share with s sightings."""

    poses: np.ndarray               # (f, 3)
    covariances: np.ndarray         # (f, 3, 3)
    H: np.ndarray                   # (s, 3, 3)


def localize(aruco: ArucoReadings, shared_errors: bool = True) -> Localization:
    """Localization for problem 2: incremental, from the ArucoReadings alone.

    A frame is localized against its parent: the previous frame if the increment from it is usable,
    else an earlier frame (`_relocalized`). Without a parent its pose is unknown. The world frame is
    that of the first frame with a usable increment to the next. Without `shared_errors` H_j = 0,
    as for independent increments; this is conservative. Raises DatasetError if no sighting agrees
    with the others of its marker at its pose.

    >>> from slamlib.studies.simulation import simulate
    >>> dataset, truth = simulate("short", seed=1)
    >>> found = localize(dataset.aruco)
    >>> found.frame[:3].tolist(), found.poses.shape
    ([0, 10, 20], (200, 3))
    """
    require(isinstance(aruco, ArucoReadings), "localize", "an ArucoReadings", aruco)
    sightings = sightings_by_frame(aruco)
    if not len(sightings.frame):
        raise DatasetError("expected sightings that agree; all contradict another one of the same "
                           "marker at the same pose")
    increments = consecutive_increments(sightings)
    common = np.stack([increments.first, increments.second])
    rows = np.arange(len(sightings.row))
    paired = np.isin(rows, common)
    confirmed = np.isin(rows, common[:, increments.accepted])
    links = _links(sightings, increments, confirmed)
    path = _composed(sightings, links, shared_errors)
    known = np.isfinite(path.poses[sightings.row, 0])
    rejected = np.ones(len(aruco.pose), bool)
    rejected[sightings.index] = paired & ~confirmed
    unused = np.zeros(len(aruco.pose), bool)
    unused[sightings.index] = ~paired
    mapped = _map_markers(sightings, confirmed & known, path)
    return Localization(
        sightings.frame, path.poses, path.covariances, rejected, unused, *mapped)


def _links(sightings, increments, confirmed):
    """The _Link to each frame that has one, in the order of the frames; the first one is the root.

    A link is the usable increment from the previous frame, else `_relocalized`. The root is the
    first frame with a usable increment to the next. `confirmed` (s,) are the sightings that
    adjacent frames confirm.
    """
    table = sightings.table()
    is_known = np.zeros(len(sightings.frame), bool)
    root = min(np.flatnonzero(increments.usable), default=0)
    is_known[root] = True
    yield _Link(root)
    for frame in range(root + 1, len(is_known)):
        previous = frame - 1
        if increments.usable[previous] and is_known[previous]:
            link = _Link(frame, previous, increments, pair=previous)
        else:
            link = _relocalized(sightings, confirmed, table, is_known, frame)
        if link is not None:
            is_known[frame] = True
            yield link


def _relocalized(sightings, confirmed, table, is_known, frame):
    """The _Link to a frame from an earlier one that `is_known` (f,), or None.

    Candidates are those with the most markers in common, the latest first. A parent requires two
    accepted markers, or one whose two sightings adjacent frames confirm.
    """
    seen = table >= 0
    common = seen[:frame] & seen[frame] & is_known[:frame, None]
    by_common_markers = np.argsort(common.sum(axis=1), kind="stable")
    parents = by_common_markers[::-1][:MAX_CANDIDATES]
    pair, label = np.nonzero(common[parents])
    first = table[parents[pair], label]
    second = table[frame, label]
    count = len(parents)
    found = robust_increments(sightings.z, sightings.C, pair, first, second, count)
    accepted = np.bincount(pair, found.accepted, count)
    sure = np.bincount(pair, found.accepted & confirmed[first] & confirmed[second], count)
    trusted = found.usable & ((accepted > 1) | (sure > 0))
    if not trusted.any():
        return None
    best = np.argmax(trusted)
    return _Link(frame, parents[best], found, best)


def _composed(sightings, links, shared_errors):
    """The _Path by composition along the _Links, by equation 2.3."""
    count = len(sightings.frame)
    poses = np.full((count, 3), np.nan)
    covariances = np.full((count, 3, 3), np.nan)
    H = np.zeros((len(sightings.row), 3, 3))
    for link in links:
        f = link.frame
        if link.increments is None:
            poses[f] = 0.0
            covariances[f] = 0.0
            continue
        X = poses[link.parent]
        delta = link.increments.increment[link.pair]
        poses[f], A, B = se2.compose_with_jacobians(X, delta)
        by_parent = A @ covariances[link.parent] @ A.T
        by_increment = B @ link.increments.covariance[link.pair] @ B.T
        covariances[f] = by_parent + by_increment
        if shared_errors:
            first, second, D, D_later = link.shared()
            S = A @ np.sum(H[first] @ (B @ D).mT, axis=0)
            covariances[f] += S + S.T
            H[second] = B @ D_later @ sightings.C[second]
    return _Path(poses, covariances, H)


def _map_markers(sightings, used, path):
    """Ids (k,), poses (k, 3) and covariances (k, 3, 3) of markers, each from one used sighting.

    Sightings of a marker are correlated through the poses, so an average would be overconfident.
    """
    row = sightings.row[used]
    marker = sightings.marker[used]
    X = path.poses[row]
    Z = sightings.z[used]
    in_world, E, F = se2.compose_with_jacobians(X, Z)
    T = E @ path.H[used] @ F.mT
    by_pose = E @ path.covariances[row] @ E.mT
    by_sighting = F @ sightings.C[used] @ F.mT
    covariance = by_pose + by_sighting + T + T.mT
    in_world[:, 2] = se2.wrap(in_world[:, 2])
    best = consensus(marker, in_world, covariance)
    return marker[best], in_world[best], covariance[best]
