"""Reduces the size of matplotlib's SVG several times, without a visible change.

Coordinates are rounded to hundredths of a point, matplotlib simplifies paths of straight lines, and
repeated styles are written once.
"""

import re
from functools import lru_cache

import numpy as np
from matplotlib.path import Path

TOLERANCE = 0.03  # points of an inch, by which a simplified path may differ
MIN_POINTS = 12  # of a path that is simplified
PAIR = r"\s*[-\d.e]+\s+[-\d.e]+"  # of coordinates
LINES = re.compile(rf'(?<=\sd=")(?:\s*M{PAIR}(?:\s*L{PAIR})*(?:\s*z)?)+\s*(?=")')
COORDINATES = re.compile(r'(\s(?:d|x|y|cx|cy|r|width|height|points)="|translate\()([^")]*)')
LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")
# The typeface with which matplotlib measures text, and those of the text in the PDF and the pages.
DRAWN = "STIXGeneral"
FAMILY = ("'Libertinus Serif', Charter, 'Bitstream Charter', 'Iowan Old Style', 'Source Serif 4', "
          "Cambria, 'Liberation Serif', Georgia, STIXGeneral, serif")
UNSEEN = re.compile(r"<\?xml.*?\?>|<!DOCTYPE[^>]*>|<metadata>.*?</metadata>|<!--.*?-->", re.DOTALL)
MARKS = re.compile(r"(?:<use [^>]*/>){2,}")
STYLE_ATTRIBUTE = re.compile(r' style="[^"]*"')


@lru_cache(maxsize=256)  # a page and the PDF show the same figures
def compressed(text):
    """Return an SVG (str) that looks the same and is smaller."""
    text = re.sub(r">\s+<", "><", UNSEEN.sub("", text)).strip()
    text = LINES.sub(_relative_path, text)
    text = COORDINATES.sub(_rounded, text)
    return MARKS.sub(_grouped_marks, text.replace(f"'{DRAWN}'", FAMILY))


def _rounded(coordinates):
    return LONG_NUMBER.sub(lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."),
                           coordinates[1] + " ".join(coordinates[2].split()))


def _grouped_marks(marks):
    """Return marks in a row (Match) in a group with their style, if all have the same one."""
    styles = STYLE_ATTRIBUTE.findall(marks[0])
    if len(set(styles)) != 1 or marks[0].count("<use ") != len(styles):
        return marks[0]
    return f"<g{styles[0]}>{STYLE_ATTRIBUTE.sub('', marks[0])}</g>"


def _relative_path(lines):
    """Return the data of a path of straight lines (Match), simplified, in relative steps."""
    written, position = [], np.zeros(2, int)
    for part in lines[0].split("M")[1:]:
        points = np.array(re.findall(r"[-\d.e]+", part), float).reshape(-1, 2)
        points = np.rint(100 * _simplified(points)).astype(int)
        steps = np.diff(points, axis=0, prepend=position[None])
        closing = "z" if "z" in part else ""
        written.append(_path_steps("m", steps[:1]) + _path_steps("l", steps[1:]) + closing)
        position = points[0] if closing else points[-1]
    return "".join(written)


def _path_steps(command, steps):
    """Return steps (n, 2) in hundredths of a point as data of a path, "" if there are none."""
    numbers = " ".join(f"{value / 100:.10g}" for value in steps.ravel().tolist())
    return command * bool(numbers) + re.sub(r"\b0\.", ".", numbers).replace(" -", "-")


def _simplified(points):
    if len(points) < MIN_POINTS:
        return points
    path = Path(points)
    path.simplify_threshold = TOLERANCE
    return path.cleaned(simplify=True).vertices[:-1]  # the last one only marks the end
