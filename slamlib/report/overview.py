"""The summary that opens the report: an abstract, all results, pictures.

The text is in the template overview.md. All numbers are computed from the results of this build,
their files and `summary.json`, and, where it is known, the truth.
"""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import quote

import matplotlib.pyplot as plt
import numpy as np
from IPython.core.pylabtools import print_figure
from jinja2 import Template
from matplotlib.figure import Figure
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib.core import evaluation, marker_increments
from slamlib.core.records import Dataset, Truth
from slamlib.io.dataset import all_notes
from slamlib.io.files import file_names
from slamlib.io.results import read_structs, read_summary
from slamlib.notebook import Drive, accuracy, plotting, table
from slamlib.notebook.drives import plain, without_stand_ins
from slamlib.report.execution import Books, NotebookError
from slamlib.report.notebooks import chapter_of
from slamlib.robust.file_doubts import Doubt
from slamlib.solve import PROBLEMS, SENSORS, Failure, Solution, title

TEXT = Path(__file__).with_name("overview.md")
ALT = "Trajectories, and standard deviations of position"  # of the picture
ON_SCREEN = ("pdf", "files", "chapters")  # blocks of the text that the PDF leaves out
CURVE_POINTS = 1500  # of a curve, at most
HIDDEN_TRAJECTORIES = ("problem2", "problem2_hint", "problem3")  # they would lie below others
LOOKS = {"problem3": dict(linewidth=4.0), "problem4": dict(linestyle="-", linewidth=1.4)}
MAX_NAMED = 3  # drives that the abstract names one by one; else the shortest and the longest
CAMERA = ("camera_x", "camera_y", "camera_turn", "marker_size")  # entries of a calibration
MAPS = {"aruco_map": "ArucoMap", "uwb_map": "UwbMap"}  # fields of a Solution, names of their files
# Columns of the table of results, of `notebook.accuracy`.
ACCURACY = ("ATE (mm)", "aligned (mm)", "σ (mm)", "σ of δ (mrad)")
in_our_style = plt.style.context(plotting.STYLE, after_reset=True)  # decorates what draws


@dataclass(frozen=True, eq=False)
class SolvedDrive(Drive):
    """A Drive with the solutions that this build computed for it."""

    solutions: tuple[Solution, ...] = ()  # in the order of PROBLEMS
    doubts: tuple[Doubt, ...] = ()  # first about the drive, then by problem
    failures: tuple[Failure, ...] = ()  # in the order of PROBLEMS
    files: tuple[str, ...] = ()  # its results, as `problem1/vehiclePose.mat`
    summary: dict = field(default_factory=dict, repr=False)  # as summary.json has it

    def solution(self, problem: str) -> Solution | None:
        """Return the Solution of a problem, or None."""
        return next((known for known in self.solutions if known.problem == problem), None)


def solved_drive(drive: Drive, results: Path) -> SolvedDrive:
    """Return a Drive with what is in its folder of results.

    NotebookError if a file cannot be read, or has another number of poses.
    """
    summary = read_summary(results)
    solutions = []
    failures = []
    for problem, row in summary["problems"].items():
        if "failed" in row:
            failures.append(Failure(problem, row["title"], row["failed"]))
        else:
            solutions.append(read_solution(results / problem, drive.dataset))
    doubts = tuple(Doubt(**doubt) for doubt in summary["doubts"])
    return SolvedDrive(drive.name, drive.dataset, drive.truth, tuple(solutions), doubts,
                       tuple(failures), tuple(file_names(results)), summary)


def why_missing(drive: SolvedDrive, problem: str) -> str:
    """Return why a drive has no solution of a problem."""
    lacks = [SENSORS[sensor] for sensor in PROBLEMS[problem].sensors if _without(drive, sensor)]
    if lacks:
        return f"left out: no {' and no '.join(lacks)}"
    for failure in drive.failures:
        if failure.problem == problem:
            return f"could not be solved: {failure.reason}"
    return "no result"


def _without(drive, sensor):
    return getattr(drive.dataset, sensor) is None


def read_solution(folder: Path, dataset: Dataset) -> Solution:
    """Return the Solution in a results folder; its world frame is the first pose estimated."""
    place = f"{folder.parent.name}/{folder.name}, which a notebook wrote,"
    try:
        _, poses, covariances = read_structs(folder, "vehiclePose")
        maps = {field: read_structs(folder, name) for field, name in MAPS.items()
                if (folder / f"{name}.mat").exists()}
    except Exception as error:  # scipy and numpy raise many kinds
        raise NotebookError(f"{place} cannot be read: {error}") from None
    count = len(dataset.ticks)
    known = np.isfinite(poses[:, 0])
    if poses.shape != (count, 3) or not known.any():
        raise NotebookError(f"{place} must hold [x, y, heading] for each of the {count} encoder "
                            f"poses, one of them at least not NaN, found {poses.shape}")
    return Solution(problem=folder.name, title=title(folder.name, dataset), poses=poses,
                    covariances=covariances, world=int(known.argmax()), **maps)


