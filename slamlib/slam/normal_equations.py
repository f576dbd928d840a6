"""Stage 3: the normal equations of a problem at a state, for all values of the noise.

The factors are linearised once, and their information is summed by groups: priors, odometry,
sightings and ranges. The information of odometry depends on the slip, that of the sightings and of
the ranges on their factors alone. Each value of the noise then costs one sparse decomposition.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse.linalg import splu

from slamlib import se2
from slamlib.slam.linear_factors import linear_factors
from slamlib.slam.measurement_factors import GUESS_PRIOR_SIGMA, WEAK_SIGMA
from slamlib.slam.odometry_factors import odometry_error
from slamlib.slam.problem import Problem
from slamlib.slam.state import State

KEPT = 3                     # values of the slip whose sums are kept


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
        squared = self._odometry_sums(self.problem.noise.slip)[2] + self._priors.squared
        return float(squared) / 2 + sum(factors.error for factors in self.factors)

    @cached_property
    def factors(self):
        """The LinearFactors of sightings of poses, of points, and of ranges."""
        return linear_factors(self.problem.measured, self.problem.noise, self.state)

    def step(self):
        """The Gauss-Newton step (n,), or None where H is singular to rounding."""
        H, g, *_ = self.sums(self.problem.noise)
        lu = decomposition(self.structure.matrix(H))
        step = None if lu is None else -lu.solve(g)
        return step if step is not None and g @ step <= 0 else None        # else not a descent

    def sums(self, noise, from_kernels=(1.0, 1.0, 1.0)):
        """Data of H, g, squared error at the state, and sum log|Q| of the odometry noise Q.

        `from_kernels` (3,) divide what the factors contribute (`evidence.consistencies`).
        """
        given, priors = self.problem.noise, self._priors
        H, g, squared, log_determinant = self._odometry_sums(noise.slip)
        H, g, squared = H.copy(), g + priors.g, squared + priors.squared
        H[self.structure.diagonal] += priors.H
        of_sightings = (given.sightings / noise.sightings)**2
        of_ranges = (given.ranges / noise.ranges)**2
        for group, ratio, from_kernel in zip(
                self._measured, (of_sightings, of_sightings, of_ranges), from_kernels):
            if group is not None:
                ratio = ratio / from_kernel
                H += group.H if ratio == 1 else ratio * group.H
                g += ratio * group.g
                squared += ratio * group.squared
        return H, g, squared, log_determinant

    @property
    def of_priors(self):
        """What the priors add to the diagonal (n,) of H."""
        return self._priors.H

    def counts(self):
        """Numbers of accepted errors of sightings and of ranges."""
        poses, points, ranges = (f.e.shape[1] * np.sum(f.weight) for f in self.factors)
        return poses + points, ranges

    def jacobian(self, factors):
        """Derivatives (m, d, c) of LinearFactors by the unknowns of their variables."""
        J = [factors.by_pose, factors.by_landmark]
        if self.problem.measurements.calibrated and factors.by_calibration is not None:
            J.append(factors.by_calibration)
        return np.concatenate(J, axis=2)

    @cached_property
    def _measured(self):
        """The _Groups of `factors`, None where there are no such measurements."""
        return [_group(self.structure, places[f.index], rows[f.index], self.jacobian(f), f.e)
                if len(f.row) else None
                for f, (places, rows) in zip(self.factors, self.problem.measurements.placed[1:])]

    @cached_property
    def _odometry(self):
        """Unwhitened errors (f-1, 3) and derivatives (f-1, 3, 9) of the odometry."""
        e, *jacobians = odometry_error(self.problem.odometry, self.state.poses, self.state.w)
        return e, np.concatenate(jacobians, axis=2)

    def _odometry_sums(self, slip):
        """`sums` of the odometry alone; those of the last slips are kept."""
        kept = self._kept_sums
        if slip not in kept:
            if len(kept) == KEPT:
                del kept[next(iter(kept))]
            e, J = self._odometry
            U, log_determinant = self.problem.odometry.whitening(slip)
            J, e = U @ J, (U @ e[..., None])[..., 0]
            own = _group(self.structure, *self.problem.measurements.placed[0], J, e)
            kept[slip] = own.H, own.g, own.squared, log_determinant
        return kept[slip]

    @cached_property
    def _kept_sums(self):
        return {}

    @cached_property
    def _priors(self):
        """The _Group of the priors, whose H is the diagonal (n,)."""
        problem, m, state = self.problem, self.problem.measurements, self.state
        f, k = len(m.frame), len(m.marker)
        parts = [([0], se2.log(state.poses[:1]), m.origin_sigma), ([m.wheels], state.w[None], 1.0),
                 (f + k + np.arange(len(m.antenna)), state.antennas - m.guess, GUESS_PRIOR_SIGMA)]
        parts += [([f + j], state.markers[j:j + 1, :2 + m.oriented[j]], WEAK_SIGMA)
                  for j in problem.measured.unsupported]
        if m.calibrated:
            parts.append(([m.wheels + 1], state.z[None], 1.0))
        information, e = np.zeros((2, len(self.structure.diagonal)))
        for variables, off, sigma in parts:
            rows = self.structure.rows(np.asarray(variables), off.shape[1])
            information[rows], e[rows] = np.broadcast_to(sigma, off.shape)**-2.0, off
        return _Group(information, information * e, float(np.sum(information * e**2)))


@dataclass(frozen=True)
class _Group:
    """What factors add to H (data of `Structure.matrix`), to g (n,) and to the squared error."""

    H: np.ndarray
    g: np.ndarray
    squared: float


def _group(structure, places, rows, J, e):
    """The _Group of whitened errors e (m, d) and derivatives J (m, d, c) at `rows` (m, c)."""
    J_t = np.swapaxes(J, 1, 2)
    return _Group(
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
