"""Comparison of start values of the markers and the antennas in the SLAM graph."""

from dataclasses import replace

import gtsam
import numpy as np

from slamlib import localize
from slamlib.core import se2
from slamlib.core.sightings import POINT_GATE
from slamlib.robust.fit import CAUCHY_SCALES, narrow_kernels
from slamlib.robust.initialization import consensus_markers, odometry_state
from slamlib.robust.linear import build_problem, state_from_arrays
from slamlib.robust.measurements import Measurements, accept_all, measure
from slamlib.robust.optimize import optimize
from slamlib.robust.result import slam_result
from slamlib.studies.kernels import measure_with_known_noise, rounds, solve_with
from slamlib.studies.montecarlo import antenna_error, drive
from slamlib.studies.simulation import confuse_labels, distances, misguess

MAX_ANTENNA_ERROR = 0.5      # m, error below which an antenna is right
MAX_MARKER_ERROR = 0.1       # m, distance from the right optimum above which a marker is off
COST_TOLERANCE = 1.0         # cost above that of the right optimum: a residual of 1.4 sigmas


def first_sighting(measurements: Measurements, in_world: np.ndarray,
                   covariances: np.ndarray) -> np.ndarray:
    """(k, 3) markers at their first sightings; parameters as of `consensus_markers`."""
    _, first = np.unique(measurements.marker_row, return_index=True)
    return in_world[first]


def most_certain(measurements: Measurements, in_world: np.ndarray,
                 covariances: np.ndarray) -> np.ndarray:
    """(k, 3) markers at their most certain sightings; parameters as of `consensus_markers`."""
    certainty = -np.linalg.slogdet(covariances).logabsdet
    rows = np.arange(len(certainty))
    order = np.lexsort((rows, -certainty, measurements.marker_row))
    _, first = np.unique(measurements.marker_row[order], return_index=True)
    return in_world[order[first]]


def median_of_sightings(measurements: Measurements, in_world: np.ndarray,
                        covariances: np.ndarray) -> np.ndarray:
    """(k, 3) markers at the medians of x, of y and of the heading of their sightings.

    Parameters as of `consensus_markers`. The heading's is about that of the most certain sighting.
    """
    markers = most_certain(measurements, in_world, covariances)
    for j in range(len(markers)):
        own = measurements.marker_row == j
        markers[j] += np.median(se2.difference(in_world[own], markers[j]), axis=0)
    return markers


def mean_by_information(measurements: Measurements, in_world: np.ndarray,
                        covariances: np.ndarray) -> np.ndarray:
    """(k, 3) markers at the mean of their sightings, weighted by information.

    Parameters as of `consensus_markers`. Angles are averaged about the most certain sighting's.
    """
    certainty = -np.linalg.slogdet(covariances).logabsdet
    information = np.linalg.inv(covariances)
    markers = np.zeros((len(measurements.marker), 3))
    for j in range(len(markers)):
        rows = np.flatnonzero(measurements.marker_row == j)
        most_certain = in_world[rows[certainty[rows].argmax()]]
        difference = se2.difference(in_world[rows], most_certain)
        weighted = np.einsum("nij,nj->i", information[rows], difference)
        markers[j] = most_certain + np.linalg.solve(information[rows].sum(axis=0), weighted)
    return markers


def map_of_problem_2(measurements: Measurements, in_world: np.ndarray,
                     covariances: np.ndarray) -> np.ndarray:
    """(k, 3) markers of problem 2's map, by consensus where it has none.

    Parameters as of `consensus_markers`.
    """
    markers = consensus_markers(measurements, in_world, covariances)
    found = localize(measurements.dataset.sightings)
    if found.frame[0] == 0 and np.isfinite(found.poses[0, 0]):          # the same world
        mapped = np.isin(measurements.marker, found.marker)
        row = np.searchsorted(found.marker, measurements.marker[mapped])
        markers[mapped] = found.marker_in_world[row]
    return markers


LANDMARKS = {"first sighting": first_sighting, "most certain": most_certain,
             "median": median_of_sightings, "mean by information": mean_by_information,
             "consensus": consensus_markers, "problem 2's map": map_of_problem_2}
CONFUSIONS = "none", "random", "in frame", "twins"        # of `simulation.confuse_labels`


