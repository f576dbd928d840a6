"""Problem 1: odometry, its covariances, and increments between poses with their noise."""

import numpy as np
import pytest
from numeric import central_differences
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import block_diag

from slamlib.core import increments, odometry, se2
from slamlib.core.vehicle import Vehicle
from slamlib.studies.simulation import simulate

VEHICLE = Vehicle()
BOTH = pytest.mark.parametrize("model", odometry.MODELS)


def curvy_ticks():
    """Counts of a drive with bends, a stop, a turn on the spot and a stretch in reverse."""
    rng = np.random.default_rng(3)
    ticks = rng.integers(60, 180, (300, 2))
    ticks[0] = 0
    ticks[40:50] = 0
    ticks[80:100] = [70, -70]
    ticks[150:170] *= -1
    ticks[200:220, 1] = ticks[200:220, 0]                              # exactly straight
    return ticks


def literal_recursion(ticks, vehicle, X, C):
    """Equations 1, 2 and 3 as the assignment prints them."""
    RR, RL, b = vehicle.wheel
    I = np.zeros((3, 4))
    poses, covariances = [X], [C]
    for right, left in np.pi * ticks[1:] / vehicle.ticks_per_revolution:
        ds = right * RR + left * RL
        turn = 2 * (right * RR - left * RL) / b
        cos, sin = np.cos(X[2]), np.sin(X[2])
        J = np.array([[right * cos, left * cos, 0, -ds * sin],
                      [right * sin, left * sin, 0, ds * cos],
                      [2 * right / b, -2 * left / b, -turn / b, 0]])
        JS = J * [*vehicle.sigma_wheel, np.sqrt(C[2, 2])]
        C = C + JS @ JS.T + JS @ I.T + I @ JS.T
        I = I + JS
        X = X + np.array([ds * cos, ds * sin, turn])
        poses.append(X)
        covariances.append(C)
    return np.array(poses), np.array(covariances)


def relative_difference(a, b):
    """Largest difference of covariances, each element relative to its two largest sigmas so far.

    When the path closes, the covariance shrinks, but the sums keep the rounding errors of the large
    numbers before, in the recursion most of all.
    """
    sigma = np.maximum.accumulate(np.sqrt(np.diagonal(b, axis1=1, axis2=2)), axis=0)
    scale = sigma[:, :, None] * sigma[:, None, :]
    return np.max(np.abs(a - b)[scale > 0] / scale[scale > 0])


ELSEWHERE = np.array([3.0, -1.0, 2.5]), np.array(
    [[4e-4, 1e-4, 2e-4], [1e-4, 9e-4, -1e-4], [2e-4, -1e-4, 1e-2]])


@pytest.mark.parametrize("ticks, start", [
    (simulate("short", seed=5)[0].ticks, ()), (simulate("long", seed=5)[0].ticks, ()),
    (curvy_ticks(), ELSEWHERE)])
def test_closed_form_is_the_literal_recursion(ticks, start):
    poses, covariances = odometry.equation2(ticks, VEHICLE, *start)
    X, C = start or (np.zeros(3), np.diag([0, 0, VEHICLE.sigma_heading**2]))
    expected_poses, expected = literal_recursion(ticks, VEHICLE, X, C)
    assert_allclose(poses, expected_poses, rtol=1e-12, atol=1e-11)
    assert relative_difference(covariances, expected) < 1e-12
    assert_array_equal(covariances[0], C)


def test_an_arc_by_hand():
    """8000 counts right, 4000 left: ds = pi (0.1 + 0.05), dtheta = 2 pi (0.1 - 0.05) / 0.4.

    They describe a circle of radius ds / dtheta = 0.6 through 45 degrees.
    """
    poses = odometry.dead_reckoning([[0, 0], [8000, 4000]], VEHICLE, (1.0, 2.0, np.pi / 2), "arc")
    angle = np.pi / 4
    end = [1 - 0.6 * (1 - np.cos(angle)), 2 + 0.6 * np.sin(angle), np.pi / 2 + angle]
    assert_allclose(poses, [[1, 2, np.pi / 2], end], atol=1e-15)


@BOTH
@pytest.mark.parametrize("more", [0, 1, 3, 400])
def test_wheel_jacobian_of_nearly_straight_steps(model, more):
    """On both sides of the switch to the chord's series."""
    ticks = [[0, 0], [100 + more, 100], [100, 100 + more]]
    numeric = central_differences(
        lambda w: odometry.dead_reckoning(ticks, VEHICLE.with_wheel(w), (0, 0, 0.4), model),
        VEHICLE.wheel)
    assert_allclose(odometry.wheel_jacobian(ticks, VEHICLE, 0.4, model), numeric, atol=1e-9)


