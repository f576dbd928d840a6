"""The assignment's problems: which of them a dataset allows, their solutions and files.

`find` runs the solver of a problem; `problem_solution` makes a Solution of its result, with what
the files and figures of every problem need; `solve_to_folder` solves all problems and writes their
files, with a summary of plain numbers.
"""

import json
import signal
import sys
import time
from collections import namedtuple
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from multiprocessing import Pipe, get_context

import numpy as np

from slamlib import estimate, fuse, fuse_increments, localize
from slamlib.core import evaluation, odometry, se2
from slamlib.core.errors import DatasetError
from slamlib.io import results, swap
from slamlib.io.dataset import all_notes
from slamlib.robust.file_doubts import Doubt, doubts_before_solving, merged
from slamlib.robust.solution_doubts import solution_doubts

UNSOLVABLE = (DatasetError, np.linalg.LinAlgError)  # what `find` raises where there is no solution

# Every problem in the order of solution, by the name of its results folder: its title, the sensors
# that it needs (attributes of Dataset), and its role in figures (`notebook.plotting.ROLES`).
Task = namedtuple("Task", "title sensors role")
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


def title(problem, dataset):
    """Title of a problem for a Dataset; that of problem 4 tells whether markers take part."""
    name = PROBLEMS[problem].title
    return name if dataset.aruco is not None else name.replace(" + ArUco + UWB", " + UWB")


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


def allows(dataset, problem):
    """True if the dataset has the sensors that a problem needs."""
    return all(getattr(dataset, sensor) is not None for sensor in PROBLEMS[problem].sensors)


def failure(problem, dataset, error):
    """The Failure by an exception of UNSOLVABLE; its reason does not name the dataset."""
    reason = str(error).removeprefix(f"{dataset.name}: ")
    if isinstance(error, np.linalg.LinAlgError):
        reason = ("expected lengths and standard deviations that float64 can hold together; some "
                  f"are so far from the others that matrices lose their digits ({reason})")
    return Failure(problem, title(problem, dataset), reason)


def find(problem, dataset, found=None):
    """The result of a problem's solver: (poses, covariances), Localization, Fusion or SlamResult.

    `found` are such results of other problems (dict by problem): problem 4 starts from problem 3
    where there is one. Raises UNSOLVABLE where the measurements determine no solution.
    """
    solvers = {
        "problem1": lambda: odometry.equation2(dataset.ticks, dataset.vehicle),
        "problem2": lambda: localize(dataset.sightings),
        "problem2_hint": lambda: fuse_increments(dataset),
        "problem2_fused": lambda: fuse(dataset),
        "problem3": lambda: estimate(dataset.without("uwb")),
        "problem4": lambda: estimate(dataset, previous=(found or {}).get("problem3"))}
    return solvers[problem]()


def problem_solution(problem, dataset, found=None):
    """The Solution of a problem, from what `find` returned for it or, with None, solved here.

    Problem 1 is odometry, equation 1 with the covariance of equation 2. Problem 2 is incremental
    localization: "problem2" from the markers alone, "problem2_hint" fused as the assignment
    suggests, "problem2_fused" fused with all shared errors. Problem 3 is SLAM with odometry and
    markers, problem 4 with ranges, too. Raises UNSOLVABLE, also where a covariance is lost by
    rounding.
    """
    found = find(problem, dataset) if found is None else found
    poses, covariances = found if isinstance(found, tuple) else (found.poses, found.covariances)
    others = (getattr(found, f"{kind}_covariance", None) for kind in ("marker", "antenna", "wheel"))
    variances = np.concatenate([
        np.diagonal(C, axis1=-2, axis2=-1).ravel()
        for C in (covariances[np.isfinite(poses[:, 0])], *others) if C is not None])
    if not ((0 <= variances) & (variances < np.inf)).all() \
            or not np.isfinite(getattr(getattr(found, "fit", None), "log_evidence", 0.0)):
        raise np.linalg.LinAlgError("a variance is negative or not finite")
    fields = {"poses": poses, "covariances": covariances}
    if problem == "problem2":
        fields = _localization_fields(dataset, found)
    elif problem == "problem2_fused":
        fields["facts"] = _noise_facts(found)
    elif problem in ("problem3", "problem4"):
        fields |= {"facts": _slam_facts(dataset, found),
                   "doubts": (*_option_doubts(problem, dataset, found), *solution_doubts(found))}
        if dataset.aruco is not None:
            fields["aruco_map"] = found.marker, found.marker_in_world, found.marker_covariance
        if problem == "problem4":
            fields["uwb_map"] = found.antenna, found.antenna_in_world, found.antenna_covariance
    return Solution(problem=problem, title=title(problem, dataset), **fields)


