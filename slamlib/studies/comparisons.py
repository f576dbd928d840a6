"""Comparisons in the SLAM graph: kernels against late ranges, start values of its landmarks."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pandas as pd

from slamlib import localize
from slamlib.core import se2
from slamlib.core.increments import TYPICAL_SLIP
from slamlib.core.kernels import ONE_SIDED_BIAS
from slamlib.core.records import Dataset
from slamlib.core.sightings import POINT_GATE
from slamlib.robust.fit import CAUCHY_SCALES, Fit, accepted_measurements, narrow_kernels, refine
from slamlib.robust.initialization import (
    consensus_markers,
    odometry_state,
    trilaterated_antennas,
)
from slamlib.robust.linear import build_problem, state_from_arrays
from slamlib.robust.measurements import Measurements, accept_all, measure
from slamlib.robust.optimize import optimize
from slamlib.robust.result import slam_result
from slamlib.studies.montecarlo import antenna_error, judged
from slamlib.studies.simulation import confuse_labels, distances, misguess, simulate

MAX_ANTENNA_ERROR = 0.5      # m, error below which an antenna is right
MAX_MARKER_ERROR = 0.1       # m, distance from the right optimum above which a marker is off


def measure_with_known_noise(dataset: Dataset, kernel: str = "asymmetric Tukey") -> Measurements:
    """The Measurements of a Dataset with the typical slip, the sigmas of the files and a kernel."""
    vehicle = replace(dataset.vehicle, slip=TYPICAL_SLIP, marker_noise_factor=1.0,
                      range_noise_factor=1.0, kernel=kernel)
    return measure(replace(dataset, vehicle=vehicle))


def solve_with(measurements: Measurements, antennas=trilaterated_antennas) -> Fit:
    """The Fit from odometry by arcs, by the stated kernel; only sightings have the gate.

    Kernels that narrow come first. The noise of the measurements is known; `antennas` as of
    `initialization.state_from_poses`.
    """
    kernel = measurements.dataset.vehicle.kernel
    problem = build_problem(measurements, "arc")
    start = narrow_kernels(problem, odometry_state(measurements, "arc", antennas=antennas)).state
    accept = partial(accepted_measurements, sightings=(kernel, True),
                     ranges=(kernel, kernel in ONE_SIDED_BIAS))
    return refine(problem, start, accept)


def compare(seed: int, methods: tuple, **options) -> dict:
    """Kernels (names) on one drive; slip and arcs given.

    Returns
    -------
    dict of numbers for each kernel: "ate" and the rms "antenna error" in m; the means "nees" of the
    poses and "antenna nees".
    """
    dataset, truth = simulate(seed=seed, **options)
    numbers = {}
    for method in methods:
        found = slam_result(solve_with(measure_with_known_noise(dataset, method)))
        numbers |= judged(method, found.poses, found.covariances, truth.poses)
        error, nees = antenna_error(found, truth)
        numbers[f"{method} antenna error"] = np.sqrt(np.mean(error**2))
        numbers[f"{method} antenna nees"] = nees.mean()
    return numbers


def by_marker(choose: Callable) -> Callable:
    """A start of all markers from `choose`, the start (3,) of one by its sightings.

    These place it at (s, 3) with covariances (s, 3, 3). Parameters as of `consensus_markers`.
    """
    def start(measurements, in_world, covariances):
        every = [measurements.marker_row == j for j in range(len(measurements.marker))]
        places = [choose(in_world[own], covariances[own]) for own in every]
        return np.reshape(places, (-1, 3))               # also without markers

    return start


def most_certain(places, covariances):
    """(3,) where the most certain sighting places it."""
    return places[np.linalg.slogdet(covariances).logabsdet.argmin()]


def median(places, covariances):
    """(3,) medians of x, of y and of the heading, which is about that of the most certain one."""
    certain = most_certain(places, covariances)
    return certain + np.median(se2.difference(places, certain), axis=0)


def mean_by_information(places, covariances):
    """(3,) mean, weighted by information; angles are averaged about the most certain one's."""
    certain = most_certain(places, covariances)
    information = np.linalg.inv(covariances)
    weighted = np.einsum("sij,sj->i", information, se2.difference(places, certain))
    return certain + np.linalg.solve(information.sum(axis=0), weighted)


