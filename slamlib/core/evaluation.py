"""Measures of the error of an estimate against the truth, and sizes of covariances.

Poses are (n, 3) [x, y, heading] in m and rad, covariances (n, 3, 3) of the same in world axes.
Estimate and truth hold the same pose in the same row. Poses without an estimate are NaN. ATE
follows Sturm et al., *A benchmark for the evaluation of RGB-D SLAM systems* (IROS 2012); NEES
follows Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation*
(2001), section 5.4.
"""

import gtsam
import numpy as np

from slamlib.core import se2

REACH_95 = float(np.sqrt(-2 * np.log(0.05)))    # sigmas, of the 95 % ellipse of a planar Gaussian


def path_length(poses: np.ndarray) -> float:
    """Sum in m of the distances between consecutive known poses (n, >= 2)."""
    known = np.isfinite(poses[:, 0])
    steps = np.diff(poses[known, :2], axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())


def align(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Motion T (3,) of SE(2) for which compose(T, poses) is closest to the truth.

    Least squares of the positions, Horn's problem in the plane (J. Opt. Soc. Am. A 4(4), 1987).
    Both are (n, >= 2), finite, of at least two poses.
    """
    T = gtsam.Pose2.Align(truth[:, :2].T, poses[:, :2].T)
    return np.array([T.x(), T.y(), T.theta()])


def ate(poses: np.ndarray, truth: np.ndarray, aligned: bool = False) -> float:
    """Absolute trajectory error: root mean square in m of the position errors.

    Poses that are NaN are left out; the result is NaN if all are. With `aligned` the poses, if they
    are more than one, are first aligned with the truth by one motion of SE(2).

    >>> poses, truth = np.array([[0, 0, 0], [3, 4, 0]]), np.zeros((2, 3))
    >>> round(ate(poses, truth), 3)
    3.536
    """
    known = np.isfinite(poses).all(axis=1)
    poses = poses[known]
    truth = truth[known]
    if not len(poses):
        return np.nan
    if aligned and len(poses) > 1:
        poses = se2.compose(align(poses, truth), poses)
    error = poses[:, :2] - truth[:, :2]
    squared = np.sum(error**2, axis=1)
    return float(np.sqrt(np.mean(squared)))


def nees(poses: np.ndarray, covariances: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Normalized estimation error squared e^T C^-1 e of every pose, (n,).

    It is chi-squared with 3 degrees of freedom, so 3 on average, if the errors are Gaussian with
    covariance C. It is NaN where C is singular, as for a known pose, and without an estimate.
    """
    ok = se2.are_regular(covariances)
    result = np.full(len(poses), np.nan)
    result[ok] = se2.squared_distances(poses[ok], truth[ok], covariances[ok])
    return result


def anees(poses: np.ndarray, covariances: np.ndarray, truth: np.ndarray) -> float:
    """Average NEES over the poses that have one; NaN if none has."""
    values = nees(poses, covariances, truth)
    if not np.isfinite(values).any():
        return np.nan
    return float(np.nanmean(values))


def nees_band(count: int, dof: int = 3, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band (low, high) that contains the mean of `count` independent NEES.

    The sum of the NEES is chi-squared with count * dof degrees of freedom; the mean lies in the
    band with the given probability.

    >>> np.round(nees_band(8), 2)
    array([1.55, 4.92])
    """
    from scipy.stats import chi2  # here, because it takes long to import

    low, high = chi2.interval(probability, dof * count)
    return low / count, high / count


def position_sigmas(covariances: np.ndarray) -> np.ndarray:
    """The larger standard deviation of x and y (n,), of covariances (n, >= 2, >= 2)."""
    return se2.sigmas(covariances)[:, :2].max(axis=1)
