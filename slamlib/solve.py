"""The assignment's problems: which of them a dataset allows, their solutions and files.

`find` runs the solver of a problem, and `write_results` writes what it found, with a summary of
plain numbers. `solve_to_folder` does so for all problems of a dataset, `solve_folders` for many
datasets.
"""

import multiprocessing
import signal
import sys
import threading
import time
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from os.path import abspath
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slamlib import estimate, fuse, fuse_increments, localize
from slamlib.core import evaluation, odometry, se2
from slamlib.core.errors import UNSOLVABLE, DatasetError, require
from slamlib.core.records import NO_RANGES, NO_SIGHTINGS, Dataset, Truth
from slamlib.io import files, results
from slamlib.io.dataset import read_dataset, read_truth, write_vehicle
from slamlib.io.formats import ENCODER
from slamlib.robust.file_doubts import Doubt, doubts_before_solving, merged
from slamlib.robust.result import SlamResult
from slamlib.robust.solution_doubts import (
    contradiction_doubts,
    fusion_doubts,
    solution_doubts,
)


class Task(NamedTuple):
    """What a problem is called, and what it needs."""

    title: str
    sensor: str                  # attribute of Dataset
    role: str                    # in figures (`notebook.plotting.ROLES`)


# Every problem in the order of solution, by the name of its results folder.
PROBLEMS = {
    "problem1": Task("odometry", "ticks", "odometry"),
    "problem2": Task("ArUco", "aruco", "aruco"),
    "problem2_hint": Task("odometry + ArUco, hint", "aruco", "hint"),
    "problem2_fused": Task("odometry + ArUco", "aruco", "fused"),
    "problem3": Task("SLAM: odometry + ArUco", "aruco", "slam"),
    "problem4": Task("SLAM with UWB ranges", "uwb", "slam_uwb"),
}
SENSORS = {"aruco": "markers", "uwb": "UWB ranges to antennas with a guess"}
VEHICLE_ESTIMATED = "vehicle.toml"                  # in the results: what the drive says of it
NOISE = {"slip": "slip_sqrt_m", "marker_noise_factor": "marker_noise_factor",
         "range_noise_factor": "range_noise_factor"}    # entries of vehicle.toml, keys of facts
# Columns of the table over all drives.
COLUMNS = ["dataset", "problem", "estimated_poses", "ate_m", "ate_aligned_m", "nees",
           "last_sigma_m", "slip_sqrt_m", "doubts", "seconds", "failed"]


@dataclass(frozen=True)
class Solution:
    """Poses, maps and facts of one problem; it has every pose of the encoder file.

    The world frame is that of the first pose with an estimate.
    """

    problem: str                   # key of PROBLEMS
    poses: np.ndarray              # (n, 3) in the world frame; NaN where there is no estimate
    covariances: np.ndarray        # (n, 3, 3) of [x, y, heading] in world axes
    maps: dict = field(default_factory=dict)    # ids, places and covariances by name of the file
    facts: dict = field(default_factory=dict)       # plain numbers for the summary
    doubts: tuple[Doubt, ...] = ()


@dataclass(frozen=True)
class Failure:
    """A problem that could not be solved."""

    problem: str
    reason: str                    # a sentence


def allows(dataset: Dataset, problem: str) -> bool:
    """True if the dataset has the sensor that a problem needs."""
    return getattr(dataset, PROBLEMS[problem].sensor) is not None


def find(problem: str, dataset: Dataset, previous: SlamResult | None = None):
    """A solver's result: (poses, covariances), Localization, Fusion or SlamResult.

    Problem 4 starts from `previous`, problem 3's. Raises UNSOLVABLE where the measurements
    determine no solution.
    """
    solvers = {
        "problem1": lambda: odometry.equation2(dataset.ticks, dataset.vehicle),
        "problem2": lambda: localize(dataset.sightings),
        "problem2_hint": lambda: fuse_increments(dataset),
        "problem2_fused": lambda: fuse(dataset),
        "problem3": lambda: estimate(dataset.without("uwb")),
        "problem4": lambda: estimate(dataset, previous=previous)}
    return solvers[problem]()


