"""The datasets of a report with the solutions in the result files of this build."""

from dataclasses import dataclass

import numpy as np

from slamlib.checks.files import doubts_before_solving, merged
from slamlib.doubt import Doubt
from slamlib.notebook import Drive
from slamlib.report.execution import NotebookError
from slamlib.results import read_structs
from slamlib.solve import PROBLEMS, SENSORS, Failure, Solution, title


@dataclass(frozen=True, eq=False)
class SolvedDrive(Drive):
    """A Drive with the solutions that this build computed for it."""

    solutions: tuple = ()  # of Solution, in the order of PROBLEMS
    doubts: tuple = ()  # of Doubt, first about the drive, then by problem
    failures: tuple = ()  # of Failure, in the order of PROBLEMS
    files: tuple = ()  # of str, its files to hand in, as `problem1/vehiclePose.mat`

    def solution(self, problem):
        """Return the Solution of a problem (str), or None."""
        return next((known for known in self.solutions if known.problem == problem), None)


def read_drives(read, results, written, notices):
    """Return the datasets with their solutions, a list of SolvedDrive, the shortest first.

    `read` is a list of (Dataset, Truth or None), `results` (Path) the folder of this build's files,
    `written` (list of str) their names, as `short/problem1/vehiclePose.mat`, and `notices` a dict
    by `notebook.notices`. NotebookError if a file cannot be read, or has another number of poses.
    """
    drives = []
    for dataset, truth in sorted(read, key=lambda drive: len(drive[0].ticks)):
        name, told = dataset.name, notices.get(dataset.name, [])
        files = tuple(file.removeprefix(f"{name}/") for file in sorted(written)
                      if file.startswith(f"{name}/") and file.endswith(".mat"))
        doubts = [*doubts_before_solving(dataset, truth), *(x for x in told if type(x) is Doubt)]
        drives.append(SolvedDrive(
            name, dataset, truth, files=files, doubts=tuple(merged(doubts)),
            solutions=tuple(read_solution(results / name / problem, dataset, files)
                            for problem in PROBLEMS if f"{problem}/vehiclePose.mat" in files),
            failures=tuple(x for problem in PROBLEMS for x in told
                           if type(x) is Failure and x.problem == problem)))
    return drives


def why_missing(drive, problem):
    """Return why a SolvedDrive has no solution of a problem (str)."""
    lacks = [SENSORS[sensor] for sensor in PROBLEMS[problem].sensors
             if getattr(drive.dataset, sensor) is None]
    reasons = [failure.reason for failure in drive.failures if failure.problem == problem]
    return (f"left out: no {' and no '.join(lacks)}" if lacks
            else f"could not be solved: {reasons[0]}" if reasons else "no result")


def read_solution(folder, dataset, files):
    """Return the Solution in a results folder; its world frame is the first pose estimated."""
    place = f"{folder.parent.name}/{folder.name}, which a notebook wrote,"
    try:
        _, poses, covariances = read_structs(folder, "vehiclePose")
        maps = {field: read_structs(folder, name)
                for field, name in (("aruco_map", "ArucoMap"), ("uwb_map", "UwbMap"))
                if f"{folder.name}/{name}.mat" in files}
    except Exception as error:  # scipy and numpy raise many kinds
        raise NotebookError(f"{place} cannot be read: {error}") from None
    if poses.shape != (len(dataset.ticks), 3) or not np.isfinite(poses[:, 0]).any():
        raise NotebookError(f"{place} must hold [x, y, heading] for each of the "
                            f"{len(dataset.ticks)} encoder poses, one of them at least not NaN, "
                            f"found {poses.shape}")
    return Solution(problem=folder.name, title=title(folder.name, dataset), poses=poses,
                    covariances=covariances, world=int(np.isfinite(poses[:, 0]).argmax()), **maps)
