"""Trajectories, covariance ellipses and state curves, one look for each role everywhere.

Every function draws on the `ax` it is given and returns it. Ellipses state a probability: the
region {p : (p - m)^T C^-1 (p - m) <= k^2} of a planar Gaussian holds 1 - exp(-k^2 / 2), so 95 %
needs k = 2.4477, not 2.
"""

from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.core.pylabtools import print_figure
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Annulus

from slamlib import se2

# Okabe and Ito's colours and Tol's, told apart by the colour-blind; line style and width carry grey print.
ROLES = {
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
}

# Where estimates are laid over a sample: dots below, a wide line, a narrow dashed one on top of it.
COMPARED = {
    "sample": dict(linestyle="none", marker="o", markersize=3.5, zorder=5, color="#555555"),
    "odometry": dict(linewidth=3.2, alpha=0.75),
    "exact": dict(linestyle=(0, (4, 2)), linewidth=1.5, zorder=4),
}

WIDE, NARROW = "image/svg+xml", "image/svg+xml;layout=narrow"    # what `pictures` makes
NARROW_WIDTH = 3.9                                               # inches, of a phone's column


def use_style():
    """The look of all figures, from now on in this process."""
    plt.style.use(Path(__file__).with_name("slamlib.mplstyle"))


def panels(count, rows=1, height=3.4, width=3.7, columns=2):
    """A figure with `count` panels side by side, `columns` to a line, each of `rows` axes.

    Returns the figure and an array of axes (count, rows).
    """
    columns = min(columns, count)
    lines = -(-count // columns)
    fig = plt.figure(figsize=(max(width * columns, 5.0), height * lines))
    grid = fig.add_gridspec(lines * rows, columns)
    return fig, np.array([[fig.add_subplot(grid[panel // columns * rows + row, panel % columns])
                           for row in range(rows)] for panel in range(count)])


def narrow(fig, width=NARROW_WIDTH):
    """Put a figure's axes below each other, panel by panel and as high as they were: in place."""
    axes = [ax for ax in fig.axes if ax.get_visible() and ax.get_subplotspec()]
    if not axes:
        return
    rows, _ = axes[0].get_gridspec().get_geometry()
    height = fig.get_figheight() / rows * len(axes)
    for ax, place in zip(axes, fig.add_gridspec(len(axes), 1)):
        ax.set_subplotspec(place)
        ax.autoscale_view()          # an equal aspect has stretched the limits to the wide axes
    fig.set_size_inches(width, height)
    if fig.legends:
        legend_below(fig)
        fig.set_size_inches(width, height + fig.legends[0].get_window_extent().height / fig.dpi)


def pictures(fig):
    """A figure as SVG text by MIME type: as it is, and `narrow`, as which it is left; {} if empty."""
    draw = partial(print_figure, fig, "svg", metadata={"Date": None})
    texts = {WIDE: draw()}
    narrow(fig)
    texts[NARROW] = draw()
    return texts if fig.axes else {}


def trajectory(ax, poses, role, label=None, **look):
    """The path of poses (n, 3 or 2) in metres, axes equal, with a dot where it starts."""
    look = {**ROLES[role], **look}
    line, = ax.plot(poses[:, 0], poses[:, 1], label=label or role, **look)
    ax.plot(*poses[np.isfinite(poses[:, 0])][:1, :2].T, "o", color=line.get_color(), markersize=4)
    ax.set_aspect("equal", adjustable="datalim")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    return ax


def ellipses(ax, positions, covariances, color, probability=0.95, label=None, fill=0.12, enlarged=1,
             fit=True):
    """Ellipses of the given probability around positions (m, >= 2), covariances (m, >= 2, >= 2).

    `enlarged` scales them; say so in the figure. fit=False does not widen the axes to hold them.
    """
    k = enlarged * np.sqrt(-2 * np.log(1 - probability))
    variances, axes = np.linalg.eigh(np.asarray(covariances)[:, :2, :2])
    widths = 2 * k * np.sqrt(np.maximum(variances, 0))
    angles = np.degrees(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))
    rgb = np.array(to_rgb(color))
    face, edge = (*rgb, fill), tuple(0.6 * rgb)           # darker than the path they stand on
    patches = EllipseCollection(
        widths[:, 1], widths[:, 0], angles, units="xy", offsets=np.asarray(positions)[:, :2],
        offset_transform=ax.transData, facecolors=face, edgecolors=edge, linewidths=1.1, zorder=3.5)
    ax.add_collection(patches)
    reach = k * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, :2])
    centre = np.asarray(positions)[:, :2]
    if fit:
        ax.update_datalim(np.concatenate([centre - reach, centre + reach]))
    if label:
        ax.plot([], [], "o", markersize=9, markerfacecolor=face, markeredgecolor=edge, label=label)
    ax.autoscale_view()
    return ax


