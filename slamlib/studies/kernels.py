"""Comparison of kernels and gates against wrong labels and late ranges in the SLAM graph."""

from dataclasses import replace
from functools import partial

import gtsam
import numpy as np

from slamlib.increments import TYPICAL_SLIP
from slamlib.simulation import simulate
from slamlib.slam.fit import (
    CAUCHY_SCALES,
    EARLY_GATE,
    acceptance_rule,
    accepted_measurements,
    gate_weights,
    kept_weights,
    refine,
    residuals,
)
from slamlib.slam.graph import optimize
from slamlib.slam.initialization import odometry_state, trilaterated_antennas
from slamlib.slam.linear import build_problem, state_from_arrays
from slamlib.slam.measurements import AcceptedMeasurements, Noise, measure, with_known_noise
from slamlib.slam.result import slam_result
from slamlib.studies.montecarlo import judge_slam

# The `AcceptanceRule` of every method against late ranges, and against wrong labels.
RANGE_METHODS = {
    **{name: acceptance_rule(name, gate=False) for name in ("quadratic", "Huber", "Cauchy")},
    "asymmetric Cauchy": acceptance_rule("asymmetric Cauchy"),
    "asymmetric Tukey": acceptance_rule(),
    "GNC": acceptance_rule("quadratic"),
    "gate": acceptance_rule("quadratic"),
    "asymmetric gate": replace(acceptance_rule("quadratic"), late=2.0)}
SIGHTING_METHODS = {
    **{name: acceptance_rule(name, gate=False)
       for name in ("quadratic", "Huber", "Cauchy", "Geman-McClure", "Tukey")},
    "gate": acceptance_rule()}
CONVEX = ("quadratic", "Huber", "GNC")     # methods without rounds of narrowing kernels
GNC_STEP = 1.4                             # factor on the control parameter in each round
MIN_MISLABELLED_SQUARED = 50.0             # squared Mahalanobis distance of a wrong label; a right
                                           # one reaches it once in ten billion sightings


def solve_with(measurements, sightings="gate", ranges="asymmetric Tukey",
               antennas=trilaterated_antennas, starts=None, model="arc"):
    """The Fit by these methods, from odometry.

    Parameters
    ----------
    measurements : Measurements of a dataset whose noise is known.
    sightings, ranges : names in SIGHTING_METHODS and RANGE_METHODS; the defaults are those of
        `slam.estimate`.
    antennas : as of `initialization.state_from_poses`.
    starts : dict, or None, of start values for the same measurements, to which those of this call
        are added: methods that are not CONVEX share the rounds of narrowing kernels.
    model : "arc" or "euler", of an odometry step.
    """
    problem = build_problem(measurements, model)
    starts = {} if starts is None else starts
    methods = tuple(name if name in CONVEX else "narrowing" for name in (sightings, ranges))
    convex = _acceptance_by(sightings, ranges)
    if methods not in starts:
        state = odometry_state(measurements, model, antennas=antennas)
        for scale in CAUCHY_SCALES:
            cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(scale)
            accepted = AcceptedMeasurements(
                measurements=measurements, weight=measurements.unit_weights,
                sighting_kernel=convex.sighting_kernel if sightings in CONVEX else cauchy,
                range_kernel=convex.range_kernel if ranges in CONVEX else cauchy)
            state = optimize(replace(problem, accepted=accepted), state).state
        starts[methods] = state
    return refine(problem, starts[methods],
                  partial(_accepted, sightings=sightings, ranges=ranges))


def _acceptance_by(sightings, ranges):
    """The AcceptanceRule by these methods."""
    chosen = SIGHTING_METHODS[sightings]
    return replace(RANGE_METHODS[ranges], sighting_kernel=chosen.sighting_kernel,
                   gated=chosen.gated)


def _accepted(problem, state, sightings, ranges):
    """The AcceptedMeasurements by these methods."""
    accepted = accepted_measurements(problem, state, _acceptance_by(sightings, ranges))
    return accepted if ranges != "GNC" else replace(
        accepted, weight=np.r_[accepted.sighting_weight, graduated(problem, state)])


def graduated(problem, state):
    """Weights (r,) by graduated non-convexity with truncated least squares of the ranges.

    From quadratic to truncated costs, one Gauss-Newton step for each value of the control parameter
    (Yang, Antonante, Tzoumas and Carlone, IEEE RA-L 5(2), 2020).
    """
    m, gate = problem.measurements, EARLY_GATE**2
    weight = gate_weights(problem, state, EARLY_GATE, EARLY_GATE)
    ranges = slice(len(m.marker_row), None)
    weight[ranges], control = 1, None
    while control is None or ((weight > 0) & (weight < 1)).any():
        trial = replace(problem, accepted=AcceptedMeasurements(
            measurements=m, weight=weight.copy()))
        state = optimize(trial, state, **{} if control is None else {"max_steps": 1}).state
        squared = residuals(m, state, problem.noise)[1]**2
        control = GNC_STEP * control if control else gate / max(2 * squared.max() - gate, gate)
        root = np.sqrt(gate * control * (control + 1) / np.maximum(squared, 1e-12)) - control
        weight[ranges] = np.clip(root, 0, 1)**2
    return weight[ranges]


def late_ranges(seed, markers=True, methods=tuple(RANGE_METHODS), **options):
    """RANGE_METHODS on one drive of the short path, the slip and the arcs given.

    Parameters
    ----------
    seed, options : of `simulation.simulate`.
    markers : False leaves the markers out.
    methods : names in RANGE_METHODS.

    Returns
    -------
    dict of numbers for each method: "ate" and rms "antenna error" in m, "nees", "antenna nees".
    """
    dataset, truth = simulate("short", seed, **options)
    dataset, numbers = dataset if markers else dataset.without("aruco"), {}
    measurements, starts = measure(with_known_noise(dataset, TYPICAL_SLIP, 1.0, 1.0)), {}
    for method in methods:
        found = slam_result(solve_with(measurements, ranges=method, starts=starts))
        judged = judge_slam(found, dataset, truth)
        numbers |= {f"{method} {key}": judged[key]
                    for key in ("ate", "nees", "antenna error", "antenna nees")}
    return numbers


def wrong_labels(seed, methods=tuple(SIGHTING_METHODS), **options):
    """SIGHTING_METHODS on one drive of the short path, the slip and the arcs given.

    Parameters as of `late_ranges`.

    Returns
    -------
    dict of numbers for each method: "ate" and largest error of a marker, "map worst", in m, "nees"
    and "map nees"; the shares "wrong rejected" of the wrong labels (NaN without any) and "good
    lost" of the others that keep less than half of their weight.
    """
    dataset, truth = simulate("short", seed, **options)
    dataset, numbers, starts = dataset.without("uwb"), {}, {}
    measurements = measure(with_known_noise(dataset, TYPICAL_SLIP, 1.0, 1.0))
    wrong = mislabelled(measurements, truth)
    for method in methods:
        fit = solve_with(measurements, sightings=method, starts=starts)
        judged = judge_slam(slam_result(fit), dataset, truth)
        numbers |= {f"{method} {key}": judged[key]
                    for key in ("ate", "nees", "map nees", "map worst")}
        each = residuals(measurements, fit.state, fit.problem.noise)
        lost = kept_weights(fit.problem.accepted, *each)[0] < 0.5
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
    return np.sum(residuals(m, state, Noise())[0]**2, axis=1) > MIN_MISLABELLED_SQUARED
