"""The title page of the PDF."""

from dataclasses import dataclass, fields
from pathlib import Path

from slamlib.textfile import DatasetError, read_toml


@dataclass(frozen=True)
class Cover:
    """The lines of the title page; an empty line is left out."""

    title: str = "Localization and mapping of a differential-drive vehicle"
    author: str = ""
    student_number: str = ""
    course: str = ""


def read_cover(path):
    """Return the Cover that the file `path` (str or Path) describes; without it, the default.

    DatasetError if the file is not TOML, has an unknown key, or a value is not a line of text.
    """
    path = Path(path)
    if not path.exists():
        return Cover()
    known = [field.name for field in fields(Cover)]
    entries = read_toml(path, 'author = "Ada Lovelace"', known, encoding="utf-8")
    for key, (value, line) in entries.items():
        position = f"{path}, line {line}" if line else str(path)
        if type(value) not in (str, int) or not str(value).isprintable():
            raise DatasetError(f"{position}: expected a line of text in quotes for {key}")
        if "\ufffd" in str(value):
            raise DatasetError(f"{position}: expected UTF-8 text for {key}")
    return Cover(**{key: str(value) for key, (value, _) in entries.items()})
