"""Planar rigid motions, batched: poses are arrays (..., 3) of [x, y, heading].

A pose is read as the frame change T_ab that takes coordinates in b to coordinates in a,

    p_a = R(heading) p_b + [x, y],        R(h) = [[cos h, -sin h], [sin h, cos h]],

so that frames cancel when read: compose(T_ab, T_bc) = T_ac and between(T_wa, T_wb) = T_ab.
Every function broadcasts over the leading dimensions. Jacobians are the partial derivatives of
the three coordinates [x, y, heading], not of a tangent vector: they carry covariances of
[x, y, heading] as this package stores them. Headings are added and subtracted but never wrapped;
call `wrap` where an angle must lie in (-pi, pi].
"""

import numpy as np


def wrap(angle):
    """Angle in radians, any shape, brought to (-pi, pi]."""
    wrapped = np.pi - np.mod(np.pi - np.asarray(angle, dtype=float), 2 * np.pi)
    return np.where(wrapped <= -np.pi, np.pi, wrapped)         # a remainder rounded up to 2 pi


def rotation(heading):
    """Rotation matrices R(heading), shape heading.shape + (2, 2)."""
    c, s = np.cos(heading), np.sin(heading)
    R = np.empty(np.shape(heading) + (2, 2))
    R[..., 0, 0] = R[..., 1, 1] = c
    R[..., 0, 1], R[..., 1, 0] = -s, s
    return R


def compose(T_ab, T_bc):
    """T_ac = T_ab T_bc, shape (..., 3), metres and radians."""
    T_ab, T_bc = np.asarray(T_ab, dtype=float), np.asarray(T_bc, dtype=float)
    c, s = np.cos(T_ab[..., 2]), np.sin(T_ab[..., 2])
    x, y = T_bc[..., 0], T_bc[..., 1]
    return _poses(T_ab[..., 0] + c * x - s * y,
                  T_ab[..., 1] + s * x + c * y,
                  T_ab[..., 2] + T_bc[..., 2])


def inverse(T_ab):
    """T_ba, shape (..., 3)."""
    T_ab = np.asarray(T_ab, dtype=float)
    c, s = np.cos(T_ab[..., 2]), np.sin(T_ab[..., 2])
    x, y = T_ab[..., 0], T_ab[..., 1]
    return _poses(-c * x - s * y, s * x - c * y, -T_ab[..., 2])


def between(T_wa, T_wb):
    """T_ab = inverse(T_wa) T_wb, the pose of b seen from a, shape (..., 3)."""
    T_wa, T_wb = np.asarray(T_wa, dtype=float), np.asarray(T_wb, dtype=float)
    c, s = np.cos(T_wa[..., 2]), np.sin(T_wa[..., 2])
    dx, dy = T_wb[..., 0] - T_wa[..., 0], T_wb[..., 1] - T_wa[..., 1]
    return _poses(c * dx + s * dy, -s * dx + c * dy, T_wb[..., 2] - T_wa[..., 2])


def compose_jacobians(T_ab, T_bc):
    """Partial derivatives of compose: (d T_ac / d T_ab, d T_ac / d T_bc), each (..., 3, 3)."""
    shape = np.broadcast_shapes(np.shape(T_ab), np.shape(T_bc))
    T_ab, T_ac = np.broadcast_to(T_ab, shape), compose(T_ab, T_bc)
    lever = T_ac[..., :2] - T_ab[..., :2]                # position of c from b, in axes of a
    by_first = _identity(shape)
    by_first[..., 0, 2] = -lever[..., 1]
    by_first[..., 1, 2] = lever[..., 0]
    by_second = _identity(shape)
    by_second[..., :2, :2] = rotation(T_ab[..., 2])
    return by_first, by_second


def inverse_jacobian(T_ab):
    """Partial derivatives of inverse, d T_ba / d T_ab, shape (..., 3, 3)."""
    T_ab = np.asarray(T_ab, dtype=float)
    T_ba = inverse(T_ab)
    jacobian = -_identity(T_ab.shape)
    jacobian[..., :2, :2] = -rotation(T_ba[..., 2])
    jacobian[..., 0, 2] = T_ba[..., 1]
    jacobian[..., 1, 2] = -T_ba[..., 0]
    return jacobian


def between_jacobians(T_wa, T_wb):
    """Partial derivatives of between: (d T_ab / d T_wa, d T_ab / d T_wb), each (..., 3, 3)."""
    shape = np.broadcast_shapes(np.shape(T_wa), np.shape(T_wb))
    T_ab = between(T_wa, T_wb)
    world_in_a = rotation(-np.broadcast_to(T_wa, shape)[..., 2])
    by_second = _identity(shape)
    by_second[..., :2, :2] = world_in_a
    by_first = -by_second
    by_first[..., 0, 2] = T_ab[..., 1]
    by_first[..., 1, 2] = -T_ab[..., 0]
    return by_first, by_second


def log(T):
    """Logarithm of a motion, the constant velocity that reaches it in unit time, (..., 3).

    With a = (h / 2) cot(h / 2) of the heading h, wrapped: [a x + h y / 2, -h x / 2 + a y, h]. It is
    the error of GTSAM's between factors (`Pose2::Logmap`).
    """
    T = np.asarray(T, dtype=float)
    h, x, y = wrap(T[..., 2]), T[..., 0], T[..., 1]
    a, _ = _half_cotangent(h)
    return np.stack([a * x + h * y / 2, -h * x / 2 + a * y, h], -1)


def log_jacobian(T):
    """Partial derivatives of log by [x, y, heading], (..., 3, 3)."""
    T = np.asarray(T, dtype=float)
    h, x, y = wrap(T[..., 2]), T[..., 0], T[..., 1]
    a, slope = _half_cotangent(h)
    jacobian = _identity(T.shape)
    jacobian[..., 0, 0], jacobian[..., 0, 1], jacobian[..., 0, 2] = a, h / 2, slope * x + y / 2
    jacobian[..., 1, 0], jacobian[..., 1, 1], jacobian[..., 1, 2] = -h / 2, a, slope * y - x / 2
    return jacobian


def _half_cotangent(h):
    """(h / 2) cot(h / 2) and its derivative by h, with their series near zero."""
    small = np.abs(h) < 1e-3
    half = np.where(small, 1.0, h / 2)
    a = np.where(small, 1 - h**2 / 12, half / np.tan(half))
    slope = np.where(small, -h / 6, (1 / np.tan(half) - half / np.sin(half)**2) / 2)
    return a, slope


def rotate_covariance(covariance, heading):
    """Covariance of [x, y, heading] expressed in axes turned by `heading`: B C B^T.

    Parameters
    ----------
    covariance : (..., 3, 3) covariance of [x, y, heading] in the axes of frame b.
    heading : (...) rad, heading of b in a.

    Returns
    -------
    (..., 3, 3) covariance of the same quantity with x and y along the axes of a.
    """
    B = _identity(np.shape(heading) + (3,))
    B[..., :2, :2] = rotation(heading)
    return B @ covariance @ np.swapaxes(B, -1, -2)


# Arrays are filled in place: np.stack takes several times as long on the many small ones.
def _poses(x, y, heading):
    T = np.empty(np.shape(x) + (3,))
    T[..., 0], T[..., 1], T[..., 2] = x, y, heading
    return T


def _identity(shape):
    matrices = np.zeros(shape[:-1] + (3, 3))
    for i in range(3):
        matrices[..., i, i] = 1
    return matrices
