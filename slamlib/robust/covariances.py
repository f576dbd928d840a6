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
from scipy.sparse import csc_array, hstack, vstack

from slamlib.robust.calibration import WHEELS
from slamlib.robust.fit import Fit
from slamlib.robust.linear import NormalEquations, State, laplace_approximation, retract
from slamlib.robust.measurements import Noise

COLUMNS_AT_ONCE = 256        # columns of M that are held in memory


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances, of poses and markers in their own axes, else in world axes."""

    pairs: np.ndarray        # (f-1, 9, 9) of [X_i, X_{i+1}, wheel parameters], wheels in m
    landmarks: np.ndarray    # (k + a, 3, 3) of markers and antennas; of a point (2, 2) counts
    c: np.ndarray            # (p, p) of the calibration, 0 where it is known


def marginal_covariances(equations: NormalEquations, noise: Noise) -> Covariances:
    """The Covariances for a Noise by NormalEquations at the State that solves the problem.

    Raises numpy.linalg.LinAlgError if the equations are singular.
    """
    problem = equations.problem
    structure = equations.structure
    sums = equations.sums(noise)
    n = len(structure.diagonal)
    H = structure.matrix(sums.H)
    border = csc_array(sums.border[:, :-1])
    information = hstack([vstack([H, border[:n].T]), border], format="csc")
    rows = np.append(structure.rows, np.arange(n, len(sums.border)))
    frames, others = np.split(rows, [3 * len(problem.measurements.frame)])
    of_others = information[:, others]
    E = of_others[frames]
    F = of_others[others].toarray()
    chain = _decomposed(information[frames][:, frames])
    chunks = [slice(i, i + COLUMNS_AT_ONCE) for i in range(0, len(F), COLUMNS_AT_ONCE)]
    for chunk in chunks:
        F[:, chunk] -= E.T @ chain.solve(E[:, chunk].toarray())
    C = solve_triangular(np.linalg.cholesky(F), np.eye(len(F)), lower=True).T
    size = len(F) - problem.active.sum()                 # of the landmarks
    of_landmarks = C[:size].reshape(-1, 3, len(F))
    of_c = problem.prior.of(slice(None)) @ C[size:]
    own, joint = chain.blocks()
    wheels = np.zeros_like(own)
    for chunk in chunks:
        M = chain.solve(E @ C[:, chunk]).reshape(len(own), 3, -1)
        own += M @ M.mT
        joint += M[:-1] @ M[1:].mT
        wheels -= M @ of_c[WHEELS, chunk].T
    c = of_c @ of_c.T
    of_wheels = np.broadcast_to(c[WHEELS, WHEELS], joint.shape)
    pairs = np.block([[own[:-1], joint, wheels[:-1]], [joint.mT, own[1:], wheels[1:]],
                      [wheels[:-1].mT, wheels[1:].mT, of_wheels]])
    return Covariances(pairs=pairs, landmarks=of_landmarks @ of_landmarks.mT, c=c)


@dataclass(frozen=True)
class _Chain:
    """The decomposition L D L^T of T (3 f, 3 f), block tridiagonal, with blocks (3, 3).

    L has identities on its diagonal, D is block diagonal.
    """

    inverse: np.ndarray      # (f, 3, 3) D_ii^-1
    W: np.ndarray            # (f-1, 3, 3) L_{i+1,i}

    def solve(self, b):
        """T^-1 b of b (3 f, w)."""
        y = b.reshape(len(self.inverse), 3, -1).copy()
        for k, W in enumerate(self.W):
            y[k + 1] -= W @ y[k]
        x = self.inverse @ y
        for k in reversed(range(len(self.W))):
            x[k] -= self.W[k].T @ x[k + 1]
        return x.reshape(b.shape)

    def blocks(self):
        """Blocks of T^-1, (f, 3, 3) on the diagonal and (f-1, 3, 3) above it.

        From the last one on they are

            Z_ii = D_ii^-1 + W^T Z_{i+1,i+1} W,    Z_{i,i+1} = -W^T Z_{i+1,i+1}

        (Takahashi, Fagan and Chin, Formation of a sparse bus impedance matrix, PICA 1973).
        """
        Z = self.inverse.copy()
        for k in reversed(range(len(self.W))):
            Z[k] += self.W[k].T @ Z[k + 1] @ self.W[k]
        Z = (Z + Z.mT) / 2
        return Z, -self.W.mT @ Z[1:]


def _decomposed(T):
    """The _Chain of T (3 f, 3 f)."""
    bands = [np.pad(T.diagonal(-k), (0, k))[:T.shape[0]] for k in range(6)]
    L = cholesky_banded(bands, lower=True).reshape(6, -1, 3)
    column = np.tile(np.arange(3), (3, 1))
    offset = column.T - column                           # of the row from the column
    diagonal = np.tril(L[np.abs(offset), :, column].transpose(2, 0, 1))
    below = L[3 + offset, :, column].transpose(2, 0, 1)
    inverse = np.linalg.inv(diagonal)
    return _Chain(inverse.mT @ inverse, (below @ inverse)[:-1])


def posterior_moments(fit: Fit) -> tuple[State, Covariances, float]:
    """Mean State, Covariances, and root mean square of the slip in sqrt(m), of a Fit.

    Raises LinAlgError as `marginal_covariances`.
    """
    problem = fit.problem
    equations = NormalEquations(problem, fit.state)
    points = fit.noise_points
    weights = [weight for weight, _ in points]
    slips = np.array([noise.slip for _, noise in points])
    slip = np.sqrt(np.average(slips**2, weights=weights))
    conditional = [marginal_covariances(equations, noise) for _, noise in points]
    if len(points) == 1 and points[0][1] == problem.noise:
        return fit.state, conditional[0], slip
    delta = np.stack([laplace_approximation(equations, noise)[0] for _, noise in points])
    delta -= laplace_approximation(equations, problem.noise)[0]
    mean = np.average(delta, axis=0, weights=weights)
    rows = equations.structure.rows
    is_unknown = np.append(np.ones(rows.size, bool), problem.active)
    off = np.zeros((len(points), len(is_unknown)))           # x_k - x; 0 of what is known
    off[:, is_unknown] = delta - mean
    off[:, rows.size:] = off[:, rows.size:] @ problem.prior.root.T

    def averaged(field, rows):
        """A field of the Covariances, C (..., d, d) of the unknowns at rows (..., d)."""
        x = off[:, rows]
        C = [getattr(covariances, field) for covariances in conditional]
        return np.average(C + x[..., :, None] * x[..., None, :], axis=0, weights=weights)

    c = np.arange(rows.size, len(is_unknown))
    frames, landmarks = np.split(rows, [len(problem.measurements.frame)])
    wheels = np.broadcast_to(c[WHEELS], frames[1:].shape)
    pairs = np.concatenate([frames[:-1], frames[1:], wheels], axis=1)
    covariances = Covariances(
        pairs=averaged("pairs", pairs), landmarks=averaged("landmarks", landmarks),
        c=averaged("c", c))
    return retract(problem, fit.state, mean), covariances, slip
