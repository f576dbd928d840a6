"""Stage 7: what is handed in, GTSAM's solution of the graph that was decided.

`decisions_of` states what the Fit of the deciding engine found, and `core.graph` builds the graph
of it. Sightings are custom factors where entries of their calibration are unknown; these entries
are the variable S(0), in standard deviations from what is stated. Those of the ranges are R(0).
Gauss-Newton starts from problem 1's odometry. Where the headings there are too far off, it does not
converge in a few steps that are hardly shortened, or ends at a larger error than that of the
engine's solution, it starts from this solution.

Covariances are GTSAM's marginals; those of neighbouring frames together are what encoder poses
between them follow from. How far the engine's solution is from GTSAM's is part of the result.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, P, R, S, W, X

from slamlib.core.batch import Batch, numbers
from slamlib.core.graph import (
    Decisions,
    add_antenna_priors,
    build_graph,
    index_of,
    noise_model,
)
from slamlib.core.graph_solution import (
    CONVERGED,
    Marginals,
    gauss_newton,
)
from slamlib.core.kernels import ONE_SIDED_BIAS, symmetric
from slamlib.core.records import NO_RANGES, NO_SIGHTINGS, ArucoReadings, Dataset, UwbReadings
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

# Steps from odometry, which are dear on a long drive: from headings that are at most so far off, in
# rad; number of steps, and of lengths of each.
MAX_TURNED = 2.0
ODOMETRY_STEPS = 8
ODOMETRY_LENGTHS = 3
SAME_ERROR = 10 * CONVERGED      # relative difference of errors of one minimum
FROM_ODOMETRY = "odometry"
FROM_ENGINE = "the deciding engine's solution"
# Keys of the unknown calibration, by columns of c.
CALIBRATION_KEYS = ((W(0), WHEELS), (S(0), SIGHTINGS), (R(0), RANGES))


@dataclass(frozen=True)
class GtsamSolution:
    """GTSAM's solution, as arrays; covariances of poses and markers in their own axes."""

    state: State
    frames: np.ndarray           # (f, 3, 3)
    pairs: np.ndarray            # (f-1, 6, 6) of each frame and the next one
    landmarks: np.ndarray        # (k + a, 3, 3); of a point (2, 2) counts
    c: np.ndarray                # (p, p) of the calibration, 0 where it is known
    factors: int                 # number of factors in the graph
    variables: int               # number of variables
    steps: int                   # number of steps of Gauss-Newton
    start: str                   # FROM_ODOMETRY or FROM_ENGINE
    converged: bool


def graph_of(problem: Problem) -> gtsam.NonlinearFactorGraph:
    """The graph of a Problem."""
    graph = build_graph(decisions_of(problem))
    if not sightings_are_native(problem):
        for as_pose in (True, False):
            add_calibrated_sightings(graph, problem, as_pose)
    if not ranges_are_native(problem):
        add_calibrated_ranges(graph, problem)
    for key, columns in CALIBRATION_KEYS[1:]:
        count = len(unknown_of(problem, columns))
        if count:
            graph.add(gtsam.PriorFactorVector(
                key, np.zeros(count), gtsam.noiseModel.Unit.Create(count)))
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


def decisions_of(problem: Problem) -> Decisions:
    """The Decisions of a Problem, without what custom factors measure."""
    m = problem.measurements
    vehicle = m.dataset.vehicle
    accepted = accepted_dataset(problem)
    sightings, ranges = problem.accepted
    return Decisions(
        odometry=problem.odometry,
        slip=problem.noise.slip,
        sigma_heading=vehicle.sigma_heading,
        root_wheel=problem.prior.of(WHEELS),
        sightings=accepted.sightings if sightings_are_native(problem) else NO_SIGHTINGS,
        ranges=accepted.ranges if ranges_are_native(problem) else NO_RANGES,
        guess=m.dataset.antenna_guess,
        points=m.marker[~m.oriented],
        sighting_share=sightings.share[sightings.weight > 0],
        range_share=ranges.share[ranges.weight > 0],
        kernel=vehicle.kernel)


def accepted_dataset(problem: Problem) -> Dataset:
    """The Dataset of the accepted measurements with the sigmas of the noise."""
    m = problem.measurements
    noise = problem.noise
    s = m.sightings
    r = m.ranges
    sightings, ranges = problem.accepted
    by_camera = ArucoReadings(
        pose=m.frame[s.row], marker=s.marker, marker_in_vehicle=s.z,
        covariance=noise.sightings**2 * s.C)
    measured = UwbReadings(
        pose=m.frame[r.row], antenna=m.antenna[r.antenna], range=r.distance,
        sigma=noise.ranges * r.sigma)
    return replace(m.dataset, aruco=by_camera.select(sightings.weight > 0),
                   uwb=measured.select(ranges.weight > 0))


