"""Places the names of landmarks in a map without overlaps."""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.path import Path
from matplotlib.text import Text
from matplotlib.transforms import IdentityTransform

from slamlib.odometry import cumulative

# rad, directions from a landmark to its name, tried in this order.
NAME_DIRECTIONS = np.radians([40, 140, -40, -140, 90, -90, 0, 180, 65, 115, -65, -115, 20, 160])
NAME_DISTANCES = (4.0, 6.0, 9.0, 13.0)      # points, from a landmark to its name's box
# Costs: of overlap with a name, of a covered landmark or path point, and of a point of distance.
OVERLAP, LANDMARK, PATH, FAR = 100.0, 30.0, 1.0, 0.6
# Background of a name.
PAPER = dict(facecolor="white", alpha=0.7, linewidth=0, boxstyle="square,pad=0.05")
LEADER = 7.0                         # points, distance of a name from which a line leads to it


class Names(Artist):
    """An artist that writes names beside landmarks.

    It chooses their places whenever it is drawn, because a figure has several widths.

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
        """Write all names, with a thin line to landmarks that are far."""
        if not self.names:
            return
        for text, line in self.placed(renderer):
            if line is not None:
                gc = renderer.new_gc()
                gc.set_linewidth(renderer.points_to_pixels(0.35))
                gc.set_foreground("#777777")
                renderer.draw_path(gc, *line)
                gc.restore()
            text.draw(renderer)

    def placed(self, renderer):
        """List of (Text, (Path, transform) or None) with the places for this renderer."""
        to_display, point = self.axes.transData, renderer.points_to_pixels(1.0)
        anchors = to_display.transform(np.array([place for _, place, _ in self.names]))
        symbols = np.vstack([anchors, to_display.transform(self.symbols)])
        path = _spaced_points(to_display.transform(self.avoided), 2 * point)
        frame, boxes, placed = self.axes.bbox, np.empty((0, 4)), []
        for (name, _, size), anchor in zip(self.names, anchors, strict=True):
            text = Text(0, 0, name, fontsize=size, color="black", ha="center",
                        va="center_baseline", fontweight="bold" if size > 7 else "normal",
                        bbox=PAPER)
            text.set_figure(self.get_figure(root=False))
            extent = text.get_window_extent(renderer)
            half = np.array([extent.width, min(extent.height, 0.8 * size * point)]) / 2
            centres, reach = _candidates(anchor, half, point * (1 if size < 7 else 1.5))
            best = np.argmin(_costs(centres, half, boxes, symbols, path, frame) + FAR * reach)
            text.set_position(centres[best])
            boxes = np.vstack([boxes, [*centres[best] - half, *centres[best] + half]])
            line = Path([anchor, np.clip(anchor, boxes[-1, :2], boxes[-1, 2:])])
            placed.append((text, (line, IdentityTransform()) if reach[best] > LEADER else None))
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


def _spaced_points(points, step):
    """Points (n, 2) of a path, each at least about `step` from the one before."""
    travelled = cumulative(np.hypot(*np.diff(points, axis=0).T))
    return points[np.unique(np.searchsorted(travelled, np.arange(0, travelled[-1] + step, step),
                                            side="right") - 1)] if len(points) else points
