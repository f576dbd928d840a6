"""Problem 1: vehicle poses by odometry and their covariances.

One encoder step with n_R, n_L counts moves the vehicle by ds and turns it by dtheta,

    ds     = pi (n_R R_R + n_L R_L) / n_0,
    dtheta = 2 pi (n_R R_R - n_L R_L) / (b n_0).

The assignment's equation 1 is a forward Euler step: ds along the heading at the start of the step.
`model="arc"` is exact for wheels at constant speed, which describe a circular arc: its chord is
ds sin(dtheta/2) / (dtheta/2) long, along the heading at the middle of the step.

`equation2` computes the assignment's covariance in closed form, from De Cecco, Baglivo and Angrilli
(IEEE T. Instrum. Meas. 56(3), 2007). `first_order` computes the exact first-order covariance for
the same uncertain quantities: the wheel parameters w = [R_R, R_L, b] and the initial pose.

All functions take the `ticks` (n, 2), counts of the right and left wheel in the step to each of n
poses (row 0 is not used), and a `vehicle`, a Vehicle. Poses are [x, y, heading] in the world frame,
in m and rad, with continuous headings; their covariances are in world axes. A `model` that is not
in MODELS raises ValueError.
"""

import numpy as np

from slamlib.core import se2

MODELS = ("euler", "arc")


def steps(ticks, vehicle):
    """Length ds and turn dtheta of every step in equation 1, with their derivatives.

    Returns ds (n-1,) in m, dtheta (n-1,) in rad, and their derivatives by the wheel parameters
    [R_R, R_L, b] in m: ds_by_w (n-1, 3) without unit, dtheta_by_w (n-1, 3) in rad/m.
    """
    counts = np.asarray(ticks, dtype=float)[1:]
    ds_by_w = np.pi / vehicle.ticks_per_revolution * np.insert(counts, 2, 0.0, axis=1)  # b: zero
    right, left = ds_by_w[:, 0] * vehicle.right_radius, ds_by_w[:, 1] * vehicle.left_radius
    dtheta = 2 * (right - left) / vehicle.wheelbase
    dtheta_by_w = 2 / vehicle.wheelbase * np.stack(
        [ds_by_w[:, 0], -ds_by_w[:, 1], -dtheta / 2], -1)
    return right + left, dtheta, ds_by_w, dtheta_by_w


def dead_reckoning(ticks, vehicle, initial_pose=(0.0, 0.0, 0.0), model="euler"):
    """Poses (n, 3) from `initial_pose` (3,) by equation 1 or, with model "arc", by exact arcs.

    One revolution of both wheels, whose radii are 0.1 m:

    >>> from slamlib.core.vehicle import Vehicle
    >>> dead_reckoning([[0, 0], [8000, 8000]], Vehicle()).round(3)
    array([[0.   , 0.   , 0.   ],
           [0.628, 0.   , 0.   ]])
    """
    ds, dtheta, _, _ = steps(ticks, vehicle)
    heading = cumulative(dtheta, initial_pose[2])
    chord, _, bend = _chord(dtheta, model)
    length, direction = ds * chord, heading[:-1] + bend * dtheta
    return np.stack([cumulative(length * np.cos(direction), initial_pose[0]),
                     cumulative(length * np.sin(direction), initial_pose[1]),
                     heading], -1)


def equation2(ticks, vehicle, initial_pose=(0.0, 0.0, 0.0), initial_covariance=None):
    """Poses (n, 3) by equation 1 and covariances (n, 3, 3) by equation 2 and equation 3.

    Equation 2 adds J C_w J^T + J S I^T + I S J^T = (I + J S)(I + J S)^T - I I^T at every step, and
    I + J S is the next I, the (3, 4) sum of equation 3 and not the identity. The sum telescopes:

        C_Xk = C_X1 + I_k I_k^T,      I_k = sum over the steps j < k of J_j S_wj.

    S_wj contains sigma_theta_j, the root of C_Xj[2, 2]. The heading row of J is zero in the heading
    column, so the first three columns of I_k determine every sigma_theta_j. Two cumulative sums
    replace the recursion. `initial_pose` (3,) is pose 1 and `initial_covariance` (3, 3) is C_X1, by
    default diag(0, 0, sigma_heading^2).

    >>> from slamlib.core.vehicle import Vehicle
    >>> poses, covariances = equation2([[0, 0], [8000, 8000]], Vehicle())
    >>> (1e3 * np.sqrt(np.diagonal(covariances[-1]))).round(3)         # mm, mm, mrad
    array([0.444, 0.063, 2.224])
    """
    if initial_covariance is None:
        initial_covariance = np.diag([0.0, 0.0, vehicle.sigma_heading**2])
    poses = dead_reckoning(ticks, vehicle, initial_pose)
    J = step_jacobian(ticks, vehicle, poses[:-1, 2])
    integral = np.zeros((len(poses), 3, 4))                                 # I_k of equation 3
    integral[1:, :, :3] = np.cumsum(J[:, :, :3] * vehicle.sigma_wheel, axis=0)
    sigma_heading = np.sqrt(initial_covariance[2, 2] + np.sum(integral[:-1, 2, :3]**2, axis=-1))
    integral[1:, :, 3] = np.cumsum(J[:, :, 3] * sigma_heading[:, None], axis=0)
    return poses, initial_covariance + integral @ integral.mT


