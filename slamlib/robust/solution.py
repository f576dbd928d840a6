"""Stage 7: what is handed in, GTSAM's solution of the graph that was decided.

`decisions_of` states what the Fit of the deciding engine found, and `core.graph` builds the graph
of it. Sightings are custom factors where entries of their calibration are unknown; these entries
are the variable S(0), in standard deviations from what is stated. Those of the ranges are R(0).
Gauss-Newton starts from problem 1's odometry. Where it does not converge from there, or ends at a
larger error than that of the engine's solution, it starts again from this solution.

With probability p_k of point k of the noise's posterior, x_k its solution and C_k its covariance,
poses and landmarks have the moments (equation 3.4)

    x = sum p_k x_k,    C = sum p_k (C_k + (x_k - x) (x_k - x)^T),

in the tangent space at the solution of greatest posterior density. The engine computes the same in
numpy (`robust.covariances`); how far both are apart is part of the result.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, P, R, S, W, X

from slamlib.core.graph import (
    INDICES,
    Decisions,
    add_antenna_priors,
    build_graph,
    noise_model,
)
from slamlib.core.graph_solution import (
    CONVERGED,
    GaussNewton,
    Marginals,
    eliminated,
    gauss_newton,
)
from slamlib.core.kernels import ONE_SIDED
from slamlib.core.records import ArucoReadings, UwbReadings
from slamlib.robust.calibration import (
    HEIGHT,
    RANGE_LAG,
    RANGES,
    SIGHTING_LAG,
    SIGHTINGS,
    TAG_PLACE,
    WHEELS,
)
from slamlib.robust.factors import delayed, range_error, sighting_error
from slamlib.robust.fit import Fit
from slamlib.robust.initialization import odometry_state
from slamlib.robust.linear import Problem, State, state_from_arrays
from slamlib.robust.measurements import Noise

SAME_ERROR = 10 * CONVERGED      # relative difference of errors of one minimum
FROM_ODOMETRY = "odometry"
FROM_ENGINE = "the deciding engine's solution"
# Keys of the unknown calibration, by columns of c.
CALIBRATION_KEYS = ((W(0), WHEELS), (S(0), SIGHTINGS), (R(0), RANGES))


@dataclass(frozen=True)
class GtsamSolution:
    """GTSAM's solution, as arrays; covariances of poses and markers in their own axes."""

    state: State                 # averaged over the noise
    mode: State                  # of least error
    frames: np.ndarray           # (f, 3, 3)
    landmarks: np.ndarray        # (k + a, 3, 3); of a point (2, 2) counts
    c: np.ndarray                # (p, p) of the calibration, 0 where it is known
    factors: int                 # number of factors in the graph
    variables: int               # number of variables
    steps: int                   # number of steps of Gauss-Newton
    start: str                   # FROM_ODOMETRY or FROM_ENGINE
    converged: bool


def graph_of(problem: Problem, noise: Noise) -> gtsam.NonlinearFactorGraph:
    """The graph of a Problem for a Noise."""
    graph = build_graph(decisions_of(problem, noise))
    if not sightings_are_native(problem):
        add_calibrated_sightings(graph, problem, noise)
    if not ranges_are_native(problem):
        add_calibrated_ranges(graph, problem, noise)
    for key, columns in CALIBRATION_KEYS[1:]:
        unknown = np.count_nonzero(problem.active[columns])
        if unknown:
            graph.add(gtsam.PriorFactorVector(
                key, np.zeros(unknown), gtsam.noiseModel.Unit.Create(unknown)))
    return graph


def sightings_are_native(problem: Problem) -> bool:
    """Whether sightings depend on no unknown entry of the calibration, and on no delay."""
    stated = problem.measurements.calibration.stated
    return not problem.active[SIGHTINGS].any() and stated[SIGHTING_LAG] == 0


def ranges_are_native(problem: Problem) -> bool:
    """Whether ranges depend on no unknown entry of the calibration, and their tag is at X."""
    stated = problem.measurements.calibration.stated
    elsewhere = stated[TAG_PLACE].any() or stated[HEIGHT] != 0 or stated[RANGE_LAG] != 0
    return not problem.active[RANGES].any() and not elsewhere


