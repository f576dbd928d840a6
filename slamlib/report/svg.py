"""Makes matplotlib's SVG several times smaller, by amounts that no eye sees.

Coordinates are rounded to hundredths of a point, points of a path are left out that lie on the line
between their neighbours, and what repeats is said once.
"""

import re
from functools import lru_cache

import numpy as np

TOLERANCE = 0.03  # points of an inch, by which a path moves in one of PASSES
PASSES = 5
LONG = 12  # points from which a path is thinned out
NUMBER = re.compile(r"-?\d+\.\d{3,}")
PATH = re.compile(r'(<path\b[^>]*?\sd=")([^"]*)"')
PLACE = re.compile(r'(\s(?:x|y|cx|cy|r|width|height|points)="|translate\()([^")]*)')
# The typeface of which matplotlib knows the widths, and those of the text in the PDF and the pages.
DRAWN = "STIXGeneral"
FAMILY = ("'Libertinus Serif', Charter, 'Bitstream Charter', 'Iowan Old Style', 'Source Serif 4', "
          "Cambria, 'Liberation Serif', Georgia, STIXGeneral, serif")
UNSEEN = re.compile(r"<\?xml.*?\?>|<!DOCTYPE[^>]*>|<metadata>.*?</metadata>|<!--.*?-->", re.DOTALL)
ROW = re.compile(r"(?:<use [^>]*/>){2,}")
STYLE = re.compile(r' style="[^"]*"')


@lru_cache(maxsize=256)  # a page and the PDF show the same figures
def compact(text):
    """Return an SVG (str) that looks the same and is smaller."""
    text = re.sub(r">\s+<", "><", UNSEEN.sub("", text)).strip()
    text = PATH.sub(lambda path: f'{path[1]}{_path(path[2])}"', text)
    text = PLACE.sub(lambda place: place[1] + _rounded(place[2]), text)
    return ROW.sub(_row, text.replace(f"'{DRAWN}'", FAMILY))


def _rounded(text):
    return NUMBER.sub(lambda number: f"{float(number[0]):.2f}".rstrip("0").rstrip("."), text)


def _row(found):
    """Return marks in a row (Match) with their style, if it is one, in a group around them."""
    styles = set(STYLE.findall(found[0]))
    if len(styles) != 1 or found[0].count("<use ") != found[0].count(' style="'):
        return found[0]
    return f"<g{styles.pop()}>{STYLE.sub('', found[0])}</g>"


def _path(text):
    """Return the data of a path, with relative steps if it has straight lines only."""
    parts = [part.split("L") for part in text.split("M")[1:]]
    if re.search("[^-MLz0-9.e\\s]", text) or not parts:
        return _rounded(" ".join(text.split()))
    written, at = [], np.zeros(2, int)
    for part in parts:
        closed = "z" in part[-1]
        points = np.array(" ".join(part).replace("z", "").split(), float).reshape(-1, 2)
        if len(points) != len(part):  # a bare pair continues a line
            return _rounded(" ".join(text.split()))
        places = np.rint(100 * _thinned(points)).astype(int)
        steps = np.diff(places, axis=0, prepend=at[None])
        written.append(_steps("m", steps[:1]) + _steps("l", steps[1:]) + "z" * closed)
        at = places[0] if closed else places[-1]
    return "".join(written)


def _steps(command, steps):
    """Return steps (n, 2) in hundredths as data of a path, "" if there is none."""
    written = [str(value / 100).removesuffix(".0").replace("0.", ".", 1)
               if abs(value) < 100 else str(value / 100).removesuffix(".0")
               for value in steps.ravel().tolist()]
    return command * bool(written) + "".join(
        text if text[0] == "-" or not n else f" {text}" for n, text in enumerate(written))


def _thinned(points):
    """Return points (n, 2) without those that lie on the line between their neighbours."""
    for _ in range(PASSES):
        if len(points) < LONG:
            break
        before, middle, after = points[:-2:2], points[1:-1:2], points[2::2]
        count = min(map(len, (before, middle, after)))
        before, middle, after = before[:count], middle[:count], after[:count]
        chord = after - before
        share = np.clip(np.sum((middle - before) * chord, axis=1)
                        / np.maximum(np.sum(chord**2, axis=1), 1e-12), 0, 1)
        off = np.linalg.norm(middle - before - share[:, None] * chord, axis=1)
        keep = np.ones(len(points), bool)
        keep[1:2 * count:2] = off > TOLERANCE
        points = points[keep]
    return points
