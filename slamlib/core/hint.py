"""Problem 2, the fusion that the assignment suggests: independent increments, equation 2 restarted.

At a frame, the odometry increment Delta_o with covariance C_o (equation 2, with I_k and covariance
zero at the last fused frame) and the marker increment Delta_m with covariance C_m are fused by

    Delta = Delta_o + C_o (C_o + C_m)^-1 (Delta_m - Delta_o),    C = (C_o^-1 + C_m^-1)^-1.

The result is overconfident and overweights odometry: errors of the wheel parameters are the same in
all increments, consecutive marker increments share sightings, and equation 2 has no wheel slip.
`robust.fused` counts shared errors once and learns the slip.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.errors import require
from slamlib.core.marker_increments import consecutive_increments
from slamlib.core.records import NO_SIGHTINGS, Dataset
from slamlib.core.sightings import sightings_by_frame


@dataclass(frozen=True)
class Fusion:
    """Poses and covariances by fusion, for every pose of the encoder file."""

    poses: np.ndarray            # (n, 3) in the world frame, m and rad
    covariances: np.ndarray      # (n, 3, 3) of [x, y, heading] in world axes
    rejected: int                # number of sightings not used; repeated ones are used once


def fuse_increments(dataset: Dataset, propagation: Callable = odometry.equation2) -> Fusion:
    """Fusion for problem 2 as the assignment suggests: equation 2 restarts at every fused frame.

    Where markers give no increment, odometry alone is used; without markers that is the propagation
    of the whole drive. `propagation` is `odometry.equation2`, or `odometry.first_order` with all
    correlations between two frames.
    """
    require(isinstance(dataset, Dataset), "fuse_increments", "a Dataset", dataset)
    ticks = dataset.ticks
    vehicle = dataset.vehicle
    sightings = sightings_by_frame(dataset.sightings, extra_frames=[0])
    found = consecutive_increments(sightings)
    edge = np.append(sightings.frame, len(ticks) - 1)
    usable = np.append(found.usable, False)                  # no frame follows the last one
    poses = np.zeros((len(ticks), 3))
    covariances = np.zeros((len(ticks), 3, 3))
    covariances[0, 2, 2] = vehicle.sigma_heading**2
    for k, start in enumerate(sightings.frame):
        end = edge[k + 1]
        part = slice(start, end + 1)
        pose = poses[start]
        C = covariances[start]
        poses[part], covariances[part] = propagation(ticks[part], vehicle, pose, C)
        if usable[k]:
            deltas, C_deltas = propagation(
                ticks[part], vehicle, initial_covariance=np.zeros((3, 3)))
            delta_o = deltas[-1]
            C_o = C_deltas[-1]
            C_m = found.covariance[k]
            gain = C_o @ np.linalg.inv(C_o + C_m)
            delta = delta_o + gain @ se2.difference(found.increment[k], delta_o)
            C_delta = gain @ C_m                 # (C_o^-1 + C_m^-1)^-1, symmetric but for rounding
            C_delta = (C_delta + C_delta.T) / 2
            poses[end], covariances[end] = se2.compose_uncertain(pose, C, delta, C_delta)
    common = np.stack([found.first, found.second])
    used = np.unique(common[:, found.accepted])
    aruco = dataset.aruco or NO_SIGHTINGS
    return Fusion(poses, covariances, rejected=len(aruco.pose) - len(used))