def decisions_of(problem: Problem, noise: Noise) -> Decisions:
    """The Decisions of a Problem for a Noise, without what custom factors measure."""
    m = problem.measurements
    vehicle = m.dataset.vehicle
    sightings, ranges = problem.accepted
    return Decisions(
        odometry=problem.odometry,
        slip=noise.slip,
        sigma_heading=vehicle.sigma_heading,
        sigma_wheel=problem.sigma[WHEELS],
        sightings=sightings_in_vehicle(problem, noise) if sightings_are_native(problem) else None,
        ranges=calibrated_ranges(problem, noise) if ranges_are_native(problem) else None,
        guess=m.dataset.antenna_guess,
        points=m.marker[~m.oriented],
        sighting_share=sightings.share[sightings.weight > 0],
        range_share=ranges.share[ranges.weight > 0],
        sighting_kernel=sighting_kernel(problem),
        range_kernel=vehicle.kernel)


def sightings_in_vehicle(problem: Problem, noise: Noise) -> ArucoReadings | None:
    """The accepted sightings as the vehicle sees them by the stated camera and size."""
    m = problem.measurements
    s = m.sightings
    counted = problem.accepted.sightings.weight > 0
    if not counted.any():
        return None
    by_camera = ArucoReadings(
        pose=m.frame[s.row[counted]], marker=s.marker[counted], marker_in_vehicle=s.z[counted],
        covariance=noise.sightings**2 * s.C[counted])
    return replace(m.dataset, aruco=by_camera).sightings


def calibrated_ranges(problem: Problem, noise: Noise) -> UwbReadings | None:
    """The accepted ranges without the stated offset and scale."""
    m = problem.measurements
    r = m.ranges
    heard = problem.accepted.ranges.weight > 0
    if not heard.any():
        return None
    measured = UwbReadings(
        pose=m.frame[r.row[heard]], antenna=m.antenna[r.antenna[heard]], range=r.distance[heard],
        sigma=noise.ranges * r.sigma[heard])
    return replace(m.dataset, uwb=measured).ranges


class CalibratedFactors:
    """Measurements of a kind as custom factors, which are linearised all at once.

    Each factor keeps the values of its variables at the last linearisation. If it is asked at other
    values, all measurements are linearised there: one call of numpy in place of thousands.
    """

    def __init__(self, problem: Problem, keys: list, calibration: int, columns: slice,
                 linearised: Callable):
        """Factors on `keys` (m, 2) of poses and landmarks.

        The function `linearised` returns errors and derivatives. `calibration` is the key of the
        unknown entries among these `columns` of c.
        """
        self.problem = problem
        self.keys = keys
        self.calibration = calibration
        self.linearised = linearised
        self.active = problem.active[columns]
        self.sigma = problem.sigma[columns][self.active]
        self.inputs = [None] * len(keys)
        self.rows = {}

    def keys_of(self, k: int) -> list[int]:
        """All keys of measurement k."""
        return [*self.keys[k], self.calibration] if self.active.any() else self.keys[k]

    def error_of(self, k: int, size: int) -> Callable:
        """The error function of measurement k with so many errors, for gtsam.CustomFactor."""
        def error(factor, values, jacobians):
            if self.inputs[k] is None or self.inputs[k] != self.input_of(k, values):
                self.linearise(values)
            row = self.rows[k]
            if jacobians is not None:
                width = 3 if self.is_pose(k) else 2
                jacobians[0] = self.by_pose[row, :size]
                jacobians[1] = self.by_landmark[row, :size, :width]
                if self.active.any():
                    jacobians[2] = self.by_c[row, :size][:, self.active] * self.sigma
            return self.e[row, :size]

        return error

    def is_pose(self, k: int) -> bool:
        """Whether the landmark of measurement k is a pose."""
        return chr(gtsam.symbolChr(self.keys[k][1])) == "l"

    def input_of(self, k: int, values: gtsam.Values) -> tuple:
        """All numbers at GTSAM's values on which measurement k depends."""
        pose, landmark = self.keys[k]
        unknown = values.atVector(self.calibration) if self.active.any() else ()
        return (*array_of(values, pose), *array_of(values, landmark), *unknown)

    def linearise(self, values: gtsam.Values):
        """Keep errors and derivatives of all measurements at GTSAM's values."""
        there = [k for k, keys in enumerate(self.keys) if all(map(values.exists, keys))]
        inputs = [self.input_of(k, values) for k in there]
        self.inputs = [None] * len(self.keys)
        for k, numbers in zip(there, inputs):
            self.inputs[k] = numbers
        self.rows = {k: row for row, k in enumerate(there)}
        places = np.array(inputs)
        self.e, self.by_pose, self.by_landmark, self.by_c = self.linearised(
            np.array(there), places[:, :3], places[:, 3:6], calibration_at(self.problem, values))


