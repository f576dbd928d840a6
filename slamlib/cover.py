"""What the title page of the PDF says."""

from dataclasses import dataclass, fields, replace
from pathlib import Path

from slamlib.dataset import DatasetError, read_toml


@dataclass(frozen=True)
class Cover:
    """The lines of the title page; an empty one is left out."""

    title: str = "Localization and mapping of a differential-drive vehicle"
    author: str = ""
    student_number: str = ""
    course: str = ""


def read_cover(path):
    """The title page that a `report.toml` describes; without the file, the defaults.

    Raises
    ------
    DatasetError : the file is not TOML, has another key, or a value that is not a line of text.
    """
    path = Path(path)
    if not path.exists():
        return Cover()
    known = [field.name for field in fields(Cover)]
    entries = read_toml(path, 'author = "Ada Lovelace"', known, encoding="utf-8")
    for key, (value, line) in entries.items():
        place = f"{path}, line {line}" if line else str(path)
        if type(value) not in (str, int) or not str(value).isprintable():
            raise DatasetError(f"{place}: expected a line of text in quotes for {key}")
        if "\ufffd" in str(value):
            raise DatasetError(f"{place}: expected UTF-8 text for {key}")
    return replace(Cover(), **{key: str(value) for key, (value, _) in entries.items()})
