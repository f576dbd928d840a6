"""Draws the whole map of one drive with the names of its landmarks, which avoid each other."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from slamlib.notebook import plotting

MAP_WIDTH = 7.4                    # inches, the whole width of the page
MIN_HEIGHT = 2.6                   # inches, of the axes
MAX_HEIGHT = 3.4
MIN_POINT_VARIANCE = 1.0       # rad^2, variance of the heading of a marker without orientation
TICK_LENGTH = 0.022            # of a marker's heading tick, in the map's extent
ELLIPSE_COUNT = 24             # ellipses of the vehicle
NAME = 7.0                         # points, font size of the names of markers
ANTENNA_NAME = 10.5                # points, of those of antennas
# Places of a name relative to its landmark, in font sizes, in the order in which they are tried.
NAME_OFFSETS = (1, 0.9), (-1, 0.9), (1, -0.9), (-1, -0.9), (0, 1.4), (0, -1.4), (1.8, 0), (-1.8, 0)
HALO = withStroke(linewidth=1.5, foreground="white")       # so that a name on the path can be read


def whole_map(drive, result) -> Figure:
    """The figure of a Drive's map: path, markers, antennas, their names, and truth if known.

    `result` is a SlamResult. Ellipses hold 95 %; the title states how much they are enlarged, which
    is `plotting.enlargement` of the vehicle's. Those of antennas in doubt have their true size,
    because they may be as large as the map. A question mark stands at the names of antennas in
    doubt and of markers that nothing confirms. A marker's name without a free place is left out.
    """
    truth = drive.truth
    guess = drive.dataset.antenna_guess
    shown = [result.poses[:, :2], result.marker_in_world[:, :2], result.antenna_in_world]
    if guess is not None:
        guess = plotting.places_by_id(guess.antenna, guess.position, result.antenna)
        shown.append(guess)
    shown = np.concatenate(shown)
    extent = np.maximum(np.nanmax(shown, axis=0) - np.nanmin(shown, axis=0), 0.1)
    height = np.clip((MAP_WIDTH - 0.7) * extent[1] / extent[0], MIN_HEIGHT, MAX_HEIGHT)
    fig, axes = plotting.panels(1, width=MAP_WIDTH, height=height + 1.1)
    ax = axes[0, 0]

    role = "slam_uwb" if len(result.antenna) else "slam"
    enlarged = plotting.enlargement(result.poses, result.covariances)
    in_doubt = np.isin(result.antenna, list(result.doubts))
    plotting.with_ellipses(ax, result.poses, result.covariances, role, "vehicle", enlarged,
                           ELLIPSE_COUNT)
    if truth is not None:
        plotting.trajectory(ax, truth.poses, "truth", linewidth=0.7)
    if len(result.marker):
        _draw_headings(ax, result, TICK_LENGTH * extent.max())
        plotting.draw_markers(ax, result.marker_in_world, result.marker_covariance, enlarged)
        if truth is not None and len(truth.marker):
            plotting.landmarks(ax, truth.marker_in_world, "true marker", "markers: truth")
    if len(result.antenna):
        true_antennas = None if truth is None else truth.antenna_in_world
        plotting.draw_antennas(ax, result.antenna_in_world, result.antenna_covariance, guess,
                               true_antennas, np.where(in_doubt, 1, enlarged))
    factor = f" × {enlarged}" if enlarged > 1 else ""
    if factor and in_doubt.any():
        factor += ", in doubt (?) × 1"
    ax.set_title(f"{drive.name} (95 % ellipses{factor})")
    plotting.legend_below(fig)
    ax.figure.draw_without_rendering()                            # fixes the axes for the names
    taken = []
    for place, antenna in zip(result.antenna_in_world, result.antenna):
        mark = "?" if antenna in result.doubts else ""
        _write_name(ax, place, f"{antenna}{mark}", ANTENNA_NAME, taken, fontweight="bold")
    for place, marker in zip(result.marker_in_world[:, :2], result.marker):
        mark = "?" if marker in result.unconfirmed else ""
        _write_name(ax, place, f"{marker}{mark}", NAME, taken)
    return fig


def _draw_headings(ax, result, length):
    """Draw a tick of a length in m in the direction of each marker that has one."""
    oriented = result.marker_covariance[:, 2, 2] < MIN_POINT_VARIANCE
    x, y, heading = result.marker_in_world[oriented].T
    end_x = x + length * np.cos(heading)
    end_y = y + length * np.sin(heading)
    ax.plot([x, end_x], [y, end_y], color="#555555", linewidth=0.9, zorder=4)


def _write_name(ax, place, name, size, taken, **look):
    """Write a name beside its place (2,) in m, where it covers none of the boxes `taken`.

    Its own box joins them. Without a free place within the axes there is no name.
    """
    text = ax.annotate(name, place, (0, 0), textcoords="offset points", ha="center", va="center",
                       fontsize=size, zorder=7, path_effects=[HALO], **look)
    text.set_in_layout(False)
    for offset in NAME_OFFSETS:
        text.set_position(size * np.array(offset))
        box = text.get_window_extent()
        is_inside = ax.bbox.contains(*box.min) and ax.bbox.contains(*box.max)
        if is_inside and not box.count_overlaps(taken):
            taken.append(box)
            return
    text.remove()
