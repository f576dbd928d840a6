from functools import partial

import gtsam
import numpy as np
import pytest
from numeric import central_differences

from slamlib import se2

HEADINGS = [0.0, 1e-8, -1e-8, 0.7, -2.1, np.pi, -np.pi, np.pi - 1e-9, 5.0]
POSES = [np.array([x, y, h]) for h in HEADINGS for x, y in [(0.0, 0.0), (1.5, -2.5)]]


def matrix(pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0, 0, 1]])


@pytest.mark.parametrize("a", POSES)
def test_operations_are_those_of_homogeneous_matrices(a):
    for b in POSES:
        np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-14)
        np.testing.assert_allclose(matrix(se2.between(a, b)), np.linalg.solve(matrix(a), matrix(b)),
                                   atol=1e-13)
    np.testing.assert_allclose(matrix(se2.inverse(a)), np.linalg.inv(matrix(a)), atol=1e-13)


def swapped(function, b, a):
    return function(a, b)


@pytest.mark.parametrize("a", POSES)
def test_jacobians_against_central_differences(a):
    for b in POSES:
        for function, jacobians in ((se2.compose, se2.compose_jacobians),
                                    (se2.between, se2.between_jacobians)):
            by_first, by_second = jacobians(a, b)
            with_b, with_a = partial(swapped, function, b), partial(function, a)
            np.testing.assert_allclose(by_first, central_differences(with_b, a), atol=1e-8)
            np.testing.assert_allclose(by_second, central_differences(with_a, b), atol=1e-8)
    np.testing.assert_allclose(se2.inverse_jacobian(a), central_differences(se2.inverse, a),
                               atol=1e-8)
    if abs(abs(se2.wrap(a[2])) - np.pi) > 1e-3:                # where the heading wraps it jumps
        np.testing.assert_allclose(se2.log_jacobian(a), central_differences(se2.log, a), atol=1e-7)


@pytest.mark.parametrize("a", POSES)
def test_log_is_gtsams(a):
    a = np.append(a[:2], se2.wrap(a[2]))                       # at -pi there are two logarithms
    np.testing.assert_allclose(se2.log(a), gtsam.Pose2.Logmap(gtsam.Pose2(*a)), atol=1e-6)
    for heading in (9e-4, 1.1e-3):                             # on both sides of the series' end
        pose = np.array([1.5, -2.5, heading])
        expected = gtsam.Pose2.Logmap(gtsam.Pose2(*pose))
        np.testing.assert_allclose(se2.log(pose), expected, atol=1e-12)
        numeric = central_differences(se2.log, pose)
        np.testing.assert_allclose(se2.log_jacobian(pose), numeric, atol=1e-8)


def test_batches_broadcast_and_leave_their_arguments_alone():
    many, one = np.array(POSES), POSES[7]
    before = many.copy()
    for function in (se2.compose, se2.between):
        np.testing.assert_array_equal(function(one, many), [function(one, p) for p in many])
        np.testing.assert_array_equal(function(many, one), [function(p, one) for p in many])
    for jacobians in (se2.compose_jacobians, se2.between_jacobians):
        for i in range(2):
            np.testing.assert_array_equal(jacobians(one, many)[i],
                                          [jacobians(one, p)[i] for p in many])
            np.testing.assert_array_equal(jacobians(many, one)[i],
                                          [jacobians(p, one)[i] for p in many])
    np.testing.assert_array_equal(many, before)


def test_wrap_keeps_the_upper_end_only():
    np.testing.assert_array_equal(se2.wrap([np.pi, -np.pi, 0.0]), [np.pi, np.pi, 0.0])
    angles = np.linspace(-50, 50, 1001)
    odd = np.pi * np.array([1, 3, 7, -1, -3, -7])
    angles = np.concatenate([angles, np.nextafter(odd, -99), np.nextafter(odd, 99)])
    wrapped = se2.wrap(angles)
    assert (wrapped > -np.pi).all() and (wrapped <= np.pi).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)


def test_rotated_covariance_is_that_of_rotated_samples():
    C = np.array([[4.0, 0.5, 0.3], [0.5, 1.0, -0.2], [0.3, -0.2, 0.25]])
    B = matrix([0, 0, 0.8])
    np.testing.assert_allclose(se2.rotate_covariance(C, 0.8), B @ C @ B.T, atol=1e-15)
    batch = se2.rotate_covariance(np.stack([C, C]), np.array([0.8, -0.8]))
    np.testing.assert_allclose(batch[1], B.T @ C @ B, atol=1e-15)
