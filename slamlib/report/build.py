"""Builds the report: executes the notebooks and writes pages and a PDF that need no network.

Each notebook becomes one HTML page and one chapter of the PDF; both open with the same summary.
"""

import os
import resource
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from urllib.parse import quote

import nbformat

from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth
from slamlib.notebook import notices
from slamlib.report import cache, overview
from slamlib.report.cover import Cover
from slamlib.report.execution import execute, kernel_environment, read_notebook
from slamlib.report.numbering import numbered
from slamlib.report.pages import chapter_of, html_pages
from slamlib.report.pdf import missing_glyphs, typeset
from slamlib.studies.memory import forget


@dataclass(frozen=True)
class Report:
    """A report that was written."""

    files: list  # of Path, `index.html` first
    drives: list  # of overview.SolvedDrive, with what is doubted and what could not be solved


def build_report(notebooks, data, report, results, datasets=None, jobs=2, cover=None, code=True,
                 kept=None, fresh=False):
    """Execute all notebooks, write pages and PDF; return the Report.

    Kernels read the absolute paths of data and results, and the selection, from the environment
    variables SLAMLIB_DATA, SLAMLIB_RESULTS and SLAMLIB_DATASETS (one name per line).

    Parameters
    ----------
    notebooks, data : folders of the `*.ipynb` files and of the datasets, one sub-folder each.
    report, results : folders of the pages and of the result files; created if absent.
    datasets : list of str, names of the selected datasets, or None for all.
    jobs : int, notebooks executed at a time.
    cover : Cover, the title page of the PDF, or None for the default.
    code : bool; False leaves out code cells and printed text.
    kept : folder that caches executed notebooks and their Monte Carlo studies, or None.
    fresh : bool; True executes everything although it is cached.

    Raises
    ------
    DatasetError : there is no notebook or dataset of a selected name, or a dataset is malformed.
    NotebookError : a cell failed or a page cannot be set; the previous report is unchanged.
    """
    start = time.monotonic()
    notebooks, data, report, results = (
        Path(folder).resolve() for folder in (notebooks, data, report, results))
    cover = cover or Cover()
    books, selected = _checked_input(notebooks, data, datasets, cover)
    chapters = [chapter_of(source, book) for source, book in books.items()]
    texts = {source: nbformat.v4.new_notebook(
        cells=[cell for cell in book.cells if cell.cell_type == "markdown"])
        for source, book in books.items()}
    _render(texts, chapters, cover, code)  # reports early what cannot be set
    for folder in (results, report):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()  # reports early that a folder is not writable

    books, written = _executed(books, {"data": data, "datasets": datasets, "jobs": jobs},
                               [data / name for name in selected], results, kept, fresh)
    drives = overview.read_drives(data, results, selected, written, notices(books.values()))
    links = [(quote(os.path.relpath(results / name, report)), name)
             for drive in drives for name in written
             if name.startswith(f"{drive.name}/") and name.endswith(".mat")]
    opening = overview.summary(drives)
    index = overview.index(cover.title, opening, chapters, links)
    files = _render({Path("index"): index, **numbered(books)}, chapters, cover, code, opening)
    with tempfile.TemporaryDirectory(prefix=".", dir=report) as temporary:
        for name, content in files.items():
            Path(temporary, name).write_bytes(content)
        for name in files:
            os.replace(Path(temporary, name), report / name)
    print(_resources_used(time.monotonic() - start), file=sys.stderr)
    return Report([report / name for name in files], drives)


def _checked_input(notebooks, data, datasets, cover):
    """Return the notebooks by their paths, and the selected names; malformed input is refused."""
    for line, text in asdict(cover).items():
        if missing := missing_glyphs(text):
            raise DatasetError(f"title page: the PDF's fonts have no glyph for {missing[0]} in "
                               f"{line} '{text}': write it in Latin, Greek or Cyrillic letters")
    sources = sorted(notebooks.glob("*.ipynb"))
    if not sources:
        raise DatasetError(f"{notebooks}: there are no notebooks (*.ipynb) in this folder")
    selected = dataset_names(data, datasets)
    for name in selected:
        read_dataset(data / name), read_truth(data / name)
    return {source: read_notebook(source) for source in sources}, selected


def _executed(books, options, datasets, results, kept, fresh):
    """Return the executed books, cached or new, and the sorted names of the files they wrote.

    `options` are those of `kernel_environment`, `datasets` the selected folders.
    """
    executed, written = {}, set()
    with tempfile.TemporaryDirectory() as folder:
        environment = kernel_environment(Path(folder), **options)
        fingerprint = partial(cache.fingerprint, datasets, next(iter(books)).parent,
                              environment | {"SLAMLIB_RESULTS": str(results)})
        common = fingerprint()
        keys = {source: cache.key_of(source, book, common) for source, book in books.items()}

        def finish(source, book, names):
            executed[source] = book
            written.update(names)
            if kept is not None and fingerprint() == common:  # nothing was edited meanwhile
                cache.keep(kept, source, keys[source], book, results, names)

        if kept is not None and not fresh:
            for source, key in keys.items():
                if found := cache.recall(kept, source, key, results):
                    executed[source] = found[0]
                    written.update(found[1])
                    print(f"{source.stem}: nothing changed, not executed again", file=sys.stderr)
        if kept is not None:
            studies = Path(kept, "studies").resolve()
            environment["SLAMLIB_STUDIES"] = str(studies)
            if fresh:
                forget(studies)
        execute({source: book for source, book in books.items() if source not in executed},
                environment, results, max(1, options["jobs"]), finish)
    return {source: executed[source] for source in books}, sorted(written)


def _render(books, chapters, cover, code, opening=None):
    """Return the report's files as {name: bytes}: a page for each book, and the PDF."""
    files = {name: page.encode() for name, page in html_pages(books, chapters, code).items()}
    parts = [(source, book) for source, book in books.items() if source.suffix]
    return files | {"report.pdf": typeset(parts, opening, code, **asdict(cover))}


def _resources_used(seconds):
    """Return a sentence with the duration and the peak memory of the build."""
    unit = 1 if sys.platform == "darwin" else 1024  # bytes in a unit of ru_maxrss
    own, largest = (resource.getrusage(who).ru_maxrss * unit / 1e6
                    for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return (f"built in {seconds:.1f} s; memory: {own:.0f} MB, and {largest:.0f} MB in the largest "
            "of the notebooks and other processes")
