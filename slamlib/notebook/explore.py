"""Figures with sliders in JupyterLab; pages have buttons between figures for a few values.

A function draws a figure of the sliders' values. Those of chapters 3 and 4 are here.
"""

from dataclasses import replace
from functools import lru_cache
from html import escape

import gtsam
import matplotlib.pyplot as plt
import numpy as np
from IPython.core.pylabtools import print_figure
from IPython.display import display
from ipywidgets import Box, Dropdown, FloatSlider, IntSlider, Layout, VBox, interactive_output

from slamlib import evaluation
from slamlib.increments import TYPICAL_SLIP
from slamlib.notebook import plotting
from slamlib.notebook.drives import interactive
from slamlib.simulation import misguess, simulate
from slamlib.slam.graph import optimize
from slamlib.slam.initialization import odometry_state, trilaterated_antennas
from slamlib.slam.linear import build_problem
from slamlib.slam.measurements import AcceptedMeasurements, measure, with_known_noise
from slamlib.slam.pipeline import fit_from_odometry
from slamlib.slam.result import slam_result
from slamlib.solve import UNSOLVABLE
from slamlib.studies.kernels import rounds, solve_with
from slamlib.studies.starts import LANDMARKS, guessed_antennas

# Scales of the Cauchy kernel in standard deviations, by name.
KERNEL_SCALES = {f"{scale} σ": scale for scale in (1, 3, 10, 30, 100)} | {"none": None}
WIDE = Layout(width="31em")              # of a slider with its label


def slider(label, start, low, high, step=1):
    """A slider from `low` to `high`, of integers if all arguments are integers, else of floats."""
    whole = all(isinstance(number, int) for number in (start, low, high, step))
    return (IntSlider if whole else FloatSlider)(
        start, min=low, max=high, step=step, description=label, continuous_update=False,
        layout=WIDE, style={"description_width": "12em"})


def choice(label, options, start):
    """A drop-down list of names (str), of which `start` is chosen first."""
    return Dropdown(options=list(options), value=start, description=label, layout=WIDE,
                    style={"description_width": "12em"})


def show_with_controls(draw, grid=None, **controls):
    """Show the figure of draw(**values), in JupyterLab with controls of the values.

    Parameters
    ----------
    draw : function of the controls' values, by name, that returns a figure.
    grid : dict by name of the values (list) that the report's pages offer of some controls.
    controls : widgets with a value, as of `slider` and `choice`.
    """
    if interactive():
        row = Box([*controls.values()], layout=Layout(flex_flow="row wrap"))
        display(VBox([row, interactive_output(_shown(draw), controls)]))
    else:
        display({"text/html": states(draw, controls, grid or {})}, raw=True)


def _shown(draw):
    """A function that shows the figure of draw(**values), or why there is none."""
    def show(**values):
        try:
            fig = draw(**values)
        except UNSOLVABLE as error:
            return print("There is no solution with these values:", error)
        display(fig)
        plt.close(fig)
    return show


def states(draw, controls, grid):
    """HTML (str) of the figures for each value of `grid`, with all other controls as they are."""
    start, parts = {name: control.value for name, control in controls.items()}, []
    chosen = {"first values": start} | {
        f"{controls[name].description} {value}": start | {name: value}
        for name, values in grid.items() for value in values if value != start[name]}
    for number, (label, values) in enumerate(chosen.items()):
        fig, group = draw(**values), "-".join(grid)
        parts.append(f'<input type="radio" name="{group}" id="{group}-{number}"'
                     f'{" checked" * (number == 0)}><label for="{group}-{number}">{escape(label)}'
                     f'</label><div><img alt="{escape(label)}" '
                     f'src="data:image/png;base64,{print_figure(fig, base64=True)}"></div>')
        plt.close(fig)
    return f'<div class="states">{"".join(parts)}</div>'


