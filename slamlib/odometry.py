"""Problem 1: where the encoders say the vehicle is, and how far they can be trusted.

One encoder step with n_R, n_L counts moves the vehicle by ds and turns it by dtheta,

    ds     = pi (n_R R_R + n_L R_L) / n_0,
    dtheta = 2 pi (n_R R_R - n_L R_L) / (b n_0),

and the assignment's equation 1 applies it as a forward Euler step: ds along the heading at the
start of the step. `model="arc"` drives the same step as the circular arc that wheels at constant
speed describe: the chord ds sin(dtheta/2) / (dtheta/2) along the heading half way.

Two covariances are computed. `equation2` is the assignment's, from De Cecco, Baglivo and Angrilli
(IEEE T. Instrum. Meas. 56(3), 2007), in closed form. `first_order` is the exact first-order
propagation of the same four uncertain quantities, w = [R_R, R_L, b] and the initial pose.
"""


import numpy as np

from slamlib import se2

MODELS = ("euler", "arc")


def steps(ticks, vehicle):
    """Length and turn of every encoder step, and their derivatives by the wheel parameters.

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel; row 0 leads to pose 1 and is not used.
    vehicle : Vehicle

    Returns
    -------
    ds, dtheta : (n-1,) m and rad, the step from each pose to the next.
    ds_by_w, dtheta_by_w : (n-1, 3) derivatives by [R_R, R_L, b].
    """
    n_right, n_left = np.asarray(ticks, dtype=float)[1:].T
    per_count = np.pi / vehicle.ticks_per_revolution
    zero = np.zeros(len(n_right))
    ds_by_w = per_count * np.stack([n_right, n_left, zero], -1)
    ds = ds_by_w[:, 0] * vehicle.right_radius + ds_by_w[:, 1] * vehicle.left_radius
    difference = ds_by_w[:, 0] * vehicle.right_radius - ds_by_w[:, 1] * vehicle.left_radius
    dtheta = 2 * difference / vehicle.wheelbase
    dtheta_by_w = 2 / vehicle.wheelbase * np.stack(
        [ds_by_w[:, 0], -ds_by_w[:, 1], -dtheta / 2], -1)
    return ds, dtheta, ds_by_w, dtheta_by_w


def dead_reckoning(ticks, vehicle, initial_pose=(0.0, 0.0, 0.0), model="euler"):
    """Vehicle poses by composing the encoder steps: equation 1 of the assignment, or exact arcs.

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel.
    vehicle : Vehicle
    initial_pose : (3,) [x, y, heading] of pose 1, m and rad.
    model : "euler" (equation 1) or "arc".

    Returns
    -------
    (n, 3) poses [x, y, heading] in the world frame, heading continuous.
    """
    ds, dtheta, _, _ = steps(ticks, vehicle)
    heading = _accumulate(dtheta, initial_pose[2])
    chord, _, bend = _chord(dtheta, model)
    length, direction = ds * chord, heading[:-1] + bend * dtheta
    return np.stack([_accumulate(length * np.cos(direction), initial_pose[0]),
                     _accumulate(length * np.sin(direction), initial_pose[1]),
                     heading], -1)


def equation2(ticks, vehicle, initial_pose=(0.0, 0.0, 0.0), initial_covariance=None):
    """Poses by equation 1 and their covariance by equations 2 and 3, in closed form.

    Equation 2 adds J C_w J^T + J S I^T + I S J^T at every step: the expansion of
    (I + J S)(I + J S)^T - I I^T, and I + J S is the next I. So the sum telescopes,

        C_Xk = C_X1 + I_k I_k^T,      I_k = sum over the steps j < k of J_j S_wj.

    S_wj holds sigma_theta_j, the root of C_Xj[2, 2]; the heading row of J has no heading column,
    so I_k's heading row, hence every sigma_theta_j, follows from the first three columns alone.
    Two cumulative sums replace the recursion.

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel.
    vehicle : Vehicle, with the sigmas of R_R, R_L and b.
    initial_pose : (3,) pose 1, m and rad.
    initial_covariance : (3, 3) C_X1 of [x, y, heading]; by default diag(0, 0, sigma_heading^2).

    Returns
    -------
    poses : (n, 3) [x, y, heading].
    covariances : (n, 3, 3) of [x, y, heading] in world axes.
    """
    if initial_covariance is None:
        initial_covariance = np.diag([0.0, 0.0, vehicle.sigma_heading**2])
    poses = dead_reckoning(ticks, vehicle, initial_pose)
    J = step_jacobian(ticks, vehicle, poses[:-1, 2])
    integral = np.zeros((len(poses), 3, 4))                                 # I_k of equation 3
    integral[1:, :, :3] = np.cumsum(J[:, :, :3] * vehicle.sigma_wheel, axis=0)
    sigma_heading = np.sqrt(initial_covariance[2, 2] + np.sum(integral[:-1, 2, :3]**2, axis=-1))
    integral[1:, :, 3] = np.cumsum(J[:, :, 3] * sigma_heading[:, None], axis=0)
    return poses, initial_covariance + integral @ np.swapaxes(integral, -1, -2)


