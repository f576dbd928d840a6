"""The summary that opens the report: the datasets, all results, and a figure of the trajectories.

All numbers are computed from the result files and, where it is known, the truth.
"""

import re
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib import evaluation, odometry, se2
from slamlib.dataset import Dataset, Truth, read_dataset, read_truth
from slamlib.doubt import Doubt
from slamlib.notebook import listed, plain, plotting, table_text
from slamlib.report.execution import NotebookError
from slamlib.results import read_vehicle_poses
from slamlib.solve import (
    PROBLEMS,
    SENSORS,
    Failure,
    Solution,
    doubts_about_drive,
    merged,
    title,
    truth_in_world,
)

INTRODUCTION = (
    "We estimate the trajectory of a vehicle and map the landmarks from wheel encoders, markers on "
    "the ceiling and radio ranges. Each chapter derives the estimator of one problem, runs it on "
    "every dataset, and compares it with the truth where that is known.")


@dataclass(frozen=True)
class SolvedDrive:
    """A dataset with the solutions that this build computed for it."""

    name: str
    dataset: Dataset
    truth: Truth | None
    solutions: tuple  # of Solution, in the order of PROBLEMS
    doubts: tuple = ()  # of Doubt, first about the drive, then by problem
    failures: tuple = ()  # of Failure, in the order of PROBLEMS


def read_drives(data, results, selected, written, notices=None):
    """Return the selected datasets with their solutions, a list of SolvedDrive, the shortest first.

    Parameters
    ----------
    data, results : Path, the folders of the datasets and of the result files.
    selected : list of str, names of datasets.
    written : list of str, this build's files, as `short/problem1/vehiclePose.mat` in `results`.
        NotebookError if poses cannot be read or have other shapes than the dataset's.
    notices : dict by `notebook.notices`, the doubts and failures that this build's notebooks found.
    """
    drives = []
    for name in selected:
        problems = sorted((file.split("/")[1] for file in sorted(written) if re.fullmatch(
            f"{re.escape(name)}/[^/]+/vehiclePose.mat", file)), key=_order)
        dataset, truth = read_dataset(data / name), read_truth(data / name)
        solved = tuple(_read_solution(results / name / problem, dataset) for problem in problems)
        told = (notices or {}).get(name, [])
        doubts = [*doubts_about_drive(dataset, truth), *(x for x in told if isinstance(x, Doubt))]
        failures = sorted((x for x in told if isinstance(x, Failure)),
                          key=lambda failure: _order(failure.problem))
        drives.append(SolvedDrive(name, dataset, truth, solved, tuple(merged(doubts)),
                                  tuple(failures)))
    return sorted(drives, key=lambda drive: len(drive.dataset.ticks))


def _order(problem):
    """Return the index of a problem in PROBLEMS; unknown problems come last."""
    return list(PROBLEMS).index(problem) if problem in PROBLEMS else len(PROBLEMS)


def _read_solution(folder, dataset):
    """Return the Solution in a results folder; its world frame is the first pose estimated."""
    count = len(dataset.ticks)
    file = f"{folder.parent.name}/{folder.name}/vehiclePose.mat, which a notebook wrote"
    try:
        poses, covariances = read_vehicle_poses(folder)
    except Exception as error:  # scipy and numpy raise many kinds
        raise NotebookError(f"{file}, cannot be read: {error}") from None
    if poses.shape != (count, 3) or covariances.shape != (count, 3, 3):
        raise NotebookError(f"{file}, must hold [x, y, heading] and a covariance for each of the "
                            f"{count} encoder poses; it holds {poses.shape}, {covariances.shape}")
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    return Solution(problem=folder.name, title=title(folder.name, dataset), poses=poses,
                    covariances=covariances, world=int(known[0]) if len(known) else 0)


def summary(drives):
    """Return the opening of the report, an executed NotebookNode, for a list of SolvedDrive."""
    cells = [new_markdown_cell(f"# Overview\n\n{INTRODUCTION}", id="what"),
             new_markdown_cell("## The datasets\n\n" + _dataset_table(drives), id="datasets")]
    if doubts := _doubts(drives):
        cells.append(new_markdown_cell(f"## Doubts about the data\n\n{doubts}", id="doubts"))
    if solved := [drive for drive in drives if drive.solutions]:
        longest = max(solved, key=lambda drive: len(drive.dataset.ticks))
        cells += [
            new_markdown_cell("## The results\n\n" + _result_table(drives), id="results"),
            new_code_cell(
                outputs=[new_output("display_data", _trajectories(longest))], id="picture",
                metadata={"alt": f"The trajectories of {longest.name}, laid over each other"}),
            new_markdown_cell(
                f"Figure 1. The trajectories of {plain(longest.name)}, the longest drive, as the "
                f"problems estimate it{', and the truth (dashed)' if longest.truth else ''}. Where "
                "curves cannot be told apart they agree; table 2 lists the differences.",
                id="caption")]
    return new_notebook(cells=cells)


