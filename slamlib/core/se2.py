"""Planar rigid motions, batched: poses are arrays (..., 3) of [x, y, heading].

Lengths are in metres, angles in radians. The pose T_ab of frame b in frame a maps coordinates in b
to coordinates in a,

    p_a = R(heading) p_b + [x, y],        R(h) = [[cos h, -sin h], [sin h, cos h]].

Adjacent frames cancel: compose(T_ab, T_bc) = T_ac and between(T_wa, T_wb) = T_ab. Every function
broadcasts over the leading dimensions. Jacobians are partial derivatives by the coordinates
[x, y, heading], not by a tangent vector, as the covariances of this package are of [x, y, heading].
Headings are added and subtracted but not wrapped; call `wrap` where an angle must lie in (-pi, pi].
With B(h), which rotates x and y by h and leaves the heading,

    T_ac = T_ab + B(h_ab) T_bc,        T_ab = B(-h_wa) (T_wb - T_wa).
"""

import numpy as np


def wrap(angle: np.ndarray) -> np.ndarray:
    """Angles in (-pi, pi] that are equivalent to `angle`, rad, of any shape.

    >>> wrap([1.5 * np.pi, 2.0]).round(3)
    array([-1.571,  2.   ])
    """
    angle = np.asarray(angle, dtype=float)
    wrapped = np.pi - np.mod(np.pi - angle, 2 * np.pi)
    return np.where(wrapped <= -np.pi, np.pi, wrapped)         # np.mod can round up to 2 pi


def rotation(heading: np.ndarray) -> np.ndarray:
    """Rotation matrices R(heading), (..., 2, 2), of headings (...)."""
    c = np.cos(heading)
    s = np.sin(heading)
    R = np.empty(np.shape(heading) + (2, 2))
    R[..., 0, 0] = c
    R[..., 0, 1] = -s
    R[..., 1, 0] = s
    R[..., 1, 1] = c
    return R


def compose(T_ab: np.ndarray, T_bc: np.ndarray) -> np.ndarray:
    """T_ac = T_ab T_bc, (..., 3).

    >>> compose([1, 0, np.pi / 2], [2, 0, 0]).round(3)
    array([1.   , 2.   , 1.571])
    """
    T_ab = np.asarray(T_ab, dtype=float)
    return T_ab + _turned(T_bc, T_ab[..., 2])


def inverse(T_ab: np.ndarray) -> np.ndarray:
    """T_ba, (..., 3), the inverse of T_ab."""
    return between(T_ab, np.zeros(3))


def between(T_wa: np.ndarray, T_wb: np.ndarray) -> np.ndarray:
    """T_ab = inverse(T_wa) T_wb, (..., 3), the pose of b in a.

    >>> between([1, 0, np.pi / 2], [1, 2, np.pi / 2]).round(3)
    array([2., 0., 0.])
    """
    T_wa = np.asarray(T_wa, dtype=float)
    return _turned(T_wb - T_wa, -T_wa[..., 2])


