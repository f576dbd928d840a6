"""Stage 7: marginal covariances at the solution, of frames, landmarks and calibration.

The inverse of the information matrix H is dense; only some of its blocks are computed, by nested
dissection. Every LEAF frames there is a separator. The unknowns that are connected only to unknowns
between two separators are eliminated there, which leaves a Schur complement on the front, the
unknowns around them. Two such parts are joined at the separator between them, and so on. With the
blocks H_ee of the eliminated unknowns and H_ef between them and the front, and K = H_ee^-1 H_ef,
the covariances follow from the front inwards:

    Cov(front) = S,    Cov(eliminated, front) = -K S,    Cov(eliminated) = H_ee^-1 + K S K^T

(Kaess and Dellaert, Robotics and Autonomous Systems 57(12), 2009). GTSAM's marginals are the same
numbers, one query at a time; a test compares them.

The result averages them over the points of the noise posterior (`posterior_moments`). With
probability p_k of point k, x_k its solution and C_k its covariance, the moments are

    x = sum p_k x_k,    C = sum p_k (C_k + (x_k - x) (x_k - x)^T),

in the tangent space at the state that solves the problem of greatest posterior density.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array

from slamlib import se2
from slamlib.dataset import DatasetError
from slamlib.slam.calibration import WHEELS
from slamlib.slam.linear import laplace_approximation, linear_solution
from slamlib.slam.problem import retract

LEAF = 12                    # number of frames between separators
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

    With the calibration c known, they are blocks of H^-1. An uncertain c of covariance S^-1 adds
    (H^-1 B) S^-1 (H^-1 B)^T (`linear`). Raises DatasetError if float rounding hides the information
    about the heading at pose 1, and numpy.linalg.LinAlgError if the equations are singular.
    """
    problem, structure = equations.problem, equations.structure
    m, v, active = problem.measurements, problem.measurements.variables, problem.active
    landmarks = structure.rows_of_each(np.r_[v.markers, v.antennas])
    pairs = rows_of_pairs(m)
    data, border, *_ = equations.sums(noise)
    H, solution = structure.matrix(data), linear_solution(structure, data, border)
    _require_digits(equations, H)
    if solution is None:
        raise np.linalg.LinAlgError("singular information matrix")
    of_pairs, blocks = selected_inverse(H, structure.rows(v.frames, 3), pairs, landmarks)
    sigma = problem.sigma[active]
    c = np.linalg.inv(solution.S)
    c = (c + c.T) / 2 * sigma[:, None] * sigma
    by_c = solution.by_c / -sigma                          # of the unknowns by c
    blocks = [block + by_c[rows] @ c @ by_c[rows].T for block, rows in zip(blocks, landmarks)]
    whole = np.zeros(2 * [len(active)])
    whole[np.ix_(active, active)] = c
    joint, cross = np.zeros((len(pairs), 9, 9)), by_c[pairs] @ c
    joint[:, :6, :6] = of_pairs + cross @ np.swapaxes(by_c[pairs], 1, 2)
    uncertain = np.flatnonzero(active[WHEELS])                       # the first entries of c
    joint[:, :6, 6 + uncertain] = cross[:, :, :len(uncertain)]
    joint[:, 6:, :6] = np.swapaxes(joint[:, :6, 6:], 1, 2)
    joint[:, 6:, 6:] = whole[WHEELS, WHEELS]
    markers, antennas = blocks[:len(v.markers)], np.reshape(blocks[len(v.markers):], (-1, 2, 2))
    return Covariances(pairs=joint, markers=markers, antennas=antennas, c=whole)


def rows_of_pairs(measurements):
    """Rows (f-1, 6) of X_i and X_{i+1}."""
    rows = measurements.structure.rows(measurements.variables.frames, 3)
    return np.concatenate([rows[:-1], rows[1:]], axis=1)


def _require_digits(equations, H):
    """Raise DatasetError if rounding in the information matrix H hides the prior of the heading.

    A common rotation of all poses and landmarks about pose 1 changes no measurement: only the
    priors have information about it. Any more information in H is rounding.
    """
    m, turn = equations.problem.measurements, _common_turn(equations)
    rounding, sigma = turn @ (H @ turn) - equations.priors.H @ turn**2, m.origin_sigma[2]
    if abs(rounding) * sigma**2 > MAX_ROUNDING:
        raise DatasetError(
            f"{m.dataset.name}: expected measurements beside which sigma_heading = {sigma:g} rad "
            "(vehicle.toml, or the assignment's table 2) is not lost in rounding; their standard "
            "deviations are too small for it")


