"""Finds the files of a dataset in its folder: each file is read, named in a note, or refused.

A missing file is read under an unambiguous variant of its name, as `ArucoReading.txt.txt` where
Windows hides extensions, and a note says so. A name that is only similar is refused, because a
sensor would be left out silently.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from slamlib.filenames import (
    ARCHIVE,
    DATASET_FILES,
    ENCODER,
    TABLES,
    is_variant,
    listed_names,
    misnamed_error,
    name_in_placeholder,
    name_of_file,
    resembled_name,
    similar_name,
    stem_of,
)
from slamlib.matfile import Variable, mat_variables
from slamlib.textfile import DatasetError, error, quoted, read_regular

# Names of files that systems put into folders.
SYSTEM_FILES = re.compile(r"\..*|thumbs\.db|desktop\.ini|__macosx", re.IGNORECASE)


@dataclass(frozen=True)
class Contents:
    """The files of a dataset's folder, or of its folder `truth`."""

    folder: Path  # of the files
    files: dict  # Path or Variable by name in DATASET_FILES
    notes: tuple[str, ...]  # on unexpected names and on files that are not read
    hint: str = ""  # end of a message on a missing file

    def required(self, name):
        """The source (Path or Variable) of this name; raises DatasetError if there is none."""
        if name not in self.files:
            raise error(self.folder / name, f"expected this file, found none{self.hint}")
        return self.files[name]


def contents(folder, expected=DATASET_FILES):
    """The Contents of a folder (Path) with files of the names `expected`, in any case of letters.

    If the folder holds none of these, they may be in one of its sub-folders. Raises DatasetError if
    two files have a name, a name is almost right, or the folder cannot be read.
    """
    folder = Path(folder)
    paths = _listed(folder)
    if expected is DATASET_FILES and not any(name_of_file(path, expected) for path in paths):
        deeper = [path for path in paths if path.is_dir() and _holds_encoder(path)]
        if len(deeper) > 1:
            raise error(folder, "expected the files of one dataset, found those of "
                        f"{listed_names([path.name for path in deeper])} in sub-folders")
        if deeper:
            inner = contents(deeper[0], expected)
            notes = [f"The files were read from the sub-folder {listed_names([deeper[0].name])}."]
            return Contents(inner.folder, inner.files, (*notes, *_not_read(
                [path.name for path in paths if path != deeper[0]]), *inner.notes), inner.hint)
    files, notes, copies, hint = {}, [], set(), ""
    for name in expected:
        found, others = _choose(folder, name, paths)
        if found is not None:
            files[name] = found
        if found is not None and found.name.lower() != name.lower():
            notes.append(f"{found.name} was read as {name}.")
        notes += [f"{other.name} is not read: it is a copy of {found.name}." for other in others]
        copies |= {found, *others}
    rest = [path for path in paths if path not in copies]
    if expected is DATASET_FILES:
        variables, more, unread, hint = _mat_tables(
            [path for path in rest if path.suffix.lower() == ".mat"],
            [name for name in TABLES if name not in files])
        files |= variables
        notes += more
        told = {*unread, *(each.path for each in variables.values())}
        rest = [path for path in rest if path not in told]
    _refuse_misnamed(folder, expected, files, rest)
    archives = [path.name for path in rest if ARCHIVE.search(path.name)]
    notes += [f"{name} is not read: unpack it here if it holds files of this dataset."
              for name in archives]
    others = [path.name for path in rest if path.name not in archives]
    notes += _not_read(others)
    return Contents(folder, files, tuple(notes),
                    f", but {quoted(archives[0])}: unpack it" if archives else hint)


def is_dataset(folder):
    """True if a folder (Path) or one of its sub-folders holds files of a dataset, in any form."""
    paths = _listed(folder)
    mats = [path for path in paths if path.suffix.lower() == ".mat"]
    return any(name_of_file(path, DATASET_FILES) or ARCHIVE.search(path.name) for path in paths) \
        or any(path.is_dir() and _holds_encoder(path) for path in paths) \
        or any(name_in_placeholder(path, DATASET_FILES) for path in _hidden(folder)) \
        or bool(_mat_tables(mats, TABLES)[0])


def left_in(data):
    """Sentences (list of str) on archives and tables in the folder of all datasets (Path)."""
    sentences = []
    for path in _listed(data):
        if path.is_file() and ARCHIVE.search(path.name):
            sentences.append(f"{path} is not read: unpack it into a folder in {data}.")
        elif path.is_file() and name_of_file(path, TABLES):
            sentences.append(f"{path} is not read: move it into a folder of its dataset in {data}.")
    return sentences


def _listed(folder):
    """Sorted paths in a folder without SYSTEM_FILES."""
    try:
        return sorted(path for path in Path(folder).iterdir()
                      if not SYSTEM_FILES.fullmatch(path.name))
    except (OSError, ValueError):  # ValueError: a NUL character in the folder's name
        raise error(folder, "expected a folder that can be read") from None


