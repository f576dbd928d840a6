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
    notes: tuple[str, ...] = ()  # clauses on what was mended or left out

    @property
    def name(self) -> str:
        """Name of the file without its folder, or of the argument."""
        return Path(self.source).name

    def noted(self, note: str) -> "Table":
        """The Table with one more note."""
        return replace(self, notes=(*self.notes, note))

    def drop_rows(self, checks: dict[str, np.ndarray], most: float = np.inf) -> "Table":
        """The Table of the rows that are right by all checks, with a note on the others.

        Checks are masks (m,) of the rows that are right, by what is expected. Raises DatasetError
        for the first of the others if they are more than `most`.
        """
        ok = np.all(list(checks.values()), axis=0)
        if ok.all():
            return self
        row = np.argmin(ok)
        expected = next(each for each, right in checks.items() if not right[row])
        found = shorten(" ".join(f"{number:.12g}" for number in self.numbers[row]), 120)
        fault = f"{self.kind} {self.lines[row]}: expected {expected}, found '{found}'"
        dropped = np.count_nonzero(~ok)
        if dropped > most:
            raise DatasetError(f"{self.source}, {fault}")
        return self.rows(ok).noted(f"{dropped} of {len(ok)} rows left out, the first in {fault}")

    def ids(self, column: int) -> np.ndarray:
        """The whole numbers of a column, (m,) int64."""
        return self.numbers[:, column].astype(int)

    def rows(self, which: np.ndarray) -> "Table":
        """The Table of rows by a mask or indices."""
        return replace(self, numbers=self.numbers[which], lines=self.lines[which])


def sentences(*tables: Table) -> tuple[str, ...]:
    """Sentences of the notes of Tables, each note once with the names of its tables."""
    names = {}
    for table in tables:
        for note in table.notes:
            names.setdefault(note, []).append(table.name)
    return tuple(f"{', '.join(named)}: {note}." for note, named in names.items())


def read_table(files: dict, name: str, pose_count: int | None = None) -> Table:
    """The Table of a file by its name in LIMITS, whose rows pass all checks.

    `files` has its source, a Path or Table; without it there are no rows. The rows are in ascending
    order of the first column. With a `pose_count`, the number of poses of the drive, the table has
    readings of a sensor: rows with NaN, without a range or repeated are left out, and up to
    MAX_BAD_SHARE of those that are beyond limits, and of those that are impossible as a whole.
    Raises DatasetError for any other row that does not pass, as one with words.
    """
    limits = LIMITS[name]
    table = files.get(name)
    if table is None:
        return Table(name, np.empty((0, len(limits))))
    if isinstance(table, Path):
        table = _table_of_text(table, name)
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
        array = np.asarray(value).astype(float, casting="same_kind")
    except (TypeError, ValueError):
        require(False, source, expected, value)
    if array.size == 0:
        array = np.empty((0, count))
    require(array.shape[1:] == (count,), source, expected, f"shape {array.shape}")
    return Table(source, array, np.arange(1, len(array) + 1), "row")


def _table_of_text(path, name):
    """The Table of a text file, with NaN for empty cells and without heights of antennas."""
    columns = LIMITS[name]
    count = len(columns)
    numbers = []
    notes = set()
    rows = read_rows(path)
    lines = list(rows)
    if lines and not re.search(NUMBER, rows[lines[0]]):
        lines.pop(0)
        notes.add("read without the header line")
    for line in lines:
        cells = cells_of(rows[line])
        if "," in "".join(cells):
            notes.add("read with decimal commas")
            cells = [cell.replace(",", ".") for cell in cells]
        try:
            row = [float(cell or "nan") for cell in cells]
        except ValueError:
            row = []
        while len(row) > count and np.isnan(row[-1]):
            row.pop()
        if name == GUESS and len(row) == count + 1:
            row.pop()
            notes.add("read without z, the fourth column")
        require(len(row) == count, f"{path}, line {line}",
                f"{count} numbers ({', '.join(columns)})", rows[line])
        numbers.append(row)
    if not numbers:
        notes.add("no rows of numbers")
    matrix = np.array(numbers).reshape(-1, count)
    return Table(path, matrix, np.array(lines), notes=tuple(sorted(notes)))


def contents(folder: Path | str, required: str | None = None,
             expected: tuple[str, ...] = DATASET_FILES) -> tuple[dict, tuple[str, ...]]:
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
        if missing and path.suffix.lower() == ".mat" and path.is_file():
            matrices = _matrices(path, missing)
            sources += matrices
            if not matrices:
                reasons.append(f"{path.name}: expected a matrix named as {' or '.join(missing)} of "
                               "a file that 'save -v7' wrote.")
    files = {}
    for name, source in sources:
        earlier = files.setdefault(name, source)
        require(earlier is source, folder / source.name, f"only one {name}", earlier.name)
    renamed = [f"{source.name} as {name}" for name, source in files.items()
               if source.name.lower() != name.lower()]
    notes = [f"Read {', '.join(renamed)}."] if renamed else []
    used = [source.name.split(",")[0] for source in files.values()]
    others = [path for path in paths if path.name not in used]
    not_read = _not_read(others) + reasons
    if required:
        told = " ".join(["this file, found none.", *not_read])
        require(required in files, folder / required, told)
    return files, tuple(notes + not_read)


def _matrices(path, names):
    """Pairs (list) of one of `names` and the Table of the matrix so named in a .mat file."""
    by_stem = {Path(name).stem.lower(): name for name in names}
    try:
        found = loadmat(path)
    except Exception:  # scipy raises many kinds about other versions and bytes
        return []
    tables = []
    for variable, value in found.items():
        name = by_stem.get(variable.lower())
        if name:
            source = f"{path}, variable {variable}"
            tables.append((name, table_of_array(source, value, LIMITS[name])))
    return tables


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
    return [f"Not read: {shorten(names, 100)}."]
