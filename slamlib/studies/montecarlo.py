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
from slamlib.core.hint import Fusion
from slamlib.core.increments import TYPICAL_SLIP
from slamlib.core.records import Dataset, Truth
from slamlib.core.sightings import sightings_by_frame
from slamlib.robust.fit import refine
from slamlib.robust.result import SlamResult, slam_result
from slamlib.studies.simulation import distances, simulate

PROBLEM2_METHODS = {
    "odometry": lambda dataset: Fusion(
        *odometry.equation2(dataset.ticks, dataset.vehicle), rejected=0),
    "ArUco": lambda dataset: localize(dataset.aruco),
    "naive": lambda dataset: localize(dataset.aruco, shared_errors=False),
    "hint": fuse_increments,
    "exact hint": lambda dataset: fuse_increments(dataset, odometry.first_order),
    "fused": fuse}
MEMORY_METHODS = ("markers", "problem 3", "problem 4", "independent")


def drive(seed: int, poses: int | None = None, path: str = "short",
          **options) -> tuple[Dataset, Truth]:
    """The Dataset and Truth of a simulated drive, or of its first `poses`."""
    dataset, truth = simulate(path, seed, **options)
    if poses is None:
        return dataset, truth
    return dataset.first(poses), replace(truth, poses=truth.poses[:poses])


def judged(name: str, poses: np.ndarray, covariances: np.ndarray, true: np.ndarray,
           aligned: bool = False) -> dict:
    """Numbers "nees", the mean, and "ate" in m of poses (n, 3), with a name before each key."""
    return {f"{name} nees": anees(poses, covariances, true),
            f"{name} ate": ate(poses, true, aligned)}


def problem2_trial(seed: int, **options) -> dict:
    """PROBLEM2_METHODS on one `drive`.

    Returns
    -------
    dict of numbers for each method: "nees", the mean over the measured poses, and "ate" in m.
    """
    dataset, truth = drive(seed, **options)
    frame = sightings_by_frame(dataset.aruco).frame
    numbers = {}
    for name, method in PROBLEM2_METHODS.items():
        found = method(dataset)
        rows = slice(None) if len(found.poses) == len(frame) else frame
        numbers |= judged(name, found.poses[rows], found.covariances[rows], truth.poses[frame])
    return numbers


def ranges_added(seed: int, share: float = 1.0, **options) -> dict:
    """Problems 3 and 4 on one `drive`, with markers over the first `share` of the drive only.

    Returns
    -------
    dict of numbers, "without" and "with" ranges: "ate without" and "aligned without", the ATE in m;
    "sigma without", the median over the poses of the larger sigma of x and y, in m; and so on. Also
    "moved", the median distance between the positions of both, over this sigma of each pose.
    """
    dataset, truth = drive(seed, **options)
    marker_poses = round(share * len(dataset.ticks))
    dataset = replace(dataset, aruco=dataset.first(marker_poses).aruco)
    without = estimate(dataset.without("uwb"))
    added = estimate(dataset, previous=without)
    numbers = {}
    for name, found in (("without", without), ("with", added)):
        numbers[f"ate {name}"] = ate(found.poses, truth.poses)
        numbers[f"aligned {name}"] = ate(found.poses, truth.poses, aligned=True)
        numbers[f"sigma {name}"] = np.median(position_sigmas(found.covariances[1:]))
    moved = distances(added.poses[1:], without.poses[1:])
    numbers["moved"] = np.median(moved / position_sigmas(without.covariances[1:]))
    return numbers


def plain_and_delivered(seed: int, **options) -> dict:
    """The plain graph and `estimate`, problems 3 and 4, on one `drive`.

    Returns
    -------
    dict of numbers, as "plain 3 ate" and "delivered 4 ate": the ATE and the aligned ATE in m, the
    mean "nees", and the median "sigma" in m, the larger one of x and y; of the poses with a
    measurement.
    """
    dataset, truth = drive(seed, **options)
    without = dataset.without("uwb")
    problem3 = estimate(without)
    problem4 = estimate(dataset, previous=problem3)
    numbers = {}
    for problem, given, result in ((3, without, problem3), (4, dataset, problem4)):
        for name, at, poses, covariances in both_graphs(given, result):
            key = f"{name} {problem}"
            numbers |= judged(key, poses, covariances, truth.poses[at])
            numbers[f"{key} aligned"] = ate(poses, truth.poses[at], aligned=True)
            numbers[f"{key} sigma"] = np.median(position_sigmas(covariances[1:]))
    return numbers


def both_graphs(dataset: Dataset, result: SlamResult) -> Iterator[tuple]:
    """Yield "plain" and "delivered", each with the indices of its poses, them, and covariances.

    The plain graph of a Dataset counts all measurements, its slip is typical. Of the `result` of
    `estimate` the poses are those that the plain graph has.
    """
    decisions = count_everything(dataset, slip=TYPICAL_SLIP)
    plain = solve_graph(build_graph(decisions), initial_values(dataset, decisions))
    at = plain.pose
    yield "plain", at, plain.poses, plain.covariances
    yield "delivered", at, result.poses[at], result.covariances[at]


def correlated_errors(seed: int, correlation: float, **options) -> dict:
    """Problems 2 to 4 on one `drive`; `correlation` is the `memory` of `simulate`.

    Returns
    -------
    dict of "nees" and aligned "ate" in m of MEMORY_METHODS, as "markers nees"; "independent" is
    problem 3 with every sighting counted in full. Also of problem 3 the mean "share" of its
    information that a sighting keeps, and the "residuals", the correlation of those of neighbours.
    """
    dataset, truth = drive(seed, memory=correlation, **options)
    markers = localize(dataset.aruco)
    problem3 = estimate(dataset.without("uwb"))
    problem4 = estimate(dataset, previous=problem3)
    results = (markers, problem3, problem4, _counted_in_full(problem3.fit))
    numbers = {"share": problem3.share.mean(), "residuals": problem3.correlation[0]}
    for name, found in zip(MEMORY_METHODS, results, strict=True):
        true = truth.poses[markers.frame] if found is markers else truth.poses
        numbers |= judged(name, found.poses, found.covariances, true, aligned=True)
    return numbers


def _counted_in_full(fit):
    """The SlamResult with the noise of a Fit, where every sighting keeps all its information."""
    accepted = fit.problem.accepted
    in_full = accepted.with_shares(np.ones_like(each.share) for each in accepted)
    return slam_result(refine(replace(fit.problem, accepted=in_full), fit.state, accept=None))


def antenna_error(found, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """Distances (a,) in m of a SlamResult's antennas from the truth, and their NEES (a,)."""
    row = np.searchsorted(truth.antenna, found.antenna)
    error = found.antenna_in_world - truth.antenna_in_world[row]
    return np.linalg.norm(error, axis=1), se2.squared_norms(error, found.antenna_covariance)
