"""Comparison of kernels and gates against wrong labels and late ranges in the SLAM graph."""

from dataclasses import replace
from functools import partial

import numpy as np

from slamlib.core.evaluation import anees, ate
from slamlib.core.increments import TYPICAL_SLIP
from slamlib.robust import fit as stages
from slamlib.robust.initialization import odometry_state, trilaterated_antennas
from slamlib.robust.linear import build_problem, state_from_arrays
from slamlib.robust.measurements import measure
from slamlib.robust.result import slam_result
from slamlib.studies.montecarlo import antenna_error, drive

# Kernel and gate of every method.
METHODS = {name: (name, name in stages.ONE_SIDED) for name in stages.KERNELS} | {
    "gate": ("quadratic", True)}
MIN_MISLABELLED_SQUARED = 50.0   # Mahalanobis; a right label reaches it once in 10^10 sightings


def rounds(measurements, antennas=trilaterated_antennas):
    """The State after the rounds of narrowing kernels, from odometry by arcs.

    `antennas` as of `initialization.state_from_poses`.
    """
    state = odometry_state(measurements, "arc", antennas=antennas)
    return stages.narrow_kernels(build_problem(measurements, "arc"), state)


def solve_with(measurements, start, sightings="gate", ranges="asymmetric Tukey"):
    """The Fit from a State, as of `rounds`, by METHODS; the defaults are those of `estimate`.

    The noise of the measurements is known.
    """
    return stages.refine(build_problem(measurements, "arc"), start, partial(
        stages.accepted_measurements, sightings=METHODS[sightings], ranges=METHODS[ranges]))


def compare(seed, kind, methods, markers=True, **options):
    """METHODS for a `kind`, "sightings" or "ranges", on one `drive`, the slip and the arcs given.

    Ranges are compared with or without `markers`, sightings without ranges.

    Returns
    -------
    dict of numbers for each method: "ate" in m and "nees"; of ranges the rms "antenna error" in m
    and "antenna nees"; of sightings the shares "wrong rejected" of the wrong labels (NaN without
    any) and "good lost" of the others that keep less than half of their weight.
    """
    dataset, truth = drive(seed, **options)
    dataset = dataset if markers else dataset.without("aruco")
    dataset, numbers = dataset if kind == "ranges" else dataset.without("uwb"), {}
    measurements = measure(replace(dataset, vehicle=replace(
        dataset.vehicle, slip=TYPICAL_SLIP, marker_noise_factor=1.0, range_noise_factor=1.0)))
    wrong, start = mislabelled(measurements, truth), rounds(measurements)
    for method in methods:
        fit = solve_with(measurements, start, **{kind: method})
        found = slam_result(fit)
        numbers |= {f"{method} ate": ate(found.poses, truth.poses),
                    f"{method} nees": anees(found.poses, found.covariances, truth.poses)}
        if kind == "ranges":
            error, squared = antenna_error(found, truth)
            numbers |= {f"{method} antenna error": np.sqrt(np.mean(error**2)),
                        f"{method} antenna nees": np.mean(squared)}
        else:
            size = np.linalg.norm(stages.residuals(fit.problem, fit.state)[0], axis=1)
            lost = fit.problem.accepted.sightings.kept(size) < 0.5
            numbers |= {f"{method} wrong rejected": lost[wrong].mean() if wrong.any() else np.nan,
                        f"{method} good lost": lost[~wrong].mean()}
    return numbers


def mislabelled(measurements, truth):
    """(s,) bool, sightings of a simulated drive that have another marker's label, by its Truth.

    False where the Truth does not have the marker.
    """
    m, known = measurements, np.isin(measurements.marker, truth.marker)
    true_map = np.full((len(m.marker), 3), np.nan)
    true_map[known] = truth.marker_in_world[np.searchsorted(truth.marker, m.marker[known])]
    state = state_from_arrays(m, truth.poses[m.frame], true_map,
                              np.zeros((len(m.antenna), 2)), m.calibration.stated)
    residual, _ = stages.residuals(build_problem(m, "arc"), state)
    return np.sum(residual**2, axis=1) > MIN_MISLABELLED_SQUARED
