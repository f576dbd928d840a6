"""Executed notebooks with the files that they wrote, kept until something changes.

A notebook is executed again when its code cells changed or what `keys` says of slamlib, Python,
packages, datasets and the files beside the notebooks; not when its text did. What is kept of a
notebook is in a folder of its name: executed.ipynb, written last, and `results`.
"""

import hashlib
import json
import sys
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

import nbformat
from nbformat import NotebookNode

from slamlib.io.files import write_file
from slamlib.report.execution import Books
from slamlib.report.notebooks import tags_of

SLAMLIB = Path(__file__).parents[1]
PACKAGES = ("numpy", "scipy", "gtsam", "pandas", "matplotlib")
EXECUTED = "executed.ipynb"
RESULTS = "results"  # name of the folder of the files that a notebook wrote
KEY = "slamlib_key"  # in the metadata of an executed notebook


def keys(books: Books, datasets: Iterable[Path]) -> dict[Path, str]:
    """Return the keys of books, digests of what they need; `datasets` are folders."""
    notebooks = next(iter(books)).parent
    state = hashlib.sha256(sys.version.encode())
    state.update(repr([version(package) for package in PACKAGES]).encode())
    for root in (SLAMLIB, notebooks, *datasets):
        for file in sorted(root.rglob("*")):
            name = file.relative_to(root)
            if file.is_file() and not _is_unseen(name, root):
                state.update(f"{root.name}/{name}\n".encode())
                state.update(hashlib.sha256(file.read_bytes()).digest())
    found = {}
    for source, book in books.items():
        code = [(cell.source, tags_of(cell)) for cell in _code_cells(book)]
        own = state.copy()
        own.update(json.dumps(code).encode())
        found[source] = own.hexdigest()
    return found


def _is_unseen(name, root):
    """Return whether no cell sees a file: of the report, a notebook, hidden, or made of others."""
    is_page = root == SLAMLIB and name.parts[0] == "report"
    is_hidden = any(part.startswith(".") or part == "__pycache__" for part in name.parts)
    return is_page or is_hidden or name.suffix == ".ipynb"


def _code_cells(book):
    return [cell for cell in book.cells if cell.cell_type == "code"]


def recall(folder: Path, key: str, book: NotebookNode) -> bool:
    """Put the kept outputs into a book; return whether there are any of this key."""
    try:
        executed = nbformat.read(folder / EXECUTED, as_version=4)
    except Exception:  # it is absent or damaged
        return False
    if executed.metadata.get(KEY) != key:
        return False
    for cell, old in zip(_code_cells(book), _code_cells(executed), strict=True):
        cell.outputs = old.outputs
    return True


def keep(folder: Path, key: str, book: NotebookNode):
    """Keep an executed notebook, whose results are in its folder."""
    executed = NotebookNode(book | {"metadata": book.metadata | {KEY: key}})
    write_file(folder / EXECUTED, nbformat.writes(executed).encode())
