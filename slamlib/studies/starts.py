"""Comparison of start values of the markers and the antennas in the SLAM graph."""

from dataclasses import replace

import gtsam
import numpy as np

from slamlib import localize
from slamlib.core import se2
from slamlib.core.increments import TYPICAL_SLIP
from slamlib.core.sightings import POINT_GATE
from slamlib.robust.fit import CAUCHY_SCALES, narrow_kernels
from slamlib.robust.initialization import consensus_markers, odometry_state, state_from_poses
from slamlib.robust.linear import build_problem, state_from_arrays
from slamlib.robust.measurements import accept_all, measure
from slamlib.robust.optimize import optimize
from slamlib.robust.result import slam_result
from slamlib.studies.kernels import rounds, solve_with
from slamlib.studies.montecarlo import antenna_error, drive
from slamlib.studies.simulation import misguess

MAX_ANTENNA_ERROR = 0.5      # m, error below which an antenna is right
MAX_MARKER_ERROR = 0.1       # m, distance from the right optimum above which a marker is off
COST_TOLERANCE = 1.0         # cost above that of the right optimum: a residual of 1.4 sigmas


def first_sighting(measurements, in_world, covariances):
    """(k, 3) markers at their first sightings; parameters as of `consensus_markers`."""
    return in_world[np.unique(measurements.marker_row, return_index=True)[1]]


def mean_by_information(measurements, in_world, covariances):
    """(k, 3) markers at the mean of their sightings, weighted by information.

    Parameters as of `consensus_markers`. Angles are averaged about the most certain sighting's.
    """
    m = measurements
    order = np.lexsort((np.linalg.slogdet(covariances)[1], m.marker_row))
    middle = in_world[order[np.unique(m.marker_row[order], return_index=True)[1]]]
    difference = se2.difference(in_world, middle[m.marker_row])
    information = np.linalg.inv(covariances)
    total, moment = np.zeros((len(m.marker), 3, 3)), np.zeros((len(m.marker), 3))
    np.add.at(total, m.marker_row, information)
    np.add.at(moment, m.marker_row, (information @ difference[..., None])[..., 0])
    return middle + np.linalg.solve(total, moment[..., None])[..., 0]


def map_of_problem_2(measurements, in_world, covariances):
    """(k, 3) markers of problem 2's map, by consensus where it has none.

    Parameters as of `consensus_markers`.
    """
    markers = consensus_markers(measurements, in_world, covariances)
    found = localize(measurements.dataset.sightings)
    if found.frame[0] == 0 and np.isfinite(found.poses[0, 0]):          # the same world
        mapped = np.isin(measurements.marker, found.marker)
        markers[mapped] = found.marker_in_world[
            np.searchsorted(found.marker, measurements.marker[mapped])]
    return markers


LANDMARKS = {"first sighting": first_sighting, "mean by information": mean_by_information,
             "consensus": consensus_markers, "problem 2's map": map_of_problem_2}


def guessed_antennas(measurements, poses, covariances, c):
    """(a, 2) antennas at their guesses; parameters as of `initialization.trilaterated_antennas`."""
    return measurements.guess


def landmarks(seed, kernel="graduated", starts=tuple(LANDMARKS), **options):
    """LANDMARKS, starts of the markers, on one `drive` with the typical slip known.

    Parameters
    ----------
    kernel : "graduated", all scales of the Cauchy kernel, or "last", only the last one.
    starts : names in LANDMARKS.

    Returns
    -------
    dict of numbers for each start: the final "cost", the graph's error; "right", 1 where it is that
    reached from the true map and poses, to within COST_TOLERANCE; "off", share of the markers that
    end farther than MAX_MARKER_ERROR from there; "initial error", their rms distance at the start,
    in m.
    """
    dataset, truth = drive(seed, **options)
    m = measure(dataset.without("uwb"))
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, m.marker)]
    right = state_from_arrays(
        m, truth.poses[m.frame], true_map, np.zeros((0, 2)), m.calibration.stated)
    return _from_each_start(build_problem(m, "arc"), right, kernel, starts)


def landmarks_of_drive(dataset, found, kernel="last", starts=tuple(LANDMARKS)):
    """The numbers of `landmarks` on a Dataset, given the SlamResult `found` of problem 3.

    Model and noise are those of the result, which replaces the truth.
    """
    m = measure(dataset.without("uwb"))
    problem = replace(build_problem(m, found.model, found.noise), sigma=found.fit.problem.sigma)
    right = state_from_poses(m, found.poses[m.frame], found.covariances[m.frame], found.c)
    return _from_each_start(problem, right, kernel, starts)


def _from_each_start(problem, right, kernel, starts):
    """The numbers of `landmarks`; from the State `right` the optimum is the right one."""
    m, numbers = problem.measurements, {}
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY_SCALES[-1])
    last = replace(problem, accepted=accept_all(m, cauchy))
    best = optimize(last, right)
    for name in starts:
        state = odometry_state(m, problem.odometry.model, markers=LANDMARKS[name])
        start = state.markers
        if kernel == "graduated":
            state = narrow_kernels(problem, state, CAUCHY_SCALES[:-1])
        end = optimize(last, state)
        cost, (first, off) = end.equations.error, (
            np.hypot(*(each - best.state.markers)[:, :2].T) for each in (start, end.state.markers))
        numbers |= {f"{name} cost": cost, f"{name} off": np.mean(off > MAX_MARKER_ERROR),
                    f"{name} right": cost < best.equations.error + COST_TOLERANCE,
                    f"{name} initial error": np.sqrt(np.mean(first**2))}
    return numbers


def guesses(seed, error, markers=True, **options):
    """Antenna guesses that are wrong by `error` m in random directions, on one `drive`.

    Without the markers if `markers` is False.

    Returns
    -------
    dict of shares of the antennas: "right", within MAX_ANTENNA_ERROR of the truth; right "from the
    guess" without trilateration; "in doubt"; and "silently wrong": not right, not in doubt, and
    outside their 99.9 % ellipse.
    """
    dataset, truth = drive(seed, **options)
    dataset = misguess(dataset if markers else dataset.without("aruco"), truth.antenna_in_world,
                       error, seed)
    measurements = measure(replace(dataset, vehicle=replace(
        dataset.vehicle, slip=TYPICAL_SLIP, marker_noise_factor=1.0, range_noise_factor=1.0)))
    found = slam_result(solve_with(measurements, rounds(measurements)))
    untrilaterated = solve_with(measurements, rounds(measurements, guessed_antennas)).state.antennas
    from_guess = np.hypot(*(untrilaterated - truth.antenna_in_world).T)
    miss, squared = antenna_error(found, truth)
    right, doubt = miss < MAX_ANTENNA_ERROR, np.isin(found.antenna, list(found.doubts))
    return {"right": right.mean(), "in doubt": doubt.mean(),
            "silently wrong": np.mean(~right & (squared > POINT_GATE) & ~doubt),
            "from the guess": np.mean(from_guess < MAX_ANTENNA_ERROR)}
