"""Reads files into text and TOML entries."""

import tomllib
from difflib import get_close_matches
from json import detect_encoding

from slamlib.core.errors import DatasetError, require


def read_toml(path, example, known):
    """Entries (dict) of a TOML file without tables.

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


def read_text(path):
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
