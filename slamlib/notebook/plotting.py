"""Draws trajectories, covariance ellipses and curves over poses, with one style for each role.

Functions with an argument `ax` or `axes` draw on these matplotlib axes and return them. Poses are
(n, 3) [x, y, heading] in m and rad, NaN without an estimate; covariances are (n, 3, 3) of the same.
`role` is a key of ROLES, which gives the style; further arguments **look change it. `label` is the
text in the legend. Ellipses state a probability: {p : (p - m)^T C^-1 (p - m) <= k^2} contains a
planar Gaussian with probability 1 - exp(-k^2 / 2), so that 95 % needs k = 2.4477.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from matplotlib_inline.backend_inline import set_matplotlib_formats

from slamlib.core import se2
from slamlib.core.evaluation import REACH_95


def _line(color, width, dashes=None):
    """The look of a path; `dashes` are the lengths of strokes and gaps in line widths."""
    style = (0, dashes) if dashes else "-"
    return {"color": color, "linewidth": width, "linestyle": style, "zorder": 3}


def _sign(color, marker, size, zorder):
    """The look of landmarks."""
    return {"color": color, "linestyle": "none", "marker": marker, "markersize": size,
            "zorder": zorder}


# Colours of Okabe and Ito and of Tol, distinct for the colour-blind; line styles differ in grey.
ROLES = {
    "truth": _line("black", 1.1, (4, 2)),
    "odometry": _line("#D55E00", 1.5),
    "aruco": _line("#CC79A7", 1.7, (1.2, 0.8)),
    "fused": _line("#009E73", 1.8, (4.5, 1.6)),
    "hint": _line("#E69F00", 1.5, (5, 1, 1, 1)),
    "marker": _sign("#333333", "s", 3, zorder=3),
    "slam": _line("#0072B2", 2.0),
    "slam_uwb": _line("#56B4E9", 2.2, (6, 1.5)),
    "antenna": _sign("#222222", "^", 6, zorder=5),
    "guess": _sign("#222222", "^", 7, zorder=4) | {"markerfacecolor": "none"},
    "true place": _sign("black", "+", 5, zorder=6),
}
STYLE = Path(__file__).with_name("slamlib.mplstyle")  # for matplotlib.style
MAX_SEMI_AXIS = 0.04         # of enlarged 95 % ellipses, in the larger extent of the path
MAX_BANDS = 800              # poses at which errors are drawn
LABEL_WIDTH = 1.8            # inches, of a label in a legend


class Estimates(NamedTuple):
    """What a solver estimated, and the truth in the same world frame, where it is known."""

    frame: np.ndarray            # (m,) indices of the poses that have an estimate
    poses: np.ndarray            # (m, 3)
    covariances: np.ndarray      # (m, 3, 3)
    true: np.ndarray | None      # (m, 3) poses


def use_style() -> None:
    """Set the style of a notebook's figures."""
    plt.style.use(STYLE)
    set_matplotlib_formats("svg", metadata={"Date": None})


def each_drive(drives: Iterable, rows: int = 1, height: float = 3.4, width: float = 3.7,
               columns: int = 2) -> Iterator[tuple]:
    """Yield each Drive with its axes, or with `rows` axes as a list; a legend ends the figure.

    `drives` (iterable of Drive or of names, such as a dict by Drive) are the panels, `columns` side
    by side, with their names as titles; height and width of one in inches. Without any there is no
    figure.
    """
    drives = list(drives)
    if not drives:
        return
    columns = min(columns, len(drives))
    lines = math.ceil(len(drives) / columns)
    fig = plt.figure(figsize=(max(width * columns, 5.0), height * lines))
    parts = fig.subfigures(lines, columns, squeeze=False)
    for drive, part in zip(drives, parts.flat):
        axes = part.subplots(rows, squeeze=False)[:, 0]
        axes[0].set_title(getattr(drive, "name", drive))
        yield drive, axes if rows > 1 else axes[0]
    legend_below(fig)


