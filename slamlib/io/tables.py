"""Finds the files of a dataset in its folder, and reads tables of numbers from them.

A file is read under its name as browsers and Windows leave it, as `ArucoReading (1).txt`, and a
note says so. Other names are not guessed, but listed. Matrices of .mat files stand in for missing
text files. Text has blanks between columns, decimal points, and comments that begin with `#`, `%`
or `//`; other separators, decimal commas and a header are read. The limits of the numbers are far
wider than vehicles, cameras and antennas need: a number beyond them has another unit, or float64
loses digits beside it. data/README.md lists them.
"""

import re
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path

import numpy as np
from scipy.io import loadmat

from slamlib.core import se2
from slamlib.core.errors import DatasetError, quoted, require
from slamlib.core.vehicle import Limit
from slamlib.io.textfile import read_text

ENCODER = "encoderReading.txt"


_ANY = Limit(-1e15, 1e15)               # float64 represents whole numbers up to there exactly
_WHOLE = Limit(-1e15, 1e15, whole=True)  # ids and counts
_VARIANCE = Limit(1e-18, 1e8, "m^2")
_IN_VEHICLE, _GUESS, _TRUE = (Limit(-size, size, "m") for size in (1e4, 1e6, 1e9))
_ANGLE, _TRUE_ANGLE = (Limit(-size, size, "rad") for size in (6.3, 1e9))
# Limits by the name of a file and by its column, in the order of the file.
LIMITS = {
    ENCODER: {"pose id": _WHOLE, "right ticks": _WHOLE, "left ticks": _WHOLE},
    "ArucoReading.txt": {
        "pose id": _WHOLE, "marker id": _WHOLE, "x": _IN_VEHICLE, "y": _IN_VEHICLE, "theta": _ANGLE,
        "s_xx": _VARIANCE, "s_xy": _ANY, "s_xtheta": _ANY, "s_yy": _VARIANCE, "s_ytheta": _ANY,
        "s_thetatheta": Limit(1e-18, 1e14, "rad^2")},
    "UwbReading.txt": {"pose id": _WHOLE, "antenna id": _WHOLE, "range": Limit(-5e4, 1e5, "m"),
                       "sigma": Limit(1e-9, 1e4, "m")},
    "UwbAntennaGuess.txt": {"antenna id": _WHOLE, "x": _GUESS, "y": _GUESS},
    "vehiclePose.txt": {"pose id": _WHOLE, "x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "ArucoMap.txt": {"marker id": _WHOLE, "x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "UwbMap.txt": {"antenna id": _WHOLE, "x": _TRUE, "y": _TRUE}}

MAX_BAD_SHARE = 0.1  # of the rows of a sensor, which are left out; with more a file is refused
MIN_EIGENVALUE = 1e-12  # of a correlation matrix; with a smaller one it counts as singular
MAX_NEGATIVE_SIGMAS = 5.0  # sigmas, by which noise may make a range negative
COVARIANCE = [[5, 6, 7], [6, 8, 9], [7, 9, 10]]  # columns of the covariance of a sighting

_COUNTED = (lambda x: x[:, 0] == np.arange(1, len(x) + 1), "pose ids 1, 2, 3, ... in order")
_UNIQUE = (lambda x: np.isin(np.arange(len(x)), np.unique(x[:, 0], return_index=True)[1]),
           "each id only once")
# By file, which rows of its numbers (m, c) are right, and what is expected of them. Covariances are
# scaled to correlations: s_thetatheta may be 1e4 rad^2 where s_xx is 1e-4 m^2.
CHECKS = {
    ENCODER: _COUNTED, "vehiclePose.txt": _COUNTED, "UwbAntennaGuess.txt": _UNIQUE,
    "ArucoMap.txt": _UNIQUE, "UwbMap.txt": _UNIQUE,
    "ArucoReading.txt": (
        lambda x: np.linalg.eigvalsh(se2.correlations(x[:, COVARIANCE]))[:, 0] > MIN_EIGENVALUE,
        "a positive definite covariance (smallest eigenvalue of its correlation matrix above "
        f"{MIN_EIGENVALUE:g})"),
    "UwbReading.txt": (lambda x: x[:, 2] >= -MAX_NEGATIVE_SIGMAS * x[:, 3],
                       f"a range that is not below -{MAX_NEGATIVE_SIGMAS:g} sigma")}
# Names of the tables of a drive and of its truth, and of all files in its folder.
TABLES, TRUTH_FILES = tuple(LIMITS)[:4], (*tuple(LIMITS)[4:], "vehicle.toml")
DATASET_FILES = (*TABLES, "vehicle.toml", "truth")
# What may stand after a name without its ending, as browsers and Windows leave it.
ENDING = r"( - copy)?( ?\(\d+\))?(\.(txt|csv|tsv|dat|toml))*"
# Names of files that systems put into folders; clouds leave hidden ones in place of files.
SYSTEM_FILES = re.compile(r"\..*(?<!\.icloud)|thumbs\.db|desktop\.ini|__macosx", re.IGNORECASE)
MAX_LISTED_NAMES = 5  # file names in one sentence

COMMENT_OR_QUOTE = re.compile(r'(#|%|//).*|"')
NUMBER_FIRST = re.compile(r"(^|[\s,;])\W*(\d|nan\b|inf(inity)?\b)", re.I)  # in a row, not a header
NUMBER = {sign: rf"[+-]?(?:(?:{digits})(?:e[+-]?[0-9]+)?|nan|inf(?:inity)?)" for sign, digits in (
    (".", r"[0-9]+(?:\.[0-9]*)?|\.[0-9]+"), (",", "[0-9]+(?:,[0-9]+)?"))}
DIALECTS = (None, "."), (",", "."), (";", "."), (None, ","), (";", ",")  # separator, decimal sign


@dataclass(frozen=True)
class Table:
    """The numbers of a table, with the places of its rows for messages."""

    source: Path | str | None  # a file or an argument; None if there is none
    numbers: np.ndarray  # (m, c)
    lines: np.ndarray = ()  # (m,) of the rows, from 1
    notes: tuple[str, ...] = ()  # sentences on what was mended or left out

    def noted(self, note):
        """The Table with one more note, a clause about its file."""
        return replace(self, notes=(*self.notes, f"{Path(str(self.source)).name}{note}."))

    def place(self, k):
        """What messages call row k (str)."""
        return f"{'line' if isinstance(self.source, Path) else 'row'} {self.lines[k]}"

    def kept(self, ok, expected, most=0):
        """The Table of the rows where `ok` (m,) or (m, c) is True, with a note on the others.

        `expected` (str) may be one for each of c columns. Raises DatasetError for the first of the
        others if they are more than `most`.
        """
        if ok.all():
            return self
        bad = ~ok.reshape(len(ok), -1).all(axis=1)
        count, first = np.count_nonzero(bad), int(np.argmax(bad))
        column = int(np.argmin(ok[first])) if ok.ndim == 2 else slice(None)  # what is quoted
        expected = expected if isinstance(expected, str) else expected[column]
        found = " ".join(f"{x:.12g}" for x in np.atleast_1d(self.numbers[first, column]))
        said, place = f"{expected}, found '{found}'", self.place(first)
        require(count <= most, f"{self.source}, {place}", said)
        return replace(self, numbers=self.numbers[~bad], lines=self.lines[~bad]).noted(
            f": {count} of {len(bad)} rows left out, the first in {place}: expected {said}")


def read_table(source, name, pose_count=None):
    """The Table of a text file (Path) or Table, whose rows pass all checks; of None it has no rows.

    The checks are LIMITS[name] and CHECKS[name]. Pose ids of a sensor are at most `pose_count`; its
    rows with NaN or without a range are left out with a note, and up to MAX_BAD_SHARE of others
    that do not pass. Raises DatasetError for any other row, as one with words.
    """
    limits = LIMITS[name] | ({"pose id": Limit(1, pose_count, whole=True)} if pose_count else {})
    table = (_table_of_text(source, list(limits)) if isinstance(source, Path)
             else source or Table(None, np.empty((0, len(limits)))))
    measured = (table.numbers != 0) | (np.array([*limits]) != "range")
    table = table.kept(measured & ~np.isnan(table.numbers), [
        f"{column}, a number{' (0 is no reception)' * (column == 'range')}" for column in limits],
        most=len(table.numbers) * bool(pose_count))
    table.kept((table.numbers[:, 0] != 0) | (not pose_count), "pose ids from 1 on")
    most, rows = MAX_BAD_SHARE * len(table.numbers) * bool(pose_count), len(table.numbers)
    ok = [limit.holds(x) for limit, x in zip(limits.values(), table.numbers.T)]
    table = table.kept(np.stack(ok, axis=-1), [
        f"{column}, a {'whole' if limit.whole else 'finite'} number {limit}"
        for column, limit in limits.items()], most)
    return table.kept(CHECKS[name][0](table.numbers), CHECKS[name][1],
                      most - rows + len(table.numbers))


def table_of_array(source, value, name, counted=False):
    """The Table of a `value` with the columns LIMITS[name], without rows if it is empty.

    If `counted`, the first column, the numbers of the rows, is not among them. Raises DatasetError,
    which names the `source` (str), if it is no matrix of real numbers.
    """
    columns = list(LIMITS[name])[counted:]
    try:
        array = np.asarray(value, dtype=float if np.isrealobj(value) else object)
    except (TypeError, ValueError):
        array = np.asarray(value, dtype=object)
    array = np.empty((0, len(columns))) if value is None or not array.size else array
    require(array.dtype == float and array.ndim == 2 and array.shape[1] == len(columns), source,
            f"a matrix of real numbers with {len(columns)} columns ({', '.join(columns)}), found "
            f"{array.dtype} of shape {array.shape}")
    rows = np.arange(1, len(array) + 1)
    return Table(source, np.column_stack([rows, array]) if counted else array, rows)


def _table_of_text(source, columns):
    """The Table of a text file with these columns, with NaN for empty cells."""
    table = Table(source, np.empty((0, len(columns))))
    rows = COMMENT_OR_QUOTE.sub("", read_text(source)).split("\n")
    lines = [k for k, row in enumerate(rows, start=1) if re.search(r"[^,;\s]", row)]
    rows = [rows[k - 1].strip() for k in lines]
    if rows and re.search("[A-Za-z]", rows[0]) and not NUMBER_FIRST.search(rows[0]):
        table = table.noted(f": the header {quoted(rows[0])} was left out; columns were read as "
                            + ", ".join(columns))
        rows, lines = rows[1:], lines[1:]
    if not rows:
        return table
    cells = max((_cells(rows, len(columns), *dialect) for dialect in DIALECTS), key=len)
    k = min(len(cells), len(rows) - 1)
    require(len(cells) == len(rows), f"{source}, line {lines[k]}",
            f"{len(columns)} numbers ({', '.join(columns)})", rows[k])
    numbers = np.strings.replace(text := np.array(cells), ",", ".")
    if (numbers != text).any():
        table = table.noted(" was read with decimal commas")
    return replace(table, numbers=numbers.astype(float), lines=np.array(lines))


def _cells(rows, count, separator, decimal):
    """Numbers as text, `count` for each of the rows that a dialect has before the first other."""
    number = f"({NUMBER[decimal]})"
    cells = [rf"\s*(?:{number}\s*)?" if separator else number] * count
    row = re.compile((separator or r"\s+").join(cells) + r"[\s,;]*", re.IGNORECASE)
    return [match.groups("nan") for match in takewhile(bool, map(row.fullmatch, rows))]


def contents(folder, expected=DATASET_FILES, required=None):
    """Sources (dict of Path or Table) of the files of a folder by name, and notes (list of str).

    Raises DatasetError if the folder cannot be read, the file `required` is missing, or two files
    have one of the names `expected`.
    """
    folder, files, notes, rest = Path(folder), {}, [], []
    patterns = {name: name if name == "truth" else Path(name).stem + ENDING for name in expected}
    for path in _listed(folder):
        name = next((name for name, pattern in patterns.items()
                     if re.fullmatch(pattern, path.name, re.IGNORECASE)
                     and (name == "truth" or not path.is_dir())), None)
        if name is None:
            rest.append(path)
            continue
        require(name not in files, folder / name, "one file of this name, found "
                f"{files.get(name, path).name} and {path.name}: move one of them away")
        files[name] = path
        notes += [f"{path.name} was read as {name}."] * (path.name.lower() != name.lower())
    if expected is DATASET_FILES:
        rest = [path for path in rest
                if not path.is_file() or not _add_variables(files, path, notes)]
    require(required in (None, *files), folder / (required or ""),
            ". ".join(["this file, found none", *_not_read(rest)]).rstrip("."))
    return files, notes + _not_read(rest)


def datasets_in(data, names=None):
    """Names (list) of the datasets in a folder, and sentences (list) on what else is there.

    They are all sub-folders with files of a dataset, or those that `names` selects. Raises
    DatasetError if there is none, or no sub-folder of a selected name.
    """
    data = Path(data)
    rest = [path for path in _listed(data) if path.name != "README.md"] if data.is_dir() else []
    found = [path.name for path in rest if path.is_dir() and contents(path)[0]]
    require(found, data, f"this folder, with a sub-folder with an {ENCODER} for each dataset, "
            "found none")
    names = found if names is None else list(names)
    for name in names:
        require((data / name).is_dir(), data, f"one of {', '.join(found)}", name)
    return names, [f"{data}: {each}" for each in _not_read(
        [path for path in rest if path.name not in found])]


def _listed(folder):
    """Sorted paths in a folder without SYSTEM_FILES."""
    try:
        return sorted(path for path in folder.iterdir() if not SYSTEM_FILES.fullmatch(path.name))
    except (OSError, ValueError):  # ValueError: a NUL character in the folder's name
        place = "" if folder.is_absolute() else f" (paths are relative to {Path.cwd()})"
        raise DatasetError(f"{folder}: expected a folder that can be read{place}") from None


def _add_variables(files, path, notes):
    """Add variables of a .mat file with the names of missing TABLES; False if there is none."""
    missing = {Path(name).stem.lower(): name for name in TABLES if name not in files}
    try:
        variables = loadmat(path) if missing and path.suffix.lower() == ".mat" else {}
    except Exception:               # scipy raises many kinds about other versions and bytes
        return False
    found = {missing[key.lower()]: key for key in variables if key.lower() in missing}
    for name, key in found.items():
        files[name] = table_of_array(f"{path}, variable {key}", variables[key], name)
        notes.append(f"Variable {key} of {path.name} was read as {name}.")
    return bool(found)


def _not_read(paths):
    """Sentences (list of str) with the first MAX_LISTED_NAMES, and how many more there are."""
    listed = ", ".join(quoted(path.name) for path in paths[:MAX_LISTED_NAMES])
    more = f" and {len(paths) - MAX_LISTED_NAMES} more" * (len(paths) > MAX_LISTED_NAMES)
    return [f"Not read: {listed}{more}."] * bool(paths)