def step_jacobian(ticks, vehicle, heading):
    """J_k of equation 2: derivatives of one Euler step by w_k = [R_R, R_L, b, heading_k].

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel.
    vehicle : Vehicle
    heading : (n-1,) rad, at the start of each step.

    Returns
    -------
    (n-1, 3, 4) d(X_{k+1} - X_k) / d w_k.
    """
    ds, _, ds_by_w, dtheta_by_w = steps(ticks, vehicle)
    c, s = np.cos(heading), np.sin(heading)
    J = np.zeros((len(ds), 3, 4))
    J[:, 0, :3] = c[:, None] * ds_by_w
    J[:, 1, :3] = s[:, None] * ds_by_w
    J[:, 2, :3] = dtheta_by_w
    J[:, 0, 3] = -ds * s
    J[:, 1, 3] = ds * c
    return J


def wheel_jacobian(ticks, vehicle, initial_heading=0.0, model="euler"):
    """Derivatives of every dead-reckoned pose by the wheel parameters, pose 1 held fixed.

    The same constant error of a radius acts in every step, and through the heading on all later
    steps: the derivatives of the steps are accumulated, not their variances.

    Returns
    -------
    (n, 3, 3) d [x, y, heading] / d [R_R, R_L, b].
    """
    ds, dtheta, ds_by_w, dtheta_by_w = steps(ticks, vehicle)
    heading = _accumulate(dtheta, initial_heading)
    heading_by_w = _accumulate(dtheta_by_w)
    chord, chord_slope, bend = _chord(dtheta, model)
    length, direction = (ds * chord)[:, None], (heading[:-1] + bend * dtheta)[:, None]
    length_by_w = chord[:, None] * ds_by_w + (ds * chord_slope)[:, None] * dtheta_by_w
    direction_by_w = heading_by_w[:-1] + bend * dtheta_by_w
    c, s = np.cos(direction), np.sin(direction)
    return np.stack([_accumulate(c * length_by_w - s * length * direction_by_w),
                     _accumulate(s * length_by_w + c * length * direction_by_w),
                     heading_by_w], axis=1)


def first_order(ticks, vehicle, initial_pose=(0.0, 0.0, 0.0), initial_covariance=None,
                model="euler"):
    """Poses and their exact first-order covariance under uncertain w and initial pose.

    With G_k = d X_k / d [R_R, R_L, b] and A_k = d X_k / d X_1,

        C_Xk = A_k C_X1 A_k^T + G_k diag(sigma_RR^2, sigma_RL^2, sigma_b^2) G_k^T.

    Unlike equation 2 it keeps the correlation between position and heading, because an error of
    the heading at pose k turns all that follows.

    Parameters and returns are those of `equation2`, with the increments' model to choose.
    """
    if initial_covariance is None:
        initial_covariance = np.diag([0.0, 0.0, vehicle.sigma_heading**2])
    poses = dead_reckoning(ticks, vehicle, initial_pose, model)
    G = wheel_jacobian(ticks, vehicle, initial_pose[2], model) * vehicle.sigma_wheel
    A, _ = se2.compose_jacobians(poses[0], se2.between(poses[0], poses))
    A_t, G_t = np.swapaxes(A, -1, -2), np.swapaxes(G, -1, -2)
    return poses, A @ initial_covariance @ A_t + G @ G_t


def increments(ticks, vehicle, start, end, model="euler"):
    """Increments between any two poses by odometry alone, with their wheel-parameter Jacobians.

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel.
    vehicle : Vehicle
    start, end : (m,) indices from 0 of the poses at which each increment starts and ends.
    model : "euler" or "arc".

    Returns
    -------
    increment : (m, 3) pose `end` in the frame of pose `start`.
    increment_by_w : (m, 3, 3) its derivatives by [R_R, R_L, b].
    """
    poses = dead_reckoning(ticks, vehicle, model=model)
    by_w = wheel_jacobian(ticks, vehicle, model=model)
    by_start, by_end = se2.between_jacobians(poses[start], poses[end])
    return (se2.between(poses[start], poses[end]),
            by_start @ by_w[start] + by_end @ by_w[end])