def add_calibrated_sightings(graph: gtsam.NonlinearFactorGraph, problem: Problem, as_pose: bool):
    """Add the accepted sightings of markers with a heading, or of points, by their calibration."""
    m = problem.measurements
    accepted = problem.accepted.sightings
    rows = np.flatnonzero((accepted.weight > 0) & (m.as_pose == as_pose))
    size = 3 if as_pose else 2
    frame = m.sightings.row[rows]

    def errors(poses, markers, c):
        motion, velocity = delayed(problem, frame, c, SIGHTING_LAG)
        e, by_pose, by_marker, by_c = sighting_error(
            m.sightings.z[rows], poses, motion, velocity, as_places(markers), c, m.as_pose[rows],
            m.is_bumped[rows])
        return e[:, :size], by_pose[:, :size], by_marker[:, :size, :size], by_c[:, :size]

    markers = marker_keys(problem)
    landmarks = [markers[k] for k in m.marker_row[rows]]
    covariances = problem.noise.sightings**2 * m.sighting_covariances[rows, :size, :size]
    kernel = symmetric(m.dataset.vehicle.kernel)
    add_calibrated(graph, problem, errors, frame, landmarks, (S(0), SIGHTINGS), covariances, kernel,
                   accepted.share[rows])


def add_calibrated_ranges(graph: gtsam.NonlinearFactorGraph, problem: Problem):
    """Add the accepted ranges by their calibration."""
    m = problem.measurements
    accepted = problem.accepted.ranges
    rows = np.flatnonzero(accepted.weight)
    frame = m.ranges.row[rows]
    antenna = m.ranges.antenna[rows]
    kernel = m.dataset.vehicle.kernel
    sigma = problem.noise.ranges * m.ranges.sigma[rows, None]
    measured = m.ranges.distance[rows]
    bias = ONE_SIDED_BIAS.get(kernel, 0.0) * sigma

    def errors(poses, places, c):
        motion, velocity = delayed(problem, frame, c, RANGE_LAG)
        antennas = np.zeros((len(m.antenna), 2))
        antennas[antenna] = places
        e, *derivatives = range_error(measured, poses, motion, velocity, antennas, antenna, c)
        return e + bias, *derivatives

    landmarks = [A(index_of(k)) for k in m.antenna[antenna]]
    add_antenna_priors(graph, m.dataset.antenna_guess, m.antenna[antenna])
    add_calibrated(graph, problem, errors, frame, landmarks, (R(0), RANGES),
                   sigma[:, :, None]**2, kernel, accepted.share[rows])


def add_calibrated(graph: gtsam.NonlinearFactorGraph, problem: Problem, errors: Callable,
                   frame: np.ndarray, landmarks: list[int], calibration: tuple[int, slice],
                   covariances: np.ndarray, kernel: str, shares: np.ndarray):
    """Add measurements of a kind from the rows `frame` (m,) to landmarks, keys.

    Where entries of their calibration are unknown, these are a variable of all: its key and the
    columns of c are `calibration`. The function `errors` returns the errors at poses (m, 3), places
    of landmarks and c, and their derivatives by each of them, by c of these columns.
    """
    key, columns = calibration
    keys = [[X(i) for i in problem.measurements.frame[frame].tolist()], landmarks]
    root = problem.prior.of(columns)
    if root.size:
        keys.append(len(landmarks) * [key])

    def errors_at(poses, places, *off):
        c = problem.measurements.calibration.stated.copy()
        if off:
            c[columns] += root @ off[0][0]
        e, by_pose, by_landmark, by_c = errors(poses, places, c)
        return e, [by_pose, by_landmark, by_c @ root][:len(keys)]

    batch = Batch(keys, errors_at)
    for k, (covariance, share) in enumerate(zip(covariances, shares)):
        graph.add(batch.factor(k, noise_model(covariance, kernel, share)))


def as_places(places: np.ndarray) -> np.ndarray:
    """Poses (m, 3) of landmarks (m, 3) or (m, 2), heading 0 of points."""
    return np.pad(places, ((0, 0), (0, 3 - places.shape[1])))


def unknown_of(problem: Problem, columns: slice) -> np.ndarray:
    """Those of these columns of the calibration that are unknown."""
    return np.flatnonzero(problem.active[columns]) + columns.start


def calibration_at(problem: Problem, values: gtsam.Values) -> np.ndarray:
    """The calibration c (p,) at GTSAM's values."""
    c = problem.measurements.calibration.stated.copy()
    for key, columns in CALIBRATION_KEYS:
        if values.exists(key):
            c[columns] += problem.prior.of(columns) @ values.atVector(key)
    return c


def marker_keys(problem: Problem) -> list[int]:
    """GTSAM's keys of all k markers, L of a pose and P of a position."""
    m = problem.measurements
    return [L(index_of(marker)) if is_pose else P(index_of(marker))
            for marker, is_pose in zip(m.marker, m.oriented)]


