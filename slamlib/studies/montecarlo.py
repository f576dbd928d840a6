"""Trials of the methods of problems 2 to 4: one simulated drive, judged against its truth.

A trial is a function of a seed and of options that returns a dict of numbers. `memory.run` runs it
over many seeds. Options that a trial does not name are those of `simulation.simulate`.
"""

from dataclasses import replace

import numpy as np

from slamlib import estimate, fuse, fuse_increments, localize
from slamlib.core import odometry
from slamlib.core.evaluation import anees, ate, position_sigmas
from slamlib.core.sightings import sightings_by_frame
from slamlib.robust.fit import refine
from slamlib.robust.result import slam_result
from slamlib.studies.simulation import simulate

PROBLEM2_METHODS = {
    "odometry": lambda dataset: odometry.dead_reckoning(dataset.ticks, dataset.vehicle),
    "ArUco": lambda dataset: localize(dataset.aruco),
    "naive": lambda dataset: localize(dataset.aruco, shared_errors=False),
    "hint": fuse_increments,
    "exact hint": lambda dataset: fuse_increments(dataset, odometry.first_order),
    "fused": fuse}
MEMORY_METHODS = ("markers", "problem 3", "problem 4", "known", "independent")


def drive(seed, poses=None, **options):
    """The Dataset and Truth of a simulated drive of the short path, or of its first `poses`."""
    dataset, truth = simulate("short", seed, **options)
    return (dataset.first(poses or len(dataset.ticks)), replace(truth, poses=truth.poses[:poses]))


def problem2_trial(seed, methods=tuple(PROBLEM2_METHODS), **options):
    """Methods of problem 2 on one `drive`.

    Returns
    -------
    dict of numbers for each of `methods`: "nees", the mean over the measured poses, and "ate" in m
    (of odometry the ATE only).
    """
    dataset, truth = drive(seed, **options)
    frame, numbers = sightings_by_frame(dataset.aruco).frame, {}
    for method in methods:
        found = PROBLEM2_METHODS[method](dataset)
        if method == "odometry":
            numbers["odometry ate"] = ate(found[frame], truth.poses[frame])
            continue
        measured = slice(None) if len(found.poses) == len(frame) else frame
        poses, covariances = found.poses[measured], found.covariances[measured]
        numbers |= {f"{method} nees": anees(poses, covariances, truth.poses[frame]),
                    f"{method} ate": ate(poses, truth.poses[frame])}
    return numbers


def ranges_added(seed, share=1.0, **options):
    """Problems 3 and 4 on one `drive`, with markers over the first `share` of the drive only.

    Returns
    -------
    dict of numbers, "without" and "with" ranges: "ate without" and "aligned without", the ATE in m;
    "sigma without", the median over the poses of the larger sigma of x and y, in m; and so on. Also
    "moved", the median distance between the positions of both, over this sigma of each pose.
    """
    dataset, truth = drive(seed, **options)
    dataset = replace(dataset, aruco=dataset.first(round(share * len(dataset.ticks))).aruco)
    without = estimate(dataset.without("uwb"))
    solved, numbers = {"without": without, "with": estimate(dataset, previous=without)}, {}
    for name, found in solved.items():
        numbers |= {f"ate {name}": ate(found.poses, truth.poses),
                    f"aligned {name}": ate(found.poses, truth.poses, aligned=True),
                    f"sigma {name}": np.median(position_sigmas(found.covariances[1:]))}
    distance = np.hypot(*(solved["with"].poses - without.poses)[1:, :2].T)
    return numbers | {"moved": np.median(distance / position_sigmas(without.covariances[1:]))}


def correlated_errors(seed, correlation, **options):
    """Problems 2 to 4 on one `drive`; `correlation` is the `memory` of `simulate`.

    Returns
    -------
    dict of "nees" and aligned "ate" in m of MEMORY_METHODS, as "markers nees"; "known" is problem 3
    with the `known_shares` of information, "independent" with all of it. Also of problem 3 the mean
    "share" of its information that a sighting keeps, and the "residuals", the correlation of those
    of neighbours.
    """
    dataset, truth = drive(seed, memory=correlation, **options)
    markers, problem3 = localize(dataset.aruco), estimate(dataset.without("uwb"))
    problem4, numbers = estimate(dataset, previous=problem3), {}
    problem = problem3.fit.problem
    known = known_shares(problem.measurements, correlation)
    known, independent = (slam_result(refine(replace(problem, accepted=problem.accepted.with_shares(
        [share, np.ones(0)])), problem3.fit.state, accept=None)) for share in (known, known**0))
    for name, found in zip(MEMORY_METHODS, (markers, problem3, problem4, known, independent)):
        true = truth.poses[getattr(found, "frame", slice(None))]
        numbers |= {f"{name} nees": anees(found.poses, found.covariances, true),
                    f"{name} ate": ate(found.poses, true, aligned=True)}
    return numbers | {"share": problem3.share.mean(), "residuals": problem3.correlation[0]}


def known_shares(measurements, correlation):
    """Shares (s,) of its information that a sighting keeps, by the true correlation of errors.

    The design effect, as in slamlib.robust.error_memory: 1 / (1 + sum of the correlations with the
    errors of all other sightings of its marker), which is `correlation` to the power of the number
    of camera frames between them.
    """
    g, label = measurements.sightings, measurements.marker_row
    pose = measurements.frame[g.row]
    lag = np.abs(pose[:, None] - pose) / np.median(np.diff(np.unique(pose)))
    same = label[:, None] == label
    return 1 / np.sum(same * np.where(lag > 0, correlation**lag, 1.0), axis=1)


def antenna_error(found, truth):
    """Distances (a,) in m of a SlamResult's antennas from the truth, and their NEES (a,)."""
    error = found.antenna_in_world - truth.antenna_in_world[
        np.searchsorted(truth.antenna, found.antenna)]
    return np.hypot(*error.T), np.einsum(
        "ni,nij,nj->n", error, np.linalg.inv(found.antenna_covariance), error)
