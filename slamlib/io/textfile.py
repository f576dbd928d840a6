"""Reads files into text, TOML entries, and rows of numbers.

Rows of numbers have blanks between columns, decimal points, and comments that begin with `#`, `%`
or `//`. Other separators, decimal commas and a header are read, too.
"""

import re
import tomllib
from difflib import get_close_matches
from json import detect_encoding
from pathlib import Path

from slamlib.core.errors import DatasetError, require

_COMMENT_OR_QUOTE = re.compile(r'(#|%|//).*|"')
_CONTENT = re.compile(r"[^,;\s]")
_LETTER = re.compile("[A-Za-z]")
_NUMBER_FIRST = re.compile(r"(^|[\s,;])\W*(\d|nan\b|inf(inity)?\b)", re.I)  # not in a header


def _number(digits):
    """The pattern of a number with these digits before its exponent, as a group."""
    return rf"([+-]?(?:(?:{digits})(?:e[+-]?[0-9]+)?|nan|inf(?:inity)?))"


_POINT = _number(r"[0-9]+(?:\.[0-9]*)?|\.[0-9]+")
_COMMA = _number("[0-9]+(?:,[0-9]+)?")
# The separator of columns, None for blanks, and the pattern of a number.
DIALECTS = ((None, _POINT), (",", _POINT), (";", _POINT), (None, _COMMA), (";", _COMMA))


def read_toml(path: Path, example: str, known) -> dict:
    """Entries of a TOML file without tables.

    Raises DatasetError, which quotes the `example` of an entry, if the file is not TOML, or has a
    key that is not among the `known` ones.
    """
    text = read_text(path)
    try:
        entries = tomllib.loads(text)
    except (ValueError, RecursionError) as failure:
        raise DatasetError(f"{path}: expected TOML such as '{example}', found: {failure}") from None
    for key in entries:
        nearest = ", ".join(get_close_matches(key, known, 3, cutoff=0))
        require(key in known, path, f"an entry such as {nearest}", key)
    return entries


def read_text(path: Path) -> str:
    """Text of a file in UTF-8, UTF-16 or UTF-32, with line ends '\\n'.

    Bytes that are invalid in it become '\\ufffd'. Raises DatasetError if the file cannot be read,
    or may not end, as a pipe or a device.
    """
    try:
        data = path.read_bytes() if path.is_file() else None
    except OSError:
        data = None
    require(data is not None, path, "a file that can be read")
    text = data.decode(detect_encoding(data), errors="replace").removeprefix("\ufeff")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_rows(path: Path) -> dict[int, str]:
    """Rows of a file by their line, from 1, without comments, quotes and empty rows."""
    text = _COMMENT_OR_QUOTE.sub("", read_text(path))
    rows = {}
    for line, row in enumerate(text.split("\n"), start=1):
        if _CONTENT.search(row):
            rows[line] = row.strip()
    return rows


def is_header(row: str) -> bool:
    """True of a row of words, of which none begins with a digit or is NaN."""
    return bool(_LETTER.search(row)) and not _NUMBER_FIRST.search(row)


def split_rows(rows: list[str], count: int) -> list[tuple[str, ...]]:
    """Numbers as text, `count` for each row, up to the first row that has others.

    They are read in the dialect that reads the most rows; empty cells become "nan".
    """
    return max((_split(rows, count, *dialect) for dialect in DIALECTS), key=len)


def _split(rows, count, separator, number):
    if separator is None:
        columns = r"\s+".join([number] * count)
    else:
        cell = rf"\s*(?:{number}\s*)?"
        columns = separator.join([cell] * count)
    pattern = re.compile(columns + r"[\s,;]*", re.IGNORECASE)
    cells = []
    for row in rows:
        match = pattern.fullmatch(row)
        if match is None:
            break
        cells.append(match.groups("nan"))
    return cells