def markers(ax, in_world, covariances, role="marker", label="markers"):
    """Markers (k, >= 2) as squares with their 95 % ellipses."""
    ellipses(ax, in_world, covariances, "#bbbbbb", fill=0.35)
    ax.plot(in_world[:, 0], in_world[:, 1], label=label, **ROLES[role])
    return ax


def antennas(ax, positions, covariances, guess=None, truth=None, enlarged=1):
    """Antennas (a, 2) with their 95 % ellipses, the guessed places and the true ones."""
    ellipses(ax, positions, covariances, "#999999", fill=0.35, enlarged=enlarged)
    if guess is not None:
        ends = np.stack([guess, positions])
        ax.plot(ends[..., 0], ends[..., 1], color="#999999", linewidth=0.8, zorder=2)
        ax.plot(*guess.T, label="antennas: guess", **ROLES["guess"])
    ax.plot(*positions.T, label="antennas: estimate", **ROLES["antenna"])
    if truth is not None:
        ax.plot(*truth.T, label="antennas: truth", **ROLES["true antenna"])
    return ax


def rings(ax, centres, radii, sigma, color="#56B4E9"):
    """The places that ranges allow: rings of +-2 sigma around centres (m, 2), radii and sigma (m,)."""
    for centre, radius, s in zip(centres, radii, sigma):
        ax.add_patch(Annulus(centre, radius + 2 * s, 4 * s, facecolor=color, alpha=0.35, linewidth=0))
    ax.set_aspect("equal", adjustable="box")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    return ax


def likelihood(ax, positions, ranges, sigma, window):
    """Where an antenna may be that has these ranges (m,) of the same sigma from positions (m, 2).

    `window` are the ends of x and y in metres. Shades are the density relative to its greatest.
    """
    x, y = (np.linspace(low, high, 161) for low, high in window)
    grid = np.stack(np.meshgrid(x, y), -1)
    off = (np.linalg.norm(grid[:, :, None] - positions, axis=-1) - ranges) / sigma
    cost = np.sum(off**2, axis=-1) / 2
    ax.contourf(x, y, np.exp(cost.min() - cost), levels=[1e-6, 1e-3, 0.05, 0.3, 1.01],
                colors=["#e3f1fa", "#b5dbf3", "#7cbfe8", "#0072B2"])
    ax.set_aspect("equal", adjustable="box")
    ax.set(xlabel="x (m)", ylabel="y (m)")
    return ax


def factor_graph(ax, count, sightings, names):
    """A factor graph drawn as a scheme: vehicle poses in a row, markers above them, w below, factors as dots.

    `count` is that of the poses; `sightings` are pairs (pose, marker), numbers from 0; `names` the markers'
    labels, from left to right.
    """
    poses = np.column_stack([np.arange(count), np.zeros(count)])
    markers = np.column_stack([np.linspace(-0.5, count - 0.5, len(names) + 2)[1:-1], np.full(len(names), 1.5)])
    wheel = np.array([poses[:, 0].mean(), -0.8])

    def edge(ends, color):
        middle = np.mean(ends, axis=0)
        for end in ends:
            ax.plot(*np.stack([end, middle]).T, color=color, linewidth=0.9, zorder=1)
        ax.plot(*middle, "s", color=color, markersize=4, zorder=2)

    for i, j in sightings:
        edge([poses[i], markers[j]], ROLES["aruco"]["color"])
    for i in range(count - 1):
        edge([poses[i], poses[i + 1], wheel], ROLES["odometry"]["color"])
    nodes = [(p, f"$X_{i + 1}$", "white") for i, p in enumerate(poses)]
    nodes += [(m, f"$L_{{{name}}}$", "#dddddd") for m, name in zip(markers, names)]
    for place, name, color in [*nodes, (wheel, "$w$", "#ffe0b0")]:
        ax.text(*place, name, ha="center", va="center", fontsize=8, zorder=4,
                bbox=dict(boxstyle="circle,pad=0.25", facecolor=color, edgecolor="black"))
    for prior in (poses[0], wheel):
        edge([prior, prior - [0.4, 0]], "black")
    ax.set_aspect("equal", adjustable="datalim")
    ax.axis("off")
    return ax


