"""The animated drive on the first page: odometry beside SLAM, each with its ellipses.

It is an SVG that CSS alone animates (with the rules for `.drive` in page.css): a check box pauses
it, and it stands still at its end on paper and where the reader wants no motion. It loads nothing.
"""

from hashlib import sha256
from html import escape

import numpy as np
from markupsafe import Markup
from nbformat.v4 import new_code_cell, new_output

from slamlib import evaluation
from slamlib.notebook import plotting, with_unit
from slamlib.odometry import cumulative
from slamlib.report.chapters import HTML_ONLY

SECONDS, MOVING_SHARE = 24, 0.88  # of one round, and the share of it in which the vehicle moves
WIDTH, HEIGHTS = 720, (280, 460)  # units of the drawing, about pixels: width, least and most height
DRAWING_MARGIN = 24  # units of the drawing
PATH_POINTS, STOPS = 500, 40  # numbers of points of a path, and of those where its time is exact
ELLIPSE_COUNTS = 8, 16  # of odometry, and of the estimate beside it
SEMI_AXIS_LIMIT = 0.08  # of the path's extent: the estimate's ellipses are enlarged up to it
BESIDE_ODOMETRY = ("problem4", "problem3", "problem2_fused")  # estimates, the best first



def moving(drive):
    """Return a list of the cell with a SolvedDrive's animation, for pages only; [] without one."""
    html = animated(drive)
    output = new_output("display_data", {"text/html": Markup(html)})  # not sanitized
    return [new_code_cell(outputs=[output], id="motion",
                          metadata={"tags": [HTML_ONLY]})] if html else []


def animated(drive):
    """Return the animation of a SolvedDrive in HTML; "" without odometry and another estimate."""
    solved = {solution.problem: solution for solution in drive.solutions}
    best = next((solved[problem] for problem in BESIDE_ODOMETRY if problem in solved), None)
    if best is None or "problem1" not in solved or evaluation.path_length(best.poses) <= 0:
        return ""
    shown = [solved["problem1"].poses, best.poses]
    shown += [drive.truth.poses] if drive.truth else []
    on_page, height, scale = _projection(shown)
    enlarged = plotting.enlargement(best.poses, best.covariances, SEMI_AXIS_LIMIT)
    layers = [(solved["problem1"], "#D55E00", 1), (best, "#0072B2", enlarged)]
    parts, rules = [], []
    own = f"d{sha256(np.concatenate(shown).tobytes()).hexdigest()[:6]}"
    if drive.truth is not None:
        parts.append(f'<path class="true" d="{_path_data(on_page(drive.truth.poses))}"/>')
    for name, count, layer in zip("ab", ELLIPSE_COUNTS, layers, strict=True):
        drawn, styled = _layer(own + name, count, *layer, on_page, scale)
        parts.append(drawn)
        rules.append(styled)
    return (f'<figure class="drive"><style>{"".join(rules)}</style>'
            f'<input class="pause" type="checkbox" id="{own}"><label class="pause" for="{own}">'
            f'Pause</label><svg viewBox="0 0 {WIDTH} {height}" role="img" '
            f'aria-label="{escape(_described(drive, best))}">{"".join(parts)}{_bar(scale, height)}'
            f"</svg>{_legend(layers, drive.truth is not None)}"
            f"<figcaption>{_said(drive, solved['problem1'], best)}</figcaption></figure>")


def _layer(name, count, solution, color, enlarged, on_page, scale):
    """Return a Solution's path, ellipses and vehicle in SVG (str), and the CSS that moves them."""
    known = np.flatnonzero(np.isfinite(solution.poses[:, 0]))
    poses = solution.poses[known]
    indices = plotting.equidistant(poses, count)
    drawn, rules = [], []
    for number, (i, ellipse) in enumerate(zip(indices, _ellipses(
            on_page(poses[indices]), solution.covariances[known[indices]], enlarged * scale),
            strict=True)):
        when = 100 * MOVING_SHARE * i / (len(poses) - 1)
        rules.append(f"@keyframes {name}{number}{{0%,{when:.1f}%{{opacity:0}}"
                     f"{when + 0.5:.1f}%,100%{{opacity:1}}}}")
        drawn.append(f'<ellipse {ellipse} stroke="{color}" fill="{color}" '
                     f'style="animation:{name}{number} {SECONDS}s infinite"/>')
    path = on_page(poses)
    travelled = cumulative(np.hypot(*np.diff(path, axis=0).T))
    stops = np.unique(np.linspace(0, len(poses) - 1, STOPS).astype(int))
    done = travelled[stops] / max(travelled[-1], 1e-9)
    times = 100 * MOVING_SHARE * stops / stops[-1]
    for kind, rule in (("line", "stroke-dashoffset:{:.4f}"), ("dot", "offset-distance:{:.2f}%")):
        values = 1 - done if kind == "line" else 100 * done
        frames = "".join(f"{time:.1f}%{{{rule.format(value)}}}"
                         for time, value in zip(times, values, strict=True))
        rules.append(f"@keyframes {name}{kind}{{{frames}100%{{{rule.format(values[-1])}}}}}")
    d = _path_data(path)
    drawn.append(
        f'<path d="{d}" pathLength="1" stroke="{color}" stroke-width="2.2" style="stroke-dasharray:'
        f'1;stroke-dashoffset:0;animation:{name}line {SECONDS}s linear infinite"/>'
        f'<circle r="6" fill="{color}" style="offset-path:path(\'{d}\');offset-distance:100%;'
        f'animation:{name}dot {SECONDS}s linear infinite"/>')
    return "".join(drawn), "".join(rules)


