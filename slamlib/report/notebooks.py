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
from nbformat import NotebookNode

from slamlib.core.errors import DatasetError, require
from slamlib.io.textfile import read_text, read_toml
from slamlib.report.execution import Books, NotebookError

FOLDER = "notebooks"  # name of the notebooks' folder
CODE_SHOWN = ("none", "method", "all")  # what code is shown: none, all that is not hidden, or all
# Folder of the results of each estimate that may be handed in as problem 2.
PROBLEM2_FOLDERS = {"aruco": "problem2", "fused": "problem2_fused", "hint": "problem2_hint"}
# Options that have one of several values.
CHOICES = {"code": CODE_SHOWN, "problem2": tuple(PROBLEM2_FOLDERS), "appendix": (True, False)}
TITLE = re.compile(r"^#\s+(.+)", re.MULTILINE)
NUMBER = re.compile(r"(\d+|[A-Z])\.")  # begins the title of a chapter or an appendix
# Neither heading, table, quotation, code, formula nor list.
PARAGRAPH = re.compile(r"^(?!\s|[#|<>`]|\$\$|[-*+]\s).+(?:\n.+)*", re.MULTILINE)


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


@dataclass(frozen=True)
class Chapter:
    """What a notebook says of itself."""

    title: str
    number: str  # that of a chapter, the letter of an appendix, or ""
    lead: str  # the first paragraph, or ""

    @property
    def is_appendix(self) -> bool:
        """Return whether its number is a letter."""
        return self.number.isalpha()


def read_options(path: str | Path) -> Options:
    """Return the Options that a file describes; without it, the defaults.

    DatasetError if the file is not TOML, has an unknown key, or a value is not as it must be.
    """
    path = Path(path)
    if not path.exists():
        return Options()
    keys = [option.name for option in fields(Options)]
    entries = read_toml(path, 'author = "Ada Lovelace"', keys)
    return Options(**{key: _checked(key, value, str(path)) for key, value in entries.items()})


def _checked(key, value, place):
    """Return the value of a key as Options have it; DatasetError, which begins with `place`."""
    if key in CHOICES:
        choices = CHOICES[key]
        ok = type(value) is type(choices[0]) and value in choices  # 1 is not true
        expected = f"one of {json.dumps(choices)[1:-1]}"
    elif key == "leave_out":
        ok = isinstance(value, list) and all(isinstance(entry, str) for entry in value)
        expected = 'a list of numbers and titles in quotes, such as ["B", "3.5", "References"],'
    else:
        ok = type(value) in (str, int) and re.fullmatch(r"[^\n\ufffd]*", str(value))
        expected = "a line of UTF-8 text in quotes"
        value = str(value)
    require(ok, place, f"{expected} for {key}", value)
    return dict.fromkeys(value, place) if key == "leave_out" else value


def notebooks_folder() -> Path:
    """Return the folder `notebooks` if it is there, else that of the installed notebooks.

    DatasetError where neither is there.
    """
    if Path(FOLDER).is_dir():
        return Path(FOLDER)
    repository = Path(__file__).parents[2]
    if (repository / "pyproject.toml").is_file():  # slamlib is not installed elsewhere
        return repository / FOLDER
    with suppress(PackageNotFoundError):
        for file in files("slamlib") or ():
            if file.suffix == ".ipynb":
                return Path(file.locate()).resolve().parent
    raise DatasetError(f"{FOLDER}: expected this folder, because slamlib was installed without its "
                       "notebooks; found none")


def read_notebook(source: Path) -> NotebookNode:
    """Return the notebook in a file, without outputs that an editor saved.

    NotebookError if the file is not a notebook, DatasetError if it is no file that can be read.
    """
    text = read_text(source)
    try:
        if "\ufffd" in text:  # which stands for bytes that are not UTF-8
            raise ValueError("expected UTF-8 text")
        book = nbformat.reads(text, as_version=4)
        cleared, _ = ClearOutputPreprocessor().preprocess(book, {})
    except Exception as error:  # on other JSON nbformat fails in many ways
        reason = str(error).partition("\n")[0]
        raise NotebookError(f"{source.name} is not a notebook: {reason}") from None
    return cleared


def to_execute(folder: Path, options: Options) -> Books:
    """Return the notebooks in a folder that are executed, in order.

    These are all chapters, because they write results, by the names of their files, and then the
    appendices that `options` show, by their letters. DatasetError if there is none.
    """
    books = {source: read_notebook(source) for source in sorted(folder.glob("*.ipynb"))}
    about = {source: chapter_of(source, book) for source, book in books.items()}
    _require_known(options.leave_out, {chapter.number for chapter in about.values()})
    executed = [source for source in books if not about[source].is_appendix]
    if options.appendix is not False:
        appendices = [source for source in shown(books, options) if about[source].is_appendix]
        executed += sorted(appendices, key=lambda source: about[source].number)
    require(executed, folder, "notebooks (*.ipynb) that are not left out, found no notebooks")
    return {source: books[source] for source in executed}


def _require_known(leave_out, numbers):
    """Raise DatasetError if a chapter is to be left out that has none of the numbers (set)."""
    known = sorted(numbers - {""})
    for entry, place in leave_out.items():
        is_title = not re.fullmatch(r"\d+|[A-Za-z]", entry)
        require(is_title or entry.upper() in known, place,
                f"to leave out a chapter ({', '.join(known)}) or a section", entry)


def shown(books: Books, options: Options) -> Books:
    """Return the books without the chapters that are left out."""
    left_out = {entry.strip().removesuffix(".").upper() for entry in options.leave_out} - {""}
    return {source: book for source, book in books.items()
            if chapter_of(source, book).number not in left_out}


def chapter_of(source: Path, book: NotebookNode) -> Chapter:
    """Return the Chapter that a notebook is."""
    text = "\n\n".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    heading = TITLE.search(text)
    title = re.sub("[*_`]", "", heading[1]).strip() if heading else source.stem
    number = NUMBER.match(title)
    lead = PARAGRAPH.search(text)
    return Chapter(title, number[1] if number else "", lead[0] if lead else "")


def tags_of(cell: NotebookNode) -> list[str]:
    """Return the tags of a cell."""
    return cell.metadata.get("tags", [])
