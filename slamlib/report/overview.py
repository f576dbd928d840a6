"""The overview that opens the report: its text, the table of all results, and pictures.

The text is in the template overview.md. All numbers are those of the results of this build: their
files and `summary.json`.
"""

from base64 import b64encode
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.core.pylabtools import print_figure
from jinja2 import Template
from matplotlib.figure import Figure
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell, new_notebook

from slamlib.core import evaluation, marker_increments
from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import read_vehicle
from slamlib.io.results import read_structs, read_summary
from slamlib.notebook import Drive, plotting, table
from slamlib.notebook.drives import plain, without_stand_ins
from slamlib.solve import PROBLEMS, SENSORS, VEHICLE_ESTIMATED, Solution

TEXT = Path(__file__).with_name("overview.md")
SCREEN_ONLY = "<!-- on screens only -->"  # in the text, before what the PDF leaves out
DRAWN = "problem1", "problem2_fused"  # whose trajectories figure 1 has, beside the last one
MAPS = {"aruco_map": "ArucoMap", "uwb_map": "UwbMap"}  # fields of a Solution, names of their files
# Columns of the table of results, in thousandths of these entries of a summary.
COLUMNS = {"ATE (mm)": "ate_m", "aligned (mm)": "ate_aligned_m", "at returns (mm)": "at_returns_m",
           "σ (mm)": "median_sigma_m", "σ of δ (mrad)": "median_sigma_heading_rad"}


@dataclass(frozen=True, eq=False)
class SolvedDrive(Drive):
    """A Drive with the results that this build computed for it."""

    solutions: dict[str, Solution] = field(default_factory=dict)  # by problem, in order
    summary: dict = field(default_factory=dict, repr=False)  # as summary.json has it
    vehicle: Vehicle | None = None                          # as estimated

    @property
    def last(self) -> Solution:
        """The Solution of the last problem that is solved."""
        return list(self.solutions.values())[-1]


def solved_drive(drive: Drive, results: Path) -> SolvedDrive:
    """Return a Drive with what is in its folder of results."""
    summary = read_summary(results)
    solutions = {}
    for problem, row in summary["problems"].items():
        if "failed" not in row:
            own = results / problem
            maps = {field: read_structs(own, name) for field, name in MAPS.items()
                    if (own / f"{name}.mat").exists()}
            _, poses, covariances = read_structs(own, "vehiclePose")
            solutions[problem] = Solution(problem, row["title"], poses, covariances,
                                          row["world_is_pose"] - 1, **maps)
    estimated = results / VEHICLE_ESTIMATED
    vehicle = read_vehicle(estimated if estimated.exists() else None, drive.dataset.vehicle)
    return SolvedDrive(drive.name, drive.dataset, drive.truth, solutions, summary, vehicle)


def opening(drives: list[SolvedDrive]) -> NotebookNode:
    """Return the opening of the report, an executed notebook."""
    shown = longest(drives)
    drawn = trajectories(shown) if shown else ""
    template = Template(TEXT.read_text(encoding="utf-8"), trim_blocks=True, lstrip_blocks=True)
    text = template.render(
        drives=drives, longest=shown, plain=plain, sensors=SENSORS,
        picture=f"data:image/svg+xml;base64,{b64encode(drawn.encode()).decode()}",
        results=table(row for drive in drives for row in result_rows(drive)).data)
    printed, on_screen = text.split(SCREEN_ONLY)
    return new_notebook(cells=[
        new_markdown_cell(printed, id="summary"),
        new_markdown_cell(on_screen, id="files", metadata={"tags": ["html-only"]})])


def longest(drives: list[SolvedDrive]) -> SolvedDrive | None:
    """Return the longest drive that has a solution, a recorded one if any is."""
    solved = [drive for drive in drives if drive.solutions]
    return max(without_stand_ins(solved), default=None, key=lambda drive: len(drive.dataset.ticks))


def result_rows(drive: SolvedDrive) -> Iterator[dict]:
    """Return the rows of a drive in the table of results, for `notebook.table`.

    Without truth they have what it differs by from returns, and what noise alone would.
    """
    dataset = {"dataset": plain(drive.name)}
    at_returns = {}
    if drive.truth is None and "problem2" in drive.solutions:
        at_returns = differences_at_returns(drive)
    for problem, found in drive.summary["problems"].items():
        number = problem.removeprefix("problem")[0]
        row = dataset | {"problem": f"{number}. {plain(found['title'])}"}
        found = found | {"at_returns_m": at_returns.get(problem)}
        for name, entry in COLUMNS.items():
            value = found.get(entry)
            row[name] = None if value is None else 1e3 * value
        if "failed" in found:
            row["σ (mm)"] = "*could not be solved*"
        yield row | {"poses": found.get("estimated_poses")}
    if at_returns:
        yield dataset | {"problem": "noise of the sightings alone",
                         "at returns (mm)": 1e3 * at_returns["noise"]}


def differences_at_returns(drive: SolvedDrive) -> dict[str, float]:
    """Return root mean square differences of solutions from what returns measure, in m.

    By problem; "noise" is what the noise of the sightings alone gives. Sightings are those by the
    camera as it was estimated. None if the drive never returns.
    """
    returns = marker_increments.returns(replace(drive.dataset, vehicle=drive.vehicle))
    if len(returns.start) == 0:
        return {}
    variances = np.trace(returns.covariance[:, :2, :2], axis1=1, axis2=2)
    factor = drive.vehicle.marker_noise_factor or 1
    found = {"noise": factor * np.sqrt(np.mean(variances))}
    for problem, solution in drive.solutions.items():
        off = returns.discrepancies(solution.poses)[:, :2]
        known = np.isfinite(off[:, 0])
        if known.any():
            found[problem] = np.sqrt(np.mean(np.sum(off[known]**2, axis=1)))
    return found


@plt.style.context(plotting.STYLE, after_reset=True)
def trajectories(drive: SolvedDrive) -> str:
    """Return the figure of a drive's trajectories, its last map and sigmas, as SVG."""
    fig = Figure(figsize=(7.2, 3.1))  # inches
    left, right = fig.subplots(1, 2, width_ratios=(2, 3))
    for problem, solution in drive.solutions.items():
        role = PROBLEMS[problem].role
        if problem in DRAWN or solution is drive.last:
            plotting.trajectory(left, solution.poses, role, solution.title, linewidth=1.2)
        sigmas = evaluation.position_sigmas(solution.covariances)
        sigmas[:len(sigmas) // 50] = np.nan  # nearly zero, on a logarithmic axis
        known = np.flatnonzero(sigmas > 0)
        plotting.curve(right, sigmas[known], role, known, solution.title)
    if drive.last.aruco_map is not None:
        left.plot(*drive.last.aruco_map[1].T[:2], label="markers",
                  **plotting.ROLES["marker"] | {"markersize": 1.5})
    if drive.last.uwb_map is not None:
        plotting.draw_antennas(left, *drive.last.uwb_map[1:])
    if drive.truth is not None:
        plotting.trajectory(left, drive.truth.poses, "truth")
    right.set(xlabel="pose id", yscale="log", ylabel="σ of position (m)")
    plotting.legend_below(fig)
    return print_figure(fig, "svg", metadata={"Date": None})
