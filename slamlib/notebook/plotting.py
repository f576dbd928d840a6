"""Draws trajectories, covariance ellipses and curves over poses, with one style for each role.

Functions with an argument `ax` or `axes` draw on these matplotlib axes and return them. Poses are
(n, 3) [x, y, heading] in m and rad, NaN without an estimate; covariances are (n, 3, 3) of the same.
`role` is a key of ROLES, which gives the style; further arguments **look change it. `label` is the
text in the legend. Ellipses state a probability: {p : (p - m)^T C^-1 (p - m) <= k^2} contains a
planar Gaussian with probability 1 - exp(-k^2 / 2), so that 95 % needs k = 2.4477.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgb

from slamlib.core import se2
from slamlib.core.evaluation import REACH_95
from slamlib.core.odometry import cumulative


class _Roles(dict):
    def __missing__(self, role):
        raise ValueError(f"expected a role, one of {', '.join(self)}; found {role!r}")


# Colours of Okabe and Ito and of Tol, distinct for the colour-blind; line styles differ in grey.
ROLES = _Roles({
    "truth": dict(color="black", linestyle=(0, (4, 2)), linewidth=1.1, zorder=4),
    "odometry": dict(color="#D55E00", linewidth=1.5, zorder=3),
    "exact": dict(color="#332288", linewidth=1.5, zorder=3),
    "sample": dict(color="#999999", linewidth=1.0, zorder=1),
    "aruco": dict(color="#CC79A7", linestyle=(0, (1.2, 0.8)), linewidth=1.7, zorder=3),
    "fused": dict(color="#009E73", linestyle=(0, (4.5, 1.6)), linewidth=1.8, zorder=3),
    "hint": dict(color="#E69F00", linestyle=(0, (5, 1, 1, 1)), linewidth=1.5, zorder=3),
    "marker": dict(color="#333333", linestyle="none", marker="s", markersize=3, zorder=3),
    "slam": dict(color="#0072B2", linewidth=2.0, zorder=3),
    "slam_uwb": dict(color="#56B4E9", linestyle=(0, (6, 1.5)), linewidth=2.2, zorder=3.2),
    "arc": dict(color="#333333", linewidth=1.7, zorder=3),
    "euler": dict(color="#888888", linestyle=(0, (3, 1.5)), linewidth=1.7, zorder=3),
    "alternative": dict(color="#882255", linestyle=(0, (5, 1, 1, 1)), linewidth=1.5, zorder=3),
    "antenna": dict(color="#222222", linestyle="none", marker="^", markersize=6, zorder=5),
    "guess": dict(color="#222222", linestyle="none", marker="^", markersize=7, zorder=4,
                  markerfacecolor="none"),
    "true antenna": dict(color="black", linestyle="none", marker="+", markersize=9, zorder=6),
})
STYLE = Path(__file__).with_name("slamlib.mplstyle")  # for matplotlib.style
MAX_SEMI_AXIS = 0.08         # of enlarged 95 % ellipses, in the larger extent of the path


def panels(count, rows=1, height=3.4, width=3.7, columns=2):
    """A figure and its axes (count, rows): `columns` panels side by side, sizes in inches each."""
    columns = min(columns, count)
    lines = -(-count // columns)
    fig = plt.figure(figsize=(max(width * columns, 5.0), height * lines))
    grid = fig.add_gridspec(lines * rows, columns)
    return fig, np.array([[fig.add_subplot(grid[panel // columns * rows + row, panel % columns])
                           for row in range(rows)] for panel in range(count)])


def each_drive(drives, rows=1, **size):
    """Yield each Drive with its axes, or with `rows` axes as a list; a legend ends the figure.

    `drives` (iterable of Drive or of names, such as a dict by Drive) are the panels, with their
    names as titles; `size` as of `panels`. Without a drive the figure has one empty panel.
    """
    drives = list(drives)
    fig, axes = panels(max(1, len(drives)), rows, **size)
    for drive, column in zip(drives, axes, strict=False):
        column[0].set_title(getattr(drive, "name", drive))
        yield drive, column if rows > 1 else column[0]
    if any(ax.get_legend_handles_labels()[0] for ax in fig.axes):
        legend_below(fig)


def estimates(result, drive):
    """Indices (m,), poses (m, 3), covariances (m, 3, 3) and true poses of what is estimated.

    `result` is (poses, covariances), or has these attributes: a Solution, Localization, Fusion or
    SlamResult. The truth, None where the Drive has none, is in the world frame of the result.
    """
    poses, covariances = result if isinstance(result, tuple) else (result.poses, result.covariances)
    known = np.isfinite(poses[:, 0])
    frame = getattr(result, "frame", np.arange(len(poses)))[known]
    true = None if drive.truth is None else drive.truth.poses
    world = getattr(result, "world", frame[0] if hasattr(result, "frame") else 0)
    if true is not None:
        true = (se2.between(true[world], true) if world else true)[frame]
    return frame, poses[known], covariances[known], true


def with_ellipses(ax, poses, covariances, role, label=None, count=12, enlarged=None, **look):
    """Draw a path with `count` filled 95 % ellipses at equal distances along it.

    Ellipses are `enlarged` by this factor, by default by that of `enlargement`, which is added to
    the axes' title.
    """
    enlarged = enlarged or enlargement(poses, covariances)
    some = equidistant(poses, count)
    trajectory(ax, poses, role, label, **{"linewidth": 1.2, "alpha": 0.8, **look})
    ellipses(ax, poses[some], covariances[some], ROLES[role]["color"], fill=0.5, enlarged=enlarged)
    if "ellipses" not in ax.get_title("left"):
        factor = f" × {enlarged}" * (enlarged > 1)
        ax.set_title(f"{ax.get_title('left')} (95 % ellipses{factor})")
    return ax


def errors(axes, result, drive, role="slam", label=None):
    """Draw errors of a result along the path in two axes: of position, and of the heading.

    The bands are the longest semi-axis of the 95 % ellipse and ±2 sigma of the heading; without
    truth they stand alone. `result` as of `estimates`. `label`, by default the role of all but the
    first result on these axes, precedes its entries in the legend.
    """
    (top, bottom), color = axes, ROLES[role]["color"]
    of = f"{label or role}: " if label or top.collections else ""
    frame, poses, C, true = estimates(result, drive)
    some = np.unique(np.linspace(0, len(frame) - 1, 800).astype(int))
    frame, C = frame[some], C[some]
    reach = 1e3 * REACH_95 * np.sqrt(np.maximum(np.linalg.eigvalsh(C[:, :2, :2])[:, 1], 0))
    turn = 2e3 * np.sqrt(C[:, 2, 2])
    for ax, low, high in ((top, 0 * reach, reach), (bottom, -turn, turn)):
        ax.fill_between(frame + 1, low, high, color=color, alpha=0.18, linewidth=0,
                        label=f"{of}95 % by the covariance")
    if true is not None:
        off = 1e3 * (poses - true)[some]
        curve(top, np.hypot(*off[:, :2].T), role, frame, f"{of}error", linewidth=1.2)
        curve(bottom, off[:, 2], role, frame, f"{of}error", linewidth=0.8)
    name_rows(axes, ("position (mm)", "δ (mrad)"))
    top.set_ylim(0, None)
    return axes


def trajectory(ax, poses, role, label=None, **look):
    """Draw the path of poses (n, >= 2) with a dot at its start and equal axes."""
    line, = ax.plot(poses[:, 0], poses[:, 1], label=label or role, **ROLES[role] | look)
    ax.plot(*poses[np.isfinite(poses[:, 0])][:1, :2].T, "o", color=line.get_color(), markersize=4)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    return ax


def ellipses(ax, positions, covariances, color, probability=0.95, label=None, fill=0.12,
             enlarged=1):
    """Draw ellipses of a probability at positions (m, >= 2) with covariances (m, >= 2, >= 2).

    `fill` is the opacity. `enlarged`, a number or (m,), scales the ellipses, which the figure must
    state. The axes are extended to contain them.
    """
    k = np.sqrt(-2 * np.log(1 - probability)) * np.reshape(enlarged, (-1, 1))
    centre = np.asarray(positions)[:, :2]
    variances, axes = np.linalg.eigh(np.asarray(covariances)[:, :2, :2])
    widths = 2 * k * np.sqrt(np.maximum(variances, 0))
    angles = np.degrees(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))
    rgb = np.array(to_rgb(color))
    face, edge = (*rgb, fill), tuple(0.6 * rgb)           # darker than the path below them
    ax.add_collection(EllipseCollection(
        widths[:, 1], widths[:, 0], angles, units="xy", offsets=centre,
        offset_transform=ax.transData, facecolors=face, edgecolors=edge, linewidths=0.9,
        zorder=3.5))
    reach = k * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, :2])
    ax.update_datalim(np.concatenate([centre - reach, centre + reach]))
    if label:
        ax.plot([], [], "o", markersize=9, markerfacecolor=face, markeredgecolor=edge, label=label)
    ax.autoscale_view()
    return ax


def draw_markers(ax, in_world, covariances, enlarged=1):
    """Draw markers in_world (k, 3) as squares with their 95 % ellipses."""
    ellipses(ax, in_world, covariances, ROLES["aruco"]["color"], fill=0.3, enlarged=enlarged)
    ax.plot(*in_world[:, :2].T, label="markers", **ROLES["marker"])
    return ax


def draw_antennas(ax, positions, covariances, guess=None, truth=None, enlarged=1):
    """Draw antennas (a, 2) with 95 % ellipses, lines from their guesses (a, 2), and truth (t, 2).

    `enlarged`, the factor on the ellipses, may be (a,).
    """
    ellipses(ax, positions, covariances, "#44AA99", fill=0.3, enlarged=enlarged)
    if guess is not None:
        ax.plot(*np.stack([guess, positions]).transpose(2, 0, 1), color="#999999", linewidth=0.8,
                zorder=2)
        ax.plot(*guess.T, label="antennas: guess", **ROLES["guess"])
    ax.plot(*positions.T, label="antennas: estimate", **ROLES["antenna"])
    if truth is not None and len(truth):
        ax.plot(*truth.T, label="antennas: truth", **ROLES["true antenna"])
    return ax


def places_by_id(ids, places, wanted):
    """Places (m, c) of the wanted ids (m,) out of ids (k,) with places (k, c), NaN if missing."""
    return pd.DataFrame(places, index=ids).reindex(wanted).to_numpy()


def enlargement(poses, covariances):
    """The largest factor 1, 2, 5, 10, ..., 5000 on 95 % ellipses that fit MAX_SEMI_AXIS, or 1."""
    known = np.isfinite(poses[:, 0])
    limit = MAX_SEMI_AXIS * np.ptp(poses[known, :2], axis=0).max()
    largest = REACH_95 * np.sqrt(np.linalg.eigvalsh(covariances[known, :2, :2])[:, 1].max())
    factors = np.outer(10 ** np.arange(4), [1, 2, 5]).ravel()
    return int(max(factors[factors * largest <= limit], default=1)) if largest > 0 else 1


def equidistant(poses, count=14):
    """Indices of about `count` known poses at equal distances along the path."""
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    travelled = cumulative(np.hypot(*np.diff(poses[known, :2], axis=0).T))
    wanted = np.linspace(0, travelled[-1], count + 1)[1:]
    return known[np.unique(np.minimum(np.searchsorted(travelled, wanted), len(known) - 1))]


def name_rows(axes, names):
    """Set the labels of the vertical axes of one panel; the last axes show the pose id."""
    for ax, name in zip(axes, names, strict=True):
        ax.set(ylabel=name, xlabel=None)
    axes[-1].set(xlabel="pose id")


def legend_below(fig):
    """Draw one legend below all axes of a figure: each label once, in as few lines as fit."""
    entries = {}
    for ax in fig.axes:
        handles, labels = ax.get_legend_handles_labels()
        entries |= {label: handle for handle, label in zip(handles, labels, strict=True)
                    if label not in entries}
    for columns in range(4, 0, -1):
        fig.legends.clear()
        lines = -(-len(entries) // columns)
        legend = fig.legend(entries.values(), entries.keys(), loc="outside lower center",
                            ncols=-(-len(entries) // lines))
        if legend.get_window_extent().width <= fig.bbox.width:
            break


def curve(ax, values, role, frame=None, label=None, **look):
    """Draw values (n,) over the pose id; `frame` (n,) are the indices from 0 of their poses."""
    frame = np.arange(len(values)) if frame is None else frame
    ax.plot(frame + 1, values, label=label or role, **ROLES[role] | look)
    ax.set(xlabel="pose id")
    return ax


def slam_graph(ax, poses, sightings):
    """Draw a scheme of problem 3's graph: poses in a row, markers above, wheel parameters w below.

    `poses` is their number; `sightings` are pairs of a pose from 0 and a marker from 1.
    """
    markers = sorted({marker for _, marker in sightings})
    places = {f"$X_{i + 1}$": (i, 0.0) for i in range(poses)} | {"$w$": (poses / 2 - 0.5, -0.8)} | {
        f"$L_{{{marker}}}$": (x, 1.3) for marker, x in zip(
            markers, np.linspace(-0.7, poses - 0.3, len(markers) + 2)[1:-1], strict=True)}
    factors = [("aruco", f"$X_{i + 1}$", f"$L_{{{marker}}}$") for i, marker in sightings]
    factors += [("odometry", f"$X_{i}$", f"$X_{i + 1}$", "$w$") for i in range(1, poses)]
    for role, *names in factors + [("truth", "$X_1$"), ("truth", "$w$")]:
        ends = np.array([places[name] for name in names])
        middle = np.average(ends, axis=0, weights=[0.6, 0.4] if len(ends) == 2 else None) - [
            0.3 * (len(names) == 1), 0.0]         # priors stand beside; no squares at crossings
        for end in ends:
            ax.plot(*np.stack([end, middle]).T, color=ROLES[role]["color"], linewidth=0.9, zorder=1)
        ax.plot(*middle, "s", color=ROLES[role]["color"], markersize=4.5, zorder=2)
    for name, place in places.items():
        color = {"L": "#dddddd", "w": "#ffe0b0"}.get(name[1], "white")
        ax.text(*place, name, ha="center", va="center", fontsize=11, zorder=4,
                bbox=dict(boxstyle="circle,pad=0.25", facecolor=color, edgecolor="black"))
    ax.set(xlim=(-0.8, poses - 0.2), ylim=(-1.3, 1.8))
    ax.axis("off")
    return ax