def difference(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """first - second, (..., 3), with the difference of the headings in (-pi, pi]."""
    r = np.subtract(first, second, dtype=float)
    r[..., 2] = wrap(r[..., 2])
    return r


def compose_with_jacobians(T_ab: np.ndarray, T_bc: np.ndarray) -> tuple[np.ndarray, ...]:
    """T_ac = T_ab T_bc, (..., 3), and its derivatives by T_ab and T_bc, each (..., 3, 3)."""
    T_ab = np.asarray(T_ab, dtype=float)
    lever = _turned(T_bc, T_ab[..., 2])                  # position of c from b, in axes of a
    by_first = _identity(lever.shape)
    by_first[..., 0, 2] = -lever[..., 1]
    by_first[..., 1, 2] = lever[..., 0]
    by_second = _identity(lever.shape)
    by_second[..., :2, :2] = rotation(T_ab[..., 2])
    return T_ab + lever, by_first, by_second


def compose_jacobians(T_ab: np.ndarray, T_bc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of compose, d T_ac / d T_ab and d T_ac / d T_bc, each (..., 3, 3)."""
    return compose_with_jacobians(T_ab, T_bc)[1:]


def by_left_perturbation(T: np.ndarray) -> np.ndarray:
    """Derivatives (..., 3, 3) of exp(xi) T by a tangent vector xi at 0, of motions T (..., 3)."""
    return compose_jacobians(np.zeros(3), T)[0]


def compose_uncertain(T_ab: np.ndarray, C_ab: np.ndarray, T_bc: np.ndarray,
                      C_bc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T_ac, (..., 3), and its covariance (..., 3, 3), by independent motions and covariances."""
    T_ac, A, B = compose_with_jacobians(T_ab, T_bc)
    return T_ac, A @ C_ab @ A.mT + B @ C_bc @ B.mT


def between_with_jacobians(T_wa: np.ndarray, T_wb: np.ndarray) -> tuple[np.ndarray, ...]:
    """T_ab = inverse(T_wa) T_wb, (..., 3), and its derivatives by T_wa and T_wb, (..., 3, 3)."""
    T_ab = between(T_wa, T_wb)
    by_second = _identity(T_ab.shape)
    by_second[..., :2, :2] = rotation(-np.asarray(T_wa)[..., 2])
    by_first = -by_second
    by_first[..., 0, 2] = T_ab[..., 1]
    by_first[..., 1, 2] = -T_ab[..., 0]
    return T_ab, by_first, by_second


def between_jacobians(T_wa: np.ndarray, T_wb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of between, d T_ab / d T_wa and d T_ab / d T_wb, each (..., 3, 3)."""
    return between_with_jacobians(T_wa, T_wb)[1:]


def log(T: np.ndarray) -> np.ndarray:
    """Logarithm (..., 3) of motions T (..., 3), the constant velocity that yields T in unit time.

    It is [a x + h y / 2, -h x / 2 + a y, h] with the wrapped heading h and a = (h / 2) cot(h / 2).
    GTSAM computes the error of its between factors with it (`Pose2::Logmap`).
    """
    return log_with_jacobian(T)[0]


def log_with_jacobian(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`log` of motions T (..., 3), and its derivative by [x, y, heading], (..., 3, 3)."""
    T = np.asarray(T, dtype=float)
    x = T[..., 0]
    y = T[..., 1]
    h = wrap(T[..., 2])
    a = np.cos(h / 2) / np.sinc(h / (2 * np.pi))             # (h / 2) cot(h / 2)
    small = np.abs(h) < 1e-3                                 # there the derivative of a cancels
    safe = np.where(small, 1.0, h)
    quotient = (a - a**2 - h**2 / 4) / safe
    a_by_h = np.where(small, -h / 6, quotient)
    jacobian = _identity(T.shape)
    jacobian[..., 0, 0] = a
    jacobian[..., 0, 1] = h / 2
    jacobian[..., 0, 2] = a_by_h * x + y / 2
    jacobian[..., 1, 0] = -h / 2
    jacobian[..., 1, 1] = a
    jacobian[..., 1, 2] = a_by_h * y - x / 2
    return _poses(a * x + h * y / 2, a * y - h * x / 2, h), jacobian


def rotate_covariance(covariance: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """B C B^T, covariances C (..., 3, 3) of [x, y, heading] rotated from axes of b to those of a.

    B rotates x and y by `heading` (...), that of b in a, in rad.
    """
    B = _identity(np.shape(heading) + (3,))
    B[..., :2, :2] = rotation(heading)
    return B @ covariance @ B.mT


def sigmas(covariances: np.ndarray) -> np.ndarray:
    """Standard deviations (n, d) of covariances (n, d, d)."""
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))


def correlations(covariances: np.ndarray) -> np.ndarray:
    """Correlation matrices (n, d, d) of covariances (n, d, d); NaN where a variance is zero."""
    sigma = sigmas(covariances)
    scale = sigma[..., :, None] * sigma[..., None, :]
    unknown = np.full_like(scale, np.nan)
    return np.divide(covariances, scale, out=unknown, where=scale > 0)


def are_regular(covariances: np.ndarray) -> np.ndarray:
    """True (n,) where covariances (n, d, d) are finite and, as correlations, not singular."""
    rho = correlations(covariances)
    found = np.isfinite(rho).all(axis=(1, 2))
    smallest = np.linalg.eigvalsh(rho[found])[:, 0]
    found[found] = smallest > 1e-12
    return found


def squared_distances(first: np.ndarray, second: np.ndarray,
                      covariance: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distances (...) of poses (..., 3) whose difference has a covariance."""
    return squared_norms(difference(first, second), covariance)


def squared_norms(r: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """r^T C^-1 r, (...), of residuals r (..., d) with covariances C (..., d, d)."""
    weighted = np.linalg.solve(covariance, r[..., None])[..., 0]
    return np.vecdot(r, weighted)


def _turned(T, heading):
    """B(heading) T, poses T (..., 3) with positions rotated by headings (...)."""
    T = np.asarray(T)
    x = T[..., 0]
    y = T[..., 1]
    c = np.cos(heading)
    s = np.sin(heading)
    turned_x = c * x - s * y
    turned_y = s * x + c * y
    return _poses(turned_x, turned_y, T[..., 2])


def _poses(x, y, heading):
    """Poses (..., 3), filled in place because np.stack is several times slower on small arrays."""
    T = np.empty(np.shape(x) + (3,))
    T[..., 0] = x
    T[..., 1] = y
    T[..., 2] = heading
    return T


def _identity(shape):
    """Identity matrices (..., 3, 3), one for each pose of an array of this shape, (..., 3)."""
    return np.full(shape + (3,), np.eye(3))
