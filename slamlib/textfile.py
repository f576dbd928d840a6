"""Reads files into text and TOML entries.

A `DatasetError` is one sentence, which names the file, the line and what was expected there.
"""

import re
import tomllib
from difflib import get_close_matches
from json import detect_encoding

CONTROL_BYTES = bytes([*range(9), *range(14, 32)])  # which no text has


class DatasetError(ValueError):
    """A dataset does not follow the format; the message names file, line and expectation."""


def error(source, message, line=None):
    """DatasetError whose message begins with the source, a file or argument, and the line, if any.

    `line` is a number, or a str such as "row 3" where the rows of a source are not lines.
    """
    place = line if isinstance(line, str) else f"line {line}"
    return DatasetError(f"{source}{'' if line is None else f', {place}'}: {message}")


def quoted(value):
    """The first 60 characters (str) of a value, in quotes."""
    try:
        text = str(value)
    except ValueError:                         # Python writes no integers of thousands of digits
        return "a far longer number"
    return repr(text if len(text) <= 60 else text[:60] + "...")


def read_toml(path, example, known, encoding="ascii"):
    """Entries of a TOML file without tables: a dict from key to (value, line number or None).

    Raises DatasetError, which quotes the `example` of an entry, if the file is not TOML, or has a
    key that is not among the `known` ones. For `encoding` see `read_text`.
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
    """Text of a file with line ends '\\n', and its encoding if that is UTF-16 or UTF-32, or "".

    Bytes that are invalid in `encoding` become '\\ufffd'. Raises DatasetError if the file cannot be
    read or has control bytes.
    """
    data = read_bytes(path)
    codec = detect_encoding(data)                # by a byte order mark, or by where NUL bytes are
    wide = "" if codec.startswith("utf-8") else codec[:6].upper()
    try:
        data = data.decode(codec).encode() if wide else data
    except UnicodeError:
        raise error(path, f"expected plain text, found {wide} that breaks off") from None
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if len(data.translate(None, CONTROL_BYTES)) < len(data):
        first = next(k for k, byte in enumerate(data) if byte in CONTROL_BYTES)
        raise error(path, f"expected plain text, found the byte 0x{data[first]:02x}",
                    data.count(b"\n", 0, first) + 1)
    return data.decode(encoding, errors="replace"), wide


def read_bytes(path):
    """Bytes of a file; DatasetError if it cannot be read, or may not end, as a pipe or a device."""
    try:
        if path.is_file():
            return path.read_bytes()
    except OSError:
        pass
    found = ", found a folder" if path.is_dir() else ""
    raise error(path, f"expected a file that can be read{found}")