def variable_keys(problem: Problem) -> list[int]:
    """GTSAM's keys of frames, markers and antennas, in the order of their numbers."""
    m = problem.measurements
    frames = [X(i) for i in m.frame.tolist()]
    return frames + marker_keys(problem) + [A(index_of(antenna)) for antenna in m.antenna]


def places_of(state: State) -> np.ndarray:
    """Poses (v, 3) of frames, markers and antennas of a State, heading 0 of positions."""
    return np.concatenate([state.poses, state.markers, as_places(state.antennas)])


def values_of(problem: Problem, state: State, graph: gtsam.NonlinearFactorGraph) -> gtsam.Values:
    """GTSAM's values of a State, of the variables of a graph."""
    used = set(graph.keyVector())
    values = gtsam.Values()
    for key, place in zip(variable_keys(problem), places_of(state)):
        if key not in used:
            continue
        if chr(gtsam.symbolChr(key)) in "pa":
            values.insert(key, place[:2])
        else:
            values.insert(key, gtsam.Pose2(*place))
    off = np.zeros(len(state.c))
    off[problem.active] = problem.prior.unknowns(
        state.c - problem.measurements.calibration.stated)
    for key, columns in CALIBRATION_KEYS:
        unknown = unknown_of(problem, columns)
        if len(unknown):
            values.insert(key, off[unknown])
    return values


def state_at(fit: Fit, values: gtsam.Values) -> State:
    """The State at GTSAM's values; what is not in the graph is where a Fit has it."""
    m = fit.problem.measurements
    places = places_of(fit.state)
    for place, key in zip(places, variable_keys(fit.problem)):
        if values.exists(key):
            there = numbers(values, key)
            place[:len(there)] = there
    poses, markers, antennas = np.split(places, np.cumsum([len(m.frame), len(m.marker)]))
    return state_from_arrays(
        m, poses, markers, antennas[:, :2], calibration_at(fit.problem, values))


def solve_by_gtsam(fit: Fit) -> GtsamSolution:
    """GTSAM's solution of the graph of a Fit.

    Raises DatasetError where the measurements do not determine every variable.
    """
    problem = fit.problem
    graph = graph_of(problem)
    decided = values_of(problem, fit.state, graph)
    found = _from_odometry(fit, graph, decided)
    start = FROM_ODOMETRY
    if found is None:
        found = gauss_newton(graph, decided)
        start = FROM_ENGINE
    values = found.values
    marginals = found.marginals
    keys = [X(i) for i in problem.measurements.frame.tolist()]
    pairs = marginals.neighbours(keys)
    last = marginals.covariance(keys[-1])
    return GtsamSolution(
        state=state_at(fit, values), frames=np.concatenate([pairs[:, :3, :3], last[None]]),
        pairs=pairs, landmarks=landmark_covariances(problem, values, marginals),
        c=calibration_covariance(problem, values, marginals),
        factors=graph.size(), variables=values.size(), steps=found.steps, start=start,
        converged=found.converged)


def _from_odometry(fit, graph, decided):
    """GaussNewton from odometry on the graph of a Fit, or None where it misses the minimum.

    The minimum is near the values `decided`.
    """
    problem = fit.problem
    odometry = odometry_state(problem.measurements, problem.odometry.model)
    turned = odometry.poses[:, 2] - fit.state.poses[:, 2]
    if np.abs(turned).max() > MAX_TURNED:
        return None
    found = gauss_newton(
        graph, values_of(problem, odometry, graph), ODOMETRY_STEPS, ODOMETRY_LENGTHS)
    limit = graph.error(decided)
    is_minimum = found.converged and found.error <= limit + SAME_ERROR * (1 + limit)
    return found if is_minimum else None


def landmark_covariances(problem: Problem, values: gtsam.Values,
                         marginals: Marginals) -> np.ndarray:
    """Covariances (k + a, 3, 3) of landmarks, zero of markers without accepted sightings."""
    keys = variable_keys(problem)[len(problem.measurements.frame):]
    blocks = np.zeros((len(keys), 3, 3))
    there = [k for k, key in enumerate(keys) if values.exists(key)]
    for k, C in zip(there, marginals.covariances([keys[k] for k in there])):
        blocks[k, :len(C), :len(C)] = C
    return blocks


def calibration_covariance(problem: Problem, values: gtsam.Values,
                           marginals: Marginals) -> np.ndarray:
    """Covariance (p, p) of the calibration, 0 where it is known."""
    of_unknowns = np.zeros_like(problem.prior.root)
    there = [(key, unknown_of(problem, columns))
             for key, columns in CALIBRATION_KEYS if values.exists(key)]
    for key, rows in there:
        for other, columns in there:
            if key == other:
                block = marginals.covariance(key)
            else:
                block = marginals.pair(key, other)[:len(rows), len(rows):]
            of_unknowns[np.ix_(rows, columns)] = block
    root = problem.prior.root
    return root @ of_unknowns @ root.T
