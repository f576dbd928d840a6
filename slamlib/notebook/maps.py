"""Draws the whole map of one drive with the names of its landmarks, which avoid each other."""

import math

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from slamlib.core.evaluation import position_sigmas
from slamlib.core.records import NO_RANGES
from slamlib.notebook import plotting

HALF_WIDTH = 4.08            # inches, half the width of the page
WIDTH = 7.4                  # inches, all of it
FLAT = 0.55                        # height of a map over its width, below which it needs all of it
ABOVE_AND_BELOW = 0.55             # inches, for title and label
LEGEND = 0.25                      # inches, height of a line of the legend
# Places of a name relative to its landmark, in font sizes, in the order in which they are tried.
NAME_OFFSETS = (1, 0.9), (-1, 0.9), (1, -0.9), (-1, -0.9)
MOST_NAMES = 60                    # number of markers, beyond which the map names antennas only
HALO = withStroke(linewidth=1.5, foreground="white")       # so that a name on the path can be read


def whole_maps(results: dict) -> None:
    """Draw figures of the maps of SlamResults by their Drive, and one of the legend they share."""
    entries = {}
    for drive, result in results.items():
        entries |= plotting.legend_entries(whole_map(drive, result, legend=False))
    if entries:
        columns = int(WIDTH / plotting.LABEL_WIDTH)
        lines = math.ceil(len(entries) / columns)
        _, ax = plt.subplots(figsize=(WIDTH, LEGEND * lines), layout="none")
        ax.set_axis_off()
        ax.legend(entries.values(), entries.keys(), loc="center", ncols=columns)


def whole_map(drive, result, legend: bool = True) -> Figure:
    """The figure of a Drive's map: path, markers, antennas, and their names.

    `result` is a SlamResult. Ellipses hold 95 %; the title states how much they are enlarged, which
    is `plotting.enlargement` of the vehicle's. A question mark stands at the names of antennas in
    doubt, which have no ellipse because it may be as large as the map, and of markers that nothing
    confirms. Names of antennas begin with A. Names of more than MOST_NAMES markers, and those
    without a free place, are left out; pages tell them under the pointer.
    """
    landmarks = np.concatenate([result.marker_in_world[:, :2], result.antenna_in_world])
    fig, ax = plt.subplots(figsize=_size(np.concatenate([result.poses[:, :2], landmarks])))
    ax.set_title(drive.name)
    role = "slam_uwb" if len(result.antenna) else "slam"
    enlarged = plotting.enlargement(result.poses, result.covariances)
    plotting.with_ellipses(ax, result.poses, result.covariances, role, "vehicle", enlarged,
                           count=24)
    if len(result.marker):
        plotting.ellipses(ax, result.marker_in_world, result.marker_covariance,
                          plotting.ROLES["aruco"]["color"], enlarged=enlarged)
        plotting.landmarks(ax, result.marker_in_world, "marker", "markers")
    if len(result.antenna):
        guess = drive.dataset.antenna_guess
        guess = plotting.places_by_id(guess.antenna, guess.position, result.antenna)
        in_doubt = np.isin(result.antenna, list(result.doubts))
        sure = np.where(in_doubt[:, None, None], 0, result.antenna_covariance)
        x, y = np.stack([guess, result.antenna_in_world], axis=1).T
        ax.plot(x, y, color="#999999", linewidth=0.8, zorder=2)
        plotting.landmarks(ax, guess, "guess", "antennas: guess")
        plotting.draw_antennas(ax, result.antenna_in_world, sure, enlarged)
    if legend:
        fig.set_figheight(fig.get_figheight() + LEGEND)
        plotting.legend_below(fig)
    fig.draw_without_rendering()                                  # fixes the axes for the names
    taken = []
    signs = ax.transData.transform(landmarks)
    ranged = (drive.dataset.uwb or NO_RANGES).antenna
    seen = result.sightings.marker[~result.rejected]
    for kind, letter, size, doubtful, measured in (
            ("antenna", "A", 9.0, result.doubts, ranged),
            ("marker", "", 7.0, result.unconfirmed, seen)):
        ids = getattr(result, kind)
        places = getattr(result, f"{kind}_in_world")[:, :2]
        sigmas = 1e3 * position_sigmas(getattr(result, f"{kind}_covariance"))
        for each, place, sigma in zip(ids, places, sigmas):
            name = f"{letter}{each}"
            if each in doubtful:
                name += "?"
            if letter or each in doubtful or len(ids) <= MOST_NAMES:
                _write_name(ax, place, name, size, taken, signs)
            count = np.count_nonzero(measured == each)
            # Pages tell the name of this invisible disc: report.lua makes a title of it.
            ax.plot(*place, "o", alpha=0, markersize=9, zorder=9,
                    gid=f"tip: {kind} {each}, σ {sigma:.2g} mm, {count} measurements")
    return fig


def _size(places):
    """Width and height in inches of a map of places (n, 2) that leaves little white beside it."""
    across, up = np.ptp(places, axis=0)
    shape = np.clip(up / max(across, 1e-9), 0.25, 1.0)
    width = WIDTH if shape < FLAT else HALF_WIDTH
    return width, width * shape + ABOVE_AND_BELOW


def _write_name(ax, place, name, size, taken, signs):
    """Write a name beside its place (2,) in m, which covers no box `taken` and none of the `signs`.

    These are (n, 2) in pixels. Its own box joins the others. Without a free place within the axes
    there is no name.
    """
    text = ax.annotate(name, place, (0, 0), textcoords="offset points", ha="center", va="center",
                       fontsize=size, zorder=7, in_layout=False, path_effects=[HALO])
    for offset in size * np.array(NAME_OFFSETS):
        text.set_position(offset)
        box = text.get_window_extent()
        is_inside = ax.bbox.count_contains(box.corners()) == 4
        if is_inside and not box.count_overlaps(taken) and not box.count_contains(signs):
            taken.append(box)
            return
    text.remove()
