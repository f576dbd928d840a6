import gtsam
import numpy as np
import pytest
from numeric import central_differences
from numpy.testing import assert_allclose, assert_array_equal

from slamlib.core import evaluation, se2

HEADINGS = [0.0, 1e-8, -1e-8, 0.7, -2.1, np.pi, -np.pi, np.pi - 1e-9, 5.0]
POSES = np.array([[x, y, h] for h in HEADINGS for x, y in [(0.0, 0.0), (1.5, -2.5)]])
EACH = POSES[:, None]


def assert_moves(pose, place, turn):
    """Poses (..., 3) are complex places (...) and turns exp(i heading)."""
    assert_allclose(pose[..., 0] + 1j * pose[..., 1], place, atol=1e-14)
    assert_allclose(np.exp(1j * pose[..., 2]), turn, atol=1e-14)


def test_operations_are_those_of_complex_numbers():
    place = POSES[:, 0] + 1j * POSES[:, 1]
    turn = np.exp(1j * POSES[:, 2])
    first, by = place[:, None], turn[:, None]
    assert_moves(se2.compose(EACH, POSES), first + by * place, by * turn)
    assert_moves(se2.between(EACH, POSES), (place - first) / by, turn / by)
    assert_moves(se2.inverse(POSES), -place / turn, 1 / turn)


@pytest.mark.parametrize("function, jacobians", [
    (se2.compose, se2.compose_jacobians), (se2.between, se2.between_jacobians)])
def test_jacobians_against_central_differences(function, jacobians):
    by_first, by_second = jacobians(EACH, POSES)
    numeric = central_differences(lambda d: function(EACH + d, POSES), np.zeros(3))
    assert_allclose(by_first, numeric, atol=1e-8)
    numeric = central_differences(lambda d: function(EACH, POSES + d), np.zeros(3))
    assert_allclose(np.broadcast_to(by_second, numeric.shape), numeric, atol=1e-8)


@pytest.mark.parametrize("a", [*POSES, [1.5, -2.5, 9e-4], [1.5, -2.5, 1.1e-3]])    # series' ends
def test_log_is_gtsams(a):
    a = np.append(a[:2], se2.wrap(a[2]))                       # at -pi there are two logarithms
    assert_allclose(se2.log(a), gtsam.Pose2.Logmap(gtsam.Pose2(*a)), atol=1e-6)
    if abs(a[2]) < np.pi - 1e-3:                               # where the heading wraps it jumps
        _, jacobian = se2.log_with_jacobian(a)
        assert_allclose(jacobian, central_differences(se2.log, a), atol=1e-8)


def test_arguments_are_left_alone():
    many = POSES.copy()
    for function in (se2.compose, se2.between, se2.difference):
        function(many, many)
    assert_array_equal(many, POSES)


def test_wrap_keeps_the_upper_end_only():
    odd = np.pi * np.array([1, 3, 7, -1, -3, -7])
    angles = np.r_[-50:50:0.1, odd, np.nextafter(odd, -99), np.nextafter(odd, 99)]
    wrapped = se2.wrap(angles)
    assert (wrapped > -np.pi).all() and (wrapped <= np.pi).all()
    assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)


def test_rotated_covariance_is_that_of_rotated_places():
    C = np.array([[4.0, 0.5, 0.3], [0.5, 1.0, -0.2], [0.3, -0.2, 0.25]])
    heading = np.array([0.8, -0.8])
    _, B = se2.compose_jacobians(heading[:, None] * [0, 0, 1], np.zeros(3))
    assert_allclose(se2.rotate_covariance(C, heading), B @ C @ B.mT, atol=1e-15)


# Evaluation.


def test_ate_and_path_length_by_hand():
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    poses = truth + [[0, 0, 0], [0.3, 0.4, 9], [0, 0.5, 9]]
    assert np.isclose(evaluation.ate(poses, truth), np.sqrt((0.25 + 0.25) / 3))
    assert evaluation.path_length(truth) == 2
    assert np.isnan(evaluation.ate(np.full_like(truth, np.nan), truth))


def test_an_aligned_path_has_no_error():
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    assert evaluation.ate(se2.compose([3, -1, 0.7], truth), truth, aligned=True) < 1e-12


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
