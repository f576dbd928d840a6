import numpy as np

from slamlib import evaluation


def test_ate_and_path_length_by_hand():
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    poses = truth + [[0, 0, 0], [0.3, 0.4, 9], [0, 0.5, 9]]
    assert np.isclose(evaluation.ate(poses, truth), np.sqrt((0.25 + 0.25) / 3))
    assert evaluation.path_length(truth) == 2


def test_nees_by_hand_and_across_the_cut_of_the_heading():
    C = np.array([np.diag([4.0, 1.0, 0.01]), np.diag([1e-4, 1e-4, 1e4]), np.diag([0, 0, 1e-8])])
    truth = np.array([[0, 0, np.pi], [0, 0, 0], [0, 0, 0]])
    poses = np.array([[2, 1, -np.pi + 0.1], [0.01, 0, 0], [0, 0, 0]])
    before = poses.copy()
    np.testing.assert_allclose(evaluation.nees(poses, C, truth), [3, 1, np.nan], rtol=1e-9)
    np.testing.assert_array_equal(poses, before)
