"""The report: runs the notebooks headless and writes pages that need no script and no network.

Notebooks are executed, each in a kernel of its own; each becomes one HTML page through nbconvert,
`report_page.html` and `report_style.css`, its formulas set from TeX to MathML by pandoc.
"""

import asyncio
import html
import json
import os
import re
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from urllib.parse import quote

import nbformat
import pypandoc
from jinja2 import pass_context
from jupyter_client import AsyncKernelManager
from jupyter_client.kernelspec import KernelSpecManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import HTMLExporter
from nbconvert.filters import strip_ansi
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from tqdm import tqdm

from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth

def build_report(notebooks, data, report, results, datasets=None, jobs=2):
    """Execute the notebooks of a folder; write a page for each, and `index.html`.

    Kernels find the absolute paths of data and results, and the selection, in the environment
    variables SLAMLIB_DATA, SLAMLIB_RESULTS and SLAMLIB_DATASETS (names, one a line).

    Parameters
    ----------
    notebooks, data : folder of the `*.ipynb` files, and of the datasets, a sub-folder each.
    report, results : folder of the pages, and of what notebooks write; made if they do not exist.
    datasets, jobs : names, or None for all; number of notebooks executed at a time.

    Returns
    -------
    list of Path, the pages, the index first.

    Raises
    ------
    DatasetError : no notebook, no dataset of a selected name, or one that is not as it must be.
    NotebookError : a cell failed, or a page cannot be set; an earlier report stays as it was.
    """
    notebooks, data, report, results = (
        Path(folder).resolve() for folder in (notebooks, data, report, results))
    sources = sorted(notebooks.glob("*.ipynb"))
    if not sources:
        raise DatasetError(f"{notebooks}: there are no notebooks (*.ipynb) in this folder")
    selected = dataset_names(data, datasets)
    for name in selected:  # bad data is to be told as such, and not as a failing notebook
        read_dataset(data / name), read_truth(data / name)
    books = {source: _read(source) for source in sources}
    chapters = [_chapter(source, book) for source, book in books.items()]
    for source, book in books.items():  # a formula that fails shall fail before the long part
        text = [cell for cell in book.cells if cell.cell_type == "markdown"]
        _page(source, nbformat.v4.new_notebook(cells=text), chapters)

    results.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as settings:
        environment = _environment(Path(settings), data, results, datasets, jobs)
        try:
            with asyncio.Runner(loop_factory=_Loop) as runner:
                runner.run(_execute_all(books, environment, max(1, jobs)))
        except ExceptionGroup as group:
            raise group.exceptions[0] from None
    files = [(quote(os.path.relpath(file, report)), file.relative_to(results).as_posix())
             for name in selected for file in sorted((results / name).rglob("*.mat"))]
    index = nbformat.v4.new_notebook()
    pages = {"index.html": _page(Path("index"), index, chapters, datasets=selected, files=files)}
    pages |= {f"{source.stem}.html": _page(source, books[source], chapters) for source in sources}
    report.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".", dir=report) as beside:
        for name, text in pages.items():
            Path(beside, name).write_text(text, encoding="utf-8")
        for name in pages:
            os.replace(Path(beside, name), report / name)
    return [report / name for name in pages]
