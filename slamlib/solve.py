"""Runs the problems that a dataset's sensors allow, and writes the deliverables."""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slamlib import evaluation, odometry, results


@dataclass(frozen=True)
class Solution:
    """What one problem yields: poses (n, 3), covariances (n, 3, 3), and what it is called."""

    problem: str
    title: str
    poses: np.ndarray
    covariances: np.ndarray


def problem1(dataset):
    """Odometry: equation 1 and the covariance of equation 2."""
    poses, covariances = odometry.equation2(dataset.ticks, dataset.vehicle)
    return Solution("problem1", "odometry", poses, covariances)


def solve(dataset):
    """Yield the Solution of every problem that the dataset's sensors allow, in order."""
    yield problem1(dataset)


def write(folder, solution):
    """Write a solution's .mat files into folder/<problem>/ and return that folder."""
    folder = Path(folder) / solution.problem
    results.write_vehicle_poses(folder, solution.poses, solution.covariances)
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
    for solution in solutions:
        write(out, solution)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    results.write_atomically(Path(out) / "summary.json", text.encode())
    return summary


def summarize(solution, truth):
    """Last pose with its sigmas and, where there is truth, errors: a dict of plain numbers."""
    sigma = np.sqrt(np.diagonal(solution.covariances[-1]))
    summary = {"path_length_m": evaluation.path_length(solution.poses),
               "last_pose": solution.poses[-1].tolist(), "last_sigma": sigma.tolist()}
    if truth is not None:
        summary["ate_m"] = evaluation.ate(solution.poses, truth.poses)
    return summary
