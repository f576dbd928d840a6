"""Runs the problems that a dataset's sensors allow, and writes the deliverables."""

import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slamlib import evaluation, fusion, localization, odometry, results, se2, slam


@dataclass(frozen=True)
class Solution:
    """What one problem yields, for every pose of the encoder file."""

    problem: str                   # folder of the results
    title: str
    poses: np.ndarray              # (n, 3) in the world frame; NaN where there is no estimate
    covariances: np.ndarray        # (n, 3, 3) of [x, y, heading] in world axes
    world: int = 0                 # index from 0 of the pose whose frame is the world frame
    aruco_map: tuple | None = None         # marker ids (k,), poses (k, 3), covariances (k, 3, 3)
    uwb_map: tuple | None = None           # antenna ids (a,), positions (a, 2), covariances (a, 2, 2)
    facts: dict = field(default_factory=dict)       # plain numbers for the summary


def problem1(dataset):
    """Odometry: equation 1 and the covariance of equation 2."""
    return Solution("problem1", "odometry", *odometry.equation2(dataset.ticks, dataset.vehicle))


def problem2(dataset, found=None):
    """Incremental localization from the markers alone; the world is the first measured pose.

    `found` is the Localization, where it has been computed already.
    """
    found = localization.localize(dataset.aruco) if found is None else found
    poses = np.full((len(dataset.ticks), 3), np.nan)
    covariances = np.full((len(dataset.ticks), 3, 3), np.nan)
    poses[found.frame], covariances[found.frame] = found.poses, found.covariances
    known = np.isfinite(found.poses[:, 0])
    poses[found.frame[known], 2] = np.unwrap(found.poses[known, 2])
    return Solution("problem2", "ArUco", poses, covariances, int(found.frame[known][0]),
                    (found.marker, found.marker_in_world, found.marker_covariance),
                    facts={"measured_poses": len(found.frame), "localized_poses": int(known.sum()),
                           "sightings": len(dataset.aruco.pose), "outliers": int(found.outlier.sum()),
                           "unused_sightings": int(found.unused.sum())})


def problem2_hint(dataset, fused=None):
    """Odometry and markers fused as the assignment hints: see `fusion.fuse_increments`.

    `fused` is the Fusion, where it has been computed already.
    """
    fused = fusion.fuse_increments(dataset) if fused is None else fused
    return Solution("problem2_hint", "odometry + ArUco, hint", fused.poses, fused.covariances)


def problem2_fused(dataset, fused=None):
    """Odometry and markers fused incrementally, with the errors that they share.

    `fused` is the Fusion, where it has been computed already.
    """
    fused = fusion.fuse(dataset) if fused is None else fused
    return Solution("problem2_fused", "odometry + ArUco", fused.poses, fused.covariances, facts={
        "slip_sqrt_m": fused.slip, "outliers": fused.outliers,
        "wheel_parameters_m": fused.wheel.tolist(),
        "wheel_parameter_sigmas_m": np.sqrt(np.diag(fused.wheel_covariance)).tolist()})


def problem3(dataset, found=None):
    """SLAM with GTSAM on odometry and markers. `found` is the Slam, where it has been computed."""
    found = slam.solve(dataset.without("uwb")) if found is None else found
    return Solution("problem3", "SLAM: odometry + ArUco", found.poses, found.covariances, 0,
                    (found.marker, found.marker_in_world, found.marker_covariance), facts=_facts(found))


def problem4(dataset, found=None):
    """SLAM with GTSAM on odometry, ranges, and markers if there are any.

    `found` is the Slam, where it has been computed.
    """
    found = slam.solve(dataset) if found is None else found
    has_markers = dataset.aruco is not None
    title = "SLAM: odometry + ArUco + UWB" if has_markers else "SLAM: odometry + UWB"
    weak = {antenna: int(np.sum(found.range_weight[dataset.uwb.antenna == antenna] < 0.5))
            for antenna in found.antenna.tolist()}
    return Solution(
        "problem4", title, found.poses, found.covariances, 0,
        (found.marker, found.marker_in_world, found.marker_covariance) if has_markers else None,
        (found.antenna, found.antenna_in_world, found.antenna_covariance),
        _facts(found) | {"ranges": len(dataset.uwb.pose), "ranges_down_weighted_by_antenna": weak,
                         "antennas_in_doubt": found.doubts})


def _facts(found):
    return {"slip_sqrt_m": found.slip, "increments": found.model, "outliers": int(found.outlier.sum()),
            "chi2_per_dof": found.chi2_per_dof, "log_evidence": found.log_evidence,
            "wheel_parameters_m": found.wheel.tolist(),
            "wheel_parameter_sigmas_m": np.sqrt(np.diag(found.wheel_covariance)).tolist()}


def solve(dataset):
    """Yield the Solution of every problem that the dataset's sensors allow, in order."""
    yield problem1(dataset)
    found = None
    if dataset.aruco is not None:
        yield problem2(dataset)
        yield problem2_hint(dataset)
        yield problem2_fused(dataset)
        found = slam.solve(dataset.without("uwb"))
        yield problem3(dataset, found)
    if dataset.uwb is not None:
        yield problem4(dataset, slam.solve(dataset, after=found))


def truth_in_world_of(solution, truth):
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


def solve_to_folder(dataset, truth, out):
    """Solve all problems, write the .mat files and summary.json below `out`; return the summary.

    Parameters
    ----------
    dataset : Dataset
    truth : Truth or None; used to report errors, never to estimate.
    out : folder to write to.

    Returns
    -------
    dict as written to summary.json.
    """
    summary = {"dataset": dataset.name, "poses": len(dataset.ticks), "problems": {}}
    solutions, start = [], time.perf_counter()
    for solution in solve(dataset):
        seconds, start = time.perf_counter() - start, time.perf_counter()
        solutions.append(solution)
        summary["problems"][solution.problem] = {"title": solution.title,
                                                 **summarize(solution, truth), "seconds": seconds}
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    for solution in solutions:
        write(out, solution)
    results.write_atomically(Path(out) / "summary.json", text.encode())
    return summary


def summarize(solution, truth):
    """Last estimate with its sigmas and, where there is truth, errors: a dict of plain numbers."""
    known = np.flatnonzero(np.isfinite(solution.poses[:, 0]))
    last = known[-1]
    summary = {"path_length_m": evaluation.path_length(solution.poses),
               "estimated_poses": len(known), "world_is_pose": solution.world + 1,
               "last_pose_number": int(last) + 1, "last_pose": solution.poses[last].tolist(),
               "last_sigma": evaluation.sigmas(solution.covariances[last]).tolist(),
               **solution.facts}
    if truth is not None:
        true_poses = truth_in_world_of(solution, truth)
        summary["ate_m"] = evaluation.ate(solution.poses, true_poses)
        summary["ate_aligned_m"] = evaluation.ate(solution.poses, true_poses, aligned=True)
    return summary
