"""The file report.toml: the title page, and what the report and the hand-in show."""

from dataclasses import dataclass, field, fields
from pathlib import Path

from slamlib.textfile import DatasetError, quoted, read_toml

CODE_SHOWN = ("none", "method", "all")  # what code is shown: none, all that is not hidden, or all
# Folder of the results of each estimate that may be handed in as problem 2.
PROBLEM2_FOLDERS = {"aruco": "problem2", "fused": "problem2_fused", "hint": "problem2_hint"}


@dataclass(frozen=True)
class Options:
    """Options of report.toml; an empty line of the title page is left out."""

    title: str = "Localization and mapping of a differential-drive vehicle"
    author: str = ""
    student_number: str = ""
    course: str = ""
    leave_out: dict = field(default_factory=dict)  # from numbers and titles to the place in a file
    appendix: bool | None = None  # None: the report has it, the hand-in has not
    code: str = "method"  # one of CODE_SHOWN
    problem2: str = "aruco"  # which is handed in, of PROBLEM2_FOLDERS; required is markers alone


def read_options(path):
    """Return the Options that the file `path` (str or Path) describes; without it, the defaults.

    DatasetError if the file is not TOML, has an unknown key, or a value is not as it must be.
    """
    if not Path(path).exists():
        return Options()
    keys = [option.name for option in fields(Options)]
    entries = read_toml(Path(path), 'author = "Ada Lovelace"', keys, encoding="utf-8")
    return Options(**{key: _checked(key, value, f"{path}, line {line}" if line else str(path))
                      for key, (value, line) in entries.items()})


def _checked(key, value, place):
    """Return the value of a key as Options have it; DatasetError, which begins with `place`."""
    def require(ok, expected):
        if not ok:
            raise DatasetError(f"{place}: expected {expected} for {key}, found {quoted(value)}")

    if choices := {"code": CODE_SHOWN, "problem2": PROBLEM2_FOLDERS}.get(key):
        require(type(value) is str and value in choices,
                f"one of {', '.join(map(repr, choices))}")
    elif key == "appendix":
        require(type(value) is bool, "true or false")
    elif key == "leave_out":
        require(type(value) is list and all(type(entry) is str for entry in value),
                'a list of numbers and titles in quotes, such as ["B", "3.5", "Explore"],')
        return dict.fromkeys(value, place)
    else:
        require(type(value) in (str, int) and str(value).isprintable(), "a line of text in quotes")
        require("\ufffd" not in str(value), "UTF-8 text")
        return str(value)
    return value
