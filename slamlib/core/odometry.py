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

from typing import NamedTuple

import numpy as np

from slamlib.core import se2
from slamlib.core.vehicle import Vehicle

MODELS = ("euler", "arc")
ORIGIN = (0.0, 0.0, 0.0)         # pose 1


class Steps(NamedTuple):
    """Every step by equation 1: its length `ds` (n-1,) in m and its turn `dtheta` (n-1,) in rad.

    `ds_by_w` (n-1, 3), without unit, and `dtheta_by_w` (n-1, 3), in rad/m, are their derivatives by
    the wheel parameters [R_R, R_L, b] in m.
    """

    ds: np.ndarray
    dtheta: np.ndarray
    ds_by_w: np.ndarray
    dtheta_by_w: np.ndarray


def steps(ticks: np.ndarray, vehicle: Vehicle) -> Steps:
    """The Steps by equation 1: lengths, turns, and their derivatives by the wheel parameters."""
    counts = np.asarray(ticks, dtype=float)[1:]
    by_right, by_left = (np.pi / vehicle.ticks_per_revolution * counts).T
    right = by_right * vehicle.right_radius
    left = by_left * vehicle.left_radius
    dtheta = 2 * (right - left) / vehicle.wheelbase
    ds_by_w = np.array([by_right, by_left, np.zeros(len(counts))]).T
    dtheta_by_w = np.array([2 * by_right, -2 * by_left, -dtheta]).T / vehicle.wheelbase
    return Steps(right + left, dtheta, ds_by_w, dtheta_by_w)


def dead_reckoning(ticks: np.ndarray, vehicle: Vehicle, initial_pose: np.ndarray = ORIGIN,
                   model: str = "euler") -> np.ndarray:
    """Poses (n, 3) from `initial_pose` (3,) by equation 1 or, with model "arc", by exact arcs.

    One revolution of both wheels, whose radii are 0.1 m:

    >>> from slamlib.core.vehicle import Vehicle
    >>> dead_reckoning([[0, 0], [8000, 8000]], Vehicle()).round(3)
    array([[0.   , 0.   , 0.   ],
           [0.628, 0.   , 0.   ]])
    """
    return _integrated(steps(ticks, vehicle), initial_pose, model)


def _integrated(step, initial_pose, model="euler"):
    """Poses (n, 3) by Steps from `initial_pose` (3,)."""
    heading = cumulative(step.dtheta, initial_pose[2])
    bend = _bend(model) * step.dtheta
    direction = heading[:-1] + bend
    length = step.ds * np.sinc(bend / np.pi)
    x = cumulative(length * np.cos(direction), initial_pose[0])
    y = cumulative(length * np.sin(direction), initial_pose[1])
    return np.stack([x, y, heading], axis=-1)


def equation2(ticks: np.ndarray, vehicle: Vehicle, initial_pose: np.ndarray = ORIGIN,
              initial_covariance: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 3) by equation 1 and covariances (n, 3, 3) by equation 2 and equation 3.

    With I_k, the (3, 4) sum of J_j S_wj over the steps j < k of equation 3 (not the identity), what
    equation 2 adds at step k is I_(k+1) I_(k+1)^T - I_k I_k^T. So the sum telescopes:

        C_Xk = C_X1 + I_k I_k^T.

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
        initial_covariance = _initial_covariance(vehicle)
    step = steps(ticks, vehicle)
    poses = _integrated(step, initial_pose)
    J = step_jacobian(step, poses[:-1, 2])
    by_wheel = cumulative(J[:, :, :3] * vehicle.sigma_wheel)
    variance_heading = initial_covariance[2, 2] + np.sum(by_wheel[:-1, 2]**2, axis=1)
    sigma_heading = np.sqrt(variance_heading)
    by_heading = cumulative(J[:, :, 3] * sigma_heading[:, None])
    integral = np.concatenate([by_wheel, by_heading[:, :, None]], axis=2)       # I_k of equation 3
    return poses, initial_covariance + integral @ integral.mT


