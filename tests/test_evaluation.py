import numpy as np
import pytest

from slamlib import evaluation, se2
from slamlib.dataset import Vehicle


def test_ate_and_path_length_by_hand():
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    poses = truth + [[0, 0, 0], [0.3, 0.4, 9], [0, 0.5, 9]]
    assert np.isclose(evaluation.ate(poses, truth), np.sqrt((0.25 + 0.25) / 3))
    assert evaluation.path_length(truth) == 2


def test_nees_by_hand_and_across_the_cut_of_the_heading():
    """Whole turns are no error; a known pose has none."""
    C = np.array([np.diag([4.0, 1.0, 0.01]), np.diag([4.0, 1.0, 0.01]), np.diag([1e-4, 1e-4, 1e4]),
                  np.diag([0, 0, 1e-8])])
    truth = np.array([[0, 0, np.pi], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
    poses = np.array([[2, 1, -np.pi + 0.1], [2, 1, 6 * np.pi + 0.1], [0.01, 0, 0], [0, 0, 0]])
    before = poses.copy()
    np.testing.assert_allclose(evaluation.nees(poses, C, truth), [3, 3, 1, np.nan], rtol=1e-9)
    np.testing.assert_array_equal(poses, before)
    np.testing.assert_allclose(evaluation.position_sigmas(C), [2, 2, 0.01, 0])


def as_evo(poses):
    from evo.core.trajectory import PosePath3D
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, :2, :2], matrices[:, :2, 3] = se2.rotation(poses[:, 2]), poses[:, :2]
    return PosePath3D(poses_se3=list(matrices))


@pytest.mark.parametrize("aligned", [False, True])
def test_ate_agrees_with_evo_and_unknown_poses_are_left_out(aligned):
    from evo.core import metrics
    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.normal([0.1, 0.02, 0.03], 0.02, (200, 3)), axis=0)
    shifted = se2.compose([3.0, -2.0, 2.5], truth + rng.normal(0, 0.05, (200, 3)))
    reference, estimate = as_evo(truth), as_evo(shifted)
    if aligned:
        estimate.align(reference)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((reference, estimate))
    expected = ape.get_statistic(metrics.StatisticsType.rmse)
    with_unknown = (np.insert(each, [3, 50], np.nan, axis=0) for each in (shifted, truth))
    assert np.isclose(evaluation.ate(*with_unknown, aligned), expected, rtol=1e-9)
    assert np.isnan(evaluation.ate(np.full_like(truth, np.nan), truth))


def test_nees_band_is_that_of_the_tables():
    """Chi-squared, 3 degrees of freedom: 0.216 and 9.348; 150 degrees: 117.985 and 185.800."""
    np.testing.assert_allclose(evaluation.nees_band(1), [0.2158, 9.3484], atol=1e-4)
    np.testing.assert_allclose(evaluation.nees_band(50), [117.985 / 50, 185.800 / 50], atol=1e-4)


@pytest.mark.parametrize("wrong", [None, Vehicle(), np.zeros(3), np.zeros((4, 3))])
def test_what_is_no_array_of_as_many_poses_is_refused(wrong):
    right, C = np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1))
    for pair in ((wrong, right), (right, wrong)):
        with pytest.raises((TypeError, ValueError)):
            evaluation.ate(*pair)
        with pytest.raises((TypeError, ValueError)):
            evaluation.nees(pair[0], C, pair[1])