def map_of_problem_2(measurements, in_world, covariances):
    """(k, 3) markers of problem 2's map, by consensus where it has none.

    Parameters as of `consensus_markers`.
    """
    markers = consensus_markers(measurements, in_world, covariances)
    found = localize(measurements.dataset.sightings)
    if np.isfinite(found.poses[0, 0]):          # the same world: pose 1 sees markers
        mapped = pd.DataFrame(found.marker_in_world, found.marker).reindex(measurements.marker)
        return np.where(mapped.isna(), markers, mapped)
    return markers


LANDMARKS = {"first sighting": by_marker(lambda places, _: places[0]),
             "most certain": by_marker(most_certain), "median": by_marker(median),
             "mean by information": by_marker(mean_by_information),
             "consensus": consensus_markers, "problem 2's map": map_of_problem_2}
CONFUSIONS = "none", "random", "in frame", "twins"        # of `simulation.confuse_labels`
# Scales of the Cauchy kernels before the last one, by the name of the rounds.
ROUNDS = {"last": (), "graduated": CAUCHY_SCALES[:-1], "wide": (100.0, 30.0, *CAUCHY_SCALES[:-1])}


def confusions(seed: int, **options) -> dict:
    """LANDMARKS, starts of the markers, with each of CONFUSIONS, on one drive, its slip typical.

    From each start the graph is solved with the "last" Cauchy kernel alone, with the "graduated"
    ones, and from "wide" ones on (ROUNDS). The right optimum is that reached from the true map and
    poses.

    Returns
    -------
    dict of numbers, as "twins, last, consensus off", the share of the markers that end farther than
    MAX_MARKER_ERROR from the right optimum, and "twins, consensus initial error", their rms
    distance from there at the start, in m.
    """
    dataset, truth = simulate(seed=seed, **options)
    numbers = {}
    for kind in CONFUSIONS:
        m = measure(confuse_labels(dataset, kind, seed).without("uwb"))
        problem = build_problem(m, "arc")
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_SCALES[-1])
        last = replace(problem, accepted=accept_all(m, cauchy))
        row = np.searchsorted(truth.marker, m.marker)
        true = state_from_arrays(m, truth.poses[m.frame], truth.marker_in_world[row],
                                 truth.antenna_in_world[:0], m.calibration.stated)
        right = optimize(last, true).state.markers
        for name, place in LANDMARKS.items():
            state = odometry_state(m, "arc", markers=place)
            initial_error = distances(state.markers, right)
            numbers[f"{kind}, {name} initial error"] = np.sqrt(np.mean(initial_error**2))
            for kernel, scales in ROUNDS.items():
                start = narrow_kernels(problem, state, scales).state if scales else state
                error = distances(optimize(last, start).state.markers, right)
                numbers[f"{kind}, {kernel}, {name} off"] = np.mean(error > MAX_MARKER_ERROR)
    return numbers


def guesses(seed: int, error: float, **options) -> dict:
    """Antenna guesses that are wrong by `error` m in random directions, on one drive.

    Returns
    -------
    dict of shares of the antennas: "right", within MAX_ANTENNA_ERROR of the truth; right "from the
    guess" without trilateration; "in doubt"; and "silently wrong": not right, not in doubt, and
    outside their 99.9 % ellipse.
    """
    dataset, truth = simulate(seed=seed, **options)
    dataset = misguess(dataset, truth.antenna_in_world, error, seed)
    measurements = measure_with_known_noise(dataset)
    found = slam_result(solve_with(measurements))
    from_guess = solve_with(measurements, antennas=lambda measurements, *_: measurements.guess)
    guess_error = distances(from_guess.state.antennas, truth.antenna_in_world)
    distance, nees = antenna_error(found, truth)
    right = distance < MAX_ANTENNA_ERROR
    in_doubt = np.isin(found.antenna, list(found.doubts))
    return {"right": right.mean(), "in doubt": in_doubt.mean(),
            "silently wrong": np.mean(~right & ~in_doubt & (nees > POINT_GATE)),
            "from the guess": np.mean(guess_error < MAX_ANTENNA_ERROR)}