def problem_solution(problem: str, dataset: Dataset, found) -> Solution:
    """The Solution of a problem, from what `find` returned for it.

    Problem 1 is odometry, equation 1 with the covariance of equation 2. Problem 2 is incremental
    localization: "problem2" from the markers alone, "problem2_hint" fused as the assignment
    suggests, "problem2_fused" fused with all shared errors. Problem 3 is SLAM with odometry and
    markers, problem 4 with ranges, too. Raises UNSOLVABLE, also where a covariance is lost by
    rounding.
    """
    if problem == "problem1":
        found = Solution(problem, *found)
    if problem == "problem2":
        found = _at_all_poses(found, len(dataset.ticks))
    maps = {}
    if len(getattr(found, "marker", ())):
        maps["ArucoMap"] = found.marker, found.marker_in_world, found.marker_covariance
    if len(getattr(found, "antenna", ())):
        maps["UwbMap"] = found.antenna, found.antenna_in_world, found.antenna_covariance
    is_known = np.isfinite(found.poses[:, 0])
    covariances = [found.covariances[is_known]]
    covariances += [each for _, _, each in maps.values()]
    if isinstance(found, SlamResult):
        covariances.append(found.c_covariance)
    for each in covariances:
        variances = np.diagonal(each, axis1=-2, axis2=-1)
        if not np.all((variances >= 0) & (variances < np.inf)):
            raise np.linalg.LinAlgError("a variance is negative or not finite")
    doubts = ()
    if problem == "problem2_fused":
        doubts = fusion_doubts(found, dataset.vehicle)
    if isinstance(found, SlamResult):
        doubts = solution_doubts(found)
    return Solution(problem, found.poses, found.covariances, maps, _facts(found), doubts)


def _at_all_poses(found, count):
    """The Localization with `count` poses, NaN where it has no frame."""
    poses = np.full((count, 3), np.nan)
    covariances = np.full((count, 3, 3), np.nan)
    poses[found.frame] = found.poses
    covariances[found.frame] = found.covariances
    known = np.isfinite(poses[:, 0])
    poses[known, 2] = np.unwrap(poses[known, 2])
    return replace(found, poses=poses, covariances=covariances)


def _facts(found):
    """Slip, noise, calibration and doubtful landmarks of a result."""
    facts = {}
    if getattr(found, "slip", None) is not None:
        facts["slip_sqrt_m"] = found.slip
    if isinstance(found, SlamResult):
        facts["unconfirmed"] = found.unconfirmed.tolist()
        facts["calibration"] = [row for row in found.calibration_table if row["sigma"]]
        if len(found.rejected):
            facts["marker_noise_factor"] = found.noise.sightings
        if len(found.antenna):
            facts["range_noise_factor"] = found.noise.ranges
    return facts


def _failure(problem, dataset, error):
    """The Failure of a problem by an `error` of UNSOLVABLE."""
    reason = str(error).removeprefix(f"{dataset.name}: ")
    if isinstance(error, np.linalg.LinAlgError):
        reason = ("expected lengths and standard deviations that float64 can hold together; "
                  f"some are so far from the others that matrices lose their digits ({reason})")
    return Failure(problem, reason)


def solutions(dataset: Dataset, problems: Collection[str] = PROBLEMS) -> list[Solution | Failure]:
    """The Solution of each of `problems` that the dataset's sensors allow, in their order.

    A problem that cannot be solved has a Failure. Facts include the seconds that it took.
    """
    listed = [problem for problem in PROBLEMS if problem in problems and allows(dataset, problem)]
    slam = [problem for problem in listed if problem in ("problem3", "problem4")]
    others = [problem for problem in listed if problem not in slam]
    if not slam or not others:
        return _in_turn(dataset, listed)
    wait_for_others = _meanwhile(_in_turn, dataset, others)
    found = _in_turn(dataset, slam)
    return wait_for_others() + found


