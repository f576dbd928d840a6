"""Stage 3: a state gives every variable of the graph a value.

Variables are the frames' poses X_i, the markers L_j (points P_j where no sighting has a heading),
the antennas A_k, and w, the errors of the wheel parameters in units of their standard deviations.
Where the ranges calibrate themselves, z holds their offset and scale in the same way.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import odometry, se2

RANGE_SIGMA = np.array([0.2, 0.05])      # m and 1, prior of the ranges' offset and scale


@dataclass(frozen=True)
class State:
    """Values of all variables."""

    poses: np.ndarray        # (f, 3) m, m, rad; headings continuous
    markers: np.ndarray      # (k, 3), heading 0 where a marker is a point
    antennas: np.ndarray     # (a, 2) m
    w: np.ndarray            # (3,) in units of sigma
    z: np.ndarray            # (2,) in units of RANGE_SIGMA, 0 where ranges are not calibrated

    @property
    def range_calibration(self):
        """(2,) offset in m and scale of the ranges: measured = offset + scale * distance."""
        return np.array([0.0, 1.0]) + RANGE_SIGMA * self.z


def state_from_arrays(measurements, poses, markers, antennas, w, z=np.zeros(2)):
    """The State of poses (f, 3), markers (k, 3), antennas (a, 2), w (3,) and z (2,).

    A frame's heading continues that of the one before.
    """
    turn, poses = measurements.turn, np.array(poses, dtype=float)
    apart = se2.wrap(np.diff(poses[:, 2]) - turn)
    poses[:, 2] = odometry.cumulative(turn + apart, se2.wrap(poses[0, 2]))
    markers = np.array(markers, dtype=float)
    markers[~measurements.oriented, 2] = 0
    return State(poses=poses, markers=markers, antennas=np.asarray(antennas, dtype=float),
                 w=np.asarray(w, dtype=float), z=np.asarray(z, dtype=float))


def moved(measurements, state, delta):
    """The State that a solution (n,) of the normal equations leads to.

    Poses and markers move in their own axes, as GTSAM's do: X becomes X delta.
    """
    m, rows = measurements, measurements.structure.rows
    f, k = len(m.frame), len(m.marker)
    oriented, points = (f + np.flatnonzero(which) for which in (m.oriented, ~m.oriented))
    markers = state.markers.copy()
    markers[m.oriented] = se2.compose(markers[m.oriented], delta[rows(oriented, 3)])
    markers[~m.oriented, :2] += delta[rows(points, 2)]
    return state_from_arrays(
        m, se2.compose(state.poses, delta[rows(np.arange(f), 3)]), markers,
        state.antennas + delta[rows(f + k + np.arange(len(m.antenna)), 2)],
        state.w + delta[rows([m.wheels], 3)[0]],
        state.z + delta[rows([m.wheels + 1], 2)[0]] if m.calibrated else state.z)
