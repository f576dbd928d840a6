"""How good an estimate is, against the truth where there is truth."""

import numpy as np
from scipy.stats import chi2

from slamlib import se2


def path_length(poses):
    """Sum of the straight lines between consecutive known poses (n, >= 2), in metres."""
    known = poses[np.isfinite(poses[:, 0]), :2]
    return float(np.hypot(*np.diff(known, axis=0).T).sum())


def align(poses, truth):
    """The motion T of SE(2) that brings poses nearest to the truth: least squares of positions.

    Horn's problem in the plane: the turn follows from the cross and dot products of the positions
    about their means.

    Parameters
    ----------
    poses, truth : (n, >= 2) [x, y, ...], the same pose in the same row, finite.

    Returns
    -------
    (3,) T, such that compose(T, poses) is aligned.
    """
    mean, true_mean = poses[:, :2].mean(0), truth[:, :2].mean(0)
    p, q = poses[:, :2] - mean, truth[:, :2] - true_mean
    turn = np.arctan2(np.sum(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]), np.sum(p * q))
    return np.append(true_mean - se2.rotation(turn) @ mean, turn)


def ate(poses, truth, aligned=False):
    """Absolute trajectory error: root mean square of the position errors, in metres.

    Parameters
    ----------
    poses, truth : (n, 3) [x, y, heading], the same pose in the same row; rows of poses that are
        NaN are left out. NaN if all are.
    aligned : True moves the poses as a whole nearest to the truth first (Sturm et al., *A benchmark
        for the evaluation of RGB-D SLAM systems*, IROS 2012).
    """
    poses, truth = _finite(poses, truth)
    if not len(poses):
        return np.nan
    if aligned:
        poses = se2.compose(align(poses, truth), poses)
    return float(np.sqrt(np.mean(np.sum((poses[:, :2] - truth[:, :2])**2, axis=1))))


def rpe(poses, truth, step):
    """Relative pose error: of the increments over `step` rows, all of them (Sturm et al., 2012).

    Parameters
    ----------
    poses, truth : (n, 3) [x, y, heading]; increments from or to a pose that is NaN are left out.
    step : rows from the beginning to the end of an increment.

    Returns
    -------
    translation, rotation : root mean squares in metres and radians; NaN if there is no increment.
    """
    estimated = se2.between(poses[:-step], poses[step:])
    error = se2.between(se2.between(truth[:-step], truth[step:]), estimated)
    error = error[np.isfinite(error).all(axis=1)]
    if not len(error):
        return np.nan, np.nan
    error[:, 2] = se2.wrap(error[:, 2])
    squared = np.mean(error**2, axis=0)
    return float(np.sqrt(squared[0] + squared[1])), float(np.sqrt(squared[2]))


def judge(poses, covariances, truth, step):
    """ATE, aligned ATE, RPE over `step` rows and mean NEES of one trajectory: a dict of numbers.

    Rows of poses that are NaN stay where they are: no increment leads across a gap.
    """
    translation, rotation = rpe(poses, truth, step)
    return {"ate": ate(poses, truth), "aligned": ate(poses, truth, aligned=True),
            "rpe": translation, "rpe_heading": rotation, "nees": anees(poses, covariances, truth)}


def anees(poses, covariances, truth):
    """Average NEES over the poses that have one; NaN if none has."""
    values = nees(poses, covariances, truth)
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else np.nan


def nees_band(count, dof=3, probability=0.95):
    """Two-sided band in which the mean of `count` independent NEES lies with this probability.

    count times the mean is chi-squared with count * dof degrees of freedom (Bar-Shalom, Li and
    Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001, section 5.4).
    """
    tail = (1 - probability) / 2
    return tuple(chi2.ppf([tail, 1 - tail], dof * count) / count)


def _finite(poses, truth):
    known = np.isfinite(poses).all(axis=1)
    return poses[known], truth[known]


def sigmas(covariances):
    """Standard deviations (n, d) of covariances (n, d, d)."""
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))


def along(n, count=41):
    """Up to `count` indices from 1 to n - 1, evenly spread; 0 if there is nothing else."""
    return np.unique(np.linspace(min(1, n - 1), n - 1, count).astype(int))


def sigma_difference(covariances, reference):
    """Largest difference of the position's standard deviations from those of a reference.

    Both are (n, 3, 3); the result is a share of the largest standard deviation of the reference,
    since a ratio says nothing where both are next to zero. NaN if the reference has no extent.
    """
    sigma, expected = sigmas(covariances)[:, :2], sigmas(reference)[:, :2]
    return float(np.abs(sigma - expected).max() / expected.max()) if expected.max() > 0 else np.nan


def correlation_difference(covariances, reference):
    """Root mean square difference of the correlations of x and y with the heading.

    Both are (n, 3, 3); poses where a correlation is not defined are left out. NaN if all are.
    """
    difference = correlations(covariances)[:, :2, 2] - correlations(reference)[:, :2, 2]
    difference = difference[np.isfinite(difference)]
    return float(np.sqrt(np.mean(difference**2))) if len(difference) else np.nan


def correlations(covariances):
    """Correlation matrices (n, d, d) of covariances (n, d, d); NaN where a variance is zero."""
    sigma = sigmas(covariances)
    scale = sigma[..., :, None] * sigma[..., None, :]
    return np.divide(covariances, scale, out=np.full_like(scale, np.nan), where=scale > 0)


def nees(poses, covariances, truth):
    """Normalized estimation error squared e^T C^-1 e of every pose; 3 on average is consistent.

    Parameters
    ----------
    poses, truth : (n, 3) [x, y, heading].
    covariances : (n, 3, 3) of [x, y, heading]. Singular ones, as of a pose that is known, and those
        of poses without an estimate give NaN.

    Returns
    -------
    (n,) NEES, chi-squared with 3 degrees of freedom for an honest Gaussian covariance.
    """
    error = poses - truth
    error[:, 2] = se2.wrap(error[:, 2])
    rho = correlations(covariances)
    regular = np.isfinite(rho).all(axis=(1, 2))
    regular[regular] = np.linalg.eigvalsh(rho[regular])[:, 0] > 1e-12
    scaled = error[regular] / sigmas(covariances[regular])
    result = np.full(len(error), np.nan)
    result[regular] = np.einsum("ni,ni->n", scaled,
                                np.linalg.solve(rho[regular], scaled[..., None])[..., 0])
    return result