def _in_turn(dataset, problems):
    """The Solution or Failure of each of the `problems`."""
    found = None
    every = []
    for problem in problems:
        start = time.perf_counter()
        try:
            found = find(problem, dataset, previous=found)
            solution = problem_solution(problem, dataset, found)
            solution.facts["seconds"] = time.perf_counter() - start
        except UNSOLVABLE as error:
            solution = _failure(problem, dataset, error)
        every.append(solution)
    return every


def _meanwhile(function, *arguments):
    """A function that waits for function(*arguments), which another process computes meanwhile.

    That process is a copy of this one. Where no copy is safe, or it ended without a result, the
    function is called when it is waited for.
    """
    if sys.platform != "linux" or threading.active_count() > 1:
        return partial(function, *arguments)
    processes = multiprocessing.get_context("fork")
    receiver, sender = processes.Pipe(duplex=False)

    def compute():
        receiver.close()                         # so that it ends if nobody receives any more
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        sender.send(function(*arguments))

    def wait():
        try:
            return receiver.recv()
        except EOFError:
            return function(*arguments)

    processes.Process(target=compute, daemon=True).start()
    sender.close()
    return wait


def write_results(out: Path | str, problem: str, found, dataset: Dataset,
                  truth: Truth | None = None) -> Solution | Failure:
    """Write what a solver found of one problem to the results folder `out` of a drive.

    The .mat files come first, summary.json last: a folder without it is unfinished. What it lists
    of other problems stays; files of problems that it does not list are removed.

    Parameters
    ----------
    problem : key of `PROBLEMS`.
    found : what `find` returns for the problem, or the exception, of UNSOLVABLE, that it raised.
    truth : Truth, to report errors, or None.

    Returns
    -------
    The Solution that is written, whose `doubts` say what contradicts the files, or the Failure by
    an exception. Raises UNSOLVABLE if a covariance is lost by rounding, and DatasetError if `out`
    is the folder of a dataset.

    >>> from slamlib.studies.simulation import simulate
    >>> dataset, truth = simulate("short", seed=1)
    >>> found = odometry.equation2(dataset.ticks, dataset.vehicle)
    >>> write_results("results/short", "problem1", found, dataset, truth).problem
    'problem1'
    >>> results.read_summary("results/short")["problems"]["problem1"]["estimated_poses"]
    2000
    """
    out = Path(out)
    require(not (out / ENCODER).exists(), out,
            "another folder for the results: this one is a dataset's")
    if isinstance(found, Exception):
        solution = _failure(problem, dataset, found)
    else:
        solution = problem_solution(problem, dataset, found)
    with files.locked(out):
        others = {}
        with suppress(DatasetError):
            others = results.read_summary(out)["problems"]
        others.pop(problem, None)
        _write(out, dataset, truth, [solution], others)
    return solution


def solve_to_folder(dataset: Dataset, truth: Truth | None, out: Path,
                    problems: Collection[str] = PROBLEMS) -> dict:
    """Solve `problems` of a Dataset, then write their files to the folder `out`.

    Files of an earlier run are replaced, or removed if they belong to other problems; all other
    files in the folder stay. Raises DatasetError, before anything is solved, if nothing can be
    written there. `truth` serves to report errors.

    Returns
    -------
    The summary, the dict that is written to summary.json. A problem that could not be solved has
    the entry "failed", a sentence. The list "doubts", of "what", "sentence" and "advice", has those
    about the drive first, then by problem. "notes" lists what was mended or left out while the
    files were read.
    """
    with files.locked(out):
        return _write(out, dataset, truth, solutions(dataset, problems), {})


def _write(out, dataset, truth, found, others):
    """Write Solutions to a folder; return its summary, with the rows of `others`, too."""
    rows = others | {each.problem: summarize(each, truth) for each in found}
    (out / results.SUMMARY).unlink(missing_ok=True)
    written = [file for problem in others for file in (out / problem).glob("*.mat")]
    for each in found:
        if isinstance(each, Solution):
            written += results.write_solution(out, each)
    return finish_results(out, written, dataset, truth, rows)