def add_calibrated_sightings(graph: gtsam.NonlinearFactorGraph, problem: Problem, noise: Noise):
    """Add the accepted sightings with the unknown entries of their calibration, S(0)."""
    m = problem.measurements
    s = m.sightings
    accepted = problem.accepted.sightings
    counted = np.flatnonzero(accepted.weight)
    is_known = not problem.active[SIGHTING_LAG]
    frames = [X(i) for i in m.frame.tolist()]
    markers = marker_keys(problem)

    def linearised(some, poses, landmarks, c):
        rows = counted[some]
        motion, velocity = delayed(m, s.row[rows], c[SIGHTING_LAG], is_known)
        return sighting_error(s.z[rows], poses, motion, velocity, landmarks, c, m.as_pose[rows])

    keys = [[frames[s.row[k]], markers[m.marker_row[k]]] for k in counted]
    factors = CalibratedFactors(problem, keys, S(0), SIGHTINGS, linearised)
    for number, k in enumerate(counted):
        size = 3 if m.as_pose[k] else 2
        root = m.sighting_roots[k, :size, :size] / noise.sightings
        model = noise_model(
            np.linalg.inv(root.T @ root), sighting_kernel(problem), accepted.share[k])
        graph.add(gtsam.CustomFactor(
            model, factors.keys_of(number), factors.error_of(number, size)))


def add_calibrated_ranges(graph: gtsam.NonlinearFactorGraph, problem: Problem, noise: Noise):
    """Add the accepted ranges with the unknown entries of their calibration, R(0)."""
    m = problem.measurements
    r = m.ranges
    accepted = problem.accepted.ranges
    counted = np.flatnonzero(accepted.weight)
    is_known = not problem.active[RANGE_LAG]
    kernel = m.dataset.vehicle.kernel
    sigma = noise.ranges * r.sigma
    bias = ONE_SIDED.get(kernel, 0.0) * sigma

    def linearised(some, poses, landmarks, c):
        rows = counted[some]
        motion, velocity = delayed(m, r.row[rows], c[RANGE_LAG], is_known)
        antennas = np.zeros((len(m.antenna), 2))
        antennas[r.antenna[rows]] = landmarks[:, :2]
        e, by_pose, by_antenna, by_c = range_error(
            r.distance[rows], poses, motion, velocity, antennas, r.antenna[rows], c)
        return e + bias[rows, None], by_pose, by_antenna, by_c

    antennas = (m.antenna % INDICES).tolist()
    keys = [[X(int(m.frame[r.row[k]])), A(antennas[r.antenna[k]])] for k in counted]
    factors = CalibratedFactors(problem, keys, R(0), RANGES, linearised)
    add_antenna_priors(graph, m.dataset.antenna_guess, m.antenna[r.antenna[counted]])
    for number, k in enumerate(counted):
        model = noise_model(np.array([[sigma[k]**2]]), kernel, accepted.share[k])
        graph.add(gtsam.CustomFactor(
            model, factors.keys_of(number), factors.error_of(number, 1)))


