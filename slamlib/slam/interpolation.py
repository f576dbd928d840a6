"""Stage 7: the encoder poses between the frames, conditioned on both neighbouring frames."""

import numpy as np

from slamlib import increments, se2
from slamlib.slam.calibration import WHEELS
from slamlib.slam.problem import odometry_noise

FRAMES_AT_ONCE = 1000        # number of frames of a section, whose arrays stay in cache


def interpolate(problem, state, pairs):
    """Every encoder pose (n, 3) and its covariance (n, 3, 3) in world axes, given the frames.

    A pose k between the frames a and b depends only on them and on the wheels w. X_a Delta_ak(w)
    and X_b Delta_kb(w)^-1 are two estimates of it, with independent noise of the encoder steps
    before and after it. Their average by information is the conditional mean, exact to first order.

    `pairs` (f-1, 9, 9) as in `Covariances`, at the State that solves the Problem.
    """
    frame, count = problem.measurements.frame, len(problem.measurements.dataset.ticks)
    if not len(pairs):                                       # pose 1 alone: the world's origin
        return state.poses.copy(), np.diag(problem.measurements.origin_sigma)[None]**2
    poses, covariances = np.empty((count, 3)), np.empty((count, 3, 3))
    for first in range(0, len(pairs), FRAMES_AT_ONCE):
        rows = slice(first, min(first + FRAMES_AT_ONCE, len(pairs)) + 1)          # of frames
        section = slice(frame[rows][0], frame[rows][-1] + 1)               # shares its ends
        poses[section], covariances[section] = _interpolate_section(
            problem, state.poses[rows], state.c[WHEELS], frame[rows],
            pairs[rows.start:rows.stop - 1])
    return poses, covariances


def _interpolate_section(problem, poses, wheel, frame, pairs):
    """The same for the encoder poses from the first to the last of consecutive frames (g,)."""
    joint = _in_world_axes(pairs, poses)
    pose = np.arange(frame[0], frame[-1] + 1)
    last = np.searchsorted(frame, pose, side="right") - 1
    all_poses = poses[last].copy()
    covariances = np.concatenate([joint[:, :3, :3], joint[-1:, 3:6, 3:6]])[last]
    inner = np.flatnonzero(~np.isin(pose, frame))
    if not len(inner):
        return all_poses, covariances
    a, b = last[inner], last[inner] + 1

    delta_a, a_by_wheel, Q_a = _increments(problem, wheel, frame, frame[a], pose[inner])
    A_a, B_a = se2.compose_jacobians(poses[a], delta_a)
    N_a = B_a @ Q_a @ np.swapaxes(B_a, 1, 2)
    delta_b, b_by_wheel, Q_b = _increments(problem, wheel, frame, pose[inner], frame[b])
    back = se2.inverse(delta_b)
    A_b, B_b = se2.compose_jacobians(poses[b], back)
    B_b = B_b @ se2.inverse_jacobian(delta_b)
    N_b = B_b @ Q_b @ np.swapaxes(B_b, 1, 2)

    gain_b = N_a @ np.linalg.inv(N_a + N_b)
    gain_a = np.eye(3) - gain_b
    from_a, from_b = se2.compose(poses[a], delta_a), se2.compose(poses[b], back)
    difference = from_b - from_a
    difference[:, 2] = se2.wrap(difference[:, 2])
    F = np.concatenate([gain_a @ A_a, gain_b @ A_b,
                        gain_a @ B_a @ a_by_wheel + gain_b @ B_b @ b_by_wheel], axis=2)
    all_poses[inner] = from_a + np.einsum("nij,nj->ni", gain_b, difference)
    covariances[inner] = F @ joint[a] @ np.swapaxes(F, 1, 2) + gain_a @ N_a
    return all_poses, (covariances + np.swapaxes(covariances, 1, 2)) / 2


def _in_world_axes(pairs, poses):
    """Covariances (g-1, 9, 9) as `Covariances.pairs` with the poses in world axes."""
    turned = np.zeros_like(pairs)
    turned[:, range(9), range(9)] = 1
    turned[:, :2, :2], turned[:, 3:5, 3:5] = (se2.rotation(poses[rows, 2])
                                              for rows in (slice(-1), slice(1, None)))
    return turned @ pairs @ np.swapaxes(turned, 1, 2)


def _increments(problem, wheel, frame, start, end):
    """Increments (m, 3) from the encoder poses `start` (m,) to `end` (m,), with `wheel` (3,) m.

    Also their derivatives (m, 3, 3) by `wheel`, and their covariances Q (m, 3, 3) in the axes of
    the start. The poses lie in the section of the frames `frame` (g,).
    """
    d = problem.measurements.dataset
    vehicle, ticks = d.vehicle.with_wheel(wheel), d.ticks[frame[0]:frame[-1] + 1]
    start, end = start - frame[0], end - frame[0]
    delta, by_wheel = increments.between_poses(ticks, vehicle, start, end, problem.odometry.model)
    quantization, slipping = odometry_noise(ticks, vehicle, start, end, len(d.ticks) - 1)
    return delta, by_wheel, quantization + problem.noise.slip**2 * slipping
