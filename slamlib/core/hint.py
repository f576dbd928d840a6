"""Problem 2, the fusion that the assignment suggests: independent increments, equation 2 restarted.

At a frame, the odometry increment Delta_o with covariance C_o (equation 2, with I_k and covariance
zero at the last fused frame) and the marker increment Delta_m with covariance C_m are fused by

    Delta = Delta_o + C_o (C_o + C_m)^-1 (Delta_m - Delta_o),    C = (C_o^-1 + C_m^-1)^-1.

The result is overconfident and overweights odometry: errors of the wheel parameters are the same in
all increments, consecutive marker increments share sightings, and equation 2 has no wheel slip.
`robust.fused` counts shared errors once and learns the slip.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.errors import require
from slamlib.core.marker_increments import consecutive_increments
from slamlib.core.records import Dataset
from slamlib.core.sightings import sightings_by_frame


@dataclass(frozen=True)
class Fusion:
    """Poses and covariances by fusion, for every pose of the encoder file."""

    poses: np.ndarray            # (n, 3) in the world frame, m and rad
    covariances: np.ndarray      # (n, 3, 3) of [x, y, heading] in world axes
    rejected: int                # number of sightings not used; repeated ones are used once
    slip: float | None = None    # sqrt(m), given or learned
    wheel: np.ndarray | None = None             # (3,) m, R_R, R_L, b estimated at the last frame
    wheel_covariance: np.ndarray | None = None  # (3, 3) m^2


def fuse_increments(dataset, propagation=odometry.equation2):
    """Fusion for problem 2 as the assignment suggests: equation 2 restarts at every fused frame.

    Where markers give no increment, odometry alone is used. `propagation` is `odometry.equation2`,
    or `odometry.first_order` with all correlations between two frames.
    """
    require(isinstance(dataset, Dataset), "fuse_increments", "a Dataset", dataset)
    ticks, vehicle = dataset.ticks, dataset.vehicle
    sightings = sightings_by_frame(dataset.sightings, extra_frames=[0])
    found = consecutive_increments(sightings)
    poses, covariances = np.zeros((len(ticks), 3)), np.zeros((len(ticks), 3, 3))
    covariances[0, 2, 2] = vehicle.sigma_heading**2
    for k, (start, end) in enumerate(pairwise([*sightings.frame, len(ticks) - 1])):
        part, pose, C = slice(start, end + 1), poses[start], covariances[start]
        poses[part], covariances[part] = propagation(ticks[part], vehicle, pose, C)
        if k < len(found.usable) and found.usable[k]:
            deltas, C_deltas = propagation(ticks[part], vehicle, np.zeros(3), np.zeros((3, 3)))
            gain = C_deltas[-1] @ np.linalg.inv(C_deltas[-1] + found.covariance[k])
            delta = deltas[-1] + gain @ se2.difference(found.increment[k], deltas[-1])
            poses[end], covariances[end] = se2.compose_uncertain(
                pose, C, delta, gain @ found.covariance[k])
    used = np.union1d(*(r[found.accepted] for r in (found.first, found.second)))
    return Fusion(poses=poses, covariances=covariances,
                  rejected=len(dataset.aruco.pose) - len(used))
