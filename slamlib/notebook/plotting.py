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
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib_inline.backend_inline import set_matplotlib_formats

from slamlib.core import se2
from slamlib.core.evaluation import REACH_95
from slamlib.core.odometry import cumulative


def _line(color, width, dashes=None, zorder=3):
    """The look of a path; `dashes` are the lengths of strokes and gaps in line widths."""
    style = (0, dashes) if dashes else "-"
    return {"color": color, "linewidth": width, "linestyle": style, "zorder": zorder}


def _sign(color, marker, size, zorder):
    """The look of landmarks."""
    return {"color": color, "linestyle": "none", "marker": marker, "markersize": size,
            "zorder": zorder}


# Colours of Okabe and Ito and of Tol, distinct for the colour-blind; line styles differ in grey.
ROLES = {
    "truth": _line("black", 1.1, (4, 2), zorder=4),
    "odometry": _line("#D55E00", 1.5),
    "exact": _line("#332288", 1.5),
    "sample": _line("#999999", 1.0, zorder=1),
    "aruco": _line("#CC79A7", 1.7, (1.2, 0.8)),
    "fused": _line("#009E73", 1.8, (4.5, 1.6)),
    "hint": _line("#E69F00", 1.5, (5, 1, 1, 1)),
    "marker": _sign("#333333", "s", 3, zorder=3),
    "slam": _line("#0072B2", 2.0),
    "slam_uwb": _line("#56B4E9", 2.2, (6, 1.5), zorder=3.2),
    "arc": _line("#333333", 1.7),
    "euler": _line("#888888", 1.7, (3, 1.5)),
    "alternative": _line("#882255", 1.5, (5, 1, 1, 1)),
    "antenna": _sign("#222222", "^", 6, zorder=5),
    "guess": _sign("#222222", "^", 7, zorder=4) | {"markerfacecolor": "none"},
    "true antenna": _sign("black", "+", 9, zorder=6),
    "true marker": _sign("black", "+", 4.5, zorder=5) | {"markeredgewidth": 0.6},
}
STYLE = Path(__file__).with_name("slamlib.mplstyle")  # for matplotlib.style
MAX_SEMI_AXIS = 0.08         # of enlarged 95 % ellipses, in the larger extent of the path
MAX_BANDS = 800              # poses at which the bands of errors are drawn


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


def panels(count: int, rows: int = 1, height: float = 3.4, width: float = 3.7,
           columns: int = 2) -> tuple[Figure, np.ndarray]:
    """A figure and its axes (count, rows): `columns` panels side by side, sizes in inches each."""
    columns = min(columns, count)
    lines = math.ceil(count / columns)
    fig = plt.figure(figsize=(max(width * columns, 5.0), height * lines))
    grid = fig.subplots(lines * rows, columns, squeeze=False)
    axes = grid.reshape(lines, rows, columns).swapaxes(1, 2).reshape(-1, rows)
    for ax in axes[count:].flat:
        ax.remove()
    return fig, axes[:count]


def each_drive(drives: Iterable, rows: int = 1, **size) -> Iterator[tuple]:
    """Yield each Drive with its axes, or with `rows` axes as a list; a legend ends the figure.

    `drives` (iterable of Drive or of names, such as a dict by Drive) are the panels, with their
    names as titles; `size` as of `panels`. Without a drive the figure has one empty panel.
    """
    drives = list(drives)
    fig, axes = panels(max(1, len(drives)), rows, **size)
    for drive, column in zip(drives, axes):
        column[0].set_title(getattr(drive, "name", drive))
        yield drive, column if rows > 1 else column[0]
    legend_below(fig)


def estimates(result, drive) -> Estimates:
    """The Estimates of a Drive: the poses that a result has, and the truth of these poses.

    `result` is (poses, covariances), or has these attributes: a Solution, Localization, Fusion or
    SlamResult. The truth, None where the Drive has none, is in the world frame of the result.
    """
    poses, covariances = result if isinstance(result, tuple) else (result.poses, result.covariances)
    known = np.isfinite(poses[:, 0])
    if hasattr(result, "frame"):
        frame = result.frame[known]
        world = frame[0]                     # index of the pose in whose frame the result is
    else:
        frame = np.flatnonzero(known)
        world = getattr(result, "world", 0)
    true = None
    if drive.truth is not None:
        true = drive.truth.poses
        if world:
            true = se2.between(true[world], true)
        true = true[frame]
    return Estimates(frame, poses[known], covariances[known], true)


