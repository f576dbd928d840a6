"""The assignment's problems: which of them a dataset allows, their solutions and files.

This module is the one home of the problems' titles, sensors and roles in figures. The function of a
problem takes what a caller has computed already: a Localization, Fusion or SlamResult.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamlib import localization, odometry, results, se2, slam
from slamlib.dataset import DatasetError
from slamlib.doubt import Doubt

UNSOLVABLE = (DatasetError, np.linalg.LinAlgError)  # what `find` raises where there is no solution


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
WHOLE_FILES = {"units", "wheels-swapped", "wheels-reversed", "camera-mirrored", "camera-turned",
               "odometry", "counts-since-start"}
COVARIANCES = ("marker_covariance", "antenna_covariance", "wheel_covariance")
SENSORS = {"aruco": "markers", "uwb": "UWB ranges"}
SUMMARY = "summary.json"
OURS = frozenset([  # names of what a drive's results may be
    SUMMARY, *(f"{problem}/{file}" for problem in PROBLEMS for file in results.FILES)])


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
    doubts: tuple[Doubt, ...] = ()


def _solution(problem, dataset, poses, covariances, **others):
    return Solution(problem=problem, title=title(problem, dataset), poses=poses,
                    covariances=covariances, **others)


@dataclass(frozen=True)
class Failure:
    """A problem that could not be solved."""

    problem: str
    title: str
    reason: str                    # a sentence


def allows(dataset, problem):
    """True if the dataset has the sensors that a problem needs."""
    return all(getattr(dataset, sensor) is not None for sensor in PROBLEMS[problem].sensors)


def failure(problem, dataset, error):
    """The Failure that an exception of UNSOLVABLE tells; the reason does not name the dataset."""
    reason = str(error).removeprefix(f"{dataset.name}: ")
    if isinstance(error, np.linalg.LinAlgError):
        reason = ("expected lengths and standard deviations that float64 can hold together; some "
                  f"are so far from the others that matrices lose their digits ({reason})")
    return Failure(problem, title(problem, dataset), reason)


def find(problem, dataset, found=None):
    """What the solver of a problem returns, from which `problem1` and so on make a Solution.

    It is (poses, covariances), Localization, Fusion or SlamResult. `found` are such results of
    other problems (dict by problem): problem 4 starts from problem 3 where there is one. Raises
    UNSOLVABLE.
    """
    solvers = {
        "problem1": lambda: odometry.equation2(dataset.ticks, dataset.vehicle),
        "problem2": lambda: localization.localize(dataset.aruco),
        "problem2_hint": lambda: localization.fuse_increments(dataset),
        "problem2_fused": lambda: localization.fuse(dataset),
        "problem3": lambda: slam.estimate(dataset.without("uwb")),
        "problem4": lambda: slam.estimate(dataset, previous=(found or {}).get("problem3"))}
    result = solvers[problem]()
    _require_covariances(result)
    return result


def _require_covariances(result):
    """Raise LinAlgError where a covariance of what `find` returns is lost by rounding."""
    poses, covariances = result if isinstance(result, tuple) else (result.poses, result.covariances)
    each = [covariances[np.isfinite(poses[:, 0])]] + [
        getattr(result, name) for name in COVARIANCES if getattr(result, name, None) is not None]
    variances = np.concatenate(
        [np.diagonal(C, axis1=-2, axis2=-1).ravel() for C in each])
    if not ((0 <= variances) & (variances < np.inf)).all() \
            or not np.isfinite(getattr(result, "log_evidence", 0.0)):
        raise np.linalg.LinAlgError("a variance is negative or not finite")


def problem1(dataset, found=None):
    """Solution of problem 1, odometry: equation 1 and the covariance of equation 2."""
    poses, covariances = find("problem1", dataset) if found is None else found
    return _solution("problem1", dataset, poses, covariances)


def problem2(dataset, found=None):
    """Solution of problem 2, markers alone; the world is the frame of the first measured pose."""
    found = find("problem2", dataset) if found is None else found
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


def problem2_hint(dataset, found=None):
    """Solution of problem 2 fused as the assignment hints: `localization.fuse_increments`."""
    found = find("problem2_hint", dataset) if found is None else found
    return _solution("problem2_hint", dataset, found.poses, found.covariances)


def problem2_fused(dataset, found=None):
    """Solution of problem 2 fused with odometry, with shared errors: `localization.fuse`."""
    found = find("problem2_fused", dataset) if found is None else found
    factor = dataset.vehicle.marker_noise_factor
    facts = {"slip_sqrt_m": found.slip, **({} if factor is None else {
        "marker_noise_factor": factor})}
    return _solution("problem2_fused", dataset, found.poses, found.covariances, facts={
        **facts, **_given(dataset, facts), "outliers": found.rejected, **_wheels(found)})


def problem3(dataset, found=None):
    """Solution of problem 3, SLAM on odometry and markers."""
    found = find("problem3", dataset) if found is None else found
    return _solution("problem3", dataset, found.poses, found.covariances,
                     aruco_map=_marker_map(found), facts=_slam_facts(found, dataset),
                     doubts=found.drive_doubts)


def problem4(dataset, found=None):
    """Solution of problem 4, SLAM on odometry, ranges, and markers if there are any."""
    found = find("problem4", dataset) if found is None else found
    weak = {antenna: int(np.sum(found.range_weight[dataset.uwb.antenna == antenna] < 0.5))
            for antenna in found.antenna.tolist()}
    return _solution(
        "problem4", dataset, found.poses, found.covariances,
        aruco_map=None if dataset.aruco is None else _marker_map(found),
        uwb_map=(found.antenna, found.antenna_in_world, found.antenna_covariance),
        facts=_slam_facts(found, dataset) | {
            "ranges": len(dataset.uwb.pose), "ranges_down_weighted_by_antenna": weak,
            "antennas_in_doubt": found.doubts}, doubts=found.drive_doubts)


def _marker_map(found):
    return found.marker, found.marker_in_world, found.marker_covariance


def _wheels(found):
    return {"wheel_parameters_m": found.wheel.tolist(),
            "wheel_parameter_sigmas_m": np.sqrt(np.diag(found.wheel_covariance)).tolist()}


def _given(dataset, facts):
    """The names of those of the facts that the dataset's Vehicle gives, where there are any."""
    names = [name for name in facts
             if getattr(dataset.vehicle, name.removesuffix("_sqrt_m"), None) is not None]
    return {"given": names} if names else {}


