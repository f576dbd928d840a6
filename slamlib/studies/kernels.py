"""Comparison of kernels and gates against wrong labels and late ranges in the SLAM graph."""

from dataclasses import replace
from functools import partial

import numpy as np

from slamlib.core import se2
from slamlib.core.increments import TYPICAL_SLIP
from slamlib.core.kernels import KERNELS, ONE_SIDED
from slamlib.core.records import Dataset, Truth
from slamlib.core.sightings import sightings_by_frame
from slamlib.robust.fit import Fit, accepted_measurements, narrow_kernels, refine, residuals
from slamlib.robust.initialization import odometry_state, trilaterated_antennas
from slamlib.robust.linear import State, build_problem
from slamlib.robust.measurements import Measurements, measure
from slamlib.robust.result import slam_result
from slamlib.studies.montecarlo import antenna_error, drive, judged

# Kernel and gate of every method.
METHODS = {name: (name, name in ONE_SIDED) for name in KERNELS} | {"gate": ("quadratic", True)}
MIN_MISLABELLED_SQUARED = 50.0   # Mahalanobis; a right label reaches it once in 10^10 sightings


def measure_with_known_noise(dataset: Dataset) -> Measurements:
    """The Measurements of a Dataset with the typical slip and the sigmas of the files."""
    vehicle = replace(dataset.vehicle, slip=TYPICAL_SLIP, marker_noise_factor=1.0,
                      range_noise_factor=1.0)
    return measure(replace(dataset, vehicle=vehicle))


def rounds(measurements: Measurements, antennas=trilaterated_antennas) -> State:
    """The State after the rounds of narrowing kernels, from odometry by arcs.

    `antennas` as of `initialization.state_from_poses`.
    """
    state = odometry_state(measurements, "arc", antennas=antennas)
    return narrow_kernels(build_problem(measurements, "arc"), state)


def solve_with(measurements: Measurements, start: State, sightings: str = "gate",
               ranges: str = "asymmetric Tukey") -> Fit:
    """The Fit from a State, as of `rounds`, by METHODS; the defaults are those of `estimate`.

    The noise of the measurements is known.
    """
    accept = partial(accepted_measurements, sightings=METHODS[sightings], ranges=METHODS[ranges])
    return refine(build_problem(measurements, "arc"), start, accept)


def compare(seed: int, kind: str, methods: tuple, markers: bool = True, **options) -> dict:
    """METHODS for a `kind`, "sightings" or "ranges", on one `drive`, the slip and the arcs given.

    Ranges are compared with or without `markers`, sightings without ranges.

    Returns
    -------
    dict of numbers for each method: "ate" in m and "nees"; of ranges the rms "antenna error" in m
    and "antenna nees"; of sightings the shares "wrong rejected" of the wrong labels (NaN without
    any) and "good lost" of the others that keep less than half of their weight.
    """
    dataset, truth = drive(seed, **options)
    if not markers:
        dataset = dataset.without("aruco")
    if kind == "sightings":
        dataset = dataset.without("uwb")
    measurements = measure_with_known_noise(dataset)
    start = rounds(measurements)
    numbers = {}
    for method in methods:
        fit = solve_with(measurements, start, **{kind: method})
        found = slam_result(fit)
        numbers |= judged(method, found.poses, found.covariances, truth.poses)
        if kind == "ranges":
            error, nees = antenna_error(found, truth)
            numbers[f"{method} antenna error"] = np.sqrt(np.mean(error**2))
            numbers[f"{method} antenna nees"] = nees.mean()
        else:
            wrong = mislabelled(dataset, truth)
            of_sightings, _ = residuals(fit.problem, fit.state)
            distance = np.linalg.norm(of_sightings, axis=1)
            lost = fit.problem.accepted.sightings.kept(distance) < 0.5
            numbers[f"{method} wrong rejected"] = lost[wrong].mean() if wrong.any() else np.nan
            numbers[f"{method} good lost"] = lost[~wrong].mean()
    return numbers


def mislabelled(dataset: Dataset, truth: Truth) -> np.ndarray:
    """(s,) bool, `Sightings` of a simulated drive that have another marker's label, by its Truth.

    False where the Truth does not have the marker.
    """
    seen = sightings_by_frame(dataset.sightings)
    known = np.isin(seen.marker, truth.marker)
    marker = truth.marker_in_world[np.searchsorted(truth.marker, seen.marker[known])]
    pose = truth.poses[seen.frame[seen.row[known]]]
    distance = se2.squared_distances(seen.z[known], se2.between(pose, marker), seen.C[known])
    wrong = np.zeros(len(known), bool)
    wrong[known] = distance > MIN_MISLABELLED_SQUARED
    return wrong