def with_ellipses(ax: Axes, poses: np.ndarray, covariances: np.ndarray, role: str,
                  label: str | None = None, enlarged: float | None = None,
                  count: int = 12) -> Axes:
    """Draw a path with `count` filled 95 % ellipses, at equal distances along it.

    Ellipses are `enlarged` by this factor, by default by that of `enlargement`, which is added to
    the axes' title.
    """
    enlarged = enlarged or enlargement(poses, covariances)
    some = equidistant(poses, count)
    trajectory(ax, poses, role, label, linewidth=1.2, alpha=0.8)
    ellipses(ax, poses[some], covariances[some], ROLES[role]["color"], fill=0.5, enlarged=enlarged)
    title = ax.get_title("left")
    if "ellipses" not in title:
        factor = f" × {enlarged}" if enlarged > 1 else ""
        ax.set_title(f"{title} (95 % ellipses{factor})")
    return ax


def errors(axes: Sequence[Axes], result, drive, role: str = "slam") -> Sequence[Axes]:
    """Draw errors of a result along the path in two axes: of position, and of the heading.

    The bands are the longest semi-axis of the 95 % ellipse and ±2 sigma of the heading; without
    truth they stand alone. `result` as of `estimates`.
    """
    top, bottom = axes
    found = estimates(result, drive)
    shown = evenly(np.arange(len(found.frame)), MAX_BANDS)
    frame = found.frame[shown]
    covariances = found.covariances[shown]
    semi_axis = 1e3 * longest_semi_axes(covariances)                     # mm
    two_sigma = 2e3 * np.sqrt(covariances[:, 2, 2])                      # mrad
    band = {"color": ROLES[role]["color"], "alpha": 0.18, "linewidth": 0,
            "label": "95 % by the covariance"}
    top.fill_between(frame + 1, 0, semi_axis, **band)
    bottom.fill_between(frame + 1, -two_sigma, two_sigma, **band)
    if found.true is not None:
        error = 1e3 * se2.difference(found.poses, found.true)[shown]
        distance = np.linalg.norm(error[:, :2], axis=1)
        curve(top, distance, role, frame, "error", linewidth=1.2)
        curve(bottom, error[:, 2], role, frame, "error", linewidth=0.8)
    name_rows(axes, ("position (mm)", "δ (mrad)"))
    top.set_ylim(0, None)
    return axes


def position_error(ax: Axes, result, drive, role: str = "slam") -> Axes:
    """Draw the error of the position along the path, and the longest semi-axis of its 95 % ellipse.

    The first of the two axes of `errors`, for a result with few poses; parameters as there.
    """
    found = estimates(result, drive)
    color = ROLES[role]["color"]
    ax.fill_between(found.frame + 1, 0, 1e3 * longest_semi_axes(found.covariances), color=color,
                    alpha=0.18, linewidth=0, label="95 % by the covariance")
    if found.true is not None:
        distance = 1e3 * np.linalg.norm((found.poses - found.true)[:, :2], axis=1)
        curve(ax, distance, role, found.frame, "error", linewidth=1.2)
    ax.set(xlabel="pose id", ylabel="position (mm)", ylim=(0, None))
    return ax


