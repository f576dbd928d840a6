"""Trials of the methods of problems 2 to 4: one simulated drive, judged against its truth.

A trial is a function of a seed and of options that returns a dict of numbers. `studies.run` runs it
over many seeds. Options that a trial does not name are those of `simulation.simulate`.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from slamlib import (
    build_graph,
    count_everything,
    estimate,
    fuse,
    fuse_increments,
    initial_values,
    localize,
    solve_graph,
)
from slamlib.core import odometry, se2
from slamlib.core.evaluation import anees, ate, position_sigmas
from slamlib.core.records import Dataset, Truth
from slamlib.robust.fit import refine_without_memory, settled
from slamlib.robust.result import SlamResult, slam_result
from slamlib.robust.solution_doubts import solution_doubts
from slamlib.studies.simulation import simulate


def judged(name: str, poses: np.ndarray, covariances: np.ndarray, true: np.ndarray,
           aligned: bool = False) -> dict:
    """Numbers "nees", the mean, and "ate" in m of poses (n, 3), with a name before each key."""
    return {f"{name} nees": anees(poses, covariances, true),
            f"{name} ate": ate(poses, true, aligned)}


def problem2_trial(seed: int, **options) -> dict:
    """Methods of problem 2 on one drive.

    Returns
    -------
    dict of numbers for each method: "nees", the mean over the measured poses, and "ate" in m.
    """
    dataset, truth = simulate(seed=seed, **options)
    aruco = dataset.aruco
    methods = {
        "odometry": fuse_increments(dataset.without("aruco")),
        "ArUco": localize(aruco),
        "naive": localize(aruco, shared_errors=False),
        "hint": fuse_increments(dataset),
        "exact hint": fuse_increments(dataset, odometry.first_order),
        "fused": fuse(dataset)}
    frame = methods["ArUco"].frame
    numbers = {}
    for name, found in methods.items():
        rows = slice(None) if len(found.poses) == len(frame) else frame
        numbers |= judged(name, found.poses[rows], found.covariances[rows], truth.poses[frame])
    return numbers


def problems_3_and_4(dataset: Dataset) -> tuple[SlamResult, SlamResult]:
    """What `estimate` finds without and with the ranges of a Dataset."""
    without = estimate(dataset.without("uwb"))
    return without, estimate(dataset, previous=without)


def ranges_added(seed: int, share: float = 1.0, **options) -> dict:
    """Problems 3 and 4 on one drive, with markers over the first `share` of the drive only.

    Returns
    -------
    dict of numbers, "without" and "with" ranges: "ate without" and "aligned without", the ATE in m.
    """
    dataset, truth = simulate(seed=seed, **options)
    marker_poses = round(share * len(dataset.ticks))
    dataset = replace(dataset, aruco=dataset.first(marker_poses).aruco)
    numbers = {}
    for name, found in zip(("without", "with"), problems_3_and_4(dataset)):
        numbers[f"ate {name}"] = ate(found.poses, truth.poses)
        numbers[f"aligned {name}"] = ate(found.poses, truth.poses, aligned=True)
    return numbers


def plain_and_delivered(seed: int, **options) -> dict:
    """The plain graph and `estimate`, problems 3 and 4, on one drive.

    Returns
    -------
    dict of numbers, as "plain 3 ate" and "delivered 4 ate": the ATE and the aligned ATE in m, the
    mean "nees", and the median "sigma" in m, the larger one of x and y; of the poses with a
    measurement. "delivered 3 doubts" is the number of doubts about the solution.
    """
    dataset, truth = simulate(seed=seed, **options)
    problem3, problem4 = problems_3_and_4(dataset)
    numbers = {}
    for problem, given, result in (
            (3, dataset.without("uwb"), problem3), (4, dataset, problem4)):
        for name, at, poses, covariances in both_graphs(given, result):
            key = f"{name} {problem}"
            numbers |= judged(key, poses, covariances, truth.poses[at])
            numbers[f"{key} aligned"] = ate(poses, truth.poses[at], aligned=True)
            numbers[f"{key} sigma"] = np.median(position_sigmas(covariances[1:]))
        numbers[f"delivered {problem} doubts"] = len(solution_doubts(result))
    return numbers


def both_graphs(dataset: Dataset, result: SlamResult) -> Iterator[tuple]:
    """Yield "plain" and "delivered", each with the indices of its poses, them, and covariances.

    The plain graph of a Dataset counts all measurements, its slip is typical. Of the `result` of
    `estimate` the poses are those that the plain graph has.
    """
    decisions = count_everything(dataset)
    plain = solve_graph(build_graph(decisions), initial_values(dataset, decisions))
    at = plain.pose
    yield "plain", at, plain.poses, plain.covariances
    yield "delivered", at, result.poses[at], result.covariances[at]


def correlated_errors(seed: int, correlation: float, **options) -> dict:
    """Problems 2 to 4 on one drive; `correlation` is the `memory` of `simulate`.

    Returns
    -------
    dict of "nees" and aligned "ate" in m of each method, as "markers nees"; "independent" is
    problem 3 with every sighting counted in full. Also of problem 3 the mean "share" of its
    information that a sighting keeps, and the "correlation" of neighbours that it finds.
    """
    dataset, truth = simulate(seed=seed, memory=correlation, **options)
    markers = localize(dataset.aruco)
    problem3, problem4 = problems_3_and_4(dataset)
    methods = {"markers": markers, "problem 3": problem3, "problem 4": problem4,
               "independent": _counted_in_full(problem3.fit)}
    numbers = {"share": problem3.share.mean(), "correlation": problem3.correlation[0]}
    for name, found in methods.items():
        true = truth.poses[markers.frame] if found is markers else truth.poses
        numbers |= judged(name, found.poses, found.covariances, true, aligned=True)
    return numbers


def _counted_in_full(fit):
    """The SlamResult from a Fit, with noise as of sightings that keep all their information."""
    return slam_result(settled(refine_without_memory(fit.problem, fit.state)))


def antenna_error(found, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """Distances (a,) in m of a SlamResult's antennas from the truth, and their NEES (a,)."""
    row = np.searchsorted(truth.antenna, found.antenna)
    error = found.antenna_in_world - truth.antenna_in_world[row]
    return np.linalg.norm(error, axis=1), se2.squared_norms(error, found.antenna_covariance)
