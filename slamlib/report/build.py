"""Builds the report: executes the notebooks and writes pages and a PDF that need no network.

Each notebook becomes one HTML page and one chapter of the PDF; both open with the same summary.
"""

import os
import resource
import sys
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import nbformat
from tqdm import tqdm

from slamlib import swap
from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth
from slamlib.notebook import notices
from slamlib.report import cache, overview
from slamlib.report.chapters import chapter_of, in_order, printed, with_data
from slamlib.report.cover import Cover
from slamlib.report.drives import read_drives
from slamlib.report.execution import (
    execute,
    kernel_environment,
    read_notebook,
    temporary_folder,
)
from slamlib.report.numbering import numbered
from slamlib.report.pages import html_pages
from slamlib.report.pdf import typeset
from slamlib.report.pictures import title_picture
from slamlib.report.setting import missing_glyphs
from slamlib.solve import OURS
from slamlib.studies.memory import CODE, forget
from slamlib.summary import tables

STUDIES = "studies"  # in the cache, besides executed notebooks
FIRST = 10.0  # s, for which the notebooks wait for the first numbers
BUILDING = ".slamlib-build.lock"  # in folders that only one build at a time changes


@dataclass(frozen=True)
class Report:
    """A report that was written."""

    files: list  # of Path, `index.html` first
    drives: list  # of drives.SolvedDrive, with what is doubted and what could not be solved


def build_report(notebooks, data, report, results, datasets=None, jobs=2, cover=None,
                 code="method", kept=None, fresh=False, appendix=True):
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
    code : one of chapters.CODE; "none" leaves out code cells and printed text.
    kept : folder that caches executed notebooks and their Monte Carlo studies, or None. Where it
        has none of these notebooks, each dataset is solved first, and its `summary.table` printed.
    fresh : bool; True executes everything although it is cached.
    appendix : bool; False leaves out the appendices.

    Raises
    ------
    DatasetError : there is no notebook or dataset of a selected name, or a dataset is malformed.
    NotebookError : a cell failed or a page cannot be set; report and results are unchanged.

    One build at a time works in a results folder or with a cache; another one waits for it.
    """
    start = time.monotonic()
    kept = kept and Path(kept).resolve()
    notebooks, data, report, results = (
        Path(folder).resolve() for folder in (notebooks, data, report, results))
    cover = cover or Cover()
    books, selected = _checked_input(notebooks, data, datasets, cover, appendix)
    chapters = [chapter_of(source, book) for source, book in books.items()]
    texts = {source: nbformat.v4.new_notebook(
        cells=[cell for cell in book.cells if cell.cell_type == "markdown"])
        for source, book in books.items()}
    folders = [data / name for name in selected]
    with ExitStack() as stack:
        settings = stack.enter_context(temporary_folder())
        environment = kernel_environment(settings, data, datasets, kept and kept / STUDIES)
        keys = partial(_keys, books, folders, environment | {"SLAMLIB_RESULTS": str(results)})
        if fresh or kept is None or not any(
                cache.entry(kept, source, key).exists() for source, key in keys().items()):
            wait = stack.enter_context(tables(folders, partial(tqdm.write, file=sys.stderr)))
        else:
            wait = None
        _render(texts, texts, chapters, cover, code)  # reports early what cannot be set
        if wait:
            wait(max(0.0, start + FIRST - time.monotonic()))
        for folder in sorted({results, kept or results}):
            stack.enter_context(swap.locked(folder / BUILDING))
        stage, pages = (stack.enter_context(swap.staging(folder)) for folder in (results, report))
        books, written = _executed(books, keys, environment, max(1, jobs), stage, kept, fresh)
        print("setting the pages and the PDF", file=sys.stderr)
        drives = read_drives(data, stage, selected, written, notices(books.values()))
        files = rendered(books, drives, cover, code, os.path.relpath(results, report))
        for name, content in files.items():
            swap.write(pages / name, content)
        swap.require_staged(stage)
        swap.publish([
            swap.Set(report, {name: pages / name for name in files}, last=next(iter(files))),
            *_result_sets(results, stage, selected, written)])
    print(_resources_used(time.monotonic() - start), file=sys.stderr)
    return Report([report / name for name in files], drives)


def _checked_input(notebooks, data, datasets, cover, appendix):
    """Return the notebooks by their paths, in order, and the names of the selected datasets."""
    for line, text in asdict(cover).items():
        if missing := missing_glyphs(text):
            raise DatasetError(f"title page: the PDF's fonts have no glyph for {missing[0]} in "
                               f"{line} '{text}': write it in Latin, Greek or Cyrillic letters")
    books = in_order({source: read_notebook(source) for source in notebooks.glob("*.ipynb")},
                     appendix)
    if not books:
        raise DatasetError(f"{notebooks}: there are no notebooks (*.ipynb) in this folder")
    selected = dataset_names(data, datasets)
    for name in selected:
        if missing := missing_glyphs(name):
            raise DatasetError(f"{data / name}: the PDF's fonts have no glyph for {missing[0]} in "
                               "the name of this dataset: rename its folder")
    read = [(read_dataset(data / name), read_truth(data / name)) for name in selected]
    served = with_data(books, [dataset for dataset, _ in read])
    for source in books.keys() - served.keys():
        print(f"{source.stem}: left out, no dataset has the measurements", file=sys.stderr)
    return served, selected


def _result_sets(results, stage, selected, written):
    """Return a swap.Set for each of the datasets that are selected or have files in `stage`."""
    files = {name: {} for name in selected}
    for path in written:
        dataset, name = path.split("/", 1) if "/" in path else ("", path)
        files.setdefault(dataset, {})[name] = stage / path
    return [swap.Set(results / dataset, found, ours=OURS) for dataset, found in files.items()]


def _keys(books, datasets, environment):
    """Return {source: key} with the books' keys in the cache, as files and variables are now."""
    common = cache.fingerprint(datasets, next(iter(books)).parent, environment)
    return {source: cache.key_of(source, book, common) for source, book in books.items()}


