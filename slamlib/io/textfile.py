"""Reads files into text, TOML entries, and rows of words.

Rows of numbers have blanks between columns, decimal points, and comments that begin with `#`, `%`
or `//`. Commas or semicolons between columns, decimal commas and a header line are read, too.
"""

import re
import tomllib
from difflib import get_close_matches
from json import detect_encoding
from pathlib import Path

from slamlib.core.errors import DatasetError, require

_COMMENT_OR_QUOTE = r'(#|%|//).*|"'
_BLANKS_AT_SEPARATOR = r"(?<=[,;])[^\S\n]+|(?<!\s)[^\S\n]+(?=[,;])"


def read_toml(path: Path, example: str, known) -> tuple[dict, dict]:
    """Entries of a TOML file without tables, and their places, file and line, by the same keys.

    Raises DatasetError, which quotes the `example` of an entry, if the file is not TOML, or has a
    key that is not among the `known` ones.
    """
    text = read_text(path)
    try:
        entries = tomllib.loads(text)
    except (ValueError, RecursionError) as failure:
        raise DatasetError(f"{path}: expected TOML such as '{example}', found: {failure}") from None
    places = {key: _place(path, text, key) for key in entries}
    for key, place in places.items():
        alike = get_close_matches(key, known, 1)
        require(key in known, place, f"entries such as '{alike[0] if alike else example}'", key)
    return entries, places


def _place(path, text, key):
    """The path and, where it can be told, the line of a key."""
    for line, row in enumerate(text.split("\n"), start=1):
        if re.match(rf"[^\w#]*{re.escape(key)}\b", row):
            return f"{path}, line {line}"
    return path


def read_text(path: Path) -> str:
    """Text of a file in UTF-8 or UTF-16, with line ends '\\n'.

    Bytes that are invalid in it become '\\ufffd'. Raises DatasetError if there is no file, or what
    may not end, as a pipe or a device.
    """
    require(path.is_file(), path, "a file that can be read")
    encoding = detect_encoding(path.read_bytes())
    return path.read_text(encoding, errors="replace")


def read_rows(path: Path) -> dict[int, str]:
    """Rows of a file by their line, from 1, without comments, quotes, and rows without words."""
    text = re.sub(_COMMENT_OR_QUOTE, "", read_text(path))
    text = re.sub(_BLANKS_AT_SEPARATOR, "", text)
    rows = enumerate(text.split("\n"), start=1)
    return {line: row.strip() for line, row in rows if row.strip(" \t,;")}


def cells_of(row: str) -> list[str]:
    """Cells of a row between semicolons, else between blanks, else between commas."""
    if ";" in row.rstrip(";"):
        return row.split(";")
    words = row.rstrip(",;").split()
    if len(words) > 1:
        return words
    return row.split(",")
