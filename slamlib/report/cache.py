"""Executed notebooks with the files that they wrote, kept until something changes.

A notebook is executed again when its code cells changed or what `keys` says of slamlib, Python,
packages, datasets and the files beside the notebooks; not when its text did. What is kept of a
notebook is in a folder of its name: `results`, and a notebook with outputs, written last, whose
name is the key.
"""

import re
import sys
from collections.abc import Iterable
from importlib.metadata import version
from pathlib import Path

import joblib
import nbformat
from nbformat import NotebookNode

from slamlib.report.notebooks import Books, code_cells

SLAMLIB = Path(__file__).parents[1]
PACKAGES = ("numpy", "scipy", "gtsam", "pandas", "matplotlib")
RESULTS = "results"  # name of the folder of the files that a notebook wrote
# Names of files that no cell sees: of the report, hidden, made of others, or notebooks.
UNSEEN = re.compile(r"^report/|(^|/)(\.|__pycache__)|\.ipynb$")


def keys(books: Books, datasets: Iterable[Path]) -> dict[Path, str]:
    """Return the keys of books, digests of what they need; `datasets` are folders."""
    notebooks = next(iter(books)).parent
    state = [sys.version, [version(package) for package in PACKAGES]]
    for root in (SLAMLIB, notebooks, *datasets):
        for file in sorted(root.rglob("*")):
            name = file.relative_to(root).as_posix()
            if file.is_file() and not UNSEEN.search(name):
                state.append((root.name, name, joblib.hash(file.read_bytes())))
    found = {}
    for source, book in books.items():
        code = [(cell.source, cell.metadata.get("tags")) for cell in code_cells(book)]
        found[source] = joblib.hash([state, code])
    return found


def recall(folder: Path, key: str, book: NotebookNode) -> bool:
    """Put the kept outputs into a book with the same code; return whether there are any."""
    kept = folder / f"{key}.ipynb"
    if not kept.exists():
        return False
    executed = nbformat.read(kept, as_version=4)
    for cell, old in zip(code_cells(book), code_cells(executed), strict=True):
        cell.outputs = old.outputs
    return True
