"""Builds the report: executes the notebooks, which become pages and the chapters of a PDF."""

import hashlib
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
from slamlib.report.document import render
from slamlib.report.execution import TRANSPORT, execute, kernel_environment
from slamlib.report.notebooks import Options, chapter_of, read_books
from slamlib.report.overview import opening, solved_drive, title_picture
from slamlib.robust.file_doubts import doubts_before_solving
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
    short = "/tmp" if TRANSPORT == "ipc" else None  # because paths of sockets must be
    with TemporaryDirectory(dir=short, prefix="slamlib-", ignore_cleanup_errors=True) as temporary:
        kept = (kept or Path(temporary, "kept")).resolve()
        names = [drive.name for drive in drives]
        environment = kernel_environment(Path(temporary), data, names)
        with files.locked(kept):
            stages = _executed(books, drives, data, environment, jobs, kept)
            with files.locked(results), files.locked(report):
                for drive in drives:
                    _write_results(drive, stages, results / drive.name)
                solved = [solved_drive(drive, results / drive.name) for drive in drives]
                shown = {Path("index"): opening(solved, books)} | books
                names = _write_pages(shown, options, title_picture(solved), report)
    _say(f"built in {time.monotonic() - start:.1f} s")
    summaries = [drive.summary for drive in solved]
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
    _say("\n".join(unread))
    return drives


def _with_what_they_need(books, drives):
    """Return the notebooks whose measurements the drives have, or all if there is none."""
    has = {sensor for sensor in SENSORS for drive in drives
           if getattr(drive.dataset, sensor) is not None}
    needs = {source: chapter_of(source, book).needs for source, book in books.items()}
    served = {source: book for source, book in books.items() if needs[source] in has | {None}}
    for source in books:
        if served and source not in served:
            _say(f"{source.stem}: left out, no dataset has {SENSORS[needs[source]]}")
    return served or books


def _executed(books, drives, data, environment, jobs, kept):
    """Execute books in place, or recall their outputs; return the folders of their files."""
    folders = {source: kept / source.stem for source in books}
    stages = {source: folders[source] / cache.RESULTS for source in books}
    datasets = [data / drive.name for drive in drives]
    begun = cache.keys(books, datasets)
    left = {}
    done = []

    def finish(source, told):
        done.append(source)
        _say(f"{len(done)} of {len(books)}: {source.stem}, {told}")

    def keep(source, seconds):
        if cache.keys(books, datasets) == begun:  # nothing was edited meanwhile
            cache.keep(folders[source], begun[source], books[source])
        finish(source, f"executed in {seconds:.1f} s")

    for source, book in books.items():
        if cache.recall(folders[source], begun[source], book):
            finish(source, "nothing changed")
        else:
            left[source] = book
            shutil.rmtree(folders[source], ignore_errors=True)
            stages[source].mkdir(parents=True)
    execute(left, environment, stages, max(1, jobs), keep)
    return list(stages.values())


def _write_results(drive, stages, folder):
    """Write the files of a Drive that notebooks wrote to `stages` into its results."""
    rows = {}
    with files.locked(folder):
        clear_results(folder)
        for stage in stages:
            own = stage / drive.name
            with suppress(DatasetError):  # this notebook solves nothing
                rows |= read_summary(own)["problems"]
            for name in files.file_names(own):
                if name != SUMMARY:
                    files.write_file(folder / name, (own / name).read_bytes())
        doubts = doubts_before_solving(drive.dataset)
        write_summary(folder, summary_of(drive.dataset, drive.truth, rows, doubts))


def _write_pages(books, options, picture, report):
    """Set books as pages and a PDF in a report, unless they are there; return their names.

    Those of an earlier build that are not made now are removed.
    """
    listed = report / PAGES
    key = _key_of_pages(books, options, picture)
    earlier_key = ""
    earlier = []
    with suppress(OSError):
        earlier_key, *earlier = listed.read_text(encoding="utf-8").splitlines()
    if earlier_key == key and all((report / name).is_file() for name in earlier):
        return earlier
    _say("setting the pages and the PDF")
    made = render(books, options, picture)
    listed.unlink(missing_ok=True)
    for name, content in made.items():
        files.write_file(report / name, content)
    for name in set(earlier) - made.keys():
        (report / name).unlink(missing_ok=True)
    files.write_file(listed, "\n".join([key, *made]).encode())
    return list(made)


def _key_of_pages(books, options, picture):
    """Return a digest of all that pages show: notebooks, what is beside them, and their look."""
    state = hashlib.sha256(repr([options, picture]).encode())
    beside = [file for source in books for file in source.parent.iterdir()
              if file.suffix in (".svg", ".png", ".jpg")]
    look = [file for file in Path(__file__).parent.iterdir() if file.is_file()]
    for file in sorted(beside + look):
        state.update(file.read_bytes())
    for source, book in books.items():
        state.update(f"{source}{nbformat.writes(book)}".encode())
    return state.hexdigest()
