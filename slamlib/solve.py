"""The assignment's problems: which of them a dataset allows, their solutions and files.

`find` runs the solver of a problem; `problem_solution` makes a Solution of its result, with what
the files and figures of every problem need; `solve_to_folder` solves all problems and writes their
files, with a summary of plain numbers.
"""

import json
import logging
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import Pipe, get_context
from pathlib import Path
from threading import Timer
from typing import NamedTuple

import numpy as np

from slamlib import estimate, fuse, fuse_increments, localize
from slamlib.core import evaluation, odometry, se2
from slamlib.core.errors import DatasetError
from slamlib.core.records import Dataset, Truth
from slamlib.io import results, swap
from slamlib.io.dataset import all_notes
from slamlib.robust.file_doubts import Doubt, doubts_before_solving, merged
from slamlib.robust.solution_doubts import solution_doubts

log = logging.getLogger(__name__)
log_if_slow = log.getChild("slow")                  # what the command line always prints

SLOW = 2.0                                          # s, after which a problem is told to be slow
UNSOLVABLE = (DatasetError, np.linalg.LinAlgError)  # what `find` raises where there is no solution


class Task(NamedTuple):
    """What a problem is called, and what it needs."""

    title: str
    sensors: tuple[str, ...]     # attributes of Dataset
    role: str                    # in figures (`notebook.plotting.ROLES`)


# Every problem in the order of solution, by the name of its results folder.
PROBLEMS = {
    "problem1": Task("odometry", (), "odometry"),
    "problem2": Task("ArUco", ("aruco",), "aruco"),
    "problem2_hint": Task("odometry + ArUco, hint", ("aruco",), "hint"),
    "problem2_fused": Task("odometry + ArUco", ("aruco",), "fused"),
    "problem3": Task("SLAM: odometry + ArUco", ("aruco",), "slam"),
    "problem4": Task("SLAM: odometry + ArUco + UWB", ("uwb",), "slam_uwb"),
}
INDEPENDENT = ("problem1", "problem2", "problem2_hint", "problem2_fused")  # no other needs them
SENSORS = {"aruco": "markers", "uwb": "UWB ranges"}
RESULT_NAMES = frozenset([  # relative paths of all files that a drive's results may have
    results.SUMMARY, *(f"{problem}/{file}" for problem in PROBLEMS
                       for file in results.RESULT_FILES)])


def title(problem: str, dataset: Dataset) -> str:
    """Title of a problem for a Dataset; that of problem 4 tells whether markers take part."""
    name = PROBLEMS[problem].title
    if dataset.aruco is None:
        return name.replace(" + ArUco + UWB", " + UWB")
    return name


@dataclass(frozen=True)
class Solution:
    """Poses, maps and facts of one problem; it has every pose of the encoder file."""

    problem: str                   # folder of the results
    title: str
    poses: np.ndarray              # (n, 3) in the world frame; NaN where there is no estimate
    covariances: np.ndarray        # (n, 3, 3) of [x, y, heading] in world axes
    world: int = 0                 # index from 0 of the pose whose frame is the world frame
    aruco_map: tuple | None = None         # marker ids (k,), poses (k, 3), covariances (k, 3, 3)
    uwb_map: tuple | None = None           # antenna ids (a,), positions (a, 2), cov. (a, 2, 2)
    facts: dict = field(default_factory=dict)       # plain numbers for the summary
    doubts: tuple[Doubt, ...] = ()


@dataclass(frozen=True)
class Failure:
    """A problem that could not be solved."""

    problem: str
    title: str
    reason: str                    # a sentence


def allows(dataset: Dataset, problem: str) -> bool:
    """True if the dataset has the sensors that a problem needs."""
    return all(getattr(dataset, sensor) is not None for sensor in PROBLEMS[problem].sensors)


