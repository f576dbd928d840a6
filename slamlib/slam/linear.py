"""Stage 3: the normal equations H delta = -g of a problem at a state, and the Laplace evidence.

With whitened errors e and derivatives J of all factors, H = sum J^T J and g = sum J^T e. The
calibration c touches nearly all factors and is eliminated last: with the information matrix
[[H, B], [B^T, D]] and the gradient [g, g_c], only H, which is sparse, is decomposed, and

    S = D - B^T H^-1 B,    delta_c = -S^-1 (g_c - B^T H^-1 g),    delta = -H^-1 (g + B delta_c).

The factors are linearised once, and H, B, D and g are summed by groups: priors, odometry, sightings
and ranges. The group of odometry depends on the slip, those of sightings and ranges only on their
noise factors. Each value of the noise then costs one decomposition, which gives its evidence.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.sparse.linalg import splu

from slamlib import se2
from slamlib.slam.calibration import WHEELS
from slamlib.slam.factors import linearize_measurements, odometry_error
from slamlib.slam.measurements import GUESS_PRIOR_SIGMA, WEAK_SIGMA
from slamlib.slam.problem import Problem, State

MAX_CACHED_SLIPS = 3         # values of the slip whose sums are kept in memory


@dataclass(frozen=True)
class Group:
    """Sums over a group of factors of n unknowns and q entries of the calibration."""

    H: np.ndarray            # data of `Structure.matrix`; of the priors the diagonal (n,)
    border: np.ndarray       # (n + q, q + 1), [[B, g], [D, g_c]]
    squared: float           # sum of squared whitened errors


@dataclass(frozen=True)
class LinearSolution:
    """The normal equations solved."""

    delta: np.ndarray        # (n + q,) the step, in sigmas of the calibration
    lu: object               # decomposition of H
    by_c: np.ndarray         # (n, q) H^-1 B
    S: np.ndarray            # (q, q) information about the calibration
    gradient: np.ndarray     # (q,) by the calibration, the other unknowns eliminated
    log_determinant: float   # of the information matrix
    decrease: float          # of half the squared error, by the step


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations, with unknowns in the order of `structure` and then the calibration."""

    problem: Problem
    state: State

    @property
    def structure(self):
        """The Structure of H."""
        return self.problem.measurements.structure

    @cached_property
    def error(self):
        """Half the sum of squared whitened errors, kernels applied."""
        odometry, _ = self._odometry(self.problem.noise.slip)
        return float(odometry.squared + self.priors.squared) / 2 \
            + sum(kind.error for kind in self.linearized)

    @cached_property
    def linearized(self):
        """The LinearizedMeasurements of sightings of poses, of points, and of ranges."""
        return linearize_measurements(self.problem, self.state)

    def step(self):
        """The Gauss-Newton step delta (n + q,), or None where H is singular to rounding."""
        H, border, *_ = self.sums(self.problem.noise)
        solution = linear_solution(self.structure, H, border)
        return solution.delta if solution is not None and solution.decrease >= 0 else None

    def sums(self, noise, consistency=(1.0, 1.0, 1.0)):
        """Data of H, border, squared error at the state, and sum log|Q| of the odometry noise Q.

        `consistency` (3,) divides the contribution of each kind of `linearized` by its consistency
        factor, which corrects the bias of a robust kernel (`consistency_factors`).
        """
        odometry, log_determinant = self._odometry(noise.slip)
        H, border = odometry.H.copy(), odometry.border + self.priors.border
        H[self.structure.diagonal] += self.priors.H
        squared = odometry.squared + self.priors.squared
        sightings = (self.problem.noise.sightings / noise.sightings)**2
        ranges = (self.problem.noise.ranges / noise.ranges)**2
        for group, ratio, divisor in zip(
                self._measurement_groups, (sightings, sightings, ranges), consistency):
            if group is not None:
                ratio = ratio / divisor
                H += group.H if ratio == 1 else ratio * group.H
                border += ratio * group.border
                squared += ratio * group.squared
        return H, border, squared, log_determinant

    def counts(self):
        """Numbers of accepted errors of sightings and of ranges."""
        poses, points, ranges = (f.e.shape[1] * np.sum(f.weight) for f in self.linearized)
        return poses + points, ranges

    @cached_property
    def priors(self):
        """The Group of the priors, whose H and D are diagonal."""
        problem, m, state = self.problem, self.problem.measurements, self.state
        v, active, n = m.variables, problem.active, len(self.structure.diagonal)
        parts = [(v.frames[:1], se2.log(state.poses[:1]), m.origin_sigma),
                 (v.antennas, state.antennas - m.guess, GUESS_PRIOR_SIGMA)]
        parts += [(v.markers[[j]], state.markers[[j], :2 + m.oriented[j]], WEAK_SIGMA)
                  for j in problem.accepted.unsupported]
        H, e = np.zeros((2, n))
        for variables, difference, sigma in parts:
            rows = self.structure.rows(variables, difference.shape[1])
            H[rows], e[rows] = np.broadcast_to(sigma, difference.shape)**-2.0, difference
        e_c = ((state.c - m.calibration.stated)[active] / problem.sigma[active])
        border = np.zeros((n + len(e_c), len(e_c) + 1))
        border[:n, -1], border[n:, -1] = H * e, e_c
        border[n:, :-1] = np.eye(len(e_c))
        return Group(H, border, float(np.sum(H * e**2) + e_c @ e_c))

    @cached_property
    def _measurement_groups(self):
        """The Group of each kind of `linearized`, None if there are no such measurements."""
        return [self._group(places[f.index], rows[f.index], f.J, f.J_c, f.columns, f.e)
                if len(f.row) else None
                for f, (places, rows) in zip(
                    self.linearized, self.problem.measurements.factor_places[1:])]

    @cached_property
    def _odometry(self):
        """Function from a slip to the Group of the odometry and sum log|Q|."""
        factors, active = self.problem.odometry, self.problem.active[WHEELS]
        places = self.problem.measurements.factor_places[0]
        e, J, J_c = odometry_error(factors, self.state.poses, self.state.c[WHEELS])
        J_c = J_c[:, :, active] * self.problem.sigma[WHEELS][active]

        @lru_cache(maxsize=MAX_CACHED_SLIPS)
        def odometry(slip):
            U, log_determinant = factors.whitening(slip)
            return self._group(*places, U @ J, U @ J_c, np.arange(active.sum()),
                               (U @ e[..., None])[..., 0]), log_determinant

        return odometry

    def _group(self, places, rows, J, J_c, columns, e):
        """The Group of whitened errors e (m, d), with derivatives J (m, d, p) at `rows` (m, p).

        J_c (m, d, u) are those by the entries `columns` (u,) of the calibration.
        """
        n, q = len(self.structure.diagonal), self.problem.active.sum()
        J_t, last = np.swapaxes(J, 1, 2), np.concatenate([J_c, e[..., None]], axis=2)
        border, product = np.zeros((n + q, q + 1)), J_t @ last
        for column, values in zip((*columns, q), np.moveaxis(product, 2, 0)):
            border[:n, column] = _summed(rows, values, n)
        border[n + columns[:, None], (*columns, q)] = np.tensordot(J_c, last, ([0, 1], [0, 1]))
        return Group(_summed(places, J_t @ J, len(self.structure.indices)), border,
                     float(np.sum(e**2)))


