"""Draws the whole map of one drive with the names of its landmarks, which avoid each other."""

import numpy as np
from matplotlib.figure import Figure

from slamlib.core import evaluation
from slamlib.notebook import plotting

MAP_WIDTH = 7.4                    # inches, the whole width of the page
MIN_HEIGHT = 2.6                   # inches, of the axes
MAX_HEIGHT = 4.6
MIN_POINT_VARIANCE = 1.0       # rad^2, variance of the heading of a marker without orientation
TICK_LENGTH = 0.022            # of a marker's heading tick, in the map's extent
ELLIPSE_COUNT = 24             # ellipses of the vehicle, at equal distances along the path
OUTLINE = np.linspace(0, 2 * np.pi, 12, endpoint=False)    # rad, points of ellipses to leave free
NAME = 7.0                         # points, font size of the names of markers
ANTENNA_NAME = 10.5                # points, of those of antennas
MARGIN = 0.8                       # points, left free around a name
# Places of a name around its landmark, tried in this order: all directions at each distance.
NAME_DIRECTIONS = np.radians([40, 140, -40, -140, 90, -90, 0, 180, 65, 115, -65, -115, 20, 160])
NAME_DISTANCES = 4.0, 6.0, 9.0, 13.0       # points, from a landmark to its name's box
OVERLAP = 100.0                # cost of a name on another one, or not within the axes
LANDMARK = 30.0                # of each landmark that a name covers
PATH = 2.0                     # of each point of the path and of its ellipses
FAR = 0.6                      # of each point of distance between landmark and name
MAX_COST = 12.0                # of a marker's name, which else is left out


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
    _name_landmarks(ax, result, in_doubt, enlarged)
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


def _name_landmarks(ax, result, in_doubt, enlarged):
    """Write the names of landmarks where they cover least, once the figure has its legend.

    Of a SlamResult; `in_doubt` (a,) bool is of the antennas. A marker's name that costs more than
    MAX_COST is left out.
    """
    ids = np.concatenate([result.antenna, result.marker])
    unconfirmed = np.isin(result.marker, result.unconfirmed)
    unsure = np.concatenate([in_doubt, unconfirmed])
    places = np.concatenate([result.antenna_in_world, result.marker_in_world[:, :2]])
    ax.figure.draw_without_rendering()                            # fixes the axes
    landmarks = ax.transData.transform(places)
    path = ax.transData.transform(_path_and_ellipses(result, enlarged))
    covered = np.concatenate([landmarks, path])
    weight = np.repeat([LANDMARK, PATH], [len(landmarks), len(path)])
    taken = np.full((len(places), 2, 2), np.nan)      # the corners of each name, low and high

    angle = np.tile(NAME_DIRECTIONS, len(NAME_DISTANCES))
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    distance = np.repeat(NAME_DISTANCES, len(NAME_DIRECTIONS))
    point = ax.figure.dpi / 72                                    # in pixels, as all below
    for k, place in enumerate(places):
        is_antenna = k < len(result.antenna)
        size = ANTENNA_NAME if is_antenna else NAME
        name = f"{ids[k]}?" if unsure[k] else f"{ids[k]}"
        text = ax.annotate(name, place, (0, 0), ha="center", va="center", fontsize=size,
                           fontweight="bold" if is_antenna else "normal", zorder=7,
                           textcoords="offset points", annotation_clip=False)
        text.set_in_layout(False)
        box = np.array([text.get_window_extent().width, 0.8 * size * point])
        half = box / 2 + MARGIN * point
        to_edge = np.min(half / np.maximum(np.abs(direction), 1e-9), axis=1)
        reach = to_edge + distance * point * size / NAME
        offset = direction * reach[:, None]
        centre = landmarks[k] + offset
        corners = np.stack([centre - half, centre + half], axis=1)
        cost = _covering_cost(corners, taken, covered, weight, ax.bbox) + FAR * distance
        best = np.argmin(cost)
        if is_antenna or cost[best] <= MAX_COST:
            text.set_position(offset[best] / point)
            taken[k] = corners[best]
        else:
            text.remove()


def _covering_cost(corners, taken, covered, weight, frame):
    """Cost (c,) of what names with these corners (c, 2, 2), low and high, would cover.

    That is other names at `taken` (n, 2, 2), NaN where there is none, points `covered` (m, 2) of
    this weight (m,), and what is around the frame of the axes.
    """
    low = corners[:, 0]
    high = corners[:, 1]
    on_names = (low[:, None] < taken[:, 1]) & (high[:, None] > taken[:, 0])
    on_points = (covered > low[:, None]) & (covered < high[:, None])
    outside = (low < frame.min) | (high > frame.max)
    overlaps = on_names.all(axis=2).sum(axis=1) + outside.any(axis=1)
    return OVERLAP * overlaps + on_points.all(axis=2) @ weight


def _path_and_ellipses(result, enlarged):
    """Points (m, 2) in the world on the path and on the ellipses of markers and vehicle."""
    path = result.poses[::10, :2]
    some = plotting.equidistant(result.poses, ELLIPSE_COUNT)
    centres = np.concatenate([result.marker_in_world, result.poses[some]])[:, :2]
    covariances = np.concatenate([result.marker_covariance, result.covariances[some]])
    variances, axes = np.linalg.eigh(covariances[:, :2, :2])
    semi_axes = enlarged * evaluation.REACH_95 * np.sqrt(np.maximum(variances, 0))
    circle = [np.cos(OUTLINE), np.sin(OUTLINE)]
    outlines = centres[:, :, None] + axes * semi_axes[:, None] @ circle
    return np.concatenate([path, outlines.mT.reshape(-1, 2)])