def draw_graphs(seed, slip, assumed, wrong, kernel, start):
    """Chapter 3: the graph solved with one Cauchy kernel, and with kernels that narrow. The figure.

    `slip` and `assumed` in mm after 1 m are of the simulated drive and of the graph, `wrong` is the
    percentage of wrong labels; `kernel` of KERNEL_SCALES and `start` of starts.LANDMARKS are those
    of the single kernel.
    """
    truth, m, solved = _solved_with_markers(seed, slip, assumed, wrong)
    scale = KERNEL_SCALES[kernel]
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(scale) if scale else None
    problem = replace(build_problem(m, "arc"),
                      accepted=AcceptedMeasurements(
                          measurements=m, weight=m.unit_weights, sighting_kernel=cauchy))
    single = optimize(problem, odometry_state(m, "arc", markers=LANDMARKS[start])).state
    places = truth.marker_in_world[:, :2]
    fig, plan, side = _figure(truth, {
        "alternative": ("single kernel", single.poses, m.frame, places[np.searchsorted(
            truth.marker, m.marker)], single.markers),
        "slam": ("rounds of kernels", solved.poses, slice(None), places[np.searchsorted(
            truth.marker, solved.marker)], solved.marker_in_world)})
    plan.plot(*places.T, **plotting.ROLES["marker"], label="true markers")
    low, high = places.min(0) - 0.5, places.max(0) + 0.5
    plan.set_aspect("equal", adjustable="box")          # markers far from the map are cut off
    plan.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    plan.set_title(f"{len(solved.rejected)} sightings")
    side.set_title(f"rounds: {np.count_nonzero(solved.rejected)} rejected"
                   + _nees_text(solved, truth))
    plotting.legend_below(fig)
    return fig


@lru_cache(maxsize=8)
def _solved_with_markers(seed, slip, assumed, wrong):
    """Truth, Measurements, and SlamResult by rounds of kernels, of the values of `draw_graphs`."""
    dataset, truth = simulate("short", seed, slip=1e-3 * slip, mislabelled=wrong / 100)
    m = measure(with_known_noise(dataset.without("uwb"), 1e-3 * assumed, 1.0, 1.0))
    return truth, m, slam_result(fit_from_odometry(m, "arc"))


def draw_ranges(seed, late, off, part, range_kernel):
    """Chapter 4: ranges and odometry, by one kernel from the guess, and by the default. The figure.

    `late` and `part` are percentages, of ranges that are too long and of the first poses, which are
    used. `off` in m is the error of the guesses, `range_kernel` a name in kernels.RANGE_METHODS.
    """
    chosen, solved = (_solved_with_ranges(seed, late, off, part, *way) for way in (
        (range_kernel, guessed_antennas), ("asymmetric Tukey", trilaterated_antennas)))
    truth, m, solved = solved
    fig, plan, side = _figure(truth, {
        role: (name, found.poses, slice(None), m.guess, found.antenna_in_world)
        for role, name, found in (("alternative", "chosen kernel", chosen[2]),
                                  ("slam", "solver", solved))})
    places = truth.antenna_in_world[np.searchsorted(truth.antenna, m.antenna)]
    plan.plot(*m.guess.T, label="antennas: guess", **plotting.ROLES["guess"])
    plan.plot(*places.T, label="antennas: truth", **plotting.ROLES["true antenna"])
    miss = np.hypot(*(solved.antenna_in_world - places).T)
    plan.set_title(f"antennas within {miss.max():.2f} m")
    side.set_title(f"{len(solved.doubts)} in doubt" + _nees_text(solved, truth))
    plotting.legend_below(fig)
    return fig


@lru_cache(maxsize=16)
def _solved_with_ranges(seed, late, off, part, range_kernel, antennas):
    """Truth, Measurements and SlamResult of the values of `draw_ranges` and a start of antennas."""
    dataset, truth = simulate("short", seed, late_ranges=late / 100)
    count = -(-len(dataset.ticks) * part // 100)
    dataset = misguess(dataset.without("aruco"), truth.antenna_in_world, off, seed).first(count)
    m = measure(with_known_noise(dataset, TYPICAL_SLIP, 1.0, 1.0))
    return (replace(truth, poses=truth.poses[:count]), m,
            slam_result(solve_with(m, rounds(m, antennas), ranges=range_kernel)))


def _figure(truth, results):
    """A figure of results by role, its axes of the plan, and those of the errors in mm.

    A result has a name, poses (f, 3), their indices (f,), and places (m, 2) from which lines lead
    to where its landmarks (m, >= 2) are.
    """
    fig, ((plan,), (side,)) = plotting.panels(2, height=3.6)
    plotting.trajectory(plan, truth.poses, "truth")
    for role, (name, poses, frame, places, found) in results.items():
        plotting.trajectory(plan, poses, role, name)
        error = 1e3 * np.hypot(*(poses - truth.poses[frame])[:, :2].T)
        plotting.curve(side, error, role, np.arange(len(truth.poses))[frame], name)
        plan.plot(*np.stack([places, found[:, :2]]).transpose(2, 0, 1), linewidth=1.2,
                  color=plotting.ROLES[role]["color"])
    side.set(yscale="log", ylabel="position error (mm)", ylim=(1, None))
    side.yaxis.set_major_formatter("{x:g}")
    return fig, plan, side


def _nees_text(found, truth):
    return f", NEES {evaluation.anees(found.poses, found.covariances, truth.poses):.1f}"
