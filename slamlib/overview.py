"""What opens the report: the datasets, every problem's result on each, and a picture.

All numbers come from the files to hand in, and from the truth where there is truth.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib import evaluation, odometry, plotting, se2
from slamlib.dataset import Dataset, Truth, read_dataset, read_truth
from slamlib.execution import NotebookError
from slamlib.notebook import listed, table_text
from slamlib.results import read_vehicle_poses
from slamlib.solve import Solution, truth_in_world_of

TITLES = {"problem1": "odometry", "problem2": "ArUco", "problem2_hint": "odometry + ArUco, hint",
          "problem2_fused": "odometry + ArUco", "problem3": "SLAM: odometry + ArUco",
          "problem4": "SLAM: odometry + ArUco + UWB"}
NEEDS = {"aruco": ("markers", ["problem2", "problem2_hint", "problem2_fused", "problem3"]),
         "uwb": ("UWB ranges", ["problem4"])}
ROLES = {"problem1": "odometry", "problem2": "aruco", "problem2_fused": "fused", "problem3": "slam",
         "problem4": "slam_uwb"}
WHAT = ("Wheel encoders, markers on the ceiling and radio ranges: where the vehicle was, and what "
        "it saw. Each chapter derives the estimator of one problem, runs it on every dataset, and "
        "judges it by the truth where that is known.")


@dataclass(frozen=True)
class Drive:
    """A dataset with what this build has made of it."""

    name: str
    dataset: Dataset
    truth: Truth | None
    solutions: tuple  # of Solution, in the order of the problems


def read_drives(data, results, selected, written):
    """The drives of the selected datasets, the shortest first, with their poses in `written`.

    Parameters
    ----------
    data, results : Path
    selected : list of str, names of datasets.
    written : names of this build's files below `results`, as `short/problem1/vehiclePose.mat`.

    Raises
    ------
    NotebookError : poses that are not what a vehiclePose.mat holds.
    """
    drives = []
    for name in selected:
        problems = sorted(file.split("/")[1] for file in written if re.fullmatch(
            f"{re.escape(name)}/[^/]+/vehiclePose.mat", file))
        order = {problem: place for place, problem in enumerate(TITLES)}
        problems.sort(key=lambda problem: order.get(problem, len(order)))
        dataset = read_dataset(data / name)
        drives.append(Drive(name, dataset, read_truth(data / name), tuple(
            _read(results / name / problem, dataset) for problem in problems)))
    return sorted(drives, key=lambda drive: len(drive.dataset.ticks))


def title_of(problem, dataset):
    """What a problem is called on a dataset; one that is not known, by its folder."""
    title = TITLES.get(problem, problem)
    return title if dataset.aruco is not None else title.replace(" + ArUco + UWB", " + UWB")


def _read(folder, dataset):
    count = len(dataset.ticks)
    place = f"{folder.parent.name}/{folder.name}/vehiclePose.mat, which a notebook wrote"
    try:
        poses, covariances = read_vehicle_poses(folder)
    except Exception as error:  # of scipy or numpy, of whatever kind
        raise NotebookError(f"{place}, cannot be read: {error}") from None
    if poses.shape != (count, 3) or covariances.shape != (count, 3, 3):
        raise NotebookError(f"{place}, must hold [x, y, heading] and a covariance for each of the "
                            f"{count} encoder poses; it holds {poses.shape}, {covariances.shape}")
    known = np.flatnonzero(np.isfinite(poses[:, 0]))  # the first of them is the world frame
    return Solution(folder.name, title_of(folder.name, dataset), poses, covariances,
                    int(known[0]) if len(known) else 0)


def summary(title, drives):
    """A notebook, as if executed, that opens the report under this title (in Markdown)."""
    cells = [new_markdown_cell(f"# {title}\n\n{WHAT}", id="what"),
             new_markdown_cell("## The datasets\n\n" + _datasets(drives), id="datasets")]
    if any(drive.solutions for drive in drives):
        cells.append(new_markdown_cell("## The results\n\n" + _headline(drives), id="results"))
        longest = max((drive for drive in drives if drive.solutions),
                      key=lambda drive: len(drive.dataset.ticks))
        picture = new_output("display_data", _pictures(longest))
        cells += [new_code_cell(outputs=[picture], id="picture", metadata={
                      "alt": f"The trajectories of {longest.name}, laid over each other"}),
                  new_markdown_cell(f"Figure 1. The trajectories of {plain(longest.name)}, "
                                    + _overlaid(longest), id="caption")]
    return new_notebook(cells=cells)


def index(opening, chapters, files):
    """The summary with links to chapters, to the PDF and to (address, name) of result files."""
    first, *rest = opening.cells
    links = "\n\n".join(
        f"### [{chapter['title']}]({chapter['file']})\n\n"
        + re.sub(r"\]\(#", f"]({chapter['file']}#", chapter["lead"]) for chapter in chapters)
    cells = [new_markdown_cell(first.source + "\n\n[The whole report as one PDF](report.pdf)",
                               id="what"), *rest,
             new_markdown_cell("## Chapters\n\n" + links, id="chapters")]
    if files:
        names = "\n".join(f"- [{plain(name)}]({address})" for address, name in files)
        cells.append(new_markdown_cell(
            "## Files to hand in\n\nMATLAB files with struct arrays, as the notebooks wrote them."
            f"\n\n{names}", id="files"))
    return new_notebook(cells=cells)


def plain(text):
    """Text that Markdown is to leave as it is."""
    return re.sub(r"[^\w\s.,:/+-]", lambda sign: f"&#{ord(sign[0])};", text)


def _datasets(drives):
    rows = []
    for drive in drives:
        d = drive.dataset
        path = evaluation.path_length(odometry.dead_reckoning(d.ticks, d.vehicle))
        rows.append([plain(drive.name), f"{len(d.ticks):,}", f"{path:.1f}\u00a0m", _count(d.aruco),
                     _count(d.uwb), "known" if drive.truth else "not known"])
    header = ["dataset", "poses", "path", "sightings of markers", "UWB ranges", "truth"]
    return (table_text(header, rows, texts=2)
            + "\n\nTable 1. What was measured on each drive; the path is the encoders'.")


def _count(readings):
    return "none" if readings is None else f"{len(readings.pose):,}"


def _headline(drives):
    problems = list(dict.fromkeys(s.problem for drive in drives for s in drive.solutions))
    problems.sort(key=lambda problem: list(TITLES).index(problem) if problem in TITLES else 99)
    rows = []
    for drive in drives:
        solved = {solution.problem: solution for solution in drive.solutions}
        rows += [_row(drive, problem, solved.get(problem)) for problem in problems]
    text = table_text(["dataset", "problem", "ATE", "ATE, aligned", "σ of position", "σ of heading",
                       "poses"], rows, texts=2)
    text += ("\n\nTable 2. Every problem on every dataset: the root mean square error of all positions "
             "(ATE), as they stand and moved as a whole nearest to the truth; at the last pose that has "
             "an estimate the larger standard deviation of $x$ and $y$, and that of the heading; and how "
             "many poses have one.")
    if without := [plain(drive.name) for drive in drives if drive.truth is None]:
        text += f"\n\nNo truth comes with {listed(without)}, so errors are not known there."
    for sensor, (name, _) in NEEDS.items():
        if without := [plain(d.name) for d in drives if getattr(d.dataset, sensor) is None]:
            text += (f"\n\nThere are no {name} in {listed(without)}: the problems that need them "
                     "are left out there.")
    return text


def _row(drive, problem, solution):
    row = [plain(drive.name), plain(title_of(problem, drive.dataset))]
    if solution is None:
        lacking = [name for sensor, (name, needed) in NEEDS.items()
                   if problem in needed and getattr(drive.dataset, sensor) is None]
        return [*row, f"left out: no {' and no '.join(lacking)}" if lacking else "no result",
                *["–"] * 4]
    known = np.flatnonzero(np.isfinite(solution.poses[:, 0]))
    if not len(known):
        return [*row, *["–"] * 4, "0"]
    errors = ["no truth"] * 2
    if drive.truth is not None:
        truth = truth_in_world_of(solution, drive.truth)
        errors = [_si(evaluation.ate(solution.poses, truth, aligned), "m") for aligned in (False, True)]
    sigma = evaluation.sigmas(solution.covariances[known[-1]])
    return [*row, *errors, _si(max(sigma[:2]), "m"), _si(sigma[2], "rad"), f"{len(known):,}"]


def _si(value, unit):
    """Three digits, in thousandths of the unit where it is small."""
    value, unit = (value, unit) if value >= 1 else (1e3 * value, f"m{unit}")
    return f"{value:.{max(0, 2 - len(str(int(value))) + 1)}f}\u00a0{unit}"


def _overlaid(drive):
    shown = "as the problems estimate it" if drive.truth is None else (
        "as the problems estimate it, and the truth (dashed)")
    return (f"the longest drive, {shown}. Where curves cannot be told apart they agree; what they "
            "differ by is in table 2.")


def _pictures(drive):
    """The trajectories of a drive over each other, in the world frame of pose 1, as SVG texts."""
    style = Path(plotting.__file__).with_name("slamlib.mplstyle")
    with plt.style.context(style, after_reset=True):
        fig = Figure(figsize=(7.2, 3.8))
        ax = fig.add_subplot()
        if drive.truth is not None:
            plotting.trajectory(ax, drive.truth.poses, "truth")
        last = drive.solutions[-1].poses
        for solution in drive.solutions:
            if solution.problem in ROLES or solution.problem not in TITLES:
                poses = solution.poses
                if solution.world and np.isfinite(last[solution.world, 0]):
                    poses = se2.compose(last[solution.world], poses)
                plotting.trajectory(ax, poses, ROLES.get(solution.problem, "alternative"),
                                    solution.title)
        plotting.legend_below(fig)
        return plotting.pictures(fig)
