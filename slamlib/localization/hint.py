"""Problem 2, the fusion that the assignment suggests: independent increments, equation 2 restarted.

At a frame, the odometry increment Delta_o with covariance C_o (equation 2, with I_k and covariance
zero at the last fused frame) and the marker increment Delta_m with covariance C_m are fused by

    Delta = Delta_o + C_o (C_o + C_m)^-1 (Delta_m - Delta_o),    C = (C_o^-1 + C_m^-1)^-1.

The result is overconfident and overweights odometry: errors of the wheel parameters are the same in
all increments, consecutive marker increments share sightings, and equation 2 has no wheel slip.
`fused.py` counts shared errors once and learns the slip.
"""

import numpy as np

from slamlib import increments, odometry, se2
from slamlib.dataset import Dataset
from slamlib.localization.fused import Fusion
from slamlib.marker_increments import consecutive_increments
from slamlib.sightings import sightings_by_frame
from slamlib.textfile import require_type


def equation2_from(ticks, vehicle, start, poses, covariances):
    """Equation 1 and equation 2 restarted at some poses: `odometry.equation2` of every part.

    Parameters
    ----------
    ticks : (n, 2); vehicle : Vehicle; start : (f,) poses from 0, ascending, the first one is 0.
    poses, covariances : (f, 3) and (f, 3, 3) at `start`, in world axes.

    Returns
    -------
    (n, 3) and (n, 3, 3), each pose from the last `start` before it; pose 0 as given.
    """
    driven = odometry.dead_reckoning(ticks, vehicle)
    part = np.maximum(np.searchsorted(start, np.arange(len(ticks))) - 1, 0)
    turned = (poses[:, 2] - driven[start, 2])[part]              # from the axes of `driven`
    J = odometry.step_jacobian(ticks, vehicle, driven[:-1, 2] + turned[1:])
    integral = np.zeros((len(ticks), 3, 4))                      # of all parts in their sum
    np.cumsum(J[:, :, :3] * vehicle.sigma_wheel, axis=0, out=integral[1:, :, :3])
    by_wheels = integral[:-1, 2, :3] - integral[start[part[1:]], 2, :3]
    sigma_heading = np.sqrt(covariances[part[1:], 2, 2] + np.sum(by_wheels**2, axis=-1))
    np.cumsum(J[:, :, 3] * sigma_heading[:, None], axis=0, out=integral[1:, :, 3])
    integral -= integral[start[part]]
    return (se2.compose(poses[part], se2.between(driven[start[part]], driven)),
            covariances[part] + integral @ integral.mT)


def first_order_from(ticks, vehicle, start, poses, covariances):
    """Poses (n, 3) and covariances (n, 3, 3) as `equation2_from`, by `odometry.first_order`.

    They have all correlations within the part of the drive that begins at a fused pose.
    """
    part = np.maximum(np.searchsorted(start, np.arange(len(ticks))) - 1, 0)
    delta, by_w = increments.between_poses(ticks, vehicle, start[part], np.arange(len(ticks)))
    by_w *= vehicle.sigma_wheel
    return se2.compose_uncertain(poses[part], covariances[part], delta, by_w @ by_w.mT)


def fuse_increments(dataset, propagation=equation2_from):
    """Fusion for problem 2 as the assignment suggests: equation 2 restarts at every fused frame.

    Where markers give no increment, odometry alone is used. `propagation` is `equation2_from`, or
    `first_order_from` with all correlations.
    """
    require_type(dataset, Dataset, "fuse_increments")
    ticks, vehicle = dataset.ticks, dataset.vehicle
    sightings = sightings_by_frame(dataset.sightings, extra_frames=[0])
    frame, found = sightings.frame, consecutive_increments(sightings)
    delta, C = (each[frame[1:]] for each in propagation(
        ticks, vehicle, frame, np.zeros((len(frame), 3)), np.zeros((len(frame), 3, 3))))
    use = found.usable
    gain = C[use] @ np.linalg.inv(C[use] + found.covariance[use])
    C[use] = gain @ found.covariance[use]
    difference = se2.difference(found.increment[use], delta[use])
    delta[use] += (gain @ difference[..., None])[..., 0]
    heading = odometry.cumulative(delta[:, 2])
    turned = (se2.rotation(heading[:-1]) @ delta[:, :2, None])[..., 0]
    poses = np.column_stack([odometry.cumulative(turned), heading])
    A, B = se2.compose_jacobians(poses[:-1], delta)
    noise, covariances = B @ (C + C.mT) @ B.mT / 2, np.zeros((len(frame), 3, 3))
    covariances[0, 2, 2] = vehicle.sigma_heading**2
    for k, (start, end) in enumerate(zip(frame, frame[1:])):
        if use[k]:
            covariances[k + 1] = A[k] @ covariances[k] @ A[k].T + noise[k]
        else:
            covariances[k + 1] = propagation(
                ticks[start:end + 1], vehicle, np.zeros(1, int), poses[k:k + 1],
                covariances[k:k + 1])[1][-1]
    path, path_covariances = propagation(ticks, vehicle, frame, poses, covariances)
    path[frame], path_covariances[frame] = poses, covariances
    used = np.union1d(*(r[found.accepted] for r in (found.first, found.second)))
    return Fusion(poses=path, covariances=path_covariances,
                  rejected=len(dataset.aruco.pose) - len(used))
