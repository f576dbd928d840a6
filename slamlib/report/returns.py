"""Returns: pairs of frames that see the same markers again after a loop.

The motion between both frames by these markers shows the drift of methods that close no loops, and
needs no truth. Errors of returns are correlated: they share sections of odometry, and sightings.
"""

from dataclasses import dataclass

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.marker_increments import robust_increments
from slamlib.core.records import Dataset
from slamlib.core.sightings import sightings_by_frame

MIN_GAP = 5.0                 # m, driven between two sightings of the markers of a return
MAX_RETURN_FRAMES = 400       # frames, evenly chosen, among which returns are sought
MIN_COMMON_MARKERS = 2        # markers that both frames of a return see, and that agree


@dataclass(frozen=True)
class Returns:
    """Pairs of frames that see the same markers after a loop, and the motion between them."""

    start: np.ndarray        # (m,) pose index from 0 of the earlier frame
    end: np.ndarray          # (m,) pose index of the later frame, ascending
    motion: np.ndarray       # (m, 3) later in earlier frame, by these markers, m and rad
    covariance: np.ndarray   # (m, 3, 3) of the motion, by the covariances of the sightings

    def discrepancies(self, poses: np.ndarray) -> np.ndarray:
        """Motions (m, 3) by poses (n, 3) minus these, in the axes of the earlier frames."""
        return se2.difference(se2.between(poses[self.start], poses[self.end]), self.motion)


def find_returns(dataset: Dataset) -> Returns:
    """The Returns of a Dataset after at least MIN_GAP of driving; none without markers."""
    s = sightings_by_frame(dataset.sightings)
    every = len(s.frame) // MAX_RETURN_FRAMES + 1
    frame = s.frame[::every]
    sighting = s.table()[::every]
    seen = sighting >= 0
    steps = odometry.steps(dataset.ticks, dataset.vehicle)
    travelled = odometry.cumulative(np.abs(steps.ds))
    earlier, later = _returning(seen, travelled[frame])
    pair, marker = np.nonzero(seen[earlier] & seen[later])
    found = robust_increments(s.z, s.C, pair, sighting[earlier[pair], marker],
                              sighting[later[pair], marker], len(later))
    agreeing = np.bincount(pair, found.accepted, len(later))
    ok = found.usable & (agreeing >= MIN_COMMON_MARKERS)
    return Returns(start=frame[earlier[ok]], end=frame[later[ok]], motion=found.increment[ok],
                   covariance=found.covariance[ok])


def _returning(seen, travelled):
    """Earlier and later frames (l,) of returns, by the markers (f, k) that are `seen` at frames.

    A frame returns to the earlier frame with which it has most markers in common, among those from
    which the vehicle has `travelled` (f,) MIN_GAP since.
    """
    markers = seen.astype(int)
    far = travelled[:, None] - travelled >= MIN_GAP
    common = np.where(far, markers @ markers.T, 0)
    later = np.flatnonzero((common >= MIN_COMMON_MARKERS).any(axis=1))
    if not len(later):
        return later, later
    return common[later].argmax(axis=1), later
