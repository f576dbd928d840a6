"""The datasets of a report with the solutions in the result files of this build."""

import re
from dataclasses import dataclass

import numpy as np

from slamlib.checks.files import doubts_before_solving, merged
from slamlib.dataset import Dataset, Truth, read_dataset, read_truth
from slamlib.doubt import Doubt
from slamlib.inventory import all_notes
from slamlib.notebook import Drive
from slamlib.report.execution import NotebookError
from slamlib.results import read_aruco_map, read_uwb_map, read_vehicle_poses
from slamlib.solve import PROBLEMS, Failure, Solution, title


@dataclass(frozen=True)
class SolvedDrive:
    """A dataset with the solutions that this build computed for it."""

    name: str
    dataset: Dataset
    truth: Truth | None
    solutions: tuple  # of Solution, in the order of PROBLEMS
    doubts: tuple = ()  # of Doubt, first about the drive, then by problem
    failures: tuple = ()  # of Failure, in the order of PROBLEMS
    files: tuple = ()  # of str, its files to hand in, as `problem1/vehiclePose.mat`

    @property
    def origin(self):
        """Origin of the data, a str as of `notebook.Drive`."""
        return Drive(self.name, self.dataset, self.truth).origin

    @property
    def notes(self):
        """What was mended or left out when the files were read, a tuple of str."""
        return all_notes(self.dataset, self.truth)

    @property
    def simulated(self):
        """True if the data are simulated, False if they were recorded."""
        return self.origin == "simulated"

    def solution(self, problem):
        """Return the Solution of a problem (str), or None."""
        return next((known for known in self.solutions if known.problem == problem), None)


def read_drives(data, results, selected, written, notices=None):
    """Return the selected datasets with their solutions, a list of SolvedDrive, the shortest first.

    Parameters
    ----------
    data, results : Path, the folders of the datasets and of the result files of this build.
    selected : list of str, names of datasets.
    written : list of str, this build's files, as `short/problem1/vehiclePose.mat` in `results`.
        NotebookError if poses cannot be read or have other shapes than the dataset's.
    notices : dict by `notebook.notices`, the doubts and failures that this build's notebooks found.
    """
    drives = []
    for name in selected:
        files = tuple(file.removeprefix(f"{name}/") for file in sorted(written)
                      if file.startswith(f"{name}/") and file.endswith(".mat"))
        problems = sorted((file.split("/")[0] for file in files if re.fullmatch(
            "[^/]+/vehiclePose.mat", file)), key=order)
        dataset, truth = read_dataset(data / name), read_truth(data / name)
        solved = tuple(_read_solution(results / name / problem, dataset, files)
                       for problem in problems)
        told = (notices or {}).get(name, [])
        doubts = [*doubts_before_solving(dataset, truth),
                  *(x for x in told if isinstance(x, Doubt))]
        failures = sorted((x for x in told if isinstance(x, Failure)),
                          key=lambda failure: order(failure.problem))
        drives.append(SolvedDrive(
            name=name, dataset=dataset, truth=truth, solutions=solved,
            doubts=tuple(merged(doubts)), failures=tuple(failures), files=files))
    return sorted(drives, key=lambda drive: len(drive.dataset.ticks))


def order(problem):
    """Return the index of a problem in PROBLEMS; unknown problems come last."""
    return list(PROBLEMS).index(problem) if problem in PROBLEMS else len(PROBLEMS)


def _read_solution(folder, dataset, files):
    """Return the Solution in a results folder; its world frame is the first pose estimated."""
    count = len(dataset.ticks)
    poses, covariances = _read_result(read_vehicle_poses, folder, "vehiclePose.mat")
    if poses.shape != (count, 3) or covariances.shape != (count, 3, 3):
        raise NotebookError(
            f"{_written_file(folder, 'vehiclePose.mat')}, must hold [x, y, heading] and a "
            f"covariance for each of the {count} encoder poses; it holds {poses.shape}, "
            f"{covariances.shape}")
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    maps = {field: _read_result(function, folder, file) for field, function, file in (
        ("aruco_map", read_aruco_map, "ArucoMap.mat"), ("uwb_map", read_uwb_map, "UwbMap.mat"))
        if f"{folder.name}/{file}" in files}
    return Solution(problem=folder.name, title=title(folder.name, dataset), poses=poses,
                    covariances=covariances, world=int(known[0]) if len(known) else 0, **maps)


def _read_result(function, folder, file):
    try:
        return function(folder)
    except Exception as error:  # scipy and numpy raise many kinds
        raise NotebookError(f"{_written_file(folder, file)}, cannot be read: {error}") from None


def _written_file(folder, file):
    return f"{folder.parent.name}/{folder.name}/{file}, which a notebook wrote"
