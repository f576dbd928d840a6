"""The overview that opens the report: its text, the table of all results, and pictures.

The text is in the template overview.md. All numbers are those of the results of this build: their
files and `summary.json`.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.core.pylabtools import print_figure
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from nbformat import NotebookNode
from nbformat.v4 import new_markdown_cell, new_notebook

from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import read_vehicle
from slamlib.io.results import FIELDS, read_structs, read_summary
from slamlib.notebook import Drive, plotting, table
from slamlib.notebook.drives import plain, without_stand_ins
from slamlib.report.document import address
from slamlib.report.notebooks import rendered
from slamlib.report.returns import find_returns
from slamlib.solve import PROBLEMS, SENSORS, VEHICLE_ESTIMATED, Solution

# Columns of the table of results, in thousandths of these entries of a summary.
COLUMNS = {"ATE (mm)": "ate_m", "aligned (mm)": "ate_aligned_m", "at returns (mm)": "at_returns_m",
           "σ (mm)": "median_sigma_m", "σ of δ (mrad)": "median_sigma_heading_rad"}


@dataclass(frozen=True, eq=False)
class SolvedDrive(Drive):
    """A Drive with the results that this build computed for it."""

    solutions: list[Solution]  # of the problems that are solved, in order
    summary: dict = field(repr=False)  # as summary.json has it
    vehicle: Vehicle  # as estimated


def solved_drive(drive: Drive, results: Path) -> SolvedDrive:
    """Return a Drive with what is in its folder of results."""
    summary = read_summary(results)
    solutions = []
    for problem, row in summary["problems"].items():
        if "failed" not in row:
            found = {name: read_structs(results / problem, name) for name in FIELDS
                     if (results / problem / f"{name}.mat").exists()}
            _, poses, covariances = found.pop("vehiclePose")
            solutions.append(Solution(problem, poses, covariances, found))
    estimated = results / VEHICLE_ESTIMATED
    vehicle = read_vehicle(estimated if estimated.exists() else None, drive.dataset.vehicle)
    return SolvedDrive(drive.name, drive.dataset, drive.truth, solutions, summary, vehicle)


def opening(drives: list[SolvedDrive]) -> NotebookNode:
    """Return the opening of the report, an executed notebook, of drives as `read_drives` sorts."""
    solved = [drive for drive in drives if drive.solutions]
    longest = without_stand_ins(solved)[-1] if solved else None
    drawn = pictures(longest) if longest else ""
    rows = [row for drive in drives for row in result_rows(drive)]
    text = rendered(
        "overview.md", drives=drives, longest=longest, plain=plain, sensors=SENSORS,
        picture=address("image/svg+xml", drawn), results=table(rows).data)
    return new_notebook(cells=[new_markdown_cell(text)])


def result_rows(drive: SolvedDrive) -> Iterator[dict]:
    """Return the rows of a drive in the table of results, for `notebook.table`.

    Without truth they have what it differs by from returns, and what noise alone would.
    """
    dataset = {"dataset": plain(drive.name)}
    at_returns = {}
    if drive.truth is None and drive.dataset.aruco is not None:
        at_returns = differences_at_returns(drive)
    for problem, found in drive.summary["problems"].items():
        number = problem.removeprefix("problem")[0]
        row = dataset | {"problem": f"{number}. {found['title']}"}
        found = found | {"at_returns_m": at_returns.get(problem, np.nan)}
        for name, entry in COLUMNS.items():
            row[name] = 1e3 * found.get(entry, np.nan)
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
    returns = find_returns(replace(drive.dataset, vehicle=drive.vehicle))
    if len(returns.start) == 0:
        return {}
    variances = np.trace(returns.covariance[:, :2, :2], axis1=1, axis2=2)
    factor = drive.vehicle.marker_noise_factor or 1
    found = {"noise": factor * np.sqrt(np.mean(variances))}
    for solution in drive.solutions:
        off = returns.discrepancies(solution.poses)[:, :2]
        known = np.isfinite(off[:, 0])
        if known.any():
            found[solution.problem] = np.sqrt(np.mean(np.sum(off[known]**2, axis=1)))
    return found


@plt.style.context(plotting.STYLE, after_reset=True)
def pictures(drive: SolvedDrive) -> str:
    """Return the figure of a drive's last map and of the errors of all its problems, as SVG."""
    fig = Figure(figsize=(7.2, 2.9))  # inches
    left, right = fig.subfigures(1, 2, width_ratios=(2, 3.4))
    draw_map(left.subplots(), drive.solutions[-1])
    columns = min(3, len(drive.solutions))
    lines = math.ceil(len(drive.solutions) / columns)
    panels = right.subplots(lines, columns, squeeze=False, sharex=True)
    for ax, solution in zip(panels.flat, drive.solutions):
        title, _, role = PROBLEMS[solution.problem]
        plotting.errors([ax], solution, drive, role)
        number = solution.problem.removeprefix("problem")[0]
        ax.set_title(f"{number}. {title}", fontsize=7.5, fontweight="normal")
        ax.set(xlabel="", ylabel="")
    for ax in panels.flat[len(drive.solutions):]:
        ax.remove()
    right.supxlabel("pose id", fontsize=9)
    plotting.legend_below(fig)
    return print_figure(fig, "svg", metadata={"Date": None})


def draw_map(ax: Axes, solution: Solution) -> None:
    """Draw the trajectory of a Solution, and the landmarks that it has."""
    for name, role, size in (("ArucoMap", "marker", 1.5), ("UwbMap", "antenna", 5)):
        if name in solution.maps:
            places = solution.maps[name][1]
            plotting.landmarks(ax, places, role, f"{role}s", markersize=size)
    _, _, role = PROBLEMS[solution.problem]
    plotting.trajectory(ax, solution.poses, role, "vehicle", linewidth=1.2, linestyle="-")
