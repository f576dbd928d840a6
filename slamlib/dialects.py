"""Tables of numbers, from text as editors, spreadsheets and MATLAB write it, and from arrays.

Plain text has blanks or tabs between columns, decimal points, and comments that begin with `#`, `%`
or `//`. Other separators, decimal commas and a header are read. The limits of the numbers are far
wider than vehicles, cameras and antennas need: a number beyond them has another unit, or float64
loses digits beside it. data/README.md lists them.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamlib.folder import ENCODER, Variable
from slamlib.textfile import error, quoted, read_text


@dataclass(frozen=True)
class Limit:
    """The closed interval in which a number lies."""

    minimum: float
    maximum: float
    unit: str = ""
    whole: bool = False

    def __str__(self):
        return f"from {self.minimum:g} to {self.maximum:g} {self.unit}".rstrip()


_ANY = Limit(-1e15, 1e15)               # float64 represents whole numbers up to there exactly
_WHOLE = Limit(-1e15, 1e15, whole=True)  # ids and counts
_VARIANCE = Limit(1e-18, 1e8, "m^2")
_IN_VEHICLE, _GUESS, _TRUE = (Limit(-size, size, "m") for size in (1e4, 1e6, 1e9))
_ANGLE, _TRUE_ANGLE = (Limit(-size, size, "rad") for size in (6.3, 1e9))
# Limits by the name of a file and by its column, in the order of the file.
LIMITS = {
    "encoderReading.txt": {"pose id": _WHOLE, "right ticks": _WHOLE, "left ticks": _WHOLE},
    "ArucoReading.txt": {
        "pose id": _WHOLE, "marker id": _WHOLE, "x": _IN_VEHICLE, "y": _IN_VEHICLE, "theta": _ANGLE,
        "s_xx": _VARIANCE, "s_xy": _ANY, "s_xtheta": _ANY, "s_yy": _VARIANCE, "s_ytheta": _ANY,
        "s_thetatheta": Limit(1e-18, 1e14, "rad^2")},
    "UwbReading.txt": {"pose id": _WHOLE, "antenna id": _WHOLE, "range": Limit(-5e4, 1e5, "m"),
                       "sigma": Limit(1e-9, 1e4, "m")},
    "UwbAntennaGuess.txt": {"antenna id": _WHOLE, "x": _GUESS, "y": _GUESS},
    "vehiclePose.txt": {"pose id": _WHOLE, "x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "ArucoMap.txt": {"marker id": _WHOLE, "x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "UwbMap.txt": {"antenna id": _WHOLE, "x": _TRUE, "y": _TRUE}}

COMMENT_OR_QUOTE = re.compile(r'(#|%|//).*|"')
EMPTY_CELL = re.compile(r"(?:^|(?<=[;,]))[^\S\n]*(?=[;,]|$)", re.MULTILINE)
NUMBER_FIRST = re.compile(r"(^|[\s,;])\W*(\d|nan\b|inf)", re.IGNORECASE)  # in a row, not a header
POINT_OR_LOOSE_COMMA = re.compile(r"\.|(?<!\d),|,(?!\d)")  # where commas are no decimal commas
# Words of headers for two columns, in the order of the file.
HEADER_ORDER = {ENCODER: (r"right|dx|destra|r\b", r"left|sx|sinistra|l\b"),
                "ArucoReading.txt": ("pos[ea]", "marker|aruco|tag|landmark"),
                "UwbReading.txt": ("pos[ea]", "antenna|anchor|beacon|landmark")}


@dataclass(frozen=True)
class Table:
    """The numbers of a table, with the lines of its rows for messages."""

    source: Path | Variable | None  # None if there is no file
    numbers: np.ndarray  # (m, c)
    lines: np.ndarray = ()  # (m,) of the rows in the file, from 1
    notes: tuple[str, ...] = ()  # sentences on what was mended or left out

    def noted(self, note):
        """The Table with one more note, a clause about its file."""
        return replace(self, notes=(*self.notes, f"{Path(str(self.source)).name}{note}."))

    def place(self, k):
        """Line of row k in the file, as part of a sentence."""
        return f"{'row' if isinstance(self.source, Variable) else 'line'} {self.lines[k]}"

    def kept(self, ok, expected, share=0.0):
        """The Table of the rows where `ok` is True, with a note on the others.

        `ok` (m,) or (m, c) is bool; the latter tells the number to quote, and `expected` (str) may
        be one for each column. Raises DatasetError for the first of the others if they are more
        than a share of the rows, or of an exact Variable.
        """
        if ok.all():
            return self
        bad = ~ok.reshape(len(ok), -1).all(axis=1)
        count, first = np.count_nonzero(bad), int(np.argmax(bad))
        column = int(np.argmin(ok[first])) if ok.ndim == 2 else slice(None)
        expected = expected if isinstance(expected, str) else expected[column]
        found = " ".join(f"{x:.12g}" for x in np.atleast_1d(self.numbers[first, column]))
        said, place = f"expected {expected}, found '{found}'", self.place(first)
        if count > share * len(bad) or getattr(self.source, "exact", False):
            raise error(self.source, said, place)
        kept = replace(self, numbers=self.numbers[~bad], lines=self.lines[~bad])
        return kept.noted(f": {count} of {len(bad)} rows left out, the first in {place}: {said}")


def read_table(source, name, share=0.0, pose_count=None):
    """The Table of a text file (Path), a Variable, or None, which has no rows.

    The columns are those of LIMITS[name]. A share of the rows may be beyond LIMITS, or have pose
    ids beyond `pose_count`, and if it is not 0, any may have NaN. Raises DatasetError if there are
    more, a row has other than a number for each column, or a header names the columns in another
    order.
    """
    limits, columns = dict(LIMITS[name]), list(LIMITS[name])
    if pose_count is not None:
        limits["pose id"] = Limit(1, pose_count, whole=True)
    if source is None:
        return Table(source=source, numbers=np.empty((0, len(columns))))
    if isinstance(source, Variable):
        rows = matrix(source, source.value, columns)
        table = Table(source=source, numbers=rows, lines=np.arange(1, len(rows) + 1))
    else:
        table = _table_of_text(source, name)
    if share:
        table = table.kept(~np.isnan(table.numbers), [f"{each}, a number" for each in columns], 1)
    if "range" in limits:
        table = table.kept(table.numbers[:, 2] != 0, "a range, which 0 (no reception) is not", 1)
    x, whole = table.numbers, np.array([limit.whole for limit in limits.values()])
    minimum, maximum = np.array([[each.minimum, each.maximum] for each in limits.values()]).T
    return table.kept((minimum <= x) & (x <= maximum) & ((x == np.rint(x)) | ~whole), [
        f"{column}, a {'whole' if limit.whole else 'finite'} number {limit}"
        for column, limit in limits.items()], share)


def matrix(source, value, columns):
    """The array (m, c) of float of a `value` with these columns; m = 0 if it is empty.

    Raises DatasetError for another shape and if it holds no real numbers.
    """
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        array = np.asarray(value, dtype=object)
    if array.size == 0:
        return np.empty((0, len(columns)))
    if array.dtype == object or array.ndim != 2 or array.shape[1] != len(columns):
        raise error(source, f"expected a matrix of real numbers with {len(columns)} columns "
                    f"({', '.join(columns)}), found {array.dtype} of shape {array.shape}")
    return array


def _table_of_text(source, name):
    """The Table of a text file, with NaN for empty cells."""
    columns = list(LIMITS[name])
    table = Table(source=source, numbers=np.empty((0, len(columns))))
    rows = COMMENT_OR_QUOTE.sub("", read_text(source)).split("\n")
    lines = [k for k, row in enumerate(rows, start=1) if row.strip(",; \t").strip()]
    header = rows[lines[0] - 1].strip() if lines else ""
    if re.search("[A-Za-z]", header) and not NUMBER_FIRST.search(header):
        found = [re.search(words, header, re.I) for words in HEADER_ORDER.get(name, ())]
        if found and all(found) and found[1].start() < found[0].start():
            raise error(source, f"expected the columns in the order ({', '.join(columns)}), found "
                        f"the header {quoted(header)}", lines[0])
        table = table.noted(f": the header {quoted(header)} was left out")
        del lines[0]
    if not lines:
        return table
    rows = [rows[k - 1].strip() for k in lines]
    for end in ",;":                                # an empty last cell in every row
        if all(row.endswith(end) for row in rows):
            rows = [row[:-1] for row in rows]
    first, body = rows[0], "\n".join(rows)
    # Blanks inside of a cell mean that commas are no separators.
    separator = ";" if ";" in first else "," if "," in first and not any(
        len(cell.split()) > 1 for cell in first.split(",")) else None
    if separator != "," and "," in body and not POINT_OR_LOOSE_COMMA.search(body):
        table, body = table.noted(" was read with decimal commas"), body.replace(",", ".")
    if separator:
        body = EMPTY_CELL.sub("nan", body)
    rows = body.split("\n")
    numbers = _numbers(rows, separator)
    if np.shape(numbers) != (len(rows), len(columns)):
        k = next(k for k, row in enumerate(rows)
                 if np.shape(_numbers([row], separator)) != (1, len(columns)))
        raise error(source, f"expected {len(columns)} numbers ({', '.join(columns)}), found "
                    f"{quoted(rows[k])}", lines[k])
    return replace(table, numbers=numbers, lines=np.array(lines))


def _numbers(rows, separator):
    """The numbers (m, c) in rows of text, or None if there are words, or c differs."""
    try:
        return np.loadtxt(rows, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        return None
