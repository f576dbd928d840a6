"""Standard deviations and correlations of covariances."""

import numpy as np


def sigmas(covariances):
    """Standard deviations (n, d) of covariances (n, d, d)."""
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))


def correlations(covariances):
    """Correlation matrices (n, d, d) of covariances (n, d, d); NaN where a variance is zero."""
    sigma = sigmas(covariances)
    scale = sigma[..., :, None] * sigma[..., None, :]
    return np.divide(covariances, scale, out=np.full_like(scale, np.nan), where=scale > 0)
