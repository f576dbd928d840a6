"""Reads tables of numbers from .mat files, and from text as spreadsheets and MATLAB write it.

The plain dialect has blanks or tabs between columns, decimal points, blank lines, and comments that
begin with `#`, `%` or `//`. Text in another dialect is translated into the plain one, line by line,
with a note; ambiguous text is refused. Every message names the file and the line.
"""

import re
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from slamlib.matfile import Variable, variable_text
from slamlib.textfile import error, quoted, read_text

MAX_SIZE = 1e15  # bound on the size of numbers; float64 represents integers below it exactly
# Words that are numbers or NaN; comments; numbers whose commas may also separate thousands.
DECIMAL_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
NAN = re.compile(r"[+-]?nan(\([a-z]*\))?", re.IGNORECASE)
COMMENT = re.compile(r"(#|%|//).*")
THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(,\d{3})+")
# Separator of columns (None for blanks) and decimal sign, by name.
DIALECTS = {"blanks": (None, "."), "commas": (",", "."), "semicolons": (";", "."),
            "semicolons, with decimal commas": (";", ","),
            "blanks or tabs, with decimal commas": (None, ",")}
# Parts of the words in headers, and the words that name a column, as patterns in small letters.
ID_WORDS = "(id|number|num|nr|no|n|index|idx)?"
TICK_WORDS = "(n|d|c|e|t|w|delta|ticks?|counts?|enc|encoder|wheel|ruota|pulses?|impulsi)*"
COLUMN_WORDS = {
    "pose id": f"{ID_WORDS}(pose|posa|step){ID_WORDS}",
    "marker id": f"{ID_WORDS}(marker|aruco|tag|landmark)+{ID_WORDS}",
    "antenna id": f"{ID_WORDS}(uwb)?(antenna|anchor|beacon|landmark){ID_WORDS}",
    "right ticks": f"{TICK_WORDS}(right|destr[ao]|dx|r){TICK_WORDS}",
    "left ticks": f"{TICK_WORDS}(left|sinistr[ao]|sx|l){TICK_WORDS}",
    "x": "x", "y": "y", "theta": "theta|delta|heading|yaw", "range": "range|distance",
    "sigma": "sigma|std|stddev",
    **{f"s_{a}{b}": f"(s|sigma|cov|c|var){a[0]}({a[1:]})?{b[0]}({b[1:]})?" for a, b in (
        ("x", "x"), ("x", "y"), ("x", "theta"), ("y", "y"), ("y", "theta"), ("theta", "theta"))}}


