"""Reads tables of numbers from .mat files, and from text as spreadsheets and MATLAB write it.

Plain text has blanks or tabs between columns, decimal points, and comments that begin with `#`.
Other text is rewritten as plain text, line by line, with a note; ambiguous text is refused.
"""

import re
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from slamlib.limits import LIMITS
from slamlib.textfile import error, quoted, read_regular, read_text

# Words that are numbers, by the decimal sign; comments; commas that may separate thousands.
NUMBERS = {sign: re.compile(rf"[+-]?({digits}(e[+-]?\d+)?|nan(\([a-z]*\))?|inf(inity)?)", re.I)
           for sign, digits in ((".", r"(\d+\.?\d*|\.\d+)"), (",", r"\d+(,\d+)?"))}
COMMENT = re.compile(r"(#|%|//).*")
THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
SEPARATORS = {";": "semicolons", ",": "commas", None: "blanks or tabs"}
# Words of headers that name a column; others are the ends of the columns' own names, as "xx".
HEADER_WORDS = {"pose id": "pose posa step", "marker id": "marker aruco tag landmark",
                "antenna id": "antenna anchor beacon landmark",
                "right ticks": "right destra dx r", "left ticks": "left sinistra sx l",
                "theta": "theta delta heading yaw", "range": "range distance", "sigma": "sigma std"}


@dataclass(frozen=True)
class Variable:
    """A table in a .mat file, or an argument of `Dataset.from_arrays`."""

    path: Path | None  # None of an argument
    name: str  # with the struct's, as `logs.UwbReading`
    value: object  # what scipy or numpy made of it

    def __str__(self):
        return f"{self.path}, variable {self.name}" if self.path else self.name

    def text(self):
        """The rows as text (str), one a line; DatasetError if it is no matrix of real numbers."""
        if getattr(self.value, "ndim", 0) != 2 or self.value.dtype.kind not in "iuf":
            raise error(self, "expected a matrix of real numbers")
        return "\n".join(" ".join(map(repr, row)) for row in self.value.tolist())


@dataclass(frozen=True)
class Table:
    """The numbers of a table, with its text for messages."""

    source: Path | Variable | None  # None if there is no file
    numbers: np.ndarray  # (m, c)
    text: str = ""  # plain, with the lines of the file
    rows: np.ndarray | None = None  # (m,) numbers from 0 of the rows among those of the text
    notes: tuple[str, ...] = ()  # sentences on what was mended or left out

    def noted(self, note):
        """The Table with one more note, a clause about its file."""
        return replace(self, notes=(*self.notes, f"{Path(str(self.source)).name}{note}."))

    def place(self, k):
        """Line of row k in the file, as part of a sentence, and the row's words."""
        filled = ((n, words) for n, line in enumerate(self.text.split("\n"), start=1)
                  if (words := line.partition("#")[0].split()))
        line, words = next(islice(filled, int(self.rows[k]), None))
        return f"{'row' if isinstance(self.source, Variable) else 'line'} {line}", words

    def kept(self, ok, expected, share=0.0):
        """The Table of the rows where `ok` is True, with a note on the others.

        Raises DatasetError for the first of the others if they are more than a share of the rows,
        or those of an argument.

        Parameters
        ----------
        ok : (m,) or (m, c) bool; the latter tells the word to quote.
        expected : str, or one for each column
        """
        if ok.all():
            return self
        bad = ~(ok if ok.ndim == 1 else ok.all(axis=1))
        count, first = np.count_nonzero(bad), int(np.argmax(bad))
        place, words = self.place(first)
        column = int(np.argmin(ok[first])) if ok.ndim == 2 else None
        found = quoted(" ".join(words) if column is None else words[column])
        expected = expected if isinstance(expected, str) else expected[column]
        if count > share * len(bad) or getattr(self.source, "path", self) is None:
            raise error(self.source, f"expected {expected}, found {found}", place)
        kept = replace(self, numbers=self.numbers[~bad], rows=self.rows[~bad])
        return kept.noted(f": {count} of {len(bad)} rows left out, the first in {place}: expected "
                          f"{expected}, found {found}")


def read_table(source, name, share=0.0, **options):
    """The Table of a source, with numbers within LIMITS in all but a share of the rows.

    The `options`, parameters and errors are those of `_read`.
    """
    table, limits = _read(source, name, **options), LIMITS[name]
    if share:
        table = table.kept(~np.isnan(table.numbers), "numbers", share=1)
    if "range" in limits:
        table = table.kept(table.numbers[:, 2] != 0, "a range, which 0 (no reception) is not", 1)
    minimum, maximum, whole = np.array([
        [limit.minimum, limit.maximum, limit.whole] for limit in limits.values()]).T
    ok = (minimum <= table.numbers) & (table.numbers <= maximum)
    return table.kept(ok & ((table.numbers == np.rint(table.numbers)) | (whole == 0)), [
        f"{column}, a {'whole' if limit.whole else 'finite'} number {limit}"
        for column, limit in limits.items()], share)


