"""Stage 7: marginal covariances at the solution, of frames, landmarks and calibration.

Given landmarks and calibration, b, the frames are a Markov chain. With the information T about the
frames (block tridiagonal), E between them and b, and F about b,

    Cov(b) = (F - E^T T^-1 E)^-1 = C C^T,    Cov(frames) = T^-1 + M M^T,    M = T^-1 E C,

and the blocks of T^-1 between neighbours follow from a banded Cholesky decomposition of T. All sums
are of positive terms. GTSAM's marginals are the same numbers, one query at a time; a test compares
them.

The result averages them over the points of the noise posterior (`posterior_moments`). With
probability p_k of point k, x_k its solution and C_k its covariance, the moments are

    x = sum p_k x_k,    C = sum p_k (C_k + (x_k - x) (x_k - x)^T),

in the tangent space at the state that solves the problem of greatest posterior density.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky_banded, solve_triangular
from scipy.sparse import block_array, csc_array

from slamlib.robust.calibration import WHEELS
from slamlib.robust.linear import NormalEquations, laplace_approximation, retract

COLUMNS_AT_ONCE = 256        # columns of M that are held in memory


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances, of poses and markers in their own axes, else in world axes."""

    pairs: np.ndarray        # (f-1, 9, 9) of [X_i, X_{i+1}, wheel parameters], wheels in m
    landmarks: np.ndarray    # (k + a, 3, 3) of markers and antennas; of a point (2, 2) counts
    c: np.ndarray            # (p, p) of the calibration, 0 where it is known


def marginal_covariances(equations, noise):
    """The Covariances for a Noise by NormalEquations at the State that solves the problem.

    Raises numpy.linalg.LinAlgError if the equations are singular.
    """
    problem, structure, active = equations.problem, equations.structure, equations.problem.active
    sums = equations.sums(noise)
    border = sums.border
    H, n, q = structure.matrix(sums.H), len(structure.diagonal), active.sum()
    B, D = csc_array(border[:n, :-1]), csc_array(border[n:, :-1])
    rows = structure.rows(slice(None)).ravel()
    frames, others = np.split(np.r_[rows, n:n + q], [3 * len(problem.measurements.frame)])
    of_others = block_array([[H, B], [B.T, D]], format="csc")[:, others]
    E, F = of_others[frames], of_others[others].toarray()
    solve, own, joint = _chain_inverse(H[frames][:, frames])
    chunks = [slice(i, i + COLUMNS_AT_ONCE) for i in range(0, len(F), COLUMNS_AT_ONCE)]
    for chunk in chunks:
        F[:, chunk] -= E.T @ solve(E[:, chunk].toarray())
    C = solve_triangular(np.linalg.cholesky(F), np.eye(len(F)), lower=True).T
    of_landmarks, of_c = np.split(C, [len(F) - q])
    by_c, wheels = np.zeros((len(active), len(F))), np.zeros_like(own)
    by_c[active] = problem.sigma[active, None] * of_c
    for chunk in chunks:
        M = solve(E @ C[:, chunk]).reshape(own.shape[:2] + (-1,))
        own += M @ M.mT
        joint += M[:-1] @ M[1:].mT
        wheels -= M @ by_c[WHEELS, chunk].T
    c, of_landmarks = by_c @ by_c.T, of_landmarks.reshape(-1, 3, len(F))
    of_wheels = np.broadcast_to(c[WHEELS, WHEELS], joint.shape)
    pairs = np.block([[own[:-1], joint, wheels[:-1]], [joint.mT, own[1:], wheels[1:]],
                      [wheels[:-1].mT, wheels[1:].mT, of_wheels]])
    return Covariances(pairs=pairs, landmarks=of_landmarks @ of_landmarks.mT, c=c)


def _chain_inverse(T):
    """Function from b (3 f, w) to T^-1 b; blocks of T^-1 (f, 3, 3), and (f-1, 3, 3) above these.

    T (3 f, 3 f) is block tridiagonal. With its Cholesky factor L and W = L_{i+1,i} L_ii^-1 it is
    eliminated and substituted back block by block. The blocks are

        Z_ii = L_ii^-T L_ii^-1 + W^T Z_{i+1,i+1} W,    Z_{i,i+1} = -W^T Z_{i+1,i+1}

    (Takahashi, Fagan and Chin, Formation of a sparse bus impedance matrix, PICA 1973).
    """
    bands = [np.pad(T.diagonal(-k), (0, k))[:T.shape[0]] for k in range(6)]
    L = cholesky_banded(bands, lower=True)
    i, j = np.indices((3, 3))
    blocks = L.reshape(6, -1, 3)
    inverse = np.linalg.inv(np.tril(blocks[np.maximum(i - j, 0), :, j].transpose(2, 0, 1)))
    W = (blocks[3 + i - j, :, j].transpose(2, 0, 1) @ inverse)[:-1]
    Z = inverse.mT @ inverse
    for k in reversed(range(len(W))):
        Z[k] += W[k].T @ Z[k + 1] @ W[k]
    Z = (Z + Z.mT) / 2

    def solve(b):
        x = b.reshape(len(inverse), 3, -1).copy()
        for k, step in enumerate(W):
            x[k + 1] -= step @ x[k]
        x = inverse.mT @ (inverse @ x)
        for k in reversed(range(len(W))):
            x[k] -= W[k].T @ x[k + 1]
        return x.reshape(b.shape)

    return solve, Z, -W.mT @ Z[1:]


def posterior_moments(fit):
    """Mean State, Covariances, and root mean square of the slip in sqrt(m), of a Fit.

    Raises LinAlgError as `marginal_covariances`.
    """
    problem, equations = fit.problem, NormalEquations(fit.problem, fit.state)
    weights, noises = zip(*fit.posterior.points) if fit.posterior else ((1.0,), (problem.noise,))
    weights = np.array(weights) / sum(weights)
    slip = np.sqrt(weights @ np.square([point.slip for point in noises]))
    conditional = [marginal_covariances(equations, point) for point in noises]
    if noises == (problem.noise,):
        return fit.state, conditional[0], slip
    x = np.stack([laplace_approximation(equations, point)[0] for point in noises])
    x -= laplace_approximation(equations, problem.noise)[0]
    mean, structure, n = weights @ x, equations.structure, len(equations.structure.diagonal)
    off = np.zeros((len(x), n + len(problem.sigma)))         # from the mean; 0 of what is known
    off[:, np.r_[:n, n + np.flatnonzero(problem.active)]] = x - mean
    off[:, n:] *= problem.sigma

    def averaged(blocks, rows):
        """sum p_k (C_k + x_k x_k^T) of blocks p of (..., d, d) at rows (..., d)."""
        x_k = off[:, rows]
        return np.einsum("p,p...->...", weights,
                         np.stack(blocks) + x_k[..., :, None] * x_k[..., None, :])

    c = n + np.arange(len(problem.sigma))
    frames, landmarks = np.split(structure.rows(slice(None)), [len(problem.measurements.frame)])
    pairs = [frames[:-1], frames[1:], np.broadcast_to(c[WHEELS], frames[1:].shape)]
    return retract(problem, fit.state, mean), Covariances(
        pairs=averaged([C.pairs for C in conditional], np.concatenate(pairs, axis=1)),
        landmarks=averaged([C.landmarks for C in conditional], landmarks),
        c=averaged([C.c for C in conditional], c)), slip
