"""Checks of a map without truth: residuals by landmark, and the maps of both halves of a drive.

`residuals_by_landmark` compares the residuals of every landmark with their expected sum of squares.
`halves` splits a drive, and `estimated_map` solves each half in the frame of its own first pose.
`compare_maps` aligns both maps; the remaining distances have known covariances.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from slamlib import evaluation, se2
from slamlib.slam.calibrations import calibrated
from slamlib.slam.covariances import marginal_covariances
from slamlib.slam.linear import consistency_factor, decomposition
from slamlib.slam.measurements import measure
from slamlib.slam.pipeline import fit_from_odometry
from slamlib.slam.result import slam_result

MIN_SIGHTINGS_IN_HALF = 3   # accepted sightings of a marker; fewer may all have wrong labels
ALIGNMENT_ITERATIONS = 10     # Gauss-Newton iterations for the motion between two maps


@dataclass(frozen=True)
class LandmarkResiduals:
    """Squared whitened residuals of every landmark of a kind, with the learned noise."""

    count: np.ndarray        # (k,) sum of the weights of the accepted measurements
    chi2: np.ndarray         # (k,) sum of the squares
    dof: np.ndarray          # (k,) its expectation


def residuals_by_landmark(fit):
    """LandmarkResiduals of the markers and of the antennas of a `slam.fit.Fit`.

    With the derivatives J of n whitened errors e by unknowns of covariance C, the solution takes
    the degrees of freedom tr(J C J^T): E[e^T e] = n - tr(J C J^T). A range counts by its weight.
    """
    m, equations = fit.problem.measurements, fit.equations
    columns, column = _covariance_columns(fit)
    pairs = marginal_covariances(equations, fit.problem.noise).pairs
    of_poses = np.concatenate([pairs[:, :3, :3], pairs[-1:, 3:6, 3:6]])
    totals = np.zeros((3, len(m.marker) + len(m.antenna)))
    of_kernel = consistency_factor(fit.problem.accepted.range_kernel)
    for f, (_, rows), expected in zip(equations.linearized, m.factor_places[1:], (1, 1, of_kernel)):
        if not len(f.row):                                              # of no width
            continue
        rows, J = rows[f.index], f.J
        C = columns[rows[:, :, None], column[rows][:, None]]            # wrong in columns of poses
        C[:, :3, :3], C[:, 3:, :3] = of_poses[f.row], np.swapaxes(C[:, :3, 3:], 1, 2)
        np.add.at(totals.T, f.landmark, np.stack([
            f.weight, np.sum(f.e**2, axis=1),
            expected * f.weight * f.e.shape[1] - np.einsum("mdi,mij,mdj->m", J, C, J)], axis=1))
    markers, antennas = np.split(totals, [len(m.marker)], axis=1)
    return LandmarkResiduals(*markers), LandmarkResiduals(*antennas)


def _covariance_columns(fit):
    """Covariances (n, r) of a Fit's unknowns with the r that are not of poses; their columns (n,).

    Unknowns of poses have the column -1. This is all that the checks need of the information matrix
    besides `marginal_covariances`.
    """
    m, equations = fit.problem.measurements, fit.equations
    others = np.concatenate(m.structure.rows_of_each(
        np.arange(len(m.frame), len(m.structure.width))))
    H = m.structure.matrix(equations.sums(fit.problem.noise)[0])
    unit, column = np.zeros((H.shape[0], len(others))), np.full(H.shape[0], -1)
    unit[others, np.arange(len(others))] = 1
    column[others] = np.arange(len(others))
    return decomposition(H).solve(unit), column


@dataclass(frozen=True)
class Map:
    """Landmarks of a drive in the frame of its first pose: k markers, then a antennas."""

    marker: np.ndarray       # (k,) ids, ascending, of markers with a heading
    antenna: np.ndarray      # (a,) ids, ascending
    place: np.ndarray        # (k + a, 3) in m and rad; the heading of an antenna is 0
    covariance: np.ndarray   # (3k + 3a, 3k + 3a) of all places jointly, in world axes


def halves(dataset, poses):
    """Both halves of a Dataset, each a Dataset in the frame of its own first pose.

    `poses` (n, 3), of any solution, move the guesses of the antennas into the second half's frame.
    Sensors without readings are None.
    """
    middle = len(dataset.ticks) // 2

    def later(readings):
        late = readings and readings.select(readings.pose >= middle)
        return replace(late, pose=late.pose - middle) if late and len(late.pose) else None

    ticks, guess = dataset.ticks[middle:].copy(), dataset.antenna_guess
    ticks[0] = 0
    if guess is not None:
        there = se2.between(poses[middle], np.pad(guess.position, ((0, 0), (0, 1))))
        guess = replace(guess, position=there[:, :2])
    return dataset.first(middle), replace(dataset, ticks=ticks, aruco=later(dataset.aruco),
                                          uwb=later(dataset.uwb), antenna_guess=guess)


def estimated_map(dataset):
    """The Map of a Dataset by SLAM, without landmarks that are in doubt.

    Raises DatasetError where the measurements determine no solution.
    """
    fit = calibrated(fit_from_odometry(measure(dataset)))
    m, found = fit.problem.measurements, slam_result(fit)
    accepted = np.bincount(m.marker_row, fit.problem.accepted.sighting_weight, len(m.marker))
    marker = np.flatnonzero(np.isin(m.marker, found.marker) & m.oriented
                            & (accepted >= MIN_SIGHTINGS_IN_HALF))
    antenna = np.flatnonzero(~np.isin(m.antenna, list(found.doubts)))
    place = np.concatenate([fit.state.markers[marker],
                            np.pad(fit.state.antennas[antenna], ((0, 0), (0, 1)))])
    rows = np.concatenate([m.structure.rows(m.variables.markers[marker], 3).ravel(),
                           m.structure.rows(m.variables.antennas[antenna], 2).ravel()])
    columns, column = _covariance_columns(fit)
    used, C = _coordinates(marker, antenna), np.zeros(2 * [place.size])
    C[np.ix_(used, used)] = columns[np.ix_(rows, column[rows])]
    to_world = se2.compose_jacobians(place, np.zeros(3))[1]            # from each landmark's axes
    turn = block_diag(np.zeros((0, 0)), *to_world)                     # (0, 0) also without any
    return Map(m.marker[marker], m.antenna[antenna], place, turn @ C @ turn.T)


def _coordinates(marker, antenna):
    """Mask (3k + 3a,) of the coordinates that landmarks have: antennas have no heading."""
    return np.concatenate([np.ones(3 * len(marker), bool),
                           np.tile([True, True, False], len(antenna))])


@dataclass(frozen=True)
class Comparison:
    """The common landmarks of two maps after their alignment."""

    marker: np.ndarray       # (k,) ids
    antenna: np.ndarray      # (a,) ids
    distance: np.ndarray     # (k + a,) m, between both positions
    squared: np.ndarray      # (k + a,) chi-squared of each landmark given all others
    dofs: np.ndarray         # (k + a,) its degrees of freedom, 3 of a marker and 2 of an antenna
    chi2: float              # of all of them together
    dof: int                 # its degrees of freedom, without the 3 of the motion


def compare_maps(first, second):
    """The Comparison of two independent Maps, None if they have fewer than two landmarks in common.

    The motion T minimises r^T W r for r = p - T q, with the places p of the first map and q of the
    second one, of covariances C and D, and W = (C + J D J^T)^-1, J = d(T q) / dq. With
    A = dr/dT and P = W - W A (A^T W A)^-1 A^T W, the vector u = P r has the covariance P. Landmark
    j adds u_j^T P_jj^-1 u_j to the chi-squared of the others (Baarda, A Testing Procedure for Use
    in Geodetic Networks, 1968).
    """
    marker, antenna = (np.intersect1d(getattr(first, kind), getattr(second, kind))
                       for kind in ("marker", "antenna"))
    if len(marker) + len(antenna) < 2:
        return None
    (p, C), (q, D) = (_common(half, marker, antenna) for half in (first, second))
    used = _coordinates(marker, antenna)
    T = evaluation.align(q, p)
    for _ in range(ALIGNMENT_ITERATIONS):
        by_T, by_q = se2.compose_jacobians(T, q)
        r = p - se2.compose(T, q)
        r[:, 2] = se2.wrap(r[:, 2])
        J, A, e = block_diag(*by_q), by_T.reshape(-1, 3)[used], r.ravel()[used]
        W = np.linalg.inv((C + J @ D @ J.T)[np.ix_(used, used)])
        gain = np.linalg.solve(A.T @ W @ A, A.T @ W)
        T = T + gain @ e
    P = W - W @ A @ gain
    u, dofs = P @ e, used.reshape(-1, 3).sum(axis=1)
    rows = np.split(np.arange(len(u)), np.cumsum(dofs)[:-1])
    return Comparison(
        marker=marker, antenna=antenna, distance=np.hypot(*r[:, :2].T), dofs=dofs,
        chi2=float(e @ u), dof=len(u) - 3,
        squared=np.array([u[j] @ np.linalg.solve(P[np.ix_(j, j)], u[j]) for j in rows]))


def _common(half, marker, antenna):
    """Places (k + a, 3) of some landmarks of a Map, and their covariance."""
    rows = np.concatenate([np.searchsorted(half.marker, marker),
                           len(half.marker) + np.searchsorted(half.antenna, antenna)])
    coordinates = (3 * rows[:, None] + np.arange(3)).ravel()
    return half.place[rows], half.covariance[np.ix_(coordinates, coordinates)]