def _executed(books, keys, environment, jobs, stage, kept, fresh):
    """Return the executed books, cached or new, and the sorted names of the files they wrote.

    `keys` is a function without arguments that returns what `_keys` does, `environment` that of the
    kernels, `stage` the folder of the files, by `swap.staging`.
    """
    executed, written, begun = {}, set(), keys()

    def finish(source, book, names):
        swap.require_staged(stage)
        executed[source] = book
        written.update(names)
        if kept is not None and keys() == begun:  # nothing was edited meanwhile
            cache.keep(kept, source, begun[source], book, stage, names)

    if kept is not None and not fresh:
        for source, book in books.items():
            names = cache.recall(kept, source, begun[source], book, stage)
            if names is not None:
                executed[source] = book
                written.update(names)
                print(f"{source.stem}: nothing changed, not executed again", file=sys.stderr)
    if kept is not None and fresh:
        forget(kept / STUDIES)
    execute({source: book for source, book in books.items() if source not in executed},
            environment, stage, jobs, finish, kept and _seconds(kept))
    return {source: executed[source] for source in books}, sorted(written)


def _seconds(kept):
    """Return the Path of the seconds that cells take, which are more where studies are computed."""
    return kept / f"seconds_{'recalled' if (kept / STUDIES / CODE).is_dir() else 'computed'}.json"


def rendered(books, drives, cover, code, results):
    """Return the report's files as {name: bytes}, `index.html` first and the PDF last.

    Parameters
    ----------
    books : dict from Path to NotebookNode, executed, in order.
    drives : list of SolvedDrive, of which the opening tells.
    cover, code : as of `build_report`.
    results : str, the path of the results folder from that of the report.
    """
    chapters = [chapter_of(source, book) for source, book in books.items()]
    opening = overview.summary(drives, results)
    on_paper = numbered({source: printed(book) for source, book in books.items()}, whole=books)
    index = {Path("index"): overview.index(cover.title, opening, chapters)}
    solved = [drive for drive in drives if drive.solutions]
    return _render(index | numbered(books), on_paper, chapters, cover, code, printed(opening),
                   title_picture(solved[-1]) if solved else None)


def _render(books, on_paper, chapters, cover, code, opening=None, picture=None):
    """Return the report's files as {name: bytes}: a page for each of `books`, and the PDF.

    `on_paper` are the chapters of the PDF, a dict as `books`.
    """
    files = {name: page.encode() for name, page in html_pages(books, chapters, code).items()}
    return files | {"report.pdf": typeset(list(on_paper.items()), opening, code, picture,
                                          **asdict(cover))}


def _resources_used(seconds):
    """Return a sentence with the duration and the peak memory of the build."""
    unit = 1 if sys.platform == "darwin" else 1024  # bytes in a unit of ru_maxrss
    own, largest = (resource.getrusage(who).ru_maxrss * unit / 1e6
                    for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return (f"built in {seconds:.1f} s; memory: {own:.0f} MB, and {largest:.0f} MB in the largest "
            "of the notebooks and other processes")