def estimates(result, drive) -> Estimates:
    """The Estimates of a Drive: the poses that a result has, and the truth of these poses.

    `result` is (poses, covariances), or has these attributes: a Solution, Localization, Fusion or
    SlamResult. The truth, None where the Drive has none, is in the frame of the first of the poses,
    in which the result is.
    """
    if isinstance(result, tuple):
        poses, covariances = result
    else:
        poses = result.poses
        covariances = result.covariances
    known = np.isfinite(poses[:, 0])
    frame = getattr(result, "frame", np.arange(len(poses)))[known]
    true = None
    if drive.truth is not None:
        true = drive.truth.poses[frame]
        true = se2.between(true[0], true)
    return Estimates(frame, poses[known], covariances[known], true)


def with_ellipses(ax: Axes, poses: np.ndarray, covariances: np.ndarray, role: str,
                  label: str, enlarged: float, count: int = 12) -> Axes:
    """Draw a path with at most `count` filled 95 % ellipses, enlarged as a title says."""
    some = evenly(poses, count)
    color = ROLES[role]["color"]
    trajectory(ax, poses, role, label, linewidth=1.2, alpha=0.8)
    ellipses(ax, poses[some], covariances[some], color, fill=0.5, enlarged=enlarged)
    ax.set_title(f"95 % ellipses × {enlarged}", loc="right", fontweight="normal")
    return ax


