"""Increments by odometry and their noise."""

import numpy as np
from numeric import central_differences
from test_odometry import BOTH, curvy_ticks

from slamlib import increments, odometry, se2
from slamlib.dataset import Vehicle
from slamlib.simulation import simulate

VEHICLE = Vehicle()

@BOTH
def test_increments_between_any_two_poses(model):
    ticks = curvy_ticks()
    start, end = np.array([0, 10, 35, 299, 120, 7]), np.array([299, 11, 190, 0, 120, 90])
    increment, by_w = increments.between_poses(ticks, VEHICLE, start, end, model)
    poses = odometry.dead_reckoning(ticks, VEHICLE, (2.0, 1.0, -0.7), model)
    np.testing.assert_allclose(se2.compose(poses[start], increment), poses[end], atol=1e-12)
    numeric = central_differences(
        lambda w: increments.between_poses(ticks, VEHICLE.with_wheel(w), start, end, model)[0],
        VEHICLE.wheel, step=1e-7)
    np.testing.assert_allclose(by_w, numeric, atol=1e-6 * np.abs(numeric).max())
    # An increment depends on its own counts only.
    alone, alone_by_w = increments.between_poses(ticks[9:12], VEHICLE, [1], [2], model)
    np.testing.assert_allclose(increment[1], alone[0], atol=1e-13)
    np.testing.assert_allclose(by_w[1], alone_by_w[0], atol=1e-11)


def literal_noise(ticks, vehicle, start, end, slip):
    """Sum over the steps of the wheel errors' effects at the end of one increment."""
    ds, dtheta, _, _ = odometry.steps(ticks, vehicle)
    half = vehicle.wheelbase / 2
    poses = odometry.dead_reckoning(ticks, vehicle, model="arc")
    total = np.zeros((3, 3))
    for k in range(start, end):
        travel = np.array([ds[k] + half * dtheta[k], ds[k] - half * dtheta[k]])
        count = 2 * np.pi * vehicle.wheel[:2] / vehicle.ticks_per_revolution
        variance = slip**2 * np.abs(travel) + count**2 / 6 / (end - start)
        direction = poses[k, 2] + dtheta[k] / 2
        lever = poses[end, :2] - (poses[k, :2] + poses[k + 1, :2]) / 2
        for sign, v in zip((1, -1), variance, strict=True):
            turn = sign / (2 * half)
            effect = np.array([np.cos(direction) / 2 - lever[1] * turn,
                               np.sin(direction) / 2 + lever[0] * turn, turn])
            total += v * np.outer(effect, effect)
    return se2.rotate_covariance(total, -poses[start, 2])


def noise_alone(ticks, vehicle, start, end, slip):
    rounding, slipping = increments.rounding_and_slipping(ticks, vehicle, start, end)
    return rounding + slip**2 * slipping


def test_noise_is_the_sum_over_steps():
    ticks = simulate("short", seed=3)[0].ticks
    start, end = np.array([0, 100, 37, 1500]), np.array([10, 400, 38, 1999])
    got = noise_alone(ticks, VEHICLE, start, end, 2e-3)
    for s, e, noise in zip(start, end, got, strict=True):
        expected = literal_noise(ticks, VEHICLE, s, e, 2e-3)
        np.testing.assert_allclose(noise, expected, atol=1e-9 * np.abs(expected).max())


def test_noise_keeps_its_digits_far_from_the_origin():
    """Steps of 157 m: the last one, 300 km away, has the noise of the first."""
    ticks, vehicle = np.full((2001, 2), 80_000), Vehicle(right_radius=2.5, left_radius=2.5)
    for part in increments.rounding_and_slipping(ticks, vehicle, [0, 1999], [1, 2000]):
        np.testing.assert_allclose(part[1], part[0], rtol=1e-9, atol=1e-9 * part[0, 2, 2])


def test_noise_in_drive_does_not_depend_on_how_the_drive_is_cut():
    """A straight drive: the rounding of one difference of counts, the skid and the slip."""
    ticks = np.full((2001, 2), 127)
    whole = noise_alone(ticks, VEHICLE, [0], [2000], 0.0)[0]
    travelled = np.sum(odometry.steps(ticks, VEHICLE)[0])
    for every in (1, 10, 500, 2000):
        pose = np.arange(0, 2001, every)
        rounding, slipping = increments.noise_in_drive(ticks, VEHICLE, pose[:-1], pose[1:])
        expected = np.diag(whole)[[0, 2]] + [increments.MINIMUM_SLIP**2 * travelled, 0.0]
        np.testing.assert_allclose(np.diag(rounding.sum(axis=0))[[0, 2]], expected, rtol=1e-6)
        if every == 1:                                        # no lever arm: the skid alone
            skid = expected[0] - whole[0, 0]
            np.testing.assert_allclose(rounding[:, 1, 1].sum(), skid, rtol=1e-4)
            np.testing.assert_allclose(rounding[:, 0, 1], 0, atol=1e-6 * rounding[0, 1, 1])
        by_slip = travelled * np.array([1 / 2, 2 / VEHICLE.wheelbase**2])
        np.testing.assert_allclose(np.diag(slipping.sum(axis=0))[[0, 2]], by_slip, rtol=1e-6)
    one, _ = increments.noise_in_drive(ticks[:2], VEHICLE, [0], [1])             # a single step
    difference = one[0] - noise_alone(ticks[:2], VEHICLE, [0], [1], 0.0)[0]
    skid = increments.MINIMUM_SLIP**2 * travelled / 2000
    np.testing.assert_allclose(difference, np.diag([skid, skid, 0.0]), rtol=1e-9, atol=1e-20)
    for part in increments.noise_in_drive(ticks, VEHICLE, [0, 700], [0, 700]):
        np.testing.assert_array_equal(part, 0)
    for part in increments.noise_in_drive(ticks[:1], VEHICLE, [0], [0]):    # a single pose
        np.testing.assert_array_equal(part, 0)