def failure(problem: str, dataset: Dataset, error: Exception) -> Failure:
    """The Failure by an exception of UNSOLVABLE; its reason does not name the dataset."""
    reason = str(error).removeprefix(f"{dataset.name}: ")
    if isinstance(error, np.linalg.LinAlgError):
        reason = ("expected lengths and standard deviations that float64 can hold together; some "
                  f"are so far from the others that matrices lose their digits ({reason})")
    return Failure(problem, title(problem, dataset), reason)


def find(problem: str, dataset: Dataset, found: dict | None = None):
    """The result of a problem's solver: (poses, covariances), Localization, Fusion or SlamResult.

    `found` are such results of other problems (dict by problem): problem 4 starts from problem 3
    where there is one. Raises UNSOLVABLE where the measurements determine no solution.
    """
    before = (found or {}).get("problem3")
    solvers = {
        "problem1": lambda: odometry.equation2(dataset.ticks, dataset.vehicle),
        "problem2": lambda: localize(dataset.sightings),
        "problem2_hint": lambda: fuse_increments(dataset),
        "problem2_fused": lambda: fuse(dataset),
        "problem3": lambda: estimate(dataset.without("uwb")),
        "problem4": lambda: estimate(dataset, previous=before)}
    return solvers[problem]()


def problem_solution(problem: str, dataset: Dataset, found=None) -> Solution:
    """The Solution of a problem, from what `find` returned for it or, with None, solved here.

    Problem 1 is odometry, equation 1 with the covariance of equation 2. Problem 2 is incremental
    localization: "problem2" from the markers alone, "problem2_hint" fused as the assignment
    suggests, "problem2_fused" fused with all shared errors. Problem 3 is SLAM with odometry and
    markers, problem 4 with ranges, too. Raises UNSOLVABLE, also where a covariance is lost by
    rounding.
    """
    if found is None:
        found = find(problem, dataset)
    if isinstance(found, tuple):
        poses, covariances = found
    else:
        poses = found.poses
        covariances = found.covariances
    _require_variances(found, covariances[np.isfinite(poses[:, 0])])
    fields = {"poses": poses, "covariances": covariances}
    if problem == "problem2":
        fields = _localization_fields(dataset, found)
    elif problem == "problem2_fused":
        fields["facts"] = _noise_facts(found)
    elif problem in ("problem3", "problem4"):
        fields["facts"] = _slam_facts(dataset, found)
        fields["doubts"] = (*_option_doubts(problem, dataset, found), *solution_doubts(found))
        if dataset.aruco is not None:
            fields["aruco_map"] = found.marker, found.marker_in_world, found.marker_covariance
        if problem == "problem4":
            fields["uwb_map"] = found.antenna, found.antenna_in_world, found.antenna_covariance
    return Solution(problem=problem, title=title(problem, dataset), **fields)


def _require_variances(found, covariances):
    """Raise LinAlgError if a variance of poses (m, 3, 3), map or wheels was lost by rounding."""
    others = [getattr(found, f"{kind}_covariance", None) for kind in ("marker", "antenna", "wheel")]
    variances = np.concatenate([np.diagonal(block, axis1=-2, axis2=-1).ravel()
                                for block in (covariances, *others) if block is not None])
    is_valid = (variances >= 0) & (variances < np.inf)
    fit = getattr(found, "fit", None)
    is_lost = fit is not None and not np.isfinite(fit.log_evidence)
    if is_lost or not is_valid.all():
        raise np.linalg.LinAlgError("a variance is negative or not finite")


def _localization_fields(dataset, found):
    """Fields of problem 2's Solution by a Localization; the first localized pose is the world."""
    poses = np.full((len(dataset.ticks), 3), np.nan)
    covariances = np.full((len(dataset.ticks), 3, 3), np.nan)
    covariances[found.frame] = found.covariances
    poses[found.frame] = found.poses
    known = found.frame[np.isfinite(found.poses[:, 0])]
    poses[known, 2] = np.unwrap(poses[known, 2])
    facts = {"sightings": len(dataset.aruco.pose), "outliers": int(found.rejected.sum()),
             "unused_sightings": int(found.unused.sum())}
    return {"poses": poses, "covariances": covariances, "world": int(known[0]), "facts": facts,
            "aruco_map": (found.marker, found.marker_in_world, found.marker_covariance)}


