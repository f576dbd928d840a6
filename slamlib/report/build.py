"""Builds the report: executes the notebooks, which become pages and the chapters of a PDF."""

import re
import shutil
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from slamlib.core.errors import require
from slamlib.io import files
from slamlib.io.dataset import inventory_lines, read_dataset, read_truth
from slamlib.io.results import write_summary
from slamlib.io.tables import datasets_in
from slamlib.notebook import notices
from slamlib.report import cache
from slamlib.report.document import render
from slamlib.report.execution import STUDIES, TRANSPORT, execute, kernel_environment
from slamlib.report.notebooks import Options, chapter_of, read_books
from slamlib.report.overview import SolvedDrive, opening, read_drives, title_picture
from slamlib.solve import SENSORS, clear_results, summary_of, summary_row

PAGES = ".pages"  # name of the file in a report that lists its files; all others are the user's
DATASET_NAME = re.compile("[A-Za-z0-9 ._-]+")  # nothing that Markdown, HTML or Typst interprets


@dataclass(frozen=True)
class Report:
    """The files of a report and what was found."""

    files: list[Path]  # `index.html` first, `report.pdf` last
    drives: list[SolvedDrive]


def build_report(notebooks: Path, data: Path, report: Path, results: Path,
                 datasets: list[str] | None = None, options: Options = Options(), jobs: int = 2,
                 kept: Path | None = None, fresh: bool = False) -> Report:
    """Execute all notebooks, write pages and PDF; return the Report.

    Kernels read the absolute paths of data and results, and the selection, from SLAMLIB_DATA,
    SLAMLIB_RESULTS and SLAMLIB_DATASETS (one name per line). One build at a time works in a results
    folder or with a cache; another one waits for it. DatasetError if there is no notebook or
    dataset, a dataset is malformed, or a chapter that is chosen is unknown; NotebookError if a cell
    failed or a page cannot be set. Then report and results are unchanged.

    Parameters
    ----------
    notebooks, data : folders of the `*.ipynb` files and of the datasets, one sub-folder each.
    report, results : folders of the pages and of the result files; created if absent.
    datasets : names of the selected datasets, or None for all.
    options : the title page and what is shown.
    jobs : notebooks executed at a time.
    kept : folder that caches executed notebooks and their studies, or None for one that is removed.
    fresh : True executes everything although it is cached.
    """
    start = time.monotonic()
    data = data.resolve()
    report = report.resolve()
    results = results.resolve()
    books = read_books(notebooks.resolve(), options.chapters)
    read = _read_datasets(data, datasets)
    books = _with_what_they_need(books, read)
    short = "/tmp" if TRANSPORT == "ipc" else None  # because paths of sockets must be
    with TemporaryDirectory(dir=short, prefix="slamlib-", ignore_cleanup_errors=True) as temporary:
        kept = (kept or Path(temporary, "kept")).resolve()
        environment = kernel_environment(Path(temporary), data, datasets, kept / STUDIES)
        folders = [data / dataset.name for dataset, _ in read]
        keys = partial(cache.keys, books, folders, environment | {"SLAMLIB_RESULTS": str(results)})
        stage = Path(temporary, "results")
        with files.locked(kept), files.locked(results), files.locked(report):
            written = _executed(books, keys, environment, jobs, stage, kept, fresh)
            print("setting the pages and the PDF", file=sys.stderr)
            drives = read_drives(read, stage, written, notices(books.values()))
            made = _rendered(drives, books, options)
            _write_results(drives, stage, written, results)
            _write_pages(made, report)
    print(f"built in {time.monotonic() - start:.1f} s", file=sys.stderr)
    return Report([report / name for name in made], drives)


def _read_datasets(data, selected):
    """Return the datasets in a folder with their truth, list of (Dataset, Truth or None)."""
    names, unread = datasets_in(data, selected)
    for name in names:
        require(DATASET_NAME.fullmatch(name), data / name, "letters from a to z, digits, spaces, "
                "dots, dashes and underscores in its name: rename this folder")
    read = [(read_dataset(data / name), read_truth(data / name)) for name in names]
    lines = [line for dataset, truth in read for line in inventory_lines(dataset, truth)]
    print("\n".join(lines + unread), file=sys.stderr)
    return read


def _with_what_they_need(books, read):
    """Return the notebooks whose measurements the datasets have, or all if there is none."""
    has = {sensor for sensor in SENSORS for dataset, _ in read
           if getattr(dataset, sensor) is not None}
    needs = {source: chapter_of(source, book).needs for source, book in books.items()}
    served = {source: book for source, book in books.items() if needs[source] in has | {None}}
    if not served:
        return books
    for source in books.keys() - served.keys():
        print(f"{source.stem}: left out, no dataset has {SENSORS[needs[source]]}", file=sys.stderr)
    return served


def _executed(books, keys, environment, jobs, stage, kept, fresh):
    """Execute books in place, or recall their outputs; return the sorted names of their files.

    `keys` returns `cache.keys` as they are now, `stage` is the folder of the files.
    """
    written = set()
    left = {}
    begun = keys()
    for source, book in books.items():
        names = None if fresh else cache.recall(kept, source, begun[source], book, stage)
        if names is None:
            left[source] = book
        else:
            written.update(names)
            print(f"{source.stem}: nothing changed, not executed again", file=sys.stderr)

    def finish(source, book, names):
        written.update(names)
        if keys() == begun:  # nothing was edited meanwhile
            cache.keep(kept, source, begun[source], book, stage, names)

    if fresh:
        shutil.rmtree(kept / STUDIES, ignore_errors=True)
    execute(left, environment, stage, max(1, jobs), finish)
    return sorted(written)


def _write_results(drives, stage, written, results):
    """Write files from the folder `stage` to the results, and the summary of each SolvedDrive."""
    for drive in drives:
        folder = results / drive.name
        rows = {each.problem: summary_row(each, drive.truth)
                for each in drive.solutions + drive.failures}
        with files.locked(folder):
            clear_results(folder)
            for name in drive.files:
                _copy(f"{drive.name}/{name}", stage, results)
            summary = summary_of(drive.dataset, drive.truth, rows, drive.doubts)
            write_summary(folder, summary)
    names = {drive.name for drive in drives}
    for name in written:
        if name.split("/")[0] not in names:
            _copy(name, stage, results)


def _copy(name, source, target):
    files.write_file(target / name, (source / name).read_bytes())


def _write_pages(made, report):
    """Write pages, {name: bytes}, and remove those of an earlier build that are not made now."""
    listed = report / PAGES
    earlier = set()
    with suppress(OSError):
        earlier = set(listed.read_text(encoding="utf-8").splitlines())
    for name, content in made.items():
        files.write_file(report / name, content)
    for name in earlier - made.keys():
        (report / name).unlink(missing_ok=True)
    files.write_file(listed, "\n".join(made).encode())


def _rendered(drives, books, options):
    """Return the files of the report, {name: bytes}."""
    solved = [drive for drive in drives if drive.solutions]
    picture = title_picture(solved[-1]) if solved else ""
    return render({Path("index"): opening(drives, books)} | books, options, picture)
