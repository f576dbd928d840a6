"""Stage 2: the odometry factors between consecutive frames, which depend on the wheel errors w.

With the increment Delta(w) = Delta(0) + dDelta/dw w between the frames X and X' the error is

    e = log(Delta(w)^-1 X^-1 X'),

that of GTSAM's between factor, except that the measurement depends on w. The noise of Delta, with
covariance Q, is the quantization of the encoders and wheel slip, in the axes of the increment's
end. All derivatives by w are per standard deviation of a wheel parameter; those of
`increments.between_poses` are per metre.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import increments, se2
from slamlib.slam.errors import between_error, square_root_information

MINIMUM_SIGMA = 1e-5         # m, standard deviation of an increment's end along x and y


@dataclass(frozen=True)
class OdometryFactors:
    """Odometry factors between consecutive frames, for every value of the slip."""

    model: str               # of a step, "arc" or "euler"
    increment: np.ndarray    # (f-1, 3) Delta(0), extrapolated linearly: m, m, rad
    J_w: np.ndarray          # (f-1, 3, 3) dDelta/dw, per sigma of each wheel parameter
    quantization: np.ndarray  # (f-1, 3, 3) covariance without slip, in the axes of the end
    slipping: np.ndarray     # (f-1, 3, 3) covariance of slip 1 sqrt(m), in the same axes

    def covariance(self, slip):
        """Covariances Q (f-1, 3, 3) for a slip in sqrt(m)."""
        return self.quantization + slip**2 * self.slipping

    def whitening(self, slip):
        """Square root information U (f-1, 3, 3), U^T U = Q^-1, and sum log|Q|, for a slip."""
        U = square_root_information(self.covariance(slip))
        return U, -2 * float(np.sum(np.log(np.diagonal(U, axis1=1, axis2=2))))


def preintegrate_odometry(measurements, model, relinearize_at=(0.0, 0.0, 0.0)):
    """The OdometryFactors of Measurements, linearised at w = `relinearize_at` (3,).

    `model` is "arc" or "euler". dDelta/dw accumulates over the encoder steps between two frames
    (preintegration with calibration parameters: Forster et al., IEEE T-RO 33(1), 2017).
    """
    dataset, start, end = measurements.dataset, measurements.frame[:-1], measurements.frame[1:]
    vehicle = dataset.vehicle.with_deviation(np.asarray(relinearize_at))
    increment, by_wheel = increments.between_poses(dataset.ticks, vehicle, start, end, model)
    quantization, slipping = odometry_noise(dataset.ticks, vehicle, start, end)
    by_w, turn = by_wheel * vehicle.sigma_wheel, -increment[:, 2]
    return OdometryFactors(
        model=model, increment=increment - by_w @ relinearize_at, J_w=by_w,
        quantization=se2.rotate_covariance(quantization, turn),
        slipping=se2.rotate_covariance(slipping, turn))


def odometry_noise(ticks, vehicle, start, end, steps=None):
    """Quantization and slipping (m, 3, 3) by `increments.noise_in_drive`, made regular.

    A vehicle that stands still has no lateral noise, but the graph needs the inverse of
    Q: MINIMUM_SIGMA is added. Axes are those of the increments' starts, lengths in m.
    """
    quantization, slipping = increments.noise_in_drive(ticks, vehicle, start, end, steps)
    quantization[:, [0, 1], [0, 1]] += MINIMUM_SIGMA**2
    return quantization, slipping


def odometry_error(factors, poses, w):
    """Errors (f-1, 3) of OdometryFactors, and their derivatives (f-1, 3, 9) by X_i, X_{i+1} and w.

    At poses (f, 3) of the frames and w (3,). The errors are not whitened.
    """
    increment = factors.increment + factors.J_w @ w
    e, by_first, by_second, by_increment = between_error(increment, poses[:-1], poses[1:])
    return e, np.concatenate([by_first, by_second, by_increment @ factors.J_w], axis=2)
