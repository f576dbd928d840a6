"""Increments between poses by odometry, their noise, and how they depend on the wheels.

A wheel that travels s metres slips with variance slip^2 |s|, independently from step to step. Each
encoder rounds its cumulative count. `rounding_and_slipping` sums what the steps of an increment
contribute to its noise, `noise_in_drive` adds a skid, and `odometry_noise` what the graph needs at
rest. An increment is the pose `end` in the frame of the pose `start`; both are arrays (m,) of
indices from 0. The `ticks` (n, 2), `vehicle` and `model` are those of module `odometry`.

`OdometryIncrements` are those between the frames, the poses that are variables of the graph. An
increment Delta accumulates all encoder steps from one frame to the next. It is linear in the wheel
parameters w = [R_R, R_L, b] about the value w_0 of linearisation,

    Delta(w) = Delta(w_0) + dDelta/dw (w - w_0),

because the errors of the wheels are the same in every step (preintegration with calibration
parameters: Forster, Carlone, Dellaert and Scaramuzza, IEEE T-RO 33(1), 2017).
"""

from dataclasses import dataclass

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.records import Dataset
from slamlib.core.vehicle import Vehicle

SLIP_BOUNDS = (1e-5, 3e-2)  # sqrt(m), interval in which the slip is searched
MINIMUM_SKID = 1e-4         # sqrt(m), skid of an increment's end along either axis
MINIMUM_SIGMA = 1e-5        # m, standard deviation of an increment's end along x and y
TYPICAL_SLIP = 1e-3         # sqrt(m), median of the prior
SLIP_FACTOR = 3.0           # its logarithm is the standard deviation of the prior of log slip
LARGE_RATIO = 1.1           # of turns to those by the stated wheels, up to which noise is as stated


def between_poses(ticks: np.ndarray, vehicle: Vehicle, start: np.ndarray, end: np.ndarray,
                  model: str = "euler") -> tuple[np.ndarray, np.ndarray]:
    """Increments (m, 3) by odometry, m and rad, and derivatives (m, 3, 3) by [R_R, R_L, b]."""
    poses = odometry.dead_reckoning(ticks, vehicle, model=model)
    by_w = odometry.wheel_jacobian(ticks, vehicle, model=model)
    increment, by_start, by_end = se2.between_with_jacobians(poses[start], poses[end])
    return increment, by_start @ by_w[start] + by_end @ by_w[end]