def step_jacobian(step: Steps, heading: np.ndarray, model: str = "euler") -> np.ndarray:
    """Jacobians J_k of equation 2 and equation 3, (n-1, 3, 4), of Steps.

    J_k = d(X_{k+1} - X_k) / d w_k with w_k = [R_R, R_L, b, heading_k]. `heading` (n-1,) is that at
    the start of each step, in rad.
    """
    bend = _bend(model) * step.dtheta[:, None]
    bend_by_w = _bend(model) * step.dtheta_by_w
    chord = np.sinc(bend / np.pi)
    ds = step.ds[:, None]
    length = ds * chord
    length_by_w = chord * step.ds_by_w + ds * _chord_slope(bend) * bend_by_w
    direction = heading[:, None] + bend
    c = np.cos(direction)
    s = np.sin(direction)
    J = np.zeros((len(heading), 3, 4))
    J[:, 0, :3] = c * length_by_w - s * length * bend_by_w
    J[:, 1, :3] = s * length_by_w + c * length * bend_by_w
    J[:, 2, :3] = step.dtheta_by_w
    J[:, 0, 3:] = -s * length
    J[:, 1, 3:] = c * length
    return J


def wheel_jacobian(ticks: np.ndarray, vehicle: Vehicle, initial_heading: float = 0.0,
                   model: str = "euler") -> np.ndarray:
    """Derivatives (n, 3, 3) of the poses of `dead_reckoning` by [R_R, R_L, b], with pose 1 fixed.

    A wheel-parameter error is constant. It acts in every step, by the first columns of J_k, and by
    the last column through the heading, which earlier steps have turned: the derivatives
    accumulate, not the variances. `initial_heading` is in rad.
    """
    step = steps(ticks, vehicle)
    heading = cumulative(step.dtheta, initial_heading)
    heading_by_w = cumulative(step.dtheta_by_w)
    J = step_jacobian(step, heading[:-1], model)
    return cumulative(J[:, :, :3] + J[:, :, 3:] * heading_by_w[:-1, None])


def first_order(ticks: np.ndarray, vehicle: Vehicle, initial_pose: np.ndarray = ORIGIN,
                initial_covariance: np.ndarray | None = None,
                model: str = "euler") -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 3) and their exact first-order covariances (n, 3, 3).

    With G_k = d X_k / d [R_R, R_L, b] and A_k = d X_k / d X_1,

        C_Xk = A_k C_X1 A_k^T + G_k diag(sigma_RR^2, sigma_RL^2, sigma_b^2) G_k^T.

    Unlike equation 2 it contains the correlation of position and heading, because A_k and G_k
    propagate a heading error to all later positions. Shapes and defaults are those of `equation2`.
    """
    if initial_covariance is None:
        initial_covariance = _initial_covariance(vehicle)
    poses = dead_reckoning(ticks, vehicle, initial_pose, model)
    G = wheel_jacobian(ticks, vehicle, initial_pose[2], model) * vehicle.sigma_wheel
    from_first = se2.between(poses[0], poses)
    A = se2.compose_jacobians(poses[0], from_first)[0]
    return poses, A @ initial_covariance @ A.mT + G @ G.mT


def cumulative(increments: np.ndarray, initial: float = 0.0) -> np.ndarray:
    """Cumulative sums (n+1, ...) of increments (n, ...) over the first axis, after `initial`."""
    return np.cumulative_sum(increments, axis=0, include_initial=True) + initial


def _initial_covariance(vehicle):
    """Covariance (3, 3) of pose 1."""
    return np.diag([0.0, 0.0, vehicle.sigma_heading**2])


def _bend(model):
    """Angle between a step's start and its chord, as a fraction of dtheta.

    The chord of a step of unit length is sin(bend) / bend long, by both models.
    """
    if model not in MODELS:
        raise ValueError(f"model must be one of {MODELS}, not {model!r}")
    return 0.5 if model == "arc" else 0.0


def _chord_slope(bend):
    """Derivative of sin(bend) / bend, of any shape."""
    small = np.abs(bend) < 1e-4                    # the quotient cancels there: use its series
    safe = np.where(small, 1.0, bend)
    quotient = (np.cos(safe) - np.sin(safe) / safe) / safe
    return np.where(small, -bend / 3, quotient)
