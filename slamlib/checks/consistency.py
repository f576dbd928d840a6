"""Checks of poses without truth: loop closures, and the Hausman statistic.

Markers that the camera sees again measure the motion since then, and with it the error of every
method without loop closures: `returns` and `discrepancies`. `hausman_statistic` compares a method
with an efficient one. The error of the efficient estimate is uncorrelated with its difference from
any other, so the covariance of the difference is the difference of both covariances (Hausman,
Econometrica 46(6), 1978). Poses are [x, y, heading] in m and rad.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import evaluation, odometry, se2
from slamlib.localization.marker_increments import robust_increments
from slamlib.sightings import sightings_by_frame

MIN_GAP = 5.0                # m, driven between two sightings of the markers of a return
MAX_RETURN_FRAMES = 400      # frames, evenly chosen, among which returns are sought
MIN_COMMON_MARKERS = 2       # markers that both frames of a return see, and that agree


@dataclass(frozen=True)
class Returns:
    """Pairs of frames that see the same markers, and the motion between them by these markers."""

    start: np.ndarray        # (m,) pose index from 0 of the earlier frame
    end: np.ndarray          # (m,) pose index of the later frame, ascending
    driven: np.ndarray       # (m,) m between them, by odometry
    motion: np.ndarray       # (m, 3) later in earlier frame
    covariance: np.ndarray   # (m, 3, 3) of the motion, by the covariances of the sightings


def returns(dataset, gap=MIN_GAP):
    """The Returns of a Dataset after at least `gap` m of driving; none without markers.

    A frame returns to the earlier frame with which it has most markers in common. Errors of returns
    are correlated: they share sections of odometry, and sightings.
    """
    s = sightings_by_frame(dataset.sightings)
    travelled = odometry.cumulative(np.abs(odometry.steps(dataset.ticks, dataset.vehicle)[0]))
    label = np.unique(s.marker, return_inverse=True)[1]
    sighting = np.full((len(s.frame), label.max(initial=-1) + 1), -1)          # row, or -1
    sighting[s.row, label] = np.arange(len(s.row))
    every = len(s.frame) // MAX_RETURN_FRAMES + 1
    sighting, frame = sighting[::every], s.frame[::every]
    seen, distance = (sighting >= 0).astype(int), travelled[frame]
    common = (seen @ seen.T) * (distance[:, None] - distance >= gap)     # later with earlier frames
    later = np.flatnonzero(common.max(axis=1, initial=0) >= MIN_COMMON_MARKERS)
    earlier = common[later].argmax(axis=1) if len(later) else later
    pair, which = np.nonzero(seen[earlier] & seen[later])
    found = robust_increments(s.z, s.C, pair, sighting[earlier[pair], which],
                              sighting[later[pair], which], len(later))
    ok = found.usable & (np.bincount(pair, found.accepted, len(later)) >= MIN_COMMON_MARKERS)
    start, end = frame[earlier[ok]], frame[later[ok]]
    return Returns(start=start, end=end, driven=travelled[end] - travelled[start],
                   motion=found.increment[ok], covariance=found.covariance[ok])


def discrepancies(found, poses):
    """Motions (m, 3) by poses (n, 3) minus those of Returns `found`, in the frames of its starts.

    NaN where a pose is NaN.
    """
    off = se2.between(poses[found.start], poses[found.end]) - found.motion
    off[:, 2] = se2.wrap(off[:, 2])
    return off


def hausman_statistic(poses, covariances, efficient, efficient_covariances):
    """Squared differences (n,) of poses (n, 3) from efficient ones, normalized by C - C_efficient.

    It is chi-squared with 3 degrees of freedom if both covariances (n, 3, 3) are right and the
    efficient method is optimal for data that include those of the first one. NaN without a pose,
    and where C - C_efficient is not positive definite: the first method claims to be more certain.
    """
    difference = covariances - efficient_covariances
    difference[~(np.diagonal(difference, axis1=1, axis2=2) > 0).all(axis=1)] = 0
    return evaluation.nees(poses, difference, efficient)
