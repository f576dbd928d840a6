"""Problem 1: odometry, its covariances, and increments between poses with their noise."""

from dataclasses import replace

import numpy as np
import pytest
from numeric import central_differences, sigmas
from numpy.testing import assert_allclose, assert_array_equal

from slamlib.core import increments, odometry, se2
from slamlib.core.preintegration import preintegrate
from slamlib.core.records import Dataset
from slamlib.core.se2 import correlations
from slamlib.core.vehicle import Vehicle
from slamlib.studies.simulation import manoeuvre, simulate

VEHICLE = Vehicle()
BOTH = pytest.mark.parametrize("model", odometry.MODELS)


def curvy_ticks(n=300, seed=3):
    """Counts of a drive with bends, a stop, a turn on the spot and a stretch in reverse."""
    rng = np.random.default_rng(seed)
    ticks = rng.integers(60, 180, (n, 2))
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


@pytest.mark.parametrize("model, expected", [
    ("euler", [1, 2 + 0.15 * np.pi, 3 * np.pi / 4]),
    ("arc", [1 - 0.6 * (1 - np.cos(np.pi / 4)), 2 + 0.6 * np.sin(np.pi / 4), 3 * np.pi / 4])])
def test_one_step_by_hand(model, expected):
    """8000 counts right, 4000 left: ds = pi (0.1 + 0.05), dtheta = 2 pi (0.1 - 0.05) / 0.4.

    They describe a circle of radius ds / dtheta = 0.6 through 45 degrees.
    """
    poses = odometry.dead_reckoning([[0, 0], [8000, 4000]], VEHICLE, (1.0, 2.0, np.pi / 2), model)
    assert_allclose(poses, [[1, 2, np.pi / 2], expected], atol=1e-15)


@BOTH
@pytest.mark.parametrize("ticks", [curvy_ticks(), *(np.array(
    [[0, 0], [100 + more, 100], [100, 100 + more]]) for more in (0, 1, 3, 40))])
def test_wheel_jacobian_against_central_differences(model, ticks):
    """Also of nearly straight steps, on both sides of the switch to the chord's series."""
    numeric = central_differences(
        lambda w: odometry.dead_reckoning(ticks, VEHICLE.with_wheel(w), (0, 0, 0.4), model),
        VEHICLE.wheel, step=1e-7 if len(ticks) > 3 else 1e-6)
    analytic = odometry.wheel_jacobian(ticks, VEHICLE, 0.4, model)
    assert_allclose(analytic, numeric, atol=max(1e-9, 1e-6 * np.abs(numeric[3:]).max(
        initial=0)))


def test_unknown_model_is_refused():
    with pytest.raises(ValueError, match="euler.*arc.*'midpoint'"):
        odometry.dead_reckoning(curvy_ticks(), VEHICLE, model="midpoint")


@pytest.mark.parametrize("legs, equation2_holds", [
    ([(5, np.pi / 2)], True),                                             # a quarter turn
    ([(3, 0), (4, 2.5), (3, -1.0)], True),                                # bends to both sides
    ([(8, 0)], True),                                                     # straight on
    ([(5, 0), (0.8, np.pi / 2), (-5, 0), (-0.8, np.pi / 2), (-5, 0)], False),       # backing up
])
def test_both_covariances_against_monte_carlo(legs, equation2_holds):
    """With 4,000 draws a sigma is known to 1.1 %, a correlation to 0.016.

    The first-order propagation must agree in all six elements. Equation 2 must agree in the heading
    and, as long as the heading error grows in one direction, in the position's sigmas. It must
    disagree where the vehicle backs up, and its correlation of heading and position must be almost
    zero. Notebook 1 explains these findings.
    """
    ticks = manoeuvre(legs)

    def last_pose(z):
        vehicle = VEHICLE.with_wheel(VEHICLE.wheel + z[:3] * VEHICLE.sigma_wheel)
        start = (0.0, 0.0, z[3] * VEHICLE.sigma_heading)
        return odometry.dead_reckoning(ticks, vehicle, start)[-1]

    draws = np.random.default_rng(11).standard_normal((4000, 4))
    errors = [last_pose(z) for z in draws] - last_pose(np.zeros(4))
    sampled = errors.T @ errors / len(errors)
    sigma = sigmas(sampled)
    exact = odometry.first_order(ticks, VEHICLE)[1][-1]
    equation2 = odometry.equation2(ticks, VEHICLE)[1][-1]
    scale = np.array([sigma[:2].max(), sigma[:2].max(), sigma[2]])
    assert_allclose(sigmas(exact) / scale, sigma / scale, atol=0.05)
    assert_allclose(correlations(exact), correlations(sampled), atol=0.06)
    assert np.abs(correlations(sampled)[:2, 2]).max() > 0.9
    assert np.abs(correlations(equation2)[:2, 2]).max() < 0.2
    difference = np.abs(sigmas(equation2) - sigma) / scale
    assert difference[2] < 0.05
    assert difference.max() < 0.05 if equation2_holds else difference.max() > 0.5


@BOTH
def test_first_order_is_exact_for_the_initial_pose(model):
    """Only the initial pose uncertain: C_k = A C_1 A^T with A by central differences."""
    ticks, start = curvy_ticks(), np.array([1.0, -2.0, 0.5])
    sure = replace(VEHICLE, sigma_right_radius=1e-30, sigma_left_radius=1e-30,
                   sigma_wheelbase=1e-30)
    C1 = np.array([[4e-4, 1e-4, 2e-4], [1e-4, 9e-4, -1e-4], [2e-4, -1e-4, 1e-3]])
    poses, covariances = odometry.first_order(ticks, sure, start, C1, model)
    A = central_differences(lambda p: odometry.dead_reckoning(ticks, VEHICLE, p, model)[-1], start)
    assert_allclose(covariances[-1], A @ C1 @ A.T, atol=1e-9)
    assert_allclose(poses, odometry.dead_reckoning(ticks, VEHICLE, start, model))


