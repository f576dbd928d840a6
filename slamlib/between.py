"""Poses between the graph's: every encoder pose, conditioned on its two neighbours in the graph."""

import numpy as np

from slamlib import odometry, se2
from slamlib.factors import odometry_noise, vehicle_with
from slamlib.graph import GAUGE


def between_frames(graph, state, joint, slip):
    """Poses (n, 3) and covariances (n, 3, 3) of every encoder pose, given the graph's.

    Between two graph poses a and b a pose depends on nothing but them and w: X_a Delta_ak(w) and
    X_b Delta_kb(w)^-1 are two estimates of it with the independent noise of the encoder steps before
    and after, and their average by information is exact to first order.

    `joint` (f-1, 9, 9) are the covariances of [X_i, X_{i+1}, w] in GTSAM's axes.
    """
    poses, ticks, vehicle = state.poses, graph.dataset.ticks, vehicle_with(graph.dataset.vehicle, state.w)
    if not len(joint):                                       # pose 1 alone, which is the world's origin
        return poses, np.diag([GAUGE, GAUGE, vehicle.sigma_heading])[None]**2
    turned = np.zeros_like(joint)
    turned[:, range(9), range(9)] = 1
    turned[:, :2, :2], turned[:, 3:5, 3:5] = (se2.rotation(poses[rows, 2])
                                              for rows in (slice(-1), slice(1, None)))
    joint = turned @ joint @ np.swapaxes(turned, 1, 2)

    last = np.searchsorted(graph.frame, np.arange(len(ticks)), side="right") - 1
    all_poses = poses[last].copy()
    covariances = np.concatenate([joint[:, :3, :3], joint[-1:, 3:6, 3:6]])[last]
    between = np.flatnonzero(~np.isin(np.arange(len(ticks)), graph.frame))
    if not len(between):
        return all_poses, covariances
    a, b = last[between], last[between] + 1

    def increment(start, end):
        delta, by_w = odometry.increments(ticks, vehicle, start, end, graph.model)
        by_w = by_w * vehicle.sigma_wheel * (graph.wheels == "variable")
        rounding, slipping = odometry_noise(ticks, vehicle, start, end)
        return delta, by_w, rounding + slip**2 * slipping

    forward, forward_by_w, noise = increment(graph.frame[a], between)
    A, B = se2.compose_jacobians(poses[a], forward)
    N_a = B @ noise @ np.swapaxes(B, 1, 2)
    ahead, ahead_by_w, noise = increment(between, graph.frame[b])
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
    all_poses[between] = estimate + np.einsum("nij,nj->ni", gain, difference)
    covariances[between] = F @ joint[a] @ np.swapaxes(F, 1, 2) + rest @ N_a
    return all_poses, (covariances + np.swapaxes(covariances, 1, 2)) / 2
