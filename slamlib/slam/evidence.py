"""Stage 6: the evidence of the noise, from one linearisation for all values of the noise.

At a state, the graph's factors are linearised and their information is summed by groups: priors,
odometry, sightings and ranges. The noise of odometry depends on the slip, the information of the
other two on their factors alone. Each value of the noise then costs one sparse decomposition.
"""

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from slamlib.slam.linear_factors import linear_factors
from slamlib.slam.measurement_factors import GUESS_PRIOR_SIGMA, WEAK_SIGMA
from slamlib.slam.odometry_factors import odometry_error
from slamlib.slam.problem import Problem
from slamlib.slam.state import State

KEPT = 4                     # values of the slip whose sums are kept


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations H delta = -g of the linearised graph, as a function of the noise."""

    problem: Problem
    state: State

    def solve(self, noise):
        """Solution delta (n,) in the order of `begin`, and the log evidence, up to a constant.

        With half the squared error e at the solution, the odometry noise Q, factors l_s and l_r on
        the sigmas of S errors of sightings and R of ranges, and the information H,

            log evidence = -e - sum log|Q| / 2 - S log l_s - R log l_r - log|H| / 2

        (MacKay, Neural Computation 4(3), 1992). The omitted constant depends on the dataset and the
        weights: only problems on the same accepted measurements can be compared. The log evidence
        is minus infinity where H is singular to rounding.
        """
        H, g, squared, log_determinant = self._sums(noise)
        lu, groups = decomposition(H), self._groups
        if lu is None:
            return np.full(len(g), np.nan), -np.inf
        delta = -lu.solve(g)
        log_root = np.sum(np.log(np.abs(lu.U.diagonal()))) / 2
        return delta, -(squared + g @ delta) / 2 - log_determinant / 2 - log_root \
            - groups["sightings"].count * np.log(noise.sightings) \
            - groups["ranges"].count * np.log(noise.ranges)

    def information(self, noise):
        """H (n, n), sparse, and g (n,)."""
        return self._sums(noise)[:2]

    def _sums(self, noise):
        """H, g, squared error at the state, and sum log|Q|."""
        given, groups = self.problem.noise, self._groups
        ratios = {"prior": 1.0, "sightings": (given.sightings / noise.sightings)**2,
                  "ranges": (given.ranges / noise.ranges)**2}
        H, g, squared, log_determinant = self._odometry_sums(noise.slip)
        for name, ratio in ratios.items():
            H = H + ratio * groups[name].H
            g = g + ratio * groups[name].g
            squared = squared + ratio * groups[name].squared
        return H, g, squared, log_determinant

    @cached_property
    def begin(self):
        """(v,) first row of every variable: frames, markers, antennas, w, and z where it is one."""
        m, size = self.problem.measurements, self._widths
        first = {"x": 0, "l": len(m.frame), "p": len(m.frame),
                 "a": len(m.frame) + len(m.marker), "w": len(size) - 1 - m.calibrated,
                 "z": len(size) - 1}
        keys = (gtsam.Symbol(m.ordering.at(i)) for i in range(m.ordering.size()))
        order = [first[chr(key.chr())] + key.index() for key in keys]
        begin = np.empty(len(size), int)
        begin[order] = np.cumsum(size[order]) - size[order]
        return begin

    @cached_property
    def _widths(self):
        """(v,) numbers of unknowns of the variables, numbered as in `begin`."""
        m = self.problem.measurements
        return np.r_[np.full(len(m.frame), 3), np.where(m.oriented, 3, 2),
                     np.full(len(m.antenna), 2), 3, [2] * m.calibrated].astype(int)

    @property
    def size(self):
        """Number n of unknowns."""
        return int(self._widths.sum())

    def rows(self, variables, width):
        """Rows (m, width) of the unknowns of `variables` (m,), numbered as in `begin`."""
        return self.begin[variables][:, None] + np.arange(width)

    @cached_property
    def _frames(self):
        """Rows (f-1, 9) of [X_i, X_{i+1}, w], and unwhitened errors and derivatives."""
        m, state = self.problem.measurements, self.state
        f = len(m.frame)
        w = np.full(f - 1, f + len(m.marker) + len(m.antenna))
        rows = np.concatenate([self.rows(np.arange(f - 1), 3), self.rows(np.arange(1, f), 3),
                               self.rows(w, 3)], axis=1)
        e, *jacobians = odometry_error(self.problem.odometry, state.poses, state.w)
        return rows, e, np.concatenate(jacobians, axis=2)

    def _odometry_sums(self, slip):
        """H, g, squared error and sum log|Q| of the odometry; those of the last slips are kept."""
        kept = self._kept_sums
        if slip not in kept:
            rows, e, J = self._frames
            L = np.linalg.cholesky(self.problem.odometry.noise(slip))
            J = self._sparse(rows, np.linalg.solve(L, J))
            e = np.linalg.solve(L, e[..., None]).ravel()
            logs = np.log(np.diagonal(L, axis1=1, axis2=2))
            kept[slip] = J.T @ J, J.T @ e, e @ e, 2 * np.sum(logs)
            if len(kept) > KEPT:
                del kept[next(iter(kept))]
        return kept[slip]

    @cached_property
    def _kept_sums(self):
        return {}

    def _sparse(self, columns, blocks):
        """Sparse (m d, n) of blocks (m, d, c) at columns (m, c)."""
        m, d, c = blocks.shape
        return sparse.csr_matrix(
            (blocks.ravel(), np.repeat(columns[:, None], d, axis=1).ravel(),
             np.arange(0, m * d * c + 1, c)), shape=(m * d, self.size))

    @cached_property
    def _groups(self):
        """The _Group of the priors, of the sightings and of the ranges."""
        problem = self.problem
        poses, points, ranges = linear_factors(problem.measured, problem.noise, self.state)
        from_kernel = consistency(problem.measured.range_kernel)
        sightings = _sum([self._group(poses), self._group(points)])
        return {"prior": self._prior(), "sightings": sightings,
                "ranges": self._group(ranges, from_kernel)}

    def _group(self, factors, from_kernel=1.0):
        J, e = self.jacobian(factors), factors.e.ravel()
        return _Group(J.T @ J / from_kernel, J.T @ e / from_kernel, e @ e / from_kernel,
                      factors.e.shape[1] * np.sum(factors.weight))

    def jacobian(self, factors):
        """Sparse derivatives (m d, n) of LinearFactors."""
        m, width = self.problem.measurements, factors.by_landmark.shape[2]
        rows = [self.rows(factors.row, 3), self.rows(len(m.frame) + factors.landmark, width)]
        J = [factors.by_pose, factors.by_landmark]
        if factors.by_calibration is not None and m.calibrated:
            rows.append(self.rows(np.full(len(factors.row), len(self.begin) - 1), 2))
            J.append(factors.by_calibration)
        return self._sparse(np.concatenate(rows, axis=1), np.concatenate(J, axis=2))

    def _prior(self):
        problem, m, state = self.problem, self.problem.measurements, self.state
        f, k = len(m.frame), len(m.marker)
        parts = [(np.array([0]), state.poses[:1], m.origin_sigma),
                 (np.array([f + k + len(m.antenna)]), state.w[None], 1.0),
                 (f + k + np.arange(len(m.antenna)), state.antennas - m.guess, GUESS_PRIOR_SIGMA)]
        parts += [(np.array([f + j]), state.markers[j:j + 1, :2 + m.oriented[j]], WEAK_SIGMA)
                  for j in problem.measured.unsupported]
        if m.calibrated:
            parts.append((np.array([len(self.begin) - 1]), state.z[None], 1.0))
        information, e = np.zeros(self.size), np.zeros(self.size)
        for variables, off, sigma in parts:
            rows = self.rows(variables, off.shape[1])
            information[rows], e[rows] = np.broadcast_to(sigma, off.shape)**-2.0, off
        return _Group(sparse.diags_array(information).tocsr(), information * e,
                      np.sum(information * e**2), 0)


@dataclass(frozen=True)
class _Group:
    """Information H (n, n), gradient g (n,) and squared error of a group of `count` errors."""

    H: sparse.csr_matrix
    g: np.ndarray
    squared: float
    count: float


def _sum(groups):
    return _Group(*(sum(getattr(group, name) for group in groups)
                    for name in ("H", "g", "squared", "count")))


def decomposition(H):
    """Sparse decomposition of H (n, n), ordered for elimination; None if H is singular."""
    try:
        return splu(H.tocsc(), permc_spec="NATURAL", diag_pivot_thresh=0.0,
                    options={"SymmetricMode": True})
    except RuntimeError:
        return None


def consistency(kernel):
    """Weighted mean of the squares of standard normal residuals under a kernel's weights.

    A kernel takes part of the variance of Gaussian residuals; without this factor the learned sigma
    would be too small (Huber and Ronchetti, Robust Statistics, 2009, chapter 5). It is 1 without
    kernel.
    """
    if kernel is None:
        return 1.0
    r = np.linspace(-6, 6, 241)
    density = np.exp(-r**2 / 2) * np.array([kernel.weight(x) for x in r])
    return float(np.sum(r**2 * density) / np.sum(density))


def log_evidence(problem, state):
    """Laplace log evidence of a Problem at a State near its optimum, as `NormalEquations.solve`."""
    return NormalEquations(problem, state).solve(problem.noise)[1]
