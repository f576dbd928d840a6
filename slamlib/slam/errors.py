"""Stage 2: errors of the factors and their derivatives in numpy, all factors of a kind at once.

Derivatives are by GTSAM's tangent vectors: a pose X moves as X exp(xi), in its own axes. GTSAM has
the same errors in BetweenFactorPose2 and RangeFactor2D; tests compare them.
"""

import numpy as np

from slamlib import se2


def between_error(Z, first, second):
    """log(Z^-1 X^-1 X') and its derivatives by X and X', and by the coordinates of Z.

    Z, first and second are poses (m, 3), the derivatives (m, 3, 3). GTSAM: BetweenFactorPose2.
    """
    h = se2.between(first, second)
    miss = se2.between(Z, h)
    log_by_miss, origin = se2.log_jacobian(miss), np.zeros(3)
    _, by_second = se2.compose_jacobians(miss, origin)               # miss xi for X' xi
    h_by_first, _ = se2.compose_jacobians(origin, h)                 # xi^-1 h for X xi
    miss_by_Z, miss_by_h = se2.between_jacobians(Z, h)
    return (se2.log(miss), -log_by_miss @ miss_by_h @ h_by_first, log_by_miss @ by_second,
            log_by_miss @ miss_by_Z)


def point_error(z, pose, point):
    """R^T (point - t) - z of points z (m, 2) m seen from poses X = (t, R), (m, 3): errors (m, 2).

    Also their derivatives by pose (m, 2, 3) and point (m, 2, 2).
    """
    back = se2.rotation(-pose[:, 2])
    seen = (back @ (point - pose[:, :2])[..., None])[..., 0]
    by_pose = np.zeros((len(z), 2, 3))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = -1
    by_pose[:, 0, 2], by_pose[:, 1, 2] = seen[:, 1], -seen[:, 0]
    return seen - z, by_pose, back


def range_error(r, pose, antenna):
    """|antenna - t| - r of ranges r (m,) m from poses (m, 3) to antennas (m, 2): errors (m,).

    Also their derivatives by pose (m, 1, 3) and antenna (m, 1, 2). GTSAM: RangeFactor2D.
    """
    apart = antenna - pose[:, :2]
    distance = np.hypot(*apart.T)
    direction = apart[:, None, :] / np.maximum(distance, 1e-9)[:, None, None]
    by_position = -direction @ se2.rotation(pose[:, 2])
    by_pose = np.concatenate([by_position, np.zeros((len(r), 1, 1))], axis=2)
    return distance - r, by_pose, direction


def square_root_information(covariance):
    """Upper triangular U (..., d, d) with U^T U = C^-1, of covariances C, which whitens errors."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)
