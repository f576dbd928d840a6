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

import numpy as np
from gtsam.noiseModel import mEstimator
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU, splu, spsolve_triangular

from slamlib.core import odometry, se2
from slamlib.core.graph import GUESS_PRIOR_SIGMA
from slamlib.core.graph_solution import undetermined
from slamlib.core.increments import OdometryIncrements
from slamlib.robust.calibration import Prior
from slamlib.robust.factors import (
    LinearizedFactors,
    linearize_measurements,
    linearize_odometry,
    preintegrate_odometry,
)
from slamlib.robust.measurements import (
    WEAK_SIGMA,
    AcceptedMeasurements,
    Measurements,
    Noise,
    Structure,
    accept_all,
    with_known,
)

KEPT_SLIPS = 3               # number of values for which the sums of odometry are kept


@dataclass(frozen=True)
class State:
    """Values of all variables."""

    poses: np.ndarray        # (f, 3) m, m, rad; headings continuous
    markers: np.ndarray      # (k, 3), heading 0 where a marker is a point
    antennas: np.ndarray     # (a, 2) m
    c: np.ndarray            # (p,) of the calibration, in the units of its entries


def state_from_arrays(measurements: Measurements, poses: np.ndarray, markers: np.ndarray,
                      antennas: np.ndarray, c: np.ndarray) -> State:
    """The State of poses (f, 3), markers (k, 3), antennas (a, 2) and calibration c (p,).

    Headings become continuous: between two frames they turn by odometry's angle, up to half a turn.
    """
    poses = np.array(poses, dtype=float)
    turn = np.diff(measurements.path[measurements.frame, 2])
    correction = se2.wrap(np.diff(poses[:, 2]) - turn)
    poses[:, 2] = odometry.cumulative(turn + correction, se2.wrap(poses[0, 2]))
    markers = np.array(markers, dtype=float)
    markers[~measurements.oriented, 2] = 0
    return State(poses, markers, np.asarray(antennas), c)


@dataclass(frozen=True)
class Problem:
    """The factor graph."""

    measurements: Measurements
    odometry: OdometryIncrements
    accepted: AcceptedMeasurements
    noise: Noise
    prior: Prior             # of the calibration
    reference: np.ndarray    # (p,) a calibration, by whose delays rows are chosen
    memory_first: bool = False   # whether memory is sought before a slip is learned
    max_slip: float = np.inf     # sqrt(m), of a slip that is learned

    @property
    def active(self) -> np.ndarray:
        """(p,) bool, entries of the calibration among the q unknowns."""
        return self.prior.active


def build_problem(measurements: Measurements, model: str, noise: Noise | None = None,
                  wheel: np.ndarray | None = None) -> Problem:
    """The Problem of all Measurements with weight 1, without kernels, and of a Noise.

    Without a Noise it is the typical one. Parameters that the Vehicle gives replace its own.
    Odometry is of the `model` "arc" or "euler", linearised at `wheel` (3,) m, None for the stated
    one. The calibration is as stated, but for what the Jumps say of the camera.
    """
    noise = with_known(noise or Noise(), measurements.dataset.vehicle)
    return Problem(
        measurements=measurements,
        odometry=preintegrate_odometry(measurements, model, wheel, noise.slip),
        accepted=accept_all(measurements), noise=noise,
        prior=measurements.calibration.prior(measurements.jumps.groups),
        reference=measurements.calibration.stated)


def retract(problem: Problem, state: State, delta: np.ndarray) -> State:
    """The State after a step delta (n + q,) in m and rad, and in sigmas of the q unknowns of c.

    Poses and markers move in their own axes: X becomes X delta.
    """
    m = problem.measurements
    by_variable = delta[m.structure.rows]
    of_frames, of_markers, of_antennas = np.split(
        by_variable, np.cumsum([len(m.frame), len(m.marker)]))
    c = state.c + problem.prior.of(slice(None)) @ delta[by_variable.size:]
    return state_from_arrays(
        m, se2.compose(state.poses, of_frames), se2.compose(state.markers, of_markers),
        state.antennas + of_antennas[:, :2], c)


