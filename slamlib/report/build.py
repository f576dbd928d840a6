"""Builds the report: executes the notebooks, which become pages and the chapters of a PDF."""

import os
import re
import shutil
import sys
import time
from collections import namedtuple
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from tqdm import tqdm

from slamlib.core.errors import require
from slamlib.io import swap
from slamlib.io.dataset import inventory_lines, read_dataset, read_truth
from slamlib.io.tables import datasets_in
from slamlib.notebook import notices
from slamlib.report import cache
from slamlib.report.document import render
from slamlib.report.execution import STUDIES, TRANSPORT, execute, kernel_environment
from slamlib.report.notebooks import Options, shown, to_execute
from slamlib.report.overview import opening, read_drives, title_picture
from slamlib.solve import RESULT_NAMES, SENSORS

DATASET_NAME = re.compile("[A-Za-z0-9 ._-]+")  # nothing that Markdown, HTML or Typst interprets

# Files (list of Path, `index.html` first) and drives (list of overview.SolvedDrive) of a report.
Report = namedtuple("Report", ("files", "drives"))


def build_report(notebooks, data, report, results, datasets=None, options=Options(), jobs=2,
                 kept=None, fresh=False):
    """Execute all notebooks, write pages and PDF; return the Report.

    Kernels read the absolute paths of data and results, and the selection, from SLAMLIB_DATA,
    SLAMLIB_RESULTS and SLAMLIB_DATASETS (one name per line). One build at a time works in a results
    folder or with a cache; another one waits for it. DatasetError if there is no notebook or
    dataset, a dataset is malformed, or what is to be left out is unknown; NotebookError if a cell
    failed or a page cannot be set. Then report and results are unchanged.

    Parameters
    ----------
    notebooks, data : folders of the `*.ipynb` files and of the datasets, one sub-folder each.
    report, results : folders of the pages and of the result files; created if absent.
    datasets : list of str, names of the selected datasets, or None for all.
    options : Options, the title page and what is shown.
    jobs : int, notebooks executed at a time.
    kept : folder that caches executed notebooks and their studies, or None for one that is removed.
    fresh : bool; True executes everything although it is cached.
    """
    start, tell = time.monotonic(), partial(tqdm.write, file=sys.stderr)  # above the bar
    notebooks, data, report, results = (
        Path(folder).resolve() for folder in (notebooks, data, report, results))
    books, read, has = _checked_input(notebooks, data, datasets, options)
    chapters, folders = shown(books, options), [data / dataset.name for dataset, _ in read]
    with ExitStack() as stack:
        temporary = Path(stack.enter_context(TemporaryDirectory(
            dir="/tmp" if TRANSPORT == "ipc" else None,     # paths of sockets must be short
            prefix="slamlib-", ignore_cleanup_errors=True)))
        kept = Path(kept or temporary / "kept").resolve()
        environment = kernel_environment(temporary, data, datasets, kept / STUDIES)
        keys = partial(cache.keys, books, folders, environment | {"SLAMLIB_RESULTS": str(results)})
        stack.enter_context(swap.locked(kept))
        stage, pages = (stack.enter_context(swap.staging(folder)) for folder in (results, report))
        check = partial(render, chapters, options, check=True)
        written = _executed(books, keys, check, environment, jobs, stage, kept, fresh)
        tell("setting the pages and the PDF")
        drives = read_drives(read, stage, written, notices(books.values()))
        solved = [drive for drive in drives if drive.solutions]
        made = render({Path("index"): opening(drives, chapters)} | chapters, options, has,
                      title_picture(solved[-1]) if solved else "")
        for name, content in made.items():
            swap.write_atomically(pages / name, content)
        made_for = {folder.name for folder in folders}
        made_for |= {name.split("/")[0] for name in written if "/" in name}
        swap.publish({report: pages} | {results / name: stage / name for name in made_for},
                     ours=RESULT_NAMES)
        for name in written:
            if "/" not in name:  # of no dataset
                os.replace(stage / name, results / name)
    tell(f"built in {time.monotonic() - start:.1f} s")
    return Report([report / name for name in made], drives)


def _checked_input(notebooks, data, datasets, options):
    """Return the notebooks by their paths, in order, datasets with truth, and what these have."""
    books = to_execute(notebooks, options)
    names, unread = datasets_in(data, datasets)
    for name in names:
        require(DATASET_NAME.fullmatch(name), data / name, "letters from a to z, digits, spaces, "
                "dots, dashes and underscores in its name: rename this folder")
    read = [(read_dataset(data / name), read_truth(data / name)) for name in names]
    lines = [line for dataset, truth in read for line in inventory_lines(dataset, truth)]
    print(*lines, *unread, sep="\n", file=sys.stderr)
    has = {sensor for sensor in SENSORS for dataset, _ in read
           if getattr(dataset, sensor) is not None} | {"truth" for _, truth in read if truth}
    served = {source: book for source, book in books.items()
              if book.metadata.get("slamlib", {}).get("needs") in {None, *has}} or books
    for source in books.keys() - served.keys():
        print(f"{source.stem}: left out, no dataset has the measurements", file=sys.stderr)
    return served, read, has


def _executed(books, keys, check, environment, jobs, stage, kept, fresh):
    """Execute books in place, or recall their outputs; return the sorted names of their files.

    `keys` returns `cache.keys` as they are now, `check` refuses bad text before a kernel starts,
    `stage` is the folder of the files.
    """
    written, begun, left = set(), keys(), dict(books)

    def finish(source, book, names):
        written.update(names)
        if keys() == begun:  # nothing was edited meanwhile
            cache.keep(kept, source, begun[source], book, stage, names)

    for source, book in books.items():
        names = None if fresh else cache.recall(kept, source, begun[source], book, stage)
        if names is not None:
            written.update(names)
            del left[source]
            print(f"{source.stem}: nothing changed, not executed again", file=sys.stderr)
    if left:
        check()
    if fresh:
        shutil.rmtree(kept / STUDIES, ignore_errors=True)
    execute(left, environment, stage, max(1, jobs), finish)
    return sorted(written)