def index(heading, opening, chapters, files):
    """Return the first page, a NotebookNode: the opening by `summary` with links to all the rest.

    `heading` (str) is the title of the report, `chapters` are dicts by `pages.chapter_of`, and
    `files` pairs (str, str) of address and name of the result files.
    """
    links = "\n\n".join(
        f"### [{chapter['title']}]({chapter['file']})\n\n"
        + re.sub(r"\]\(#", f"]({chapter['file']}#", chapter["lead"]) for chapter in chapters)
    cells = [new_markdown_cell(f"# {plain(heading)}\n\n{INTRODUCTION}\n\n"
                               "[The whole report as one PDF](report.pdf)", id="what"),
             *opening.cells[1:],
             new_markdown_cell("## Chapters\n\n" + links, id="chapters")]
    if files:
        names = "\n".join(f"- [{plain(name)}]({address})" for address, name in files)
        cells.append(new_markdown_cell(
            "## Files to hand in\n\nMATLAB files with struct arrays, as the notebooks wrote them."
            f"\n\n{names}", id="files"))
    return new_notebook(cells=cells)


def _dataset_table(drives):
    rows = []
    for drive in drives:
        dataset = drive.dataset
        path = odometry.dead_reckoning(dataset.ticks, dataset.vehicle)
        counts = ["none" if readings is None else f"{len(readings.pose):,}"
                  for readings in (dataset.aruco, dataset.uwb)]
        rows.append([plain(drive.name), f"{len(dataset.ticks):,}",
                     f"{evaluation.path_length(path):.1f}\u00a0m", *counts,
                     "known" if drive.truth else "not known"])
    header = ["dataset", "poses", "path", "sightings of markers", "UWB ranges", "truth"]
    return (table_text(header, rows, texts=2)
            + "\n\nTable 1. Measurements of each drive; the path length is from odometry.")


def _doubts(drives):
    """Return by drive what could not be solved and what is doubted, in Markdown; "" if nothing."""
    parts = []
    for drive in drives:
        sentences = [f"The problem “{failure.title}” could not be solved: {failure.reason}."
                     for failure in drive.failures]
        sentences += [doubt.sentence for doubt in drive.doubts]
        if sentences:
            lines = "\n".join(f"- {plain(sentence)}" for sentence in sentences)
            parts.append(f"{plain(drive.name)}:\n\n{lines}")
    return "\n\n".join(parts)


def _result_table(drives):
    problems = sorted(dict.fromkeys(
        told.problem for drive in drives for told in (*drive.solutions, *drive.failures)),
        key=_order)
    rows = []
    for drive in drives:
        solved = {solution.problem: solution for solution in drive.solutions}
        rows += [_result_row(drive, problem, solved.get(problem)) for problem in problems]
    header = ["dataset", "problem", "ATE", "ATE, aligned", "σ of position", "σ of heading",
              "poses"]
    text = table_text(header, rows, texts=2) + (
        "\n\nTable 2. Every problem on every dataset: the root mean square error of all positions "
        "(ATE), as they stand and moved as a whole nearest to the truth; at the last pose that has "
        "an estimate the larger standard deviation of $x$ and $y$, and that of the heading; and "
        "how many poses have one.")
    if without := [plain(drive.name) for drive in drives if drive.truth is None]:
        text += f"\n\nNo truth comes with {listed(without)}, so errors are not known there."
    for sensor, name in SENSORS.items():
        if without := [plain(d.name) for d in drives if getattr(d.dataset, sensor) is None]:
            text += (f"\n\nThere are no {name} in {listed(without)}: the problems that need them "
                     "are left out there.")
    return text


def _result_row(drive, problem, solution):
    row = [plain(drive.name), plain(title(problem, drive.dataset))]
    if solution is None:
        needed = PROBLEMS[problem].sensors if problem in PROBLEMS else ()
        missing = [SENSORS[sensor] for sensor in needed if getattr(drive.dataset, sensor) is None]
        failed = any(failure.problem == problem for failure in drive.failures)
        return [*row, f"left out: no {' and no '.join(missing)}" if missing
                else "could not be solved" if failed else "no result", *["–"] * 4]
    known = np.flatnonzero(np.isfinite(solution.poses[:, 0]))
    if not len(known):
        return [*row, *["–"] * 4, "0"]
    errors = ["no truth"] * 2
    if drive.truth is not None:
        truth = truth_in_world(solution, drive.truth)
        errors = [_with_unit(evaluation.ate(solution.poses, truth, aligned), "m")
                  for aligned in (False, True)]
    sigma = evaluation.sigmas(solution.covariances[known[-1]])
    return [*row, *errors, _with_unit(max(sigma[:2]), "m"), _with_unit(sigma[2], "rad"),
            f"{len(known):,}"]


def _with_unit(value, unit):
    """Return a value with three digits, below 1 in thousandths of the unit."""
    value, unit = (value, unit) if value >= 1 else (1e3 * value, f"m{unit}")
    return f"{value:.{max(0, 3 - len(str(int(value))))}f}\u00a0{unit}"


def _trajectories(drive):
    """Return the figure of a drive's trajectories, in the frame of pose 1, as {MIME type: SVG}."""
    style = Path(plotting.__file__).with_name("slamlib.mplstyle")
    with plt.style.context(style, after_reset=True):
        fig = Figure(figsize=(7.2, 3.8))  # inches
        ax = fig.add_subplot()
        if drive.truth is not None:
            plotting.trajectory(ax, drive.truth.poses, "truth")
        last = drive.solutions[-1].poses
        for solution in drive.solutions:
            if solution.problem == "problem2_hint":
                continue
            poses = solution.poses
            if solution.world and np.isfinite(last[solution.world, 0]):
                poses = se2.compose(last[solution.world], poses)
            task = PROBLEMS.get(solution.problem)
            plotting.trajectory(ax, poses, task.role if task else "alternative", solution.title)
        plotting.legend_below(fig)
        return plotting.pictures(fig)
