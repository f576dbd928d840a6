"""Covariances of the SLAM graph: of every two consecutive poses with w, and of the landmarks.

The information matrix of the graph has an arrow's shape: the poses form a chain (3 x 3 blocks on and
beside the diagonal, T), and landmarks and w a border (B, D) that touches all of it,

    [[T, B], [B^T, D]]^-1:    border     S = (D - B^T Y)^-1,   Y = T^-1 B,
                              poses      T^-1 + Y S Y^T,       poses and border  -Y S.

Of T^-1 only the blocks on and beside the diagonal are needed; a forward and a backward sweep give
them. GTSAM's marginals are the same numbers, one query at a time; a test compares them.
"""

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded


def marginals(odometry, measured, prior):
    """Covariances of consecutive poses with w, and of the border: all landmarks, then w.

    Parameters
    ----------
    odometry : (first, second, by_w), each (f-1, 3, 3), whitened derivatives of the odometry factors.
    measured : list of (row, columns, by_pose, by_landmark), one for each kind of measurement, with
        the pose (m,), the landmark's columns of the border (m, d), and whitened derivatives
        (m, e, 3), (m, e, d).
    prior : information of pose 1 (3, 3), and of the border, its diagonal (c,).

    Returns
    -------
    joint : (f-1, 9, 9) covariance of [X_i, X_{i+1}, w] in GTSAM's axes.
    border : (c, c) covariance of the landmarks, then w.
    """
    first, second, by_w = odometry
    of_first, of_border = prior
    count, width = len(first) + 1, len(of_border)
    diagonal, beside = np.zeros((count, 3, 3)), _t(first) @ second
    diagonal[:-1] += _t(first) @ first
    diagonal[1:] += _t(second) @ second
    diagonal[0] += of_first
    B, D = np.zeros((count, 3, width)), np.diag(of_border)
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
    border = np.linalg.inv(D - B.T @ Y)
    border = (border + border.T) / 2
    on, off = _inverse_blocks(diagonal, beside)
    Y = Y.reshape(count, 3, -1)
    YS = Y @ border
    on += YS @ _t(Y)
    off += YS[:-1] @ _t(Y[1:])
    with_w = -YS[:, :, -3:]
    joint = np.empty((count - 1, 9, 9))
    joint[:, :3, :3], joint[:, 3:6, 3:6], joint[:, 6:, 6:] = on[:-1], on[1:], border[-3:, -3:]
    joint[:, :3, 3:6], joint[:, 3:6, :3] = off, _t(off)
    joint[:, :3, 6:], joint[:, 6:, :3] = with_w[:-1], _t(with_w[:-1])
    joint[:, 3:6, 6:], joint[:, 6:, 3:6] = with_w[1:], _t(with_w[1:])
    return joint, border


def _banded(diagonal, beside):
    """Lower bands (6, 3 n) of the block tridiagonal matrix, as LAPACK wants them."""
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