@dataclass(frozen=True)
class Table:
    """The numbers of a table, with its text for messages."""

    source: Path | Variable | None  # None if there is no file
    numbers: np.ndarray  # (m, c)
    text: str = ""  # in the plain dialect, with the lines of the file
    notes: tuple[str, ...] = ()  # sentences on what was mended or left out

    def require(self, ok, expected, column=None):
        """Raise DatasetError for the first row where ok (m,) is False.

        The message quotes the row, or the word in the column with this number from 0.
        """
        if not ok.all():
            line, words = next(islice(_filled_lines(self.text), int(np.argmin(ok)), None))
            found = " ".join(words) if column is None else words[column]
            raise error(self.source, f"expected {expected}, found {quoted(found)}",
                        _row_name(self.source, line))


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
    DatasetError : a row has another number of columns or a word that is not a number below
        MAX_SIZE, a header names the columns in another order, or the text is ambiguous.
    """
    columns = columns.split(", ")
    if source is None:
        return Table(None, np.empty((0, len(columns))))
    notes, name = [], _source_name(source)
    if isinstance(source, Variable):
        text = variable_text(source)
    else:
        text, encoding = read_text(source)
        notes += [f"{name} was read as {encoding} text."] * bool(encoding)
    numbers = _parsed(text, len(columns))
    if numbers is None:
        text, columns, more = _in_plain_dialect(source, text, columns, gaps, optional)
        notes += more
        numbers = _parsed(text, len(columns), _may_be_nan(columns, gaps, optional))
        if numbers is None:
            raise _table_error(source, text, columns, gaps)
        if columns[-1] == optional:
            numbers = numbers[:, :-1]
            notes.append(f"{name}: the last of {len(columns)} columns was taken as {optional} and "
                         "left out; positions and ranges are taken in the plane.")
        lacking = np.isnan(numbers).any(axis=1)
        if lacking.any():
            text, first = _without_rows(text, lacking)
            numbers = numbers[~lacking]
            notes.append(f"{name}: {np.count_nonzero(lacking)} of {len(lacking)} rows hold NaN and "
                         f"were left out, the first in {_row_name(source, first)}.")
    return Table(source, numbers, text, tuple(notes))


def _source_name(source):
    """Name (str) of a source in notes, without the folder."""
    return f"{source.path.name}, variable {source.name}" if isinstance(source, Variable) \
        else source.name


def _row_name(source, line):
    return f"row {line}" if isinstance(source, Variable) else f"line {line}"


def _parsed(text, count, nan=False):
    """Numbers (m, count) of text in the plain dialect, or None for other text.

    `nan`, a bool or (count,) bool, is True for columns that may hold NaN.
    """
    if not re.search(r"^[ \t\v\f]*[^#\s]", text, re.MULTILINE):
        return np.empty((0, count))
    try:
        table = np.loadtxt(text.split("\n"), comments="#", ndmin=2)
    except ValueError:
        return None
    ok = abs(table) < MAX_SIZE
    return table if table.shape[1] == count and (ok | np.isnan(table) & nan).all() else None


def _may_be_nan(columns, gaps, optional):
    """Mask (c,) of columns that may hold NaN: all with `gaps`, else the optional one."""
    return np.array([gaps or column == optional for column in columns])


def _in_plain_dialect(source, text, columns, gaps, optional):
    """The text in the plain dialect, its columns (list of str) and notes (list of str)."""
    name, notes = _source_name(source), []
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
                               _may_be_nan(wanted, gaps, optional)) is not None]
        if fitting:
            _require_decimals(source, lines, fitting[0])
            notes += [f"{name} was read with columns separated by {fitting[0]}."] * (
                fitting[0] != "blanks")
            return _translated(body, fitting[0]), wanted, notes
    first = lines[filled[0]]
    commas = "commas" if "," in first.split()[0][:-1] else "blanks"
    likely = "semicolons" if ";" in first else commas
    dialect = next((name for name in DIALECTS if _fits(first, name) and _parsed(
        _translated(first, name), len(columns), gaps) is not None), likely)
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
    """True if a line has words, none of which begins like a number.

    Without `more` rows it must name two columns.
    """
    words = [word for word in re.split(r"[\s,;]+", line) if word]
    numbers = any(re.match(r"\W*\d", word) or NAN.fullmatch(word) or "inf" in word.lower()
                  for word in words)
    return bool(re.search("[A-Za-z]", line)) and not numbers and (
        more or len(_named_columns(line, columns)) > 1)


def _named_columns(header, columns):
    """Indices (list) of the columns that the words of a header name, in their order there."""
    words = [re.sub("[^a-z]", "", word) for word in re.split(r"[\s,;]+", header.lower())]
    return [k for word in words for k, column in enumerate(columns)
            if column in COLUMN_WORDS and re.fullmatch(COLUMN_WORDS[column], word)]


def _require_order(source, header, line, columns):
    """Raise DatasetError if the header names columns in another order."""
    named = _named_columns(header, columns)
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


def _without_rows(text, lacking):
    """The text without the rows where lacking (m,) is True, and the number of the first one's line.
    """
    lines = text.split("\n")
    numbers = [line for line, _ in _filled_lines(text)]
    left_out = [numbers[k] for k in np.flatnonzero(lacking)]
    for line in left_out:
        lines[line - 1] = ""
    return "\n".join(lines), left_out[0]


def _table_error(source, text, columns, gaps, separator=None, decimal="."):
    """The DatasetError about the first row that does not follow a dialect."""
    expected = f"expected {len(columns)} columns ({', '.join(columns)})"
    for line, words in _filled_lines(text, separator):
        place = _row_name(source, line)
        if len(words) != len(columns):
            return error(source, f"{expected}, found {len(words)}", place)
        for word in words:
            plain = word if decimal == "." else word.replace(".", "?").replace(",", ".")
            number = DECIMAL_NUMBER.fullmatch(plain) and abs(float(plain)) < MAX_SIZE
            if not number and not (gaps and (not word or NAN.fullmatch(word))):
                expected = f"expected finite numbers (below {MAX_SIZE:g} in size)"
                return error(source, f"{expected}, found {quoted(word)}", place)
    return error(source, expected)  # unreachable unless numpy and DECIMAL_NUMBER disagree


def _filled_lines(text, separator=None):
    """Yield line number and words of every line that has more than a comment."""
    for line, content in enumerate(text.split("\n"), start=1):
        if words := content.partition("#")[0].strip():
            yield line, [word.strip() for word in words.split(separator)]
