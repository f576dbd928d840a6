"""Which file of a dataset's folder is which: every one is read, named in a note, or refused.

A file whose name is unmistakably that of a missing one, as `ArucoReading.txt.txt` where Windows
hides extensions, is read under it. A name that is near to a missing one is refused: a sensor would
else be left out silently.
"""

import re
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from slamlib.dialects import Variable, mat_variables
from slamlib.textfile import DatasetError, error, quoted, read_regular

ENCODER = "encoderReading.txt"
TABLES = (ENCODER, "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt")
FILES = (*TABLES, "vehicle.toml", "truth")
TRUTH_FILES = ("vehiclePose.txt", "ArucoMap.txt", "UwbMap.txt", "vehicle.toml")
IGNORED = re.compile(r"\..*|thumbs\.db|desktop\.ini|__macosx", re.IGNORECASE)
ARCHIVE = re.compile(r"\.(zip|7z|rar|gz|tgz|tar)$", re.IGNORECASE)
PICTURE = re.compile(r"\.(jpe?g|png|gif|svg|heic|webp|tiff?|bmp|eps|fig|mp4|mov|avi)$")
# Extensions of files that hold no text, what that is, and what is to be done.
KINDS = (
    (re.compile(r"\.(xlsx?|ods|numbers)$"), "a spreadsheet", "save it as {stem}.csv"),
    (re.compile(r"\.(docx?|odt|rtf|pdf|pages|html?)$"), "a document", "save it as text in {name}"),
    (re.compile(r"\.mat$"), "a .mat file", "save it as text in {name}"),
    (re.compile(r"\.np[yz]$"), "arrays of numpy", "save them as text in {name}"),
    (ARCHIVE, "an archive", "unpack it here as {name}"),
    (re.compile(r"\.(crdownload|download|part|partial|opdownload)$"), "an unfinished download",
     "download {name} again"),
    (re.compile(r"\.(url|lnk|webloc)$"), "a link", "copy {name} itself here"),
    (re.compile(r"^\."), "a hidden file", "download or copy {name} itself here"))
# What an editor, a browser or a file manager adds to a name: an extension, or the number of a copy.
EXTENSION = re.compile(r"\.(txt|csv|tsv|dat)$")
COPY = re.compile(r"^(copy of|copia di) |( ?\(\d+\)|[ _-]+(copy|copia)( ?\(\d+\)| \d+)?)$")
# Extensions of files that may hold data.
DATA = re.compile(r"^[^.]*$|\.(txt|csv|tsv|dat|asc|log|text|prn|out|toml|tml|bak|old|orig|"
                  r"xlsx?|ods|numbers)~?$|~$")
# What the words of a name say, the first that fits.
MEANINGS = {"UwbAntennaGuess.txt": "guess|antenna|anchor",
            "ArucoReading.txt": "aruco|marker|sighting", "UwbReading.txt": "uwb|(?<![a-z])range",
            ENCODER: "encoder|odometr|(?<![a-z])tick"}
MOST_NAMED = 5  # files that one sentence names


@dataclass(frozen=True)
class Contents:
    """The files of a dataset's folder, or of its folder `truth`."""

    folder: Path  # in which they are
    files: dict  # from a name of FILES to a Path or a Variable
    notes: tuple[str, ...]  # on names that are not as expected and files that are not read
    hint: str = ""  # what a message on a missing file adds

    def required(self, name):
        """The source of this name; DatasetError if there is none."""
        if name not in self.files:
            raise error(self.folder / name, f"expected this file, found none{self.hint}")
        return self.files[name]


