"""Reads the notebooks of a report and report.toml: which chapters it has, in which order.

A title `# 2. Name` makes a chapter, `# A. Name` an appendix. The metadata of a notebook may say
which measurements it needs, as `"slamlib": {"needs": "uwb"}`.
"""

import json
import re
from contextlib import suppress
from dataclasses import dataclass, fields
from fnmatch import fnmatchcase
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path

import nbformat
from nbconvert.preprocessors import ClearOutputPreprocessor
from nbformat import NotebookNode

from slamlib.core.errors import DatasetError, require
from slamlib.io.textfile import read_text, read_toml
from slamlib.report.execution import Books, NotebookError

FOLDER = "notebooks"  # name of the notebooks' folder
# Folder of the results of each estimate that may be handed in as problem 2.
PROBLEM2_FOLDERS = {"aruco": "problem2", "fused": "problem2_fused", "hint": "problem2_hint"}
# Options that have one of several values. Code that is shown: none, all that is not hidden, or all.
CHOICES = {"code": ("none", "method", "all"), "problem2": tuple(PROBLEM2_FOLDERS)}
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
    chapters: tuple[str, ...] = ()  # names of notebooks, also as "[1-4]*"; empty: all
    code: str = "method"
    problem2: str = "aruco"  # which is handed in, of PROBLEM2_FOLDERS; required is markers alone


@dataclass(frozen=True)
class Chapter:
    """What a notebook says of itself."""

    title: str
    number: str  # that of a chapter, the letter of an appendix, or ""
    lead: str  # the first paragraph, or ""
    needs: str | None  # the sensor without which it has nothing to say


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
        require(value in CHOICES[key], place,
                f"one of {json.dumps(CHOICES[key])[1:-1]} for {key}", value)
        return value
    if key == "chapters":
        is_list = isinstance(value, list) and all(isinstance(name, str) for name in value)
        require(is_list, place,
                'a list of notebooks in quotes, such as ["1_odometry", "A_studies"], for chapters',
                value)
        return tuple(value)
    is_line = type(value) in (str, int) and re.fullmatch(r"[^\n\ufffd]*", str(value))
    require(is_line, place, f"a line of UTF-8 text in quotes for {key}", value)
    return str(value)


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


def read_books(folder: Path, chapters: tuple[str, ...] = ()) -> Books:
    """Return the notebooks in a folder by the names of their files, or those that are chosen.

    DatasetError if there is none, or none of a name.
    """
    sources = sorted(folder.glob("*.ipynb"))
    require(sources, folder, "notebooks (*.ipynb), found no notebooks")
    names = [source.stem for source in sources]
    for pattern in chapters:
        require(any(fnmatchcase(name, pattern) for name in names), "report.toml",
                f"chapters among {', '.join(names)}", pattern)
    chosen = chapters or ("*",)
    return {source: read_notebook(source) for source in sources
            if any(fnmatchcase(source.stem, pattern) for pattern in chosen)}


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


def chapter_of(source: Path, book: NotebookNode) -> Chapter:
    """Return the Chapter that a notebook is."""
    text = "\n\n".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    heading = TITLE.search(text)
    title = re.sub("[*_`]", "", heading[1]).strip() if heading else source.stem
    number = NUMBER.match(title)
    lead = PARAGRAPH.search(text)
    return Chapter(title, number[1] if number else "", lead[0] if lead else "",
                   book.metadata.get("slamlib", {}).get("needs"))


def tags_of(cell: NotebookNode) -> list[str]:
    """Return the tags of a cell."""
    return cell.metadata.get("tags", [])
