"""Stage 7: covariances at the solution: jointly of consecutive frames and w, and of each landmark.

The inverse of the information matrix is dense; only some of its blocks are computed, by nested
dissection. Every LEAF frames there is a separator. What is connected only to unknowns between two
separators is eliminated there, which leaves a Schur complement on its front, the unknowns around.
Two such parts are joined at the separator between them, and so on. With C the information of what
is eliminated, B that between it and the front, and W = C^-1 B, the way back is

    Cov(front) = S,    Cov(eliminated, front) = -W S,    Cov(eliminated) = C^-1 + W S W^T

(Kaess and Dellaert, Robotics and Autonomous Systems 57(12), 2009). GTSAM's marginals are the same
numbers, one query at a time; a test compares them.
"""

from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csc_array

from slamlib import se2
from slamlib.dataset import DatasetError

LEAF = 12                    # frames between separators
MAX_ROUNDING = 0.05          # of the information about the heading at pose 1


@dataclass(frozen=True)
class Covariances:
    """Marginal covariances in GTSAM's axes, those of each pose itself."""

    pairs: np.ndarray        # (f-1, 9, 9) of [X_i, X_{i+1}, w]
    markers: list            # k of (3, 3), or (2, 2) for a point
    antennas: np.ndarray     # (a, 2, 2)
    z: np.ndarray            # (2, 2) of the ranges' offset and scale, zero if they are given
    w: np.ndarray            # (3, 3)


def covariances(equations, noise):
    """The Covariances of a Noise by NormalEquations at the State that solves the problem.

    Raises DatasetError where rounding hides what is known of the heading at pose 1.
    """
    m, rows = equations.problem.measurements, equations.structure.rows
    f, k, a = len(m.frame), len(m.marker), len(m.antenna)
    frames, w = rows(np.arange(f), 3), rows([m.wheels], 3)
    pairs = np.concatenate([frames[:-1], frames[1:], np.repeat(w, f - 1, axis=0)], axis=1)
    landmarks = [rows([f + j], 2 + m.oriented[j])[0] for j in range(k)] \
        + [*rows(f + k + np.arange(a), 2), w[0]]
    if m.calibrated:
        landmarks.append(rows([m.wheels + 1], 2)[0])
    H = equations.structure.matrix(equations.sums(noise)[0])
    _require_digits(equations, H)
    of_pairs, blocks = selected_inverse(H, frames, pairs, landmarks)
    return Covariances(
        pairs=of_pairs, markers=blocks[:k], antennas=np.reshape(blocks[k:k + a], (-1, 2, 2)),
        z=blocks[-1] if m.calibrated else np.zeros((2, 2)), w=blocks[k + a])


def _require_digits(equations, H):
    """Raise DatasetError where rounding in the information matrix H hides the prior of the heading.

    If all poses and landmarks turn together about pose 1, no measurement changes: only the priors
    have information about it. What H has beyond theirs is rounding.
    """
    turn = _common_turn(equations.problem.measurements, equations.state)
    rounding = turn @ (H @ turn) - equations.of_priors @ turn**2
    m, sigma = equations.problem.measurements, equations.problem.measurements.origin_sigma[2]
    if abs(rounding) * sigma**2 > MAX_ROUNDING:
        raise DatasetError(
            f"{m.dataset.name}: expected measurements beside which sigma_heading = {sigma:g} rad "
            "(vehicle.toml, or table 2) is not lost in rounding; their standard deviations are too "
            "small for it")


def _common_turn(m, state):
    """How the unknowns (n,) change per rad by which poses and landmarks turn about the origin."""
    f, k, rows = len(m.frame), len(m.marker), m.structure.rows
    turn = np.empty(len(m.structure.diagonal))
    turn[rows([m.wheels], 3)] = 0
    if m.calibrated:
        turn[rows([m.wheels + 1], 2)] = 0
    for first, poses, width in (
            (0, state.poses, np.full(f, 3)), (f, state.markers, 2 + m.oriented),
            (f + k, np.pad(state.antennas, ((0, 0), (0, 1))), np.full(len(m.antenna), 2))):
        moved = se2.compose_jacobians(np.zeros(3), poses)[0][..., 2]
        moved[:, :2] = (se2.rotation(-poses[:, 2]) @ moved[:, :2, None])[..., 0]     # own axes
        for each in (2, 3):
            of_width = np.flatnonzero(width == each)
            turn[rows(first + of_width, each)] = moved[of_width, :each]
    return turn


