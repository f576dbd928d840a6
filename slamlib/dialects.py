"""Tables of numbers, from text in the dialects of spreadsheets and MATLAB, and from .mat files.

The plain dialect has blanks or tabs between columns, decimal points, blank lines and comments from
`#`, `%` or `//` on. Text in another dialect is translated into the plain one, line by line, and a
note says so; what can be read in two ways is refused. Every message names the file and the line.
"""

import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from slamlib.matfile import Variable, variable_text
from slamlib.textfile import error, quoted, read_text

BOUND = 1e15  # every number is smaller in size, so that float64 represents every integer exactly
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
NAN = re.compile(r"[+-]?nan(\([a-z]*\))?", re.IGNORECASE)
COMMENT = re.compile(r"(#|%|//).*")
THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")  # what a decimal comma may be instead
# By name: separator of columns (None for blanks), decimal sign.
DIALECTS = {"blanks": (None, "."), "commas": (",", "."), "semicolons": (";", "."),
            "semicolons, with decimal commas": (";", ","),
            "blanks or tabs, with decimal commas": (None, ",")}
ID = "(id|number|num|nr|no|n|index|idx)?"
COUNTS = "(n|d|c|e|t|w|delta|ticks?|counts?|enc|encoder|wheel|ruota|pulses?|impulsi)*"
# Words of a header, in small letters, by the column that they name.
WORDS = {
    "pose id": f"{ID}(pose|posa|step){ID}",
    "marker id": f"{ID}(marker|aruco|tag|landmark)+{ID}",
    "antenna id": f"{ID}(uwb)?(antenna|anchor|beacon|landmark){ID}",
    "right ticks": f"{COUNTS}(right|destr[ao]|dx|r){COUNTS}",
    "left ticks": f"{COUNTS}(left|sinistr[ao]|sx|l){COUNTS}",
    "x": "x", "y": "y", "theta": "theta|delta|heading|yaw", "range": "range|distance",
    "sigma": "sigma|std|stddev",
    **{f"s_{a}{b}": f"(s|sigma|cov|c|var){a[0]}({a[1:]})?{b[0]}({b[1:]})?" for a, b in (
        ("x", "x"), ("x", "y"), ("x", "theta"), ("y", "y"), ("y", "theta"), ("theta", "theta"))}}


@dataclass(frozen=True)
class Table:
    """Numbers of a file, and what messages about them need."""

    source: Path | Variable | None  # None for no file, whose table has no rows
    numbers: np.ndarray  # (m, c)
    text: str = ""  # the rows in the plain dialect, on the lines that they have in the file
    notes: tuple[str, ...] = ()  # what was mended or left out, a sentence each

    def require(self, ok, expected, column=None):
        """Raise DatasetError for the first row where ok (m,) is False.

        The message quotes the row, or the word in the column with this number from 0.
        """
        if not ok.all():
            line, words = next(islice(_rows(self.text), int(np.argmin(ok)), None))
            found = " ".join(words) if column is None else words[column]
            raise error(self.source, f"expected {expected}, found {quoted(found)}",
                        _place(self.source, line))


def read_table(source, columns, gaps=False, optional=None):
    """The Table of a text file or .mat variable with c columns; m = 0 if `source` is None.

    Parameters
    ----------
    source : Path, Variable or None
    columns : str with the c names, separated by ", ".
    gaps : bool; True leaves out rows with NaN or an empty cell, with a note.
    optional : str or None, name of one more last column, which is left out with a note.

    Raises
    ------
    DatasetError : a row has another number of columns or a word that is not a number below BOUND, a
        header names the columns in another order, or the text can be read in two ways.
    """
    columns = columns.split(", ")
    if source is None:
        return Table(None, np.empty((0, len(columns))))
    notes, name = [], _name(source)
    if isinstance(source, Variable):
        text = variable_text(source)
    else:
        text, encoding = read_text(source)
        notes += [f"{name} was read as {encoding} text."] * bool(encoding)
    numbers = _parsed(text, len(columns))
    if numbers is None:
        text, columns, more = _in_plain_dialect(source, text, columns, gaps, optional)
        notes += more
        numbers = _parsed(text, len(columns), _gaps(columns, gaps, optional))
        if numbers is None:
            raise _table_error(source, text, columns, gaps)
        if columns[-1] == optional:
            numbers = numbers[:, :-1]
            notes.append(f"{name}: the last of {len(columns)} columns was taken as {optional} and "
                         "left out; positions and ranges are taken in the plane.")
        lacking = np.isnan(numbers).any(axis=1)
        if lacking.any():
            text, first = _without(text, lacking)
            numbers = numbers[~lacking]
            notes.append(f"{name}: {np.count_nonzero(lacking)} of {len(lacking)} rows hold NaN and "
                         f"were left out, the first in {_place(source, first)}.")
    return Table(source, numbers, text, tuple(notes))


