"""Draws the whole map of one drive with the names of its landmarks, which avoid each other."""

from itertools import repeat

import numpy as np

from slamlib.core import evaluation
from slamlib.notebook import plotting

MAP_WIDTH = 7.4                    # inches, the whole width of the page
MAP_HEIGHTS = 2.6, 4.6             # inches: lowest and highest axes
MIN_POINT_VARIANCE = 1.0       # rad^2, variance of the heading of a marker without orientation
TICK_LENGTH = 0.022            # of a marker's heading tick, in the map's extent
ELLIPSE_COUNT = 24             # ellipses of the vehicle, at equal distances along the path
OUTLINE = np.linspace(0, 2 * np.pi, 12, endpoint=False)    # rad, points of ellipses to leave free
NAME, ANTENNA_NAME = 7.0, 10.5     # points, font sizes of the names of markers and antennas
MARGIN = 0.8                       # points, left free around a name
# Directions from a landmark to its name, in rad, tried in this order.
NAME_DIRECTIONS = np.radians([40, 140, -40, -140, 90, -90, 0, 180, 65, 115, -65, -115, 20, 160])
NAME_DISTANCES = 4.0, 6.0, 9.0, 13.0       # points, from a landmark to its name's box
# Costs: of a covered name, landmark or path point, and of a point of distance.
OVERLAP, LANDMARK, PATH, FAR = 100.0, 30.0, 2.0, 0.6
MAX_COST = 12.0                # of a marker's name, which else is left out


def whole_map(drive, result):
    """The figure of a Drive's map: path, markers, antennas, their names, and truth if known.

    `result` is a SlamResult. Ellipses hold 95 %; the title states how much they are enlarged, which
    is `plotting.enlargement` of the vehicle's. Those of antennas in doubt have their true size,
    because they may be as large as the map. A question mark stands at the names of antennas in
    doubt and of markers that nothing confirms. A marker's name without a free place is left out.
    """
    guess, truth, places = drive.dataset.antenna_guess, drive.truth, result.marker_in_world
    guess = None if guess is None else plotting.places_by_id(
        guess.antenna, guess.position, result.antenna)
    doubt = np.array([each in result.doubts for each in result.antenna.tolist()], bool)
    shown = np.concatenate([result.poses[:, :2], places[:, :2], result.antenna_in_world,
                            *([] if guess is None else [guess])])
    extent = np.maximum(np.nanmax(shown, axis=0) - np.nanmin(shown, axis=0), 0.1)
    height = np.clip((MAP_WIDTH - 0.7) * extent[1] / extent[0], *MAP_HEIGHTS) + 1.1
    enlarged = plotting.enlargement(result.poses, result.covariances)
    fig, ((ax,),) = plotting.panels(1, width=MAP_WIDTH, height=height)
    role, some = ("slam_uwb" if len(result.antenna) else "slam",
                  plotting.equidistant(result.poses, ELLIPSE_COUNT))
    plotting.trajectory(ax, result.poses, role, "vehicle", linewidth=1.0, linestyle="-", alpha=0.6)
    plotting.ellipses(ax, result.poses[some], result.covariances[some], fill=0.9, enlarged=enlarged,
                      color=plotting.ROLES[role]["color"], label="its ellipses")
    if truth is not None:
        plotting.trajectory(ax, truth.poses, "truth", linewidth=0.7)
    if len(places):
        oriented = places[result.marker_covariance[:, 2, 2] < MIN_POINT_VARIANCE]
        heading = np.stack([np.cos(oriented[:, 2]), np.sin(oriented[:, 2])])
        ticks = oriented[:, :2].T + [[[0]], [[TICK_LENGTH * extent.max()]]] * heading
        ax.plot(*ticks.transpose(1, 0, 2), color="#555555", linewidth=0.9, zorder=4)
        plotting.draw_markers(ax, places, result.marker_covariance, enlarged)
    if truth is not None and len(truth.marker) and len(places):
        ax.plot(*truth.marker_in_world[:, :2].T, "+", color="black", markersize=4.5,
                markeredgewidth=0.6, zorder=5, label="markers: truth")
    if len(result.antenna):
        plotting.draw_antennas(ax, result.antenna_in_world, result.antenna_covariance, guess,
                               None if truth is None else truth.antenna_in_world,
                               np.where(doubt, 1, enlarged))
    factor = f" × {enlarged}" + ", in doubt (?) × 1" * bool(doubt.any())
    ax.set_title(f"{drive.name} (95 % ellipses{factor * (enlarged > 1)})")
    plotting.legend_below(fig)
    _name_landmarks(ax, result, doubt, enlarged)
    return fig