def _read(source, name, optional=None, settled=False):
    """The Table of a text file, .mat variable or argument; m = 0 if `source` is None.

    Parameters
    ----------
    source : Path, Variable or None
    name : str, key of LIMITS, which has the columns
    optional : str or None, name of one more last column, which is left out with a note.
    settled : bool, whether other files of the folder have decimal commas.

    Raises
    ------
    DatasetError : a row has another number of columns or a word that is not a number, a header
        names the columns in another order, or the text is ambiguous.
    """
    columns = list(LIMITS[name])
    table = Table(source=source, numbers=np.empty((0, len(columns))), rows=np.arange(0))
    if source is None:
        return table
    text, encoding = (source.text(), "") if isinstance(source, Variable) else read_text(source)
    table = table.noted(f" was read as {encoding} text") if encoding else table
    numbers = _numbers(text)
    if numbers is None or numbers.shape[1] != len(columns):
        table, text = _plain(table, text, columns, optional, settled)
        numbers = _numbers(text)
    if numbers is None:
        return table.noted(" holds no rows")
    if numbers.shape[1] > len(columns):
        table = table.noted(f": the last of {numbers.shape[1]} columns was taken as {optional} and "
                            "left out; positions and ranges are taken in the plane")
    return replace(table, numbers=numbers[:, :len(columns)], text=text,
                   rows=np.arange(len(numbers)))


def _numbers(text):
    """Numbers (m, c) of plain text, or None for other text or none."""
    try:
        if re.search(r"^[^\S\n]*[^#\s]", text, re.MULTILINE):
            return np.loadtxt(text.split("\n"), comments="#", ndmin=2)
    except ValueError:
        pass
    return None


def _plain(table, text, columns, optional, settled):
    """The Table with notes, and its text as plain text; an empty cell is NaN."""
    lines = [COMMENT.sub("", line).replace('"', "").strip() for line in text.split("\n")]
    filled = [k for k, line in enumerate(lines) if line.strip(" \t,;")]
    header = lines[filled[0]] if filled else ""
    if re.search("[A-Za-z]", header) and not re.search(r"(?i)(^|[\s,;])\W*(\d|nan\b|inf)", header):
        _require_order(table.source, header, filled.pop(0) + 1, columns)
        table = table.noted(f": the header {ascii(header[:60])} was left out")
    rows = [lines[k] for k in filled]
    for end in ",;":                                # an empty last cell in every row
        if all(row.endswith(end) for row in rows):
            rows = [row.removesuffix(end).rstrip() for row in rows]
    first, body = rows[0] if rows else "", "\n".join(rows)
    # Blanks inside of a cell mean that commas are no separators.
    separator = ";" if ";" in first else "," if "," in first and not any(
        len(cell.split()) > 1 for cell in first.split(",")) else None
    decimal = "," if separator != "," and "," in body and "." not in body else "."
    if separator or decimal == ",":
        table = table.noted(f" was read with columns separated by {SEPARATORS[separator]}"
                            f"{', with decimal commas' if decimal == ',' else ''}")
    if optional and len(first.split(separator)) == len(columns) + 1:
        columns = [*columns, optional]
    lines, commas = [""] * len(lines), []
    for k, row in zip(filled, rows):
        cells = _cells(table.source, k, row.split(separator), columns, NUMBERS[decimal])
        commas += [(k, cell) for cell in cells if "," in cell]
        lines[k] = " ".join(cells)
    if commas and not settled and all(THOUSANDS.fullmatch(cell) for _, cell in commas):
        k, cell = commas[0]
        raise error(table.source, f"expected decimal points, found {quoted(cell)}, which is "
                    f"{cell.replace(',', '.')} or {cell.replace(',', '')}", k + 1)
    return table, re.sub(r"\([a-z]*\)", "", "\n".join(lines).lower().replace(",", "."))


def _cells(source, k, words, columns, number):
    """The words of the line with index k (list of str), as many as columns; each matches `number`.
    """
    place = f"row {k + 1}" if isinstance(source, Variable) else k + 1
    if len(words) != len(columns):
        raise error(source, f"expected {len(columns)} columns ({', '.join(columns)}), found "
                    f"{len(words)}", place)
    cells = [word.strip() or "nan" for word in words]
    for cell in cells:
        if not number.fullmatch(cell):
            raise error(source, f"expected finite numbers, found {quoted(cell)}", place)
    return cells


def _require_order(source, header, line, columns):
    """Raise DatasetError if a header names columns in another order."""
    words = [HEADER_WORDS.get(column, column.rpartition("_")[2]).split() for column in columns]
    parts = re.findall("[A-Z]?[a-z]+|[A-Z]+", header)       # `ticksLeft`, `tick_sx` and `nL`
    named = [k for part in parts for k, names in enumerate(words) if part.lower() in names]
    if (order := list(dict.fromkeys(named))) != sorted(order):
        raise error(source, f"expected the columns in the order ({', '.join(columns)}), found the "
                    f"header {quoted(header)}", line)


def mat_variables(path):
    """Values (dict) of the variables and fields of a .mat file, by names as `logs.UwbReading`.

    Raises DatasetError if it cannot be read, or is of another version than MATLAB's 5 to 7.
    """
    data, kind = read_regular(path), "expected a .mat file of version 7 or older, saved with '-v7'"
    try:
        found = loadmat(BytesIO(data))
    except Exception:                   # scipy raises many kinds about other versions and bytes
        raise error(path, kind) from None
    values = {name: value for name, value in found.items() if not name.startswith("__")}
    for name, value in list(values.items()):
        if getattr(value, "shape", None) == (1, 1) and value.dtype.names:
            values |= {f"{name}.{each}": value[each][0, 0] for each in value.dtype.names}
            del values[name]
    return values