def contents(folder, expected=FILES):
    """The Contents of a folder, in which files of the names `expected` are looked for.

    Upper and lower case are the same. If the folder holds none of these, they may be in one of its
    sub-folders. Raises DatasetError if two files have a name, a name is almost right, or the folder
    cannot be read.
    """
    folder = Path(folder)
    paths = _listed(folder)
    if expected is FILES and not any(_role(path, expected) for path in paths):
        deeper = [path for path in paths if path.is_dir() and _holds_encoder(path)]
        if len(deeper) > 1:
            raise error(folder, "expected the files of one dataset, found those of "
                        f"{_some([path.name for path in deeper])} in sub-folders")
        if deeper:
            inner = contents(deeper[0], expected)
            notes = [f"The files were read from the sub-folder {_some([deeper[0].name])}."]
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
    if expected is FILES:
        variables, more, unread, hint = _mat_tables(
            [path for path in rest if path.suffix.lower() == ".mat"],
            [name for name in TABLES if name not in files])
        files |= variables
        notes += more
        told = {*unread, *(each.path for each in variables.values())}
        rest = [path for path in rest if path not in told]
    for path in rest:
        if (name := _meant(path, expected)) and name not in files:
            raise _misnamed(path, name)
    for path in _hidden(folder):
        if (name := _placeholder(path, expected)) and name not in files:
            raise _misnamed(path, name)
    if expected is FILES:
        _require_here(folder, files, [path for path in rest if path.is_dir()])
    archives = [path.name for path in rest if ARCHIVE.search(path.name)]
    notes += [f"{name} is not read: unpack it here if it holds files of this dataset."
              for name in archives]
    others = [path.name for path in rest if path.name not in archives]
    notes += _not_read(others)
    return Contents(folder, files, tuple(notes),
                    f", but {quoted(archives[0])}: unpack it" if archives else hint)


def is_dataset(folder):
    """True if a folder, or one of its sub-folders, holds files of a dataset under any names."""
    paths = _listed(folder)
    mats = [path for path in paths if path.suffix.lower() == ".mat"]
    return any(_role(path, FILES) or ARCHIVE.search(path.name) for path in paths) \
        or any(path.is_dir() and _holds_encoder(path) for path in paths) \
        or any(_placeholder(path, FILES) for path in _hidden(folder)) \
        or bool(_mat_tables(mats, TABLES)[0])


def left_in(data):
    """Sentences on archives and files of a dataset that are in the folder of all datasets."""
    sentences = []
    for path in _listed(data):
        if path.is_file() and ARCHIVE.search(path.name):
            sentences.append(f"{path} is not read: unpack it into a folder in {data}.")
        elif path.is_file() and _role(path, TABLES):
            sentences.append(f"{path} is not read: move it into a folder of its dataset in {data}.")
    return sentences


def _listed(folder):
    """Paths in a folder, sorted, without those that systems put there."""
    try:
        return sorted(path for path in Path(folder).iterdir() if not IGNORED.fullmatch(path.name))
    except (OSError, ValueError):  # ValueError: a NUL character in the folder's name
        raise error(folder, "expected a folder that can be read") from None


def _hidden(folder):
    """Paths of the files in a folder whose names begin with a dot, sorted."""
    return sorted(path for path in Path(folder).glob(".*") if path.is_file())


def _placeholder(path, expected):
    """The name of `expected` that a hidden file's name contains, or None.

    Clouds leave `.ArucoReading.txt.icloud` for a file that is not here, macOS
    `._ArucoReading.txt` beside one.
    """
    return next((name for name in expected
                 if name != "truth" and name.removesuffix(".txt").lower() in path.name.lower()),
                None)


def _require_here(folder, files, others):
    """Raise DatasetError if a table that is not among `files` is in one of the folders `others`.

    A folder with encoders of its own is another dataset.
    """
    for deeper in others:
        held = {_role(path, TABLES): path for path in _listed_if_readable(deeper)
                if any(path.name.lower() == name.lower() or _is_variant(path, name)
                       for name in TABLES)}
        for name, path in held.items():
            if name not in files and (ENCODER not in files or ENCODER not in held):
                raise error(folder / name, "expected this file, found it as "
                            f"{_some([f'{deeper.name}/{path.name}'])}: move it up, or away")


def _some(names):
    """A list of names in words, of many the first ones."""
    named = [name if name.isprintable() and name.isascii() and len(name) < 40 else
             ascii(name[:40]) for name in names[:MOST_NAMED]]
    more = len(names) - len(named)
    return ", ".join(named) + (f" and {more} more" if more else "")


def _not_read(names):
    return [f"Not read: {_some(names)}."] * bool(names)


def _choose(folder, name, paths):
    """The path of a file of this name, or None, and copies of it that are not read.

    Raises DatasetError if there are two files that differ.
    """
    exact = [path for path in paths if path.name.lower() == name.lower()]
    if len(exact) > 1:
        raise error(folder / name, "expected one file of this name, found "
                    f"{' and '.join(path.name for path in exact)}")
    variants = [path for path in paths if path not in exact and _is_variant(path, name)]
    first, *others = [*exact, *variants] or [None]
    for other in others:
        if read_regular(other) != read_regular(first):
            raise error(folder / name, f"expected one file of this name, found {first.name} and "
                        f"{quoted(other.name)}, which differ: move one of them away")
    return first, others


