"""Pictures of the longest drive: the first figure of the report, and that of the title page."""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.core.pylabtools import print_figure
from matplotlib.figure import Figure
from nbformat.v4 import new_code_cell, new_markdown_cell, new_output

from slamlib import evaluation, se2
from slamlib.notebook import plain, plotting
from slamlib.solve import PROBLEMS

CURVE_POINTS = 1500  # of a curve, at most
HIDDEN_TRAJECTORIES = ("problem2", "problem2_hint", "problem3")  # they would lie below others
LOOKS = {"problem3": dict(linewidth=4.0), "problem4": dict(linestyle="-", linewidth=1.4)}
FIGURE_STYLE = Path(plotting.__file__).with_name("slamlib.mplstyle")


def first_figure(drive):
    """Return the cells (list of NotebookNode) of a SolvedDrive's figure and of its caption."""
    return [
        new_code_cell(outputs=[new_output("display_data", trajectories(drive))], id="picture",
                      metadata={"alt": f"The trajectories of {drive.name}, and the standard "
                                       "deviation of position along them"}),
        new_markdown_cell(
            f"Figure 1. *{plain(drive.name)}*, the longest drive. Left: its trajectory by "
            "odometry, by fusion and by the last problem"
            f"{', and the truth (dashed)' if drive.truth else ''}. Right: the standard deviation "
            "of position along the drive, for every problem, on a logarithmic axis"
            f"{'; problem 3 is the wide line' if drive.solution('problem3') else ''}.",
            id="caption")]


def trajectories(drive):
    """Return the figure of a SolvedDrive's trajectories and sigmas, as {MIME type: SVG}."""
    with plt.style.context(FIGURE_STYLE, after_reset=True):
        fig = Figure(figsize=(7.2, 2.7))  # inches
        left, right = fig.subplots(1, 2, width_ratios=(1, 1))
        for solution in drive.solutions:
            role, look = _role(solution), LOOKS.get(solution.problem, {})
            if solution.problem not in HIDDEN_TRAJECTORIES or solution is drive.solutions[-1]:
                plotting.trajectory(left, _few(_in_first_frame(drive, solution)), role,
                                    solution.title, **look)
            sigma = evaluation.position_sigmas(solution.covariances)
            known = _few(np.flatnonzero(np.isfinite(sigma) & (sigma > 0)))
            plotting.curve(right, sigma[known], role, known, solution.title, **look)
        if drive.truth is not None:
            plotting.trajectory(left, _few(drive.truth.poses), "truth")
        right.set(yscale="log", ylabel="σ of position (m)")
        right.set_ylim(bottom=_shown_from(drive))
        plotting.legend_below(fig)
        return plotting.svg_pictures(fig)


def title_picture(drive):
    """Return a SolvedDrive's last trajectory with its landmarks, without axes, as SVG (str)."""
    with plt.style.context(FIGURE_STYLE, after_reset=True):
        fig = Figure(figsize=(6.3, 4.6))  # inches
        ax = fig.add_subplot()
        solution = drive.solutions[-1]
        plotting.trajectory(ax, _few(solution.poses), _role(solution), linestyle="-", linewidth=1.2)
        if solution.aruco_map is not None:
            plotting.draw_markers(ax, *solution.aruco_map[1:])
        if solution.uwb_map is not None:
            plotting.draw_antennas(ax, *solution.uwb_map[1:])
        ax.axis("off")
        return print_figure(fig, "svg", metadata={"Date": None})


def _shown_from(drive):
    """Return two thirds of the smallest sigma in m after the first 2 % of the poses, or None."""
    sigmas = np.concatenate([
        evaluation.position_sigmas(solution.covariances)[len(solution.covariances) // 50:]
        for solution in drive.solutions])
    return sigmas[sigmas > 0].min() / 1.5 if (sigmas > 0).any() else None


def _role(solution):
    task = PROBLEMS.get(solution.problem)
    return task.role if task else "alternative"


def _in_first_frame(drive, solution):
    """Return the poses (n, 3) of a Solution in the frame of pose 1, if the last one has it."""
    last = drive.solutions[-1].poses
    if solution.world and np.isfinite(last[solution.world, 0]):
        return se2.compose(last[solution.world], solution.poses)
    return solution.poses


def _few(rows):
    """Return at most CURVE_POINTS of the rows (n, ...), first and last included."""
    if not len(rows):
        return rows
    return rows[np.unique(np.linspace(0, len(rows) - 1, CURVE_POINTS).astype(int))]
