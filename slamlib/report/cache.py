"""Executed notebooks with the files that they wrote, kept until something changes.

A notebook is executed again when its code cells changed or what `keys` says of slamlib, Python,
packages, datasets and the files beside the notebooks; not when its text did. What is kept of a
notebook is in a folder of its name: `results`, and a notebook with outputs, written last, whose
name is the key.
"""

import hashlib
import sys
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

import nbformat
from nbformat import NotebookNode

from slamlib.io.files import write_file
from slamlib.report.notebooks import Books, code_cells

SLAMLIB = Path(__file__).parents[1]
PACKAGES = ("numpy", "scipy", "gtsam", "pandas", "matplotlib")
RESULTS = "results"  # name of the folder of the files that a notebook wrote


def digest(*parts) -> str:
    """Return a digest of plain data."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def keys(books: Books, datasets: Iterable[Path]) -> dict[Path, str]:
    """Return the keys of books, digests of what they need; `datasets` are folders."""
    notebooks = next(iter(books)).parent
    state = [sys.version, [version(package) for package in PACKAGES]]
    for root in (SLAMLIB, notebooks, *datasets):
        for file in sorted(root.rglob("*")):
            name = file.relative_to(root)
            if file.is_file() and not _is_unseen(name, root):
                content = hashlib.sha256(file.read_bytes()).hexdigest()
                state.append((root.name, name.as_posix(), content))
    common = digest(state)
    found = {}
    for source, book in books.items():
        code = [(cell.source, cell.metadata.get("tags")) for cell in code_cells(book)]
        found[source] = digest(common, code)
    return found


def _is_unseen(name, root):
    """Return whether no cell sees a file: of the report, a notebook, hidden, or made of others."""
    is_page = root == SLAMLIB and name.parts[0] == "report"
    is_hidden = any(part.startswith((".", "__pycache__")) for part in name.parts)
    return is_page or is_hidden or name.suffix == ".ipynb"


def recall(folder: Path, key: str, book: NotebookNode) -> bool:
    """Put the kept outputs into a book; return whether there are any of this key."""
    kept = folder / f"{key}.ipynb"
    if kept.exists():
        put_outputs(book, nbformat.read(kept, as_version=4))
    return kept.exists()


def put_outputs(book: NotebookNode, executed: NotebookNode):
    """Put the outputs of an executed notebook into a book with the same code."""
    for cell, old in zip(code_cells(book), code_cells(executed), strict=True):
        cell.outputs = old.outputs


def keep(folder: Path, key: str, executed: NotebookNode):
    """Keep an executed notebook, whose results are in its folder."""
    write_file(folder / f"{key}.ipynb", nbformat.writes(executed).encode())
