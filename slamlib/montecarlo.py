"""Monte Carlo: one problem's methods on many simulated drives, judged against the truth."""

import numpy as np
from joblib import Parallel, delayed
from tqdm import tqdm

from slamlib import fusion, localization, odometry
from slamlib.evaluation import ate, nees
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
        numbers |= {f"{name} nees": np.nanmean(values), f"{name} last nees": values[-1],
                    f"{name} ate": ate(poses, truth.poses[at])}
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, alone.marker)]
    error = fused.wheel - wheel
    return numbers | {
        "map nees": nees(alone.marker_in_world, alone.marker_covariance, true_map).mean(),
        "wheel nees": error @ np.linalg.solve(fused.wheel_covariance, error), "slip": fused.slip}
