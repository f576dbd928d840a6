"""Stage 3: a state gives every variable of the graph a value, as arrays and for GTSAM.

Variables are the frames' poses X_i, the markers L_j (points P_j where no sighting has a heading),
the antennas A_k, and w, the errors of the wheel parameters in units of their standard deviations.
Where the ranges calibrate themselves, z holds their offset and scale in the same way.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, P, W, X, Z

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
    values: gtsam.Values     # the same, for GTSAM

    @property
    def range_calibration(self):
        """(2,) offset in m and scale of the ranges: measured = offset + scale * distance."""
        return np.array([0.0, 1.0]) + RANGE_SIGMA * self.z


def state_from_arrays(measurements, poses, markers, antennas, w, z=np.zeros(2)):
    """The State of poses (f, 3), markers (k, 3), antennas (a, 2), w (3,) and z (2,)."""
    values = gtsam.Values()
    for i, pose in enumerate(poses):
        values.insert(X(i), gtsam.Pose2(*pose))
    for j, (marker, oriented) in enumerate(zip(markers, measurements.oriented)):
        if oriented:
            values.insert(L(j), gtsam.Pose2(*marker))
        else:
            values.insert(P(j), gtsam.Point2(*marker[:2]))
    for k, antenna in enumerate(antennas):
        values.insert(A(k), gtsam.Point2(*antenna))
    values.insert(W(0), np.asarray(w, dtype=float))
    if measurements.calibrated:
        values.insert(Z(0), np.asarray(z, dtype=float))
    return state_from_values(measurements, values)


def state_from_values(measurements, values):
    """The State of gtsam.Values, which come in the order of their keys, by letter and number."""
    poses, points = gtsam.utilities.extractPose2(values), gtsam.utilities.extractPoint2(values)
    oriented, antennas = measurements.oriented, len(measurements.antenna)
    with_heading, without = np.count_nonzero(oriented), np.count_nonzero(~oriented)
    markers = np.zeros((len(oriented), 3))
    markers[oriented] = poses[:with_heading]                               # L before X
    markers[~oriented, :2] = points[antennas:antennas + without]           # A, P, then w and z
    poses = poses[with_heading:]
    turn = measurements.turn                    # a frame's heading continues that of the one before
    apart = se2.wrap(np.diff(poses[:, 2]) - turn)
    poses[:, 2] = odometry.cumulative(turn + apart, poses[0, 2])
    return State(poses=poses, markers=markers, antennas=points[:antennas], w=values.atVector(W(0)),
                 z=values.atVector(Z(0)) if measurements.calibrated else np.zeros(2),
                 values=values)
