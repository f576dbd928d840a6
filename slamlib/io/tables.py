"""Finds the files of a dataset in its folder, and reads tables of numbers from them.

A file is read under its name as browsers and Windows leave it, as `ArucoReading (1).txt`, and a
note says so. Other names are not guessed, but listed. Matrices of .mat files stand in for missing
text files.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from slamlib.core.errors import DatasetError, quoted, require
from slamlib.core.vehicle import Limit
from slamlib.io.formats import (
    CHECKS,
    DATASET_FILES,
    ENCODER,
    GUESS,
    LIMITS,
    TABLES,
    Check,
    given,
    within,
)
from slamlib.io.textfile import is_header, read_rows, split_rows

MAX_BAD_SHARE = 0.1  # of the rows of a sensor, which are left out; with more a file is refused
MAX_LISTED = 5  # names in one sentence
# What may stand after a name without its ending, as browsers and Windows leave it.
ENDING = r"( - copy)?( ?\(\d+\))?(\.(txt|csv|tsv|dat|toml))*"
# Names of files that systems put into folders; clouds leave hidden ones in place of files.
SYSTEM_FILES = re.compile(r"\..*(?<!\.icloud)|thumbs\.db|desktop\.ini|__macosx", re.IGNORECASE)


@dataclass(frozen=True)
class Table:
    """The numbers of a table, with the places of its rows for messages."""

    source: Path | str  # a file or an argument
    numbers: np.ndarray  # (m, c)
    lines: np.ndarray = ()  # (m,) of the rows, from 1
    notes: tuple[str, ...] = ()  # sentences on what was mended or left out

    @property
    def name(self) -> str:
        """Name of the file without its folder, or of the argument."""
        return Path(str(self.source)).name

    def noted(self, note: str) -> "Table":
        """The Table with one more note, a clause about its file."""
        return replace(self, notes=(*self.notes, f"{self.name}{note}."))

    def place(self, row: int) -> str:
        """What messages call a row."""
        kind = "line" if isinstance(self.source, Path) else "row"
        return f"{kind} {self.lines[row]}"

    def require_rows(self, checks: list[Check]):
        """Raise DatasetError about the first row that is not right by all checks."""
        if not _right(checks).all():
            raise DatasetError(f"{self.source}, {self._fault(checks)}")

    def drop_rows(self, checks: list[Check], most: float = np.inf) -> "Table":
        """The Table of the rows that are right by all checks, with a note on the others.

        Raises DatasetError for the first of the others if they are more than `most`.
        """
        ok = _right(checks)
        dropped = np.count_nonzero(~ok)
        if dropped == 0:
            return self
        if dropped > most:
            self.require_rows(checks)
        kept = replace(self, numbers=self.numbers[ok], lines=self.lines[ok])
        return kept.noted(
            f": {dropped} of {len(ok)} rows left out, the first in {self._fault(checks)}")

    def _fault(self, checks):
        """Place, expectation and finding (str) in the first row that is not right."""
        row = int(np.argmin(_right(checks)))
        failed = next(check for check in checks if not check.ok[row])
        found = self.numbers[row]
        if failed.column is not None:
            found = found[[failed.column]]
        found = " ".join(f"{number:.12g}" for number in found)
        return f"{self.place(row)}: expected {failed.expected}, found '{found}'"


def _right(checks):
    return np.all([check.ok for check in checks], axis=0)


def read_table(source: Path | Table | None, name: str, pose_count: int | None = None) -> Table:
    """The Table of a text file or Table, whose rows pass all checks; of None it has no rows.

    `name` is that of its file in LIMITS. With a `pose_count`, the number of poses of the drive, it
    has readings of a sensor, and some rows may be left out. Raises DatasetError for any other row
    that does not pass, as one with words.
    """
    limits = LIMITS[name]
    if source is None:
        return _empty(name, limits)
    table = _table_of_text(source, name) if isinstance(source, Path) else source
    if pose_count is not None:
        return _right_readings(table, name, pose_count)
    table.require_rows(given(table.numbers, limits))
    table.require_rows(within(table.numbers, limits))
    table.require_rows(CHECKS[name](table.numbers))
    return table


def _right_readings(table, name, pose_count):
    """The Table of the readings that a sensor can have made, with notes on the others.

    Rows with NaN and without a range are left out, and up to MAX_BAD_SHARE of others.
    """
    limits = LIMITS[name] | {"pose id": Limit(1, pose_count, whole=True)}
    table = table.drop_rows(given(table.numbers, limits))
    table.require_rows([Check(table.numbers[:, 0] != 0, "pose ids from 1 on")])
    most = MAX_BAD_SHARE * len(table.numbers)
    possible = table.drop_rows(within(table.numbers, limits), most)
    most -= len(table.numbers) - len(possible.numbers)
    return possible.drop_rows(CHECKS[name](possible.numbers), most)


def _empty(source, columns):
    return Table(source, np.empty((0, len(columns))))


def table_of_array(source: str, value, name: str, counted: bool = False) -> Table:
    """The Table of a `value` with the columns LIMITS[name], without rows if it is empty.

    If `counted`, the first column, the numbers of the rows, is not among them. Raises DatasetError,
    which names the `source`, if it is no matrix of real numbers.
    """
    columns = list(LIMITS[name])
    if counted:
        columns = columns[1:]
    try:
        array = np.asarray(value, dtype=float if np.isrealobj(value) else object)
    except (TypeError, ValueError):
        array = np.asarray(value, dtype=object)
    if value is None or array.size == 0:
        return _empty(source, LIMITS[name])
    fits = array.dtype == float and array.ndim == 2 and array.shape[1] == len(columns)
    require(fits, source, f"a matrix of real numbers with {len(columns)} columns "
            f"({', '.join(columns)}), found {array.dtype} of shape {array.shape}")
    rows = np.arange(1, len(array) + 1)
    if counted:
        array = np.column_stack([rows, array])
    return Table(source, array, rows)


def _table_of_text(source, name):
    """The Table of a text file (Path), with NaN for empty cells and without heights of antennas."""
    columns = list(LIMITS[name])
    table = _empty(source, columns)
    rows = read_rows(source)
    lines = list(rows)
    if lines and is_header(rows[lines[0]]):
        header = quoted(rows[lines.pop(0)])
        table = table.noted(
            f": the header {header} was left out; columns were read as {', '.join(columns)}")
    if not lines:
        return table
    texts = [rows[line] for line in lines]
    cells = split_rows(texts, len(columns))
    if name == GUESS and len(cells) < len(texts):
        with_heights = split_rows(texts, 4)
        if len(with_heights) == len(texts):
            cells = [row[:3] for row in with_heights]
            table = table.noted(": the last of 4 columns was taken as z and left out")
    if len(cells) < len(texts):
        k = len(cells)
        require(False, f"{source}, line {lines[k]}",
                f"{len(columns)} numbers ({', '.join(columns)})", texts[k])
    with_commas = np.array(cells)
    numbers = np.strings.replace(with_commas, ",", ".")
    if (numbers != with_commas).any():
        table = table.noted(" was read with decimal commas")
    return replace(table, numbers=numbers.astype(float), lines=np.array(lines))


def contents(folder: Path | str, expected: tuple[str, ...] = DATASET_FILES,
             required: str | None = None) -> tuple[dict, tuple[str, ...]]:
    """Sources (dict of Path or Table) of the files of a folder by name, and notes.

    Raises DatasetError if the folder cannot be read, the file `required` is missing, or two files
    have one of the names `expected`.
    """
    folder = Path(folder)
    files = {}
    notes = []
    others = []
    for path in _listed(folder):
        name = _expected_name(path, expected)
        if name is None:
            others.append(path)
            continue
        require(name not in files, folder / name, "one file of this name, found "
                f"{files.get(name, path).name} and {path.name}: move one of them away")
        files[name] = path
        if path.name.lower() != name.lower():
            notes.append(f"{path.name} was read as {name}.")
    unread = []
    for path in others:
        missing = [name for name in TABLES if name in expected and name not in files]
        tables, said = _matrices(path, missing)
        files |= tables
        notes += said
        if not tables:
            unread.append(path)
    not_read = _not_read(unread)
    if required is not None:
        found = " ".join(["this file, found none."] + not_read)
        require(required in files, folder / required, found.removesuffix("."))
    return files, tuple(notes + not_read)


def _expected_name(path, expected):
    """The one of the names `expected` that a file or the folder `truth` has, or None."""
    for name in expected:
        if name == "truth":
            if path.name.lower() == name:
                return name
        elif re.fullmatch(Path(name).stem + ENDING, path.name, re.IGNORECASE):
            if not path.is_dir():
                return name
    return None


def _matrices(path, names):
    """Tables (dict) of the matrices of a .mat file with the stems of `names`, and notes."""
    tables = {}
    notes = []
    if path.suffix.lower() != ".mat" or not path.is_file() or not names:
        return tables, notes
    try:
        variables = loadmat(path)
    except Exception:  # scipy raises many kinds about other versions and bytes
        return tables, notes
    by_stem = {Path(name).stem.lower(): name for name in names}
    for key, value in variables.items():
        name = by_stem.get(key.lower())
        if name is not None:
            tables[name] = table_of_array(f"{path}, variable {key}", value, name)
            notes.append(f"Variable {key} of {path.name} was read as {name}.")
    return tables, notes


def datasets_in(data: Path | str, names: list[str] | None = None) -> tuple[list[str], list[str]]:
    """Names of the datasets in a folder, and sentences on what else is there.

    They are all sub-folders with files of a dataset, or those that `names` selects. Raises
    DatasetError if there is none, or no sub-folder of a selected name.
    """
    data = Path(data)
    paths = []
    if data.is_dir():
        paths = [path for path in _listed(data) if path.name != "README.md"]
    found = [path.name for path in paths if path.is_dir() and contents(path)[0]]
    require(found, data, f"this folder, with a sub-folder with an {ENCODER} for each dataset, "
            "found none")
    names = found if names is None else list(names)
    for name in names:
        require((data / name).is_dir(), data, f"one of {', '.join(found)}", name)
    others = [path for path in paths if path.name not in found]
    return names, [f"{data}: {sentence}" for sentence in _not_read(others)]


def _listed(folder):
    """Sorted paths in a folder without SYSTEM_FILES."""
    try:
        return sorted(path for path in folder.iterdir() if not SYSTEM_FILES.fullmatch(path.name))
    except (OSError, ValueError):  # ValueError: a NUL character in the folder's name
        place = "" if folder.is_absolute() else f" (paths are relative to {Path.cwd()})"
        raise DatasetError(f"{folder}: expected a folder that can be read{place}") from None


def _not_read(paths):
    """A sentence (list of str) with the first names, or none if there are no paths."""
    if not paths:
        return []
    names = listed([quoted(path.name) for path in paths])
    return [f"Not read: {names}."]


def listed(names: list) -> str:
    """The first MAX_LISTED names, and how many more there are."""
    text = ", ".join(str(name) for name in names[:MAX_LISTED])
    more = len(names) - MAX_LISTED
    return f"{text} and {more} more" if more > 0 else text
