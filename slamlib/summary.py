"""All problems of a dataset solved into a folder, with a summary of plain numbers."""

import json
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

from slamlib import evaluation, results
from slamlib.solve import (
    Failure,
    doubts_about_drive,
    merged,
    solutions,
    truth_in_world,
    write,
)


def solve_to_folder(dataset, truth, out):
    """The summary of all problems of a Dataset, written with their files below the folder `out`.

    The Truth, or None, serves to report errors, never to estimate. Each problem's files are written
    as it ends. The summary is the dict that is written to summary.json; a problem that could not be
    solved has the entry "failed", a sentence. Its list "doubts", of "what" and "sentence", is empty
    where the measurements agree with the files: first those about the drive, then by problem.
    """
    summary = {"dataset": dataset.name, "poses": len(dataset.ticks), "doubts": [], "problems": {}}
    doubts = list(doubts_about_drive(dataset, truth))
    start = time.perf_counter()
    for solution in solutions(dataset):
        seconds = time.perf_counter() - start
        failed = isinstance(solution, Failure)
        row = {"failed": solution.reason} if failed else summarize(solution, truth)
        summary["problems"][solution.problem] = {"title": solution.title, **row, "seconds": seconds}
        if not failed:
            write(out, solution)
            doubts += solution.doubts
        start = time.perf_counter()
    summary["doubts"] = [asdict(doubt) for doubt in merged(doubts)]
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
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
        true_poses = truth_in_world(solution, truth)
        summary["ate_m"] = evaluation.ate(solution.poses, true_poses)
        summary["ate_aligned_m"] = evaluation.ate(solution.poses, true_poses, aligned=True)
    return summary
