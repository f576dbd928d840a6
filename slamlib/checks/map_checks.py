"""Checks of a map without truth: residuals by landmark, and the maps of both halves of a drive.

`residuals_by_landmark` compares the residuals of every landmark with their expected sum of squares.
`halves` splits a drive, and `estimated_map` solves each half in the frame of its own first pose.
`compare_maps` aligns the positions in both maps; the remaining distances have known covariances.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib import evaluation, se2
from slamlib.slam.choices import calibrated
from slamlib.slam.covariances import marginal_covariances
from slamlib.slam.linear import consistency_factor, linear_solution
from slamlib.slam.measurements import measure
from slamlib.slam.pipeline import fit_from_odometry
from slamlib.slam.result import slam_result

MIN_SIGHTINGS_IN_HALF = 3   # accepted sightings of a marker; fewer may all have wrong labels
ALIGNMENT_ITERATIONS = 10     # Gauss-Newton iterations for the motion between two maps


@dataclass(frozen=True)
class LandmarkResiduals:
    """Squared whitened residuals of every landmark of a kind, with the learned noise."""

    chi2: np.ndarray         # (k,) sum of the squares
    dof: np.ndarray          # (k,) its expectation


def residuals_by_landmark(fit):
    """LandmarkResiduals of the markers and of the antennas of a `slam.fit.Fit`.

    With the derivatives J of n whitened errors e by unknowns of covariance C, the solution takes
    the degrees of freedom tr(J C J^T): E[e^T e] = n - tr(J C J^T), but for the few that the
    calibration takes. A range counts by its weight.
    """
    m, equations = fit.problem.measurements, fit.equations
    columns, column = _covariance_columns(fit)
    pairs = marginal_covariances(equations, fit.problem.noise).pairs
    of_poses = np.concatenate([pairs[:, :3, :3], pairs[-1:, 3:6, 3:6]])
    totals = np.zeros((len(m.marker) + len(m.antenna), 2))
    of_kernel = consistency_factor(fit.problem.accepted.range_kernel)
    for f, (_, rows), expected in zip(equations.linearized, m.factor_places[1:], (1, 1, of_kernel)):
        if not len(f.row):                                              # of no width
            continue
        rows, J = rows[f.index], f.J
        C = columns[rows[:, :, None], column[rows][:, None]]            # wrong in columns of poses
        C[:, :3, :3], C[:, 3:, :3] = of_poses[f.row], np.swapaxes(C[:, :3, 3:], 1, 2)
        np.add.at(totals, f.landmark, np.stack([np.sum(f.e**2, axis=1), (
            expected * f.weight * f.e.shape[1] - np.einsum("mdi,mij,mdj->m", J, C, J))], axis=1))
    return tuple(LandmarkResiduals(*part.T) for part in np.split(totals, [len(m.marker)]))


def _covariance_columns(fit):
    """Covariances (n, r) of a Fit's unknowns with the r that are not of poses; their columns (n,).

    Unknowns of poses have the column -1. This is all that the checks need of the information matrix
    besides `marginal_covariances`.
    """
    m, equations = fit.problem.measurements, fit.equations
    others = np.concatenate([np.zeros(0, int), *m.structure.rows_of_each(
        np.arange(len(m.frame), len(m.structure.width)))])
    H, border, *_ = equations.sums(fit.problem.noise)
    solution, n = linear_solution(m.structure, H, border), len(m.structure.diagonal)
    unit, column = np.zeros((n, len(others))), np.full(n, -1)
    unit[others, np.arange(len(others))] = 1
    column[others] = np.arange(len(others))
    by_c = solution.by_c                                            # an uncertain calibration adds
    return solution.lu.solve(unit) + by_c @ np.linalg.solve(solution.S, by_c[others].T), column


@dataclass(frozen=True)
class Map:
    """Positions of landmarks in the frame of a drive's first pose: k markers, then a antennas."""

    marker: np.ndarray       # (k,) ids, ascending
    antenna: np.ndarray      # (a,) ids, ascending
    place: np.ndarray        # (k + a, 2) m
    covariance: np.ndarray   # (k + a, 2, k + a, 2) m^2, of all places jointly, in world axes