def _common_turn(equations):
    """Change (n,) of all unknowns per rad of a rotation of poses and landmarks about the origin."""
    m, state, structure = equations.problem.measurements, equations.state, equations.structure
    turn, v = np.zeros(len(structure.diagonal)), m.variables

    def in_own_axes(poses):
        """Change (m, 3) of poses (m, 3) per rad, in their own axes."""
        change = se2.compose_jacobians(np.zeros(3), poses)[0][..., 2]
        change[:, :2] = (se2.rotation(-poses[:, 2]) @ change[:, :2, None])[..., 0]
        return change

    antennas = np.pad(state.antennas, ((0, 0), (0, 1)))
    turn[structure.rows(v.frames, 3)] = in_own_axes(state.poses)
    turn[structure.rows(v.antennas, 2)] = in_own_axes(antennas)[:, :2]
    for rows, change in zip(structure.rows_of_each(v.markers), in_own_axes(state.markers)):
        turn[rows] = change[:len(rows)]
    return turn


def selected_inverse(H, frames, pairs, blocks):
    """Some blocks of the inverse of a sparse information matrix H (n, n) in csc format.

    Parameters
    ----------
    frames : (f, 3) rows of consecutive poses. H connects a pose with the next, but no other poses.
    pairs : (f-1, p) rows of the first blocks, each connected to a pose and the next.
    blocks : list of (d,) rows of single variables.

    Returns
    -------
    (f-1, p, p), and a list of (d, d).
    """
    tree = _dissection(H, frames)
    of_pairs = np.empty((len(pairs),) + 2 * pairs.shape[1:])
    of_blocks, block_of_row = [None] * len(blocks), np.full(H.shape[0], -1)
    block_of_row[[rows[0] for rows in blocks]] = np.arange(len(blocks))

    root, _ = _eliminated(tree, 0, len(tree.separators) - 1)
    stack = [(root, np.zeros((0, 0)))]                  # parts, and the covariances of their fronts
    while stack:
        part, S = stack.pop()
        cross = -part.K @ S
        own = part.inverse - cross @ part.K.T
        # Rounding is relative to the largest entry: it would make pose 1's covariance asymmetric.
        joint = np.block([[(own + own.T) / 2, cross], [cross.T, S]])
        position = _positions(part.rows, part.front)
        if not part.parts:
            i = position(pairs[part.pairs])
            of_pairs[part.pairs] = joint[i[:, :, None], i[:, None, :]]
        for number in block_of_row[part.rows][block_of_row[part.rows] >= 0].tolist():
            i = position(blocks[number])
            of_blocks[number] = joint[i[:, None], i]
        for inner in part.parts:
            i = position(inner.front)
            stack.append((inner, joint[i[:, None], i]))
    return of_pairs, of_blocks


@dataclass(frozen=True)
class _Dissection:
    """A matrix H (n, n) and its separators."""

    H: csc_array
    frames: np.ndarray       # (f, 3)
    separators: np.ndarray   # frames between parts, with -1 and f at the ends
    first: np.ndarray        # (n,) first frame that a row is connected to, or that of the row
    last: np.ndarray         # (n,) last one

    def inside(self, rows, begin, end):
        """(m,) bool, `rows` (m,) connected only to frames between the separators begin and end."""
        low, high = self.separators[begin], self.separators[end]
        return (self.first[rows] > low) & (self.last[rows] < high)


def _dissection(H, frames):
    """The _Dissection with a separator every LEAF frames."""
    count = len(frames)
    frame = np.full(H.shape[0], -1)
    frame[frames] = np.arange(count)[:, None]
    of_entries = frame[H.indices]
    last = np.maximum.reduceat(of_entries, H.indptr[:-1])
    first = np.minimum.reduceat(np.where(of_entries < 0, count, of_entries), H.indptr[:-1])
    alone = last < 0                                       # eliminated last
    first, last = np.where(alone, 0, first), np.where(alone, count - 1, last)
    return _Dissection(
        H=H, frames=frames, separators=np.r_[-1, np.arange(LEAF, count - 1, LEAF + 1), count],
        first=np.where(frame < 0, first, frame), last=np.where(frame < 0, last, frame))


