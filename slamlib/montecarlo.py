"""Monte Carlo: one problem's methods on many simulated drives, judged against the truth."""

import time
from dataclasses import replace

import gtsam
import numpy as np
from joblib import Parallel, delayed
from tqdm import tqdm

from slamlib import fusion, initial, localization, odometry, slam, studies
from slamlib.dataset import Vehicle
from slamlib.evaluation import anees, ate, nees
from slamlib.graph import State
from slamlib.simulation import misguess, simulate
from slamlib.ties import GATE_OF_POINTS


def run(trial, seeds, jobs=2, progress=False, **options):
    """Run trial(seed, **options) for all seeds, in `jobs` processes, or recall what it gave (`studies`).

    Returns
    -------
    dict of (s,) arrays, one for each number that the trial returns.
    """
    seeds = list(seeds)
    place = studies.place(trial, seeds, options)
    if (kept := studies.recall(place)) is not None:
        return kept
    rows = list(tqdm(Parallel(n_jobs=jobs, return_as="generator")(
        delayed(trial)(seed, **options) for seed in seeds), total=len(seeds), disable=not progress))
    numbers = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    studies.keep(place, numbers)
    return numbers


def markers_alone(seed, **options):
    """Localization from markers on one drive of the short path: NEES of poses, last pose and map."""
    dataset, truth = simulate("short", seed, **options)
    found = localization.localize(dataset.aruco)
    values = nees(found.poses, found.covariances, truth.poses[found.frame])
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, found.marker)]
    return {"nees": np.nanmean(values), "last nees": values[-1],
            "map nees": anees(found.marker_in_world, found.marker_covariance, true_map)}


def problem2(seed, **options):
    """All methods of problem 2 on one drive of the short path, simulated with these options.

    Returns
    -------
    dict of numbers: for each method its NEES (mean over the measured poses, and at the last one) and
    its ATE in metres; `odometry ate`; NEES of the marker map and of the wheel parameters; the slip.
    """
    dataset, truth = simulate("short", seed, **options)
    alone = localization.localize(dataset.aruco)
    naive = localization.localize(dataset.aruco, shared_errors=False)
    hint = fusion.fuse_increments(dataset)
    exact_hint = fusion.fuse_increments(dataset, odometry.first_order)
    fused = fusion.fuse(dataset)
    at = alone.frame
    numbers = {"odometry ate": ate(odometry.dead_reckoning(dataset.ticks, dataset.vehicle)[at],
                                   truth.poses[at])}
    for name, poses, covariances in (
            ("ArUco", alone.poses, alone.covariances), ("naive", naive.poses, naive.covariances),
            ("hint", hint.poses[at], hint.covariances[at]),
            ("exact hint", exact_hint.poses[at], exact_hint.covariances[at]),
            ("fused", fused.poses[at], fused.covariances[at])):
        values = nees(poses, covariances, truth.poses[at])
        numbers |= {f"{name} nees": anees(poses, covariances, truth.poses[at]),
                    f"{name} last nees": values[-1],
                    f"{name} ate": ate(poses, truth.poses[at])}
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, alone.marker)]
    error = fused.wheel - truth.vehicle.wheel
    return numbers | {
        "map nees": nees(alone.marker_in_world, alone.marker_covariance, true_map).mean(),
        "wheel nees": error @ np.linalg.solve(fused.wheel_covariance, error), "slip": fused.slip}


def problem3(seed, **options):
    """SLAM on odometry and markers of one drive of the short path, with everything learned.

    Returns
    -------
    dict of numbers, those of `_judged`.
    """
    dataset, truth = simulate("short", seed, **options)
    return _judged(slam.solve(dataset.without("uwb")), dataset.without("uwb"), truth)


def learned_slips(seed, slip):
    """Problem 3 on one drive of the short path with this slip: the slip learned, and known.

    Returns
    -------
    dict of numbers: the "slip" learned; with it the "nees" of the poses and the "aligned" ATE in metres,
    and "known nees" and "known aligned", those of the graph that is given the slip and the arcs.
    """
    dataset, truth = simulate("short", seed, slip=slip)
    dataset = dataset.without("uwb")
    learned, known = slam.solve(dataset), slam.solve(dataset, slip, "arc")
    numbers = {"slip": learned.slip}
    for name, found in (("", learned), ("known ", known)):
        numbers |= {f"{name}nees": anees(found.poses, found.covariances, truth.poses),
                    f"{name}aligned": ate(found.poses, truth.poses, aligned=True)}
    return numbers


