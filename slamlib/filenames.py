"""What the name of a file in a dataset's folder says: which file it is, or which it is near to."""

import re
from difflib import get_close_matches
from pathlib import Path

from slamlib.textfile import error

ENCODER = "encoderReading.txt"
TABLES = (ENCODER, "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt")
FILES = (*TABLES, "vehicle.toml", "truth")
TRUTH_FILES = ("vehiclePose.txt", "ArucoMap.txt", "UwbMap.txt", "vehicle.toml")
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


def is_variant(path, name):
    """True if a file's name is this one with what a copy or a program has added to it."""
    if name == "truth" or path.is_dir():
        return False
    return stem_of(path.name) == stem_of(name) and (
        ".toml" in path.name.lower() if name.endswith(".toml") else not ARCHIVE.search(path.name))


def stem_of(name):
    """A file's name in small letters without extensions and the number of a copy."""
    name, before = name.lower(), None
    while name != before:
        before = name
        name = COPY.sub("", EXTENSION.sub("", name)).strip()
        if name.endswith(".toml"):
            name = COPY.sub("", name.removesuffix(".toml"))
    return name


def meant(path, expected):
    """The name of `expected` that a file's name is near to in spelling or meaning, or None.

    A text file's name without extension is enough, unless the file is a picture.
    """
    if path.is_dir() or PICTURE.search(path.name.lower()):
        return None
    bare = stem_of(path.name.partition(".")[0])
    same = next((name for name in expected if name == f"{Path(name).stem}.txt"
                 and bare == stem_of(name)), None)
    if same or not DATA.search(path.name.lower()):
        return same
    return sense(re.sub(r"\.[a-z]{3,4}~?$|~$", "", stem_of(path.name)), expected)


def sense(stem, expected):
    """The name of `expected` that a name without extension is near to, or None."""
    stems = {stem_of(name): name for name in expected if name != "truth"}
    if close := get_close_matches(stem, stems, 1, 0.8):
        return stems[close[0]]
    if expected is TRUTH_FILES or get_close_matches(stem, map(stem_of, TRUTH_FILES), 1, 0.8):
        return None
    return next((name for name, words in MEANINGS.items() if re.search(words, stem)), None)


def role(path, expected):
    """The name of `expected` that a file has, in any form, or None."""
    exact = next((name for name in expected if path.name.lower() == name.lower()), None)
    return exact or next((name for name in expected if is_variant(path, name)), None) \
        or meant(path, expected)


def misnamed(path, name):
    """The DatasetError about a file that stands for the missing one of this name."""
    for extension, kind, advice in KINDS:
        if extension.search(path.name.lower()):
            advice = advice.format(name=name, stem=Path(name).stem)
            return error(path, f"expected text, found {kind}: {advice}")
    return error(path, f"expected the name {name}: rename it, or move it away")


def placeholder(path, expected):
    """The name of `expected` that a hidden file's name contains, or None.

    Clouds leave `.ArucoReading.txt.icloud` for a file that is not here, macOS
    `._ArucoReading.txt` beside one.
    """
    return next((name for name in expected
                 if name != "truth" and name.removesuffix(".txt").lower() in path.name.lower()),
                None)


def some(names):
    """A list of names in words, of many the first ones."""
    named = [name if name.isprintable() and name.isascii() and len(name) < 40 else
             ascii(name[:40]) for name in names[:MOST_NAMED]]
    more = len(names) - len(named)
    return ", ".join(named) + (f" and {more} more" if more else "")
