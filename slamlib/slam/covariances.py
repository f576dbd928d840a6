"""Stage 7: marginal covariances at the solution, of frames, landmarks and calibration.

Given landmarks and calibration, b, the frames are a Markov chain. With the information T about the
frames (block tridiagonal), E between them and b, and F about b,

    Cov(b) = (F - E^T T^-1 E)^-1 = C C^T,    Cov(frames) = T^-1 + M M^T,    M = T^-1 E C,

and the blocks of T^-1 between neighbours follow by cyclic reduction (`chain_inverse`). All
sums are of positive terms. GTSAM's marginals are the same numbers, one query at a time; a test
compares them.

The result averages them over the points of the noise posterior (`posterior_moments`). With
probability p_k of point k, x_k its solution and C_k its covariance, the moments are

    x = sum p_k x_k,    C = sum p_k (C_k + (x_k - x) (x_k - x)^T),

in the tangent space at the state that solves the problem of greatest posterior density.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.sparse import csc_array, hstack

from slamlib import se2
from slamlib.dataset import DatasetError
from slamlib.slam.calibration import WHEELS
from slamlib.slam.linear import laplace_approximation, retract

COLUMNS_AT_ONCE = 128        # columns of M that are held in memory
MAX_ROUNDING = 0.05          # float rounding: share of the information about the heading at pose 1


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances, of poses and markers in their own axes, else in world axes."""

    pairs: np.ndarray        # (f-1, 9, 9) of [X_i, X_{i+1}, wheel parameters], wheels in m
    markers: list            # k of (3, 3), or (2, 2) for a point
    antennas: np.ndarray     # (a, 2, 2)
    c: np.ndarray            # (p, p) of the calibration, 0 where it is known


def marginal_covariances(equations, noise):
    """The Covariances for a Noise by NormalEquations at the State that solves the problem.

    Raises DatasetError if float rounding hides the information about the heading at pose 1, and
    numpy.linalg.LinAlgError if the equations are singular.
    """
    problem, structure = equations.problem, equations.structure
    v, active, n = problem.measurements.variables, problem.active, len(structure.diagonal)
    data, border, *_ = equations.sums(noise)
    H = structure.matrix(data)
    _require_digits(equations, H)
    frames, others = np.split(structure.unknowns, [3 * len(v.frames)])
    of_others, B = H[:, others], border[others, :-1]
    E = csc_array(hstack([of_others[frames], border[frames, :-1]]))
    F = np.block([[of_others[others].toarray(), B], [B.T, border[n:, :-1]]])
    chain, chunks = structure.chain(data, v.frames), [
        slice(i, i + COLUMNS_AT_ONCE) for i in range(0, max(1, len(F)), COLUMNS_AT_ONCE)]
    for chunk in chunks:
        F[:, chunk] -= E.T @ np.concatenate(chain_inverse(*chain, E[:, chunk].toarray())[2])
    C = solve_triangular(np.linalg.cholesky(F), np.eye(len(F)), lower=True).T
    by_c = np.zeros((len(active), len(F)))
    by_c[active] = problem.sigma[active, None] * C[len(others):]
    c = by_c @ by_c.T
    own, joint, wheels = np.zeros((3, len(v.frames), 3, 3))
    for chunk in chunks:
        given, given_joint, M = chain_inverse(*chain, E @ -C[:, chunk])
        own += M @ M.mT
        joint[:-1] += M[:-1] @ M[1:].mT
        wheels += M @ by_c[WHEELS, chunk].T
    own, joint = own + (given + given.mT) / 2, joint[:-1] + given_joint
    of_wheels = np.broadcast_to(c[WHEELS, WHEELS], joint.shape)
    pairs = np.block([[own[:-1], joint, wheels[:-1]], [joint.mT, own[1:], wheels[1:]],
                      [wheels[:-1].mT, wheels[1:].mT, of_wheels]])
    width = 2 + structure.is_pose[len(v.frames):]
    blocks = [part @ part.T for part in np.split(C, np.cumsum(width))[:-1]]
    return Covariances(pairs=pairs, markers=blocks[:len(v.markers)],
                       antennas=np.reshape(blocks[len(v.markers):], (-1, 2, 2)), c=c)


