import gtsam
import numpy as np
import pytest
from numeric import central_differences
from numpy.testing import assert_allclose, assert_array_equal

from slamlib.core import evaluation, se2

HEADINGS = [0.0, 1e-8, -1e-8, 0.7, -2.1, np.pi, -np.pi, np.pi - 1e-9, 5.0]
POSES = np.array([[x, y, h] for h in HEADINGS for x, y in [(0.0, 0.0), (1.5, -2.5)]])
BOTH = pytest.mark.parametrize("function, jacobians", [
    (se2.compose, se2.compose_jacobians), (se2.between, se2.between_jacobians)])
EACH = pytest.mark.parametrize("a", POSES)


def matrix(pose):
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0, 0, 1]])


@EACH
def test_operations_are_those_of_homogeneous_matrices(a):
    for b in POSES:
        assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-14)
        assert_allclose(matrix(se2.between(a, b)), np.linalg.solve(matrix(a), matrix(b)),
                                   atol=1e-13)
    assert_allclose(matrix(se2.inverse(a)), np.linalg.inv(matrix(a)), atol=1e-13)


@BOTH
@EACH
def test_jacobians_against_central_differences(a, function, jacobians):
    """And that of the inverse, by which poses in a depend on it."""
    for by, numeric in zip(jacobians(a, POSES), (
            central_differences(lambda d: function(a + d, POSES), np.zeros(3)),
            central_differences(lambda d: function(a, POSES + d), np.zeros(3)))):
        assert_allclose(by, numeric, atol=1e-8)
    numeric = central_differences(se2.inverse, a)
    assert_allclose(se2.between_jacobians(a, np.zeros(3))[0], numeric, atol=1e-8)


@pytest.mark.parametrize("a", [*POSES, [1.5, -2.5, 9e-4], [1.5, -2.5, 1.1e-3]])    # series' ends
def test_log_is_gtsams(a):
    a = np.append(a[:2], se2.wrap(a[2]))                       # at -pi there are two logarithms
    assert_allclose(se2.log(a), gtsam.Pose2.Logmap(gtsam.Pose2(*a)), atol=1e-6)
    if abs(a[2]) < np.pi - 1e-3:                               # where the heading wraps it jumps
        assert_allclose(se2.log_jacobian(a), central_differences(se2.log, a), atol=1e-8)


@BOTH
def test_batches_broadcast_and_leave_their_arguments_alone(function, jacobians):
    many, one = POSES.copy(), POSES[7]
    for call in (function, lambda *poses: jacobians(*poses)[0], lambda *poses: jacobians(*poses)[1],
                 se2.difference):
        assert_array_equal(call(one, many), [call(one, p) for p in many])
        assert_array_equal(call(many, one), [call(p, one) for p in many])
    assert_array_equal(many, POSES)


def test_wrap_keeps_the_upper_end_only():
    assert_array_equal(se2.wrap([np.pi, -np.pi, 0.0]), [np.pi, np.pi, 0.0])
    odd = np.pi * np.array([1, 3, 7, -1, -3, -7])
    angles = np.r_[-50:50:0.1, np.nextafter(odd, -99), np.nextafter(odd, 99)]
    wrapped = se2.wrap(angles)
    assert (wrapped > -np.pi).all() and (wrapped <= np.pi).all()
    assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)


def test_rotated_covariance_is_that_of_rotated_samples():
    C = np.array([[4.0, 0.5, 0.3], [0.5, 1.0, -0.2], [0.3, -0.2, 0.25]])
    B = matrix([0, 0, 0.8])
    found = se2.rotate_covariance(np.stack([C, C]), np.array([0.8, -0.8]))
    assert_allclose(found, [B @ C @ B.T, B.T @ C @ B], atol=1e-15)


# Evaluation.


def test_ate_and_path_length_by_hand():
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    poses = truth + [[0, 0, 0], [0.3, 0.4, 9], [0, 0.5, 9]]
    assert np.isclose(evaluation.ate(poses, truth), np.sqrt((0.25 + 0.25) / 3))
    assert evaluation.path_length(truth) == 2
    assert np.isnan(evaluation.ate(np.full_like(truth, np.nan), truth))


def test_nees_by_hand_and_across_the_cut_of_the_heading():
    """Whole turns are no error; a known pose has none."""
    C = np.array([[4, 1, 0.01], [4, 1, 0.01], [1e-4, 1e-4, 1e4], [0, 0, 1e-8]])[:, None] * np.eye(3)
    truth = np.zeros((4, 3))
    truth[0, 2] = np.pi
    poses = np.array([[2, 1, -np.pi + 0.1], [2, 1, 6 * np.pi + 0.1], [0.01, 0, 0], [0, 0, 0]])
    before = poses.copy()
    assert_allclose(evaluation.nees(poses, C, truth), [3, 3, 1, np.nan], rtol=1e-9)
    assert_array_equal(poses, before)
    assert_allclose(evaluation.position_sigmas(C), [2, 2, 0.01, 0])


def test_nees_band_is_that_of_the_tables():
    """Chi-squared, 3 degrees of freedom: 0.216 and 9.348; 150 degrees: 117.985 and 185.800."""
    assert_allclose(evaluation.nees_band(1), [0.2158, 9.3484], atol=1e-4)
    assert_allclose(evaluation.nees_band(50), [117.985 / 50, 185.800 / 50], atol=1e-4)