def opening(drives: list[SolvedDrive], chapters: Books | None = None) -> NotebookNode:
    """Return the opening of the report, an executed notebook that leads to `chapters`."""
    template = Template(TEXT.read_text(encoding="utf-8"), trim_blocks=True, lstrip_blocks=True)
    facts = _facts(drives, chapters or {})
    context = template.new_context(facts)
    cells = []
    for name, block in template.blocks.items():
        if name == "caption" and facts["longest"]:
            drawn = _as_svg(trajectories(facts["longest"]))
            picture = new_output("display_data", {"image/svg+xml": drawn})
            cells.append(new_code_cell(id="picture", metadata={"alt": ALT}, outputs=[picture]))
        text = "".join(block(context)).strip()
        if text:
            tags = ["html-only"] if name in ON_SCREEN else []
            cells.append(new_markdown_cell(text, id=name, metadata={"tags": tags}))
    return new_notebook(cells=cells)


def longest(drives: list[SolvedDrive]) -> SolvedDrive | None:
    """Return the longest drive that has a solution, a recorded one if any is."""
    solved = [drive for drive in drives if drive.solutions]
    return max(without_stand_ins(solved), default=None, key=lambda drive: len(drive.dataset.ticks))


def _facts(drives, chapters):
    """Return what the template tells, a dict."""
    solved = [drive for drive in drives if drive.solutions]
    subjects = without_stand_ins(solved)
    compared = subjects if len(subjects) <= MAX_NAMED else [subjects[0], subjects[-1]]
    attempted = {each.problem for drive in drives for each in drive.solutions + drive.failures}
    problems = [problem for problem in PROBLEMS if problem in attempted]
    rows = [result_row(drive, problem) for drive in drives for problem in problems]
    facts = {"name": _name, "listed": listed, "results_of": problems}
    facts["longest"] = longest(drives)
    facts["compared"] = [_compared(drive) for drive in compared]
    facts["simulated"] = [_name(drive) for drive in drives if drive.origin == "simulated"]
    facts["results"] = table(rows).data if solved else ""
    facts["known"] = [drive for drive in drives if drive.truth]
    facts["sensors"] = [sensor for sensor in SENSORS
                        if not all(_without(drive, sensor) for drive in drives)]
    facts["without"] = {name: [plain(drive.name) for drive in drives if _without(drive, sensor)]
                        for sensor, name in SENSORS.items()}
    facts["doubts"] = {plain(drive.name): _doubts_told(drive) for drive in drives}
    facts["notes"] = {_name(drive): [plain(note) for note in all_notes(drive.dataset, drive.truth)]
                      for drive in drives}
    facts["chapters"] = {quote(source.name): chapter_of(source, book)
                         for source, book in chapters.items()}
    return facts


def _name(drive):
    return f"*{plain(drive.name)}*"


def _doubts_told(drive):
    """Return sentences (list of str) on what failed on a SolvedDrive and what is in doubt."""
    told = [f"The problem “{failure.title}” could not be solved: {failure.reason}."
            for failure in drive.failures]
    told += [doubt.sentence for doubt in drive.doubts]
    return [plain(sentence) for sentence in told]


def _compared(drive):
    """Return what the abstract tells of a SolvedDrive, a dict: odometry against the best SLAM."""
    told = {"name": _name(drive), "landmarks": listed(_landmarks(drive.solutions[-1]))}
    both = [drive.solution("problem1"), drive.solution("problem4") or drive.solution("problem3")]
    if all(both) and drive.truth:
        told["errors"] = [with_unit(accuracy(each, drive)["ATE (mm)"], "m") for each in both]
    elif all(both):
        told["returns"] = _at_returns(both, drive)
    return told


def _landmarks(solution):
    """Return the numbers of landmarks of a Solution, as "4 antennas" (list of str)."""
    told = []
    for name, landmarks in (("marker", solution.aruco_map), ("antenna", solution.uwb_map)):
        if landmarks and len(landmarks[0]):
            plural = "s" if len(landmarks[0]) > 1 else ""
            told.append(f"{len(landmarks[0])} {name}{plural}")
    return told