def _option_doubts(problem, dataset, found):
    """A Doubt if a SlamResult has options that the Vehicle of its Dataset does not state."""
    stated = vars(dataset.vehicle)
    used = vars(found.fit.problem.measurements.dataset.vehicle)
    said = [f"{key} = {value}" for key, value in used.items() if value != stated[key]]
    if said:
        yield Doubt("options", f"The files of {problem} are solved with {', '.join(said)}, unlike "
                    "other chapters and `slamlib solve`: state it in vehicle.toml, which all heed.")


def _noise_facts(found):
    """Slip, wheel parameters and number of rejected sightings of a Fusion or SlamResult."""
    return {"slip_sqrt_m": found.slip, "outliers": int(np.sum(found.rejected)),
            "wheel_parameters_m": found.wheel.tolist(),
            "wheel_parameter_sigmas_m": np.sqrt(np.diag(found.wheel_covariance)).tolist()}


def _slam_facts(dataset, found):
    """Noise, calibration and doubtful landmarks of a SlamResult."""
    facts = _noise_facts(found)
    facts["gtsam"] = _gtsam_facts(found)
    facts["increments"] = found.model
    facts["unconfirmed"] = found.unconfirmed.tolist()
    facts["calibration"] = [row for row in found.calibration_table if row["sigma"]]
    if len(found.rejected):
        facts["marker_noise_factor"] = found.noise.sightings
    if len(found.antenna):
        weak = dataset.uwb.antenna[found.range_weight < 0.5].tolist()
        facts["range_noise_factor"] = found.noise.ranges
        facts["ranges"] = len(dataset.uwb.pose)
        facts["antennas_in_doubt"] = found.doubts
        facts["ranges_down_weighted_by_antenna"] = {
            antenna: weak.count(antenna) for antenna in found.antenna.tolist()}
    return facts


def _gtsam_facts(found):
    """What GTSAM solved, and how far it is from the engine that decided, of a SlamResult."""
    by_gtsam = found.gtsam
    return {"factors": by_gtsam.factors, "variables": by_gtsam.variables,
            "steps": by_gtsam.steps, "start": by_gtsam.start,
            "largest_difference_in_sigmas": found.agreement[0],
            "largest_relative_difference_of_sigmas": found.agreement[1]}


def solutions(dataset: Dataset,
              problems: Sequence[str] = tuple(PROBLEMS)) -> Iterator[Solution | Failure]:
    """Yield the Solution of each of `problems` that the dataset's sensors allow, in order.

    A problem that cannot be solved yields a Failure. Facts include the seconds that it took.
    """
    found = {}
    for problem in problems:
        if not allows(dataset, problem):
            continue
        start = time.perf_counter()
        timer = Timer(SLOW, log_if_slow.info, (
            "%s: %s takes longer than %g s", dataset.name, problem, SLOW))
        timer.start()
        try:
            result = find(problem, dataset, found)
            solution = problem_solution(problem, dataset, result)
        except UNSOLVABLE as error:
            yield failure(problem, dataset, error)
            continue
        finally:
            timer.cancel()
        found[problem] = result
        seconds = time.perf_counter() - start
        log.info("%s: %s solved in %.1f s", dataset.name, problem, seconds)
        yield replace(solution, facts=solution.facts | {"seconds": seconds})


def truth_in_world(solution: Solution, truth: Truth) -> np.ndarray:
    """The true poses (n, 3) in the world frame of a Solution."""
    return se2.between(truth.poses[solution.world], truth.poses)


