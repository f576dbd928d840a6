"""All problems of a dataset solved into a folder, with a summary of plain numbers."""

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
from slamlib.dataset import read_dataset, read_truth
from slamlib.inventory import all_notes
from slamlib.solve import (
    OURS,
    PROBLEMS,
    SUMMARY,
    Failure,
    doubts_about_drive,
    merged,
    solutions,
    truth_in_world,
    write,
)

PR_SET_PDEATHSIG = 1                                           # Linux, prctl(2)
BESIDES = ("problem1", "problem2", "problem2_hint", "problem2_fused")  # none depends on others


def solve_to_folder(dataset, truth, out, jobs=1):
    """The summary of all problems of a Dataset, written with their files below the folder `out`.

    The Truth, or None, serves to report errors, never to estimate. The summary is the dict that is
    written to summary.json; a problem that could not be solved has the entry "failed", a sentence.
    Its list "doubts", of "what" and "sentence", is empty where the measurements agree with the
    files: first those about the drive, then by problem. Its list "notes" says what was mended or
    left out while the files were read. Once all files are written they replace those of an earlier
    run, by `swap.publish`.
    With two `jobs`, a second process solves problems 1 and 2 meanwhile.
    """
    out = Path(out)
    with swap.staging(out) as stage:
        summary = _summary(dataset, truth, stage, jobs)
        text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        swap.write_atomically(stage / SUMMARY, text.encode())
        swap.require_staged(stage)
        swap.publish([swap.FileSet(out, {name: stage / name for name in swap.file_names(stage)},
                               last=SUMMARY, ours=OURS)])
    return summary


def _summary(dataset, truth, stage, jobs):
    """The summary; each problem's files are written to an empty folder as it ends, or none."""
    (rows, doubts), of_drive = _written_by_all(dataset, truth, stage, jobs)
    in_order = [problem for problem in PROBLEMS if problem in rows]
    return {"dataset": dataset.name, "poses": len(dataset.ticks),
            "doubts": [asdict(doubt) for doubt in merged(
                [*of_drive, *chain(*(doubts[problem] for problem in in_order))])],
            "notes": list(all_notes(dataset, truth)),
            "problems": {problem: rows[problem] for problem in in_order}}


@contextmanager
def tables(folders, tell):
    """Let another process solve the datasets in `folders` (list of Path) while a block runs.

    The function `tell` of a str is called in a thread with each dataset's `table` as it comes, the
    shortest drive's first, and nothing is written. The block is given a function that waits for the
    tables at most a number of seconds; at its end the process is gone.
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
    if sys.platform == "linux":
        _ends_with(parent)
    drives = [(read_dataset(folder), read_truth(folder)) for folder in folders]
    for dataset, truth in sorted(drives, key=lambda drive: len(drive[0].ticks)):
        try:
            text = table(_summary(dataset, truth, None, 1))
        except Exception as error:          # the notebooks tell more, where they fail as well
            text = f"{dataset.name}: not solved before the notebooks: {error!r}"
        sender.send(text)


def _tell_all(receiver, tell):
    with receiver:
        while True:
            try:
                tell(receiver.recv())
            except EOFError:                # the process has ended
                return


def table(summary):
    """The summary as a table (str), one line for each problem, and below it the doubts.

    It has a column for the ATE where there is truth.
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
    """What `_written` returns, of all problems, and doubts about the drive.

    With two `jobs` there are two processes. The second one is a fork: only Linux makes those
    safely. It ends with this one, so that nothing is written once this process is gone.
    """
    if jobs < 2 or sys.platform != "linux" or len(os.sched_getaffinity(0)) < 2:
        return _written(dataset, truth, stage, PROBLEMS), doubts_about_drive(dataset, truth)
    first = [problem for problem in PROBLEMS if problem not in BESIDES]
    others = set(active_children())
    with ProcessPoolExecutor(1, mp_context=get_context("fork"), initializer=_ends_with,
                             initargs=(os.getpid(),)) as pool:
        try:
            besides = pool.submit(_besides, dataset, truth, stage)
            rows, doubts = _written(dataset, truth, stage, first)
            try:
                (others_rows, others_doubts), of_drive = besides.result()
            except BrokenProcessPool:                   # killed, as where memory is short
                (others_rows, others_doubts), of_drive = _besides(dataset, truth, stage)
            return (rows | others_rows, doubts | others_doubts), of_drive
        except BaseException:                           # no one waits for what it finds
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


def _besides(dataset, truth, stage):
    """What the second process does."""
    return _written(dataset, truth, stage, BESIDES), doubts_about_drive(dataset, truth)


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
            write(stage, solution)
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