def _hidden(folder):
    """Paths of the files in a folder whose names begin with a dot, sorted."""
    return sorted(path for path in Path(folder).glob(".*") if path.is_file())


def _refuse_misnamed(folder, expected, files, rest):
    """Raise DatasetError if one of the paths `rest` replaces a name that is not in `files`."""
    names = [*((path, resembled_name(path, expected)) for path in rest),
             *((path, name_in_placeholder(path, expected)) for path in _hidden(folder))]
    for path, name in names:
        if name and name not in files:
            raise misnamed_error(path, name)
    if expected is DATASET_FILES:
        _require_here(folder, files, [path for path in rest if path.is_dir()])


def _require_here(folder, files, others):
    """Raise DatasetError if a table that is not in `files` is in one of the folders `others`.

    A folder with its own encoder file is another dataset.
    """
    for deeper in others:
        held = {name_of_file(path, TABLES): path for path in _listed_if_readable(deeper)
                if any(path.name.lower() == name.lower() or is_variant(path, name)
                       for name in TABLES)}
        for name, path in held.items():
            if name not in files and (ENCODER not in files or ENCODER not in held):
                raise error(folder / name, "expected this file, found it as "
                            f"{listed_names([f'{deeper.name}/{path.name}'])}: move it up, or away")


def _not_read(names):
    return [f"Not read: {listed_names(names)}."] * bool(names)


def _choose(folder, name, paths):
    """The path of the file of this name, or None, and copies of it that are not read.

    Raises DatasetError if there are two files that differ.
    """
    exact = [path for path in paths if path.name.lower() == name.lower()]
    if len(exact) > 1:
        raise error(folder / name, "expected one file of this name, found "
                    f"{' and '.join(path.name for path in exact)}")
    variants = [path for path in paths if path not in exact and is_variant(path, name)]
    first, *others = [*exact, *variants] or [None]
    for other in others:
        if read_regular(other) != read_regular(first):
            raise error(folder / name, f"expected one file of this name, found {first.name} and "
                        f"{quoted(other.name)}, which differ: move one of them away")
    return first, others


def _holds_encoder(folder):
    """True if a folder holds the encoder file, in any form."""
    return any(name_of_file(path, (ENCODER,)) for path in _listed_if_readable(folder))


def _listed_if_readable(folder):
    try:
        return _listed(folder)
    except DatasetError:
        return []


def _mat_tables(paths, names):
    """Variables of .mat files by name in `names`, notes, unread files, and the hint of Contents.

    A file that cannot be read is refused if its name is one of `names`, or its bytes hold one;
    another file is refused if its name or that of a variable resembles a missing one.
    """
    files, notes, unread, hint, left = {}, [], [], "", {}
    for path in paths if names else ():
        try:
            variables = mat_variables(path)
        except DatasetError as failure:
            content = read_regular(path).lower() if path.is_file() else b""
            if any(stem_of(path.stem) == stem_of(name) or stem_of(name).encode() in content
                   for name in names):
                raise
            notes.append(f"{path.name} is not read{str(failure).removeprefix(str(path))}.")
            hint = f", but {notes[-1][:-1]}"
            unread.append(path)
            continue
        for name in names:
            found = [each for each in variables if each.rpartition(".")[2].lower() == stem_of(name)]
            if len(variables) == 1 and stem_of(path.stem) == stem_of(name):
                found = list(variables)
            if len(found) > 1 or found and name in files:
                places = found[:2] if len(found) > 1 else [files[name].path.name, path.name]
                raise error(path.parent if len(found) == 1 else path, "expected one table "
                            f"{Path(name).stem}, found it in {' and '.join(places)}")
            if found:
                files[name] = Variable(path, found[0])
                notes.append(f"Variable {found[0]} of {path.name} was read as {name}.")
        used = {each.name for each in files.values() if each.path == path}
        left[path] = {each: size for each, size in variables.items()
                      if not any(f"{name}.".startswith(f"{each}.") for name in used)}
        if used and left[path]:
            notes.append(f"Not read: variables {listed_names(list(left[path]))} of {path.name}.")
    for path, variables in left.items():
        used = any(each.path == path for each in files.values())
        has = f"the variables {listed_names(list(variables)) or 'none'}"
        _refuse_similar(path, variables, [name for name in names if name not in files], used, has)
        if not used:
            notes.append(f"{path.name} is not read: it has {has}.")
            hint = f", but {path.name}, which has {has}: name the matrix {Path(ENCODER).stem}"
            unread.append(path)
    return files, notes, unread, hint


def _refuse_similar(path, variables, missing, used, has):
    """Raise DatasetError if a .mat file's variables or, unless it is used, its name resemble one of
    the names `missing`.
    """
    words = [each.rpartition(".")[2] for each, size in variables.items() if size > 1]
    resembled = {similar_name(word.lower(), TABLES) for word in words + [path.stem] * (not used)}
    for name in missing:
        if name in resembled:
            raise error(path, f"expected a matrix named {Path(name).stem}, found {has}: rename one "
                        "of them")