def solve_to_folder(dataset: Dataset, truth: Truth | None, out: Path,
                    problems: Sequence[str] = tuple(PROBLEMS), csv: bool = False) -> dict:
    """Solve problems of a Dataset and write their files to the folder `out`.

    When all files are written they replace those of an earlier run, by `swap.publish`. On Linux,
    where a fork is safe, a second process solves problems 1 and 2.

    Parameters
    ----------
    truth : Truth, to report errors, never to estimate; or None.
    problems : keys of `PROBLEMS`; those for which there are sensors are solved.
    csv : bool; True writes each .mat file also as CSV, and trajectories and truth as TUM files.

    Returns
    -------
    The summary, the dict that is written to summary.json. A problem that could not be solved has
    the entry "failed", a sentence. The list "doubts", of "what" and "sentence", has those about the
    drive first, then by problem. "notes" lists what was mended or left out while the files were
    read.
    """
    with swap.staging(out) as stage:
        doubts, solved = _in_two_processes(dataset, problems)
        rows = {}
        for solution in solved:
            if isinstance(solution, Failure):
                row = {"failed": solution.reason}
            else:
                row = summarize(solution, truth)
                doubts += solution.doubts
                results.write_solution(stage, solution, csv)
            rows[solution.problem] = {"title": solution.title, **row}
        summary = {"dataset": dataset.name, "poses": len(dataset.ticks),
                   "kernel": dataset.vehicle.kernel, "doubts": [*map(asdict, merged(doubts))],
                   "notes": all_notes(dataset, truth), "problems": rows}
        text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
        swap.write_atomically(stage / results.SUMMARY, text.encode(errors="backslashreplace"))
        if csv and truth is not None:
            results.write_tum(stage / "truth.tum", truth.poses)
        swap.publish({out: stage}, ours=RESULT_NAMES)
    return summary


def _in_two_processes(dataset, problems):
    """What `_independent` returns, and then the solutions of the other problems, in order."""
    receiver, sender = Pipe(duplex=False)
    if sys.platform == "linux":
        second = get_context("fork").Process(
            target=_send, args=(receiver, sender, dataset, problems), daemon=True)
        second.start()
    sender.close()
    others = [problem for problem in problems if problem not in INDEPENDENT]
    late = list(solutions(dataset, others))
    try:
        doubts, early = receiver.recv()
    except (EOFError, OSError):            # no child, or it was killed, or failed: here it is told
        doubts, early = _independent(dataset, problems)
    return doubts, early + late


def _send(receiver, sender, dataset, problems):
    """Send what `_independent` returns from a process that Ctrl-C does not end."""
    receiver.close()                       # so that the pipe breaks when the other one is killed
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with sender, suppress(BaseException):
        sender.send(_independent(dataset, problems))


def _independent(dataset, problems):
    """Doubts before solving, and the list of `solutions` of those `problems` in INDEPENDENT."""
    chosen = [problem for problem in problems if problem in INDEPENDENT]
    return doubts_before_solving(dataset), list(solutions(dataset, chosen))


def summarize(solution: Solution, truth: Truth | None) -> dict:
    """Last estimate with its sigmas and, where there is truth, errors: a dict of plain numbers."""
    known = np.flatnonzero(np.isfinite(solution.poses[:, 0]))
    last = known[-1]
    summary = {"path_length_m": evaluation.path_length(solution.poses),
               "estimated_poses": len(known), "world_is_pose": solution.world + 1,
               "last_pose_number": int(last) + 1, "last_pose": solution.poses[last].tolist(),
               "last_sigma": evaluation.sigmas(solution.covariances[last]).tolist()}
    summary |= solution.facts
    if truth is not None:
        true_poses = truth_in_world(solution, truth)
        summary["ate_m"] = evaluation.ate(solution.poses, true_poses)
        summary["ate_aligned_m"] = evaluation.ate(solution.poses, true_poses, aligned=True)
    return summary