def sighting_kernel(problem: Problem) -> str:
    """Name of the kernel of the sightings: that of the Vehicle, unless it is for ranges only."""
    kernel = problem.measurements.dataset.vehicle.kernel
    return "quadratic" if kernel in ONE_SIDED else kernel


def calibration_at(problem: Problem, values: gtsam.Values) -> np.ndarray:
    """The calibration c (p,) at GTSAM's values."""
    c = problem.measurements.calibration.stated.copy()
    for key, columns in CALIBRATION_KEYS:
        if values.exists(key):
            unknown = np.flatnonzero(problem.active[columns]) + columns.start
            c[unknown] += problem.sigma[unknown] * values.atVector(key)
    return c


def array_of(values: gtsam.Values, key: int) -> np.ndarray:
    """A pose (3,) at GTSAM's values; of a position heading 0."""
    if chr(gtsam.symbolChr(key)) in "pa":
        return np.append(values.atPoint2(key), 0.0)
    pose = values.atPose2(key)
    return np.array([pose.x(), pose.y(), pose.theta()])


def marker_keys(problem: Problem) -> list[int]:
    """GTSAM's keys of all k markers, L of a pose and P of a position."""
    m = problem.measurements
    return [L(marker) if is_pose else P(marker)
            for marker, is_pose in zip((m.marker % INDICES).tolist(), m.oriented)]


def variable_keys(problem: Problem) -> list[int]:
    """GTSAM's keys of frames, markers and antennas, in the order of their numbers."""
    m = problem.measurements
    frames = [X(i) for i in m.frame.tolist()]
    return frames + marker_keys(problem) + [A(k) for k in (m.antenna % INDICES).tolist()]


