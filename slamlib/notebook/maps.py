"""Draws the whole map of one drive with the names of its landmarks, and makes tables of them.

A result is a `slam.SlamResult`; it may have no markers or no antennas. Truth enters here only: it
is drawn, and errors are computed from it, where the drive has it.
"""

import numpy as np

from slamlib import evaluation
from slamlib.notebook import inline, plotting
from slamlib.notebook.means import three_digits
from slamlib.notebook.names import Names

MAP_WIDTH = 7.4                    # inches, the whole width of the page
MAP_HEIGHTS = 2.6, 4.0, 5.7        # inches: lowest axes; highest ones of few and of many landmarks
MIN_MANY_LANDMARKS = 60        # landmarks of a map that may have the largest height
MIN_POINT_VARIANCE = 1.0       # rad^2, variance of the heading of a marker without orientation
MAP_MARGIN = 0.04              # around the map, in its extent
TICK_LENGTH = 0.022            # of a marker's heading tick, in the map's extent
ELLIPSE_COUNT = 16             # ellipses of the vehicle, at equal distances along the path
MAX_SEMI_AXIS = 0.045          # of the largest ellipse, in the map's extent
NAME, ANTENNA_NAME = 6.2, 10.0     # points, font sizes of the names of markers and antennas
MARKER, ANTENNA = "#CC79A7", "#44AA99"     # colours of the ellipses


def whole_map(drive, result):
    """The figure of a drive's map: path, markers, antennas, their names, and truth if known.

    Ellipses hold 95 %; the title states how much they are enlarged. Those of antennas in doubt are
    drawn in their true size, because they may be as large as the map.

    Parameters
    ----------
    drive : Drive
    result : SlamResult
    """
    low, high = _extent(drive, result)
    size = (high - low).max()
    enlarged = _enlargement(result, size)
    height, is_tall = _height(high - low, result)
    fig, ((ax,),) = plotting.panels(1, width=MAP_WIDTH, height=height)
    role = "slam_uwb" if len(result.antenna) else "slam"
    plotting.trajectory(ax, result.poses, role, "vehicle", linewidth=1.5,
                        linestyle="-")
    some = plotting.equidistant(result.poses, ELLIPSE_COUNT)
    plotting.ellipses(ax, result.poses[some], result.covariances[some],
                      plotting.ROLES[role]["color"], enlarged=enlarged, fit=False, fill=0.35,
                      label="its ellipses")
    if drive.truth is not None:
        plotting.trajectory(ax, drive.truth.poses, "truth", linewidth=0.7)
    names = [*_markers(ax, drive, result, enlarged, TICK_LENGTH * size),
             *_antennas(ax, drive, result, enlarged)]
    ax.set_title(_title(drive, result, enlarged))
    if is_tall:                                     # axes fill the width, with room at both sides
        ax.dataLim.set_points(np.array([low, high]))
        ax.margins(0)
    else:
        ax.set_aspect("equal", adjustable="box")
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    for ellipses in ax.collections:
        ellipses.set_linewidth(0.7)
    ax.add_artist(Names(names, _guesses(drive, result), np.concatenate([
        result.poses[:, :2], *_ticks(result, TICK_LENGTH * size), *_outlines(result, enlarged)])))
    if names:
        inline.tell(ax, np.array([place for _, place, _ in names]), _sentences(drive, result),
                    f"Map of {drive.name}")
    plotting.legend_below(fig)
    return fig


def _markers(ax, drive, result, enlarged, tick):
    """Draw the markers; yield (name, place (2,), font size) of each."""
    if not len(result.marker):
        return
    place = result.marker_in_world[:, :2]
    plotting.ellipses(ax, place, result.marker_covariance, MARKER, enlarged=enlarged, fill=0.3,
                      fit=False, label="ellipses of markers")
    ax.plot(*_ticks(result, tick).transpose(2, 0, 1)[:, [0, -1]], color="#555555", linewidth=0.9,
            zorder=4)
    ax.plot(*place.T, "s", color="#777777", markersize=2.6, zorder=4, label="markers, headings")
    if drive.truth is not None and len(drive.truth.marker):
        ax.plot(*drive.truth.marker_in_world[:, :2].T, "+", color="black", markersize=4.5,
                markeredgewidth=0.6, zorder=5, label="markers: truth")
    for marker, position in zip(result.marker, place, strict=True):
        yield str(marker), position, NAME


def _ticks(result, length):
    """Points (5, k, 2) on the heading ticks of the markers that have a heading, ends included."""
    place, heading = np.split(result.marker_in_world[_oriented(result)], [2], axis=1)
    tick = length * np.hstack([np.cos(heading), np.sin(heading)])
    return place + np.linspace(0, 1, 5)[:, None, None] * tick


def _antennas(ax, drive, result, enlarged):
    """Draw the antennas; yield (name, place (2,), font size) of each."""
    if not len(result.antenna):
        return
    place, doubt = result.antenna_in_world, in_doubt(result)
    for which, factor in ((~doubt, enlarged), (doubt, 1)):
        if which.any():
            plotting.ellipses(ax, place[which], result.antenna_covariance[which], ANTENNA,
                              enlarged=factor, fill=0.3, fit=False)
    plotting.antenna_positions(
        ax, place, _guesses(drive, result), drive.truth and drive.truth.antenna_in_world,
        markerfacecolor="#aaaaaa", markeredgewidth=0.8)
    for antenna, position, doubtful in zip(result.antenna, place, doubt, strict=True):
        yield f"{antenna}{'?' * int(doubtful)}", position, ANTENNA_NAME


