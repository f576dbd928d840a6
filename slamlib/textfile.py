"""Text files read into checked numbers.

Blank lines and `#` comments are skipped. Whatever does not follow the format raises `DatasetError`,
whose message names the file, the line and what was expected there.
"""

import re
import stat
import tomllib
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

import numpy as np

BOUND = 1e15  # every number is smaller in size, so that float64 represents every integer exactly
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
CONTROL_BYTE = re.compile(rb"[\x00-\x08\x0e-\x1f]")


class DatasetError(ValueError):
    """A dataset does not follow the format; the message names file, line and expectation."""


def find(folder, name, required=False):
    """Path of the file `name` in a folder, upper and lower case being the same, or None.

    Raises DatasetError if two files have the name, a required file is missing, a name is almost
    right (the file would otherwise be ignored silently) or the folder cannot be read.
    """
    try:
        lower_names = {path: path.name.lower() for path in Path(folder).iterdir()}
    except (OSError, ValueError):  # ValueError: a NUL character in the folder's name
        raise error(folder, "expected a folder that can be read") from None
    paths = [path for path, lower in lower_names.items() if lower == name.lower()]
    if len(paths) > 1:
        names = " and ".join(sorted(path.name for path in paths))
        raise error(Path(folder) / name, f"expected one file of this name, found {names}")
    if not paths and (close := get_close_matches(name.lower(), lower_names.values(), 1, 0.9)):
        misnamed = next(path for path, lower in lower_names.items() if lower == close[0])
        raise error(misnamed, f"expected the name {name}")
    if required and not paths:
        raise error(Path(folder) / name, "expected this file, found none")
    return paths[0] if paths else None


def read_table(path, columns):
    """Numbers (m, c) of a text file with c columns separated by blanks; m = 0 if path is None.

    `columns` is a str with the c names, separated by ", ". Raises DatasetError if a row has another
    number of columns or a word that is not a number below BOUND.
    """
    columns = columns.split(", ")
    text = "" if path is None else _read_text(path)
    if not re.search(r"^[ \t\v\f]*[^#\s]", text, re.MULTILINE):
        return np.empty((0, len(columns)))
    try:
        table = np.loadtxt(text.split("\n"), comments="#", ndmin=2)
    except ValueError:
        table = np.full((1, 1), np.nan)
    if table.shape[1] != len(columns) or not (abs(table) < BOUND).all():
        raise _table_error(path, text, columns)
    return table


def read_toml(path, example, known, encoding="ascii"):
    """Entries of a TOML file without tables: a dict from key to (value, line number or None).

    Parameters
    ----------
    path : Path
    example : str, a valid entry, quoted in the message.
    known : list of str, the allowed keys.
    encoding : str; bytes that are invalid in this encoding become '\\ufffd'.

    Raises
    ------
    DatasetError : the file is not TOML, or has a key that is not allowed.
    """
    text = _read_text(path, encoding)
    try:
        entries = tomllib.loads(text)
    except (ValueError, RecursionError) as failure:
        reason, _, place = str(failure).partition(" (at ")
        if at_line := re.match(r"line (\d+)", place):
            line = int(at_line[1])
        else:
            line = text.rstrip("\n").count("\n") + 1 if place == "end of document)" else None
        raise error(path, f"expected TOML such as '{example}' ({reason})", line) from None
    for key, value in entries.items():
        at_key = re.search(rf"""^[\s\["']*{re.escape(key)}(?![\w-])""", text, re.MULTILINE)
        line = text.count("\n", 0, at_key.end()) + 1 if at_key else None
        if key not in known:
            raise error(path, f"expected keys among {', '.join(known)}, found {quoted(key)}", line)
        entries[key] = value, line
    return entries


def require(ok, path, expected, column=None):
    """Raise DatasetError for the first row of a file where ok (m,) is False.

    The message quotes the row, or the word in the column with this number from 0.
    """
    if not ok.all():
        line, words = next(islice(_rows(_read_text(path)), int(np.argmin(ok)), None))
        found = " ".join(words) if column is None else words[column]
        raise error(path, f"expected {expected}, found {quoted(found)}", line)


def error(path, message, line=None):
    """DatasetError whose message begins with the path and the line, if there is one."""
    return DatasetError(f"{path}{'' if line is None else f', line {line}'}: {message}")


def read_regular(path):
    """Bytes of a file; DatasetError if it is no regular file or cannot be read.

    Reading a pipe waits for a writer, and some devices have no end.
    """
    expected = "expected a file that can be read"
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            kind = "a folder" if stat.S_ISDIR(mode) else "a pipe" if stat.S_ISFIFO(mode) \
                else "a socket" if stat.S_ISSOCK(mode) else "a device"
            raise error(path, f"{expected}, found {kind}")
        return path.read_bytes()
    except OSError:
        raise error(path, expected) from None


def _read_text(path, encoding="ascii"):
    """Text with line ends '\\n'; bytes that are invalid in this encoding become '\\ufffd'."""
    data = read_regular(path)
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if control := CONTROL_BYTE.search(data):
        line = data.count(b"\n", 0, control.start()) + 1
        raise error(path, f"expected plain text, found the byte 0x{control[0].hex()}", line)
    return data.decode(encoding, errors="replace")


def _table_error(path, text, columns):
    expected = f"expected {len(columns)} columns ({', '.join(columns)})"
    for line, words in _rows(text):
        if len(words) != len(columns):
            return error(path, f"{expected}, found {len(words)}", line)
        for word in words:
            if not NUMBER.fullmatch(word) or abs(float(word)) >= BOUND:
                expected = f"expected finite numbers (below {BOUND:g} in size)"
                return error(path, f"{expected}, found {quoted(word)}", line)
    return error(path, expected)  # unreachable unless numpy and NUMBER disagree


def _rows(text):
    """Yield line number and words of every line that has more than a comment."""
    for line, content in enumerate(text.split("\n"), start=1):
        if words := content.partition("#")[0].split():
            yield line, words


def quoted(value, longest=60):
    """The beginning of a value as text, in quotes."""
    try:
        text = str(value)
    except ValueError:                         # Python writes no integers of thousands of digits
        return "a far longer number"
    return repr(text if len(text) <= longest else text[:longest] + "...")