def _name_landmarks(ax, result, doubt, enlarged):
    """Write the names of landmarks where they cover least, once the figure has its legend.

    Of a SlamResult; `doubt` (a,) bool is of the antennas. A marker's name that costs more than
    MAX_COST is left out.
    """
    places, weak = result.marker_in_world, np.isin(result.marker, result.unconfirmed)
    some = plotting.equidistant(result.poses, ELLIPSE_COUNT)
    centres = np.concatenate([places[:, :2], result.poses[some, :2]])
    variances, axes = np.linalg.eigh(np.concatenate([
        result.marker_covariance, result.covariances[some]])[:, :2, :2])
    outlines = centres[:, :, None] + enlarged * evaluation.REACH_95 * axes * np.sqrt(
        np.maximum(variances, 0))[:, None] @ [np.cos(OUTLINE), np.sin(OUTLINE)]
    names = [*zip(result.antenna, result.antenna_in_world, doubt, repeat(ANTENNA_NAME)),
             *zip(result.marker, places[:, :2], weak, repeat(NAME))]
    ax.figure.draw_without_rendering()                            # fixes the axes
    renderer, frame, boxes = ax.figure.canvas.get_renderer(), ax.bbox, np.empty((0, 4))
    point = renderer.points_to_pixels(1.0)
    landmarks = ax.transData.transform(np.concatenate([result.antenna_in_world, places[:, :2]]))
    covered = np.vstack([landmarks, ax.transData.transform(
        np.concatenate([result.poses[::10, :2], *outlines.swapaxes(1, 2)]))])
    weight = np.where(np.arange(len(covered)) < len(landmarks), LANDMARK, PATH)
    direction = np.column_stack([np.cos(NAME_DIRECTIONS), np.sin(NAME_DIRECTIONS)])
    reach = np.repeat(NAME_DISTANCES, len(direction))
    direction = np.tile(direction, (len(NAME_DISTANCES), 1))
    for (name, place, unsure, size), anchor in zip(names, landmarks, strict=True):
        text = ax.annotate(f"{name}{'?' * int(unsure)}", place, (0, 0), ha="center", va="center",
                           textcoords="offset points", annotation_clip=False, zorder=7,
                           fontsize=size, fontweight="bold" if size > NAME else "normal")
        text.set_in_layout(False)
        extent = text.get_window_extent(renderer)
        half = np.array([extent.width, 0.8 * size * point]) / 2 + MARGIN * point
        edge = np.min(half / np.maximum(np.abs(direction), 1e-9), axis=1)   # to that of its box
        offset = direction * (edge + reach * point * size / NAME)[:, None]
        low, high = anchor + offset - half, anchor + offset + half
        names_hit = ((low[:, None] < boxes[:, 2:]) & (high[:, None] > boxes[:, :2])).all(axis=2)
        points_hit = ((covered > low[:, None]) & (covered < high[:, None])).all(axis=2)
        outside = (low < frame.min).any(axis=1) | (high > frame.max).any(axis=1)
        cost = OVERLAP * (names_hit.sum(axis=1) + outside) + points_hit @ weight + FAR * reach
        best = np.argmin(cost)
        if size == NAME and cost[best] > MAX_COST:
            text.remove()
            continue
        text.set_position(offset[best] / point)
        boxes = np.vstack([boxes, [*low[best], *high[best]]])
