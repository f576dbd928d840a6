"""Stage 7: covariances at the solution: jointly of consecutive frames and w, and of each landmark.

The information matrix of the graph has an arrow's shape. The poses form a chain T, with 3 x 3
blocks on and beside the diagonal. Landmarks, z and w form a border (B, D) that touches all of it:

    [[T, B], [B^T, D]]^-1:    border     S = (D - B^T Y)^-1,   Y = T^-1 B,
                              poses      T^-1 + Y S Y^T,       poses and border  -Y S.

Only the blocks of T^-1 on and beside the diagonal are needed. One forward and one backward sweep
give them (Kaess and Dellaert, Robotics and Autonomous Systems 57(12), 2009). GTSAM's marginals are
the same numbers, one query at a time; a test compares them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import csr_matrix

from slamlib.slam.linear_factors import linear_factors
from slamlib.slam.measurement_factors import GUESS_PRIOR_SIGMA, WEAK_SIGMA


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances in GTSAM's axes, those of each pose itself."""

    pairs: np.ndarray        # (f-1, 9, 9) of [X_i, X_{i+1}, w]
    markers: list            # k of (3, 3), or (2, 2) for a point
    antennas: np.ndarray     # (a, 2, 2)
    z: np.ndarray            # (2, 2) of the ranges' offset and scale, zero if they are given
    w: np.ndarray            # (3, 3)


def covariances(problem, state):
    """The Covariances of a Problem at the State that solves it."""
    m = problem.measurements
    size = np.r_[np.where(m.oriented, 3, 2), np.full(len(m.antenna), 2), 2 * m.calibrated, 3]
    begin = np.cumsum(size) - size                     # columns of the border
    prior, antennas = np.zeros(begin[-1] + 3), len(m.marker) + len(m.antenna)
    for j in problem.measured.unsupported:
        prior[begin[j]:begin[j] + size[j]] = WEAK_SIGMA**-2
    prior[begin[len(m.marker)]:begin[antennas]] = GUESS_PRIOR_SIGMA**-2
    prior[begin[antennas]:] = 1
    measured = [_of_border(factors, begin, m.calibrated)
                for factors in linear_factors(problem.measured, problem.noise, state)]
    _, odometry = problem.odometry_jacobians(state)
    pairs, border = arrow_inverse(odometry, measured, np.diag(m.origin_sigma**-2.0), prior)
    blocks = [border[b:b + n, b:b + n] for b, n in zip(begin, size)]
    return Covariances(
        pairs=pairs, markers=blocks[:len(m.marker)],
        antennas=np.reshape(blocks[len(m.marker):antennas], (-1, 2, 2)),
        z=blocks[antennas] if m.calibrated else np.zeros((2, 2)), w=blocks[-1])


def _of_border(factors, begin, calibrated):
    """Frames, columns of the border, and derivatives by pose and border, of LinearFactors."""
    width = factors.by_landmark.shape[2]
    columns = [begin[factors.landmark, None] + np.arange(width)]
    by_border = [factors.by_landmark]
    if calibrated and factors.by_calibration is not None:
        columns.append(np.broadcast_to(begin[-2] + np.arange(2), (len(factors.row), 2)))
        by_border.append(factors.by_calibration)
    return (factors.row, np.concatenate(columns, axis=1), factors.by_pose,
            np.concatenate(by_border, axis=2))


def arrow_inverse(odometry, measured, pose_prior, border_prior):
    """Covariances (f-1, 9, 9) of [X_i, X_{i+1}, w], and (c, c) of landmarks, z, then w.

    Parameters
    ----------
    odometry : whitened derivatives by X_i, X_{i+1} and w, each (f-1, 3, 3).
    measured : for each kind of measurement the frame (m,), the landmark's columns of the border
        (m, d), and whitened derivatives by pose (m, e, 3) and by landmark (m, e, d).
    pose_prior, border_prior : information of pose 1 (3, 3), and of the border, a diagonal (c,).
    """
    first, second, by_w = odometry
    count, width = len(first) + 1, len(border_prior)
    diagonal, beside = np.zeros((count, 3, 3)), _t(first) @ second
    diagonal[:-1] += _t(first) @ first
    diagonal[1:] += _t(second) @ second
    diagonal[0] += pose_prior
    B, D = np.zeros((count, 3, width)), np.diag(border_prior)
    for row, columns, by_pose, by_landmark in measured:
        np.add.at(diagonal, row, _t(by_pose) @ by_pose)
        np.add.at(B, (row[:, None, None], np.arange(3)[:, None], columns[:, None, :]),
                  _t(by_pose) @ by_landmark)
        np.add.at(D, (columns[:, :, None], columns[:, None, :]), _t(by_landmark) @ by_landmark)
    B[:-1, :, -3:] += _t(first) @ by_w
    B[1:, :, -3:] += _t(second) @ by_w
    D[-3:, -3:] += np.sum(_t(by_w) @ by_w, axis=0)

    B = B.reshape(3 * count, width)
    Y = cho_solve_banded((cholesky_banded(_banded(diagonal, beside), lower=True), True), B)
    border = np.linalg.inv(D - csr_matrix(B).T @ Y)
    border = (border + border.T) / 2
    on, off = _inverse_blocks(diagonal, beside)
    Y, YS = Y.reshape(count, 3, width), (Y @ border).reshape(count, 3, width)
    on += YS @ _t(Y)
    off += YS[:-1] @ _t(Y[1:])
    return _pairs(on, off, -YS[:, :, -3:], border[-3:, -3:]), border


def _pairs(on, off, with_w, w):
    """(f-1, 9, 9) of the blocks of poses, of consecutive poses, of poses with w, and of w."""
    pairs = np.empty((len(off), 9, 9))
    pairs[:, :3, :3], pairs[:, 3:6, 3:6], pairs[:, 6:, 6:] = on[:-1], on[1:], w
    pairs[:, :3, 3:6], pairs[:, 3:6, :3] = off, _t(off)
    pairs[:, :3, 6:], pairs[:, 6:, :3] = with_w[:-1], _t(with_w[:-1])
    pairs[:, 3:6, 6:], pairs[:, 6:, 3:6] = with_w[1:], _t(with_w[1:])
    return pairs


def _banded(diagonal, beside):
    """Lower bands (6, 3 n) of the block tridiagonal matrix, in LAPACK's layout."""
    n = len(diagonal)
    bands = np.zeros((6, 3 * n))
    for i in range(3):
        for j in range(i + 1):
            bands[i - j, j::3] = diagonal[:, i, j]
        for j in range(3):
            bands[3 + i - j, j:3 * (n - 1):3] = beside[:, j, i]
    return bands


def _inverse_blocks(diagonal, beside):
    """Blocks on (n, 3, 3) and beside (n-1, 3, 3) the diagonal of the inverse."""
    n = len(diagonal)
    pivot = np.empty_like(diagonal)                             # inverse of what elimination leaves
    pivot[0] = np.linalg.inv(diagonal[0])
    for i in range(1, n):
        pivot[i] = np.linalg.inv(diagonal[i] - beside[i - 1].T @ pivot[i - 1] @ beside[i - 1])
    gain = pivot[:-1] @ beside
    on, off = pivot.copy(), np.empty_like(beside)
    for i in range(n - 2, -1, -1):
        off[i] = -gain[i] @ on[i + 1]
        on[i] -= off[i] @ gain[i].T
    return on, off


def _t(matrices):
    return np.swapaxes(matrices, -1, -2)
