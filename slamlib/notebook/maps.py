"""Draws the whole map of one drive with the names of its landmarks, which do not overlap.

A result is a `slam.SlamResult`; it may have no markers or no antennas. Truth enters here only: it
is drawn where the drive has it.
"""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.text import Text

from slamlib import evaluation
from slamlib.notebook import plotting

MAP_WIDTH = 7.4                    # inches, the whole width of the page
MAP_HEIGHTS = 2.6, 4.0, 5.7        # inches: lowest axes; highest ones of few and of many landmarks
MIN_MANY_LANDMARKS = 60        # landmarks of a map that may have the largest height
MIN_POINT_VARIANCE = 1.0       # rad^2, variance of the heading of a marker without orientation
MAP_MARGIN = 0.04              # around the map, in its extent
TICK_LENGTH = 0.022            # of a marker's heading tick, in the map's extent
ELLIPSE_COUNT = 24             # ellipses of the vehicle, at equal distances along the path
MAX_SEMI_AXIS = 0.09           # of the largest ellipse, in the map's extent
NAME, ANTENNA_NAME = 6.2, 10.0     # points, font sizes of the names of markers and antennas
MARKER, ANTENNA = "#CC79A7", "#44AA99"     # colours of the ellipses
# rad, directions from a landmark to its name, tried in this order.
NAME_DIRECTIONS = np.radians([40, 140, -40, -140, 90, -90, 0, 180, 65, 115, -65, -115, 20, 160])
NAME_DISTANCES = (4.0, 6.0, 9.0, 13.0)      # points, from a landmark to its name's box
# Costs: of overlap with a name, of a covered landmark or path point, and of a point of distance.
OVERLAP, LANDMARK, PATH, FAR = 100.0, 30.0, 1.0, 0.6
# Background of a name.
PAPER = dict(facecolor="white", alpha=0.7, linewidth=0, boxstyle="square,pad=0.05")


def whole_map(drive, result):
    """The figure of a Drive's map: path, markers, antennas, their names, and truth if known.

    Ellipses hold 95 %; the title states how much they are enlarged. Those of antennas in doubt are
    drawn in their true size, because they may be as large as the map.
    """
    guess, truth = drive.dataset.antenna_guess, drive.truth
    guess = plotting.places_by_id(() if guess is None else guess.antenna, np.empty((0, 2))
                                  if guess is None else guess.position, result.antenna)
    shown = np.concatenate([result.poses[:, :2], result.marker_in_world[:, :2],
                            result.antenna_in_world, guess])
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    margin = MAP_MARGIN * max((high - low).max(), 1.0)
    low, high = low - margin, high + margin
    size, enlarged = (high - low).max(), _enlargement(result, (high - low).max())
    height, is_tall = _height(high - low, len(result.marker) + len(result.antenna))
    fig, ((ax,),) = plotting.panels(1, width=MAP_WIDTH, height=height)
    role, some = ("slam_uwb" if len(result.antenna) else "slam",
                  plotting.equidistant(result.poses, ELLIPSE_COUNT))
    plotting.trajectory(ax, result.poses, role, "vehicle", linewidth=1.0, linestyle="-", alpha=0.6)
    plotting.ellipses(ax, result.poses[some], result.covariances[some],
                      plotting.ROLES[role]["color"], enlarged=enlarged, fit=False, fill=0.9,
                      label="its ellipses")
    if truth is not None:
        plotting.trajectory(ax, truth.poses, "truth", linewidth=0.7)
    ticks = _ticks(result, TICK_LENGTH * size)
    if len(result.marker):
        _draw_markers(ax, result, truth, ticks, enlarged)
    if len(result.antenna):
        _draw_antennas(ax, result, truth, guess, enlarged)
    ax.set_title(_title(drive, result, enlarged))
    if is_tall:                                     # axes fill the width, with room at both sides
        ax.dataLim.set_points(np.array([low, high]))
        ax.margins(0)
    else:
        ax.set_aspect("equal", adjustable="box")
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    for ellipses in ax.collections:
        ellipses.set_linewidth(0.7)
    ax.add_artist(Names(_names(result), guess, result.poses[::10, :2]))
    plotting.legend_below(fig)
    return fig