def antenna_table(drive, result):
    """Header (list of str) and rows (lists of str) of a table of all antennas of a result.

    Each row has id, position, standard deviations, the distance from the guess and, where the
    truth is known, that from the true position. Antennas in doubt are marked behind the id.
    """
    header = ["antenna", "x (m)", "y (m)", "σ of x (mm)", "σ of y (mm)", "from the guess (mm)"]
    rows = _antenna_rows(drive, result)
    if drive.truth is None or not len(drive.truth.antenna):
        return header, rows
    true = plotting.places_by_id(drive.truth.antenna, drive.truth.antenna_in_world, result.antenna)
    errors = _distances(result.antenna_in_world, true)
    return [*header, "error (mm)"], [[*row, _thousandths(error)]
                                     for row, error in zip(rows, errors, strict=True)]


def _antenna_rows(drive, result):
    moved = _distances(result.antenna_in_world, _guesses(drive, result))
    sigma = evaluation.sigmas(result.antenna_covariance)
    return [[f"{antenna} (in doubt)" if doubtful else str(antenna), *map(_metres, place),
             *map(_thousandths, [*s, distance])]
            for antenna, doubtful, place, s, distance in zip(
                result.antenna, in_doubt(result), result.antenna_in_world, sigma, moved,
                strict=True)]


def _marker_rows(result):
    pose, sigma = result.marker_in_world.copy(), evaluation.sigmas(result.marker_covariance)
    pose[~_oriented(result), 2] = sigma[~_oriented(result), 2] = np.nan
    return [[str(marker), _metres(x), _metres(y),
             "–" if np.isnan(heading) else f"{np.degrees(heading):.1f}", *map(_thousandths, s)]
            for marker, (x, y, heading), s in zip(result.marker, pose, sigma, strict=True)]


def _sentences(drive, result):
    """Sentences (list of str) on each marker, then on each antenna, for the pointer."""
    told = [f"marker {marker}: x {x} m, y {y} m, δ {angle}°; σ {s[0]} mm, {s[1]} mm, {s[2]} mrad"
            if angle != "–" else f"marker {marker}: x {x} m, y {y} m; σ {s[0]} mm, {s[1]} mm"
            for marker, x, y, angle, *s in _marker_rows(result)]
    return told + [f"antenna {antenna}: x {x} m, y {y} m; σ {s[0]} mm, {s[1]} mm; "
                   f"{moved} mm from its guess"
                   for antenna, x, y, *s, moved in _antenna_rows(drive, result)]


def _oriented(result):
    """Which markers of a result have a heading, (k,) bool; the others are points."""
    return result.marker_covariance[:, 2, 2] < MIN_POINT_VARIANCE


def in_doubt(result):
    """Which antennas of a result are in doubt, (a,) bool."""
    return np.array([antenna in result.doubts for antenna in result.antenna.tolist()], dtype=bool)


def _extent(drive, result):
    """Lower left and upper right corner of the map with a margin, (2,) each."""
    shown = np.concatenate([result.poses[:, :2], result.marker_in_world[:, :2],
                            result.antenna_in_world, _guesses(drive, result)])
    low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
    margin = MAP_MARGIN * max((high - low).max(), 1.0)
    return low - margin, high + margin


def _guesses(drive, result):
    """Guessed positions (a, 2) of a result's antennas."""
    guess = drive.dataset.antenna_guess
    ids, places = ((), np.empty((0, 2))) if guess is None else (guess.antenna, guess.position)
    return plotting.places_by_id(ids, places, result.antenna)


def _outlines(result, enlarged):
    """Points (12, k, 2) around the ellipses of the markers, as they are drawn."""
    variances, axes = np.linalg.eigh(result.marker_covariance[:, :2, :2])
    reach = evaluation.REACH_95 * enlarged * np.sqrt(np.maximum(variances, 0))[:, None] * axes
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    circle = np.column_stack([np.cos(turn), np.sin(turn)])
    return result.marker_in_world[:, :2] + np.einsum("kij,mj->mki", reach, circle)


def _height(extent, result):
    """Height in inches of the figure for a map of extent (2,) in m, and whether the map is tall.

    The axes have the map's shape within MAP_HEIGHTS. At the page's width a tall map is higher.
    """
    low, few, many = MAP_HEIGHTS
    highest = many if len(result.marker) + len(result.antenna) > MIN_MANY_LANDMARKS else few
    wanted = (MAP_WIDTH - 0.7) * extent[1] / extent[0]
    return float(np.clip(wanted, low, highest)) + 1.1, bool(wanted > highest)


def _enlargement(result, size):
    """Factor 1, 2, 5, 10, ... on the ellipses, of which all without doubt fit MAX_SEMI_AXIS."""
    covariances = np.concatenate([result.marker_covariance[:, :2, :2],
                                  result.antenna_covariance[~in_doubt(result)]])
    if not len(covariances):
        return 1
    axes = np.sqrt(np.linalg.eigvalsh(covariances)[:, 1])
    largest = evaluation.REACH_95 * np.quantile(axes, 0.95)
    return plotting.round_factor(largest, MAX_SEMI_AXIS * size)


def _title(drive, result, enlarged):
    name = plotting.literal(drive.name)
    if enlarged == 1:
        return f"{name} (95 % ellipses)"
    doubtful = ", in doubt (?) × 1" if in_doubt(result).any() else ""
    return f"{name} (95 % ellipses × {enlarged}{doubtful})"


def _distances(places, others):
    return np.hypot(*(places - others)[:, :2].T)


def _metres(value):
    return f"{value:.3f}"


def _thousandths(value):
    """A value in thousandths of its unit with three significant digits; "–" if it is not known."""
    if not np.isfinite(value):
        return "–"
    return three_digits(1e3 * value)
