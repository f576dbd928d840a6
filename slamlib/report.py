"""The report: executes the notebooks and writes pages, and a PDF, that need no network.

Each notebook becomes one HTML page and one chapter of the PDF; both open with the same summary.
"""

import os
import resource
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from urllib.parse import quote

import nbformat

from slamlib import cache, overview, studies
from slamlib.cover import Cover
from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth
from slamlib.execution import NotebookError, execute, kernel_environment, read_notebook
from slamlib.numbering import numbered
from slamlib.pages import chapter_of, html_pages
from slamlib.pdf import typeset, without_glyph

__all__ = ["NotebookError", "build_report"]


def build_report(notebooks, data, report, results, datasets=None, jobs=2, cover=Cover(), code=True,
                 kept=None, fresh=False):
    """Execute the notebooks of a folder; write a page for each, `index.html` and `report.pdf`.

    Kernels find the absolute paths of data and results, and the selection, in the environment
    variables SLAMLIB_DATA, SLAMLIB_RESULTS and SLAMLIB_DATASETS (names, one a line). Their results
    are moved from there into `results` when the notebook has ended well.

    Parameters
    ----------
    notebooks, data : folder of the `*.ipynb` files, and of the datasets, a sub-folder each.
    report, results : folder of the pages, and of what notebooks write; made if they do not exist.
    datasets, jobs : names, or None for all; number of notebooks executed at a time.
    cover : Cover, the title page of the PDF.
    code : False leaves out code cells and printed text, on the pages and in the PDF.
    kept : folder of executed notebooks, and of their Monte Carlo studies, which are executed again
        only if something changed that they depend on, or None; `fresh` executes all, and keeps them.

    Returns
    -------
    list of Path: the pages, the index first, and the PDF.

    Raises
    ------
    DatasetError : no notebook, no dataset of a selected name, or one that is not as it must be.
    NotebookError : a cell failed, or a page cannot be set; an earlier report stays as it was.
    """
    start = time.monotonic()
    notebooks, data, report, results = (
        Path(folder).resolve() for folder in (notebooks, data, report, results))
    for line, text in asdict(cover).items():
        if missing := without_glyph(text):
            raise DatasetError(f"title page: the PDF's fonts have no glyph for {missing[0]} in {line} "
                               f"'{text}': write it in Latin, Greek or Cyrillic letters")
    sources = sorted(notebooks.glob("*.ipynb"))
    if not sources:
        raise DatasetError(f"{notebooks}: there are no notebooks (*.ipynb) in this folder")
    selected = dataset_names(data, datasets)
    for name in selected:  # bad data is to be told as such, and not as a failing notebook
        read_dataset(data / name), read_truth(data / name)
    books = {source: read_notebook(source) for source in sources}
    chapters = [chapter_of(source, book) for source, book in books.items()]
    _set({source: nbformat.v4.new_notebook(
        cells=[cell for cell in book.cells if cell.cell_type == "markdown"])
        for source, book in books.items()}, chapters, cover, code)  # fails before the long part

    for folder in (results, report):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()  # fails before the long part, too
    books, written = _executed(books, data, results, datasets, selected, jobs, kept, fresh)
    drives = overview.read_drives(data, results, selected, written)
    links = [(quote(os.path.relpath(results / name, report)), name) for drive in drives
             for name in sorted(written) if name.startswith(f"{drive.name}/") and name.endswith(".mat")]
    index = overview.index(overview.summary(overview.plain(cover.title), drives), chapters, links)
    opening = overview.summary("Overview", drives)
    files = _set({Path("index"): index, **numbered(books)}, chapters, cover, code, opening)

    with tempfile.TemporaryDirectory(prefix=".", dir=report) as beside:
        for name, content in files.items():
            Path(beside, name).write_bytes(content)
        for name in files:
            os.replace(Path(beside, name), report / name)
    print(_spent(time.monotonic() - start), file=sys.stderr)
    return [report / name for name in files]


def _executed(books, data, results, datasets, selected, jobs, kept, fresh):
    """The books, executed or as they are kept, and the names of all files that they wrote."""
    done, written = {}, []
    with tempfile.TemporaryDirectory() as settings:
        environment = kernel_environment(Path(settings), data, datasets, jobs)

        def depends_on():
            return cache.fingerprint([data / name for name in selected], next(iter(books)).parent,
                                     {**environment, "SLAMLIB_RESULTS": str(results)})

        common = depends_on()
        keys = {source: cache.key_of(source, book, common) for source, book in books.items()}

        def finish(source, book, names):
            done[source] = book
            written.extend(names)
            if kept is not None and depends_on() == common:  # and not edited in the meantime
                cache.keep(kept, source, keys[source], book, results, names)

        for source, key in keys.items() if kept is not None and not fresh else ():
            if found := cache.recall(kept, source, key, results):
                done[source], names = found
                written.extend(names)
                print(f"{source.stem}: nothing changed, not executed again", file=sys.stderr)
        folder = None if kept is None else Path(kept, "studies").resolve()
        if folder and fresh:
            studies.forget(folder)
        execute({source: book for source, book in books.items() if source not in done},
                environment | ({"SLAMLIB_STUDIES": str(folder)} if folder else {}),
                results, max(1, jobs), finish)
    return {source: done[source] for source in books}, sorted(set(written))


def _set(books, chapters, cover, code, opening=None):
    """Names and contents of the report's files: a page for each book, and the PDF."""
    files = {name: page.encode() for name, page in html_pages(books, chapters, code).items()}
    parts = [(source, book) for source, book in books.items() if source.suffix]
    files["report.pdf"] = typeset(parts, opening, code, **asdict(cover))
    return files


def _spent(seconds):
    """What the build took: a sentence. Memory is the most that a process ever had."""
    unit = 1 if sys.platform == "darwin" else 1024
    own, largest = (resource.getrusage(who).ru_maxrss * unit / 1e6
                    for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return (f"built in {seconds:.1f} s; memory: {own:.0f} MB, and {largest:.0f} MB in the largest "
            "of the notebooks and other processes")