def finish_results(out: Path, written: Collection[Path], dataset: Dataset, truth: Truth | None,
                   rows: dict) -> dict:
    """Finish a results folder whose summary is gone; returns the new one.

    Result files of earlier runs that are not among the `written` ones are removed; all other files
    stay. The summary, by the rows (dict) of its problems and the doubts about the files, is written
    last. It also doubts a fusion of problem 2 that contradicts problem 3 where both are there.
    """
    for file in out.glob("problem*/*.mat"):
        if file.name in results.RESULT_FILES and file not in written:
            file.unlink()
    problems = {problem: rows[problem] for problem in PROBLEMS if problem in rows}
    doubts = doubts_before_solving(dataset)
    with suppress(OSError):
        _, poses, covariances = results.read_structs(out / "problem2_fused", "vehiclePose")
        by_slam = results.read_structs(out / "problem3", "vehiclePose")[1]
        doubts += contradiction_doubts(poses, covariances, by_slam)
    for row in problems.values():
        doubts += [Doubt(**doubt) for doubt in row["doubts"]]
    _write_estimated_vehicle(out / VEHICLE_ESTIMATED, dataset.vehicle, problems)
    summary = {"dataset": dataset.name, "poses": len(dataset.ticks),
               "doubts": [asdict(doubt) for doubt in merged(doubts)],
               "notes": dataset.notes + getattr(truth, "notes", ()), "problems": problems}
    results.write_summary(out, summary)
    return summary


def summarize(solved: Solution | Failure, truth: Truth | None) -> dict:
    """The row of a problem in the summary: plain numbers, of errors where there is truth."""
    title = PROBLEMS[solved.problem].title
    if isinstance(solved, Failure):
        return {"title": title, "doubts": [], "failed": solved.reason}
    known = np.flatnonzero(np.isfinite(solved.poses[:, 0]))
    world = int(known[0])
    covariances = solved.covariances[known]
    position_sigmas = evaluation.position_sigmas(covariances)
    row = {"title": title, "doubts": [asdict(doubt) for doubt in solved.doubts],
           "estimated_poses": len(known), "world_is_pose": world + 1,
           "last_sigma_m": position_sigmas[-1], "median_sigma_m": np.median(position_sigmas),
           "median_sigma_heading_rad": np.median(se2.sigmas(covariances)[:, 2])}
    row |= solved.facts
    if truth is not None:
        true = se2.between(truth.poses[world], truth.poses)
        row["ate_m"] = evaluation.ate(solved.poses, true)
        row["ate_aligned_m"] = evaluation.ate(solved.poses, true, aligned=True)
        nees = evaluation.anees(solved.poses, solved.covariances, true)
        if np.isfinite(nees):                           # not where every pose is known
            row["nees"] = nees
    return row


def _write_estimated_vehicle(path, vehicle, rows):
    """Write what a drive says of its Vehicle as a vehicle.toml, if that is not what is stated.

    It has what is stated, the calibration that was released from it and the noise that was
    learned, of the last problem in the `rows` of a summary that estimates them.
    """
    learned = {}
    for row in rows.values():
        if "calibration" in row:
            learned = row
    estimated = {}
    for entry in learned.get("calibration", ()):
        name = entry["name"]
        if entry["released"] and hasattr(vehicle, name):
            estimated[name] = entry["estimate"]
            estimated[f"sigma_{name}"] = entry["sigma"]
    for name, fact in NOISE.items():
        if fact in learned and getattr(vehicle, name) is None:
            estimated[name] = learned[fact]
    path.unlink(missing_ok=True)
    if estimated:
        rounded = {name: float(f"{value:.7g}") for name, value in estimated.items()}
        write_vehicle(path, replace(vehicle, **rounded))