def selected_inverse(H, frames, pairs, blocks):
    """Some blocks of the inverse of a sparse information matrix H (n, n) in csc format.

    Parameters
    ----------
    frames : (f, 3) rows of consecutive poses. H connects a pose with the next, but no other poses.
    pairs : (f-1, p) rows of which the blocks are asked for, each connected to a pose and the next.
    blocks : list of (d,) rows of single variables.

    Returns
    -------
    (f-1, p, p), and a list of (d, d).
    """
    graph = _dissection(H, frames)
    of_pairs = np.empty((len(pairs),) + 2 * pairs.shape[1:])
    of_blocks, block_at = [None] * len(blocks), np.full(H.shape[0], -1)
    block_at[[rows[0] for rows in blocks]] = np.arange(len(blocks))

    below = [(_eliminated(graph, 0, len(graph.separators) - 1), np.zeros((0, 0)))]
    while below:                                        # parts, and the covariances of their fronts
        part, front_covariance = below.pop()
        cross = -part.W @ front_covariance
        own = part.inverse - cross @ part.W.T
        # Rounding is relative to the largest entry: it would make pose 1's covariance asymmetric.
        joint = np.block([[(own + own.T) / 2, cross], [cross.T, front_covariance]])
        with _places(graph.local, part.rows, part.front) as local:
            if not part.parts:
                at = local[pairs[part.pairs]]
                of_pairs[part.pairs] = joint[at[:, :, None], at[:, None, :]]
            for number in block_at[part.rows][block_at[part.rows] >= 0].tolist():
                at = local[blocks[number]]
                of_blocks[number] = joint[at[:, None], at]
            for each in part.parts:
                at = local[each.front]
                below.append((each, joint[at[:, None], at]))
    return of_pairs, of_blocks


@dataclass
class _Dissection:
    """A matrix H (n, n) and how it falls apart."""

    H: csc_array
    frames: np.ndarray       # (f, 3)
    separators: np.ndarray   # frames between parts, with -1 and f at the ends
    first: np.ndarray        # (n,) first frame that a row is connected to, or the row's own
    last: np.ndarray         # (n,)
    done: np.ndarray         # (n,) bool, eliminated so far
    local: np.ndarray        # (n,) scratch, see `_places`


def _dissection(H, frames):
    """The _Dissection with a separator every LEAF frames."""
    size, count = H.shape[0], len(frames)
    frame = np.full(size, -1)
    frame[frames] = np.arange(count)[:, None]
    of_entries = frame[H.indices]
    last = np.maximum.reduceat(of_entries, H.indptr[:-1])
    first = np.minimum.reduceat(np.where(of_entries < 0, count, of_entries), H.indptr[:-1])
    return _Dissection(
        H, frames, np.r_[-1, np.arange(LEAF, count - 1, LEAF + 1), count],
        np.where(frame < 0, first, frame), np.where(frame < 0, last, frame),
        np.zeros(size, bool), np.full(size, -1))


@dataclass
class _Part:
    """What is between two separators, eliminated."""

    rows: np.ndarray         # (e,) of what is eliminated
    front: np.ndarray        # (s,) rows of what it is connected to
    inverse: np.ndarray      # (e, e) C^-1
    W: np.ndarray            # (e, s)
    schur: np.ndarray        # (s, s)
    parts: tuple             # the two _Parts that are joined here, or none
    pairs: range             # of poses in a part that joins none


def _eliminated(graph, begin, end):
    """The _Part between the separators `begin` and `end` of a _Dissection."""
    low, high, parts = graph.separators[begin], graph.separators[end], ()
    own, whole = graph.frames[low + 1:high].ravel(), end - begin == len(graph.separators) - 1
    if end - begin > 1:
        middle = (begin + end) // 2
        parts = _eliminated(graph, begin, middle), _eliminated(graph, middle, end)
        own = graph.frames[graph.separators[middle]]
    reached = np.unique(np.concatenate(
        [own, _entries(graph.H, own)[1], *(part.front for part in parts)]))
    reached = np.flatnonzero(~graph.done) if whole else reached[~graph.done[reached]]
    inside = whole | (graph.first[reached] > low) & (graph.last[reached] < high)
    rows, front = reached[inside], reached[~inside]
    F, e = _information(graph, rows, front, parts), len(rows)
    inverse = np.linalg.inv(F[:e, :e])
    W = inverse @ F[:e, e:]
    graph.done[rows] = True
    return _Part(rows, front, (inverse + inverse.T) / 2, W, F[e:, e:] - F[:e, e:].T @ W, parts,
                 range(max(low, 0), min(high, len(graph.frames) - 1)))


def _information(graph, rows, front, parts):
    """Information of `rows` (e,) and `front` (s,) once the `parts` are eliminated."""
    F = np.zeros(2 * [len(rows) + len(front)])
    with _places(graph.local, rows, front) as local:
        row, column, value = _entries(graph.H, rows)
        inside = local[column] >= 0
        F[local[row[inside]], local[column[inside]]] = value[inside]
        for part in parts:
            at = local[part.front]
            F[at[:, None], at] += part.schur
            part.schur = None                                          # frees the memory
    return F


@contextmanager
def _places(local, rows, front):
    """`local` (n,) holds the place of every row in a front, otherwise -1."""
    local[rows], local[front] = np.arange(len(rows)), len(rows) + np.arange(len(front))
    yield local
    local[rows] = local[front] = -1


def _entries(H, columns):
    """Column, row and value of all entries in some columns of H, which is symmetric."""
    begin, count = H.indptr[columns], H.indptr[columns + 1] - H.indptr[columns]
    at = np.repeat(begin - np.cumsum(count) + count, count) + np.arange(count.sum())
    return np.repeat(columns, count), H.indices[at], H.data[at]