def enlargement(poses, covariances):
    """1, 2, 5, 10, ...: how much to enlarge ellipses so that the largest is a tenth of the path.

    The path's extent is that of the known poses (n, >= 2); covariances are (n, >= 2, >= 2).
    """
    known = np.isfinite(poses[:, 0])
    extent = np.ptp(poses[known, :2], axis=0).max()
    largest = 2.45 * np.sqrt(np.linalg.eigvalsh(covariances[known, :2, :2])[:, 1].max())
    wanted = 0.05 * extent / largest if largest > 0 else 1
    steps = np.outer(10.0 ** np.arange(4), [1, 2, 5]).ravel()
    return int(steps[max(0, np.searchsorted(steps, wanted, side="right") - 1)])


def spread(poses, count=14):
    """Indices of about `count` known poses, equally far apart along the path: few enough to read."""
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    steps = np.hypot(*np.diff(poses[known, :2], axis=0).T)
    travelled = np.concatenate([[0], np.cumsum(steps)])
    wanted = np.linspace(0, travelled[-1], count + 1)[1:]
    return known[np.unique(np.minimum(np.searchsorted(travelled, wanted), len(known) - 1))]


def name_rows(axes, names):
    """Names of the vertical axes of one panel, top to bottom; pose numbers only below the last."""
    for ax, name in zip(axes, names):
        ax.set(ylabel=name, xlabel=None)
    axes[-1].set(xlabel="pose number")


def farthest(poses):
    """Index of the pose farthest from the first one."""
    return int(np.argmax(np.hypot(*(poses[:, :2] - poses[0, :2]).T)))


def legend_below(fig):
    """One legend for all axes of a figure, below them: each label once, in as few lines as fit."""
    entries = {}
    for ax in fig.axes:
        entries |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels())
                    if label not in entries}
    for most in range(4, 0, -1):
        while fig.legends:
            fig.legends[0].remove()
        lines = -(-len(entries) // most)
        legend = fig.legend(entries.values(), entries.keys(), loc="outside lower center",
                            ncols=-(-len(entries) // lines))
        if legend.get_window_extent().width <= fig.bbox.width:
            break


def states(axes, poses, covariances, role, label=None):
    """x, y and heading over the pose number on three axes, with a band of +-2 sigma around them."""
    return _curves(axes, poses, poses, covariances, role, label, np.arange(len(poses)),
                   ("x (m)", "y (m)", "heading δ (rad)"))


def errors(axes, poses, covariances, truth, role, label=None, at=None):
    """Error against the truth (n, 3) over the pose number, with the band of +-2 sigma around 0.

    `at` are the indices from 0 of the poses the rows belong to; by default they are all poses.
    """
    error = poses - truth
    error[:, 2] = se2.wrap(error[:, 2])
    at = np.arange(len(poses)) if at is None else at
    return _curves(axes, error, np.zeros_like(error), covariances, role, label, at,
                   ("error of x (m)", "error of y (m)", "error of δ (rad)"))


def curve(ax, values, role, at=None, label=None, **look):
    """One value (n,) over the pose number; `at` are the indices from 0 of the poses it belongs to."""
    at = np.arange(len(values)) if at is None else at
    ax.plot(at + 1, values, label=label or role, **{**ROLES[role], **look})
    ax.set(xlabel="pose number")
    return ax


def cloud(ax, samples, mean, estimates, probability=0.95):
    """Samples (d, 2) with the ellipses of estimates {role: (covariance (2, 2), label)} around mean."""
    ax.plot(samples[:, 0], samples[:, 1], ".", color="#777777", markersize=2.5, label="Monte Carlo")
    for role, (covariance, label) in estimates.items():
        ellipses(ax, mean[None], covariance[None], ROLES[role]["color"], probability, label)
    return ax


def _curves(axes, values, middle, covariances, role, label, at, names):
    two_sigma = 2 * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    low, high = middle - two_sigma, middle + two_sigma
    few = np.unique(np.linspace(0, len(values) - 1, 800).astype(int))      # bands are smooth
    label = label or role
    for i, ax in enumerate(axes):
        ax.plot(at + 1, values[:, i], label=label, **ROLES[role])
        ax.fill_between(at[few] + 1, low[few, i], high[few, i], color=ROLES[role]["color"],
                        alpha=0.18, linewidth=0, label=f"{label}: ±2σ")
    name_rows(axes, names)
    return axes
