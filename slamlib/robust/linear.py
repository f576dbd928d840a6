"""Stages 2 and 3: the factor graph as records, its normal equations H delta = -g, the evidence.

With whitened errors e and derivatives J of all factors, H = sum J^T J and g = sum J^T e. The
calibration touches nearly all factors and is eliminated last: with the information matrix
[[H, B], [B^T, D]] and the gradient [g, g_c], only H, which is sparse, is decomposed, and

    S = D - B^T H^-1 B,    delta_c = -S^-1 (g_c - B^T H^-1 g),    delta = -H^-1 (g + B delta_c).

The factors are linearised once, and H, B, D and g are summed by groups: priors, odometry, sightings
and ranges. The group of odometry depends on the slip, those of sightings and ranges only on their
noise factors. Each value of the noise then costs one decomposition, which gives its evidence.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import splu

from slamlib.core import odometry, se2
from slamlib.core.graph import GUESS_PRIOR_SIGMA
from slamlib.core.preintegration import OdometryIncrements
from slamlib.robust.factors import (
    linearize_measurements,
    linearize_odometry,
    preintegrate_odometry,
)
from slamlib.robust.measurements import (
    WEAK_SIGMA,
    AcceptedMeasurements,
    Measurements,
    Noise,
    accept_all,
    with_known,
)


@dataclass(frozen=True)
class State:
    """Values of all variables."""

    poses: np.ndarray        # (f, 3) m, m, rad; headings continuous
    markers: np.ndarray      # (k, 3), heading 0 where a marker is a point
    antennas: np.ndarray     # (a, 2) m
    c: np.ndarray            # (p,) of the calibration, in the units of its entries


def state_from_arrays(measurements, poses, markers, antennas, c):
    """The State of poses (f, 3), markers (k, 3), antennas (a, 2) and calibration c (p,).

    Headings become continuous: between two frames they turn by odometry's angle, up to half a turn.
    """
    turn, poses = np.diff(measurements.path[measurements.frame, 2]), np.array(poses, dtype=float)
    correction = se2.wrap(np.diff(poses[:, 2]) - turn)
    poses[:, 2] = odometry.cumulative(turn + correction, se2.wrap(poses[0, 2]))
    markers = np.array(markers, dtype=float)
    markers[~measurements.oriented, 2] = 0
    return State(poses=poses, markers=markers, antennas=np.asarray(antennas, dtype=float),
                 c=np.asarray(c, dtype=float))


def retract(problem, state, delta):
    """The State after a step delta (n + q,) in m and rad, and in sigmas of the q unknowns of c.

    Poses and markers move in their own axes: X becomes X delta.
    """
    m, structure, c = problem.measurements, problem.measurements.structure, state.c.copy()
    c[problem.active] += problem.sigma[problem.active] * delta[len(structure.diagonal):]
    poses, markers, antennas = np.split(
        delta[structure.rows(slice(None))], np.cumsum([len(m.frame), len(m.marker)]))
    return state_from_arrays(
        m, se2.compose(state.poses, poses), se2.compose(state.markers, markers),
        state.antennas + antennas[:, :2], c)


@dataclass(frozen=True)
class Problem:
    """The factor graph."""

    measurements: Measurements
    odometry: OdometryIncrements
    accepted: AcceptedMeasurements
    noise: Noise
    sigma: np.ndarray        # (p,) of the prior of the calibration, 0 of what is known
    released: frozenset = frozenset()    # groups of the calibration beyond their stated sigmas
    active = property(lambda self: self.sigma > 0)      # (p,) bool, entries among the q unknowns


def build_problem(measurements, model, noise=None, wheel=None):
    """The Problem of all Measurements with weight 1, without kernels, and of a Noise.

    Without a Noise it is the typical one. Parameters that the Vehicle gives replace its own.
    Odometry is of the `model` "arc" or "euler", linearised at `wheel` (3,) m, None for the stated
    one. The calibration is as stated, but for the delay of sightings that are late.
    """
    late = frozenset({"time-offset"} if measurements.jumps.lag else ())
    return Problem(
        measurements=measurements, odometry=preintegrate_odometry(measurements, model, wheel),
        accepted=accept_all(measurements),
        noise=with_known(noise or Noise(), measurements.dataset.vehicle),
        sigma=measurements.calibration.sigma_without(late), released=late)


class Group(NamedTuple):
    """Sums over a group of factors of n unknowns and q entries of the calibration."""

    H: np.ndarray            # data of `Structure.matrix`; of the priors the diagonal (n,)
    border: np.ndarray       # (n + q, q + 1), [[B, g], [D, g_c]]
    squared: float           # sum of squared whitened errors


@dataclass(frozen=True)
class LinearSolution:
    """The normal equations solved."""

    delta: np.ndarray        # (n + q,) the step, in sigmas of the calibration
    S: np.ndarray            # (q, q) information about the calibration
    gradient: np.ndarray     # (q,) by the calibration, the other unknowns eliminated
    log_determinant: float   # of the information matrix
    decrease: float          # of half the squared error, by the step


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations, with unknowns in the order of `structure` and then the calibration."""

    problem: Problem
    state: State
    structure = property(attrgetter("problem.measurements.structure"))      # of H

    @cached_property
    def error(self):
        """Half the sum of squared whitened errors, kernels applied."""
        odometry, _ = self._odometry(self.problem.noise.slip)
        return float(odometry.squared + self.priors.squared) / 2 \
            + sum(kind.error for kind in self.linearized)

    @cached_property
    def linearized(self):
        """The LinearizedFactors of sightings and of ranges."""
        return linearize_measurements(self.problem, self.state)

    def step(self):
        """The Gauss-Newton step delta (n + q,), or None where H is singular to rounding."""
        H, border, *_ = self.sums(self.problem.noise)
        solution = linear_solution(self.structure, H, border)
        return solution.delta if solution is not None and solution.decrease >= 0 else None

    def sums(self, noise, consistent=False):
        """Data of H, border, squared error at the state, and sum log|Q| of the odometry noise Q.

        If `consistent`, measurements count over the `consistency_factor` of their robust kernel.
        """
        odometry, log_determinant = self._odometry(noise.slip)
        total = odometry.H.copy(), odometry.border + self.priors.border, \
            odometry.squared + self.priors.squared
        total[0][self.structure.diagonal] += self.priors.H
        sizes = 2 + self.problem.measurements.oriented.any(), 1
        shares = [(given / wanted)**2 / (consistency_factor(kind.kernel, size) if consistent else 1)
                  for kind, size, given, wanted in zip(
                      self.problem.accepted, sizes, self.problem.noise[1:], noise[1:])]
        for group, share in zip(self._measurement_groups, shares):
            if group is not None:
                total = [each + share * part for each, part in zip(total, group)]
        return *total, log_determinant

    def counts(self):
        """Numbers of accepted errors of sightings and of ranges."""
        sightings, ranges = self.linearized
        size = 2 + self.problem.measurements.as_pose[sightings.index]
        return np.sum(size * sightings.weight), np.sum(ranges.weight)

    @cached_property
    def priors(self):
        """The Group of the priors, whose H and D are diagonal."""
        problem, m, state = self.problem, self.problem.measurements, self.state
        f, active, n = len(m.frame), problem.active, len(self.structure.diagonal)
        weak = np.bincount(m.marker_row, problem.accepted.sightings.weight, len(m.marker)) == 0
        parts = [([0], se2.log(state.poses[:1]), m.origin_sigma),
                 (slice(f + len(m.marker), None), state.antennas - m.guess, GUESS_PRIOR_SIGMA),
                 (f + np.flatnonzero(weak), state.markers[weak], WEAK_SIGMA)]
        H, e = np.zeros((2, n))
        for variables, difference, sigma in parts:
            rows = self.structure.rows(variables, difference.shape[1])
            H[rows], e[rows] = np.broadcast_to(sigma, difference.shape)**-2.0, difference
        H[self.structure.rows(~self.structure.is_pose)[:, 2]] = 1       # what points do not have
        e_c = ((state.c - m.calibration.stated)[active] / problem.sigma[active])
        border = np.zeros((n + len(e_c), len(e_c) + 1))
        border[:n, -1], border[n:, -1] = H * e, e_c
        border[n:, :-1] = np.eye(len(e_c))
        return Group(H, border, float(np.sum(H * e**2) + e_c @ e_c))

    @cached_property
    def _measurement_groups(self):
        """The Group of each kind of `linearized`, None where there are no factors."""
        return [self._group(kind, factors) if len(factors.e) else None
                for kind, factors in enumerate(self.linearized, start=1)]

    @cached_property
    def _odometry(self):
        """Function from a slip to the Group of the odometry and sum log|Q|."""
        def odometry(slip):
            factors, log_determinant = linearize_odometry(self.problem, self.state, slip)
            return self._group(0, factors), log_determinant

        return lru_cache(maxsize=3)(odometry)

    def _group(self, kind, factors):
        """The Group of LinearizedFactors of the kind with this number in `structure.factors`."""
        structure, q = self.structure, self.problem.active.sum()
        n, e, J, J_c = len(structure.diagonal), factors.e, factors.J, factors.J_c
        J_t, last = np.swapaxes(J, 1, 2), np.concatenate([J_c, e[..., None]], axis=2)
        squares = (J_t @ J).reshape(-1, 2, 3, 2, 3).swapaxes(2, 3).reshape(-1, 9)
        H = _summed(structure.blocks[kind][factors.index], squares, structure.places.nnz // 9)
        border, columns = np.zeros((n + q, q + 1)), np.r_[factors.columns, q]
        border[:n, columns] = _summed(
            structure.position[structure.factors[kind][factors.index]],
            (J_t @ last).reshape(-1, 3 * len(columns)), n // 3).reshape(n, -1)
        border[n + columns[:-1, None], columns] = np.tensordot(J_c, last, ([0, 1], [0, 1]))
        return Group(H.ravel(), border, float(np.sum(e**2)))


def _summed(number, values, size):
    """(size, w) sums of the rows of values (m j, w) with each `number` (m, j)."""
    return csc_array((np.ones(number.size), number.ravel(), np.arange(number.size + 1)),
                     (size, number.size)) @ values


def linear_solution(structure, H, border):
    """The LinearSolution by data of H and `border`, None where they are singular to rounding."""
    n = len(structure.diagonal)
    try:                                                 # H is ordered for elimination
        lu = splu(structure.matrix(H), permc_spec="NATURAL", diag_pivot_thresh=0.0, relax=1,
                  panel_size=1, options={"SymmetricMode": True})
    except RuntimeError:
        return None
    pivots = lu.U.diagonal()
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
    return LinearSolution(delta=delta, S=S, gradient=gradient,
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
    H, border, squared, log_determinant = equations.sums(noise, consistent=True)
    solution = linear_solution(equations.structure, H, border)
    sightings, ranges = equations.counts()
    if solution is None:
        return np.full(len(border), np.nan), -np.inf
    return solution.delta, -squared / 2 + solution.decrease - log_determinant / 2 \
        - solution.log_determinant / 2 \
        - sightings * np.log(noise.sightings) - ranges * np.log(noise.ranges)


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
