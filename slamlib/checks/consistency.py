"""What a drive shows without truth: loop closures.

Markers that the camera sees again measure the motion since then, and with it the error of every
method without loop closures. Poses are in m and rad.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import odometry, se2
from slamlib.marker_increments import robust_increments
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
    """Motions (m, 3) by poses (n, 3) minus those of Returns `found`, in the axes of its starts."""
    return se2.difference(se2.between(poses[found.start], poses[found.end]), found.motion)
