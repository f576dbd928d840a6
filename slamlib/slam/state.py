"""Stage 2: values of all variables of the graph.

Variables are the frames' poses X_i, the markers L_j (points P_j if no sighting has a heading), the
antennas A_k, the errors w of the wheel parameters, and the calibration c of the ranges.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import odometry, se2

CALIBRATION_SIGMA = np.array([0.2, 0.05])    # m and 1, prior of offset and scale of the ranges


@dataclass(frozen=True)
class State:
    """Values of all variables."""

    poses: np.ndarray        # (f, 3) m, m, rad; headings continuous
    markers: np.ndarray      # (k, 3), heading 0 where a marker is a point
    antennas: np.ndarray     # (a, 2) m
    w: np.ndarray            # (3,) in units of sigma
    c: np.ndarray            # (2,) in units of CALIBRATION_SIGMA, 0 without calibration

    @property
    def range_calibration(self):
        """(2,) offset in m and scale of the ranges: measured = offset + scale * distance."""
        return np.array([0.0, 1.0]) + CALIBRATION_SIGMA * self.c


def state_from_arrays(measurements, poses, markers, antennas, w, c=np.zeros(2)):
    """The State of poses (f, 3), markers (k, 3), antennas (a, 2), w (3,) and c (2,).

    Headings become continuous: between two frames they turn by odometry's angle, up to half a turn.
    """
    turn, poses = measurements.turn, np.array(poses, dtype=float)
    correction = se2.wrap(np.diff(poses[:, 2]) - turn)
    poses[:, 2] = odometry.cumulative(turn + correction, se2.wrap(poses[0, 2]))
    markers = np.array(markers, dtype=float)
    markers[~measurements.oriented, 2] = 0
    return State(poses=poses, markers=markers, antennas=np.asarray(antennas, dtype=float),
                 w=np.asarray(w, dtype=float), c=np.asarray(c, dtype=float))


def retract(measurements, state, delta):
    """The State after a step delta (n,) in m and rad, of w and c without unit.

    Poses and markers move in their own axes, as GTSAM's do: X becomes X delta.
    """
    m, v, rows = measurements, measurements.variables, measurements.structure.rows
    markers = state.markers.copy()
    markers[m.oriented] = se2.compose(
        markers[m.oriented], delta[rows(v.markers[m.oriented], 3)])
    markers[~m.oriented, :2] += delta[rows(v.markers[~m.oriented], 2)]
    return state_from_arrays(
        m, se2.compose(state.poses, delta[rows(v.frames, 3)]), markers,
        state.antennas + delta[rows(v.antennas, 2)], state.w + delta[rows(v.w, 3)[0]],
        state.c + delta[rows(v.c, 2)[0]] if m.calibrated else state.c)