@dataclass(frozen=True)
class _Part:
    """The elimination of the unknowns between two separators."""

    rows: np.ndarray         # (e,) of the eliminated unknowns
    front: np.ndarray        # (s,) rows of the unknowns of the front
    inverse: np.ndarray      # (e, e) H_ee^-1
    K: np.ndarray            # (e, s)
    parts: tuple             # the two _Parts that are joined here, or none
    pairs: range             # of poses in a part that joins none


def _eliminated(tree, begin, end):
    """The _Part between the separators `begin` and `end`, and its Schur complement (s, s)."""
    low, high, joined = tree.separators[begin], tree.separators[end], ()
    own, middle = tree.frames[low + 1:high].ravel(), (begin + end) // 2
    if end - begin > 1:
        joined = _eliminated(tree, begin, middle), _eliminated(tree, middle, end)
        own = tree.frames[tree.separators[middle]]
    reached = np.unique(np.concatenate(
        [own, _entries(tree.H, own)[1], *(part.front for part, _ in joined)]))
    if end - begin == len(tree.separators) - 1:            # all that is left
        reached = np.arange(tree.H.shape[0])
    if joined:
        reached = reached[~tree.inside(reached, begin, middle) & ~tree.inside(reached, middle, end)]
    inside = tree.inside(reached, begin, end)
    rows, front = reached[inside], reached[~inside]
    F, e = _information(tree.H, rows, front, joined), len(rows)
    inverse = np.linalg.inv(F[:e, :e])
    K = inverse @ F[:e, e:]
    part = _Part(rows=rows, front=front, inverse=(inverse + inverse.T) / 2, K=K,
                 parts=tuple(part for part, _ in joined),
                 pairs=range(max(low, 0), min(high, len(tree.frames) - 1)))
    return part, F[e:, e:] - F[:e, e:].T @ K


def _information(H, rows, front, joined):
    """Information of `rows` (e,) and `front` (s,) once the parts of `joined` are eliminated."""
    position, F = _positions(rows, front), np.zeros(2 * [len(rows) + len(front)])
    row, column, value = _entries(H, rows)
    i, j = position(row), position(column)
    inside = j >= 0
    F[i[inside], j[inside]] = value[inside]
    for part, schur in joined:
        i = position(part.front)
        F[i[:, None], i] += schur
    return F


def _positions(rows, front):
    """Function from rows to their positions in `rows` (e,), then `front` (s,); -1 if not there."""
    both = np.concatenate([rows, front])
    order = np.argsort(both)

    def position(wanted):
        nearest = order[np.minimum(np.searchsorted(both, wanted, sorter=order), len(both) - 1)]
        return np.where(both[nearest] == wanted, nearest, -1)

    return position


def _entries(H, columns):
    """Column, row and value of all entries in some columns of H, which is symmetric."""
    begin, count = H.indptr[columns], H.indptr[columns + 1] - H.indptr[columns]
    index = np.repeat(begin - np.cumsum(count) + count, count) + np.arange(count.sum())
    return np.repeat(columns, count), H.indices[index], H.data[index]


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
    m = problem.measurements
    v, structure, pairs, n = m.variables, m.structure, rows_of_pairs(m), len(m.structure.diagonal)
    of_c = np.zeros((len(x), len(problem.sigma)))
    of_c[:, problem.active] = problem.sigma[problem.active] * x[:, n:]
    of_pairs = np.concatenate([x[:, pairs], np.broadcast_to(
        of_c[:, None, WHEELS], (len(x), len(pairs), 3))], axis=2)

    def averaged(blocks, x_k):
        """sum p_k (C_k + x_k x_k^T) of blocks p of (..., d, d) with differences (p, ..., d)."""
        return np.einsum("p,p...->...", weights,
                         np.stack(blocks) + x_k[..., :, None] * x_k[..., None, :])

    return Covariances(
        pairs=averaged([C.pairs for C in conditional], of_pairs),
        markers=[averaged([C.markers[j] for C in conditional], x[:, rows])
                 for j, rows in enumerate(structure.rows_of_each(v.markers))],
        antennas=averaged([C.antennas for C in conditional], x[:, structure.rows(v.antennas, 2)]),
        c=averaged([C.c for C in conditional], of_c))