def _localization_fields(dataset, found):
    """Fields of problem 2's Solution by a Localization; the first localized pose is the world."""
    poses = np.full((len(dataset.ticks), 3), np.nan)
    covariances = np.full((len(dataset.ticks), 3, 3), np.nan)
    poses[found.frame], covariances[found.frame] = found.poses, found.covariances
    known = np.isfinite(found.poses[:, 0])
    poses[found.frame[known], 2] = np.unwrap(found.poses[known, 2])
    return {"poses": poses, "covariances": covariances, "world": int(found.frame[known][0]),
            "aruco_map": (found.marker, found.marker_in_world, found.marker_covariance),
            "facts": {"sightings": len(dataset.aruco.pose), "outliers": int(found.rejected.sum()),
                      "unused_sightings": int(found.unused.sum())}}


def _option_doubts(problem, dataset, found):
    """A Doubt if a SlamResult has options that the Vehicle of its Dataset does not state."""
    used = vars(found.fit.problem.measurements.dataset.vehicle)
    said = [f"{key} = {value}" for key, value in used.items()
            if value != getattr(dataset.vehicle, key)]
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
    facts = _noise_facts(found) | {
        "gtsam": _gtsam_facts(found), "increments": found.model,
        "unconfirmed": found.unconfirmed.tolist(),
        "calibration": [row for row in found.calibration_table if row["sigma"]]}
    if len(found.rejected):
        facts["marker_noise_factor"] = found.noise.sightings
    if len(found.antenna):
        weak = dataset.uwb.antenna[found.range_weight < 0.5].tolist()
        facts |= {"range_noise_factor": found.noise.ranges, "ranges": len(dataset.uwb.pose),
                  "antennas_in_doubt": found.doubts, "ranges_down_weighted_by_antenna": {
                      each: weak.count(each) for each in found.antenna.tolist()}}
    return facts


def _gtsam_facts(found):
    """What GTSAM solved, and how far it is from the engine that decided, of a SlamResult."""
    by_gtsam = found.gtsam
    return {"factors": by_gtsam.factors, "variables": by_gtsam.variables,
            "steps": by_gtsam.steps, "start": by_gtsam.start,
            "largest_difference_in_sigmas": found.agreement[0],
            "largest_relative_difference_of_sigmas": found.agreement[1]}


def solutions(dataset, problems=tuple(PROBLEMS)):
    """Yield the Solution of each of `problems` that the dataset's sensors allow, in order.

    A problem that cannot be solved yields a Failure. Facts include the seconds that it took.
    """
    found = {}
    for problem in (each for each in problems if allows(dataset, each)):
        start = time.perf_counter()
        try:
            result = find(problem, dataset, found)
            solution = problem_solution(problem, dataset, result)
            found[problem] = result
            seconds = time.perf_counter() - start
            yield replace(solution, facts=solution.facts | {"seconds": seconds})
        except UNSOLVABLE as error:
            yield failure(problem, dataset, error)


def truth_in_world(solution, truth):
    """The true poses (n, 3) in the world frame of a Solution."""
    return se2.between(truth.poses[solution.world], truth.poses)


def solve_to_folder(dataset, truth, out, problems=tuple(PROBLEMS), csv=False):
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


def _in_two_processes(*arguments):
    """What `_solved` returns of all problems, in order; the second process solves INDEPENDENT."""
    receiver, sender = pipe = Pipe(duplex=False)
    if sys.platform == "linux":
        get_context("fork").Process(target=_send, args=(pipe, *arguments), daemon=True).start()
    sender.close()
    _, late = _solved(False, *arguments)
    try:
        doubts, early = receiver.recv()
    except (EOFError, OSError):            # no child, or it was killed, or failed: here it is told
        doubts, early = _solved(True, *arguments)
    return doubts, early + late


def _send(pipe, *arguments):
    """Send what `_solved` returns from a process that Ctrl-C does not end."""
    pipe[0].close()                        # so that the pipe breaks when the other one is killed
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with pipe[1], suppress(BaseException):
        pipe[1].send(_solved(True, *arguments))


def _solved(independent, dataset, problems):
    """Doubts before solving and `solutions` of problems INDEPENDENT, or none and of the others."""
    problems = [problem for problem in problems if (problem in INDEPENDENT) == independent]
    return (doubts_before_solving(dataset) if independent else [],
            [*solutions(dataset, problems)])


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