def inventory_lines(dataset: Dataset, truth: Truth | None) -> list[str]:
    """Lines on what was read of a Dataset and its Truth, what is left out, and each note."""
    sightings = (dataset.aruco or NO_SIGHTINGS).pose
    ranges = (dataset.uwb or NO_RANGES).pose
    truth_is = "unknown" if truth is None else "known"
    lines = [f"{len(dataset.ticks)} poses, {len(sightings)} sightings, {len(ranges)} ranges, "
             f"truth {truth_is}"]
    for sensor, name in SENSORS.items():
        if getattr(dataset, sensor) is None:
            without = [problem for problem, task in PROBLEMS.items() if task.sensor == sensor]
            lines.append(f"left out, no {name}: {', '.join(without)}")
    notes = dataset.notes + getattr(truth, "notes", ())
    lines += [f"note: {note}" for note in notes]
    return [f"{dataset.name}: {line}" for line in lines]


def solve_folder(folder: Path | str, out: Path | str, problems: Collection[str] = ()) -> dict:
    """Read the dataset in a folder, solve it into the folder `out`; returns the summary.

    What was read is printed to stderr. `problems` are keys of `PROBLEMS`, or none for all that the
    sensors allow. Raises DatasetError if the dataset is malformed or does not allow a problem; then
    there is no summary, as an earlier one may be of other data.
    """
    folder = Path(folder)
    out = Path(out)
    is_inside = out.resolve().is_relative_to(folder.resolve())
    if not is_inside:
        with suppress(OSError):
            (out / results.SUMMARY).unlink()
    dataset = read_dataset(folder)
    require(not is_inside, out, "another folder for the results: this one is in the dataset's")
    truth = read_truth(folder)
    print("\n".join(inventory_lines(dataset, truth)), file=sys.stderr)
    for problem in problems:
        require(allows(dataset, problem), folder,
                f"the measurements of {problem} ({PROBLEMS[problem].title})")
    return solve_to_folder(dataset, truth, out, problems or PROBLEMS)


def solve_folders(folders: Sequence[Path | str], out: Path | str, jobs: int | None = None,
                  problems: Collection[str] = ()) -> list[dict]:
    """Solve each of several datasets into out/<name>, and write the table out/drives.csv.

    One that cannot be read or written does not stop the others: its summary has the entry "error",
    a sentence, and no problems. Files among the folders, as data/* names them, are left out.

    Parameters
    ----------
    jobs : datasets at a time, in as many processes; None for what joblib's `parallel_config` says,
        by default 1.
    problems : as of `solve_folder`.

    Returns
    -------
    The summaries of the datasets, in their order.
    """
    from joblib import Parallel, delayed

    out = Path(out)
    folders = [folder for folder in map(Path, folders) if not folder.is_file()]
    by_name = {Path(abspath(folder)).name: folder for folder in folders}
    require(len(by_name) == len(folders), out,
            "datasets in folders of different names, as which their results are written")

    def solve(name, folder):
        try:
            return solve_folder(folder, out / name, problems)
        except (DatasetError, OSError) as error:
            return {"dataset": name, "error": str(error), "doubts": [], "problems": {}}

    summaries = Parallel(n_jobs=jobs)(
        delayed(solve)(name, folder) for name, folder in by_name.items())
    table = drives_table(summaries).to_csv(index=False, lineterminator="\n")
    files.write_file(out / "drives.csv", table.encode())
    return summaries


def drives_table(summaries: Sequence[dict]):
    """The pandas.DataFrame of COLUMNS over all drives, a row for each problem; NaN is not known.

    A problem or a drive that failed has a sentence.
    """
    import pandas as pd  # here, because it takes long to import

    rows = []
    for summary in summaries:
        drive = {"dataset": summary["dataset"], "failed": summary.get("error")}
        for problem, row in summary["problems"].items():
            rows.append(drive | row | {"problem": problem, "doubts": len(row["doubts"])})
        if not summary["problems"]:
            rows.append(drive)
    return pd.DataFrame(rows, columns=COLUMNS, dtype=object)
