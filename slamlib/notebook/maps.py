"""Draws the whole map of one drive with the names of its landmarks, which avoid each other."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from slamlib.notebook import plotting

MAP_WIDTH = 7.4                    # inches, the whole width of the page
MIN_HEIGHT = 2.6                   # inches, of the axes
MAX_HEIGHT = 4.6
MIN_POINT_VARIANCE = 1.0       # rad^2, variance of the heading of a marker without orientation
TICK_LENGTH = 0.022            # of a marker's heading tick, in the map's extent
ELLIPSE_COUNT = 24             # ellipses of the vehicle, at equal distances along the path
NAME = 7.0                         # points, font size of the names of markers
ANTENNA_NAME = 10.5                # points, of those of antennas
# Directions of a name from its landmark, tried in this order at each distance from it.
NAME_DIRECTIONS = np.radians([40, 140, -40, -140, 90, -90, 0, 180, 65, 115, -65, -115, 20, 160])
NAME_DISTANCES = 1.5, 1.9, 2.4, 3.0        # in font sizes
MAX_COVERED = 8                # points of the path that a marker's name covers, else it is left out
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

    enlarged = plotting.enlargement(result.poses, result.covariances)
    in_doubt = np.isin(result.antenna, list(result.doubts))
    _draw_vehicle(ax, result, enlarged)
    if truth is not None:
        plotting.trajectory(ax, truth.poses, "truth", linewidth=0.7)
    if len(result.marker):
        _draw_headings(ax, result, TICK_LENGTH * extent.max())
        plotting.draw_markers(ax, result.marker_in_world, result.marker_covariance, enlarged)
        if truth is not None and len(truth.marker):
            ax.plot(truth.marker_in_world[:, 0], truth.marker_in_world[:, 1], "+", color="black",
                    markersize=4.5, markeredgewidth=0.6, zorder=5, label="markers: truth")
    if len(result.antenna):
        true_antennas = None if truth is None else truth.antenna_in_world
        plotting.draw_antennas(ax, result.antenna_in_world, result.antenna_covariance, guess,
                               true_antennas, np.where(in_doubt, 1, enlarged))
    factor = f" × {enlarged}" if enlarged > 1 else ""
    if factor and in_doubt.any():
        factor += ", in doubt (?) × 1"
    ax.set_title(f"{drive.name} (95 % ellipses{factor})")
    plotting.legend_below(fig)
    _name_landmarks(ax, result, in_doubt)
    return fig


def _draw_vehicle(ax, result, enlarged):
    """Draw the path of a SlamResult with some of its ellipses."""
    role = "slam_uwb" if len(result.antenna) else "slam"
    color = plotting.ROLES[role]["color"]
    some = plotting.equidistant(result.poses, ELLIPSE_COUNT)
    plotting.trajectory(ax, result.poses, role, "vehicle", linewidth=1.0, linestyle="-", alpha=0.6)
    plotting.ellipses(ax, result.poses[some], result.covariances[some], color, fill=0.9,
                      enlarged=enlarged, label="its ellipses")


def _draw_headings(ax, result, length):
    """Draw a tick of a length in m in the direction of each marker that has one."""
    oriented = result.marker_covariance[:, 2, 2] < MIN_POINT_VARIANCE
    x, y, heading = result.marker_in_world[oriented].T
    end_x = x + length * np.cos(heading)
    end_y = y + length * np.sin(heading)
    ax.plot([x, end_x], [y, end_y], color="#555555", linewidth=0.9, zorder=4)


def _name_landmarks(ax, result, in_doubt):
    """Write the names of landmarks where they cover least, once the figure has its legend.

    Of a SlamResult; `in_doubt` (a,) bool is of the antennas. A marker's name that finds no place is
    left out.
    """
    unconfirmed = np.isin(result.marker, result.unconfirmed)
    places = np.concatenate([result.antenna_in_world, result.marker_in_world[:, :2]])
    ids = np.concatenate([result.antenna, result.marker])
    unsure = np.concatenate([in_doubt, unconfirmed])
    ax.figure.draw_without_rendering()                            # fixes the axes
    landmarks = ax.transData.transform(places)
    path = ax.transData.transform(result.poses[::10, :2])
    taken = []
    for k, place in enumerate(places):
        is_antenna = k < len(result.antenna)
        size = ANTENNA_NAME if is_antenna else NAME
        text = ax.annotate(f"{ids[k]}?" if unsure[k] else f"{ids[k]}", place, (0, 0), ha="center",
                           va="center", fontsize=size, zorder=7, textcoords="offset points",
                           fontweight="bold" if is_antenna else "normal", annotation_clip=False,
                           path_effects=[HALO])
        text.set_in_layout(False)
        box = text.get_window_extent()
        offset, cost = _freest(box, size * ax.figure.dpi / 72, taken, landmarks, path, ax.bbox)
        if is_antenna or cost <= MAX_COVERED:
            text.set_position(offset * 72 / ax.figure.dpi)
            taken.append(box.translated(*offset))
        else:
            text.remove()


def _freest(box, size, taken, landmarks, path, frame):
    """Offset (2,) of a name's box where it covers least, and the number of points that it covers.

    A landmark (l, 2), another name in `taken`, and what is around the frame count as many points
    of the path (p, 2). All are in pixels, also the font `size`.
    """
    best = np.zeros(2), np.inf
    for distance in NAME_DISTANCES:
        for angle in NAME_DIRECTIONS:
            reach = distance * size + 0.5 * (box.width - size) * abs(np.cos(angle))
            offset = reach * np.array([np.cos(angle), np.sin(angle)])
            at = box.translated(*offset)
            is_outside = not (frame.contains(*at.min) and frame.contains(*at.max))
            cost = (_count(at, path) + 20 * _count(at, landmarks)
                    + 100 * (at.count_overlaps(taken) + is_outside))
            if cost < best[1]:
                best = offset, cost
    return best


def _count(box, points):
    """Number of points (n, 2) in a box."""
    return np.sum(np.all((points > box.min) & (points < box.max), axis=1))
