"""Reads the notebooks of a report and report.toml: which chapters it has, in which order.

A title `# 2. Name` makes a chapter, `# A. Name` an appendix. The metadata of a notebook may say
which measurements it needs, as `"slamlib": {"needs": "uwb"}`.
"""

import fnmatch
import re
from dataclasses import dataclass, fields
from pathlib import Path

import nbformat
from jinja2 import Template
from nbformat import NotebookNode

from slamlib.core.errors import require
from slamlib.io.textfile import read_text, read_toml

TITLE = re.compile(r"^#\s+(.+)", re.MULTILINE)
LAB_ONLY = "lab-only"  # tag of cells that are not executed, and not shown on pages or in the PDF
Books = dict[Path, NotebookNode]  # notebooks by their files, in the order of the report


class NotebookError(RuntimeError):
    """A notebook failed; the message names the notebook, and has the cell and its traceback."""


@dataclass(frozen=True)
class Options:
    """Options of report.toml; an empty line of the title page is left out."""

    title: str = "Localization and mapping of a differential-drive vehicle"
    author: str = ""
    student_number: str = ""
    course: str = ""
    chapters: tuple[str, ...] = ()  # names of notebooks, also as "[1-4]*"; empty: all


def read_options(path: Path) -> Options:
    """Return the Options that a file describes; without it, the defaults.

    DatasetError if the file is not TOML, has an unknown key, or a value is not as it must be.
    """
    if not path.exists():
        return Options()
    keys = [option.name for option in fields(Options)]
    entries, places = read_toml(path, 'author = "Ada Lovelace"', keys)
    chapters = entries.pop("chapters", [])
    is_list = isinstance(chapters, list) and all(isinstance(name, str) for name in chapters)
    require(is_list, places.get("chapters"), 'a list of notebooks in quotes, such as '
            '["1_odometry", "A_studies"], for chapters', chapters)
    for key, value in entries.items():
        is_line = type(value) in (str, int) and re.fullmatch(r"[^\n\ufffd]*", str(value))
        require(is_line, places[key], f"a line of UTF-8 text in quotes for {key}", value)
        entries[key] = str(value)
    return Options(**entries, chapters=tuple(chapters))


def notebooks_folder() -> Path:
    """Return the folder `notebooks` if it is there, else the one beside slamlib's sources."""
    here = Path("notebooks")
    return here if here.is_dir() else Path(__file__).parents[2] / here


def rendered(template: str, **values) -> str:
    """Return the text of a template of Jinja, a file beside this one, with these values."""
    text = Path(__file__).with_name(template).read_text(encoding="utf-8")
    return Template(text, trim_blocks=True, lstrip_blocks=True).render(values)


def read_books(folder: Path, chapters: tuple[str, ...] = ()) -> Books:
    """Return the notebooks in a folder by the names of their files, or those that are chosen.

    DatasetError if there is none, or none of a name.
    """
    names = sorted(source.stem for source in folder.glob("*.ipynb"))
    require(names, folder, "notebooks (*.ipynb), found no notebooks")
    chosen = set()
    for pattern in chapters or ("*",):
        found = fnmatch.filter(names, pattern)
        require(found, "report.toml", f"chapters among {', '.join(names)}", pattern)
        chosen.update(found)
    sources = [folder / f"{name}.ipynb" for name in sorted(chosen)]
    return {source: read_notebook(source) for source in sources}


def read_notebook(source: Path) -> NotebookNode:
    """Return the notebook in a file, without outputs that an editor saved.

    NotebookError if the file is not a notebook, DatasetError if it is no file that can be read.
    """
    text = read_text(source)
    try:
        if "\ufffd" in text:  # which stands for bytes that are not UTF-8
            raise ValueError("expected UTF-8 text")
        book = nbformat.reads(text, as_version=4)
        for cell in code_cells(book):
            cell.update(outputs=[], execution_count=None)
    except Exception as error:  # on other JSON nbformat fails in many ways
        reason = str(error).partition("\n")[0]
        raise NotebookError(f"{source.name} is not a notebook: {reason}") from None
    return book


def title_of(source: Path, book: NotebookNode) -> str:
    """Return the title of the chapter that a notebook is."""
    text = "\n\n".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    heading = TITLE.search(text)
    return re.sub("[*_`]", "", heading[1]).strip() if heading else source.stem


def code_cells(book: NotebookNode) -> list[NotebookNode]:
    """Return the code cells of a notebook."""
    return [cell for cell in book.cells if cell.cell_type == "code"]
