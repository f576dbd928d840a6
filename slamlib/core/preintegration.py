"""Odometry between the poses that are variables of the graph, as it depends on the wheels.

The increment Delta from one frame to the next accumulates all encoder steps between them. It is
linear in the wheel parameters w = [R_R, R_L, b] about the value w_0 of linearisation,

    Delta(w) = Delta(w_0) + dDelta/dw (w - w_0),

because the errors of the wheels are the same in every step (preintegration with calibration
parameters: Forster, Carlone, Dellaert and Scaramuzza, IEEE T-RO 33(1), 2017).
"""

from dataclasses import dataclass

import numpy as np

from slamlib.core import increments, se2
from slamlib.core.records import Dataset
from slamlib.core.vehicle import Vehicle

MINIMUM_SIGMA = 1e-5         # m, standard deviation of an increment's end along x and y


@dataclass(frozen=True, eq=False)
class OdometryIncrements:
    """Increments between f consecutive frames, for every value of the slip."""

    frame: np.ndarray        # (f,) encoder poses from 0, ascending
    model: str               # of a step, "arc" or "euler"
    stated: np.ndarray       # (3,) m, wheel parameters as stated, to which the covariances belong
    wheel: np.ndarray        # (3,) m, those of linearisation
    increment: np.ndarray    # (f-1, 3) Delta(wheel): m, m, rad
    J_wheel: np.ndarray      # (f-1, 3, 3) dDelta/dwheel, per m
    quantization: np.ndarray     # (f-1, 3, 3) covariance without slip, in the axes of the end
    slipping: np.ndarray     # (f-1, 3, 3) covariance of slip 1 sqrt(m), in the same axes
    in_counts: bool = True   # whether `odometry_error` scales them; the engine may set False

    def covariance(self, slip: float) -> np.ndarray:
        """Q (f-1, 3, 3) for a slip in sqrt(m)."""
        return self.quantization + slip**2 * self.slipping


def preintegrate(dataset: Dataset, frame: np.ndarray, model: str = "arc",
                 wheel: np.ndarray | None = None,
                 noise: tuple[np.ndarray, np.ndarray] | None = None) -> OdometryIncrements:
    """The OdometryIncrements between frames (f,), linearised at `wheel` (3,) m, None if stated.

    `model` is "arc" or "euler". `noise` is that of `odometry_noise`, where it is known already: it
    depends on frames and stated wheels only.
    """
    stated = dataset.vehicle
    vehicle = stated if wheel is None else stated.with_wheel(wheel)
    start = frame[:-1]
    end = frame[1:]
    increment, J_wheel = increments.between_poses(dataset.ticks, vehicle, start, end, model)
    quantization, slipping = noise or odometry_noise(dataset.ticks, stated, start, end)
    return OdometryIncrements(
        frame=frame, model=model, stated=stated.wheel, wheel=vehicle.wheel,
        increment=increment, J_wheel=J_wheel,
        quantization=se2.rotate_covariance(quantization, -increment[:, 2]),
        slipping=se2.rotate_covariance(slipping, -increment[:, 2]))


def odometry_error(increments: OdometryIncrements, poses: np.ndarray,
                   wheel: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (f-1, 3) of OdometryIncrements at poses (f, 3) of the frames and `wheel` (3,) m.

    They are s(w) log(Delta(w)^-1 X_i^-1 X_k), not whitened. Also their derivatives (f-1, 3, 6) by
    the tangent vectors of X_i and X_k, and (f-1, 3, 3) by the wheels.

    With `in_counts` the errors are scaled to the stated wheels. Encoders measure counts, and Q is
    the noise of the counts, in metres and radians by the stated wheels. With the mean radius R and
    the wheelbase b of the wheels w, a count is a distance proportional to R and a turn proportional
    to R / b. So the errors shrink with R while Q does not, and all lengths would be estimated too
    small where nothing else gives the scale. The errors by the stated wheels do not shrink:

        s(w) = R_stated / R [1, 1, b / b_stated].
    """
    measured = increments.increment + increments.J_wheel @ (wheel - increments.wheel)
    expected = se2.between(poses[:-1], poses[1:])
    difference = se2.between(measured, expected)
    by_measured, by_expected = se2.between_jacobians(measured, expected)
    e = se2.log(difference)
    J = se2.log_jacobian(difference)
    by_first = -J @ by_expected @ se2.moved_by(expected)
    by_second = J @ se2.compose_jacobians(difference, np.zeros(3))[1]
    by_poses = np.concatenate([by_first, by_second], axis=2)
    by_wheel = J @ by_measured @ increments.J_wheel
    if not increments.in_counts:
        return e, by_poses, by_wheel
    radius = wheel[:2].mean()
    wheelbase = wheel[2]
    stated = increments.stated
    s = stated[:2].mean() / radius * np.array([1, 1, wheelbase / stated[2]])
    by_wheel[:, :, :2] -= e[:, :, None] / (2 * radius)
    by_wheel[:, 2, 2] += e[:, 2] / wheelbase
    return s * e, s[:, None] * by_poses, s[:, None] * by_wheel


def odometry_noise(ticks: np.ndarray, vehicle: Vehicle, start: np.ndarray,
                   end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantization and slipping (m, 3, 3) by `increments.noise_in_drive`, with MINIMUM_SIGMA added.

    The graph needs the inverse of Q, but a vehicle that stands still has no lateral noise.
    """
    quantization, slipping = increments.noise_in_drive(ticks, vehicle, start, end)
    quantization[:, [0, 1], [0, 1]] += MINIMUM_SIGMA**2
    return quantization, slipping
