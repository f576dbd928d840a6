"""Stage 2: the odometry factors between consecutive frames, which depend on the wheel parameters.

Let w be the errors of [R_R, R_L, b] in units of their standard deviations, and
Delta(w) = Delta(0) + dDelta/dw w the increment between the frames X and X'. The factor's error is

    e = log(Delta(w)^-1 X^-1 X'),

that of GTSAM's between factor, except that the measurement depends on w. The noise of Delta is
encoder rounding and wheel slip, in the axes of the increment's end.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import increments, odometry, se2
from slamlib.slam.errors import between_error

MINIMUM_SIGMA = 1e-5         # m, of an increment's end, for a vehicle that stands still
MINIMUM_SLIP = 1e-4          # sqrt(m), of an increment's end in any direction: wheels also skid


@dataclass(frozen=True)
class OdometryFactors:
    """Odometry factors between consecutive frames, for every value of the slip."""

    model: str               # of a step, "arc" or "euler"
    increment: np.ndarray    # (f-1, 3) Delta(0), extrapolated linearly: m, m, rad
    by_w: np.ndarray         # (f-1, 3, 3) dDelta/dw
    rounding: np.ndarray     # (f-1, 3, 3) noise without slip, in the axes of the increment's end
    slipping: np.ndarray     # (f-1, 3, 3) noise of slip 1 sqrt(m)

    def noise(self, slip):
        """Covariances (f-1, 3, 3) for a slip in sqrt(m)."""
        return self.rounding + slip**2 * self.slipping


def odometry_factors(measurements, model, relinearize_at=(0.0, 0.0, 0.0)):
    """The OdometryFactors between the frames, linear in w about `relinearize_at` (3,).

    `model` is "arc" or "euler". dDelta/dw accumulates over the encoder steps between two frames
    (preintegration with calibration parameters: Forster et al., IEEE T-RO 33(1), 2017).
    """
    relinearize_at, dataset = np.asarray(relinearize_at), measurements.dataset
    vehicle = dataset.vehicle.with_deviation(relinearize_at)
    start, end = measurements.frame[:-1], measurements.frame[1:]
    increment, by_w = increments.between_poses(dataset.ticks, vehicle, start, end, model)
    rounding, slipping = odometry_noise(dataset.ticks, vehicle, start, end)
    by_w = by_w * vehicle.sigma_wheel
    turn = -increment[:, 2]
    return OdometryFactors(
        model=model, increment=increment - by_w @ relinearize_at, by_w=by_w,
        rounding=se2.rotate_covariance(rounding, turn),
        slipping=se2.rotate_covariance(slipping, turn))


def odometry_noise(ticks, vehicle, start, end):
    """Noise of increments of one drive by encoder rounding, and by slip of 1 sqrt(m).

    The counts of an increment are a difference of what the encoder shows at its end and at its
    start. The rounding at a pose enters the increment before it and, with the opposite sign, the
    one after it, so over consecutive increments only the first and the last rounding remain.
    Giving each increment the variance of a whole difference, independently, would let it grow like
    a random walk. Each increment therefore has a share, by its number of steps, of the variance of
    one difference over the drive. This neglects the rounding at single poses, at most half a count.

    A single step has no lateral noise, and without slip hardly any. A minimum that grows with the
    distance, so that it does not depend on how a drive is cut, keeps the graph well conditioned.

    Parameters
    ----------
    ticks : (n, 2) counts; vehicle : Vehicle; start, end : (m,) poses from 0, start < end.

    Returns
    -------
    rounding, slipping : (m, 3, 3) covariances in the axes of the increments' starts.
    """
    rounding = increments.noise(ticks, vehicle, start, end, 0.0)
    slipping = increments.noise(ticks, vehicle, start, end, 1.0) - rounding
    rounding *= ((end - start) / (len(ticks) - 1))[:, None, None]
    travelled = odometry.cumulative(np.abs(odometry.steps(ticks, vehicle)[0]))
    minimum = MINIMUM_SIGMA**2 + MINIMUM_SLIP**2 * (travelled[end] - travelled[start])
    rounding[:, [0, 1], [0, 1]] += minimum[:, None]
    return rounding, slipping


def odometry_error(factors, poses, w):
    """Errors of the odometry factors and their derivatives.

    From OdometryFactors, poses (f, 3) of the frames and w (3,): errors (f-1, 3), and derivatives
    (f-1, 3, 3) by X_i, X_{i+1} and w.
    """
    Z = factors.increment + factors.by_w @ w
    e, by_first, by_second, by_Z = between_error(Z, poses[:-1], poses[1:])
    return e, by_first, by_second, by_Z @ factors.by_w
