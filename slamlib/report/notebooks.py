"""Reads the notebooks of a report and report.toml: what is executed and shown, in which order.

A title `# 2. Name` makes a chapter, `# A. Name` an appendix. The metadata of a notebook, or of a
cell that begins with a heading, may say what it needs, as `"slamlib": {"needs": "truth"}`.
"""

import json
import re
from contextlib import suppress
from dataclasses import dataclass, field, fields
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import nbformat
from nbconvert.preprocessors import ClearOutputPreprocessor

from slamlib.core.errors import DatasetError, require
from slamlib.io.textfile import read_text, read_toml
from slamlib.report.execution import NotebookError

FOLDER = "notebooks"  # name of the notebooks' folder
CODE_SHOWN = ("none", "method", "all")  # what code is shown: none, all that is not hidden, or all
# Folder of the results of each estimate that may be handed in as problem 2.
PROBLEM2_FOLDERS = {"aruco": "problem2", "fused": "problem2_fused", "hint": "problem2_hint"}


@dataclass(frozen=True)
class Options:
    """Options of report.toml; an empty line of the title page is left out."""

    title: str = "Localization and mapping of a differential-drive vehicle"
    author: str = ""
    student_number: str = ""
    course: str = ""
    leave_out: dict = field(default_factory=dict)  # from numbers and titles to their file
    appendix: bool | None = None  # None: the report has it, the hand-in has not
    code: str = "method"  # one of CODE_SHOWN
    problem2: str = "aruco"  # which is handed in, of PROBLEM2_FOLDERS; required is markers alone


def read_options(path):
    """Return the Options that the file `path` (str or Path) describes; without it, the defaults.

    DatasetError if the file is not TOML, has an unknown key, or a value is not as it must be.
    """
    if not Path(path).exists():
        return Options()
    keys = [option.name for option in fields(Options)]
    entries = read_toml(Path(path), 'author = "Ada Lovelace"', keys)
    return Options(**{key: _checked(key, value, str(path)) for key, value in entries.items()})


def _checked(key, value, place):
    """Return the value of a key as Options have it; DatasetError, which begins with `place`."""
    choices = {"code": CODE_SHOWN, "problem2": [*PROBLEM2_FOLDERS], "appendix": [True, False]}
    if key in choices:
        ok = type(value) is type(choices[key][0]) and value in choices[key]
        expected = f"one of {json.dumps(choices[key])[1:-1]}"
    elif key == "leave_out":
        ok = type(value) is list and all(type(entry) is str for entry in value)
        expected = 'a list of numbers and titles in quotes, such as ["B", "3.5", "References"],'
    else:
        ok = type(value) in (str, int) and re.fullmatch(r"[^\n\ufffd]*", value := str(value))
        expected = "a line of UTF-8 text in quotes"
    require(ok, place, f"{expected} for {key}", value)
    return dict.fromkeys(value, place) if key == "leave_out" else value


def notebooks_folder():
    """Return the Path `notebooks` if it is there, else that of the installed notebooks.

    DatasetError where neither is there.
    """
    root = Path(__file__).parents[2]
    if Path(FOLDER).is_dir():
        return Path(FOLDER)
    if (root / "pyproject.toml").is_file():  # slamlib runs from its repository
        return root / FOLDER
    with suppress(PackageNotFoundError):
        for file in files("slamlib") or ():
            if file.suffix == ".ipynb":
                return Path(file.locate()).resolve().parent
    raise DatasetError(f"{FOLDER}: expected this folder, because slamlib was installed without its "
                       "notebooks; found none")


def read_notebook(source):
    """Return the NotebookNode in a file (Path), without outputs that an editor saved.

    NotebookError if the file is not a notebook, DatasetError if it is no file that can be read.
    """
    text = read_text(source)
    try:
        if "\ufffd" in text:  # which stands for bytes that are not UTF-8
            raise ValueError("expected UTF-8 text")
        book = nbformat.reads(text, as_version=4)
        return ClearOutputPreprocessor().preprocess(book, {})[0]
    except Exception as error:  # on other JSON nbformat fails in many ways
        reason = str(error).partition("\n")[0]
        raise NotebookError(f"{source.name} is not a notebook: {reason}") from None


def to_execute(folder, options):
    """Return the notebooks in a folder (Path) that are executed, as {Path: NotebookNode} in order.

    These are all chapters, because they write results, by the names of their files, and then the
    appendices that `options` (Options) show. DatasetError if there is none.
    """
    books = {source: read_notebook(source) for source in sorted(folder.glob("*.ipynb"))}
    about = {source: chapter_of(source, book) for source, book in books.items()}
    numbers = {each["number"] for each in about.values()} - {None}
    for entry, place in options.leave_out.items():
        known = entry.upper() in numbers or not re.fullmatch(r"\d+|[A-Za-z]", entry)
        require(known or not place, place,
                f"to leave out a chapter ({', '.join(sorted(numbers))}) or a section", entry)
    chapters = {source: book for source, book in books.items() if not about[source]["letter"]}
    appendices = sorted((about[source]["letter"], source) for source in shown(books, options)
                        if source not in chapters and options.appendix is not False)
    require(chapters or appendices, folder,
            "notebooks (*.ipynb) that are not left out, found no notebooks")
    return chapters | {source: books[source] for _, source in appendices}


def shown(books, options):
    """Return the books (dict from Path to NotebookNode) without the chapters that are left out."""
    left_out = {entry.strip().removesuffix(".").casefold() for entry in options.leave_out}
    return {source: book for source, book in books.items()
            if (chapter_of(source, book)["number"] or "-").casefold() not in left_out}


def chapter_of(source, book):
    """Return title, number (or None), lead and letter of a chapter, a dict of str.

    The lead is the first paragraph, the letter that of an appendix or "".
    """
    text = "\n\n".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    title = re.search(r"^#\s+(.+)", text, re.MULTILINE)
    lead = re.search(r"^(?!\s|[#|<>`]|\$\$|[-*+]\s).+(?:\n.+)*", text, re.MULTILINE)
    title = re.sub("[*_`]", "", title[1]).strip() if title else source.stem
    number = re.match(r"(\d+|([A-Z]))\.", title)
    return {"title": title, "lead": lead[0] if lead else "", "number": number and number[1],
            "letter": number and number[2] or ""}