def step_jacobian(ticks, vehicle, heading):
    """Jacobians J_k of equation 2 and equation 3, (n-1, 3, 4).

    J_k = d(X_{k+1} - X_k) / d w_k with w_k = [R_R, R_L, b, heading_k]. `heading` (n-1,) is that at
    the start of each Euler step, in rad.
    """
    ds, _, ds_by_w, dtheta_by_w = steps(ticks, vehicle)
    c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
    by_wheels = np.stack([c * ds_by_w, s * ds_by_w, dtheta_by_w], axis=1)
    by_heading = np.hstack([-s, c, 0 * c]) * ds[:, None]
    return np.concatenate([by_wheels, by_heading[..., None]], axis=2)


def wheel_jacobian(ticks, vehicle, initial_heading=0.0, model="euler"):
    """Derivatives (n, 3, 3) of the poses of `dead_reckoning` by [R_R, R_L, b], with pose 1 fixed.

    A wheel-parameter error is constant. It acts in every step and, through the heading, on all
    later steps: the derivatives accumulate, not the variances. `initial_heading` is in rad.
    """
    ds, dtheta, ds_by_w, dtheta_by_w = steps(ticks, vehicle)
    heading = cumulative(dtheta, initial_heading)
    heading_by_w = cumulative(dtheta_by_w)
    chord, chord_slope, bend = _chord(dtheta, model)
    length, direction = (ds * chord)[:, None], (heading[:-1] + bend * dtheta)[:, None]
    length_by_w = chord[:, None] * ds_by_w + (ds * chord_slope)[:, None] * dtheta_by_w
    direction_by_w = heading_by_w[:-1] + bend * dtheta_by_w
    c, s = np.cos(direction), np.sin(direction)
    return np.stack([cumulative(c * length_by_w - s * length * direction_by_w),
                     cumulative(s * length_by_w + c * length * direction_by_w),
                     heading_by_w], axis=1)


def first_order(ticks, vehicle, initial_pose=(0.0, 0.0, 0.0), initial_covariance=None,
                model="euler"):
    """Poses (n, 3) and their exact first-order covariances (n, 3, 3).

    With G_k = d X_k / d [R_R, R_L, b] and A_k = d X_k / d X_1,

        C_Xk = A_k C_X1 A_k^T + G_k diag(sigma_RR^2, sigma_RL^2, sigma_b^2) G_k^T.

    Unlike equation 2 it contains the correlation of position and heading, because A_k and G_k
    propagate a heading error to all later positions. Shapes and defaults are those of `equation2`.
    """
    if initial_covariance is None:
        initial_covariance = np.diag([0.0, 0.0, vehicle.sigma_heading**2])
    poses = dead_reckoning(ticks, vehicle, initial_pose, model)
    G = wheel_jacobian(ticks, vehicle, initial_pose[2], model) * vehicle.sigma_wheel
    A, _ = se2.compose_jacobians(poses[0], se2.between(poses[0], poses))
    return poses, A @ initial_covariance @ A.mT + G @ G.mT


def cumulative(increments, initial=0.0):
    """Cumulative sums (n+1, ...) of increments (n, ...) over the first axis, after `initial`."""
    return np.cumulative_sum(increments, axis=0, include_initial=True) + initial


def _chord(dtheta, model):
    """Chord of a step of unit length that turns by dtheta (n,) rad.

    Returns its length (n,), the derivative of the length by dtheta (n,), and the fraction of dtheta
    between the heading at the start and the chord: 0 for Euler steps, 1/2 for arcs.
    """
    if model == "euler":
        return np.ones_like(dtheta), np.zeros_like(dtheta), 0.0
    if model != "arc":
        raise ValueError(f"model must be one of {MODELS}, not {model!r}")
    half = dtheta / 2
    small = np.abs(half) < 1e-4                    # the quotient cancels there: use its series
    safe = np.where(small, 1.0, half)
    slope = np.where(small, -half / 3, (np.cos(safe) - np.sin(safe) / safe) / safe)
    return np.sinc(half / np.pi), slope / 2, 0.5