def _at_returns(solutions, drive):
    """Return differences of Solutions from what returns measure, root mean squares (list of str).

    The last one is what the noise of the sightings alone gives. Sightings are those by the camera
    that the last solution estimated.
    """
    row = drive.summary["problems"].get(solutions[-1].problem, {})
    calibration = {entry["name"]: entry["estimate"] for entry in row.get("calibration", ())}
    camera = {name: calibration[name] for name in CAMERA if name in calibration}
    vehicle = replace(drive.dataset.vehicle, **camera)
    returns = marker_increments.returns(replace(drive.dataset, vehicle=vehicle))
    if len(returns.start) == 0:
        return []
    squares = [np.sum(returns.discrepancies(each.poses)[:, :2]**2, axis=1) for each in solutions]
    variances = np.trace(returns.covariance[:, :2, :2], axis1=1, axis2=2)
    squares.append(row.get("marker_noise_factor", 1)**2 * variances)
    return [with_unit(1e3 * np.sqrt(np.mean(each)), "m") for each in squares]


def result_row(drive: SolvedDrive, problem: str) -> dict:
    """Return a row of the table of results, for `notebook.table`."""
    number = problem.removeprefix("problem")[0]
    row = {"dataset": plain(drive.name),
           "problem": f"{number}. {plain(title(problem, drive.dataset))}"}
    solution = drive.solution(problem)
    if solution is None:
        reason = re.sub("(?<=solved):.*", "", why_missing(drive, problem))
        return row | dict.fromkeys(ACCURACY) | {"σ (mm)": f"*{reason}*"}
    found = accuracy(solution, drive)
    row |= {name: found.get(name) for name in ACCURACY}
    return row | {"poses": int(np.isfinite(solution.poses[:, 0]).sum())}


@in_our_style
def trajectories(drive: SolvedDrive, size: tuple[float, float] = (7.2, 2.7)) -> Figure:
    """Return the figure of a drive's trajectories, its last map and sigmas; the size in inches."""
    fig = Figure(figsize=size)
    left, right = fig.subplots(1, 2)
    last = drive.solutions[-1]
    for solution in drive.solutions:
        role = PROBLEMS[solution.problem].role
        look = LOOKS.get(solution.problem, {})
        if solution.problem not in HIDDEN_TRAJECTORIES or solution is last:
            plotting.trajectory(left, _few(solution.poses), role, solution.title, **look)
        sigmas = evaluation.position_sigmas(solution.covariances)
        sigmas[:len(sigmas) // 50] = np.nan  # nearly zero, on a logarithmic axis
        known = _few(np.flatnonzero(sigmas > 0))
        plotting.curve(right, sigmas[known], role, known, solution.title, **look)
    if drive.truth is not None:
        plotting.trajectory(left, _few(drive.truth.poses), "truth")
    _draw_landmarks(left, last)
    right.set(yscale="log", ylabel="σ of position (m)")
    plotting.legend_below(fig)
    return fig


def result_picture(dataset: Dataset, truth: Truth | None, results: Path, path: Path):
    """Write the figure of `trajectories` of a folder of results as a .png, .pdf or .svg file."""
    drive = solved_drive(Drive(dataset.name, dataset, truth), results)
    path.parent.mkdir(parents=True, exist_ok=True)
    trajectories(drive, (11, 5.5)).savefig(path, dpi=150)


@in_our_style
def _as_svg(fig):
    return print_figure(fig, "svg", metadata={"Date": None})


@in_our_style
def title_picture(drives: list[SolvedDrive]) -> str:
    """Return the last trajectory of the longest drive with its landmarks as SVG, or ""."""
    drive = longest(drives)
    if drive is None:
        return ""
    fig = Figure(figsize=(6.3, 4.6))  # inches
    ax = fig.add_subplot()
    solution = drive.solutions[-1]
    role = PROBLEMS[solution.problem].role
    plotting.trajectory(ax, _few(solution.poses), role, linestyle="-", linewidth=1.2)
    _draw_landmarks(ax, solution)
    ax.axis("off")
    return _as_svg(fig)


def _draw_landmarks(ax, solution):
    if solution.aruco_map is not None:
        plotting.draw_markers(ax, *solution.aruco_map[1:])
    if solution.uwb_map is not None:
        plotting.draw_antennas(ax, *solution.uwb_map[1:])


def _few(rows):
    """Return at most CURVE_POINTS of the rows (n, ...), first and last included."""
    if len(rows) == 0:
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, CURVE_POINTS).astype(int))]


def listed(names: list[str]) -> str:
    """Return names as "a, b and c"."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"


def with_unit(value: float, unit: str) -> str:
    """Return a value in mm or mrad with three significant digits in its unit or in thousandths."""
    if abs(value) >= 1e3:
        value = 1e-3 * value
    else:
        unit = f"m{unit}"
    digits = f"{value:,.0f}" if abs(value) >= 100 else f"{value:#.3g}".removesuffix(".")
    return f"{digits}\u00a0{unit}"
