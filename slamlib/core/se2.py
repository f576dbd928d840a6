"""Planar rigid motions, batched: poses are arrays (..., 3) of [x, y, heading].

Lengths are in metres, angles in radians. The pose T_ab of frame b in frame a maps coordinates in b
to coordinates in a,

    p_a = R(heading) p_b + [x, y],        R(h) = [[cos h, -sin h], [sin h, cos h]].

Adjacent frames cancel: compose(T_ab, T_bc) = T_ac and between(T_wa, T_wb) = T_ab. Every function
broadcasts over the leading dimensions. Jacobians are partial derivatives by the coordinates
[x, y, heading], not by a tangent vector, as the covariances of this package are of [x, y, heading].
Headings are added and subtracted but not wrapped; call `wrap` where an angle must lie in (-pi, pi].
"""

import numpy as np


def wrap(angle):
    """Angles in (-pi, pi] that are equivalent to `angle`, rad, of any shape.

    >>> wrap([1.5 * np.pi, 2.0]).round(3)
    array([-1.571,  2.   ])
    """
    wrapped = np.pi - np.mod(np.pi - np.asarray(angle, dtype=float), 2 * np.pi)
    return np.where(wrapped <= -np.pi, np.pi, wrapped)         # np.mod can round up to 2 pi


def rotation(heading):
    """Rotation matrices R(heading), (..., 2, 2), of headings (...)."""
    c, s = np.cos(heading), np.sin(heading)
    R = np.empty(np.shape(heading) + (2, 2))
    R[..., 0, 0] = R[..., 1, 1] = c
    R[..., 0, 1], R[..., 1, 0] = -s, s
    return R


def compose(T_ab, T_bc):
    """T_ac = T_ab T_bc, (..., 3).

    >>> compose([1, 0, np.pi / 2], [2, 0, 0]).round(3)
    array([1.   , 2.   , 1.571])
    """
    T_ab, T_bc = np.asarray(T_ab, dtype=float), np.asarray(T_bc, dtype=float)
    c, s = np.cos(T_ab[..., 2]), np.sin(T_ab[..., 2])
    x, y = T_bc[..., 0], T_bc[..., 1]
    return _poses(T_ab[..., 0] + c * x - s * y,
                  T_ab[..., 1] + s * x + c * y,
                  T_ab[..., 2] + T_bc[..., 2])


def inverse(T_ab):
    """T_ba, (..., 3), the inverse of T_ab."""
    return between(T_ab, np.zeros(3))


def between(T_wa, T_wb):
    """T_ab = inverse(T_wa) T_wb, (..., 3), the pose of b in a.

    >>> between([1, 0, np.pi / 2], [1, 2, np.pi / 2]).round(3)
    array([2., 0., 0.])
    """
    T_wa, T_wb = np.asarray(T_wa, dtype=float), np.asarray(T_wb, dtype=float)
    c, s = np.cos(T_wa[..., 2]), np.sin(T_wa[..., 2])
    dx, dy = T_wb[..., 0] - T_wa[..., 0], T_wb[..., 1] - T_wa[..., 1]
    return _poses(c * dx + s * dy, -s * dx + c * dy, T_wb[..., 2] - T_wa[..., 2])


def difference(first, second):
    """first - second, (..., 3), with the difference of the headings in (-pi, pi]."""
    r = np.subtract(first, second)
    r[..., 2] = wrap(r[..., 2])
    return r


def compose_jacobians(T_ab, T_bc):
    """Derivatives of compose, d T_ac / d T_ab and d T_ac / d T_bc, each (..., 3, 3)."""
    T_ab, T_ac = np.asarray(T_ab), compose(T_ab, T_bc)
    lever = T_ac[..., :2] - T_ab[..., :2]                # position of c from b, in axes of a
    by_first, by_second = _identity(T_ac.shape), _identity(T_ac.shape)
    by_first[..., 0, 2] = -lever[..., 1]
    by_first[..., 1, 2] = lever[..., 0]
    by_second[..., :2, :2] = rotation(T_ab[..., 2])
    return by_first, by_second


