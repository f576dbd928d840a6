"""Finds the files of a dataset in its folder, and reads tables of numbers from them.

A file is read under its name as browsers and Windows leave it, as `ArucoReading (1).txt`, and a
note says so. Other names are not guessed, but listed. Matrices of .mat files stand in for missing
text files.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import shorten

import numpy as np
from scipy.io import loadmat

from slamlib.core.errors import DatasetError, require
from slamlib.core.vehicle import Limit
from slamlib.io.formats import (
    ARUCO,
    DATASET_FILES,
    ENCODER,
    GUESS,
    LIMITS,
    UWB,
    together,
    unrepeated,
    within,
)
from slamlib.io.textfile import cells_of, read_rows

MAX_BAD_SHARE = 0.1  # of the rows of a sensor, which are left out; with more a file is refused
NUMBER = r"(?i)(^|[\s,;])\W*(\d|nan\b|inf\b)"  # in a row that is no header
# What may stand after a name without its ending, as browsers and Windows leave it.
ENDING = r"( ?\(\d+\))?(\.(txt|csv|tsv|dat|toml))*"


@dataclass(frozen=True)
class Table:
    """The numbers of a table, with the places of its rows for messages."""

    source: Path | str  # a file or an argument
    numbers: np.ndarray  # (m, c)
    lines: np.ndarray = ()  # (m,) of the rows, from 1
    kind: str = "line"  # what messages call a row
    notes: tuple[str, ...] = ()  # sentences on what was mended or left out

    @property
    def name(self) -> str:
        """Name of the file without its folder, or of the argument."""
        return Path(self.source).name

    def noted(self, note: str) -> "Table":
        """The Table with one more note, a clause about its file."""
        return replace(self, notes=(*self.notes, f"{self.name}{note}."))

    def drop_rows(self, checks: dict[str, np.ndarray], most: float = np.inf) -> "Table":
        """The Table of the rows that are right by all checks, with a note on the others.

        Checks are masks (m,) of the rows that are right, by what is expected. Raises DatasetError
        for the first of the others if they are more than `most`.
        """
        ok = np.all(list(checks.values()), axis=0)
        if ok.all():
            return self
        row = int(np.argmin(ok))
        expected = next(each for each, right in checks.items() if not right[row])
        found = " ".join(f"{number:.12g}" for number in self.numbers[row])
        fault = f"{self.kind} {self.lines[row]}: expected {expected}, found '{found}'"
        dropped = np.count_nonzero(~ok)
        if dropped > most:
            raise DatasetError(f"{self.source}, {fault}")
        return self.rows(ok).noted(f": {dropped} of {len(ok)} rows left out, the first in {fault}")

    def ids(self, column: int) -> np.ndarray:
        """The whole numbers of a column, (m,) int64."""
        return self.numbers[:, column].astype(np.int64)

    def rows(self, which: np.ndarray) -> "Table":
        """The Table of rows by a mask or indices."""
        return replace(self, numbers=self.numbers[which], lines=self.lines[which])


def read_table(source: Path | Table | None, name: str, pose_count: int | None = None) -> Table:
    """The Table of a text file or Table, whose rows pass all checks; of None it has no rows.

    `name` is that of its file in LIMITS. The rows are in ascending order of the first column. With
    a `pose_count`, the number of poses of the drive, the table has readings of a sensor: rows with
    NaN, without a range or repeated are left out, and up to MAX_BAD_SHARE of others. Raises
    DatasetError for any other row that does not pass, as one with words.
    """
    limits = LIMITS[name]
    table = source
    if source is None:
        return Table(name, np.empty((0, len(limits))))
    if isinstance(source, Path):
        table = _table_of_text(source, limits, name == GUESS)
    most = 0
    if pose_count is not None:
        limits = limits | {"pose id": Limit(1, pose_count, "(the rows of the encoder)", whole=True)}
        is_complete = ~np.isnan(table.numbers).any(axis=1)
        if name == UWB:
            is_complete &= table.numbers[:, 2] != 0
        table = table.drop_rows({"no gap (an empty cell, NaN or the range 0)": is_complete})
        table.drop_rows({"pose ids from 1 on": table.numbers[:, 0] != 0}, most)
        most = MAX_BAD_SHARE * len(table.numbers)
    right = table.drop_rows(within(table.numbers, limits), most)
    most -= len(table.numbers) - len(right.numbers)
    right = right.drop_rows(together(right.numbers, name), most)
    # A detector may repeat its last result; ranges are rounded so that they repeat by chance.
    judged = right.numbers[:, 1:] if name == ARUCO else right.numbers
    right = right.drop_rows({"each reading only once": unrepeated(judged)})
    return right.rows(np.argsort(right.numbers[:, 0], kind="stable"))


def table_of_array(source: str, value, columns) -> Table:
    """The Table of a `value` with these columns, without rows if it is empty.

    Raises DatasetError, which names the `source`, if it is no matrix of numbers.
    """
    count = len(columns)
    expected = f"a matrix of numbers with {count} columns ({', '.join(columns)})"
    try:
        array = np.asarray(value, float)
    except (TypeError, ValueError):
        require(False, source, expected, value)
    if array.size == 0:
        array = np.empty((0, count))
    require(array.shape[1:] == (count,), source, expected, f"shape {array.shape}")
    return Table(source, array, np.arange(1, len(array) + 1), "row")


def _table_of_text(path, columns, may_have_z):
    """The Table of a text file, with NaN for empty cells and without heights of antennas."""
    count = len(columns)
    numbers = []
    how = set()
    rows = read_rows(path)
    lines = list(rows)
    if lines and not re.search(NUMBER, rows[lines[0]]):
        lines.pop(0)
        how.add("without its header line")
    for line in lines:
        cells = cells_of(rows[line])
        if "," in "".join(cells):
            how.add("with decimal commas")
            cells = [cell.replace(",", ".") for cell in cells]
        try:
            row = [float(cell or "nan") for cell in cells]
        except ValueError:
            row = []
        while len(row) > count and np.isnan(row[-1]):
            row.pop()
        if may_have_z and len(row) == count + 1:
            row.pop()
            how.add("without z, its fourth column")
        if len(row) != count:
            require(False, f"{path}, line {line}", f"{count} numbers ({', '.join(columns)})",
                    rows[line])
        numbers.append(row)
    table = Table(path, np.array(numbers).reshape(-1, count), np.array(lines))
    if how:
        table = table.noted(f" was read {' and '.join(sorted(how))}")
    if not numbers:
        table = table.noted(" has no rows of numbers")
    return table


def contents(folder: Path | str, expected: tuple[str, ...] = DATASET_FILES,
             required: str | None = None) -> tuple[dict, tuple[str, ...]]:
    """Sources (dict of Path or Table) of the files of a folder by name, and notes.

    Raises DatasetError if the folder cannot be read, the file `required` is missing, or two files
    or matrices have one of the names `expected`.
    """
    folder = Path(folder)
    paths = _listed(folder)
    sources = [(name, path) for path in paths for name in expected
               if re.fullmatch(Path(name).stem + ENDING, path.name, re.IGNORECASE)]
    found = dict(sources)
    missing = [name for name in LIMITS if name in expected and name not in found]
    reasons = []
    for path in paths:
        if missing and path.suffix.lower() == ".mat":
            matrices, reason = _matrices(path, missing)
            sources += matrices
            if not matrices:
                reasons.append(reason)
    files = {}
    for name, source in sources:
        earlier = files.setdefault(name, source)
        require(earlier is source, folder / source.name, f"only one {name}", earlier.name)
    notes = [f"{source.name} was read as {name}." for name, source in files.items()
             if source.name.lower() != name.lower()]
    used = [source.name.split(",")[0] for source in files.values()]
    others = [path for path in paths if path.name not in used]
    not_read = _not_read(others) + reasons
    if required is not None:
        told = " ".join(["this file, found none.", *not_read])
        require(required in files, folder / required, told)
    return files, tuple(notes + not_read)


def _matrices(path, names):
    """Pairs (list) of one of `names` and the Table of the matrix so named, and why if none is."""
    by_stem = {Path(name).stem.lower(): name for name in names}
    try:
        require(path.is_file(), path, "a file that can be read")
        found = loadmat(path)
    except Exception as error:  # scipy raises many kinds about other versions and bytes
        found = {str(error): None}
    tables = []
    for variable, value in found.items():
        name = by_stem.get(variable.lower())
        if name:
            source = f"{path}, variable {variable}"
            tables.append((name, table_of_array(source, value, LIMITS[name])))
    told = ", ".join(variable for variable in found if not variable.startswith("__"))
    return tables, (f"{path.name}: expected a matrix named as {' or '.join(names)} of a file that "
                    f"'save -v7' wrote, found {told!r}.")


def datasets_in(data: Path, names: list[str] | None = None) -> tuple[list[str], list[str]]:
    """Names of the datasets in a folder, and sentences on what else is there.

    They are all sub-folders with files of a dataset, or those that `names` selects. Raises
    DatasetError if there is none, or no sub-folder of a selected name.
    """
    paths = [path for path in _listed(data) if path.name != "README.md"]
    found = [path.name for path in paths if path.is_dir() and contents(path)[0]]
    require(found, data, f"this folder, with a sub-folder with an {ENCODER} for each dataset, "
            "found none")
    names = names or found
    for name in names:
        require((data / name).is_dir(), data, f"one of {', '.join(found)}", name)
    others = [path for path in paths if path.name not in found]
    return names, [f"{data}: {sentence}" for sentence in _not_read(others)]


def _listed(folder):
    """Sorted paths in a folder without hidden ones."""
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError:
        raise DatasetError(f"{folder.absolute()}: expected a folder that can be read") from None


def _not_read(paths):
    """A sentence (list of str) with the first names, or none if there are no paths."""
    if not paths:
        return []
    names = ", ".join(repr(path.name) for path in paths)
    return [f"Not read: {shorten(names, 100, placeholder=' ...')}."]
