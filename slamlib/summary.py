"""Solving all problems of a dataset into a folder, with a summary of plain numbers."""

import json
import signal
import sys
import time
from contextlib import suppress
from dataclasses import asdict
from multiprocessing import Pipe, get_context

import numpy as np

from slamlib import evaluation, solve, swap
from slamlib.checks.files import doubts_before_solving, merged
from slamlib.dataset import all_notes
from slamlib.results import write_tum

# Problems that the second process solves: no other problem needs their results.
INDEPENDENT = ("problem1", "problem2", "problem2_hint", "problem2_fused")


def solve_to_folder(dataset, truth, out, problems=tuple(solve.PROBLEMS), csv=False):
    """Solve problems of a Dataset and write their files to the folder `out`.

    When all files are written they replace those of an earlier run, by `swap.publish`. On Linux,
    where a fork is safe, a second process solves problems 1 and 2.

    Parameters
    ----------
    truth : Truth, to report errors, never to estimate; or None.
    problems : keys of `solve.PROBLEMS`; those for which there are sensors are solved.
    csv : bool; True writes each .mat file also as CSV, and trajectories and truth as TUM files.

    Returns
    -------
    The summary, the dict that is written to summary.json. A problem that could not be solved has
    the entry "failed", a sentence. The list "doubts", of "what" and "sentence", has those about the
    drive first, then by problem. "notes" lists what was mended or left out while the files were
    read.
    """
    with swap.staging(out) as stage:
        summary = _solved(dataset, truth, problems,
                          lambda solution: solve.write_solution(stage, solution, csv))
        text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        swap.write_atomically(stage / solve.SUMMARY, text.encode())
        if csv and truth is not None:
            write_tum(stage / "truth.tum", truth.poses)
        swap.publish({out: stage}, ours=solve.RESULT_NAMES)
    return summary


def _solved(dataset, truth, problems, write):
    """The summary of problems, each of which is solved; `write` takes each Solution."""
    arguments = dataset, truth, problems, write
    if sys.platform == "linux":
        receiver, sender = Pipe(duplex=False)
        child = get_context("fork").Process(target=_send_rows, args=(sender, *arguments))
        child.start()
        sender.close()
    try:
        late = _rows(*arguments, False)
        early = receiver.recv() if sys.platform == "linux" else _rows(*arguments, True)
    except EOFError:                            # the child was killed, or failed: here it is told
        early = _rows(*arguments, True)
    finally:
        if sys.platform == "linux":
            child.kill()
            child.join()
            receiver.close()
    return {"dataset": dataset.name, "poses": len(dataset.ticks), "kernel": dataset.vehicle.kernel,
            "doubts": [asdict(doubt) for doubt in merged([*early[1], *late[1]])],
            "notes": list(all_notes(dataset, truth)), "problems": early[0] | late[0]}


def _rows(dataset, truth, problems, write, independent):
    """Rows of the summary of problems, those INDEPENDENT or all others, and list of the doubts.

    With the former come the doubts before solving.
    """
    doubts = doubts_before_solving(dataset, truth) if independent else []
    rows, start = {}, time.perf_counter()
    problems = [problem for problem in problems if (problem in INDEPENDENT) == independent]
    for solution in solve.solutions(dataset, problems=problems):
        failed = isinstance(solution, solve.Failure)
        row = {"failed": solution.reason} if failed else summarize(solution, truth)
        rows[solution.problem] = {
            "title": solution.title, **row, "seconds": time.perf_counter() - start}
        if not failed:
            doubts += solution.doubts
            write(solution)
        start = time.perf_counter()
    return rows, doubts


def _send_rows(sender, *arguments):
    """Send the rows of problems INDEPENDENT from a process that Ctrl-C does not end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with sender, suppress(BaseException):
        sender.send(_rows(*arguments, True))


def summary_table(summary):
    """The summary as a table (str), one line for each problem, with the doubts below it.

    It has a column for the ATE if there is truth.
    """
    judged = any("ate_m" in row for row in summary["problems"].values())
    lines = [f"{summary['dataset']}: {summary['poses']} poses",
             f"{'problem':15}{'estimates':>10}{'last x, y, heading':>29}"
             f"{'their sigmas':>28}" + judged * f"{'ATE':>11}"]
    for name, row in summary["problems"].items():
        if "failed" in row:
            lines.append(f"{name:15}could not be solved")
            continue
        pose = "{:8.3f} m {:8.3f} m {:7.4f}".format(*row["last_pose"])
        sigma = "{:7.4f} m {:7.4f} m {:6.4f}".format(*row["last_sigma"])
        error = f"{row['ate_m']:9.4f} m" if judged else ""
        lines.append(f"{name:15}{row['estimated_poses']:10}{pose:>29} {sigma:>27}{error}")
        if once := ", ".join(map(str, row.get("unconfirmed", ()))):
            lines.append(
                f"{'':15}nothing confirms markers {once}: seen once, or where another one is")
    lines += [f"doubt ({doubt['what']}): {doubt['sentence']}" for doubt in summary["doubts"]]
    return "\n".join(lines)


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
        true_poses = solve.truth_in_world(solution, truth)
        summary["ate_m"] = evaluation.ate(solution.poses, true_poses)
        summary["ate_aligned_m"] = evaluation.ate(solution.poses, true_poses, aligned=True)
    return summary
