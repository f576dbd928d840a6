"""Factors of the SLAM graph in numpy: errors and derivatives, all of one kind at once.

Odometry factors are all increments between graph poses.

With Delta(w) = Delta(0) + dDelta/dw w, w the wheel parameters in units of their sigmas, the error
of the factor between graph poses X and X' is

    e = log(Delta(w)^-1 X^-1 X'),

GTSAM's between factor with a measurement that depends on w. Its noise, rounding and slip, lives in
the axes of the increment's end, its derivatives in the tangent spaces X exp(xi), X' exp(xi').
"""

from dataclasses import dataclass

import numpy as np

from slamlib import odometry, se2

LEAST = 1e-5                 # m, sigma of the place of any increment's end, at least


@dataclass(frozen=True)
class Odometry:
    """Odometry factors between consecutive graph poses, for all values of slip."""

    increment: np.ndarray    # (f-1, 3) continued linearly to the nominal wheels
    by_w: np.ndarray         # (f-1, 3, 3) by w, in units of sigma
    rounding: np.ndarray     # (f-1, 3, 3) noise without slip, in the axes of the increment's end
    slipping: np.ndarray     # (f-1, 3, 3) noise of slip 1

    def whitening(self, slip):
        """U with U^T U = noise^-1, and the log determinants of the noise."""
        noise = self.rounding + slip**2 * self.slipping
        U = np.swapaxes(np.linalg.cholesky(np.linalg.inv(noise)), 1, 2)
        return U, np.linalg.slogdet(noise)[1]


def odometry_factors(ticks, vehicle, frame, model="arc", wheels="variable", about=None):
    """Odometry between the graph poses `frame` (f,), indices from 0.

    wheels : "variable", the common w; for comparison "independent", where every factor has wheel
        errors of its own as noise, or "fixed", without any wheel error.
    about : (3,) w about which the increments are linear; by default 0, the nominal wheels.
    """
    about = np.zeros(3) if about is None else about
    vehicle = vehicle_with(vehicle, about)
    start, end = frame[:-1], frame[1:]
    increment, by_w = odometry.increments(ticks, vehicle, start, end, model)
    rounding, slipping = odometry_noise(ticks, vehicle, start, end)
    by_w = by_w * vehicle.sigma_wheel
    if wheels == "independent":
        rounding = rounding + by_w @ np.swapaxes(by_w, 1, 2)
    if wheels != "variable":
        by_w = np.zeros_like(by_w)
    turn = -increment[:, 2]
    increment = increment - by_w @ about
    return Odometry(increment, by_w, se2.rotate_covariance(rounding, turn),
                    se2.rotate_covariance(slipping, turn))


def odometry_noise(ticks, vehicle, start, end):
    """Noise of increments of one drive, in the axes of their starts: of rounding, and of slip 1.

    The counts of an increment are the difference of what the encoders show at its end and at its start, so
    the rounding at a pose enters the increment before it and, with the opposite sign, the one after: over
    any number of consecutive increments only the first and the last remain. Independent noise cannot say
    that of every pair of poses; with a share by its steps in each increment it says so of the whole drive.
    What this neglects is the rounding at a single pose, at most half a count; noise of a whole difference
    in each increment would be a random walk instead, which is what slip is. A single step has no noise
    sideways; LEAST keeps the information of the graph within what sums of its squares can hold.

    Returns
    -------
    rounding, slipping : (m, 3, 3)
    """
    rounding = odometry.increment_noise(ticks, vehicle, start, end, 0.0)
    slipping = odometry.increment_noise(ticks, vehicle, start, end, 1.0) - rounding
    rounding *= ((end - start) / (len(ticks) - 1))[:, None, None]
    rounding[:, [0, 1], [0, 1]] += LEAST**2
    return rounding, slipping


def linearize(factors, poses, w):
    """Errors of the odometry factors and their derivatives in GTSAM's tangent spaces.

    Parameters
    ----------
    factors : Odometry
    poses : (f, 3) graph poses.
    w : (3,) wheel parameters in units of sigma.

    Returns
    -------
    e : (f-1, 3) errors.
    by_first, by_second, by_w : (f-1, 3, 3) derivatives by X_i, X_{i+1} and w.
    """
    Z = factors.increment + factors.by_w @ w
    e, by_first, by_second, by_Z = between_error(Z, poses[:-1], poses[1:])
    return e, by_first, by_second, by_Z @ factors.by_w


def between_error(Z, first, second):
    """log(Z^-1 X^-1 X') and its derivatives by X and X' in GTSAM's tangent spaces, and by Z.

    Z, first and second are (m, 3); the derivatives are (m, 3, 3), that by Z of its coordinates.
    """
    h = se2.between(first, second)
    miss = se2.between(Z, h)
    log_by_miss, origin = se2.log_jacobian(miss), np.zeros(3)
    _, by_second = se2.compose_jacobians(miss, origin)               # miss xi for X' xi
    h_by_first, _ = se2.compose_jacobians(origin, h)                 # xi^-1 h for X xi
    miss_by_Z, miss_by_h = se2.between_jacobians(Z, h)
    return (se2.log(miss), -log_by_miss @ miss_by_h @ h_by_first, log_by_miss @ by_second,
            log_by_miss @ miss_by_Z)


def point_error(z, pose, point):
    """R^T (point - t) - z of points z (m, 2) seen from poses X = (t, R), (m, 3).

    Returns
    -------
    e : (m, 2)
    by_pose, by_point : (m, 2, 3), (m, 2, 2) derivatives, by the pose in GTSAM's tangent space.
    """
    back = se2.rotation(-pose[:, 2])
    seen = (back @ (point - pose[:, :2])[..., None])[..., 0]
    by_pose = np.zeros((len(z), 2, 3))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = -1
    by_pose[:, 0, 2], by_pose[:, 1, 2] = seen[:, 1], -seen[:, 0]
    return seen - z, by_pose, back


def range_error(r, pose, antenna):
    """|antenna - t| - r of ranges r (m,) from poses (m, 3) to antennas (m, 2).

    Returns
    -------
    e : (m,)
    by_pose, by_antenna : (m, 1, 3), (m, 1, 2) derivatives, by the pose in GTSAM's tangent space.
    """
    apart = antenna - pose[:, :2]
    distance = np.hypot(*apart.T)
    along = apart[:, None, :] / np.maximum(distance, 1e-9)[:, None, None]
    by_pose = np.concatenate([-along @ se2.rotation(pose[:, 2]), np.zeros((len(r), 1, 1))], axis=2)
    return distance - r, by_pose, along


def vehicle_with(vehicle, w):
    """The vehicle with the wheel parameters w, in units of their sigmas beyond the nominal ones."""
    return vehicle.with_wheel(vehicle.wheel + vehicle.sigma_wheel * w)