def errors(axes: Sequence[Axes], result, drive, role: str = "slam", label: str = ""
           ) -> Sequence[Axes]:
    """Draw errors of a result along the path: of position, and in a second one of axes of heading.

    The bands are the longest semi-axis of the 95 % ellipse and ±2 sigma of the heading; without
    truth they stand alone. `result` as of `estimates`. `label` goes before the texts in the legend.
    """
    found = estimates(result, drive)
    some = slice(None, None, 1 + len(found.frame) // MAX_BANDS)
    frame = found.frame[some]
    C = found.covariances[some]
    two_sigma = 2 * np.sqrt(C[:, 2, 2])
    for ax, name, unit, low, high in zip(axes, ("position", "δ"), ("m", "rad"), (0, -two_sigma),
                                         (longest_semi_axes(C), two_sigma)):
        ax.fill_between(frame + 1, low, high, color=ROLES[role]["color"], alpha=0.18, linewidth=0,
                        label=f"{label} 95 % by the covariance".strip())
        ax.set_ylabel(name)
        ax.yaxis.set_major_formatter(EngFormatter(unit))
        ax.locator_params("y", nbins=3)
    if found.true is not None:
        error = se2.difference(found.poses, found.true)[some]
        distance = np.hypot(error[:, 0], error[:, 1])
        for ax, values in zip(axes, (distance, error[:, 2])):
            curve(ax, values, role, frame, f"{label} error".strip(), linewidth=1.0)
    axes[0].set_ylim(0, None)
    axes[-1].set(xlabel="pose id")
    return axes


def own_axes(ax: Axes, covariance: np.ndarray, points: np.ndarray, **look) -> Axes:
    """Draw the 95 % ellipse of a covariance (>= 2, >= 2) by odometry along its own axes.

    Each axis has its own scale, so that a needle becomes an ellipse. Crosses are `points`
    (m, >= 2) relative to its centre, in m, in the axes of the covariance.
    """
    variances, directions = np.linalg.eigh(covariance[:2, :2])
    in_own_axes = np.diag(variances[::-1])                               # along, across
    places = points[:, :2] @ directions[:, ::-1]
    ellipses(ax, np.zeros((1, 2)), in_own_axes[None], ROLES["odometry"]["color"])
    ax.plot(places[:, 0], places[:, 1], **ROLES["true place"] | look)
    ax.set(xlabel="along the ellipse", ylabel="across")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(EngFormatter("m"))
    return ax


def trajectory(ax: Axes, poses: np.ndarray, role: str, label: str | None = None, **look) -> Axes:
    """Draw the path of poses (n, >= 2) with a dot at its start and equal axes."""
    line, = ax.plot(poses[:, 0], poses[:, 1], label=label or role, **ROLES[role] | look)
    known = np.isfinite(poses[:, 0])
    x, y = poses[known][0, :2]
    ax.plot(x, y, "o", color=line.get_color(), markersize=4)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    return ax


def ellipses(ax: Axes, positions: np.ndarray, covariances: np.ndarray, color: str,
             fill: float = 0.3, enlarged: float = 1) -> Axes:
    """Draw 95 % ellipses at positions (m, >= 2) with covariances (m, >= 2, >= 2).

    `fill` is the opacity. The ellipses are `enlarged` by this factor, which the figure must state.
    """
    variances, directions = np.linalg.eigh(covariances[:, :2, :2])
    half_axes = REACH_95 * enlarged * np.sqrt(np.maximum(variances, 0))
    angle = np.pi * np.arange(40) / 20
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outlines = positions[:, :2, None] + directions * half_axes[:, None] @ circle
    ax.add_collection(PolyCollection(outlines.mT, facecolors=(color, fill), edgecolors="#333333",
                                     linewidths=0.5, zorder=3.5))
    ax.autoscale_view()
    return ax


def draw_antennas(ax: Axes, positions: np.ndarray, covariances: np.ndarray,
                  enlarged: float) -> Axes:
    """Draw antennas (a, 2) with 95 % ellipses, which are `enlarged` as those of `ellipses`."""
    ellipses(ax, positions, covariances, "#44AA99", enlarged=enlarged)
    return landmarks(ax, positions, "antenna", "antennas: estimate")


def landmarks(ax: Axes, places: np.ndarray, role: str, label: str, **look) -> Axes:
    """Draw the signs of landmarks at places (k, >= 2)."""
    if len(places):
        ax.plot(places[:, 0], places[:, 1], label=label, **ROLES[role] | look)
    return ax


def places_by_id(ids: np.ndarray, places: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Places (m, c) of the wanted ids (m,) out of ids (k,) with places (k, c), NaN if missing."""
    return pd.DataFrame(places, index=ids).reindex(wanted).to_numpy()


def longest_semi_axes(covariances: np.ndarray) -> np.ndarray:
    """The longest semi-axis (m,) in m of each 95 % ellipse, of covariances (m, >= 2, >= 2)."""
    variances = np.linalg.eigvalsh(covariances[:, :2, :2])
    return REACH_95 * np.sqrt(np.maximum(variances[:, 1], 0))


def enlargement(poses: np.ndarray, covariances: np.ndarray) -> int:
    """The factor of one digit with which the largest 95 % ellipse has MAX_SEMI_AXIS, at least 1."""
    extent = np.ptp(poses[:, :2], axis=0).max()
    largest = longest_semi_axes(covariances).max()
    factor = MAX_SEMI_AXIS * extent / largest
    return max(1, int(float(f"{factor:.0e}")))


def evenly(poses: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most `count` known poses at equal intervals, the last one included."""
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    step = 1 + len(known) // count
    return known[::-step]


def legend_entries(fig: Figure) -> dict:
    """What a legend of a figure shows by its label, each once."""
    return {label: handle for ax in fig.axes
            for handle, label in zip(*ax.get_legend_handles_labels())}


def legend_below(fig: Figure) -> None:
    """Draw one legend below all axes of a figure: each label once."""
    entries = legend_entries(fig)
    fig.legend(entries.values(), entries.keys(), loc="outside lower center",
               ncols=int(fig.get_figwidth() / LABEL_WIDTH))


def curve(ax: Axes, values: np.ndarray, role: str, frame: np.ndarray, label: str | None = None,
          **look) -> Axes:
    """Draw values (n,) over the pose id; `frame` (n,) are the indices from 0 of their poses."""
    ax.plot(frame + 1, values, label=label or role, **ROLES[role] | look)
    return ax
