"""The summary that opens the report: an abstract, all results, pictures.

The text is in the template overview.md. All numbers are computed from the files to hand in of this
build, which `read_drives` reads, and, where it is known, the truth.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

import matplotlib.pyplot as plt
import numpy as np
from IPython.core.pylabtools import print_figure
from jinja2 import Template
from matplotlib.figure import Figure
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib.core import evaluation, marker_increments
from slamlib.io.dataset import all_notes
from slamlib.io.results import read_structs
from slamlib.io.swap import file_names
from slamlib.notebook import Drive, accuracy, plotting, table
from slamlib.notebook.drives import plain
from slamlib.report.execution import NotebookError
from slamlib.report.notebooks import chapter_of
from slamlib.robust.file_doubts import Doubt, doubts_before_solving, merged
from slamlib.solve import PROBLEMS, SENSORS, Failure, Solution, title, truth_in_world

TEXT = Path(__file__).with_name("overview.md")
ON_SCREEN = ("pdf", "chapters")  # blocks of the text that the PDF leaves out
CURVE_POINTS = 1500  # of a curve, at most
HIDDEN_TRAJECTORIES = ("problem2", "problem2_hint", "problem3")  # they would lie below others
LOOKS = {"problem3": dict(linewidth=4.0), "problem4": dict(linestyle="-", linewidth=1.4)}
MAX_NAMED = 3  # drives that the abstract names one by one; else the shortest and the longest


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
        doubts = [*doubts_before_solving(dataset), *(x for x in told if type(x) is Doubt)]
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


def opening(drives, chapters=None):
    """Return the opening of the report, an executed NotebookNode, for a list of SolvedDrive.

    `chapters` (dict from Path to NotebookNode) are those to which the page leads.
    """
    template = Template(TEXT.read_text(encoding="utf-8"), trim_blocks=True, lstrip_blocks=True)
    longest = max((drive for drive in drives if drive.solutions), default=None,
                  key=lambda drive: len(drive.dataset.ticks))
    context = template.new_context(_facts(drives, chapters or {}) | {
        "longest": longest, "name": _name, "listed": listed})
    cells = []
    for name, block in template.blocks.items():
        if name == "caption" and longest:
            cells.append(new_code_cell(id="picture", metadata={"alt": "Trajectories, and standard "
                         "deviations of position"}, outputs=[new_output(
                             "display_data", {"image/svg+xml": trajectories(longest)})]))
        if text := "".join(block(context)).strip():
            cells.append(new_markdown_cell(text, id=name, metadata={
                "tags": ["html-only"] * (name in ON_SCREEN)}))
    return new_notebook(cells=cells)


def _facts(drives, chapters):
    """Return what the template tells, a dict."""
    solved = [drive for drive in drives if drive.solutions]
    problems = [problem for problem in PROBLEMS if any(
        told.problem == problem for drive in drives for told in drive.solutions + drive.failures)]
    return {
        "sensors": {sensor for sensor in SENSORS for drive in drives
                    if getattr(drive.dataset, sensor) is not None},
        "compared": [*map(_compared, solved if len(solved) <= MAX_NAMED
                          else [solved[0], solved[-1]])],
        "simulated": [_name(drive) for drive in drives if drive.origin == "simulated"],
        "results": solved and table(
            result_row(drive, problem) for drive in drives for problem in problems).data,
        "results_of": problems, "known": any(drive.truth for drive in drives),
        "dashes": not all(drive.truth for drive in drives),
        "without": {name: [plain(drive.name) for drive in drives
                           if getattr(drive.dataset, sensor) is None]
                    for sensor, name in SENSORS.items()},
        "doubts": {plain(drive.name): [plain(sentence) for sentence in (
            *(f"The problem “{failure.title}” could not be solved: {failure.reason}."
              for failure in drive.failures), *(doubt.sentence for doubt in drive.doubts))]
            for drive in drives},
        "notes": {_name(drive): [*map(plain, all_notes(drive.dataset, drive.truth))]
                  for drive in drives},
        "chapters": {quote(source.name): chapter_of(source, book)
                     for source, book in chapters.items()}}


def _name(drive):
    return f"*{plain(drive.name)}*"


def _compared(drive):
    """Return what the abstract tells of a SolvedDrive, a dict: odometry against the best SLAM."""
    both = [drive.solution("problem1"), drive.solution("problem4") or drive.solution("problem3")]
    errors = returns = None
    if all(both):
        found = marker_increments.returns(drive.dataset)
        if drive.truth is not None:
            errors = [with_unit(accuracy(each, drive)["ATE (mm)"], "m") for each in both]
        elif len(found.start):
            off = [found.discrepancies(solution.poses)[:, :2] for solution in both]
            returns = [with_unit(1e3 * np.sqrt(np.mean(np.sum(each**2, axis=1))), "m")
                       for each in off]
    last = drive.solutions[-1]
    counts = [f"{len(each[0])} {name}{'s' * (len(each[0]) > 1)}" for name, each in (
        ("marker", last.aruco_map), ("antenna", last.uwb_map)) if each and len(each[0])]
    return {"name": _name(drive), "errors": errors, "returns": returns,
            "landmarks": listed(counts)}


def result_row(drive, problem):
    """Return a row of the table of results, for `notebook.table` (dict)."""
    solution = drive.solution(problem)
    found = accuracy(solution, drive) if solution else {}
    name = f"{problem.removeprefix('problem')[0]}. {plain(title(problem, drive.dataset))}"
    row = {"dataset": plain(drive.name), "problem": name} | {
        name: with_unit(found[key], unit) if key in found else None for name, key, unit in (
            ("ATE", "ATE (mm)", "m"), ("ATE, aligned", "aligned (mm)", "m"),
            ("σ of position", "σ (mm)", "m"), ("σ of heading", "σ of δ (mrad)", "rad"))}
    if solution:
        return row | {"poses": int(np.isfinite(solution.poses[:, 0]).sum())}
    reason = re.sub("(?<=solved):.*", "", why_missing(drive, problem))
    return row | {"σ of position": f"*{reason}*"}


def trajectories(drive):
    """Return the figure of a SolvedDrive's trajectories and sigmas as SVG (str)."""
    with plt.style.context(plotting.STYLE, after_reset=True):
        fig = Figure(figsize=(7.2, 2.7))  # inches
        _draw(fig, drive.solutions, drive.truth, {
            each.problem for each in drive.solutions if each is drive.solutions[-1]
            or each.problem not in HIDDEN_TRAJECTORIES})
        plotting.legend_below(fig)
        return print_figure(fig, "svg", metadata={"Date": None})


