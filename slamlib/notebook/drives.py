"""Drives of a notebook, their results by problem, and notices of what failed or is doubted.

A notice carries its record in the metadata of the notebook's output. The report's first page
collects the records from the executed notebooks by `notices`, so the results folders hold the files
to hand in and nothing else, and a cached notebook keeps its records.
"""

import os
import re
import unicodedata
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path

from IPython import get_ipython
from IPython.display import Markdown, display
from matplotlib import style
from matplotlib_inline.backend_inline import set_matplotlib_formats

from slamlib import solve
from slamlib.core.records import Dataset, Truth
from slamlib.io.dataset import read_dataset, read_truth
from slamlib.io.results import write_solution
from slamlib.io.tables import datasets_in
from slamlib.notebook import plotting
from slamlib.studies.simulation import simulate

KEY = "slamlib"  # of records in the metadata of outputs
RECORDS = {"doubt": solve.Doubt, "failure": solve.Failure}  # types of records by their key
_WRITTEN = {}  # by the folder of files that this kernel wrote: the cell that did, and its execution


@dataclass(frozen=True, eq=False)          # compared by identity, because arrays have no hash
class Drive:
    """A dataset and its truth, which serves figures and tables only."""

    name: str
    dataset: Dataset = field(repr=False)
    truth: Truth | None = field(repr=False)
    made_up: bool = False  # True for a simulated drive that replaces datasets without a sensor

    @property
    def origin(self) -> str:
        """Origin of the data, a str; only simulations have other true wheel parameters."""
        if self.truth is None:
            return "recorded"
        same = self.truth.vehicle == self.dataset.vehicle
        return "recorded, truth known" if same else "simulated"


def start(sensor: str | None = None) -> list[Drive]:
    """List of the drives with a sensor, "aruco" or "uwb", the one with the fewest poses first.

    A simulated drive replaces them if there is none. The environment variable SLAMLIB_DATA names
    the data folder; by default it is the nearest `data` in this folder or above it.
    SLAMLIB_DATASETS selects datasets by name, one a line. Also sets the style of the figures.
    Raises DatasetError if a dataset does not follow the format, or there is none.
    """
    style.use(plotting.STYLE)
    set_matplotlib_formats("svg", metadata={"Date": None})
    data = _data_folder()
    selected = os.environ.get("SLAMLIB_DATASETS")
    names, _ = datasets_in(data, selected.split("\n") if selected else None)
    drives = [Drive(name, read_dataset(data / name), read_truth(data / name)) for name in names]
    if sensor:
        drives = [drive for drive in drives if getattr(drive.dataset, sensor) is not None]
    return _or_simulated(sorted(drives, key=lambda drive: len(drive.dataset.ticks)))


def _or_simulated(drives):
    """The drives, or a simulated short one and a notice if there is none."""
    if drives:
        return drives
    display(Markdown("*No dataset is left for this chapter: it runs on a simulated drive "
                     "instead and writes no results.*"))
    dataset, truth = simulate("short", seed=1)
    return [Drive("simulated", dataset, truth, made_up=True)]


def solved(drives: Iterable[Drive], **solvers: Callable) -> dict | list[dict]:
    """Results of solvers by problem, as {Drive: result} of the drives on which all succeed.

    Every result is written into the results folder, also of drives on which another problem fails;
    what fails and what is doubted is shown, there and on the report's first page. A second call for
    a problem of a drive writes nothing and says so, unless its cell is run again. If no drive is
    left, a simulated short one replaces them, of which nothing is written. The environment variable
    SLAMLIB_RESULTS names the results folder; by default it is `results` beside the data folder.

    Parameters
    ----------
    drives : iterable of Drive; those without a sensor that a problem needs are left out.
    solvers : functions of a Drive by problem, names of `solve.PROBLEMS`, that return what
        `solve.find` returns, such as `problem3=lambda drive: estimate(drive.dataset)`.

    Returns
    -------
    dict of results by Drive, or a list of such dicts if there are several solvers.
    """
    drives = _or_simulated([
        drive for drive in drives
        if all(solve.allows(drive.dataset, problem) for problem in solvers)])
    found = {drive: {} for drive in drives}
    for drive, problem in product(drives, solvers):
        try:
            result = solvers[problem](drive)
            solution = solve.problem_solution(problem, drive.dataset, result)
        except solve.UNSOLVABLE as error:
            if drive.made_up:
                raise
            failure = solve.failure(problem, drive.dataset, error)
            _notice(drive, f"The problem “{failure.title}” could not be solved: "
                           f"{failure.reason}.", failure=failure)
        else:
            found[drive][problem] = result
            if not drive.made_up:
                _write(drive, solution)
    left = [drive for drive in drives if len(found[drive]) == len(solvers)]
    if not left:
        return solved([], **solvers)
    by_problem = [{drive: found[drive][problem] for drive in left} for problem in solvers]
    return by_problem if len(solvers) > 1 else by_problem[0]


