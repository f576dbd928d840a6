"""Stage 7: every encoder pose between the frames, conditioned on its two neighbours."""

import numpy as np

from slamlib import increments, se2
from slamlib.slam.odometry_factors import odometry_noise

AT_ONCE = 1000               # frames between which poses are computed together: these stay in cache


def interpolate(problem, state, pairs):
    """Every encoder pose (n, 3) and its covariance (n, 3, 3) in world axes, given the frames.

    Between the frames a and b a pose k depends on nothing but them and w. X_a Delta_ak(w) and
    X_b Delta_kb(w)^-1 are two estimates of it, with the independent noise of the encoder steps
    before and after it. Their average by information is the conditional mean, exact to first order.

    `pairs` (f-1, 9, 9) are those of `Covariances` at the State that solves the Problem.
    """
    frame, count = problem.measurements.frame, len(problem.measurements.dataset.ticks)
    if not len(pairs):                                       # pose 1 alone: the world's origin
        return state.poses.copy(), np.diag(problem.measurements.origin_sigma)[None]**2
    poses, covariances = np.empty((count, 3)), np.empty((count, 3, 3))
    for first in range(0, len(pairs), AT_ONCE):
        rows = slice(first, min(first + AT_ONCE, len(pairs)) + 1)          # of frames
        own = slice(frame[rows][0], frame[rows][-1] + 1)                   # shares its ends
        poses[own], covariances[own] = _section(
            problem, state.poses[rows], state.w, frame[rows], pairs[rows.start:rows.stop - 1])
    return poses, covariances


def _section(problem, poses, w, frame, pairs):
    """The same from the first to the last of some consecutive frames, at encoder poses (g,)."""
    joint = _in_world_axes(pairs, poses)
    pose = np.arange(frame[0], frame[-1] + 1)
    last = np.searchsorted(frame, pose, side="right") - 1
    all_poses = poses[last].copy()
    covariances = np.concatenate([joint[:, :3, :3], joint[-1:, 3:6, 3:6]])[last]
    inner = np.flatnonzero(~np.isin(pose, frame))
    if not len(inner):
        return all_poses, covariances
    a, b = last[inner], last[inner] + 1

    forward, forward_by_w, noise = _increments(problem, w, frame, frame[a], pose[inner])
    A, B = se2.compose_jacobians(poses[a], forward)
    N_a = B @ noise @ np.swapaxes(B, 1, 2)
    ahead, ahead_by_w, noise = _increments(problem, w, frame, pose[inner], frame[b])
    back = se2.inverse(ahead)
    A_b, B_b = se2.compose_jacobians(poses[b], back)
    B_b = B_b @ se2.inverse_jacobian(ahead)
    N_b = B_b @ noise @ np.swapaxes(B_b, 1, 2)

    gain = N_a @ np.linalg.inv(N_a + N_b)
    rest = np.eye(3) - gain
    estimate, other = se2.compose(poses[a], forward), se2.compose(poses[b], back)
    difference = other - estimate
    difference[:, 2] = se2.wrap(difference[:, 2])
    F = np.concatenate([rest @ A, gain @ A_b,
                        rest @ B @ forward_by_w + gain @ B_b @ ahead_by_w], axis=2)
    all_poses[inner] = estimate + np.einsum("nij,nj->ni", gain, difference)
    covariances[inner] = F @ joint[a] @ np.swapaxes(F, 1, 2) + rest @ N_a
    return all_poses, (covariances + np.swapaxes(covariances, 1, 2)) / 2


def _in_world_axes(pairs, poses):
    """(f-1, 9, 9) covariances of [X_i, X_{i+1}, w], those of the poses in world axes."""
    turned = np.zeros_like(pairs)
    turned[:, range(9), range(9)] = 1
    turned[:, :2, :2], turned[:, 3:5, 3:5] = (se2.rotation(poses[rows, 2])
                                              for rows in (slice(-1), slice(1, None)))
    return turned @ pairs @ np.swapaxes(turned, 1, 2)


def _increments(problem, w, frame, start, end):
    """Increments (m, 3) between poses of a section with these frames, at the wheels w.

    Also their derivatives by w, and their noise in the axes of the start.
    """
    d = problem.measurements.dataset
    vehicle, ticks = d.vehicle.with_deviation(w), d.ticks[frame[0]:frame[-1] + 1]
    start, end = start - frame[0], end - frame[0]
    delta, by_w = increments.between_poses(ticks, vehicle, start, end, problem.odometry.model)
    rounding, slipping = odometry_noise(ticks, vehicle, start, end, len(d.ticks) - 1)
    return delta, by_w * vehicle.sigma_wheel, rounding + problem.noise.slip**2 * slipping