def problem4(seed, path="short", markers=True, **options):
    """SLAM on odometry, ranges and (unless False) markers, with everything learned, as `problem3`."""
    dataset, truth = simulate(path, seed, **options)
    dataset = dataset if markers else dataset.without("aruco")
    before = slam.solve(dataset.without("uwb")) if markers else None
    return _judged(slam.solve(dataset, after=before), dataset, truth)


def _judged(found, dataset, truth):
    """NEES of the graph poses, of those between, of the last pose, map, antennas and wheels; ATE,
    aligned too; slip, chi-squared per degree of freedom, 1 for the model "arc"; sightings left out;
    the largest error of a marker, and the rms error of the antennas, in metres; antennas in doubt.
    """
    measured = [sensor.pose for sensor in (dataset.aruco, dataset.uwb) if sensor is not None]
    frames = np.isin(np.arange(len(truth.poses)), np.concatenate(measured))
    wheel = found.wheel - truth.vehicle.wheel
    values = nees(found.poses, found.covariances, truth.poses)
    numbers = {"nees": np.nanmean(values[frames]), "nees between": np.nanmean(values[~frames]),
               "last nees": values[-1],
               "wheel nees": wheel @ np.linalg.solve(found.wheel_covariance, wheel),
               "ate": ate(found.poses, truth.poses),
               "aligned": ate(found.poses, truth.poses, aligned=True),
               "left out": np.count_nonzero(found.outlier), "slip": found.slip,
               "chi2": found.chi2_per_dof, "arc": float(found.model == "arc")}
    if len(found.marker):
        true_map = truth.marker_in_world[np.searchsorted(truth.marker, found.marker)]
        numbers |= {"map nees": nees(found.marker_in_world, found.marker_covariance, true_map).mean(),
                    "map worst": np.abs(found.marker_in_world - true_map)[:, :2].max()}
    if len(found.antenna):
        error, squared = _antenna_error(found, truth)
        numbers |= {"antenna nees": np.mean(squared), "antenna error": np.sqrt(np.mean(error**2)),
                    "doubts": len(found.doubts)}
    return numbers


def _antenna_error(found, truth):
    """Distances (a,) in metres of the antennas from the truth, and their NEES (a,)."""
    error = found.antenna_in_world - truth.antenna_in_world[np.searchsorted(truth.antenna, found.antenna)]
    return np.hypot(*error.T), np.einsum(
        "ni,nij,nj->n", error, np.linalg.inv(found.antenna_covariance), error)


def kernels(seed, markers=True, **options):
    """Every way of `slam.RANGES` to treat late ranges, on one drive of the short path.

    The slip and the increments' model are given. Returns a dict of numbers for each way: ATE and rms
    error of the antennas in metres, NEES of poses and of antennas, seconds of processor time.
    """
    dataset, truth = simulate("short", seed, **options)
    dataset, numbers = dataset if markers else dataset.without("aruco"), {}
    for name in slam.RANGES:
        start = time.process_time()
        found = slam.result(slam.solve_graph(slam.Graph(dataset, "arc"), 1e-3, ranges=name))
        seconds = time.process_time() - start
        judged = _judged(found, dataset, truth)
        numbers |= {f"{name} {key}": judged[key]
                    for key in ("ate", "nees", "antenna error", "antenna nees")}
        numbers[f"{name} seconds"] = seconds
    return numbers


def guesses(seed, error, poses=None, markers=True, **options):
    """Antenna guesses that are wrong by `error` metres, each in a random direction, on a short drive
    or its first `poses`.

    Returns
    -------
    dict of numbers: shares of the antennas that end "right", within half a metre of the truth, that do
    so "from the guess" alone, without looking for other places, that are "in doubt", and that are
    "silently wrong": not right, outside of their 99.9 % ellipse, and not in doubt.
    """
    dataset, truth = simulate("short", seed, **options)
    dataset = misguess(dataset if markers else dataset.without("aruco"), truth, error, seed)
    dataset = dataset if poses is None else initial.prefix(dataset, poses)

    found = slam.result(slam.solve_graph(slam.Graph(dataset, "arc"), 1e-3))
    naive = slam.result(slam.solve_graph(slam.Graph(dataset, "arc"), 1e-3, antennas="guess"))
    (miss, squared), (naive_miss, _) = _antenna_error(found, truth), _antenna_error(naive, truth)
    right, doubt = miss < 0.5, np.isin(found.antenna, list(found.doubts))
    return {"right": right.mean(), "from the guess": np.mean(naive_miss < 0.5), "in doubt": doubt.mean(),
            "silently wrong": np.mean(~right & (squared > GATE_OF_POINTS) & ~doubt)}


