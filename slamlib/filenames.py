"""Recognises the files of a dataset by their names, also by similar ones."""

import re
from difflib import get_close_matches
from pathlib import Path

from slamlib.textfile import error

ENCODER = "encoderReading.txt"
# Names of the tables, of all files of a dataset, and of those in its folder `truth`.
TABLES = (ENCODER, "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt")
DATASET_FILES = (*TABLES, "vehicle.toml", "truth")
TRUTH_FILES = ("vehiclePose.txt", "ArucoMap.txt", "UwbMap.txt", "vehicle.toml")
# Extensions of archives and of pictures.
ARCHIVE = re.compile(r"\.(zip|7z|rar|gz|tgz|tar)$", re.IGNORECASE)
PICTURE_EXTENSION = re.compile(r"\.(jpe?g|png|gif|svg|heic|webp|tiff?|bmp|eps|fig|mp4|mov|avi)$")
# Extensions of files that hold no text, what that is, and what is to be done.
NOT_TEXT = (
    (re.compile(r"\.(xlsx?|ods|numbers)$"), "a spreadsheet", "save it as {stem}.csv"),
    (re.compile(r"\.(docx?|odt|rtf|pdf|pages|html?)$"), "a document", "save it as text in {name}"),
    (re.compile(r"\.mat$"), "a .mat file", "save it as text in {name}"),
    (re.compile(r"\.np[yz]$"), "arrays of numpy", "save them as text in {name}"),
    (ARCHIVE, "an archive", "unpack it here as {name}"),
    (re.compile(r"\.(crdownload|download|part|partial|opdownload)$"), "an unfinished download",
     "download {name} again"),
    (re.compile(r"\.(url|lnk|webloc)$"), "a link", "copy {name} itself here"),
    (re.compile(r"^\."), "a hidden file", "download or copy {name} itself here"))
# What editors, browsers and file managers add to a name: an extension, or the number of a copy.
TEXT_EXTENSION = re.compile(r"\.(txt|csv|tsv|dat)$")
COPY_NUMBER = re.compile(r"^(copy of|copia di) |( ?\(\d+\)|[ _-]+(copy|copia)( ?\(\d+\)| \d+)?)$")
# Extensions of files that may hold data.
DATA_EXTENSION = re.compile(r"^[^.]*$|\.(txt|csv|tsv|dat|asc|log|text|prn|out|toml|tml|bak|old|"
                            r"orig|xlsx?|ods|numbers)~?$|~$")
# Words by which a name means a table; the first that fits counts.
NAME_WORDS = {"UwbAntennaGuess.txt": "guess|antenna|anchor",
            "ArucoReading.txt": "aruco|marker|sighting", "UwbReading.txt": "uwb|(?<![a-z])range",
            ENCODER: "encoder|odometr|(?<![a-z])tick"}
MAX_LISTED_NAMES = 5  # file names in one sentence


def is_variant(path, name):
    """True if a file (Path) has this name, apart from what a copy or a program adds to it."""
    if name == "truth" or path.is_dir():
        return False
    return stem_of(path.name) == stem_of(name) and (
        ".toml" in path.name.lower() if name.endswith(".toml") else not ARCHIVE.search(path.name))


def stem_of(name):
    """A file's name (str) in small letters without extensions and the number of a copy."""
    name, previous = name.lower(), None
    while name != previous:
        previous = name
        name = COPY_NUMBER.sub("", TEXT_EXTENSION.sub("", name)).strip()
        if name.endswith(".toml"):
            name = COPY_NUMBER.sub("", name.removesuffix(".toml"))
    return name


def resembled_name(path, expected):
    """The name in `expected` that a file's name resembles in spelling or meaning, or None.

    A text file's name without extension is enough, unless the file is a picture.
    """
    if path.is_dir() or PICTURE_EXTENSION.search(path.name.lower()):
        return None
    bare = stem_of(path.name.partition(".")[0])
    same = next((name for name in expected if name == f"{Path(name).stem}.txt"
                 and bare == stem_of(name)), None)
    if same or not DATA_EXTENSION.search(path.name.lower()):
        return same
    return similar_name(re.sub(r"\.[a-z]{3,4}~?$|~$", "", stem_of(path.name)), expected)


def similar_name(stem, expected):
    """The name in `expected` that a name without extension resembles, or None."""
    stems = {stem_of(name): name for name in expected if name != "truth"}
    if close := get_close_matches(stem, stems, 1, 0.8):
        return stems[close[0]]
    if expected is TRUTH_FILES or get_close_matches(stem, map(stem_of, TRUTH_FILES), 1, 0.8):
        return None
    return next((name for name, words in NAME_WORDS.items() if re.search(words, stem)), None)


def name_of_file(path, expected):
    """The name in `expected` that a file (Path) has, in any form, or None."""
    exact = next((name for name in expected if path.name.lower() == name.lower()), None)
    return exact or next((name for name in expected if is_variant(path, name)), None) \
        or resembled_name(path, expected)


def misnamed_error(path, name):
    """The DatasetError about a file (Path) that replaces the missing one of this name."""
    for extension, kind, advice in NOT_TEXT:
        if extension.search(path.name.lower()):
            advice = advice.format(name=name, stem=Path(name).stem)
            return error(path, f"expected text, found {kind}: {advice}")
    return error(path, f"expected the name {name}: rename it, or move it away")


def name_in_placeholder(path, expected):
    """The name in `expected` that a hidden file's name contains, or None.

    Clouds keep `.ArucoReading.txt.icloud` for a file that is not downloaded, macOS
    `._ArucoReading.txt` beside one.
    """
    return next((name for name in expected
                 if name != "truth" and name.removesuffix(".txt").lower() in path.name.lower()),
                None)


def listed_names(names):
    """The first MAX_LISTED_NAMES of a list of names and the number of others (str)."""
    named = [name if name.isprintable() and name.isascii() and len(name) < 40 else
             ascii(name[:40]) for name in names[:MAX_LISTED_NAMES]]
    more = len(names) - len(named)
    return ", ".join(named) + (f" and {more} more" if more else "")
