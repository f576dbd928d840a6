"""Comparison of start values of the markers and the antennas in the SLAM graph."""

from dataclasses import replace

import gtsam
import numpy as np

from slamlib import se2
from slamlib.dataset import Vehicle
from slamlib.increments import TYPICAL_SLIP
from slamlib.localization import localize
from slamlib.sightings import POINT_GATE
from slamlib.simulation import misguess, simulate
from slamlib.slam.fit import CAUCHY_SCALES
from slamlib.slam.graph import optimize
from slamlib.slam.initialization import consensus_markers, odometry_state, state_from_poses
from slamlib.slam.linear import NormalEquations, build_problem, state_from_arrays
from slamlib.slam.measurements import AcceptedMeasurements, Noise, measure, with_known_noise
from slamlib.slam.result import slam_result
from slamlib.studies.kernels import solve_with
from slamlib.studies.montecarlo import antenna_error

MAX_ANTENNA_ERROR = 0.5      # m, error below which an antenna is right
COST_TOLERANCE = 1.0         # cost above that of the right optimum: a residual of 1.4 sigmas


def first_sighting(measurements, in_world, covariances):
    """(k, 3) markers at their first sightings; parameters as of `consensus_markers`."""
    return in_world[np.unique(measurements.marker_row, return_index=True)[1]]


def most_certain_sighting(measurements, in_world, covariances):
    """(k, 3) markers at the sighting of least covariance determinant; parameters as above."""
    label = measurements.marker_row
    order = np.lexsort((np.linalg.slogdet(covariances)[1], label))
    return in_world[order[np.unique(label[order], return_index=True)[1]]]


def mean_by_information(measurements, in_world, covariances):
    """(k, 3) markers at the mean of their sightings, weighted by information.

    Parameters as of `consensus_markers`. Angles are averaged about the most certain sighting's.
    """
    m = measurements
    middle = most_certain_sighting(m, in_world, covariances)
    difference = in_world - middle[m.marker_row]
    difference[:, 2] = se2.wrap(difference[:, 2])
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


LANDMARKS = {"first sighting": first_sighting, "most certain sighting": most_certain_sighting,
             "mean by information": mean_by_information, "consensus": consensus_markers,
             "problem 2's map": map_of_problem_2}


def guessed_antennas(measurements, poses, covariances, c):
    """(a, 2) antennas at their guesses; parameters as of `initialization.trilaterated_antennas`."""
    return measurements.guess


def landmarks(seed, path="short", drift=1.0, known=True, kernel="graduated",
              starts=tuple(LANDMARKS), **options):
    """LANDMARKS, starts of the markers, on one simulated drive with the true slip.

    Parameters
    ----------
    drift : factor on table 2's sigmas in the drive, and in the estimate if `known`.
    kernel : "graduated", all scales of the Cauchy kernel, or "last", only the last one.
    starts : names in LANDMARKS.

    Returns
    -------
    dict of numbers for each start: "initial error", rms distance of the markers to the truth in m;
    "initial cost" and "cost", the graph's error before and after; "steps"; "right", 1 where the
    cost is that reached from the true map and poses, to within COST_TOLERANCE.
    """
    vehicle = Vehicle()
    drifting = replace(vehicle, sigma_right_radius=drift * vehicle.sigma_right_radius,
                       sigma_left_radius=drift * vehicle.sigma_left_radius,
                       sigma_wheelbase=drift * vehicle.sigma_wheelbase)
    dataset, truth = simulate(path, seed, vehicle=drifting, **options)
    m = measure(replace(dataset, uwb=None, vehicle=drifting if known else vehicle))
    noise = Noise(options.get("slip", TYPICAL_SLIP))
    rounds = _kernel_rounds(build_problem(m, "arc", noise), kernel)
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, m.marker)]
    best = optimize(rounds[-1], state_from_arrays(
        m, truth.poses[m.frame], true_map, np.zeros((0, 2)), m.calibration.stated)).error
    return _from_each_start(rounds, best, true_map, starts)


def landmarks_of_drive(dataset, found, kernel="last", starts=tuple(LANDMARKS)):
    """LANDMARKS, starts of the markers of a Dataset, given the SlamResult `found` of problem 3.

    Model and noise are those of the result. Returns the numbers of `landmarks`; the optimum reached
    from the result, and its map, replace the truth.
    """
    m = measure(dataset.without("uwb"))
    problem = replace(build_problem(m, found.model, found.noise), sigma=found.fit.problem.sigma)
    rounds = _kernel_rounds(problem, kernel)
    best = optimize(rounds[-1], state_from_poses(
        m, found.poses[m.frame], found.covariances[m.frame], found.c))
    return _from_each_start(rounds, best.error, best.state.markers, starts)


def _kernel_rounds(problem, kernel):
    """Problems with the scales of the Cauchy kernel, "graduated" or the "last" one only."""
    m, cauchy = problem.measurements, gtsam.noiseModel.mEstimator.Cauchy.Create
    return [replace(problem, accepted=AcceptedMeasurements(
        measurements=m, weight=m.unit_weights, sighting_kernel=cauchy(scale)))
            for scale in (CAUCHY_SCALES if kernel == "graduated" else CAUCHY_SCALES[-1:])]


def _from_each_start(rounds, best, markers, starts):
    """The numbers of `landmarks`, by the right optimum's error `best` and its markers (k, 3)."""
    m, numbers = rounds[-1].measurements, {}
    for name in starts:
        state, steps = odometry_state(m, rounds[-1].odometry.model, markers=LANDMARKS[name]), 0
        error = state.markers[:, :2] - markers[:, :2]
        initial_cost = NormalEquations(rounds[-1], state).error
        for trial in rounds:
            optimum = optimize(trial, state)
            state, steps = optimum.state, steps + optimum.steps
        numbers |= {f"{name} initial error": np.sqrt(np.mean(np.sum(error**2, axis=1))),
                    f"{name} initial cost": initial_cost, f"{name} cost": optimum.error,
                    f"{name} steps": steps,
                    f"{name} right": float(optimum.error < best + COST_TOLERANCE)}
    return numbers


def guesses(seed, error, poses=None, markers=True, from_guess=True, **options):
    """Antenna guesses that are wrong by `error` m in random directions, on a short drive.

    Parameters
    ----------
    poses : number of the drive's first poses to use, or None for all.
    markers : False leaves the markers out.
    from_guess : False leaves "from the guess" out.

    Returns
    -------
    dict of shares of the antennas: "right", within MAX_ANTENNA_ERROR of the truth; right "from the
    guess" without trilateration; "in doubt"; and "silently wrong": not right, not in doubt, and
    outside their 99.9 % ellipse.
    """
    dataset, truth = simulate("short", seed, **options)
    dataset = misguess(dataset if markers else dataset.without("aruco"), truth.antenna_in_world,
                       error, seed)
    dataset = dataset if poses is None else dataset.first(poses)
    dataset = with_known_noise(dataset, TYPICAL_SLIP, 1.0, 1.0)
    measurements = measure(dataset)
    found = slam_result(solve_with(measurements))
    miss, squared = antenna_error(found, truth)
    right, doubt = miss < MAX_ANTENNA_ERROR, np.isin(found.antenna, list(found.doubts))
    numbers = {"right": right.mean(), "in doubt": doubt.mean(),
               "silently wrong": np.mean(~right & (squared > POINT_GATE) & ~doubt)}
    if from_guess:
        untrilaterated = slam_result(solve_with(measurements, antennas=guessed_antennas))
        error, _ = antenna_error(untrilaterated, truth)
        numbers["from the guess"] = np.mean(error < MAX_ANTENNA_ERROR)
    return numbers
