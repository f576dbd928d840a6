
import numpy as np

from slamlib import evaluation, se2
from slamlib.checks import consistency
from slamlib.simulation import simulate


def test_returns_measure_the_true_motion():
    """Without noise the markers give it exactly, also where some labels are wrong."""
    for wrong in (0.0, 0.05):
        dataset, truth = simulate("short", 3, noise=False, mislabelled=wrong)
        found = consistency.returns(dataset)
        true = se2.between(truth.poses[found.start], truth.poses[found.end])
        assert len(true) > 5
        np.testing.assert_allclose(se2.difference(found.motion, true), 0, atol=1e-8)
        assert (found.driven >= consistency.MIN_GAP).all() and (np.diff(found.end) > 0).all()
        np.testing.assert_allclose(consistency.discrepancies(found, truth.poses), 0, atol=1e-8)


def test_a_drive_without_markers_or_that_goes_nowhere_again_has_no_returns():
    dataset, _ = simulate("short", 3)
    for each in (dataset.without("aruco"), dataset.first(700), dataset.first(1)):
        found = consistency.returns(each)
        assert found.motion.shape == (0, 3) and found.covariance.shape == (0, 3, 3)
        assert consistency.discrepancies(found, np.zeros((len(each.ticks), 3))).shape == (0, 3)
    assert len(consistency.returns(dataset, gap=1000.0).start) == 0


def test_the_covariance_of_returns_is_consistent():
    """The last return of each of 30 drives, so that they are independent."""
    nees = []
    for seed in range(30):
        dataset, truth = simulate("short", seed, slip=3e-3)
        found = consistency.returns(dataset)
        true = se2.between(truth.poses[found.start], truth.poses[found.end])
        nees.append(evaluation.nees(found.motion, found.covariance, true)[-1])
    low, high = evaluation.nees_band(len(nees))
    assert low < np.mean(nees) < high
