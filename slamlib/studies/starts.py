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


def first_sighting(measurements: Measurements, in_world: np.ndarray,
                   covariances: np.ndarray) -> np.ndarray:
    """(k, 3) markers at their first sightings; parameters as of `consensus_markers`."""
    _, first = np.unique(measurements.marker_row, return_index=True)
    return in_world[first]


def most_certain(measurements: Measurements, in_world: np.ndarray,
                 covariances: np.ndarray) -> np.ndarray:
    """(k, 3) markers at their most certain sightings; parameters as of `consensus_markers`."""
    uncertainty = np.linalg.slogdet(covariances).logabsdet
    order = np.lexsort((uncertainty, measurements.marker_row))
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
    row = measurements.marker_row
    markers = most_certain(measurements, in_world, covariances)
    information = np.linalg.inv(covariances)
    difference = se2.difference(in_world, markers[row])[..., None]
    total = np.zeros((len(markers), 3, 3))
    weighted = np.zeros((len(markers), 3, 1))
    np.add.at(total, row, information)
    np.add.at(weighted, row, information @ difference)
    return markers + np.linalg.solve(total, weighted)[..., 0]


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


def confusions(seed: int, **options) -> dict:
    """LANDMARKS, starts of the markers, with each of CONFUSIONS, on one `drive`, its slip typical.

    From each start the graph is solved with the "last" Cauchy kernel, and with the "graduated"
    ones, all rounds. The right optimum is that reached from the true map and poses.

    Returns
    -------
    dict of numbers, as "twins, last, consensus off", the share of the markers that end farther than
    MAX_MARKER_ERROR from the right optimum, and "twins, consensus initial error", their rms
    distance from there at the start, in m.
    """
    dataset, truth = drive(seed, **options)
    numbers = {}
    for kind in CONFUSIONS:
        m = measure(confuse_labels(dataset, kind, seed).without("uwb"))
        problem = build_problem(m, "arc")
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_SCALES[-1])
        last = replace(problem, accepted=accept_all(m, cauchy))
        row = np.searchsorted(truth.marker, m.marker)
        true = state_from_arrays(m, truth.poses[m.frame], truth.marker_in_world[row],
                                 np.zeros((0, 2)), m.calibration.stated)
        right = optimize(last, true).state.markers
        for kernel in ("last", "graduated"):
            for name, place in LANDMARKS.items():
                state = odometry_state(m, "arc", markers=place)
                initial_error = distances(state.markers, right)
                if kernel == "graduated":
                    state = narrow_kernels(problem, state, CAUCHY_SCALES[:-1])
                error = distances(optimize(last, state).state.markers, right)
                numbers[f"{kind}, {kernel}, {name} off"] = np.mean(error > MAX_MARKER_ERROR)
                numbers[f"{kind}, {name} initial error"] = np.sqrt(np.mean(initial_error**2))
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
