"""Drives of a notebook: their datasets, the files of their results, and what is said of them.

What fails or is doubted stands in a sentence in the chapter, and in the drive's `summary.json`,
from which the report's first page has it.
"""

import logging
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from IPython.display import Markdown, display

from slamlib import solve
from slamlib.core.errors import UNSOLVABLE, require
from slamlib.core.records import Dataset, Truth
from slamlib.io.dataset import read_dataset, read_truth
from slamlib.io.tables import datasets_in
from slamlib.notebook import plotting
from slamlib.robust.file_doubts import doubts_before_solving, merged


@dataclass(frozen=True, eq=False)          # compared by identity, because arrays have no hash
class Drive:
    """A dataset and its truth, which serves figures and tables only."""

    name: str
    dataset: Dataset = field(repr=False)
    truth: Truth | None = field(repr=False)

    @property
    def origin(self) -> str:
        """Origin of the data, a str; only simulations have other true wheel parameters."""
        if self.truth is None:
            return "recorded"
        same = self.truth.vehicle == self.dataset.vehicle
        return "recorded, truth known" if same else "simulated"

    @cached_property
    def doubts(self) -> list[solve.Doubt]:
        """Doubts about its files, before anything is solved."""
        return doubts_before_solving(self.dataset)


def read_drives(data: Path, selected: list[str] | None = None) -> list[Drive]:
    """List of the Drives with these names in a data folder, recorded ones first, then by length.

    Without names they are all, but simulated ones only where no other is there. Raises DatasetError
    if a dataset is not there or does not follow the format.
    """
    names = datasets_in(data, selected)[0]
    drives = [Drive(name, read_dataset(data / name), read_truth(data / name)) for name in names]
    drives.sort(key=lambda drive: (drive.origin == "simulated", len(drive.dataset.ticks)))
    return drives if selected else without_stand_ins(drives)


def without_stand_ins(drives: list[Drive]) -> list[Drive]:
    """The recorded ones of some Drives, or all where none is recorded."""
    return [drive for drive in drives if drive.origin != "simulated"] or drives


def start(sensor: str = "ticks") -> list[Drive]:
    """List of the drives with a sensor, "ticks", "aruco" or "uwb", as `read_drives` has them.

    The environment variable SLAMLIB_DATA names the data folder; by default it is the nearest `data`
    in this folder or above it. SLAMLIB_DATASETS selects datasets by name, one a line. Also sets the
    style of the figures.
    Raises DatasetError if a dataset does not follow the format, or none has the sensor.
    """
    plotting.use_style()
    selected = os.environ.get("SLAMLIB_DATASETS", "")
    drives = read_drives(_data_folder(), selected.splitlines())
    drives = [drive for drive in drives if getattr(drive.dataset, sensor) is not None]
    require(drives, _data_folder(), f"a dataset with {solve.SENSORS.get(sensor)}, found none")
    return drives


def write_results(drive: Drive, problem: str, found) -> None:
    """Write what a solver found of a problem to the results of a Drive, and say what is doubted.

    `problem` is a key of `solve.PROBLEMS`, `found` as `solve.find` returns it, or the exception
    that it raised, which is said. The environment variable SLAMLIB_RESULTS names the folder of
    results; by default it is `results` beside the data folder. Raises what `attempt` tells if
    `found` is no solution.
    """
    results = Path(os.environ.get("SLAMLIB_RESULTS") or _data_folder().parent / "results")
    solved = solve.write_results(
        results / drive.name, problem, found, drive.dataset, drive.truth)
    if isinstance(solved, solve.Failure):
        title = solve.PROBLEMS[problem].title
        _say(drive, f"The problem “{title}” could not be solved: {solved.reason}.")
    else:
        told = merged([*drive.doubts, *solved.doubts])
        show_doubts(drive, [doubt for doubt in told if doubt not in drive.doubts])


@contextmanager
def attempt(drive: Drive, problem: str | None = None) -> Iterator[None]:
    """Say in a sentence why a block fails on a Drive, and go on behind it.

    What slamlib warns of in the block is said, too. Where the block solves a problem, a key of
    `solve.PROBLEMS`, its failure is in the results.
    """
    warnings = logging.Handler(logging.WARNING)
    warnings.emit = lambda record: _say(drive, record.getMessage())
    log = logging.getLogger("slamlib")
    log.addHandler(warnings)
    try:
        yield
    except UNSOLVABLE as error:
        if problem is None:
            _say(drive, f"left out here: {error}.")
        else:
            write_results(drive, problem, error)
    finally:
        log.removeHandler(warnings)


def show_doubts(drive: Drive, doubts: Iterable[solve.Doubt]) -> None:
    """Show each Doubt of a list about a Drive."""
    for doubt in doubts:
        _say(drive, doubt.sentence)


def _say(drive, sentence):
    display(Markdown(f"**{plain(drive.name)}**: {plain(sentence)}"))


def plain(text: str) -> str:
    """Text (str) with the characters escaped that Markdown or HTML would interpret.

    Names from folders and files pass it.
    """
    return re.sub(r"[^\w\s.,:;/+-]|(?<![^\W_])_|_(?![^\W_])",
                  lambda sign: f"&#{ord(sign[0])};", text)


def _data_folder():
    """The folder that SLAMLIB_DATA names, or `data`, here or beside the folder of notebooks."""
    here = Path("data")
    nearest = here if here.is_dir() else Path("..", "data")
    return Path(os.environ.get("SLAMLIB_DATA", nearest))