def values_of(problem: Problem, state: State, graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """GTSAM's values of a State, of the variables of a graph."""
    used = set(graph.keyVector())
    values = gtsam.Values()
    rows = np.concatenate([
        state.poses, state.markers, np.pad(state.antennas, ((0, 0), (0, 1)))])
    for key, row in zip(variable_keys(problem), rows):
        if key not in used:
            continue
        if chr(gtsam.symbolChr(key)) in "pa":
            values.insert(key, row[:2])
        else:
            values.insert(key, gtsam.Pose2(*row))
    for key, columns in CALIBRATION_KEYS:
        unknown = np.flatnonzero(problem.active[columns]) + columns.start
        if len(unknown):
            off = state.c[unknown] - problem.measurements.calibration.stated[unknown]
            values.insert(key, off / problem.sigma[unknown])
    return values


def solve_by_gtsam(fit: Fit) -> GtsamSolution:
    """GTSAM's solution of the graph of a Fit, averaged over its noise.

    Raises DatasetError where the measurements do not determine every variable.
    """
    problem = fit.problem
    graph = graph_of(problem, solved_noise(fit))
    decided = values_of(problem, fit.state, graph)
    odometry = odometry_state(problem.measurements, problem.odometry.model)
    found = gauss_newton(graph, values_of(problem, odometry, graph))
    start = FROM_ODOMETRY
    limit = graph.error(decided)
    if not found.converged or found.error > limit + SAME_ERROR * (1 + limit):
        found = gauss_newton(graph, decided)
        start = FROM_ENGINE
    return averaged(fit, graph, found, start)


def noise_points(fit: Fit) -> tuple[tuple[float, Noise], ...]:
    """Probability and Noise of each point over which a Fit is averaged, one if it is known."""
    return fit.posterior.points if fit.posterior else ((1.0, fit.problem.noise),)


def solved_noise(fit: Fit) -> Noise:
    """The Noise of the graph that is solved: that of the only point, or the most probable one."""
    points = noise_points(fit)
    return points[0][1] if len(points) == 1 else fit.problem.noise


def averaged(fit: Fit, graph: gtsam.NonlinearFactorGraph, found: GaussNewton,
             start: str) -> GtsamSolution:
    """The GtsamSolution by the moments over the noise's posterior at the solution of a graph."""
    problem = fit.problem
    values = found.values
    points = noise_points(fit)
    weights = np.array([weight for weight, _ in points])
    weights /= weights.sum()
    keys = gtsam.KeyVector(list(values.keys()))
    marginals = [found.marginals]
    steps = np.zeros((1, values.dim()))
    if len(points) > 1:
        graphs = [graph_of(problem, noise) for _, noise in points]
        solved = [eliminated(each.linearize(values)) for each in graphs]
        marginals = [Marginals(tree) for tree, _ in solved]
        _, at_mode = eliminated(graph.linearize(values))
        steps = np.array([step.subtract(at_mode).vector(keys) for _, step in solved])
    mean = weights @ steps
    places = dict(zip(keys, places_of(values, keys)))

    def covariance(key, other=None):
        """Block (d, e) of the averaged covariance of one or two variables."""
        total = 0.0
        for weight, marginal, step in zip(weights, marginals, steps - mean):
            spread = np.outer(step[places[key]], step[places[other or key]])
            block = marginal.joint(key, other) if other else marginal.covariance(key)
            total = total + weight * (block + spread)
        return total

    moved = values if len(points) == 1 else values.retract(vector_values(mean, places))
    blocks = blocks_of(problem, values, covariance)
    f = len(problem.measurements.frame)
    return GtsamSolution(
        state=state_at(fit, moved), mode=state_at(fit, values),
        frames=blocks[:f], landmarks=blocks[f:],
        c=calibration_covariance(problem, values, covariance),
        factors=graph.size(), variables=values.size(), steps=found.steps, start=start,
        converged=found.converged)


def places_of(values: gtsam.Values, keys: list[int]) -> list[slice]:
    """Slice of each variable in a vector of all unknowns."""
    zero = values.zeroVectors()
    ends = np.cumsum([zero.at(key).size for key in keys])
    return [slice(end - zero.at(key).size, end) for key, end in zip(keys, ends)]


def vector_values(step: np.ndarray, places: dict) -> gtsam.VectorValues:
    """GTSAM's VectorValues of a step (n,) of all unknowns."""
    moved = gtsam.VectorValues()
    for key, place in places.items():
        moved.insert(key, step[place])
    return moved


def state_at(fit: Fit, values: gtsam.Values) -> State:
    """The State at GTSAM's values; what is not in the graph is where a Fit has it."""
    m = fit.problem.measurements
    antennas = np.pad(fit.state.antennas, ((0, 0), (0, 1)))
    rows = np.concatenate([fit.state.poses, fit.state.markers, antennas])
    for k, key in enumerate(variable_keys(fit.problem)):
        if values.exists(key):
            rows[k] = array_of(values, key)
    poses, markers, antennas = np.split(rows, np.cumsum([len(m.frame), len(m.marker)]))
    return state_from_arrays(
        m, poses, markers, antennas[:, :2], calibration_at(fit.problem, values))


def blocks_of(problem: Problem, values: gtsam.Values, covariance: Callable) -> np.ndarray:
    """Covariances (f + k + a, 3, 3) of all variables, zero of those that are not in the graph.

    Such are markers without accepted sightings. `covariance` gives that of a key.
    """
    keys = variable_keys(problem)
    blocks = np.zeros((len(keys), 3, 3))
    for k, key in enumerate(keys):
        if values.exists(key):
            C = covariance(key)
            blocks[k, :len(C), :len(C)] = C
    return blocks


def calibration_covariance(problem: Problem, values: gtsam.Values, covariance) -> np.ndarray:
    """Covariance (p, p) of the calibration, 0 where it is known."""
    c = np.zeros((len(problem.sigma), len(problem.sigma)))
    there = [(key, np.flatnonzero(problem.active[columns]) + columns.start)
             for key, columns in CALIBRATION_KEYS if values.exists(key)]
    for key, rows in there:
        for other, columns in there:
            block = covariance(key) if key == other else covariance(key, other)
            scale = np.outer(problem.sigma[rows], problem.sigma[columns])
            c[np.ix_(rows, columns)] = scale * block
    return c
