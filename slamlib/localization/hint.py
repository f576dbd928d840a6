"""Problem 2, the fusion that the assignment suggests: independent increments, equation 2 restarted.

At a frame, the odometry increment Delta_o with covariance C_o (equation 2, with I_k and covariance
zero at the last fused frame) and the marker increment Delta_m with covariance C_m are fused by

    Delta = Delta_o + C_o (C_o + C_m)^-1 (Delta_m - Delta_o),    C = (C_o^-1 + C_m^-1)^-1.

The result is overconfident and overweights odometry: errors of the wheel parameters are the same in
all increments, and consecutive marker increments share sightings. `fused.py` counts both once.
"""

import numpy as np

from slamlib import odometry, se2
from slamlib.localization.fused import Fusion
from slamlib.localization.marker_increments import consecutive_increments
from slamlib.sightings import sightings_by_frame


def fuse_increments(dataset, propagation=odometry.equation2):
    """Fusion of a Dataset by independent increments; where markers give none, odometry alone.

    `propagation` is `odometry.equation2`, or `odometry.first_order` to include all correlations.
    """
    ticks, vehicle = dataset.ticks, dataset.vehicle
    sightings = sightings_by_frame(dataset.aruco, extra_frames=[0])
    frame, increments = sightings.frame, consecutive_increments(sightings)
    poses, covariances = [np.zeros((1, 3))], [np.diag([0, 0, vehicle.sigma_heading])[None]**2]
    for k, (start, end) in enumerate(zip(frame, np.r_[frame[1:], len(ticks) - 1], strict=True)):
        driven, pose, covariance = ticks[start:end + 1], poses[-1][-1], covariances[-1][-1]
        path, path_covariance = propagation(driven, vehicle, pose, covariance)
        if k < len(frame) - 1 and increments.usable[k]:
            by_odometry, C_odometry = propagation(driven, vehicle, np.zeros(3), np.zeros((3, 3)))
            difference = increments.increment[k] - by_odometry[-1]
            difference[2] = se2.wrap(difference[2])
            gain = C_odometry[-1] @ np.linalg.inv(C_odometry[-1] + increments.covariance[k])
            delta, C = by_odometry[-1] + gain @ difference, gain @ increments.covariance[k]
            A, B = se2.compose_jacobians(pose, delta)
            path[-1] = se2.compose(pose, delta)
            path_covariance[-1] = A @ covariance @ A.T + B @ (C + C.T) / 2 @ B.T
        poses.append(path[1:])
        covariances.append(path_covariance[1:])
    used = np.union1d(*(r[increments.accepted] for r in (increments.first, increments.second)))
    return Fusion(poses=np.concatenate(poses), covariances=np.concatenate(covariances),
                  measured=frame, rejected=len(dataset.aruco.pose) - len(used))
