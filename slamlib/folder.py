"""Finds the files of a dataset in its folder: each file is read, named in a note, or refused.

A file is read under its name as browsers, editors and Windows leave it, as `ArucoReading (1).txt`
or `ArucoReading.txt.txt`, and a note says so. Other names are not guessed. The matrices of .mat
files stand in for text files that are missing.
"""

import re
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

from scipy.io import loadmat

from slamlib.textfile import DatasetError, error, read_bytes

ENCODER = "encoderReading.txt"
# Names of the tables, of all files of a dataset, and of those in its folder `truth`.
TABLES = (ENCODER, "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt")
DATASET_FILES = (*TABLES, "vehicle.toml", "truth")
TRUTH_FILES = ("vehiclePose.txt", "ArucoMap.txt", "UwbMap.txt", "vehicle.toml")
# Names of files that systems put into folders; clouds leave hidden ones in place of files.
SYSTEM_FILES = re.compile(r"\..*(?<!\.icloud)|thumbs\.db|desktop\.ini|__macosx", re.IGNORECASE)
# What browsers, editors and file managers add to a name.
COPY = r"( ?\(\d+\)|[ _-]+cop(y|ia)( ?\(\d+\)| \d+)?)*"
MAX_LISTED_NAMES = 5  # file names in one sentence


@dataclass(frozen=True)
class Variable:
    """A table in a .mat file, or an argument of `Dataset.from_arrays`."""

    path: Path | None  # None of an argument
    name: str
    value: object  # what scipy made of it, or the user

    def __str__(self):
        return f"{self.path}, variable {self.name}" if self.path else self.name


class Contents(dict):
    """Sources (Path or Variable) of a dataset's files by name; DatasetError if one is missing.

    `notes` are on names of copies, and on files that are not read.
    """

    def __init__(self, folder, files, notes):
        super().__init__(files)
        self.folder, self.notes = folder, notes

    def __missing__(self, name):
        unread = "".join(f" ({note})" for note in self.notes if "ot read" in note)
        raise error(self.folder / name, f"expected this file, found none{unread}")


def contents(folder, expected=DATASET_FILES):
    """The Contents of a folder (Path) with files of the names `expected`, in any case of letters.

    If the folder holds none of these, they may be in one of its sub-folders. Raises DatasetError if
    two files that differ have a name, or the folder cannot be read.
    """
    folder, files, notes = Path(folder), {}, []
    rest = _listed(folder)
    for name in expected:
        same = sorted((path for path in rest if _is_named(path, name)),     # the name itself first
                      key=lambda path: path.name.lower() != name.lower())
        rest = [path for path in rest if path not in same]
        for other in same[1:]:
            if read_bytes(other) != read_bytes(same[0]):
                raise error(folder / name, f"expected one file of this name, found {same[0].name} "
                            f"and {other.name}, which differ: move one of them away")
            notes.append(f"{other.name} is not read: it is a copy of {same[0].name}.")
        if same:
            files[name] = same[0]
            if same[0].name.lower() != name.lower():
                notes.append(f"{same[0].name} was read as {name}.")
    if expected is DATASET_FILES:
        notes += _add_variables(files, rest)
        deeper = [path for path in rest if path.is_dir()
                  and any(_is_named(inner, ENCODER) for inner in path.glob("*"))]
        if len(deeper) == 1 and not files:
            inner, rest = contents(deeper[0]), [path for path in rest if path != deeper[0]]
            notes.append(f"The files were read from the sub-folder {_shown(deeper[0].name)}.")
            folder, files, notes = inner.folder, inner, [*notes, *inner.notes]
    return Contents(folder, files, (*notes, *_not_read([path.name for path in rest])))


def is_dataset(folder):
    """True if a folder (Path) or one of its sub-folders holds files of a dataset."""
    try:
        return bool(contents(folder))
    except DatasetError:
        return True


def left_in(data):
    """Sentences (list of str) on what in the folder of all datasets (Path) is no dataset."""
    return [f"{data}: {sentence}" for sentence in _not_read(
        [path.name for path in _listed(data) if path.name != "README.md"
         and not (path.is_dir() and is_dataset(path))])]


def _listed(folder):
    """Sorted paths in a folder without SYSTEM_FILES."""
    try:
        return sorted(path for path in folder.iterdir() if not SYSTEM_FILES.fullmatch(path.name))
    except (OSError, ValueError):  # ValueError: a NUL character in the folder's name
        place = "" if folder.is_absolute() else f" (paths are relative to {Path.cwd()})"
        raise error(folder, f"expected a folder that can be read{place}") from None


def _is_named(path, name):
    """True if a file (Path) has this name, apart from case and what a program adds to it."""
    stem, ends = name.partition(".")[::2]
    ends = rf"{COPY}\.toml(\.txt)?" if ends == "toml" else rf"(\.(txt|csv|tsv|dat)|{COPY})*"
    return path.name.lower() == name.lower() or "." in name and not path.is_dir() and bool(
        re.fullmatch(rf"((copy of|copia di) )?{stem}{ends}", path.name, re.IGNORECASE))


def _add_variables(files, rest):
    """Notes (list of str) on .mat files among the paths `rest`, which are removed from it.

    Variables with the names of missing TABLES are added to `files`.
    """
    notes, missing = [], {Path(name).stem.lower(): name for name in TABLES if name not in files}
    for path in [path for path in rest if missing and path.suffix.lower() == ".mat"]:
        rest.remove(path)
        try:
            variables = _variables(path)
        except DatasetError as failure:
            notes.append(f"{path.name} is not read{str(failure).removeprefix(str(path))}.")
            continue
        unread = []
        for each in variables:
            alone = len(variables) == 1 and each.name.lower() not in missing
            name = missing.get((path.stem if alone else each.name).lower())
            if name in files:
                raise error(path, f"expected one table {Path(name).stem}, found it in "
                            f"{files[name].name} of {files[name].path.name} and in {each.name}")
            if name:
                files[name] = each
                notes.append(f"Variable {each.name} of {path.name} was read as {name}.")
            else:
                unread.append(f"{each.name} of {path.name}")
        notes += _not_read(unread, " variables")
    return notes


def _variables(path):
    """The Variables (list) of a .mat file of the versions 5 to 7; DatasetError for others."""
    data = read_bytes(path)
    try:
        found = loadmat(BytesIO(data))
    except Exception:                   # scipy raises many kinds about other versions and bytes
        raise error(path, "expected a .mat file of version 7 or older, saved with '-v7'") from None
    return [Variable(path, name, value) for name, value in found.items() if name[:2] != "__"]


def _not_read(names, kind=""):
    """A sentence (list of one or no str) with the first MAX_LISTED_NAMES, and how many more."""
    listed = ", ".join(map(_shown, names[:MAX_LISTED_NAMES]))
    more = f" and {len(names) - MAX_LISTED_NAMES} more" * (len(names) > MAX_LISTED_NAMES)
    return [f"Not read:{kind} {listed}{more}."] * bool(names)


def _shown(name):
    """A file's name without line ends and letters that a terminal may not have."""
    return name if re.fullmatch("[ -~]{1,39}", name) else ascii(name[:40])