def _name(source):
    """How notes name a source: without the folder, as the report shows them."""
    return f"{source.path.name}, variable {source.name}" if isinstance(source, Variable) \
        else source.name


def _place(source, line):
    return f"row {line}" if isinstance(source, Variable) else f"line {line}"


def _parsed(text, count, nan=False):
    """Numbers (m, count) of text in the plain dialect, or None where it is not that.

    `nan`, a bool or one for each column, tells where rows may hold NaN.
    """
    if not re.search(r"^[ \t\v\f]*[^#\s]", text, re.MULTILINE):
        return np.empty((0, count))
    try:
        table = np.loadtxt(text.split("\n"), comments="#", ndmin=2)
    except ValueError:
        return None
    ok = abs(table) < BOUND
    return table if table.shape[1] == count and (ok | np.isnan(table) & nan).all() else None


def _gaps(columns, gaps, optional):
    """Which columns may hold NaN (c,): with `gaps` all, else the optional one."""
    return np.array([gaps or column == optional for column in columns])


def _in_plain_dialect(source, text, columns, gaps, optional):
    """The text in the plain dialect, its columns (list of str) and notes (list of str)."""
    name, notes = _name(source), []
    lines = [COMMENT.sub("", line).strip() for line in text.split("\n")]
    lines = [re.sub(r'"([^"]*)"', r"\1", line) for line in lines]
    filled = [k for k, line in enumerate(lines) if line]
    if not filled:
        return "", columns, notes
    header = lines[filled[0]]
    if _is_header(header, columns, more=len(filled) > 1):
        _require_order(source, header, filled[0] + 1, columns)
        lines[filled.pop(0)] = ""
        notes.append(f"{name}: the header {ascii(header[:60])} was left out.")
    for end in ",;":                                # an empty last cell in every row
        if filled and all(lines[k].endswith(end) and lines[k] != end for k in filled):
            lines = [line.removesuffix(end).rstrip() for line in lines]
    for wanted in [columns] + ([[*columns, optional]] if optional else []):
        body = "\n".join(lines)
        fitting = [dialect for dialect in DIALECTS if _fits(body, dialect)
                   and _parsed(_translated(body, dialect), len(wanted),
                               _gaps(wanted, gaps, optional)) is not None]
        if fitting:
            _require_decimals(source, lines, fitting[0])
            notes += [f"{name} was read with columns separated by {fitting[0]}."] * (
                fitting[0] != "blanks")
            return _translated(body, fitting[0]), wanted, notes
    first = lines[filled[0]]
    commas = "commas" if "," in first.split()[0][:-1] else "blanks"
    likely = "semicolons" if ";" in first else commas
    dialect = next((each for each in DIALECTS if _fits(first, each) and _parsed(
        _translated(first, each), len(columns), gaps) is not None), likely)
    raise _table_error(source, "\n".join(lines), columns, gaps, *DIALECTS[dialect])


