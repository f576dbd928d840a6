"""Finds the files of a dataset in its folder: each file is read, named in a note, or refused.

A file is read under its name as browsers, editors and Windows leave it, as `ArucoReading (1).txt`
or `ArucoReading.txt.txt`, and a note says so. Other names are not guessed.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from slamlib.dialects import Variable, mat_variables
from slamlib.textfile import DatasetError, error, read_regular

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
class Contents:
    """The files of a dataset's folder, or of its folder `truth`."""

    folder: Path  # of the files
    files: dict  # Path or Variable by name in DATASET_FILES
    notes: tuple[str, ...]  # on names of copies and on files that are not read

    def required(self, name):
        """The source (Path or Variable) of this name; raises DatasetError if there is none."""
        if name not in self.files:
            unread = "".join(f" ({note})" for note in self.notes if "ot read" in note)
            raise error(self.folder / name, f"expected this file, found none{unread}")
        return self.files[name]


def contents(folder, expected=DATASET_FILES):
    """The Contents of a folder (Path) with files of the names `expected`, in any case of letters.

    If the folder holds none of these, they may be in one of its sub-folders. Raises DatasetError if
    two files that differ have a name, or the folder cannot be read.
    """
    folder, files, notes = Path(folder), {}, []
    rest = _listed(folder)
    for name in expected:
        same = [path for path in rest if _is_named(path, name)]
        same.sort(key=lambda path: path.name.lower() != name.lower())     # the name itself first
        rest = [path for path in rest if path not in same]
        for other in same[1:]:
            if read_regular(other) != read_regular(same[0]):
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
            notes.append(f"The files were read from the sub-folder {listed_names(deeper)}.")
            folder, files, notes = inner.folder, inner.files, [*notes, *inner.notes]
    return Contents(folder, files, (*notes, *_not_read(rest)))


def is_dataset(folder):
    """True if a folder (Path) or one of its sub-folders holds files of a dataset."""
    try:
        return bool(contents(folder).files)
    except DatasetError:
        return True


def left_in(data):
    """Sentences (list of str) on what in the folder of all datasets (Path) is no dataset."""
    return [f"{data}: {sentence}" for sentence in _not_read(
        [path for path in _listed(data) if path.name != "README.md"
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
            values = mat_variables(path)
        except DatasetError as failure:
            notes.append(f"{path.name} is not read{str(failure).removeprefix(str(path))}.")
            continue
        for each in list(values):
            stem = path.stem if len(values) == 1 else ""
            name = next((missing[word] for word in (each.rpartition(".")[2].lower(), stem.lower())
                         if word in missing), None)
            if name in files:
                raise error(path, f"expected one table {Path(name).stem}, found it in "
                            f"{files[name].name} of {files[name].path.name} and in {each}")
            if name:
                files[name] = Variable(path, each, values.pop(each))
                notes.append(f"Variable {each} of {path.name} was read as {name}.")
        notes += _not_read([Path(f"{each} of {path.name}") for each in values], " variables")
    return notes


def _not_read(paths, kind=""):
    return [f"Not read:{kind} {listed_names(paths)}."] * bool(paths)


def listed_names(paths):
    """Names (str) of the first MAX_LISTED_NAMES of a list of paths, and the number of others."""
    named = [path.name if path.name.isprintable() and path.name.isascii() and len(path.name) < 40
             else ascii(path.name[:40]) for path in paths[:MAX_LISTED_NAMES]]
    more = len(paths) - len(named)
    return ", ".join(named) + (f" and {more} more" if more else "")