def _names(result):
    """List of (name, place (2,), font size in points) of the markers and antennas."""
    return [*((str(marker), place[:2], NAME) for marker, place in zip(
                result.marker, result.marker_in_world, strict=True)),
            *((f"{antenna}{'?' * (antenna in result.doubts)}", place, ANTENNA_NAME)
              for antenna, place in zip(
                  result.antenna.tolist(), result.antenna_in_world, strict=True))]


def _draw_markers(ax, result, truth, ticks, enlarged):
    place, once = result.marker_in_world[:, :2], np.isin(result.marker, result.unconfirmed)
    plotting.ellipses(ax, place, result.marker_covariance, MARKER, enlarged=enlarged, fill=0.3,
                      fit=False, label="ellipses of markers")
    ax.plot(*ticks.transpose(2, 0, 1), color="#555555", linewidth=0.9, zorder=4)
    for which, face, label in ((~once, None, "markers, headings"), (once, "none", "unconfirmed")):
        if which.any():
            ax.plot(*place[which].T, "s", color="#777777", markerfacecolor=face, markersize=2.6,
                    zorder=4, label=label)
    if truth is not None and len(truth.marker):
        ax.plot(*truth.marker_in_world[:, :2].T, "+", color="black", markersize=4.5,
                markeredgewidth=0.6, zorder=5, label="markers: truth")


def _draw_antennas(ax, result, truth, guess, enlarged):
    doubt = in_doubt(result)
    for which, factor in ((~doubt, enlarged), (doubt, 1)):
        if which.any():
            plotting.ellipses(ax, result.antenna_in_world[which], result.antenna_covariance[which],
                              ANTENNA, enlarged=factor, fill=0.3, fit=False)
    plotting.antenna_positions(ax, result.antenna_in_world, guess,
                               None if truth is None else truth.antenna_in_world,
                               markerfacecolor="#aaaaaa", markeredgewidth=0.8)


def in_doubt(result):
    """Which antennas of a result are in doubt, (a,) bool."""
    return np.array([antenna in result.doubts for antenna in result.antenna.tolist()], dtype=bool)


def _ticks(result, length):
    """Ends (2, k, 2) of the heading ticks of the markers that have a heading."""
    oriented = result.marker_covariance[:, 2, 2] < MIN_POINT_VARIANCE
    place, heading = np.split(result.marker_in_world[oriented], [2], axis=1)
    tick = length * np.hstack([np.cos(heading), np.sin(heading)])
    return np.stack([place, place + tick])


def _height(extent, landmarks):
    """Height in inches of the figure for a map of extent (2,) in m, and whether the map is tall.

    The axes have the map's shape within MAP_HEIGHTS. At the page's width a tall map is higher.
    """
    low, few, many = MAP_HEIGHTS
    highest, wanted = many if landmarks > MIN_MANY_LANDMARKS else few, (
        MAP_WIDTH - 0.7) * extent[1] / extent[0]
    return float(np.clip(wanted, low, highest)) + 1.1, bool(wanted > highest)


def _enlargement(result, size):
    """Factor 1, 2, 5, 10, ... on the ellipses, of which all without doubt fit MAX_SEMI_AXIS."""
    covariances = np.concatenate([result.marker_covariance[:, :2, :2],
                                  result.antenna_covariance[~in_doubt(result)]])
    if not len(covariances):
        return plotting.enlargement(result.poses, result.covariances, MAX_SEMI_AXIS)
    largest = evaluation.REACH_95 * np.quantile(np.sqrt(np.linalg.eigvalsh(covariances)[:, 1]),
                                                0.95)
    return plotting.round_factor(largest, MAX_SEMI_AXIS * size)