@dataclass(frozen=True)
class Sums:
    """Sums over factors of n unknowns and q entries of the calibration."""

    H: np.ndarray            # data of `Structure.matrix`
    border: np.ndarray       # (n + q, q + 1), [[B, g], [D, g_c]]
    squared: float           # sum of squared whitened errors
    log_determinant: float   # sum log|Q| of odometry, in the metres of its wheels


@dataclass(frozen=True)
class LinearSolution:
    """The normal equations solved."""

    delta: np.ndarray        # (n + q,) the step, in sigmas of the calibration
    S: np.ndarray            # (q, q) information about the calibration
    gradient: np.ndarray     # (q,) by the calibration, the other unknowns eliminated
    log_determinant: float   # of the information matrix
    decrease: float          # of half the squared error, by the step
    by_c: np.ndarray         # (n, q) H^-1 B
    lu: SuperLU              # of H


@dataclass(frozen=True)
class NormalEquations:
    """The normal equations, with unknowns in the order of `structure` and then the calibration."""

    problem: Problem
    state: State
    structure = property(attrgetter("problem.measurements.structure"))      # of H

    @cached_property
    def error(self) -> float:
        """Half the sum of squared whitened errors, kernels applied."""
        odometry = self._odometry(self.problem.noise.slip)
        of_measurements = sum(factors.error for factors in self.linearized)
        return (odometry.squared + self.priors.squared) / 2 + of_measurements

    @cached_property
    def linearized(self) -> tuple[LinearizedFactors, LinearizedFactors]:
        """The LinearizedFactors of sightings and of ranges."""
        return linearize_measurements(self.problem, self.state)

    def step(self) -> np.ndarray | None:
        """The Gauss-Newton step delta (n + q,), or None where H is singular to rounding."""
        solution = linear_solution(self.structure, self.sums(self.problem.noise))
        return None if solution is None else solution.delta

    def sums(self, noise: Noise, consistent: bool = False) -> Sums:
        """The Sums over all factors for a Noise.

        If `consistent`, measurements count over the `consistency_factor` of their robust kernel.
        """
        given = self.problem.noise
        accepted = self.problem.accepted
        of_sightings = (given.sightings / noise.sightings)**2
        of_ranges = (given.ranges / noise.ranges)**2
        if consistent:
            size = 2 + self.problem.measurements.oriented.any()
            of_sightings /= consistency_factor(accepted.sightings.kernel, size)
            of_ranges /= consistency_factor(accepted.ranges.kernel)
        sightings, ranges = self._measured
        odometry = self._odometry(noise.slip)
        parts = [(1, odometry), (1, self.priors), (of_sightings, sightings), (of_ranges, ranges)]
        return Sums(
            H=sum(weight * part.H for weight, part in parts),
            border=sum(weight * part.border for weight, part in parts),
            squared=sum(weight * part.squared for weight, part in parts),
            log_determinant=odometry.log_determinant)

    def counts(self) -> list[float]:
        """Numbers of accepted errors of sightings and of ranges."""
        return [factors.count for factors in self.linearized]

    @cached_property
    def priors(self) -> Sums:
        """The Sums of the priors, whose H and D are diagonal."""
        m = self.problem.measurements
        state = self.state
        structure = self.structure
        e = np.zeros((len(structure.is_pose), 3))
        sigma = np.full_like(e, np.inf)
        e[0] = se2.log(state.poses[0])
        sigma[0] = m.origin_sigma
        counted = m.marker_row[self.problem.accepted.sightings.weight > 0]
        weak = np.setdiff1d(np.arange(len(m.marker)), counted)
        e[len(m.frame) + weak] = state.markers[weak]
        sigma[len(m.frame) + weak] = WEAK_SIGMA
        antenna = slice(len(m.frame) + len(m.marker), None)
        e[antenna, :2] = state.antennas - m.guess
        sigma[antenna, :2] = GUESS_PRIOR_SIGMA
        sigma[~structure.is_pose, 2] = 1                 # what points do not have
        precision = 1 / sigma**2
        e_c = self.problem.prior.unknowns(state.c - m.calibration.stated)
        q = len(e_c)
        border = np.zeros((e.size + q, 1 + q))
        border[structure.rows, -1] = precision * e
        border[e.size:] = np.column_stack([np.eye(q), e_c])
        H = np.zeros(structure.places.nnz)
        H[structure.diagonal[structure.rows]] = precision
        return Sums(H, border, np.sum(precision * e**2) + e_c @ e_c, 0.0)

    @cached_property
    def _measured(self):
        """The Sums of sightings and of ranges."""
        return [self._summed(factors) for factors in self.linearized]

    def _odometry(self, slip):
        """The Sums of odometry with a slip in sqrt(m)."""
        recent = self._recent_odometry
        if slip not in recent:
            if len(recent) == KEPT_SLIPS:
                recent.clear()
            recent[slip] = self._summed(linearize_odometry(self.problem, self.state, slip))
        return recent[slip]

    @cached_property
    def _recent_odometry(self):
        """The last Sums of odometry by their slip."""
        return {}

    def _summed(self, factors):
        """The Sums of LinearizedFactors."""
        structure = self.structure
        n = len(structure.diagonal)
        q = self.problem.active.sum()
        J_t = factors.J.mT
        J_c_e = np.concatenate([factors.J_c, factors.e[:, :, None]], axis=2)
        in_blocks = (J_t @ factors.J).reshape(-1, 2, 3, 2, 3).swapaxes(2, 3)
        blocks = structure.blocks[factors.index]
        H = _summed_by(blocks, in_blocks.reshape(-1, 9), structure.places.nnz // 9)
        rows = structure.rows[structure.variables[factors.index]]
        columns = np.append(factors.columns, q)
        in_rows = (J_t @ J_c_e).reshape(-1, len(columns))
        border = np.zeros((n + q, q + 1))
        border[:n, columns] = _summed_by(rows, in_rows, n)
        border[n + factors.columns[:, None], columns] = np.tensordot(
            factors.J_c, J_c_e, ([0, 1], [0, 1]))
        return Sums(H.ravel(), border, np.sum(factors.e**2), factors.log_determinant)


def errors_after(factors: LinearizedFactors, structure: Structure,
                 steps: np.ndarray) -> np.ndarray:
    """Changes (m, d, k) of the whitened errors of LinearizedFactors by steps (n + q, k)."""
    rows = structure.rows[structure.variables[factors.index]].reshape(-1, 6)
    of_c = steps[len(structure.diagonal) + factors.columns]
    return factors.J @ steps[rows] + factors.J_c @ of_c


def _summed_by(number, values, count):
    """(count, w) sums of those rows of values (m, w) that have the same number (m,), of any shape.

    As a product with a matrix that has a 1 in each column.
    """
    starts = np.arange(number.size + 1)                  # of the columns
    ones = csc_array((np.ones(number.size), number.ravel(), starts), (count, number.size))
    return ones @ values


def linear_solution(structure: Structure, sums: Sums) -> LinearSolution | None:
    """The LinearSolution by Sums over all factors, None where they are singular to rounding."""
    n = len(structure.diagonal)
    try:                                                 # H is ordered for elimination
        lu = splu(structure.matrix(sums.H), permc_spec="NATURAL", diag_pivot_thresh=0.0, relax=1,
                  panel_size=1, options={"SymmetricMode": True})
    except RuntimeError:
        return None
    pivots = lu.U.diagonal()
    if not (pivots > 0).all():                           # H is not positive definite
        return None
    B_g = sums.border[:n]
    solved = lu.solve(B_g)                               # H^-1 [B, g]
    reduced = sums.border[n:] - B_g[:, :-1].T @ solved
    S = (reduced[:, :-1] + reduced[:, :-1].T) / 2
    gradient = reduced[:, -1]
    determinant = np.linalg.slogdet(S)
    if not determinant.sign > 0 or (np.diag(S) <= 0).any():
        return None
    delta_c = -np.linalg.solve(S, gradient)
    delta = np.append(-solved[:, -1] - solved[:, :-1] @ delta_c, delta_c)
    return LinearSolution(
        delta=delta, S=S, gradient=gradient,
        log_determinant=determinant.logabsdet + np.sum(np.log(pivots)),
        decrease=-(sums.border[:, -1] @ delta) / 2,
        by_c=solved[:, :-1], lu=lu)


def posterior_draws(equations: NormalEquations, count: int) -> np.ndarray:
    """Steps (n + q, count) from the solution to draws from its posterior, the same at each call.

    H = U^T D^-1 U with the pivots D, so that U^-1 D^1/2 z has the covariance H^-1 if z is white.
    Raises DatasetError where the equations are singular to rounding.
    """
    sums = equations.sums(equations.problem.noise, consistent=True)
    solution = linear_solution(equations.structure, sums)
    if solution is None:
        raise undetermined()
    lu = solution.lu
    rng = np.random.default_rng(0)
    white = rng.standard_normal((len(lu.perm_c), count))
    scaled = np.sqrt(lu.U.diagonal())[:, None] * white
    for_known_c = spsolve_triangular(lu.U, scaled, lower=False)[lu.perm_c]
    white_c = rng.standard_normal((len(solution.S), count))
    of_c = np.linalg.solve(np.linalg.cholesky(solution.S).T, white_c)
    return np.concatenate([for_known_c - solution.by_c @ of_c, of_c])


def laplace_approximation(equations: NormalEquations, noise: Noise) -> tuple[np.ndarray, float]:
    """Solution delta (n + q,) of NormalEquations for a Noise, and log evidence up to a constant.

    With the whitened errors e at the solution, the noise factors l_s and l_r of S errors of
    sightings and R of ranges, and the whole information matrix I, calibration in sigmas,

        log evidence = -|e|^2 / 2 - sum log|Q| / 2 - S log l_s - R log l_r - log|I| / 2

    (MacKay, Neural Computation 4(3), 1992), with odometry's Q by the wheels of the solution. The
    omitted constant depends on the dataset and the weights: only problems on the same accepted
    measurements can be compared. The log evidence is minus infinity where the equations are
    singular to rounding.
    """
    sums = equations.sums(noise, consistent=True)
    solution = linear_solution(equations.structure, sums)
    if solution is None:
        return np.full(len(sums.border), np.nan), -np.inf
    squared = sums.squared - 2 * solution.decrease           # |e|^2
    log_determinants = sums.log_determinant + solution.log_determinant
    log_factors = np.log([noise.sightings, noise.ranges]) @ equations.counts()
    return solution.delta, -(squared + log_determinants) / 2 - log_factors


@lru_cache(maxsize=8)
def consistency_factor(kernel: mEstimator.Base | None, size: int = 1) -> float:
    """Mean of the squares of standard normal residuals of `size` components, weighted by a kernel.

    The kernel weighs a residual by its norm, or by its signed value if `size` is 1. It removes part
    of the variance of Gaussian residuals; without this factor the learned sigma would be too small
    (Huber and Ronchetti, Robust Statistics, 2009, chapter 5). The factor is 1 without kernel.
    """
    if kernel is None:
        return 1.0
    r = np.linspace(-6 if size == 1 else 0, 6, 241)
    normal = r**(size - 1) * np.exp(-r**2 / 2)
    weighted = normal * [kernel.weight(x) for x in r]
    return np.sum(r**2 * weighted) / np.sum(weighted) / size