def increment_noise(ticks, vehicle, start, end, slip):
    """Covariances of increments from what differs in every step: rounding of counts, and slip.

    A wheel that travels s metres errs by slip with variance slip^2 |s|; the rounding of cumulative
    counts at both ends of an increment adds one sixth of a count squared, spread over its steps.
    Wheel errors e_R, e_L in the step at p along the unit vector u lengthen it by (e_R + e_L) / 2
    and turn what follows by (e_R - e_L) / b, which moves its end p_e by that times S (p_e - p),
    S = [[0, -1], [1, 0]]. What a step contributes is linear in p_e, so it is summed up once.

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel.
    vehicle : Vehicle
    start, end : (m,) indices from 0 of the poses, start < end.
    slip : sqrt(m), standard deviation of the slip of one wheel after one metre.

    Returns
    -------
    (m, 3, 3) covariance of [x, y, heading] of pose `end` in the frame of pose `start`.
    """
    poses = dead_reckoning(ticks, vehicle, model="arc")
    ds, dtheta, _, _ = steps(ticks, vehicle)
    u = np.stack([np.cos(poses[:-1, 2] + dtheta / 2), np.sin(poses[:-1, 2] + dtheta / 2)], -1)
    p = (poses[:-1, :2] + poses[1:, :2]) / 2
    sides = vehicle.wheelbase / 2 * np.array([1, -1])
    turn = 1 / (2 * sides)                                             # by e_R, by e_L
    by_wheel = np.empty((len(ds), 3, 2))                               # of (end - S p_e turn, turn)
    by_wheel[:, 0] = u[:, :1] / 2 + p[:, 1:] * turn
    by_wheel[:, 1] = u[:, 1:] / 2 - p[:, :1] * turn
    by_wheel[:, 2] = turn
    outer = by_wheel[:, :, None, :] * by_wheel[:, None, :, :]          # (n-1, 3, 3, wheel)
    from_slip = outer @ (slip**2 * np.abs(ds[:, None] + sides * dtheta[:, None])[:, None, :, None])
    radii = vehicle.wheel[:2]
    from_rounding = outer @ ((2 * np.pi * radii / vehicle.ticks_per_revolution)**2 / 6)
    start, end = np.asarray(start), np.asarray(end)
    total = [_accumulate(part) for part in (from_slip[..., 0], from_rounding)]
    summed = total[0][end] - total[0][start] \
        + (total[1][end] - total[1][start]) / (end - start)[:, None, None]
    to_end = np.broadcast_to(np.eye(3), summed.shape).copy()
    to_end[:, 0, 2], to_end[:, 1, 2] = -poses[end, 1], poses[end, 0]
    in_world = to_end @ summed @ np.swapaxes(to_end, 1, 2)
    return se2.rotate_covariance(in_world, -poses[start, 2])


def monte_carlo(ticks, vehicle, at, rng, draws=400, model="euler"):
    """Poses of vehicles whose wheel parameters and initial heading are drawn from their sigmas.

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel, the same for every draw.
    vehicle : Vehicle, with the means and sigmas to draw from.
    at : (m,) indices from 0 of the poses to keep.
    rng : numpy random generator.
    draws : number of draws.

    Returns
    -------
    (draws, m, 3) poses [x, y, heading].
    """
    deviations = rng.standard_normal((draws, 4)) * [*vehicle.sigma_wheel, vehicle.sigma_heading]
    return np.stack([
        dead_reckoning(ticks, vehicle.with_wheel(vehicle.wheel + deviation[:3]),
                       (0.0, 0.0, deviation[3]), model)[at]
        for deviation in deviations])


def _chord(dtheta, model):
    """The chord of a step that turns by dtheta, for a step of unit length.

    Returns its length ((n,), 1 for Euler), the derivative of that by dtheta, and the share of
    dtheta by which the chord is turned from the heading at the start (0 for Euler, 1/2 for arcs).
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


def _accumulate(increments, initial=0.0):
    """Cumulative sum over the first axis that starts with `initial`: one row more than given."""
    total = np.zeros((len(increments) + 1,) + np.shape(increments)[1:])
    np.cumsum(increments, axis=0, out=total[1:])
    return total + initial