def _title(drive, result, enlarged):
    doubtful = ", in doubt (?) × 1" if enlarged > 1 and in_doubt(result).any() else ""
    return (f"{plotting.literal(drive.name)} (95 % ellipses"
            + f" × {enlarged}" * (enlarged > 1) + f"{doubtful})")


class Names(Artist):
    """An artist that writes names beside landmarks, each time it is drawn, in the figure's width.

    Parameters
    ----------
    names : list of (name, place (2,), font size in points); the last are placed first.
    symbols, avoided : (m, 2) and (n, 2) points to keep free, symbols first; NaN are left out.
    """

    def __init__(self, names, symbols, avoided):
        super().__init__()
        self.names = list(names)[::-1]
        self.symbols, self.avoided = (points[np.isfinite(points).all(axis=1)]
                                      for points in (symbols, avoided))
        self.set_zorder(7)
        self.set_in_layout(False)

    def draw(self, renderer):
        """Write all names."""
        for text in self.placed(renderer) if self.names else ():
            text.draw(renderer)

    def placed(self, renderer):
        """List of Text with the places for this renderer."""
        to_display, point = self.axes.transData, renderer.points_to_pixels(1.0)
        anchors = to_display.transform(np.array([place for _, place, _ in self.names]))
        symbols = np.vstack([anchors, to_display.transform(self.symbols)])
        avoided = to_display.transform(self.avoided)
        frame, boxes, placed = self.axes.bbox, np.empty((0, 4)), []
        for (name, _, size), anchor in zip(self.names, anchors, strict=True):
            text = Text(0, 0, name, fontsize=size, color="black", ha="center", bbox=PAPER,
                        va="center_baseline", fontweight="bold" if size > 7 else "normal")
            text.set_figure(self.get_figure(root=False))
            extent = text.get_window_extent(renderer)
            half = np.array([extent.width, min(extent.height, 0.8 * size * point)]) / 2
            centres, reach = _candidates(anchor, half, point * (1 if size < 7 else 1.5))
            best = np.argmin(_costs(centres, half, boxes, symbols, avoided, frame)
                             + FAR * reach)
            text.set_position(centres[best])
            boxes = np.vstack([boxes, [*centres[best] - half, *centres[best] + half]])
            placed.append(text)
        return placed


def _candidates(anchor, half, point):
    """Centres (c, 2) in pixels of places around an anchor, and their distances (c,) in points."""
    direction = np.column_stack([np.cos(NAME_DIRECTIONS), np.sin(NAME_DIRECTIONS)])
    reach = np.repeat(NAME_DISTANCES, len(direction))
    direction = np.tile(direction, (len(NAME_DISTANCES), 1))
    # from the anchor, `reach` to the edge of the name's box
    edge = np.min(half / np.maximum(np.abs(direction), 1e-9), axis=1)
    return anchor + direction * (edge + reach * point)[:, None], reach


def _costs(centres, half, boxes, symbols, path, frame):
    """Cost (c,) of names with half sizes (2,) at centres (c, 2), all in pixels."""
    low, high = centres - half, centres + half
    overlap = np.prod(np.clip(np.minimum(high[:, None], boxes[:, 2:] + 1)
                              - np.maximum(low[:, None], boxes[:, :2] - 1), 0, None), axis=2)
    cost = OVERLAP * (np.sum(overlap > 0, axis=1) + overlap.sum(axis=1) / np.prod(2 * half))
    for points, weight in ((symbols, LANDMARK), (path, PATH)):
        points = points[((points > low.min(0) - 2) & (points < high.max(0) + 2)).all(axis=1)]
        inside = ((points > low[:, None] - 2) & (points < high[:, None] + 2)).all(axis=2)
        cost = cost + weight * inside.sum(axis=1)
    outside = (low < [frame.x0, frame.y0]).any(axis=1) | (high > [frame.x1, frame.y1]).any(axis=1)
    return cost + OVERLAP * outside