def result_picture(dataset, truth, results, path):
    """Write a picture of the map and the errors of a Dataset's results (folder) to a Path.

    Its ending is .png, .pdf or .svg. Errors are distances to the Truth, or sigmas where it is None.
    """
    solutions = [read_solution(file.parent, dataset, file_names(results))
                 for file in sorted(results.glob("problem*/vehiclePose.mat"))]
    with plt.style.context(plotting.STYLE, after_reset=True):
        fig = Figure(figsize=(11, 5.5))
        _draw(fig, solutions, truth, PROBLEMS, errors=truth is not None)
        _draw_landmarks(fig.axes[0], solutions[-1])
        plotting.legend_below(fig)
        path.parent.mkdir(parents=True, exist_ok=True)
        fig.savefig(path, dpi=150)


def _draw(fig, solutions, truth, shown, errors=False):
    """Draw trajectories of the problems `shown`, and errors or sigmas of all Solutions."""
    left, right = fig.subplots(1, 2)
    for solution in solutions:
        role, look = PROBLEMS[solution.problem].role, LOOKS.get(solution.problem, {})
        if solution.problem in shown:
            plotting.trajectory(left, _few(solution.poses), role, solution.title, **look)
        values = np.hypot(*(solution.poses - truth_in_world(solution, truth))[:, :2].T) \
            if errors else evaluation.position_sigmas(solution.covariances)
        values[:len(values) // 50] = np.nan  # nearly zero, on a logarithmic axis
        known = _few(np.flatnonzero(values > 0))
        plotting.curve(right, values[known], role, known, solution.title, **look)
    if truth is not None:
        plotting.trajectory(left, _few(truth.poses), "truth")
    right.set(yscale="log", ylabel=f"{'error' if errors else 'σ'} of position (m)")


def title_picture(drive):
    """Return a SolvedDrive's last trajectory with its landmarks, without axes, as SVG (str)."""
    with plt.style.context(plotting.STYLE, after_reset=True):
        fig = Figure(figsize=(6.3, 4.6))  # inches
        ax = fig.add_subplot()
        solution = drive.solutions[-1]
        plotting.trajectory(ax, _few(solution.poses), PROBLEMS[solution.problem].role,
                            linestyle="-", linewidth=1.2)
        _draw_landmarks(ax, solution)
        ax.axis("off")
        return print_figure(fig, "svg", metadata={"Date": None})


def _draw_landmarks(ax, solution):
    if solution.aruco_map is not None:
        plotting.draw_markers(ax, *solution.aruco_map[1:])
    if solution.uwb_map is not None:
        plotting.draw_antennas(ax, *solution.uwb_map[1:])


def _few(rows):
    """Return at most CURVE_POINTS of the rows (n, ...), first and last included."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, CURVE_POINTS).astype(int))] \
        if len(rows) else rows


def listed(names):
    """Return names (list of str) as "a, b and c"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def with_unit(value, unit):
    """Return a value in mm or mrad with three significant digits in its unit or in thousandths."""
    value, unit = (1e-3 * value, unit) if abs(value) >= 1e3 else (value, f"m{unit}")
    digits = f"{value:{',.0f' if abs(value) >= 100 else '#.3g'}}".removesuffix(".")
    return f"{digits}\u00a0{unit}"
