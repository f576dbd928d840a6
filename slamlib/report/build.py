"""Builds the report: executes the notebooks, which become pages and the chapters of a PDF."""

import re
import shutil
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import joblib
import nbformat

from slamlib.core.errors import DatasetError, require
from slamlib.io import files
from slamlib.io.results import SUMMARY, read_summary
from slamlib.io.tables import datasets_in
from slamlib.notebook.drives import read_drives
from slamlib.report import cache
from slamlib.report.notebooks import Options, read_books
from slamlib.solve import SENSORS, finish_results, inventory_lines

# Name of the file in a report that has a digest and lists its files; all others are the user's.
PAGES = ".pages"
DATASET_NAME = re.compile("[A-Za-z0-9 ._-]+")  # nothing that Markdown, HTML or Typst interprets


@dataclass(frozen=True)
class Report:
    """The files of a report and what was found."""

    files: list[Path]  # `index.html` first, `report.pdf` last
    summaries: list[dict]  # of the drives, as their summary.json has them


def build_report(notebooks: Path, data: Path, report: Path, results: Path, kept: Path,
                 datasets: list[str] | None = None, options: Options = Options()) -> Report:
    """Execute all notebooks, write results, pages and PDF; return the Report.

    Kernels read the absolute paths of data and results, and the selection, from SLAMLIB_DATA,
    SLAMLIB_RESULTS and SLAMLIB_DATASETS (one name per line). One build at a time works with the
    folder `kept`. DatasetError if there is no notebook or dataset, a dataset is malformed, or a
    chapter that is chosen is unknown; NotebookError if a cell failed or a page cannot be set. If a
    cell failed, report and results are unchanged.

    Parameters
    ----------
    notebooks, data : folders of the `*.ipynb` files and of the datasets, one sub-folder each.
    report, results : folders of the pages and of the result files; created if absent.
    kept : folder that caches executed notebooks.
    datasets : names of the selected datasets; without any, all but simulated ones if others are.
    options : the title page and what is shown.
    """
    data = data.resolve()
    kept = kept.resolve()
    books = read_books(notebooks.resolve(), options.chapters)
    drives = _read(data, datasets)
    books = _with_what_they_need(books, drives)
    with files.locked(kept):
        keys = _execute(books, drives, data, kept)
        stages = [kept / source.stem / cache.RESULTS for source in books]
        summaries = [_write_results(drive, stages, results / drive.name) for drive in drives]
        names = _write_pages(books, keys, drives, summaries, options, results, report)
    if not options.author:
        _say("report.toml names no author: the PDF's title page has none")
    return Report([report / name for name in names], summaries)


def _say(line):
    print(line, file=sys.stderr)


def _read(data, selected):
    """Return the Drives of a build, without simulated ones if others are there."""
    names, unread = datasets_in(data, selected)
    for name in names:
        require(DATASET_NAME.fullmatch(name), data / name, "letters from a to z, digits, spaces, "
                "dots, dashes and underscores in its name: rename this folder")
    drives = read_drives(data, selected)
    for drive in drives:
        _say("\n".join(inventory_lines(drive.dataset, drive.truth)))
    omitted = set(names) - {drive.name for drive in drives}
    if omitted:
        _say(f"left out, because simulated: {', '.join(sorted(omitted))} (name all datasets to "
             "have them)")
    for line in unread:
        _say(line)
    return drives


def _with_what_they_need(books, drives):
    """Return the notebooks whose measurements the drives have."""
    served = {}
    for source, book in books.items():
        sensor = book.metadata.get("slamlib", {}).get("needs")
        if sensor and all(getattr(drive.dataset, sensor) is None for drive in drives):
            _say(f"{source.stem}: left out, no dataset has {SENSORS[sensor]}")
        else:
            served[source] = book
    require(served, "report.toml", "a chapter whose measurements a dataset has, found none")
    return served


def _execute(books, drives, data, kept):
    """Execute books, or recall their outputs, which are put into them; return their keys."""
    names = [drive.name for drive in drives]
    keys = cache.keys(books, [data / name for name in names])
    results = {}
    done = []

    def say(source, told):
        done.append(source)
        _say(f"{len(done)} of {len(books)}: {source.stem}, {told}")

    def finish(source, executed, seconds):
        folder = kept / source.stem
        content = nbformat.writes(executed)
        files.write_file(folder / f"{keys[source]}.ipynb", content.encode())
        cache.recall(folder, keys[source], books[source])
        say(source, f"executed in {seconds:.1f} s")

    for source, book in books.items():
        folder = kept / source.stem
        if cache.recall(folder, keys[source], book):
            say(source, "nothing changed")
        else:
            shutil.rmtree(folder, ignore_errors=True)
            results[source] = folder / cache.RESULTS
            results[source].mkdir(parents=True)
    if results:
        from slamlib.report.execution import execute  # here and below: what is slow to import
        execute(books, data, names, results, finish)
    return keys


def _write_results(drive, stages, folder):
    """Write the files of a Drive that notebooks wrote to `stages`; return the summary."""
    rows = {}
    with files.locked(folder):
        (folder / SUMMARY).unlink(missing_ok=True)
        written = []
        for stage in stages:
            own = stage / drive.name
            with suppress(DatasetError):  # this notebook solves nothing
                rows |= read_summary(own)["problems"]
            for file in own.rglob("*"):
                if file.is_file() and file.name != SUMMARY:
                    written.append(folder / file.relative_to(own))
                    files.write_file(written[-1], file.read_bytes())
        return finish_results(folder, written, drive.dataset, drive.truth, rows)


def _write_pages(books, keys, drives, summaries, options, results, report):
    """Set books as pages and a PDF in a report, unless they are there; return their names.

    Those of an earlier build that are not made now are removed.
    """
    look = sorted(Path(__file__).parent.glob("*.*"))
    key = joblib.hash([options, keys, summaries, books, [file.read_bytes() for file in look]])
    listed = report / PAGES
    earlier = []
    if listed.exists():
        earlier = listed.read_text(encoding="utf-8").splitlines()
    names = earlier[1:]
    if earlier[:1] == [key] and all((report / name).is_file() for name in names):
        return names
    _say("setting the pages and the PDF")
    from slamlib.report import overview
    from slamlib.report.document import render
    solved = [overview.solved_drive(drive, results / drive.name) for drive in drives]
    shown = {Path("index"): overview.opening(solved)} | books
    made = render(shown, options)
    listed.unlink(missing_ok=True)
    for name, content in made.items():
        files.write_file(report / name, content)
    for name in set(names) - made.keys():
        (report / name).unlink(missing_ok=True)
    files.write_file(listed, "\n".join([key, *made]).encode())
    return list(made)