def own_axes(ax: Axes, covariance: np.ndarray, role: str, dots: np.ndarray | None = None,
             cross: np.ndarray | None = None) -> Axes:
    """Draw the 95 % ellipse of a covariance (>= 2, >= 2) about zero along its own axes, in mm.

    Each axis has its own scale, so that a needle becomes an ellipse. `dots` (m, >= 2) and `cross`
    (>= 2,) are positions relative to its centre in m, in the axes of the covariance: random draws,
    and the truth.
    """
    variances, directions = np.linalg.eigh(covariance[:2, :2])
    short, long = 1e3 * REACH_95 * np.sqrt(np.maximum(variances, 0))
    angle = np.linspace(0, 2 * np.pi, 200)
    color = ROLES[role]["color"]
    ax.fill(long * np.cos(angle), short * np.sin(angle), facecolor=(color, 0.3), edgecolor=color,
            label="95 % ellipse")
    if dots is not None:
        y, x = 1e3 * (dots[:, :2] @ directions).T
        ax.plot(x, y, ".", color="#555555", markersize=2.5, zorder=1)
    if cross is not None:
        y, x = 1e3 * (cross[:2] @ directions)
        ax.plot(x, y, label="truth", **ROLES["true antenna"])
    ax.set(xlabel="along the ellipse (mm)", ylabel="across (mm)")
    ax.locator_params(nbins=5)
    return ax


def shade_gaps(axes: Sequence[Axes], frame: np.ndarray) -> Sequence[Axes]:
    """Cover what is drawn between estimated poses that are far apart, as grey.

    `frame` (m,) are their indices from 0, ascending. A gap is five times as long as usual.
    """
    steps = np.diff(frame)
    if len(steps):
        for k in np.flatnonzero(steps > 5 * np.median(steps)):
            for ax in axes:
                ax.axvspan(frame[k] + 1, frame[k + 1] + 1, color="#eeeeee", zorder=3.5)
    return axes


def trajectory(ax: Axes, poses: np.ndarray, role: str, label: str | None = None, **look) -> Axes:
    """Draw the path of poses (n, >= 2) with a dot at its start and equal axes."""
    line, = ax.plot(poses[:, 0], poses[:, 1], label=label or role, **ROLES[role] | look)
    known = np.isfinite(poses[:, 0])
    start = poses[known][:1]
    ax.plot(start[:, 0], start[:, 1], "o", color=line.get_color(), markersize=4)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    return ax


def ellipses(ax: Axes, positions: np.ndarray, covariances: np.ndarray, color: str,
             fill: float = 0.3, enlarged: float | np.ndarray = 1) -> Axes:
    """Draw 95 % ellipses at positions (m, >= 2) with covariances (m, >= 2, >= 2).

    `fill` is the opacity. `enlarged`, a number or (m,), scales the ellipses, which the figure must
    state. The axes are extended to contain them.
    """
    k = REACH_95 * np.reshape(enlarged, (-1, 1))
    centre = positions[:, :2]
    C = covariances[:, :2, :2]
    variances, directions = np.linalg.eigh(C)
    widths = 2 * k * np.sqrt(np.maximum(variances, 0))
    longest = directions[:, :, 1]
    angles = np.degrees(np.arctan2(longest[:, 1], longest[:, 0]))
    edge = 0.6 * np.array(to_rgb(color))                  # darker than the path below them
    ax.add_collection(EllipseCollection(
        widths[:, 1], widths[:, 0], angles, units="xy", offsets=centre,
        offset_transform=ax.transData, facecolors=(color, fill), edgecolors=edge, linewidths=0.9,
        zorder=3.5))
    reach = k * se2.sigmas(C)
    ax.update_datalim(np.concatenate([centre - reach, centre + reach]))
    ax.autoscale_view()
    return ax


def draw_markers(ax: Axes, in_world: np.ndarray, covariances: np.ndarray,
                 enlarged: float = 1) -> Axes:
    """Draw markers in_world (k, 3) as squares with their 95 % ellipses."""
    ellipses(ax, in_world, covariances, ROLES["aruco"]["color"], enlarged=enlarged)
    return landmarks(ax, in_world, "marker", "markers")


