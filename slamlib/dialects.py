"""Tables of numbers, from text as editors, spreadsheets and MATLAB write it, and from arrays.

Plain text has blanks or tabs between columns, decimal points, and comments that begin with `#`, `%`
or `//`. Other separators, decimal commas and a header are read with a note. The limits of the
numbers are far wider than vehicles, cameras and antennas need: a number beyond them has another
unit, or float64 loses digits beside it. data/README.md lists them.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slamlib.folder import Variable
from slamlib.textfile import error, quoted, read_text


@dataclass(frozen=True)
class Limit:
    """The closed interval in which a number lies."""

    minimum: float
    maximum: float | str     # a str names the entry of the same file that is the maximum
    unit: str = ""
    whole: bool = False

    def __str__(self):
        maximum = self.maximum if isinstance(self.maximum, str) else f"{self.maximum:g}"
        return f"from {self.minimum:g} to {maximum} {self.unit}".rstrip()


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

COMMENTS = "#", "%", "//"
BLANKS = " \t\v\f"
SEPARATORS = {";": "semicolons", ",": "commas", None: "blanks or tabs"}
EMPTY_CELL = re.compile(rf"(?:^|(?<=[;,]))[{BLANKS}]*(?=[;,]|$)", re.MULTILINE)
NUMBER = re.compile(r"([+-]?((\d+\.?\d*|\.\d+)(e[+-]?\d+)?|nan|inf(inity)?))?", re.IGNORECASE)
NUMBER_FIRST = re.compile(r"(^|[\s,;])\W*(\d|nan\b|inf)", re.IGNORECASE)  # in a row, not a header
POINT_OR_LOOSE_COMMA = re.compile(r"\.|(?<!\d),|,(?!\d)")  # where commas are no decimal commas
# Words of headers that name a column; others are the ends of the columns' own names, as "xx".
HEADER_WORDS = {"pose id": "pose posa step", "marker id": "marker aruco tag landmark",
                "antenna id": "antenna anchor beacon landmark",
                "right ticks": "right destra dx r", "left ticks": "left sinistra sx l",
                "theta": "theta delta heading yaw", "range": "range distance", "sigma": "sigma std"}


@dataclass(frozen=True)
class Table:
    """The numbers of a table, with its rows for messages."""

    source: Path | Variable | None  # None if there is no file
    numbers: np.ndarray  # (m, c)
    rows: list | np.ndarray = ()  # (m,) str, or (m, c) of a Variable
    lines: list | np.ndarray = ()  # (m,) of the rows in the file, from 1
    separator: str | None = None  # of the rows' words
    notes: tuple[str, ...] = ()  # sentences on what was mended or left out

    def noted(self, note):
        """The Table with one more note, a clause about its file."""
        return replace(self, notes=(*self.notes, f"{Path(str(self.source)).name}{note}."))

    def place(self, k):
        """Line of row k in the file, as part of a sentence."""
        return f"{'row' if isinstance(self.source, Variable) else 'line'} {self.lines[k]}"

    def kept(self, ok, expected, share=0.0):
        """The Table of the rows where `ok` is True, with a note on the others.

        `ok` (m,) or (m, c) is bool; the latter tells the word to quote, and `expected` (str) may be
        one for each column. Raises DatasetError for the first of the others if they are more than a
        share of the rows, or those of an argument.
        """
        if ok.all():
            return self
        bad = ~ok.reshape(len(ok), -1).all(axis=1)
        count, first = np.count_nonzero(bad), int(np.argmax(bad))
        row, place = self.rows[first], self.place(first)
        words = row.split(self.separator) if isinstance(row, str) else map(repr, row.tolist())
        words = [word.strip() for word in words]
        column = int(np.argmin(ok[first])) if ok.ndim == 2 else slice(None)
        expected = expected if isinstance(expected, str) else expected[column]
        found = quoted(" ".join(np.atleast_1d(words[column])))
        if count > share * len(bad) or getattr(self.source, "path", self) is None:
            raise error(self.source, f"expected {expected}, found {found}", place)
        kept = replace(self, numbers=self.numbers[~bad], lines=np.array(self.lines)[~bad],
                       rows=np.array(self.rows, dtype=object)[~bad])
        return kept.noted(f": {count} of {len(bad)} rows left out, the first in {place}: expected "
                          f"{expected}, found {found}")


def read_table(source, name, share=0.0, optional=None):
    """The Table of a text file (Path), a Variable, or None, which has no rows.

    The columns are those of LIMITS[name]. One more last column, called `optional`, is left out with
    a note. A share of the rows may be beyond LIMITS, and if it is not 0, any may have NaN. Raises
    DatasetError if there are more, a row has another number of columns or a word that is not a
    number, or a header names the columns in another order.
    """
    limits, columns = LIMITS[name], list(LIMITS[name])
    if source is None:
        return Table(source=source, numbers=np.empty((0, len(columns))))
    if isinstance(source, Variable):
        rows = matrix(source, source.value, columns, optional)
        table = Table(source=source, numbers=rows.astype(float), rows=rows,
                      lines=range(1, len(rows) + 1))
    else:
        table = _table_of_text(source, columns, optional)
    if not len(table.numbers):
        return table.noted(" holds no rows")
    if table.numbers.shape[1] > len(columns):
        table = table.noted(f": the last of {len(columns) + 1} columns was taken as {optional} and "
                            "left out; positions and ranges are taken in the plane")
        table = replace(table, numbers=table.numbers[:, :-1])
    if share:
        table = table.kept(~np.isnan(table.numbers), [f"{each}, a number" for each in columns], 1)
    if "range" in limits:
        table = table.kept(table.numbers[:, 2] != 0, "a range, which 0 (no reception) is not", 1)
    x, whole = table.numbers, np.array([limit.whole for limit in limits.values()])
    minimum, maximum = np.array([[each.minimum, each.maximum] for each in limits.values()]).T
    return table.kept((minimum <= x) & (x <= maximum) & ((x == np.rint(x)) | ~whole), [
        f"{column}, a {'whole' if limit.whole else 'finite'} number {limit}"
        for column, limit in limits.items()], share)


def matrix(source, value, columns, optional=None):
    """The array (m, c) of a `value` with these columns; m = 0 if it is empty.

    Raises DatasetError for another shape and if it holds no real numbers.
    """
    try:
        array = np.asarray(value)
    except ValueError:                                       # rows of different lengths
        array = np.asarray(value, dtype=object)
    if array.size == 0:
        return np.empty((0, len(columns)))
    if array.dtype.kind not in "iuf" or array.ndim != 2 \
            or array.shape[1] - len(columns) not in (0, bool(optional)):
        raise error(source, f"expected a matrix of real numbers with {len(columns)} columns "
                    f"({', '.join(columns)}), found {array.dtype} of shape {array.shape}")
    return array


def _table_of_text(source, columns, optional):
    """The Table of a text file, with NaN for empty cells."""
    text, encoding = read_text(source)
    table = Table(source=source, numbers=np.empty((0, len(columns))))
    table = table.noted(f" was read as {encoding} text") if encoding else table
    text = text.replace('"', "").replace("(ind)", "").replace("(snan)", "")    # nan(ind)
    for mark in COMMENTS:
        text = re.sub(f"{mark}.*", "", text) if mark in text else text
    rows = text.rstrip().split("\n")
    lines = [k for k, row in enumerate(rows, start=1) if row.strip(BLANKS + ",;")]
    header = rows[lines[0] - 1].strip() if lines else ""
    if re.search("[A-Za-z]", header) and not NUMBER_FIRST.search(header):
        _require_order(source, header, lines.pop(0), columns)
        table = table.noted(f": the header {ascii(header[:60])} was left out")
    if not lines:
        return table
    rows = [rows[k - 1] for k in lines] if len(lines) < len(rows) else rows
    for end in ",;":                                # an empty last cell in every row
        if all(row.rstrip().endswith(end) for row in rows):
            rows = [row.rstrip().removesuffix(end) for row in rows]
    first, body = rows[0], "\n".join(rows) if "," in text or ";" in text else ""
    # Blanks inside of a cell mean that commas are no separators.
    separator = ";" if ";" in first else "," if "," in first and not any(
        len(cell.split()) > 1 for cell in first.split(",")) else None
    decimals = separator != "," and "," in body and not POINT_OR_LOOSE_COMMA.search(body)
    if separator or decimals:
        table = table.noted(f" was read with columns separated by {SEPARATORS[separator]}"
                            f"{', with decimal commas' * decimals}")
    if optional and len(first.split(separator)) == len(columns) + 1:
        columns = [*columns, optional]
    plain = rows
    if separator or decimals:
        body = body.replace(",", ".") if decimals else body
        plain = (EMPTY_CELL.sub("nan", body) if separator else body).split("\n")
    try:
        numbers = np.loadtxt(plain, delimiter=separator, comments=None, ndmin=2)
    except ValueError:
        numbers = np.empty((0, 0))
    if numbers.shape[1] != len(columns):
        cells = (row.split(separator) for row in rows)
        raise _fault(source, zip(lines, cells), columns, decimals)
    return replace(table, numbers=numbers, rows=rows, lines=lines, separator=separator)


def _fault(source, rows, columns, decimals):
    """DatasetError about the first of the rows (line, cells) without a number for each column."""
    for line, cells in rows:
        if len(cells) != len(columns):
            return error(source, f"expected {len(columns)} columns ({', '.join(columns)}), found "
                         f"{len(cells)}", line)
        for cell in map(str.strip, cells):
            if not NUMBER.fullmatch(cell.replace(",", ".") if decimals else cell):
                return error(source, f"expected finite numbers, found {quoted(cell)}", line)
    return error(source, "expected rows of numbers")    # unless numpy and NUMBER agree


def _require_order(source, header, line, columns):
    """Raise DatasetError if a header names columns in another order."""
    words = [HEADER_WORDS.get(column, column.rpartition("_")[2]).split() for column in columns]
    parts = re.findall("[A-Z]?[a-z]+|[A-Z]+", header)       # `ticksLeft`, `tick_sx` and `nL`
    named = [k for part in parts for k, names in enumerate(words) if part.lower() in names]
    if (order := list(dict.fromkeys(named))) != sorted(order):
        raise error(source, f"expected the columns in the order ({', '.join(columns)}), found the "
                    f"header {quoted(header)}", line)
