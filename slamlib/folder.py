"""Finds the files of a dataset in its folder: each file is read, listed as not read, or refused.

A file is read under its name as browsers and Windows leave it, as `ArucoReading (1).txt` or
`ArucoReading.txt.txt`, and a note says so. Other names are not guessed. The matrices of .mat files
stand in for text files that are missing.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from scipy.io import loadmat

from slamlib.textfile import error, quoted

ENCODER = "encoderReading.txt"
# Names of the tables, of all files of a dataset, and of those in its folder `truth`.
TABLES = (ENCODER, "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt")
DATASET_FILES = (*TABLES, "vehicle.toml", "truth")
TRUTH_FILES = ("vehiclePose.txt", "ArucoMap.txt", "UwbMap.txt", "vehicle.toml")
# Names of files that systems put into folders; clouds leave hidden ones in place of files.
SYSTEM_FILES = re.compile(r"\..*(?<!\.icloud)|thumbs\.db|desktop\.ini|__macosx", re.IGNORECASE)
# What browsers and Windows add to a name, and endings by that of the format.
COPY = r"( - copy)?( ?\(\d+\))?"
ENDINGS = {".txt": rf"{COPY}(\.(txt|csv|tsv|dat))*", ".toml": rf"{COPY}\.toml(\.txt)?", "": ""}
MAX_LISTED_NAMES = 5  # file names in one sentence


@dataclass(frozen=True)
class Variable:
    """A matrix in place of a text file."""

    name: str  # in messages
    value: object
    exact: bool = False  # True for an argument of `Dataset.from_arrays`: no row may be left out

    def __str__(self):
        return self.name


def contents(folder, expected=DATASET_FILES, required=None):
    """Sources (dict of Path or Variable) of the files of a folder by name, and notes (list of str).

    Raises DatasetError if the folder cannot be read, the file `required` is missing, or two files
    have one of the names `expected`.
    """
    folder, files, notes = Path(folder), {}, []
    rest = _listed(folder)
    for name in expected:
        same = [path for path in rest if _is_named(path, name)]
        rest = [path for path in rest if path not in same]
        if len(same) > 1:
            raise error(folder / name, f"expected one file of this name, found {same[0].name} and "
                        f"{same[1].name}: move one of them away")
        if same:
            files[name] = same[0]
        if same and same[0].name.lower() != name.lower():
            notes.append(f"{same[0].name} was read as {name}.")
    if expected is DATASET_FILES:
        rest = _add_variables(files, rest, notes)
    unread = _not_read(rest)
    if required and required not in files:
        raise error(folder / required, f"expected this file, found none. {unread}".rstrip(". "))
    return files, notes + [unread] * bool(unread)


def is_dataset(folder):
    """True if a folder (Path) holds files of a dataset; raises what `contents` raises."""
    return bool(contents(folder)[0])


def left_in(data):
    """Sentences (list of str) on what in the folder of all datasets (Path) is no dataset."""
    unread = _not_read([path for path in _listed(data) if path.name != "README.md"
                        and not (path.is_dir() and is_dataset(path))])
    return [f"{data}: {unread}"] * bool(unread)


def _listed(folder):
    """Sorted paths in a folder without SYSTEM_FILES."""
    try:
        return sorted(path for path in folder.iterdir() if not SYSTEM_FILES.fullmatch(path.name))
    except (OSError, ValueError):  # ValueError: a NUL character in the folder's name
        place = "" if folder.is_absolute() else f" (paths are relative to {Path.cwd()})"
        raise error(folder, f"expected a folder that can be read{place}") from None


def _is_named(path, name):
    """True if a file (Path) has this name, apart from case and ENDINGS."""
    pattern = Path(name).stem + ENDINGS[Path(name).suffix]
    return bool(re.fullmatch(pattern, path.name, re.IGNORECASE)) and (
        name == "truth" or not path.is_dir())


def _add_variables(files, rest, notes):
    """The paths `rest` without .mat files that are read.

    Their variables with the names of missing TABLES are added to `files`, with `notes`.
    """
    missing, unread = {Path(name).stem.lower(): name for name in TABLES if name not in files}, []
    for path in rest:
        try:
            variables = loadmat(path) if missing and path.suffix.lower() == ".mat" else {}
        except Exception:           # scipy raises many kinds about other versions and bytes
            variables = {}
        found = {missing[key.lower()]: key for key in variables if key.lower() in missing}
        for name, key in found.items():
            if name in files:
                raise error(path, f"expected one variable {key}, found another in {files[name]}")
            files[name] = Variable(f"{path}, variable {key}", variables[key])
            notes.append(f"Variable {key} of {path.name} was read as {name}.")
        unread += [path] * (not found)
    return unread


def _not_read(paths):
    """A sentence (str) with the first MAX_LISTED_NAMES and how many more, or ""."""
    listed = ", ".join(quoted(path.name) for path in paths[:MAX_LISTED_NAMES])
    more = f" and {len(paths) - MAX_LISTED_NAMES} more" * (len(paths) > MAX_LISTED_NAMES)
    return f"Not read: {listed}{more}." if paths else ""