def halves(dataset, poses):
    """Both halves of a Dataset, each a Dataset in the frame of its own first pose.

    `poses` (n, 3), of any solution, move the guesses of the antennas into the second half's frame.
    Sensors without readings are None.
    """
    middle, guess = len(dataset.ticks) // 2, dataset.antenna_guess
    ticks = dataset.ticks[middle:].copy()
    ticks[0] = 0

    def later(readings):
        late = readings and readings.select(readings.pose >= middle)
        return replace(late, pose=late.pose - middle) if late and len(late.pose) else None

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
    marker = np.flatnonzero(np.isin(m.marker, found.marker) & (accepted >= MIN_SIGHTINGS_IN_HALF))
    antenna = np.flatnonzero(~np.isin(m.antenna, list(found.doubts)))
    rows = m.structure.rows(
        np.r_[m.variables.markers[marker], m.variables.antennas[antenna]], 2).ravel()
    columns, column = _covariance_columns(fit)
    C = columns[np.ix_(rows, column[rows])].reshape(2 * (len(rows) // 2, 2))
    turn = se2.rotation(np.pad(fit.state.markers[marker, 2], (0, len(antenna))))  # from their axes
    return Map(m.marker[marker], m.antenna[antenna], np.concatenate(
        [fit.state.markers[marker, :2], fit.state.antennas[antenna]]), _turned(turn, C))


def _turned(turn, covariance):
    """Joint covariance (n, 2, n, 2) of places that are turned by (n, 2, 2) or by one (2, 2)."""
    turn = np.broadcast_to(turn, (len(covariance), 2, 2))
    return np.einsum("aij,ajbk,blk->aibl", turn, covariance, turn)


@dataclass(frozen=True)
class Comparison:
    """The common landmarks of two maps after their alignment."""

    marker: np.ndarray       # (k,) ids
    antenna: np.ndarray      # (a,) ids
    distance: np.ndarray     # (k + a,) m, between both positions
    squared: np.ndarray      # (k + a,) chi-squared of each landmark given all others, 2 dof
    chi2: float              # of all of them together
    dof: int                 # its degrees of freedom, without the 3 of the motion


def compare_maps(first, second):
    """The Comparison of two independent Maps, None if they have fewer than two landmarks in common.

    The motion T minimises r^T W r for r = p - T q, with the places p of the first map and q of the
    second one, of covariances C and D, and W = (C + R D R^T)^-1 with the rotation R of T. With
    A = d(T q)/dT and P = W - W A (A^T W A)^-1 A^T W, the vector u = P r has the covariance P.
    Landmark j adds u_j^T P_jj^-1 u_j to the chi-squared of the others (Baarda, A Testing Procedure
    for Use in Geodetic Networks, 1968).
    """
    marker, antenna = (np.intersect1d(getattr(first, kind), getattr(second, kind))
                       for kind in ("marker", "antenna"))
    if (n := len(marker) + len(antenna)) < 2:
        return None
    (p, C), (q, D) = (_common(half, marker, antenna) for half in (first, second))
    T = evaluation.align(q, p)
    for _ in range(ALIGNMENT_ITERATIONS):
        there = q @ se2.rotation(T[2]).T
        r = p - T[:2] - there
        A = np.concatenate([np.tile(np.eye(2), (n, 1, 1)), there[:, ::-1, None] * [[-1], [1]]], 2)
        A = A.reshape(-1, 3)
        W = np.linalg.inv((C + _turned(se2.rotation(T[2]), D)).reshape(2 * n, 2 * n))
        gain = np.linalg.solve(A.T @ W @ A, A.T @ W)
        T = T + gain @ r.ravel()
    P = W - W @ A @ gain
    u, own = (P @ r.ravel()).reshape(n, 2, 1), P.reshape(n, 2, n, 2)[range(n), :, range(n)]
    return Comparison(
        marker=marker, antenna=antenna, distance=np.hypot(*r.T), dof=2 * n - 3,
        chi2=float(r.ravel() @ u.ravel()), squared=np.sum(u * np.linalg.solve(own, u), axis=(1, 2)))


def _common(half, marker, antenna):
    """Places (n, 2) of some landmarks of a Map, and their covariance."""
    rows = np.concatenate([np.searchsorted(half.marker, marker),
                           len(half.marker) + np.searchsorted(half.antenna, antenna)])
    return half.place[rows], half.covariance[rows][:, :, rows]
