"""Comparison of kernels against late ranges in the SLAM graph."""

from dataclasses import replace
from functools import partial

import numpy as np

from slamlib.core.increments import TYPICAL_SLIP
from slamlib.core.kernels import ONE_SIDED
from slamlib.core.records import Dataset
from slamlib.robust.fit import Fit, accepted_measurements, narrow_kernels, refine
from slamlib.robust.initialization import odometry_state, trilaterated_antennas
from slamlib.robust.linear import State, build_problem
from slamlib.robust.measurements import Measurements, measure
from slamlib.robust.result import slam_result
from slamlib.studies.montecarlo import antenna_error, drive, judged


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


def solve_with(measurements: Measurements, start: State, ranges: str = "asymmetric Tukey") -> Fit:
    """The Fit from a State, as of `rounds`, by a kernel of the ranges; sightings have the gate.

    The noise of the measurements is known. The default is that of `estimate`.
    """
    accept = partial(accepted_measurements, sightings=("quadratic", True),
                     ranges=(ranges, ranges in ONE_SIDED))
    return refine(build_problem(measurements, "arc"), start, accept)


def compare(seed: int, methods: tuple, markers: bool = True, **options) -> dict:
    """Kernels of the ranges (names) on one `drive`, with or without markers; slip and arcs given.

    Returns
    -------
    dict of numbers for each kernel: "ate" and the rms "antenna error" in m; the means "nees" of the
    poses and "antenna nees".
    """
    dataset, truth = drive(seed, **options)
    if not markers:
        dataset = dataset.without("aruco")
    measurements = measure_with_known_noise(dataset)
    start = rounds(measurements)
    numbers = {}
    for method in methods:
        found = slam_result(solve_with(measurements, start, method))
        numbers |= judged(method, found.poses, found.covariances, truth.poses)
        error, nees = antenna_error(found, truth)
        numbers[f"{method} antenna error"] = np.sqrt(np.mean(error**2))
        numbers[f"{method} antenna nees"] = nees.mean()
    return numbers