def rounding_and_slipping(ticks: np.ndarray, vehicle: Vehicle, start: np.ndarray,
                          end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariances of increments of one drive by encoder rounding, and by a slip of 1 sqrt(m).

    Both are (m, 3, 3), of [x, y, heading] in the axes of pose `start`; no `end` may be before its
    `start`. Wheel errors e_R, e_L in the step at p lengthen the step by (e_R + e_L) / 2. They turn
    the later path by (e_R - e_L) / b, which moves its end p_e by this angle times S (p_e - p),
    S = [[0, -1], [1, 0]]. The effect of a step is linear in p_e, so one cumulative sum over the
    steps serves all increments.

    The sum is over positions relative to the beginning of a block of steps. Relative to pose 1,
    its differences would lose all digits some ten kilometres away. A block is as long as the
    longest increment, so that an increment lies in two blocks at most.
    """
    start = np.asarray(start)
    end = np.asarray(end)
    poses = odometry.dead_reckoning(ticks, vehicle, model="arc")
    length = np.max(end - start, initial=1)                       # of a block, in steps
    block = np.arange(len(poses) - 1) // length
    origin = poses[block * length]
    middle = (poses[:-1] + poses[1:]) / 2
    middle[:, :2] -= origin[:, :2]
    by_wheel = _origin_by_wheel_errors(middle, vehicle.wheelbase)
    variance = _wheel_variances(ticks, vehicle)
    noise = (by_wheel * variance) @ by_wheel.mT                   # (n-1, 2, 3, 3), at the origins
    total = odometry.cumulative(noise)

    def in_block(first):
        """Noise (m, 2, 3, 3), in world axes, by steps in the blocks that begin at `first` (m,)."""
        begin = np.clip(first, start, end)
        stop = np.clip(first + length, start, end)
        at_origin = total[stop] - total[begin]
        lever = poses[end] - poses[np.minimum(first, len(poses) - 1)]
        to_end = se2.by_left_perturbation(lever[:, None])             # I + [0, 0, S lever]
        return to_end @ at_origin @ to_end.mT

    first = start // length * length
    in_world = in_block(first) + in_block(first + length)
    in_start = se2.rotate_covariance(in_world, -poses[start, 2:])
    return in_start[:, 0], in_start[:, 1]


def _origin_by_wheel_errors(middle, wheelbase):
    """Derivatives (s, 1, 3, 2) of a pose at the origin by e_R and e_L in steps before it.

    `middle` (s, 3) are the poses in the middle of the steps.
    """
    x = middle[:, None, :1]
    y = middle[:, None, 1:2]
    heading = middle[:, None, 2:]
    turn = np.array([1, -1]) / wheelbase
    derivative = np.empty((len(middle), 1, 3, 2))
    derivative[:, :, 0] = np.cos(heading) / 2 + y * turn
    derivative[:, :, 1] = np.sin(heading) / 2 - x * turn
    derivative[:, :, 2] = turn
    return derivative


def _wheel_variances(ticks, vehicle):
    """Variances (n-1, 2, 1, 2) in m^2 of e_R and e_L, by rounding and by a slip of 1 sqrt(m).

    The rounding at a pose enters the increment before it and, with the opposite sign, the one after
    it. Over consecutive increments only the first and the last rounding remain; independent
    variances of whole differences would grow like a random walk. Each step therefore has an equal
    share of the variance of one difference over the drive, 1/6 of a squared count. This neglects
    the rounding at single poses, at most half a count.
    """
    step = odometry.steps(ticks, vehicle)
    around = vehicle.wheelbase / 2 * step.dtheta
    count = len(around)
    variance = np.empty((count, 2, 1, 2))
    variance[:, 0, 0] = vehicle.metres_per_count**2 / 6 / max(1, count)
    variance[:, 1, 0, 0] = np.abs(step.ds + around)
    variance[:, 1, 0, 1] = np.abs(step.ds - around)
    return variance


def noise_in_drive(ticks: np.ndarray, vehicle: Vehicle, start: np.ndarray,
                   end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`rounding_and_slipping` of increments of one drive, and their skid.

    A single step has hardly any lateral noise. The end of an increment therefore also has a skid of
    variance MINIMUM_SKID^2 per metre along both axes. Like the share of the rounding it is
    proportional to the steps, so the sum does not depend on the choice of the poses.

    Parameters
    ----------
    ticks : (n, 2) counts; vehicle : Vehicle; start, end : (m,) poses from 0, start <= end.

    Returns
    -------
    rounding, slipping : (m, 3, 3) covariances in the axes of the increments' starts, the skid in
        `rounding`. The noise for a slip in sqrt(m) is rounding + slip^2 slipping.
    """
    rounding, slipping = rounding_and_slipping(ticks, vehicle, start, end)
    travelled = odometry.cumulative(np.abs(odometry.steps(ticks, vehicle).ds))
    skid = MINIMUM_SKID**2 * (travelled[end] - travelled[start])
    along_both_axes = np.diag([1, 1, 0])
    return rounding + skid[:, None, None] * along_both_axes, slipping


@dataclass(frozen=True, eq=False)
class OdometryIncrements:
    """Increments between f consecutive frames, for every value of the slip."""

    frame: np.ndarray        # (f,) encoder poses from 0, ascending
    model: str               # of a step, "arc" or "euler"
    stated: np.ndarray       # (3,) m, wheel parameters as stated, to which the covariances belong
    wheel: np.ndarray        # (3,) m, those of linearisation
    increment: np.ndarray    # (f-1, 3) Delta(wheel): m, m, rad
    J_wheel: np.ndarray      # (f-1, 3, 3) dDelta/dwheel, per m
    rounding: np.ndarray     # (f-1, 3, 3) covariance without slip, in the axes of the end
    slipping: np.ndarray     # (f-1, 3, 3) covariance of slip 1 sqrt(m), in the same axes

    def covariance(self, slip: float) -> np.ndarray:
        """Q (f-1, 3, 3) for a slip in sqrt(m)."""
        return self.rounding + slip**2 * self.slipping


def preintegrate(dataset: Dataset, frame: np.ndarray, model: str = "arc",
                 wheel: np.ndarray | None = None,
                 noise: tuple[np.ndarray, np.ndarray] | None = None) -> OdometryIncrements:
    """The OdometryIncrements between frames (f,), linearised at `wheel` (3,) m, None for stated.

    `model` is "arc" or "euler". `noise` is that of `odometry_noise`, where it is known already: it
    depends on frames and stated wheels only.
    """
    stated = dataset.vehicle
    vehicle = stated if wheel is None else stated.with_wheel(wheel)
    start = frame[:-1]
    end = frame[1:]
    increment, J_wheel = between_poses(dataset.ticks, vehicle, start, end, model)
    rounding, slipping = noise or odometry_noise(dataset.ticks, stated, start, end)
    return OdometryIncrements(
        frame=frame, model=model, stated=stated.wheel, wheel=vehicle.wheel,
        increment=increment, J_wheel=J_wheel,
        rounding=se2.rotate_covariance(rounding, -increment[:, 2]),
        slipping=se2.rotate_covariance(slipping, -increment[:, 2]))


def odometry_error(increments: OdometryIncrements, poses: np.ndarray,
                   wheel: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (f-1, 3) of OdometryIncrements at poses (f, 3) of the frames and `wheel` (3,) m.

    They are s(w) log(Delta(w)^-1 X_i^-1 X_k), with s(w) of `count_scale`, not whitened. Also their
    derivatives (f-1, 3, 6) by the tangent vectors of X_i and X_k, and (f-1, 3, 3) by the wheels.
    """
    measured = increments.increment + increments.J_wheel @ (wheel - increments.wheel)
    expected = se2.between(poses[:-1], poses[1:])
    difference, by_measured, by_expected = se2.between_with_jacobians(measured, expected)
    e, J = se2.log_with_jacobian(difference)
    by_first = -J @ by_expected @ se2.by_left_perturbation(expected)
    by_second = J @ se2.compose_jacobians(difference, np.zeros(3))[1]     # X_k moves as X_k exp(xi)
    by_poses = np.concatenate([by_first, by_second], axis=2)
    by_wheel = J @ by_measured @ increments.J_wheel
    s = count_scale(increments, wheel)
    by_wheel[:, :2, :2] -= e[:, :2, None] / wheel[:2].sum()
    return s * e, s[:, None] * by_poses, s[:, None] * by_wheel


def count_scale(increments: OdometryIncrements, wheel: np.ndarray) -> np.ndarray:
    """Scale s(w) (3,) from errors of OdometryIncrements by `wheel` (3,) m to the stated wheels.

    Encoders measure counts, and Q is the noise of the counts, in metres and radians by the stated
    wheels. With the mean radius R of the wheels w, a count is a distance proportional to R. So
    errors shrink with R while Q does not, and all lengths would be estimated too small where
    nothing else gives the scale. The errors by the stated wheels do not shrink:

        s(w) = [R_stated / R, R_stated / R, 1 / `noise_scale`].
    """
    along = increments.stated[:2].mean() / wheel[:2].mean()
    return np.array([along, along, 1 / noise_scale(increments)])


def turn_ratio(increments: OdometryIncrements) -> float:
    """Turns by the wheels of linearisation over those by the stated ones: of radius / wheelbase."""
    wheel = increments.wheel
    stated = increments.stated
    return wheel[:2].sum() / stated[:2].sum() * stated[2] / wheel[2]


def noise_scale(increments: OdometryIncrements) -> float:
    """Noise of turns in OdometryIncrements over that by the stated wheels.

    It is 1 near these, because over many increments the evidence would otherwise prefer wheels by
    which the noise is smaller (`robust.factors`). Beyond LARGE_RATIO it is in proportion to turns.
    """
    ratio = turn_ratio(increments)
    return ratio / np.clip(ratio, 1 / LARGE_RATIO, LARGE_RATIO)


def odometry_noise(ticks: np.ndarray, vehicle: Vehicle, start: np.ndarray,
                   end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rounding and slipping (m, 3, 3) by `noise_in_drive`, with MINIMUM_SIGMA added.

    The graph needs the inverse of Q, but a vehicle that stands still has no lateral noise.
    """
    rounding, slipping = noise_in_drive(ticks, vehicle, start, end)
    rounding[:, [0, 1], [0, 1]] += MINIMUM_SIGMA**2
    return rounding, slipping