def compose_uncertain(T_ab, C_ab, T_bc, C_bc):
    """T_ac, (..., 3), and its covariance (..., 3, 3), by independent motions and covariances."""
    A, B = compose_jacobians(T_ab, T_bc)
    return compose(T_ab, T_bc), A @ C_ab @ A.mT + B @ C_bc @ B.mT


def between_jacobians(T_wa, T_wb):
    """Derivatives of between, d T_ab / d T_wa and d T_ab / d T_wb, each (..., 3, 3)."""
    T_ab = between(T_wa, T_wb)
    by_second = _identity(T_ab.shape)
    by_second[..., :2, :2] = rotation(-np.asarray(T_wa)[..., 2])
    by_first = -by_second
    by_first[..., 0, 2] = T_ab[..., 1]
    by_first[..., 1, 2] = -T_ab[..., 0]
    return by_first, by_second


def log(T):
    """Logarithm (..., 3) of motions T (..., 3), the constant velocity that yields T in unit time.

    It is [a x + h y / 2, -h x / 2 + a y, h] with the wrapped heading h and a = (h / 2) cot(h / 2).
    GTSAM computes the error of its between factors with it (`Pose2::Logmap`).
    """
    x, y, h, a = _log_terms(T)
    return _poses(a * x + h * y / 2, -h * x / 2 + a * y, h)


def log_jacobian(T):
    """Derivative of `log` at motions T (..., 3) by [x, y, heading], (..., 3, 3)."""
    x, y, h, a = _log_terms(T)
    small = np.abs(h) < 1e-3                                 # there the derivative of a cancels
    slope = np.where(small, -h / 6, (a - a**2 - h**2 / 4) / np.where(small, 1.0, h))
    jacobian = _identity(np.shape(T))
    jacobian[..., 0, 0], jacobian[..., 0, 1], jacobian[..., 0, 2] = a, h / 2, slope * x + y / 2
    jacobian[..., 1, 0], jacobian[..., 1, 1], jacobian[..., 1, 2] = -h / 2, a, slope * y - x / 2
    return jacobian


def _log_terms(T):
    """x, y, h and a of `log`."""
    x, y, h = np.moveaxis(np.asarray(T, dtype=float), -1, 0)
    h = wrap(h)
    return x, y, h, np.cos(h / 2) / np.sinc(h / (2 * np.pi))


def rotate_covariance(covariance, heading):
    """B C B^T, covariances C (..., 3, 3) of [x, y, heading] rotated from axes of b to those of a.

    B rotates x and y by `heading` (...), that of b in a, in rad.
    """
    B = _identity(np.shape(heading) + (3,))
    B[..., :2, :2] = rotation(heading)
    return B @ covariance @ B.mT


def sigmas(covariances):
    """Standard deviations (n, d) of covariances (n, d, d)."""
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))


def correlations(covariances):
    """Correlation matrices (n, d, d) of covariances (n, d, d); NaN where a variance is zero."""
    sigma = sigmas(covariances)
    scale = sigma[..., :, None] * sigma[..., None, :]
    return np.divide(covariances, scale, out=np.full_like(scale, np.nan), where=scale > 0)


def regular(covariances):
    """True (n,) where covariances (n, d, d) are finite and, as correlations, not singular."""
    rho = correlations(covariances)
    found = np.isfinite(rho).all(axis=(1, 2))
    found[found] = np.linalg.eigvalsh(rho[found])[:, 0] > 1e-12
    return found


def squared_distances(first, second, covariance):
    """Squared Mahalanobis distances (...) of poses (..., 3) whose difference has a covariance."""
    r = difference(first, second)
    return np.sum(r * np.linalg.solve(covariance, r[..., None])[..., 0], axis=-1)


def _poses(x, y, heading):
    """Poses (..., 3), filled in place because np.stack is several times slower on small arrays."""
    T = np.empty(np.shape(x) + (3,))
    T[..., 0], T[..., 1], T[..., 2] = x, y, heading
    return T


def _identity(shape):
    """Identity matrices (..., 3, 3), one for each pose of an array of this shape, (..., 3)."""
    return np.zeros(shape + (3,)) + np.eye(3)
