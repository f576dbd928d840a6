"""Checks of poses that need no truth: what the measurements of one drive say against each other.

Where the camera sees markers again that it saw before, they measure the motion since then, and with
it the error of every method that does not recognize places: `returns` and `discrepancies`.

A method that uses the data less well than another one differs from it by `excess`. The error of the
best estimate is uncorrelated with what others differ from it by, so the covariance of the
difference is the difference of both covariances (Hausman, Econometrica 46(6), 1978).

Poses are [x, y, heading] in m and rad.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import evaluation, odometry, se2
from slamlib.localization.marker_increments import robust_increments
from slamlib.sightings import sightings_by_frame

GAP = 5.0                    # m, driven between two sightings of the markers of a return
MOST_FRAMES = 400            # at equal distances along the path, among which returns are sought
MIN_COMMON = 2               # markers that both frames of a return see, and that agree


@dataclass(frozen=True)
class Returns:
    """Pairs of frames that see the same markers, and the motion between them by these alone."""

    start: np.ndarray        # (m,) pose index from 0 of the earlier frame
    end: np.ndarray          # (m,) pose index of the later frame, ascending
    driven: np.ndarray       # (m,) m between them, by odometry
    motion: np.ndarray       # (m, 3) later in earlier frame
    covariance: np.ndarray   # (m, 3, 3) of the motion, by the covariances of the sightings


def returns(dataset, gap=GAP):
    """The Returns of a Dataset after at least `gap` m; without markers there are none.

    A frame returns to the earlier frame with which it has most markers in common. Returns share
    errors, those of odometry over the same section and those of the same sightings.
    """
    s = sightings_by_frame(dataset.aruco)
    travelled = odometry.cumulative(np.abs(odometry.steps(dataset.ticks, dataset.vehicle)[0]))
    frame = _spread(travelled[s.frame])
    label = np.unique(s.marker, return_inverse=True)[1]
    sighting = np.full((len(s.frame), label.max(initial=-1) + 1), -1)          # row, or -1
    sighting[s.row, label] = np.arange(len(s.row))
    sighting, at = sighting[frame], travelled[s.frame[frame]]
    seen = (sighting >= 0).astype(int)
    common = (seen @ seen.T) * (at[:, None] - at >= gap)            # of later with earlier frames
    later = np.flatnonzero(common.max(axis=1, initial=0) >= MIN_COMMON)
    earlier = common[later].argmax(axis=1) if len(later) else later
    pair, which = np.nonzero(seen[earlier] & seen[later])
    found = robust_increments(s.z, s.C, pair, sighting[earlier[pair], which],
                              sighting[later[pair], which], len(later))
    ok = found.usable & (np.bincount(pair, found.accepted, len(later)) >= MIN_COMMON)
    start, end = s.frame[frame[earlier[ok]]], s.frame[frame[later[ok]]]
    return Returns(start=start, end=end, driven=travelled[end] - travelled[start],
                   motion=found.increment[ok], covariance=found.covariance[ok])


def _spread(travelled):
    """Rows of at most MOST_FRAMES distances (f,), ascending, that are nearly evenly spaced."""
    if not len(travelled):
        return np.zeros(0, int)
    wanted = np.linspace(travelled[0], travelled[-1], MOST_FRAMES)
    return np.unique(np.searchsorted(travelled, wanted))


def discrepancies(found, poses):
    """Motions (m, 3) of Returns by the poses (n, 3) minus those by the markers, in their starts.

    The heading is wrapped. NaN where a pose is NaN.
    """
    off = se2.between(poses[found.start], poses[found.end]) - found.motion
    off[:, 2] = se2.wrap(off[:, 2])
    return off


def excess(poses, covariances, best, best_covariances):
    """Squared distance (n,) of poses (n, 3) from better ones, normalized by C - C_best, (n, 3, 3).

    It is chi-squared with 3 degrees of freedom if both covariances are right and the better method
    is optimal for data that include those of the other. NaN where C - C_best is not positive
    definite: there the other method claims to be more certain than the better one in some
    direction. NaN without a pose.
    """
    difference = covariances - best_covariances
    claims = ~(np.diagonal(difference, axis1=1, axis2=2) > 0).all(axis=1)
    difference[claims] = 0
    return evaluation.nees(poses, difference, best)
