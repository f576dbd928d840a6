"""Stage 2: the error of a between factor, for odometry and markers, and whitening, in numpy.

Derivatives by poses are by GTSAM's tangent vectors: X moves as X exp(xi), in its own axes. Those of
`se2` are by coordinates. Tests compare the error with GTSAM's BetweenFactorPose2.
"""

import numpy as np

from slamlib import se2


def between_error(z, first, second):
    """Errors log(z^-1 X^-1 X') (m, 3) and their derivatives by X, X', and the coordinates of z.

    Measured poses z, first poses X and second poses X' are (m, 3), m, m, rad; the derivatives
    (m, 3, 3). GTSAM: BetweenFactorPose2.
    """
    h = se2.between(first, second)
    difference = se2.between(z, h)
    log_jacobian, origin = se2.log_jacobian(difference), np.zeros(3)
    _, by_second = se2.compose_jacobians(difference, origin)         # difference xi for X' xi
    h_by_first, _ = se2.compose_jacobians(origin, h)                 # xi^-1 h for X xi
    by_z, by_h = se2.between_jacobians(z, h)
    return (se2.log(difference), -log_jacobian @ by_h @ h_by_first, log_jacobian @ by_second,
            log_jacobian @ by_z)


def square_root_information(covariance):
    """Upper triangular U (..., d, d) with U^T U = C^-1, from covariances C: U e is whitened."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)