@BOTH
def test_first_order_is_the_propagation_by_numerical_derivatives(model):
    """By start and wheels, on the whole path."""
    ticks = curvy_ticks()
    start, C = ELSEWHERE
    poses, covariances = odometry.first_order(ticks, VEHICLE, start, C, model)

    def path(x):
        return odometry.dead_reckoning(ticks, VEHICLE.with_wheel(x[3:]), x[:3], model)

    J = central_differences(path, np.append(start, VEHICLE.wheel), step=1e-7)
    expected = J @ block_diag(C, np.diag(VEHICLE.sigma_wheel**2)) @ J.mT
    assert_allclose(covariances, expected, atol=1e-6 * expected.max())
    assert_array_equal(poses, path(np.append(start, VEHICLE.wheel)))


def test_unknown_model_is_refused():
    with pytest.raises(ValueError, match="euler.*arc.*'midpoint'"):
        odometry.dead_reckoning(curvy_ticks(), VEHICLE, model="midpoint")


# Increments between any two poses, and their noise.


@BOTH
def test_increments_between_any_two_poses(model):
    ticks = curvy_ticks()
    start = np.array([0, 10, 35, 299, 120, 7])
    end = np.array([299, 11, 190, 0, 120, 90])
    increment, by_w = increments.between_poses(ticks, VEHICLE, start, end, model)
    poses = odometry.dead_reckoning(ticks, VEHICLE, (2.0, 1.0, -0.7), model)
    assert_allclose(se2.compose(poses[start], increment), poses[end], atol=1e-12)
    numeric = central_differences(
        lambda w: increments.between_poses(ticks, VEHICLE.with_wheel(w), start, end, model)[0],
        VEHICLE.wheel, step=1e-7)
    assert_allclose(by_w, numeric, atol=1e-6 * np.abs(numeric).max())


def literal_noise(ticks, vehicle, start, end, slip):
    """Sum over the steps of the wheel errors' effects at the end of one increment, and the skid."""
    count = 2 * np.pi * vehicle.wheel[:2] / vehicle.ticks_per_revolution
    poses = odometry.dead_reckoning(ticks, vehicle, model="arc")
    total = np.zeros((3, 3))
    for k in range(start, end):
        middle = (poses[k] + poses[k + 1]) / 2
        lever = poses[end] - middle
        travelled = count * ticks[k + 1]
        variance = slip**2 * np.abs(travelled) + count**2 / 6 / (len(ticks) - 1)
        for turn, v in zip(np.array([1, -1]) / vehicle.wheelbase, variance):
            effect = np.array([np.cos(middle[2]) / 2 - lever[1] * turn,
                               np.sin(middle[2]) / 2 + lever[0] * turn, turn])
            total += v * np.outer(effect, effect)
        total += increments.MINIMUM_SKID**2 * np.abs(travelled.mean()) * np.diag([1, 1, 0])
    return se2.rotate_covariance(total, -poses[start, 2])


def test_noise_is_the_sum_over_steps():
    ticks = simulate("short", seed=3)[0].ticks
    pairs = [(0, 10), (100, 400), (37, 38), (1500, 1999)]
    rounding, slipping = increments.noise_in_drive(ticks, VEHICLE, *np.transpose(pairs))
    for (s, e), noise in zip(pairs, rounding + 2e-3**2 * slipping, strict=True):
        expected = literal_noise(ticks, VEHICLE, s, e, 2e-3)
        assert_allclose(noise, expected, atol=1e-9 * np.abs(expected).max())


def test_noise_keeps_its_digits_far_from_the_origin():
    """Steps of 157 m: the last one, 300 km away, has the noise of the first."""
    ticks, vehicle = np.full((2001, 2), 80_000), Vehicle(right_radius=2.5, left_radius=2.5)
    for part in increments.rounding_and_slipping(ticks, vehicle, [0, 1999], [1, 2000]):
        assert_allclose(part[1], part[0], rtol=1e-9, atol=1e-9 * part[0, 2, 2])


@pytest.mark.parametrize("rows, pose", [(2001, [0, 700]), (1, [0])])
def test_from_a_pose_to_itself_there_is_no_noise(rows, pose):
    for part in increments.noise_in_drive(np.full((rows, 2), 127), VEHICLE, pose, pose):
        assert_array_equal(part, 0)