def draw_antennas(ax: Axes, positions: np.ndarray, covariances: np.ndarray,
                  guess: np.ndarray | None = None, truth: np.ndarray | None = None,
                  enlarged: float | np.ndarray = 1) -> Axes:
    """Draw antennas (a, 2) with 95 % ellipses, lines from their guesses (a, 2), and truth (t, 2).

    `enlarged`, the factor on the ellipses, may be (a,).
    """
    ellipses(ax, positions, covariances, "#44AA99", enlarged=enlarged)
    if guess is not None:
        ax.plot([guess[:, 0], positions[:, 0]], [guess[:, 1], positions[:, 1]], color="#999999",
                linewidth=0.8, zorder=2)
        landmarks(ax, guess, "guess", "antennas: guess")
    landmarks(ax, positions, "antenna", "antennas: estimate")
    if truth is not None and len(truth):
        landmarks(ax, truth, "true antenna", "antennas: truth")
    return ax


def landmarks(ax: Axes, places: np.ndarray, role: str, label: str) -> Axes:
    """Draw the signs of landmarks at places (k, >= 2)."""
    ax.plot(places[:, 0], places[:, 1], label=label, **ROLES[role])
    return ax


def places_by_id(ids: np.ndarray, places: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Places (m, c) of the wanted ids (m,) out of ids (k,) with places (k, c), NaN if missing."""
    return pd.DataFrame(places, index=ids).reindex(wanted).to_numpy()


def longest_semi_axes(covariances: np.ndarray) -> np.ndarray:
    """The longest semi-axis (m,) in m of each 95 % ellipse, of covariances (m, >= 2, >= 2)."""
    variances = np.linalg.eigvalsh(covariances[:, :2, :2])
    return REACH_95 * np.sqrt(np.maximum(variances[:, 1], 0))


def enlargement(poses: np.ndarray, covariances: np.ndarray) -> int:
    """The factor with one digit with which the largest 95 % ellipse has MAX_SEMI_AXIS, or 1."""
    known = np.isfinite(poses[:, 0])
    extent = np.ptp(poses[known, :2], axis=0).max()
    largest = longest_semi_axes(covariances[known]).max()
    if MAX_SEMI_AXIS * extent < largest or largest == 0:
        return 1
    factor = int(MAX_SEMI_AXIS * extent / largest)
    digits = 10 ** (len(str(factor)) - 1)
    return factor // digits * digits


def equidistant(poses: np.ndarray, count: int) -> np.ndarray:
    """Indices of about `count` known poses at equal distances along the path."""
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    steps = np.diff(poses[known, :2], axis=0)
    travelled = cumulative(np.linalg.norm(steps, axis=1))
    wanted = np.linspace(0, travelled[-1], count + 1)[1:]
    row = np.searchsorted(travelled, wanted)
    return known[np.unique(np.minimum(row, len(known) - 1))]


def evenly(rows: np.ndarray, count: int) -> np.ndarray:
    """At most `count` of the rows (n, ...) at equal numbers of rows, the last one included."""
    if len(rows) <= count:
        return rows
    return rows[np.linspace(-1, len(rows) - 1, count + 1).astype(int)[1:]]


def name_rows(axes: Sequence[Axes], names: Sequence[str]) -> None:
    """Set the labels of the vertical axes of one panel; the last axes show the pose id."""
    for ax, name in zip(axes, names, strict=True):
        ax.set(ylabel=name, xlabel=None)
    axes[-1].set(xlabel="pose id")


def legend_below(fig: Figure) -> None:
    """Draw one legend below all axes of a figure: each label once, in as few lines as fit."""
    entries = {}
    for ax in fig.axes:
        handles, labels = ax.get_legend_handles_labels()
        for handle, label in zip(handles, labels):
            entries.setdefault(label, handle)
    for columns in (4, 3, 2, 1) if entries else ():
        fig.legends.clear()
        legend = fig.legend(entries.values(), entries.keys(), loc="outside lower center",
                            ncols=columns)
        if legend.get_window_extent().width <= fig.bbox.width:
            break


def curve(ax: Axes, values: np.ndarray, role: str, frame: np.ndarray | None = None,
          label: str | None = None, **look) -> Axes:
    """Draw values (n,) over the pose id; `frame` (n,) are the indices from 0 of their poses."""
    if frame is None:
        frame = np.arange(len(values))
    ax.plot(frame + 1, values, label=label or role, **ROLES[role] | look)
    ax.set(xlabel="pose id")
    return ax
