"""Builds the report: executes the notebooks and writes pages and a PDF that need no network.

Each notebook becomes one HTML page and one chapter of the PDF; both open with the same summary.
"""

import os
import sys
import time
from contextlib import ExitStack, nullcontext
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import nbformat
from tqdm import tqdm

try:
    import resource
except ImportError:  # Windows
    resource = None

from slamlib import locks, swap
from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth
from slamlib.folder import left_in
from slamlib.inventory import inventory_lines
from slamlib.notebook import notices
from slamlib.report import cache, overview
from slamlib.report.chapters import available, chapter_of, in_order, printed, with_data
from slamlib.report.drives import read_drives
from slamlib.report.execution import execute, kernel_environment, read_notebook, temporary_folder
from slamlib.report.numbering import numbered
from slamlib.report.options import Options
from slamlib.report.pages import html_pages, own_pages
from slamlib.report.pdf import typeset
from slamlib.report.pictures import title_picture
from slamlib.report.sections import shown, to_execute
from slamlib.report.setting import missing_glyphs
from slamlib.solve import RESULT_NAMES
from slamlib.studies.memory import CODE_DIGEST, forget
from slamlib.summary import tables

STUDIES = "studies"  # in the cache, besides executed notebooks
TABLES_WAIT = 10.0  # s, for which the notebooks wait for the first numbers
BUILD_LOCK = ".slamlib-build.lock"  # in folders that only one build at a time changes


@dataclass(frozen=True)
class Report:
    """A report that was written."""

    files: list  # of Path, `index.html` first
    drives: list  # of drives.SolvedDrive, with what is doubted and what could not be solved


def build_report(notebooks, data, report, results, datasets=None, options=Options(), jobs=2,
                 kept=None, fresh=False, files=True):
    """Execute all notebooks, write pages and PDF; return the Report.

    Kernels read the absolute paths of data and results, and the selection, from the environment
    variables SLAMLIB_DATA, SLAMLIB_RESULTS and SLAMLIB_DATASETS (one name per line).

    Parameters
    ----------
    notebooks, data : folders of the `*.ipynb` files and of the datasets, one sub-folder each.
    report, results : folders of the pages and of the result files; created if absent.
    datasets : list of str, names of the selected datasets, or None for all.
    options : Options, the title page and what is shown. An appendix that is left out is not
        executed; a chapter is, as it writes the results.
    jobs : int, notebooks executed at a time.
    kept : folder that caches executed notebooks and their Monte Carlo studies, or None for one
        that is removed at the end. Where it has none of these notebooks, each dataset is solved
        first, and its `summary_table` printed.
    fresh : bool; True executes everything although it is cached.
    files : bool; False leaves the table of the result files out of the opening.

    Raises
    ------
    DatasetError : there is no notebook or dataset of a selected name, or a dataset is malformed, or
        what is to be left out is unknown.
    NotebookError : a cell failed or a page cannot be set; report and results are unchanged.

    One build at a time works in a results folder or with a cache; another one waits for it.
    """
    start = time.monotonic()
    notebooks, data, report, results = (
        Path(folder).resolve() for folder in (notebooks, data, report, results))
    address = _address(results, report) if files else None
    books, selected, has = _checked_input(notebooks, data, datasets, options)
    folders = [data / name for name in selected]
    with ExitStack() as stack:
        temporary = stack.enter_context(temporary_folder())
        kept = Path(kept or temporary / "kept").resolve()
        environment = kernel_environment(temporary, data, datasets, kept / STUDIES)
        keys = partial(_keys, books, folders, environment | {"SLAMLIB_RESULTS": str(results)})
        recalled = not fresh and any(
            cache.entry(kept, source, key).exists() for source, key in keys().items())
        with nullcontext() if recalled else tables(folders, _tell) as wait:
            _require_pages(books, options)
            if wait:
                wait(max(0.0, start + TABLES_WAIT - time.monotonic()))
            for folder in sorted({results, kept}):
                stack.enter_context(locks.locked(folder / BUILD_LOCK))
            stage, pages = (
                stack.enter_context(swap.staging(folder)) for folder in (results, report))
            written = _executed(books, keys, environment, jobs, stage, kept, fresh)
        _tell("setting the pages and the PDF")
        drives = read_drives(data, stage, selected, written, notices(books.values()))
        made = rendered(books, drives, options, address, has)
        for name, content in made.items():
            swap.write_atomically(pages / name, content)
        swap.require_staged(stage)
        swap.publish([
            swap.FileSet(report, {name: pages / name for name in made}, last=next(iter(made)),
                     ours=frozenset(own_pages(report))),  # also of notebooks that are gone
            *_result_sets(results, stage, selected, written)])
    _tell(_resources_used(time.monotonic() - start))
    return Report([report / name for name in made], drives)


def _tell(line):
    """Print a line on stderr, above the bar where one is shown."""
    tqdm.write(line, file=sys.stderr)


def _require_pages(books, options):
    """Typeset the Markdown of the notebooks before they are executed, to report errors early."""
    texts = {source: nbformat.v4.new_notebook(
        cells=[cell for cell in book.cells if cell.cell_type == "markdown"])
        for source, book in books.items()}
    html_pages(texts, [chapter_of(*each) for each in books.items()], options.code)
    typeset([*texts.items()], code=options.code, **asdict(options.cover))