def _is_variant(path, name):
    """True if a file's name is this one with what a copy or a program has added to it."""
    if name == "truth" or path.is_dir():
        return False
    return _stem(path.name) == _stem(name) and (
        ".toml" in path.name.lower() if name.endswith(".toml") else not ARCHIVE.search(path.name))


def _stem(name):
    """A file's name in small letters without extensions and the number of a copy."""
    name, before = name.lower(), None
    while name != before:
        before = name
        name = COPY.sub("", EXTENSION.sub("", name)).strip()
        if name.endswith(".toml"):
            name = COPY.sub("", name.removesuffix(".toml"))
    return name


def _meant(path, expected):
    """The name of `expected` that a file's name is near to in spelling or meaning, or None.

    A text file's name without extension is enough, unless the file is a picture.
    """
    if path.is_dir() or PICTURE.search(path.name.lower()):
        return None
    bare = _stem(path.name.partition(".")[0])
    same = next((name for name in expected if name == f"{Path(name).stem}.txt"
                 and bare == _stem(name)), None)
    if same or not DATA.search(path.name.lower()):
        return same
    return _sense(re.sub(r"\.[a-z]{3,4}~?$|~$", "", _stem(path.name)), expected)


def _sense(stem, expected):
    """The name of `expected` that a name without extension is near to, or None."""
    stems = {_stem(name): name for name in expected if name != "truth"}
    if close := get_close_matches(stem, stems, 1, 0.8):
        return stems[close[0]]
    if expected is TRUTH_FILES or get_close_matches(stem, map(_stem, TRUTH_FILES), 1, 0.8):
        return None
    return next((name for name, words in MEANINGS.items() if re.search(words, stem)), None)


def _role(path, expected):
    """The name of `expected` that a file has, in any form, or None."""
    exact = next((name for name in expected if path.name.lower() == name.lower()), None)
    return exact or next((name for name in expected if _is_variant(path, name)), None) \
        or _meant(path, expected)


def _holds_encoder(folder):
    """True if one of the files in a folder is that of the encoders, or near to a table."""
    return any(_role(path, (ENCODER,)) for path in _listed_if_readable(folder))


def _listed_if_readable(folder):
    try:
        return _listed(folder)
    except DatasetError:
        return []


def _misnamed(path, name):
    for extension, kind, advice in KINDS:
        if extension.search(path.name.lower()):
            advice = advice.format(name=name, stem=Path(name).stem)
            return error(path, f"expected text, found {kind}: {advice}")
    return error(path, f"expected the name {name}: rename it, or move it away")


def _mat_tables(paths, names):
    """Variables of .mat files by the names that they have of `names`, notes, files that are not
    read, and what a message on missing encoders adds.

    A file that cannot be read is refused if one of them is its own name or in its bytes; another
    one if its name or that of a variable is near to a missing one.
    """
    files, notes, unread, hint, left = {}, [], [], "", {}
    for path in paths if names else ():
        try:
            variables = mat_variables(path)
        except DatasetError as failure:
            content = read_regular(path).lower() if path.is_file() else b""
            if any(_stem(path.stem) == _stem(name) or _stem(name).encode() in content
                   for name in names):
                raise
            notes.append(f"{path.name} is not read{str(failure).removeprefix(str(path))}.")
            hint = f", but {notes[-1][:-1]}"
            unread.append(path)
            continue
        for name in names:
            found = [each for each in variables if each.rpartition(".")[2].lower() == _stem(name)]
            if len(variables) == 1 and _stem(path.stem) == _stem(name):
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
            notes.append(f"Not read: variables {_some(list(left[path]))} of {path.name}.")
    for path, variables in left.items():
        used = any(each.path == path for each in files.values())
        has = f"has the variables {_some(list(variables)) or 'none'}"
        near = [each.rpartition(".")[2] for each, size in variables.items() if size > 1]
        for name in names:
            if name not in files and name in {
                    _sense(word.lower(), TABLES) for word in near + [path.stem] * (not used)}:
                raise error(path, f"expected a matrix named {Path(name).stem}, found the variables "
                            f"{_some(list(variables)) or 'none'}: rename one of them")
        if not used:
            notes.append(f"{path.name} is not read: it {has}.")
            hint = f", but {path.name}, which {has}: name the matrix {Path(ENCODER).stem}"
            unread.append(path)
    return files, notes, unread, hint
