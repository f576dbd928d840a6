"""The assignment's problems: which of them a dataset allows, their solutions and files.

This module is the one home of the problems' titles, sensors and roles in figures. The function of a
problem takes what a caller has computed already: a Localization, Fusion or SlamResult.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamlib import localization, odometry, results, se2, slam
from slamlib.dataset import DatasetError


@dataclass(frozen=True)
class Task:
    """What is known of a problem before it is solved."""

    title: str
    sensors: tuple                 # attributes of Dataset that it needs besides the ticks
    role: str                      # its look in figures (`notebook.plotting.ROLES`)


# Every problem in the order of solution, by the name of its results folder.
PROBLEMS = {
    "problem1": Task("odometry", (), "odometry"),
    "problem2": Task("ArUco", ("aruco",), "aruco"),
    "problem2_hint": Task("odometry + ArUco, hint", ("aruco",), "hint"),
    "problem2_fused": Task("odometry + ArUco", ("aruco",), "fused"),
    "problem3": Task("SLAM: odometry + ArUco", ("aruco",), "slam"),
    "problem4": Task("SLAM: odometry + ArUco + UWB", ("uwb",), "slam_uwb"),
}
SENSORS = {"aruco": "markers", "uwb": "UWB ranges"}


def title(problem, dataset):
    """Title of a problem on this dataset; one that is not in PROBLEMS is called by its folder.

    Problem 4 is solved without markers, too, and its title says so.
    """
    name = PROBLEMS[problem].title if problem in PROBLEMS else problem
    return name if dataset.aruco is not None else name.replace(" + ArUco + UWB", " + UWB")


@dataclass(frozen=True)
class Solution:
    """What one problem yields, for every pose of the encoder file."""

    problem: str                   # folder of the results
    title: str
    poses: np.ndarray              # (n, 3) in the world frame; NaN where there is no estimate
    covariances: np.ndarray        # (n, 3, 3) of [x, y, heading] in world axes
    world: int = 0                 # index from 0 of the pose whose frame is the world frame
    aruco_map: tuple | None = None         # marker ids (k,), poses (k, 3), covariances (k, 3, 3)
    uwb_map: tuple | None = None           # antenna ids (a,), positions (a, 2), cov. (a, 2, 2)
    facts: dict = field(default_factory=dict)       # plain numbers for the summary


def _solution(problem, dataset, poses, covariances, **others):
    return Solution(problem=problem, title=title(problem, dataset), poses=poses,
                    covariances=covariances, **others)


@dataclass(frozen=True)
class Failure:
    """A problem that could not be solved."""

    problem: str
    title: str
    reason: str                    # a sentence


def problem1(dataset):
    """Solution of problem 1, odometry: equation 1 and the covariance of equation 2."""
    poses, covariances = odometry.equation2(dataset.ticks, dataset.vehicle)
    return _solution("problem1", dataset, poses, covariances)


def problem2(dataset, found=None):
    """Solution of problem 2, markers alone; the world is the frame of the first measured pose."""
    found = localization.localize(dataset.aruco) if found is None else found
    poses = np.full((len(dataset.ticks), 3), np.nan)
    covariances = np.full((len(dataset.ticks), 3, 3), np.nan)
    poses[found.frame], covariances[found.frame] = found.poses, found.covariances
    known = np.isfinite(found.poses[:, 0])
    poses[found.frame[known], 2] = np.unwrap(found.poses[known, 2])
    return _solution(
        "problem2", dataset, poses, covariances, world=int(found.frame[known][0]),
        aruco_map=_marker_map(found),
        facts={"measured_poses": len(found.frame), "localized_poses": int(known.sum()),
               "sightings": len(dataset.aruco.pose), "outliers": int(found.rejected.sum()),
               "unused_sightings": int(found.unused.sum())})


def problem2_hint(dataset, fused=None):
    """Solution of problem 2 fused as the assignment hints: `localization.fuse_increments`."""
    fused = localization.fuse_increments(dataset) if fused is None else fused
    return _solution("problem2_hint", dataset, fused.poses, fused.covariances)


def problem2_fused(dataset, fused=None):
    """Solution of problem 2 fused with odometry, with shared errors: `localization.fuse`."""
    fused = localization.fuse(dataset) if fused is None else fused
    return _solution("problem2_fused", dataset, fused.poses, fused.covariances, facts={
        "slip_sqrt_m": fused.slip, "outliers": fused.rejected, **_wheels(fused)})


def problem3(dataset, found=None):
    """Solution of problem 3, SLAM on odometry and markers."""
    found = slam.estimate(dataset.without("uwb")) if found is None else found
    return _solution("problem3", dataset, found.poses, found.covariances,
                     aruco_map=_marker_map(found), facts=_slam_facts(found))


def problem4(dataset, found=None):
    """Solution of problem 4, SLAM on odometry, ranges, and markers if there are any."""
    found = slam.estimate(dataset) if found is None else found
    weak = {antenna: int(np.sum(found.range_weight[dataset.uwb.antenna == antenna] < 0.5))
            for antenna in found.antenna.tolist()}
    return _solution(
        "problem4", dataset, found.poses, found.covariances,
        aruco_map=None if dataset.aruco is None else _marker_map(found),
        uwb_map=(found.antenna, found.antenna_in_world, found.antenna_covariance),
        facts=_slam_facts(found) | {
            "ranges": len(dataset.uwb.pose), "ranges_down_weighted_by_antenna": weak,
            "antennas_in_doubt": found.doubts})


def _marker_map(found):
    return found.marker, found.marker_in_world, found.marker_covariance


def _wheels(found):
    return {"wheel_parameters_m": found.wheel.tolist(),
            "wheel_parameter_sigmas_m": np.sqrt(np.diag(found.wheel_covariance)).tolist()}


def _slam_facts(found):
    return {"slip_sqrt_m": found.slip, "increments": found.model,
            "outliers": int(found.rejected.sum()), "chi2_per_dof": found.chi2_per_dof,
            "log_evidence": found.log_evidence, **_wheels(found)}


INCREMENTAL = {"problem1": problem1, "problem2": problem2, "problem2_hint": problem2_hint,
               "problem2_fused": problem2_fused}


def solutions(dataset):
    """Yield the Solution of every problem that the dataset's sensors allow, in order.

    A problem that cannot be solved yields a Failure, and the others go on. Problem 4 starts from
    problem 3 where there is one.
    """
    previous = None
    for problem, task in PROBLEMS.items():
        if any(getattr(dataset, sensor) is None for sensor in task.sensors):
            continue
        try:
            if problem == "problem3":
                previous = slam.estimate(dataset.without("uwb"))
                yield problem3(dataset, previous)
            elif problem == "problem4":
                yield problem4(dataset, slam.estimate(dataset, previous=previous))
            else:
                yield INCREMENTAL[problem](dataset)
        except (DatasetError, np.linalg.LinAlgError) as error:
            yield Failure(problem, title(problem, dataset), str(error))


def truth_in_world(solution, truth):
    """The true poses (n, 3) in the solution's world frame."""
    if solution.world == 0:
        return truth.poses
    return se2.between(truth.poses[solution.world], truth.poses)


def write(folder, solution):
    """Write a solution's .mat files into folder/<problem>/ and return that folder."""
    folder = Path(folder) / solution.problem
    results.write_vehicle_poses(folder, solution.poses, solution.covariances)
    if solution.aruco_map is not None:
        results.write_aruco_map(folder, *solution.aruco_map)
    if solution.uwb_map is not None:
        results.write_uwb_map(folder, *solution.uwb_map)
    return folder
