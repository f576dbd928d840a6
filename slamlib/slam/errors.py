"""Stage 2: errors e of the factors and their derivatives in numpy, all factors of a kind at once.

Derivatives are by GTSAM's tangent vectors: a pose X moves as X exp(xi), in its own axes. GTSAM has
the same errors in BetweenFactorPose2 and RangeFactor2D; tests compare them.
"""

import numpy as np

from slamlib import se2


def between_error(z, first, second):
    """Errors log(z^-1 X^-1 X') and their derivatives by X and X', and by the coordinates of z.

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


def point_error(z, pose, point):
    """Errors R^T (point - t) - z (m, 2) of points z (m, 2) m measured from poses (t, R), (m, 3).

    Also their derivatives by pose (m, 2, 3) and point (m, 2, 2).
    """
    R_t = se2.rotation(-pose[:, 2])
    expected = (R_t @ (point - pose[:, :2])[..., None])[..., 0]
    by_pose = np.zeros((len(z), 2, 3))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = -1
    by_pose[:, 0, 2], by_pose[:, 1, 2] = expected[:, 1], -expected[:, 0]
    return expected - z, by_pose, R_t


def range_error(r, pose, antenna):
    """Errors |antenna - t| - r (m,) of ranges r (m,) m from poses (m, 3) to antennas (m, 2) m.

    Also their derivatives by pose (m, 1, 3) and antenna (m, 1, 2). GTSAM: RangeFactor2D.
    """
    difference = antenna - pose[:, :2]
    distance = np.hypot(*difference.T)
    direction = difference[:, None, :] / np.maximum(distance, 1e-9)[:, None, None]
    by_position = -direction @ se2.rotation(pose[:, 2])
    by_pose = np.concatenate([by_position, np.zeros((len(r), 1, 1))], axis=2)
    return distance - r, by_pose, direction


def square_root_information(covariance):
    """Upper triangular U (..., d, d) with U^T U = C^-1, from covariances C: U e is whitened."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)