def _write(drive, solution):
    """Write a Solution of a Drive and show its doubts, or say why its files stay as they are."""
    results = Path(os.environ.get("SLAMLIB_RESULTS") or _data_folder().parent / "results")
    folder = results / drive.name
    if _writes(folder / solution.problem):
        write_solution(folder, solution)
        show_doubts(drive, solution.doubts)
    else:
        _notice(drive, f"the files of {solution.problem} stay those of the first call of solved in "
                       "this notebook; for comparisons there is attempted.")


def _writes(folder):
    """True for the first call that writes a folder, and where JupyterLab runs its cell again."""
    request = getattr(get_ipython(), "parent_header", {})
    cell = request.get("metadata", {}).get("cellId")
    execution = request.get("header", {}).get("msg_id")
    if folder in _WRITTEN:
        first_cell, last_execution = _WRITTEN[folder]
        if not cell or cell != first_cell or execution == last_execution:
            return False
    _WRITTEN[folder] = cell, execution
    return True


def attempted(drives: Iterable[Drive], function: Callable) -> dict:
    """{Drive: function(Drive)} of the drives on which it can be solved; shows why on others not."""
    found = {}
    for drive in drives:
        try:
            found[drive] = function(drive)
        except solve.UNSOLVABLE as error:
            _notice(drive, f"left out here: {error}.")
    return found


def show_doubts(drive: Drive, doubts: Iterable[solve.Doubt]) -> None:
    """Show each Doubt of a list about a Drive."""
    for doubt in doubts:
        _notice(drive, doubt.sentence, doubt=doubt)


def _notice(drive, text, **records):
    """Show a text about a Drive, with a record by its key in RECORDS for `notices`."""
    metadata = {}
    if records and not drive.made_up:
        entry = {kind: asdict(record) for kind, record in records.items()}
        metadata = {KEY: {"dataset": drive.name} | entry}
    display(Markdown(f"**{plain(drive.name)}**: {plain(text)}"), metadata=metadata)


def plain(text: str) -> str:
    """Text (str) with the characters escaped that Markdown or HTML would interpret.

    Names from folders and files pass it. A space replaces a control character.
    """
    seen = "".join(" " if unicodedata.category(sign)[0] == "C" else sign for sign in text)
    return re.sub(r"[^\w\s.,:;/+-]|(?<![^\W_])_|_(?![^\W_])",
                  lambda sign: f"&#{ord(sign[0])};", seen)


def notices(books: Iterable) -> dict[str, list]:
    """Records in executed notebooks, by dataset: {name: list of Doubt and Failure}, each once."""
    found = {}
    for cell in (cell for book in books for cell in book.cells):
        for output in cell.get("outputs", ()):
            entry = output.get("metadata", {}).get(KEY, {})
            for kind in RECORDS.keys() & entry.keys():
                record = RECORDS[kind](**entry[kind])
                found.setdefault(entry["dataset"], {})[record] = True
    return {name: list(records) for name, records in found.items()}


def _data_folder():
    """The folder that SLAMLIB_DATA names, or the nearest `data` in this folder or above it."""
    stated = os.environ.get("SLAMLIB_DATA")
    here = Path.cwd()
    near = (folder / "data" for folder in (here, *here.parents))
    return Path(stated or next(filter(Path.is_dir, near), here / "data"))