def _fits(body, dialect):
    """True if the separators of a text can be those of a dialect."""
    separator, decimal = DIALECTS[dialect]
    if separator is None:
        wrong = r";|(?<!\d),|,(?!\d)|\." if decimal == "," else r"[,;]"
    else:                                           # blanks inside a cell would be separators, too
        wrong = rf"[^\s{separator}][^\S\n]+[^\s{separator}]"
        wrong += {",": "|;", ";": "|," if decimal == "." else r"|\.|(?<!\d),|,(?!\d)"}[separator]
    return not re.search(wrong, body)


def _translated(body, dialect):
    """Text of a dialect in the plain one; an empty cell is NaN."""
    separator, decimal = DIALECTS[dialect]
    if separator is not None:
        body = re.sub(rf"(?m)^[^\S\n]*(?={separator})|(?<={separator})[^\S\n]*(?=$|{separator})",
                      "nan", body)
        body = body.replace(separator, " ")
    return re.sub(r"(?i)(?<=nan)\([a-z]*\)", "", body.replace(",", ".") if decimal == "," else body)


def _is_header(line, columns, more):
    """True if a line has words of which none begins as a number does.

    Without `more` rows it must name two columns.
    """
    words = [word for word in re.split(r"[\s,;]+", line) if word]
    numbers = any(re.match(r"\W*\d", word) or NAN.fullmatch(word) or "inf" in word.lower()
                  for word in words)
    return bool(re.search("[A-Za-z]", line)) and not numbers and (
        more or len(_named(line, columns)) > 1)


def _named(header, columns):
    """Numbers of the columns that the words of a header name, in their order there."""
    words = [re.sub("[^a-z]", "", word) for word in re.split(r"[\s,;]+", header.lower())]
    return [k for word in words for k, column in enumerate(columns)
            if column in WORDS and re.fullmatch(WORDS[column], word)]


def _require_order(source, header, line, columns):
    """Raise DatasetError if the header names columns in another order."""
    named = _named(header, columns)
    if named != sorted(named):
        raise error(source, f"expected the columns in the order ({', '.join(columns)}), found the "
                    f"header {quoted(header)}", line)


def _require_decimals(source, lines, dialect):
    """Raise DatasetError if all decimal commas may be separators of thousands as well."""
    if DIALECTS[dialect][1] == ",":
        cells = [(k, cell) for k, line in enumerate(lines, start=1)
                 for cell in re.split(r"[\s;]+", line) if "," in cell]
        if all(THOUSANDS.fullmatch(cell) for _, cell in cells):
            line, cell = cells[0]
            raise error(source, f"expected decimal points, found {quoted(cell)}, which is "
                        f"{cell.replace(',', '.')} or {cell.replace(',', '')}", line)


def _without(text, lacking):
    """The text without the rows where lacking (m,) is True, and the number of the first one's line.
    """
    lines = text.split("\n")
    numbers = [line for line, _ in _rows(text)]
    left_out = [numbers[k] for k in np.flatnonzero(lacking)]
    for line in left_out:
        lines[line - 1] = ""
    return "\n".join(lines), left_out[0]


def _table_error(source, text, columns, gaps, separator=None, decimal="."):
    """The DatasetError about the first row that does not follow a dialect."""
    expected = f"expected {len(columns)} columns ({', '.join(columns)})"
    for line, words in _rows(text, separator):
        place = _place(source, line)
        if len(words) != len(columns):
            return error(source, f"{expected}, found {len(words)}", place)
        for word in words:
            plain = word if decimal == "." else word.replace(".", "?").replace(",", ".")
            number = NUMBER.fullmatch(plain) and abs(float(plain)) < BOUND
            if not number and not (gaps and (not word or NAN.fullmatch(word))):
                expected = f"expected finite numbers (below {BOUND:g} in size)"
                return error(source, f"{expected}, found {quoted(word)}", place)
    return error(source, expected)  # unreachable unless numpy and NUMBER disagree


def _rows(text, separator=None):
    """Yield line number and words of every line that has more than a comment."""
    for line, content in enumerate(text.split("\n"), start=1):
        if words := content.partition("#")[0].strip():
            yield line, [word.strip() for word in words.split(separator)]
