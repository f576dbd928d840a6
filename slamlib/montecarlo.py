"""Monte Carlo: one problem's methods on many simulated drives, judged against the truth."""

from dataclasses import replace

import numpy as np
from joblib import Parallel, delayed
from tqdm import tqdm

from slamlib import fusion, localization, odometry, slam
from slamlib.dataset import Vehicle
from slamlib.evaluation import anees, ate, nees
from slamlib.simulation import simulate


def run(trial, seeds, jobs=2, progress=False, **options):
    """Run trial(seed, **options) for all seeds, in `jobs` processes.

    Returns
    -------
    dict of (s,) arrays, one for each number that the trial returns.
    """
    seeds = list(seeds)
    rows = list(tqdm(Parallel(n_jobs=jobs, return_as="generator")(
        delayed(trial)(seed, **options) for seed in seeds), total=len(seeds), disable=not progress))
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


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
    wheel = np.array([truth.vehicle.right_radius, truth.vehicle.left_radius, truth.vehicle.wheelbase])
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
        numbers |= {f"{name} nees": anees(poses, covariances, truth.poses[at]), f"{name} last nees": values[-1],
                    f"{name} ate": ate(poses, truth.poses[at])}
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, alone.marker)]
    error = fused.wheel - wheel
    return numbers | {
        "map nees": nees(alone.marker_in_world, alone.marker_covariance, true_map).mean(),
        "wheel nees": error @ np.linalg.solve(fused.wheel_covariance, error), "slip": fused.slip}


def problem3(seed, **options):
    """SLAM on one drive of the short path, with everything learned.

    Returns
    -------
    dict of numbers: NEES of the graph poses, the poses between them, the map and the wheel
    parameters; ATE, aligned too; slip, chi-squared per degree of freedom, 1 for the model "arc"; the
    largest error of a marker in metres.
    """
    dataset, truth = simulate("short", seed, **options)
    found = slam.solve(dataset)
    frames = np.isin(np.arange(len(truth.poses)), dataset.aruco.pose)
    wheel = found.wheel - [truth.vehicle.right_radius, truth.vehicle.left_radius,
                           truth.vehicle.wheelbase]
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, found.marker)]
    values = nees(found.poses, found.covariances, truth.poses)
    return {"nees": np.nanmean(values[frames]), "nees between": np.nanmean(values[~frames]),
            "map nees": nees(found.marker_in_world, found.marker_covariance, true_map).mean(),
            "wheel nees": wheel @ np.linalg.solve(found.wheel_covariance, wheel),
            "ate": ate(found.poses, truth.poses),
            "aligned": ate(found.poses, truth.poses, aligned=True),
            "left out": np.count_nonzero(found.outlier), "slip": found.slip, "chi2": found.chi2_per_dof, "arc": float(found.model == "arc"),
            "map worst": np.abs(found.marker_in_world - true_map)[:, :2].max()}


WHEELS = {"variable": "wheels as a variable", "independent": "independent chain",
          "fixed": "wheels fixed"}


def graphs(seed, **options):
    """The kinds of graph on one drive of the short path, given the true slip.

    Returns
    -------
    dict of numbers: for each of WHEELS and each model of the increments the log evidence, chi-squared
    per degree of freedom, ATE, aligned ATE and NEES.
    """
    dataset, truth = simulate("short", seed, **options)
    numbers = {}
    for wheels in WHEELS:
        for model in odometry.MODELS:
            found = slam.result(*slam.solve_graph(slam.Graph(dataset, model, wheels=wheels),
                                                  options.get("slip", 1e-3)))
            name = f"{wheels} {model}"
            numbers |= {f"{name} evidence": found.log_evidence, f"{name} chi2": found.chi2_per_dof,
                        f"{name} ate": ate(found.poses, truth.poses),
                        f"{name} aligned": ate(found.poses, truth.poses, aligned=True),
                        f"{name} nees": anees(found.poses, found.covariances, truth.poses)}
    return numbers


def landmarks(seed, path="short", drift=1.0, kernel="graduated", **options):
    """Every way to initialise the markers, on one simulated drive with the true slip.

    Parameters
    ----------
    drift : factor on table 2's sigmas, in the drive and in the estimate.
    kernel : "graduated", the rounds of `slam.CAUCHY`, or "last", only its last one.

    Returns
    -------
    dict of numbers, for each way of `slam.LANDMARKS`: `... initial error`, the rms distance of the
    markers to the truth in metres; `... initial cost`, `... cost`, the graph's error before and after;
    `... steps`; `... right`, 1 where the cost is that reached from the true map and poses.
    """
    vehicle = Vehicle()
    vehicle = replace(vehicle, sigma_right_radius=drift * vehicle.sigma_right_radius,
                      sigma_left_radius=drift * vehicle.sigma_left_radius,
                      sigma_wheelbase=drift * vehicle.sigma_wheelbase)
    dataset, truth = simulate(path, seed, vehicle=vehicle, **options)
    graph = slam.Graph(dataset, "arc")
    U, _ = graph.factors.whitening(options.get("slip", 1e-3))
    rounds = [graph.native(scale) for scale in (
        slam.CAUCHY if kernel == "graduated" else slam.CAUCHY[-1:])]
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, graph.marker)]
    _, best, _ = graph.optimize(graph.values(truth.poses[graph.frame], true_map, np.zeros(3)),
                                rounds[-1], U)
    numbers = {}
    for name in slam.LANDMARKS:
        values, steps = graph.initial(name), 0
        error = graph.poses(values)[1][:, :2] - true_map[:, :2]
        initial_cost = graph.error(values, rounds[-1], U)
        for native in rounds:
            values, cost, more = graph.optimize(values, native, U)
            steps += more
        numbers |= {f"{name} initial error": np.sqrt(np.mean(np.sum(error**2, axis=1))),
                    f"{name} initial cost": initial_cost, f"{name} cost": cost,
                    f"{name} steps": steps, f"{name} right": float(cost < best + 0.01 * abs(best))}
    return numbers