def _address(results, report):
    """Return the path (str) of the results from the report, as in a link."""
    try:
        return Path(os.path.relpath(results, report)).as_posix()
    except ValueError:  # Windows
        raise DatasetError(f"{results}: expected a folder on the drive of {report}") from None


def _checked_input(notebooks, data, datasets, options):
    """Return the notebooks by their paths, in order, the datasets' names and what they have."""
    for line, text in asdict(options.cover).items():
        if missing := missing_glyphs(text):
            raise DatasetError(f"title page: the PDF's fonts have no glyph for {missing[0]} in "
                               f"{line} '{text}': write it in Latin, Greek or Cyrillic letters")
    books = {source: read_notebook(source) for source in sorted(notebooks.glob("*.ipynb"))}
    if not books:
        raise DatasetError(f"{notebooks}: there are no notebooks (*.ipynb) in this folder")
    books = in_order(to_execute(books, options.leave_out), options.appendix is not False)
    if not books:
        raise DatasetError(f"{notebooks}: expected a notebook that is not left out")
    selected = dataset_names(data, datasets)
    for name in selected:
        if missing := missing_glyphs(name):
            raise DatasetError(f"{data / name}: the PDF's fonts have no glyph for {missing[0]} in "
                               "the name of this dataset: rename its folder")
    read = [(read_dataset(data / name), read_truth(data / name)) for name in selected]
    for dataset, truth in read:
        print("\n".join(inventory_lines(dataset, truth)), file=sys.stderr)
    for sentence in left_in(data):
        print(sentence, file=sys.stderr)
    has = available(read)
    served = with_data(books, has)
    for source in books.keys() - served.keys():
        print(f"{source.stem}: left out, no dataset has the measurements", file=sys.stderr)
    return served, selected, has


def _result_sets(results, stage, selected, written):
    """Return a swap.FileSet for each of the datasets that are selected or have files in `stage`."""
    files = {name: {} for name in selected}
    for path in written:
        dataset, name = path.split("/", 1) if "/" in path else ("", path)
        files.setdefault(dataset, {})[name] = stage / path
    return [swap.FileSet(results / dataset, found, ours=RESULT_NAMES)
            for dataset, found in files.items()]


def _keys(books, datasets, environment):
    """Return {source: key} with the books' keys in the cache, as files and variables are now."""
    common = cache.fingerprint(datasets, next(iter(books)).parent, environment)
    return {source: cache.key_of(source, book, common) for source, book in books.items()}


def _executed(books, keys, environment, jobs, stage, kept, fresh):
    """Execute books in place, or recall their outputs; return the sorted names of their files.

    `keys` is a function without arguments that returns what `_keys` does, `environment` that of the
    kernels, `stage` the folder of the files, by `swap.staging`.
    """
    written, begun, left = set(), keys(), dict(books)

    def finish(source, book, names):
        swap.require_staged(stage)
        written.update(names)
        if keys() == begun:  # nothing was edited meanwhile
            cache.keep(kept, source, begun[source], book, stage, names)

    if fresh:
        forget(kept / STUDIES)
    else:
        for source, book in books.items():
            if (names := cache.recall(kept, source, begun[source], book, stage)) is not None:
                written.update(names)
                del left[source]
                print(f"{source.stem}: nothing changed, not executed again", file=sys.stderr)
    execute(left, environment, stage, max(1, jobs), finish, _seconds(kept))
    return sorted(written)


def _seconds(kept):
    """Return the paths of two files of cells' seconds, and which bound the second one gives.

    Cells take longer where studies are computed than where these are recalled.
    """
    computed, recalled = kept / "seconds_computed.json", kept / "seconds_recalled.json"
    if (kept / STUDIES / CODE_DIGEST).is_dir():
        return recalled, computed, "at most"
    return computed, recalled, "at least"


def rendered(books, drives, options, address, has):
    """Return the report's files as {name: bytes}, `index.html` first and the PDF last.

    Parameters
    ----------
    books : dict from Path to NotebookNode, executed, in order.
    drives : list of SolvedDrive, of which the opening tells.
    options : Options as of `build_report`.
    address : str, the path of the results folder from that of the report, or None as of
        `overview.opening`.
    has : set of str by `chapters.available`; sections that need other data are left out.
    """
    whole, books = books, shown(books, has, options.leave_out)
    on_paper = numbered({source: printed(book) for source, book in books.items()}, whole)
    on_pages = numbered(books, whole)
    chapters = [chapter_of(source, book) for source, book in on_pages.items()]
    opening = overview.opening(drives, address)
    index = {Path("index"): overview.index(options.cover.title, opening, chapters)}
    solved = [drive for drive in drives if drive.solutions]
    shortened = {source: book for source, book in whole.items() if books.get(source) is not book}
    pages = html_pages(index | on_pages, chapters, options.code, shortened)
    return {name: page.encode() for name, page in pages.items()} | {"report.pdf": typeset(
        [*on_paper.items()], printed(opening), options.code,
        title_picture(solved[-1]) if solved else None, **asdict(options.cover))}


def _resources_used(seconds):
    """Return a sentence with the duration and, if available, the peak memory."""
    if resource is None:
        return f"built in {seconds:.1f} s"
    unit = 1 if sys.platform == "darwin" else 1024  # bytes in a unit of ru_maxrss
    own, largest = (resource.getrusage(who).ru_maxrss * unit / 1e6
                    for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return (f"built in {seconds:.1f} s; memory: {own:.0f} MB, and {largest:.0f} MB in the largest "
            "of the notebooks and other processes")