def test_a_single_pose_has_the_initial_covariance():
    for function in (odometry.equation2, odometry.first_order):
        poses, covariances = function(np.zeros((1, 2), int), VEHICLE)
        assert_array_equal(poses, [[0, 0, 0]])
        assert_array_equal(covariances, [np.diag([0, 0, 1e-8])])


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
    # An increment depends on its own counts only.
    alone, alone_by_w = increments.between_poses(ticks[9:12], VEHICLE, [1], [2], model)
    assert_allclose(increment[1], alone[0], atol=1e-13)
    assert_allclose(by_w[1], alone_by_w[0], atol=1e-11)


def literal_noise(ticks, vehicle, start, end, slip):
    """Sum over the steps of the wheel errors' effects at the end of one increment."""
    count = 2 * np.pi * vehicle.wheel[:2] / vehicle.ticks_per_revolution
    poses = odometry.dead_reckoning(ticks, vehicle, model="arc")
    total = np.zeros((3, 3))
    for k in range(start, end):
        middle = (poses[k] + poses[k + 1]) / 2
        lever = poses[end] - middle
        variance = slip**2 * np.abs(count * ticks[k + 1]) + count**2 / 6 / (end - start)
        for turn, v in zip(np.array([1, -1]) / vehicle.wheelbase, variance):
            effect = np.array([np.cos(middle[2]) / 2 - lever[1] * turn,
                               np.sin(middle[2]) / 2 + lever[0] * turn, turn])
            total += v * np.outer(effect, effect)
    return se2.rotate_covariance(total, -poses[start, 2])


def noise_alone(ticks, vehicle, start, end, slip):
    rounding, slipping = increments.rounding_and_slipping(ticks, vehicle, start, end)
    return rounding + slip**2 * slipping


def test_noise_is_the_sum_over_steps():
    ticks = simulate("short", seed=3)[0].ticks
    pairs = [(0, 10), (100, 400), (37, 38), (1500, 1999)]
    got = noise_alone(ticks, VEHICLE, *np.transpose(pairs), 2e-3)
    for (s, e), noise in zip(pairs, got, strict=True):
        expected = literal_noise(ticks, VEHICLE, s, e, 2e-3)
        assert_allclose(noise, expected, atol=1e-9 * np.abs(expected).max())


def test_noise_keeps_its_digits_far_from_the_origin():
    """Steps of 157 m: the last one, 300 km away, has the noise of the first."""
    ticks, vehicle = np.full((2001, 2), 80_000), Vehicle(right_radius=2.5, left_radius=2.5)
    for part in increments.rounding_and_slipping(ticks, vehicle, [0, 1999], [1, 2000]):
        assert_allclose(part[1], part[0], rtol=1e-9, atol=1e-9 * part[0, 2, 2])


def test_noise_in_drive_does_not_depend_on_how_the_drive_is_cut():
    """A straight drive: the rounding of one difference of counts, the skid and the slip."""
    ticks = np.full((2001, 2), 127)
    whole = np.diag(noise_alone(ticks, VEHICLE, [0], [2000], 0.0)[0])
    travelled = np.sum(odometry.steps(ticks, VEHICLE)[0])
    skid = increments.MINIMUM_SLIP**2 * travelled
    by_slip = travelled * np.array([1 / 2, 2 / VEHICLE.wheelbase**2])
    for every in (1, 10, 500, 2000):
        pose = np.arange(0, 2001, every)
        parts = increments.noise_in_drive(ticks, VEHICLE, pose[:-1], pose[1:])
        rounding, slipping = (np.diag(part.sum(axis=0))[[0, 2]] for part in parts)
        assert_allclose(rounding, whole[[0, 2]] + [skid, 0.0], rtol=1e-6)
        assert_allclose(slipping, by_slip, rtol=1e-6)


def test_the_noise_of_a_step_in_a_drive_has_its_part_of_the_skid():
    ticks = np.full((2, 2), 127)
    one = increments.noise_in_drive(ticks, VEHICLE, [0], [1])[0][0]
    skid = increments.MINIMUM_SLIP**2 * odometry.steps(ticks, VEHICLE)[0][0]
    expected = noise_alone(ticks, VEHICLE, [0], [1], 0.0)[0] + np.diag([skid, skid, 0.0])
    assert_allclose(one, expected, rtol=1e-9, atol=1e-20)


@pytest.mark.parametrize("rows, pose", [(2001, [0, 700]), (1, [0])])
def test_from_a_pose_to_itself_there_is_no_noise(rows, pose):
    for part in increments.noise_in_drive(np.full((rows, 2), 127), VEHICLE, pose, pose):
        assert_array_equal(part, 0)


def test_noise_of_wheels_moves_the_end_of_an_increment_across_its_own_direction():
    """After a turn of 45 degrees and 5 m straight on."""
    ticks = manoeuvre([(0.5, np.pi / 4), (5.0, 0.0)])
    drive = Dataset("turn", VEHICLE, ticks, None, None, None)
    found = preintegrate(drive, np.array([0, len(ticks) - 1]))
    for Q in (found.quantization[0], found.slipping[0]):
        assert Q[1, 1] > 3 * Q[0, 0]
