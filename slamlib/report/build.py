"""Builds the report: executes the notebooks, which become pages and the chapters of a PDF."""

import re
import shutil
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat

from slamlib.core.errors import DatasetError, require
from slamlib.io import files
from slamlib.io.dataset import inventory_lines
from slamlib.io.results import SUMMARY, read_summary, write_summary
from slamlib.io.tables import datasets_in
from slamlib.notebook.drives import read_drives, without_stand_ins
from slamlib.report import cache
from slamlib.report.notebooks import Options, needs_of, read_books
from slamlib.robust.file_doubts import Doubt
from slamlib.solve import SENSORS, clear_results, summary_of

# Name of the file in a report that has a digest and lists its files; all others are the user's.
PAGES = ".pages"
DATASET_NAME = re.compile("[A-Za-z0-9 ._-]+")  # nothing that Markdown, HTML or Typst interprets


@dataclass(frozen=True)
class Report:
    """The files of a report and what was found."""

    files: list[Path]  # `index.html` first, `report.pdf` last
    summaries: list[dict]  # of the drives, as their summary.json has them


def build_report(notebooks: Path, data: Path, report: Path, results: Path,
                 datasets: list[str] | None = None, options: Options = Options(), jobs: int = 2,
                 kept: Path | None = None) -> Report:
    """Execute all notebooks, write results, pages and PDF; return the Report.

    Kernels read the absolute paths of data and results, and the selection, from SLAMLIB_DATA,
    SLAMLIB_RESULTS and SLAMLIB_DATASETS (one name per line). One build at a time works with a
    folder. DatasetError if there is no notebook or dataset, a dataset is malformed, or a chapter
    that is chosen is unknown; NotebookError if a cell failed or a page cannot be set. If a cell
    failed, report and results are unchanged.

    Parameters
    ----------
    notebooks, data : folders of the `*.ipynb` files and of the datasets, one sub-folder each.
    report, results : folders of the pages and of the result files; created if absent.
    datasets : names of the selected datasets; None for all, without simulated ones if others are.
    options : the title page and what is shown.
    jobs : notebooks executed at a time.
    kept : folder that caches executed notebooks, or None for one that is removed.
    """
    start = time.monotonic()
    data = data.resolve()
    books = read_books(notebooks.resolve(), options.chapters)
    drives = _read(data, datasets)
    books = _with_what_they_need(books, drives)
    with TemporaryDirectory() as temporary:
        kept = (kept or Path(temporary)).resolve()
        with files.locked(kept):
            keys = _execute(books, drives, data, jobs, kept)
            stages = [kept / source.stem / cache.RESULTS for source in books]
            with files.locked(report):
                summaries = [_write_results(drive, stages, results / drive.name)
                             for drive in drives]
                names = _write_pages(books, keys, drives, summaries, options, results, report)
    _say(f"built in {time.monotonic() - start:.1f} s")
    return Report([report / name for name in names], summaries)


def _say(line):
    print(line, file=sys.stderr)


def _read(data, selected):
    """Return the Drives of a build, without simulated ones if others are there."""
    names, unread = datasets_in(data, selected)
    for name in names:
        require(DATASET_NAME.fullmatch(name), data / name, "letters from a to z, digits, spaces, "
                "dots, dashes and underscores in its name: rename this folder")
    found = read_drives(data, names)
    drives = found if selected else without_stand_ins(found)
    for drive in drives:
        _say("\n".join(inventory_lines(drive.dataset, drive.truth)))
    omitted = [drive.name for drive in found if drive not in drives]
    if omitted:
        _say(f"left out, because simulated: {', '.join(omitted)} (name all datasets to have "
             "them)")
    for line in unread:
        _say(line)
    return drives


def _with_what_they_need(books, drives):
    """Return the notebooks whose measurements the drives have."""
    served = {}
    for source, book in books.items():
        sensor = needs_of(book)
        if sensor and all(getattr(drive.dataset, sensor) is None for drive in drives):
            _say(f"{source.stem}: left out, no dataset has {SENSORS[sensor]}")
        else:
            served[source] = book
    require(served, "report.toml", "a chapter whose measurements a dataset has, found none")
    return served


def _execute(books, drives, data, jobs, kept):
    """Execute books, or recall their outputs, into which they are put; return their keys."""
    datasets = [data / drive.name for drive in drives]
    keys = cache.keys(books, datasets)
    left = {}
    done = []

    def say(source, told):
        done.append(source)
        _say(f"{len(done)} of {len(books)}: {source.stem}, {told}")

    def finish(source, executed, seconds):
        cache.put_outputs(books[source], executed)
        if cache.keys(books, datasets) == keys:  # nothing was edited meanwhile
            cache.keep(kept / source.stem, keys[source], executed)
        say(source, f"executed in {seconds:.1f} s")

    for source, book in books.items():
        folder = kept / source.stem
        if cache.recall(folder, keys[source], book):
            say(source, "nothing changed")
        else:
            left[source] = folder / cache.RESULTS
            shutil.rmtree(folder, ignore_errors=True)
            left[source].mkdir(parents=True)
    if left:
        from slamlib.report.execution import execute  # here and below: what is slow to import
        names = [drive.name for drive in drives]
        execute({source: books[source] for source in left}, data, names, left, max(1, jobs), finish)
    return keys


def _write_results(drive, stages, folder):
    """Write the files of a Drive that notebooks wrote to `stages`; return the summary."""
    rows = {}
    doubts = []
    with files.locked(folder):
        clear_results(folder)
        for stage in stages:
            own = stage / drive.name
            with suppress(DatasetError):  # this notebook solves nothing
                summary = read_summary(own)
                rows |= summary["problems"]
                doubts += [Doubt(**doubt) for doubt in summary["doubts"]]
            for name in files.file_names(own):
                if name != SUMMARY:
                    files.write_file(folder / name, (own / name).read_bytes())
        summary = summary_of(drive.dataset, drive.truth, rows, doubts)
        write_summary(folder, summary)
    return summary


def _write_pages(books, keys, drives, summaries, options, results, report):
    """Set books as pages and a PDF in a report, unless they are there; return their names.

    Those of an earlier build that are not made now are removed.
    """
    look = sorted(file for file in Path(__file__).parent.iterdir() if file.is_file())
    key = cache.digest(options, keys, summaries, [nbformat.writes(book) for book in books.values()],
                       [file.read_bytes() for file in look])
    listed = report / PAGES
    earlier_key = ""
    earlier = []
    with suppress(OSError):
        earlier_key, *earlier = listed.read_text(encoding="utf-8").splitlines()
    if earlier_key == key and all((report / name).is_file() for name in earlier):
        return earlier
    _say("setting the pages and the PDF")
    from slamlib.report import overview
    from slamlib.report.document import render
    solved = [overview.solved_drive(drive, results / drive.name) for drive in drives]
    shown = {Path("index"): overview.opening(solved)} | books
    made = render(shown, options)
    listed.unlink(missing_ok=True)
    for name, content in made.items():
        files.write_file(report / name, content)
    for name in set(earlier) - made.keys():
        (report / name).unlink(missing_ok=True)
    files.write_file(listed, "\n".join([key, *made]).encode())
    return list(made)
