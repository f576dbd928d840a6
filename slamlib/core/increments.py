"""Increments between any two poses by odometry, their noise, and the prior of the wheel slip.

A wheel that travels s metres slips with variance slip^2 |s|, independently from step to step. Each
encoder rounds its cumulative count. `rounding_and_slipping` is for single increments,
`noise_in_drive` for increments of one drive that are used together. An increment is the pose `end`
in the frame of the pose `start`; both are arrays (m,) of indices from 0. The `ticks` (n, 2),
`vehicle` and `model` are those of module `odometry`.
"""

import numpy as np

from slamlib.core import odometry, se2

SLIP_BOUNDS = (1e-5, 3e-2)  # sqrt(m), interval in which the slip is searched
MINIMUM_SLIP = 1e-4         # sqrt(m), skid of an increment's end along either axis
TYPICAL_SLIP = 1e-3         # sqrt(m), median of the prior
SLIP_FACTOR = 3.0           # its logarithm is the standard deviation of the prior of log slip


def between_poses(ticks, vehicle, start, end, model="euler"):
    """Increments (m, 3) by odometry, m and rad, and derivatives (m, 3, 3) by [R_R, R_L, b]."""
    poses = odometry.dead_reckoning(ticks, vehicle, model=model)
    by_w = odometry.wheel_jacobian(ticks, vehicle, model=model)
    by_start, by_end = se2.between_jacobians(poses[start], poses[end])
    return (se2.between(poses[start], poses[end]),
            by_start @ by_w[start] + by_end @ by_w[end])


def rounding_and_slipping(ticks, vehicle, start, end):
    """Covariances of single increments by encoder rounding, and by a slip of 1 sqrt(m).

    Both are (m, 3, 3), of [x, y, heading] in the axes of pose `start`; no `end` may be before its
    `start`. Rounding at both ends of an increment has a variance of one sixth of a squared count,
    spread over its steps. Wheel errors e_R, e_L in the step at p along the unit vector u lengthen
    the step by (e_R + e_L) / 2. They turn the later path by (e_R - e_L) / b, which moves its end
    p_e by this angle times S (p_e - p), S = [[0, -1], [1, 0]]. The effect of a step is linear in
    p_e, so one cumulative sum over the steps serves all increments.

    The sum is over positions relative to the beginning of a block of steps. Relative to pose 1,
    its differences would lose all digits some ten kilometres away. A block is as long as the
    longest increment, so that an increment lies in two blocks at most.
    """
    poses = odometry.dead_reckoning(ticks, vehicle, model="arc")
    ds, dtheta, _, _ = (each[..., None] for each in odometry.steps(ticks, vehicle))
    direction = poses[:-1, 2:] + dtheta / 2
    start, end = np.asarray(start), np.asarray(end)
    length = np.max(end - start, initial=1)
    origin = poses[:max(1, len(ds)):length]
    middle = (poses[:-1] + poses[1:]) / 2 - origin[np.arange(len(ds)) // length]
    sides = vehicle.wheelbase / np.array([2, -2])
    turn = 1 / (2 * sides)                                             # by e_R, by e_L
    by_wheel = np.stack([
        np.cos(direction) / 2 + middle[:, 1:2] * turn, np.sin(direction) / 2 - middle[:, :1] * turn,
        np.broadcast_to(turn, (len(ds), 2))], 1)[:, None]        # d(end - S p_e turn, turn)/de
    metres_per_count = 2 * np.pi * vehicle.wheel[:2] / vehicle.ticks_per_revolution
    slipped = np.abs(ds + sides * dtheta)
    variance = np.stack([np.broadcast_to(metres_per_count**2 / 6, slipped.shape), slipped], 1)
    total = odometry.cumulative((by_wheel * variance[:, :, None]) @ by_wheel.mT)
    in_world = np.zeros((len(start), 2, 3, 3))
    for block in (start // length, start // length + 1):
        begins, ends = (np.clip(edge * length, start, end) for edge in (block, block + 1))
        lever = poses[end] - [1, 1, 0] * origin[np.minimum(block, len(origin) - 1)]
        to_end, _ = se2.compose_jacobians(np.zeros(3), lever[:, None])      # I + [0, 0, S lever]
        in_world += to_end @ (total[ends] - total[begins]) @ to_end.mT
    in_world[:, 0] /= np.maximum(end - start, 1)[:, None, None]
    return tuple(np.moveaxis(se2.rotate_covariance(in_world, -poses[start, 2:]), 1, 0))


def noise_in_drive(ticks, vehicle, start, end):
    """Noise of increments of one drive by encoder rounding, and by a slip of 1 sqrt(m).

    The rounding at a pose enters the increment before it and, with the opposite sign, the one after
    it. Over consecutive increments only the first and the last rounding remain; independent
    variances of whole differences would grow like a random walk. Each increment therefore has a
    share, by its number of steps, of the variance of one difference of counts over the drive. This
    neglects the rounding at single poses, at most half a count.

    A single step has hardly any lateral noise. The end of an increment therefore also has a skid of
    variance MINIMUM_SLIP^2 per metre along both axes. Shares and skid are proportional to the
    steps, so their sum does not depend on the choice of the poses.

    Parameters
    ----------
    ticks : (n, 2) counts; vehicle : Vehicle; start, end : (m,) poses from 0, start <= end.

    Returns
    -------
    rounding, slipping : (m, 3, 3) covariances in the axes of the increments' starts, the skid in
        `rounding`. The noise for a slip in sqrt(m) is rounding + slip^2 slipping.
    """
    start, end = np.asarray(start), np.asarray(end)
    rounding, slipping = rounding_and_slipping(ticks, vehicle, start, end)
    rounding *= ((end - start) / max(1, len(ticks) - 1))[:, None, None]
    travelled = odometry.cumulative(np.abs(odometry.steps(ticks, vehicle)[0]))
    skid = MINIMUM_SLIP**2 * (travelled[end] - travelled[start])
    rounding[:, [0, 1], [0, 1]] += skid[:, None]
    return rounding, slipping
