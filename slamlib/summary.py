"""Solving all problems of a dataset into a folder, with a summary of plain numbers."""

import ctypes
import json
import os
import signal
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict
from itertools import chain
from multiprocessing import active_children, get_context
from pathlib import Path

import numpy as np

from slamlib import evaluation, swap
from slamlib.checks.files import doubts_before_solving, merged
from slamlib.dataset import read_dataset, read_truth
from slamlib.inventory import all_notes
from slamlib.solve import (
    PROBLEMS,
    RESULT_NAMES,
    SUMMARY,
    Failure,
    solutions,
    truth_in_world,
    write_solution,
)

PR_SET_PDEATHSIG = 1                                           # Linux, prctl(2)
# Problems of the second process: no other problem needs their results.
PARALLEL_PROBLEMS = ("problem1", "problem2", "problem2_hint", "problem2_fused")


def solve_to_folder(dataset, truth, out, jobs=1):
    """Solve all problems of a Dataset and write their files below the folder `out`.

    Returns the summary, the dict that is written to summary.json. A problem that could not be
    solved has the entry "failed", a sentence. The list "doubts", of "what" and "sentence", has
    those about the drive first, then by problem. "notes" lists what was mended or left out while
    the files were read. The Truth, or None, serves to report errors, never to estimate. When all
    files are written they replace those of an earlier run, by `swap.publish`. With two `jobs`, a
    second process solves problems 1 and 2.
    """
    out = Path(out)
    with swap.staging(out) as stage:
        summary = _summary(dataset, truth, stage, jobs)
        text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        swap.write_atomically(stage / SUMMARY, text.encode())
        swap.require_staged(stage)
        swap.publish([swap.FileSet(out, {name: stage / name for name in swap.file_names(stage)},
                               last=SUMMARY, ours=RESULT_NAMES)])
    return summary


def _summary(dataset, truth, stage, jobs):
    """The summary; files are written to the empty folder `stage`, or none if it is None."""
    (rows, doubts), about_drive = _written_by_all(dataset, truth, stage, jobs)
    in_order = [problem for problem in PROBLEMS if problem in rows]
    return {"dataset": dataset.name, "poses": len(dataset.ticks),
            "doubts": [asdict(doubt) for doubt in merged(
                [*about_drive, *chain(*(doubts[problem] for problem in in_order))])],
            "notes": list(all_notes(dataset, truth)),
            "problems": {problem: rows[problem] for problem in in_order}}


@contextmanager
def tables(folders, tell):
    """Context in which another process solves the datasets in `folders` (list of Path).

    A thread calls the function `tell` with each dataset's `summary_table` (str), the shortest
    drive's first; nothing is written. The context's value is a function that waits for the tables
    for at most a number of seconds. The process ends with the context.
    """
    context = get_context("fork" if sys.platform == "linux" else "spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send_tables, args=(folders, sender, os.getpid()), daemon=True)
    process.start()
    sender.close()
    listening = threading.Thread(target=_tell_all, args=(receiver, tell), daemon=True)
    listening.start()
    try:
        yield listening.join
    finally:
        process.kill()
        process.join()
        listening.join()


def _send_tables(folders, sender, parent):
    """Send the summary tables of the datasets in `folders`; `parent` is a process id."""
    if sys.platform == "linux":
        _ends_with(parent)
    drives = [(read_dataset(folder), read_truth(folder)) for folder in folders]
    for dataset, truth in sorted(drives, key=lambda drive: len(drive[0].ticks)):
        try:
            text = summary_table(_summary(dataset, truth, None, 1))
        except Exception as error:          # the notebooks report it in full
            text = f"{dataset.name}: not solved before the notebooks: {error!r}"
        sender.send(text)


def _tell_all(receiver, tell):
    """Call `tell` with every object that is received until the other end is closed."""
    with receiver:
        while True:
            try:
                tell(receiver.recv())
            except EOFError:                # the process has ended
                return


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
    lines += [f"doubt ({doubt['what']}): {doubt['sentence']}" for doubt in summary["doubts"]]
    return "\n".join(lines)


def _written_by_all(dataset, truth, stage, jobs):
    """The result of `_written` for all problems, and doubts about the drive.

    With two `jobs` there are two processes. The second one is a fork, which is safe only on Linux.
    It ends with this process, so that nothing is written later.
    """
    if jobs < 2 or sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2:
        return _written(dataset, truth, stage, PROBLEMS), doubts_before_solving(dataset, truth)
    first = [problem for problem in PROBLEMS if problem not in PARALLEL_PROBLEMS]
    others = set(active_children())
    with ProcessPoolExecutor(1, mp_context=get_context("fork"), initializer=_ends_with,
                             initargs=(os.getpid(),)) as pool:
        try:
            second = pool.submit(_solve_in_parallel, dataset, truth, stage)
            rows, doubts = _written(dataset, truth, stage, first)
            try:
                (more_rows, more_doubts), about_drive = second.result()
            except BrokenProcessPool:                   # killed, as where memory is short
                (more_rows, more_doubts), about_drive = _solve_in_parallel(dataset, truth, stage)
            return (rows | more_rows, doubts | more_doubts), about_drive
        except BaseException:                           # nobody needs its results
            for process in set(active_children()) - others:
                process.kill()
            raise


def _ends_with(parent):
    """Let the kernel end this process when `parent` (process id) is gone, however it ended.

    Signals that end both end this process at once: only the parent has something to put in order.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:                          # gone already
        os._exit(1)


def _solve_in_parallel(dataset, truth, stage):
    """The results of the second process: `_written` for its problems, doubts about the drive."""
    return (_written(dataset, truth, stage, PARALLEL_PROBLEMS),
            doubts_before_solving(dataset, truth))


def _written(dataset, truth, stage, problems):
    """Solve some problems and write their files; rows of the summary and doubts, by problem."""
    rows, doubts, start = {}, {}, time.perf_counter()
    for solution in solutions(dataset, problems=problems):
        failed = isinstance(solution, Failure)
        seconds = time.perf_counter() - start
        row = {"failed": solution.reason} if failed else summarize(solution, truth)
        rows[solution.problem] = {"title": solution.title, **row, "seconds": seconds}
        doubts[solution.problem] = () if failed else solution.doubts
        if not failed and stage is not None:
            write_solution(stage, solution)
        start = time.perf_counter()
    return rows, doubts


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
