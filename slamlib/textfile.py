"""Reads files into text and TOML entries.

A `DatasetError` is one sentence, which names the file, the line and what was expected there.
"""

import re
import stat
import tomllib
from difflib import get_close_matches

CONTROL_BYTE = re.compile(rb"[\x00-\x08\x0e-\x1f]")  # bytes that no text has


class DatasetError(ValueError):
    """A dataset does not follow the format; the message names file, line and expectation."""


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
    text = read_text(path, encoding)[0]
    try:
        entries = tomllib.loads(text)
    except (ValueError, RecursionError) as failure:
        reason, _, place = str(failure).partition(" (at ")
        end = text.rstrip("\n").count("\n") + 1 if place == "end of document)" else None
        line = int(found[1]) if (found := re.match(r"line (\d+)", place)) else end
        raise error(path, f"expected TOML such as '{example}' ({reason})", line) from None
    for key, value in entries.items():
        at_key = re.search(rf"""^[\s\["']*{re.escape(key)}(?![\w-])""", text, re.MULTILINE)
        line = text.count("\n", 0, at_key.end()) + 1 if at_key else None
        if key not in known:
            nearest = ", ".join(get_close_matches(key, known, 3, cutoff=0))
            raise error(path, f"expected an entry such as {nearest}, found {quoted(key)}", line)
        entries[key] = value, line
    return entries


def read_text(path, encoding="ascii"):
    """Text of a file with line ends '\\n', and the name of its encoding if that is UTF-16, or "".

    Bytes that are invalid in `encoding` become '\\ufffd'. UTF-16 has a byte order mark, or NUL in
    every second byte. Raises DatasetError if the file cannot be read or has control bytes.
    """
    data = read_regular(path)
    utf16 = next((codec for codec, is_so in (
        ("utf-16", data[:2] in (b"\xff\xfe", b"\xfe\xff")),
        ("utf-16-le", data[1:] and not data[1::2].strip(b"\0")),
        ("utf-16-be", data and not data[::2].strip(b"\0"))) if is_so), "")
    try:
        data = data.decode(utf16).encode() if utf16 else data
    except UnicodeError:
        raise error(path, "expected plain text, found UTF-16 that breaks off") from None
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if control := CONTROL_BYTE.search(data):
        line = data.count(b"\n", 0, control.start()) + 1
        raise error(path, f"expected plain text, found the byte 0x{control[0].hex()}", line)
    return data.decode(encoding, errors="replace"), "UTF-16" if utf16 else ""


def error(path, message, line=None):
    """DatasetError whose message begins with the path and the line, if there is one.

    `line` is a number, or a str such as "row 3" where the rows of a file are not lines.
    """
    place = "" if line is None else f", {line}" if isinstance(line, str) else f", line {line}"
    return DatasetError(f"{path}{place}: {message}")


def read_regular(path):
    """Bytes of a file; DatasetError if it is no regular file or cannot be read.

    Reading a pipe waits for a writer, and some devices have no end.
    """
    expected = "expected a file that can be read"
    try:
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode):
            raise error(path, f"{expected}, found a " + (
                "folder" if stat.S_ISDIR(mode) else "pipe" if stat.S_ISFIFO(mode) else "device"))
        return path.read_bytes()
    except OSError:
        raise error(path, expected) from None


def quoted(value):
    """The first 60 characters (str) of a value, in quotes."""
    try:
        text = str(value)
    except ValueError:                         # Python writes no integers of thousands of digits
        return "a far longer number"
    return repr(text if len(text) <= 60 else text[:60] + "...")