def chain_inverse(D, upper, right):
    """Blocks of T^-1 on the diagonal (f, 3, 3) and above (f-1, 3, 3), and T^-1 `right` (f, 3, w).

    T is block tridiagonal, with the blocks D (f, 3, 3) on the diagonal and `upper` (f-1, 3, 3)
    above; `right` is (3 f, w). Every second one is eliminated, given its neighbours (cyclic
    reduction: Golub and Van Loan, Matrix Computations, 2013, section 4.5).
    """
    count, right = len(D), right.reshape(len(D), 3, -1)
    if count < 3:
        whole = np.block([[D[0], upper[0]], [upper[0].T, D[1]]]) if count == 2 else D[0]
        inverse = np.linalg.inv(whole)
        blocks = inverse.reshape(count, 3, count, 3).swapaxes(1, 2)
        return (blocks[range(count), range(count)], blocks[range(count - 1), range(1, count)],
                (inverse @ np.concatenate(right)).reshape(right.shape))
    if not count % 2:                                        # one more, which is independent
        D = np.concatenate([D, np.eye(3)[None]])
        upper, right = (np.pad(each, ((0, 1), (0, 0), (0, 0))) for each in (upper, right))
    left, following, inverse = upper[::2], upper[1::2], np.linalg.inv(D[1::2])
    K, solved = inverse @ np.concatenate([left.mT, following], axis=2), inverse @ right[1::2]
    rest, x = D[::2].copy(), np.empty_like(right)
    x[::2] = right[::2]
    for to_odd, of_odd, own, own_x in ((left, K[:, :, :3], rest[:-1], x[:-1:2]),
                                       (following.mT, K[:, :, 3:], rest[1:], x[2::2])):
        own -= to_odd @ of_odd
        own_x -= to_odd @ solved
    diagonal, above = np.empty_like(D), np.empty_like(upper)
    diagonal[::2], joint, x[::2] = chain_inverse(rest, -left @ K[:, :, 3:], x[::2])
    S = np.block([[diagonal[:-1:2], joint], [joint.mT, diagonal[2::2]]])
    x[1::2] = solved - K[:, :, :3] @ x[:-1:2] - K[:, :, 3:] @ x[2::2]
    cross = -K @ S
    diagonal[1::2] = inverse - cross @ K.mT
    above[::2], above[1::2] = cross[:, :, :3].mT, cross[:, :, 3:]
    return diagonal[:count], above[:count - 1], x[:count]


def _require_digits(equations, H):
    """Raise DatasetError if rounding in the information matrix H hides the prior of the heading.

    A common rotation of all poses and landmarks about pose 1 changes no measurement of the files:
    only priors and factors of one's own have information about it. Any more in H is rounding.
    """
    m, turn = equations.problem.measurements, _common_turn(equations)
    own, pairs = equations.linearized[-1].J, m.structure.factors[-1]
    known = equations.priors.H @ turn**2 + np.sum(
        (own @ turn[m.structure.rows(pairs.ravel())].reshape(-1, 6, 1))**2)
    rounding, sigma = turn @ (H @ turn) - known, m.origin_sigma[2]
    if abs(rounding) * sigma**2 > MAX_ROUNDING:
        raise DatasetError(
            f"{m.dataset.name}: expected measurements beside which sigma_heading = {sigma:g} rad "
            "(vehicle.toml, or the assignment's table 2) is not lost in rounding; their standard "
            "deviations are too small for it")


def _common_turn(equations):
    """Change (n,) of all unknowns per rad of a rotation of poses and landmarks about the origin."""
    state, structure = equations.state, equations.structure
    poses = np.concatenate([state.poses, state.markers, np.pad(state.antennas, ((0, 0), (0, 1)))])
    lever = np.stack([-poses[:, 1], poses[:, 0]], -1)
    turn = np.empty(len(structure.diagonal))
    turn[structure.rows(slice(None))] = np.c_[
        (se2.rotation(-poses[:, 2]) @ lever[:, :, None])[..., 0], structure.is_pose]
    return turn


def posterior_moments(fit):
    """Mean State, Covariances, and root mean square of the slip in sqrt(m), of a Fit.

    Raises DatasetError and LinAlgError as `marginal_covariances`.
    """
    noise, equations = fit.problem.noise, fit.equations
    if fit.posterior is None:
        return fit.state, marginal_covariances(equations, noise), noise.slip
    weights, noises = zip(*fit.posterior.points)
    weights = np.array(weights) / sum(weights)
    slip = np.sqrt(weights @ np.square([point.slip for point in noises]))
    conditional = [marginal_covariances(equations, point) for point in noises]
    if len(noises) == 1:
        return fit.state, conditional[0], slip
    x = np.stack([laplace_approximation(equations, point)[0] for point in noises])
    x -= laplace_approximation(equations, noise)[0]
    mean = weights @ x
    return (retract(fit.problem, fit.state, mean),
            _averaged(fit.problem, conditional, x - mean, weights), slip)


def _averaged(problem, conditional, x, weights):
    """The Covariances averaged over points, with solutions x (p, n + q) about the mean."""
    structure, v = problem.measurements.structure, problem.measurements.variables
    c = len(structure.diagonal) + np.arange(len(problem.sigma))
    off = np.zeros((len(x), c[-1] + 1))                    # also of what is known of c
    off[:, np.r_[:c[0], c[problem.active]]] = x
    off[:, c] *= problem.sigma

    def averaged(blocks, rows):
        """sum p_k (C_k + x_k x_k^T) of blocks p of (..., d, d) at rows (..., d)."""
        x_k = off[:, rows]
        return np.einsum("p,p...->...", weights,
                         np.stack([*blocks]) + x_k[..., :, None] * x_k[..., None, :])

    frames = structure.rows(v.frames)
    pairs = [frames[:-1], frames[1:], np.broadcast_to(c[WHEELS], frames[1:].shape)]
    return Covariances(
        pairs=averaged((C.pairs for C in conditional), np.concatenate(pairs, axis=1)),
        markers=[averaged((C.markers[j] for C in conditional), rows)
                 for j, rows in enumerate(structure.rows_of_each(v.markers))],
        antennas=averaged((C.antennas for C in conditional), structure.rows(v.antennas, 2)),
        c=averaged((C.c for C in conditional), c))
