"""Stage 3: the normal equations H delta = -g of a problem at a state, and the Laplace evidence.

With whitened errors e and derivatives J of all factors, H = sum J^T J and g = sum J^T e. The
factors are linearised once, and H and g are summed by groups: priors, odometry, sightings and
ranges. The group of odometry depends on the slip, those of sightings and ranges only on their noise
factors. Each value of the noise then costs one sparse decomposition, which gives its evidence.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.sparse.linalg import splu

from slamlib import se2
from slamlib.slam.factors import Problem, State, linearize_measurements, odometry_error
from slamlib.slam.measurements import GUESS_PRIOR_SIGMA, WEAK_SIGMA

MAX_CACHED_SLIPS = 3         # values of the slip whose sums are kept in memory


@dataclass(frozen=True)
class Group:
    """Sums over a group of factors."""

    H: np.ndarray            # data of `Structure.matrix`; of the priors the diagonal (n,)
    g: np.ndarray            # (n,)
    squared: float           # sum of squared whitened errors


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations H delta = -g of n unknowns, in the order of `structure`."""

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
        return linearize_measurements(self.problem.accepted, self.problem.noise, self.state)

    def step(self):
        """The Gauss-Newton step delta (n,), or None where H is singular to rounding."""
        H, g, *_ = self.sums(self.problem.noise)
        lu = decomposition(self.structure.matrix(H))
        delta = None if lu is None else -lu.solve(g)
        return delta if delta is not None and g @ delta <= 0 else None     # else not a descent

    def sums(self, noise, consistency=(1.0, 1.0, 1.0)):
        """Data of H, g (n,), squared error at the state, and sum log|Q| of the odometry noise Q.

        `consistency` (3,) divides the contribution of each kind of `linearized` by its consistency
        factor, which corrects the bias of a robust kernel (`consistency_factors`).
        """
        odometry, log_determinant = self._odometry(noise.slip)
        H, g, squared = odometry.H.copy(), odometry.g.copy(), odometry.squared
        H[self.structure.diagonal] += self.priors.H
        g += self.priors.g
        squared += self.priors.squared
        sightings = (self.problem.noise.sightings / noise.sightings)**2
        ranges = (self.problem.noise.ranges / noise.ranges)**2
        for group, ratio, divisor in zip(
                self._measurement_groups, (sightings, sightings, ranges), consistency):
            if group is not None:
                ratio = ratio / divisor
                H += group.H if ratio == 1 else ratio * group.H
                g += ratio * group.g
                squared += ratio * group.squared
        return H, g, squared, log_determinant

    def counts(self):
        """Numbers of accepted errors of sightings and of ranges."""
        poses, points, ranges = (f.e.shape[1] * np.sum(f.weight) for f in self.linearized)
        return poses + points, ranges

    @cached_property
    def priors(self):
        """The Group of the priors, whose H is diagonal: (n,)."""
        m, v, state = self.problem.measurements, self.problem.measurements.variables, self.state
        parts = [(v.frames[:1], se2.log(state.poses[:1]), m.origin_sigma),
                 (v.antennas, state.antennas - m.guess, GUESS_PRIOR_SIGMA),
                 (v.w, state.w[None], 1.0)]
        parts += [(v.markers[[j]], state.markers[[j], :2 + m.oriented[j]], WEAK_SIGMA)
                  for j in self.problem.accepted.unsupported]
        if m.calibrated:
            parts.append((v.c, state.c[None], 1.0))
        H, e = np.zeros((2, len(self.structure.diagonal)))
        for variables, difference, sigma in parts:
            rows = self.structure.rows(variables, difference.shape[1])
            H[rows], e[rows] = np.broadcast_to(sigma, difference.shape)**-2.0, difference
        return Group(H, H * e, float(np.sum(H * e**2)))

    @cached_property
    def _measurement_groups(self):
        """The Group of each kind of `linearized`, None if there are no such measurements."""
        return [_group(self.structure, places[f.index], rows[f.index], f.J, f.e)
                if len(f.row) else None
                for f, (places, rows) in zip(
                    self.linearized, self.problem.measurements.factor_places[1:])]

    @cached_property
    def _odometry(self):
        """Function from a slip to the Group of the odometry and sum log|Q|."""
        structure, factors = self.structure, self.problem.odometry
        places = self.problem.measurements.factor_places[0]
        e, J = odometry_error(factors, self.state.poses, self.state.w)

        @lru_cache(maxsize=MAX_CACHED_SLIPS)
        def odometry(slip):
            U, log_determinant = factors.whitening(slip)
            return _group(structure, *places, U @ J, (U @ e[..., None])[..., 0]), log_determinant

        return odometry


def _group(structure, places, rows, J, e):
    """The Group of whitened errors e (m, d) and derivatives J (m, d, p) at `rows` (m, p)."""
    J_t = np.swapaxes(J, 1, 2)
    return Group(
        _summed(places, J_t @ J, len(structure.indices)),
        _summed(rows, J_t @ e[..., None], len(structure.diagonal)), float(np.sum(e**2)))


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


def laplace_approximation(equations, noise):
    """Solution delta (n,) of NormalEquations for a Noise, and the log evidence, up to a constant.

    With the whitened errors e at the solution, the noise factors l_s and l_r of S errors of
    sightings and R of ranges,

        log evidence = -|e|^2 / 2 - sum log|Q| / 2 - S log l_s - R log l_r - log|H| / 2

    (MacKay, Neural Computation 4(3), 1992). The omitted constant depends on the dataset and the
    weights: only problems on the same accepted measurements can be compared. The log evidence is
    minus infinity where H is singular to rounding.
    """
    H, g, squared, log_determinant = equations.sums(
        noise, consistency_factors(equations.problem.accepted))
    lu = decomposition(equations.structure.matrix(H))
    pivots = np.zeros(1) if lu is None else lu.U.diagonal()
    if (pivots <= 0).any():                              # H is not positive definite
        return np.full(len(g), np.nan), -np.inf
    delta, (sightings, ranges) = -lu.solve(g), equations.counts()
    return delta, -(squared + g @ delta) / 2 - log_determinant / 2 \
        - np.sum(np.log(pivots)) / 2 \
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