def graphs(seed, **options):
    """The kinds of graph on one drive of the short path, given the true slip.

    Returns
    -------
    dict of numbers: for each of slam.WHEELS and each model of the increments the log evidence (all on the
    sightings that the graph with variable wheels and arcs keeps) and, each on its own, chi-squared
    per degree of freedom, ATE, aligned ATE and NEES.
    """
    dataset, truth = simulate("short", seed, **options)
    numbers = {}
    for wheels, model, found, evidence in slam.kinds(dataset.without("uwb"), options.get("slip", 1e-3)):
        name = f"{wheels} {model}"
        numbers |= {f"{name} evidence": evidence, f"{name} chi2": found.chi2_per_dof,
                    f"{name} ate": ate(found.poses, truth.poses),
                    f"{name} aligned": ate(found.poses, truth.poses, aligned=True),
                    f"{name} nees": anees(found.poses, found.covariances, truth.poses)}
    return numbers


def wrong_labels(seed, **options):
    """Every way of `slam.SIGHTINGS` to treat wrong labels, on one drive of the short path.

    The slip and the increments' model are given. Returns a dict of numbers for each way: ATE, and the
    largest error of a marker, in metres, NEES of the poses and of the map.
    """
    dataset, truth = simulate("short", seed, **options)
    dataset, numbers = dataset.without("uwb"), {}
    for name in slam.SIGHTINGS:
        found = slam.result(slam.solve_graph(slam.Graph(dataset, "arc"), 1e-3, sightings=name))
        judged = _judged(found, dataset, truth)
        numbers |= {f"{name} {key}": judged[key] for key in ("ate", "nees", "map nees", "map worst")}
    return numbers


def landmarks(seed, path="short", drift=1.0, known=True, kernel="graduated", **options):
    """Every way to initialise the markers, on one simulated drive with the true slip.

    Parameters
    ----------
    drift : factor on table 2's sigmas in the drive, and in the estimate if `known`.
    kernel : "graduated", the rounds of `slam.CAUCHY`, or "last", only its last one.

    Returns
    -------
    dict of numbers, for each way of `initial.LANDMARKS`: `... initial error`, the rms distance of the
    markers to the truth in metres; `... initial cost`, `... cost`, the graph's error before and after;
    `... steps`; `... right`, 1 where the cost is that reached from the true map and poses, to within 1,
    the cost of a residual of less than one and a half sigmas.
    """
    vehicle = Vehicle()
    drifting = replace(vehicle, sigma_right_radius=drift * vehicle.sigma_right_radius,
                       sigma_left_radius=drift * vehicle.sigma_left_radius,
                       sigma_wheelbase=drift * vehicle.sigma_wheelbase)
    dataset, truth = simulate(path, seed, vehicle=drifting, **options)
    dataset = replace(dataset, uwb=None, vehicle=drifting if known else vehicle)
    graph = slam.Graph(dataset, "arc")
    U, _ = graph.factors.whitening(options.get("slip", 1e-3))
    rounds = [graph.native(gtsam.noiseModel.mEstimator.Cauchy.Create(scale)) for scale in (
        slam.CAUCHY if kernel == "graduated" else slam.CAUCHY[-1:])]
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, graph.marker)]
    _, best, _ = graph.optimize(graph.values(State(truth.poses[graph.frame], true_map, np.zeros((0, 2)),
                                                   np.zeros(3))), rounds[-1], U)
    numbers = {}
    for name in initial.LANDMARKS:
        values, steps = initial.from_odometry(graph, name), 0
        error = graph.state(values).markers[:, :2] - true_map[:, :2]
        initial_cost = graph.error(values, rounds[-1], U)
        for native in rounds:
            values, cost, more = graph.optimize(values, native, U)
            steps += more
        numbers |= {f"{name} initial error": np.sqrt(np.mean(np.sum(error**2, axis=1))),
                    f"{name} initial cost": initial_cost, f"{name} cost": cost,
                    f"{name} steps": steps, f"{name} right": float(cost < best + 1)}
    return numbers