def guessed_antennas(measurements: Measurements, poses: np.ndarray, covariances: np.ndarray,
                     c: np.ndarray) -> np.ndarray:
    """(a, 2) antennas at their guesses; parameters as of `initialization.trilaterated_antennas`."""
    return measurements.guess


def landmarks(seed: int, kernel: str = "graduated", starts: tuple = tuple(LANDMARKS),
              confusion: str = "none", **options) -> dict:
    """LANDMARKS, starts of the markers, on one `drive` with the typical slip known.

    Parameters
    ----------
    kernel : "graduated", all scales of the Cauchy kernel, or "last", only the last one.
    starts : names in LANDMARKS.
    confusion : kind of wrong labels, of `simulation.confuse_labels`.

    Returns
    -------
    dict of numbers for each start: the final "cost", the graph's error; "right", 1 where it is that
    reached from the true map and poses, to within COST_TOLERANCE; "off", share of the markers that
    end farther than MAX_MARKER_ERROR from there; "initial error", their rms distance at the start,
    in m.
    """
    dataset, truth = drive(seed, **options)
    m = measure(confuse_labels(dataset, confusion, seed).without("uwb"))
    row = np.searchsorted(truth.marker, m.marker)
    right = state_from_arrays(m, truth.poses[m.frame], truth.marker_in_world[row],
                              np.zeros((0, 2)), m.calibration.stated)
    return _from_each_start(build_problem(m, "arc"), right, kernel, starts)


def confusions(seed: int, **options) -> dict:
    """`landmarks` with each of CONFUSIONS, by one kernel and by all rounds, on one `drive`.

    Returns
    -------
    dict of numbers, as "twins, last, consensus off" and "twins, consensus initial error".
    """
    numbers = {}
    for kind in CONFUSIONS:
        for kernel in ("last", "graduated"):
            found = landmarks(seed, kernel, confusion=kind, **options)
            for name in LANDMARKS:
                numbers[f"{kind}, {kernel}, {name} off"] = found[f"{name} off"]
                numbers[f"{kind}, {name} initial error"] = found[f"{name} initial error"]
    return numbers


def _from_each_start(problem, right, kernel, starts):
    """The numbers of `landmarks`; from the State `right` the optimum is the right one."""
    m = problem.measurements
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_SCALES[-1])
    last = replace(problem, accepted=accept_all(m, cauchy))
    best = optimize(last, right)
    numbers = {}
    for name in starts:
        state = odometry_state(m, problem.odometry.model, markers=LANDMARKS[name])
        initial_error = distances(state.markers, best.state.markers)
        if kernel == "graduated":
            state = narrow_kernels(problem, state, CAUCHY_SCALES[:-1])
        end = optimize(last, state)
        error = distances(end.state.markers, best.state.markers)
        cost = end.equations.error
        numbers[f"{name} cost"] = cost
        numbers[f"{name} off"] = np.mean(error > MAX_MARKER_ERROR)
        numbers[f"{name} right"] = cost < best.equations.error + COST_TOLERANCE
        numbers[f"{name} initial error"] = np.sqrt(np.mean(initial_error**2))
    return numbers


def guesses(seed: int, error: float, markers: bool = True, **options) -> dict:
    """Antenna guesses that are wrong by `error` m in random directions, on one `drive`.

    Without the markers if `markers` is False.

    Returns
    -------
    dict of shares of the antennas: "right", within MAX_ANTENNA_ERROR of the truth; right "from the
    guess" without trilateration; "in doubt"; and "silently wrong": not right, not in doubt, and
    outside their 99.9 % ellipse.
    """
    dataset, truth = drive(seed, **options)
    if not markers:
        dataset = dataset.without("aruco")
    dataset = misguess(dataset, truth.antenna_in_world, error, seed)
    measurements = measure_with_known_noise(dataset)
    fit = solve_with(measurements, rounds(measurements))
    from_guess = solve_with(measurements, rounds(measurements, guessed_antennas))
    guess_error = distances(from_guess.state.antennas, truth.antenna_in_world)
    found = slam_result(fit)
    distance, nees = antenna_error(found, truth)
    right = distance < MAX_ANTENNA_ERROR
    in_doubt = np.isin(found.antenna, list(found.doubts))
    silently_wrong = ~right & ~in_doubt & (nees > POINT_GATE)
    return {"right": right.mean(), "in doubt": in_doubt.mean(),
            "silently wrong": silently_wrong.mean(),
            "from the guess": np.mean(guess_error < MAX_ANTENNA_ERROR)}