def _slam_facts(found, dataset):
    facts, sigma = {}, found.noise_sigma.tolist()
    if len(found.rejected):
        facts |= {"marker_noise_factor": found.noise.sightings,
                  "marker_noise_relative_sigma": sigma[1]}
    if len(found.antenna):
        facts |= {"range_noise_factor": found.noise.ranges, "range_noise_relative_sigma": sigma[2]}
    if found.range_calibration_covariance.any():
        facts |= dict(zip(("range_offset_m", "range_scale"), found.range_calibration.tolist()))
        facts["range_offset_and_scale_sigmas"] = found.range_calibration_sigma.tolist()
    facts = {"slip_sqrt_m": found.slip, "slip_relative_sigma": sigma[0], **facts}
    return {**facts, **_given(dataset, facts), "increments": found.model,
            "outliers": int(found.rejected.sum()), "chi2_per_dof": found.chi2_per_dof,
            "chi2_per_dof_of_all": found.chi2_per_dof_of_all,
            "log_evidence": found.log_evidence, **_wheels(found)}


SOLUTIONS = {"problem1": problem1, "problem2": problem2, "problem2_hint": problem2_hint,
             "problem2_fused": problem2_fused, "problem3": problem3, "problem4": problem4}


def solutions(dataset, found=None, problems=tuple(PROBLEMS)):
    """Yield the Solution of each of `problems` that the dataset's sensors allow, in order.

    A problem that cannot be solved yields a Failure, and the others go on. `found` are the results
    by `find` that are known already (dict by problem).
    """
    found = dict(found or {})
    for problem in problems:
        if not allows(dataset, problem):
            continue
        try:
            result = found[problem] if problem in found else find(problem, dataset, found)
            if problem == "problem3":                    # from which problem 4 starts
                found[problem] = result
            yield SOLUTIONS[problem](dataset, result)
        except UNSOLVABLE as error:
            yield failure(problem, dataset, error)


def doubts_about_drive(dataset, truth):
    """Doubts (tuple of Doubt) about a drive as a whole, before any of its problems is solved.

    From its measurements, and from its Truth or None.
    """
    try:
        by_measurements = localization.drive_doubts(dataset)
    except np.linalg.LinAlgError:              # where increments have no covariance
        by_measurements = []
    return (*by_measurements, *(() if truth is None else truth.doubts))


def merged(doubts):
    """List of Doubt, each once; of what problems 3 and 4 both find, the later sentence.

    There may be several doubts of a kind about antennas and units. A doubt about whole files
    silences those that a solution of such files leads to.
    """
    kinds = {doubt.what for doubt in doubts}
    kept = [doubt for doubt in doubts if not kinds & WHOLE_FILES
            or doubt.what in WHOLE_FILES | {"truth-frame"}]
    return list({doubt.sentence if doubt.what in ("antenna", "units") else doubt.what: doubt
                 for doubt in kept}.values())


def truth_in_world(solution, truth):
    """The true poses (n, 3) in the solution's world frame."""
    if solution.world == 0:
        return truth.poses
    return se2.between(truth.poses[solution.world], truth.poses)


def write(folder, solution):
    """Write a solution's .mat files into folder/<problem>/ and return that folder.

    A summary in `folder` is removed: it is not of these files.
    """
    (Path(folder) / SUMMARY).unlink(missing_ok=True)
    folder = Path(folder) / solution.problem
    results.write_vehicle_poses(folder, solution.poses, solution.covariances)
    if solution.aruco_map is not None:
        results.write_aruco_map(folder, *solution.aruco_map)
    if solution.uwb_map is not None:
        results.write_uwb_map(folder, *solution.uwb_map)
    return folder