def _summed(places, values, size):
    """(size,) sums of the values at each place."""
    return np.bincount(places.ravel(), values.ravel(), size).astype(float, copy=False)


def decomposition(H):
    """Sparse decomposition of H (n, n), ordered for elimination; None if H is singular."""
    try:
        return splu(H, permc_spec="NATURAL", diag_pivot_thresh=0.0, relax=1, panel_size=1,
                    options={"SymmetricMode": True})
    except RuntimeError:
        return None


def linear_solution(structure, H, border):
    """The LinearSolution of normal equations, None where they are singular to rounding.

    From the data of H and the `border` of the Groups' sum.
    """
    n, lu = len(structure.diagonal), decomposition(structure.matrix(H))
    pivots = np.zeros(1) if lu is None else lu.U.diagonal()
    if not (pivots > 0).all():                           # H is not positive definite
        return None
    solved = lu.solve(border[:n])
    reduced = border[n:] - border[:n, :-1].T @ solved
    S, gradient = (reduced[:, :-1] + reduced[:, :-1].T) / 2, reduced[:, -1]
    sign, log_determinant = np.linalg.slogdet(S)
    if not sign > 0 or (np.diag(S) <= 0).any():
        return None
    c = -np.linalg.solve(S, gradient)
    delta = np.concatenate([-solved[:, -1] - solved[:, :-1] @ c, c])
    return LinearSolution(delta=delta, lu=lu, by_c=solved[:, :-1], S=S, gradient=gradient,
                    log_determinant=log_determinant + np.sum(np.log(pivots)),
                    decrease=-float(border[:, -1] @ delta) / 2)


def laplace_approximation(equations, noise):
    """Solution delta (n + q,) of NormalEquations for a Noise, and log evidence up to a constant.

    With the whitened errors e at the solution, the noise factors l_s and l_r of S errors of
    sightings and R of ranges, and the whole information matrix I, calibration in sigmas,

        log evidence = -|e|^2 / 2 - sum log|Q| / 2 - S log l_s - R log l_r - log|I| / 2

    (MacKay, Neural Computation 4(3), 1992). The omitted constant depends on the dataset and the
    weights: only problems on the same accepted measurements can be compared. The log evidence is
    minus infinity where the equations are singular to rounding.
    """
    H, border, squared, log_determinant = equations.sums(
        noise, consistency_factors(equations.problem.accepted))
    solution = linear_solution(equations.structure, H, border)
    sightings, ranges = equations.counts()
    if solution is None:
        return np.full(len(border), np.nan), -np.inf
    return solution.delta, -squared / 2 + solution.decrease - log_determinant / 2 \
        - solution.log_determinant / 2 \
        - sightings * np.log(noise.sightings) - ranges * np.log(noise.ranges)


def consistency_factors(accepted):
    """`consistency_factor` (3,) of sightings of poses, of points, and of ranges."""
    return (consistency_factor(accepted.sighting_kernel, 3),
            consistency_factor(accepted.sighting_kernel, 2),
            consistency_factor(accepted.range_kernel))


@lru_cache(maxsize=8)
def consistency_factor(kernel, size=1):
    """Mean of the squares of standard normal residuals of `size` components, weighted by a kernel.

    The kernel weighs a residual by its norm, or by its signed value if `size` is 1. It removes part
    of the variance of Gaussian residuals; without this factor the learned sigma would be too small
    (Huber and Ronchetti, Robust Statistics, 2009, chapter 5). The factor is 1 without kernel.
    """
    if kernel is None:
        return 1.0
    r = np.linspace(-6 if size == 1 else 0, 6, 241)
    density = r**(size - 1) * np.exp(-r**2 / 2) * np.array([kernel.weight(x) for x in r])
    return float(np.sum(r**2 * density) / np.sum(density)) / size


def log_evidence(problem, state):
    """Log evidence of a Problem by `laplace_approximation` at a State near its optimum."""
    return laplace_approximation(NormalEquations(problem, state), problem.noise)[1]