def _projection(shown):
    """Return a function from positions (n, >= 2) in m to the page, its height, and units per m."""
    every = np.concatenate([poses[np.isfinite(poses[:, 0]), :2] for poses in shown])
    low, high = every.min(0), every.max(0)
    room = np.array([WIDTH, HEIGHTS[1]]) - 2 * DRAWING_MARGIN
    scale = (room / np.maximum(high - low, 1e-6)).min()
    height = round(max(HEIGHTS[0], scale * (high - low)[1] + 2 * DRAWING_MARGIN))
    middle = (low + high) / 2
    flip = np.array([scale, -scale])
    return lambda poses: (poses[:, :2] - middle) * flip + [WIDTH / 2, height / 2], height, scale


def _path_data(points):
    """Return the data of an SVG path along points (n, 2), thinned out at equal distances."""
    points = points[np.isfinite(points[:, 0])]
    travelled = cumulative(np.hypot(*np.diff(points, axis=0).T))
    kept = np.unique(np.searchsorted(travelled, np.linspace(0, travelled[-1], PATH_POINTS)))
    return "M" + " ".join(f"{x:.1f} {y:.1f}" for x, y in points[np.minimum(kept, len(points) - 1)])


def _ellipses(centres, covariances, scale):
    """Yield the attributes (str) of the 95 % ellipses at centres (m, 2) on the page."""
    variances, axes = np.linalg.eigh(covariances[:, :2, :2])
    radii = evaluation.REACH_95 * scale * np.sqrt(np.maximum(variances, 0))
    angles = -np.degrees(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))
    for (x, y), (minor, major), angle in zip(centres, radii, angles, strict=True):
        yield (f'rx="{major:.1f}" ry="{minor:.1f}" '
               f'transform="translate({x:.1f} {y:.1f}) rotate({angle:.0f})"')


def _bar(scale, height):
    """Return a scale bar (SVG, str) of 1, 2 or 5 times a power of ten metres."""
    lengths = np.outer(10.0 ** np.arange(-3, 5), [1, 2, 5]).ravel()
    length = lengths[np.searchsorted(lengths, WIDTH / 6 / scale)]
    return (f'<path class="bar" d="M{DRAWING_MARGIN} {height - 12}h{length * scale:.1f}"/>'
            f'<text x="{DRAWING_MARGIN}" y="{height - 18}">{length:g} m</text>')


def _said(drive, first, best):
    """Return the caption in HTML: the largest errors of odometry and of the best estimate."""
    begin = f"The drive <em>{escape(drive.name)}</em> in {SECONDS} seconds: odometry is up to"
    estimate = f"the estimate “{escape(best.title)}”"
    if drive.truth is None:
        apart = with_unit(_farthest(first.poses, best.poses), "m")
        return f"{begin} {apart} from {estimate}."
    off = [with_unit(_farthest(solution.poses, drive.truth.poses), "m")
           for solution in (first, best)]
    return f"{begin} {off[0]} from the truth, {estimate} up to {off[1]}."


def _farthest(poses, others):
    return np.nanmax(np.hypot(*(poses - others)[:, :2].T))


def _legend(layers, truth):
    """Return the legend in HTML of layers (solution, colour, enlargement) and of the truth."""
    lines = [f'<span><i style="border-color:{color}"></i>{escape(solution.title)}, 95 % ellipses'
             f'{f" × {enlarged}" if enlarged > 1 else ""}</span>'
             for solution, color, enlarged in layers]
    if truth:
        lines.append('<span><i style="border-top:1px dashed"></i>truth</span>')
    return f'<p class="key">{" ".join(lines)}</p>'


def _described(drive, best):
    return (f"The drive {drive.name} in motion: the path by odometry drifts away from the path by "
            f"{best.title}")
