"""Odometry factors of the SLAM graph: all increments between graph poses at once, in numpy.

With Delta(w) = Delta(0) + dDelta/dw w, w the wheel parameters in units of their sigmas, the error
of the factor between graph poses X and X' is

    e = log(Delta(w)^-1 X^-1 X'),

GTSAM's between factor with a measurement that depends on w. Its noise, rounding and slip, lives in
the axes of the increment's end, its derivatives in the tangent spaces X exp(xi), X' exp(xi').
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib import odometry, se2
from slamlib.odometry import wheel_sigmas


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
    rounding = odometry.increment_noise(ticks, vehicle, start, end, 0.0)
    slipping = odometry.increment_noise(ticks, vehicle, start, end, 1.0) - rounding
    rounding[:, [0, 1], [0, 1]] += least_noise(vehicle)
    by_w = by_w * wheel_sigmas(vehicle)
    if wheels == "independent":
        rounding = rounding + by_w @ np.swapaxes(by_w, 1, 2)
    if wheels != "variable":
        by_w = np.zeros_like(by_w)
    turn = -increment[:, 2]
    increment = increment - by_w @ about
    return Odometry(increment, by_w, se2.rotate_covariance(rounding, turn),
                    se2.rotate_covariance(slipping, turn))


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


def vehicle_with(vehicle, w):
    """The vehicle with the wheel parameters w, in units of their sigmas beyond the nominal ones."""
    right, left, base = wheel_sigmas(vehicle) * w
    return replace(vehicle, right_radius=vehicle.right_radius + right,
                   left_radius=vehicle.left_radius + left, wheelbase=vehicle.wheelbase + base)


def least_noise(vehicle):
    """m^2, sideways noise of an increment: that of rounding, where a single step has none else."""
    return (2 * np.pi * vehicle.right_radius / vehicle.ticks_per_revolution)**2 / 6
