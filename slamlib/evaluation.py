"""How good an estimate is, against the truth where there is truth."""

import numpy as np

from slamlib import se2


def path_length(poses):
    """Sum of the straight lines between consecutive poses (n, >= 2), in metres."""
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def ate(poses, truth):
    """Absolute trajectory error: root mean square of the position errors, in metres.

    Parameters
    ----------
    poses, truth : (n, >= 2) [x, y, ...], the same pose in the same row.
    """
    return float(np.sqrt(np.mean(np.sum((poses[:, :2] - truth[:, :2])**2, axis=1))))


def sigmas(covariances):
    """Standard deviations (n, d) of covariances (n, d, d)."""
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))


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
    covariances : (n, 3, 3) of [x, y, heading]. Singular ones, as of a pose that is known, give NaN.

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
