"""Drives of a notebook, their results by problem, and notices of what failed or is doubted.

A notice carries its record in the metadata of the notebook's output. The report's first page
collects the records from the executed notebooks by `notices`, so the results folders hold the files
to hand in and nothing else, and a cached notebook keeps its records.
"""

import os
import re
import unicodedata
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
    def origin(self):
        """Origin of the data, a str; only simulations have other true wheel parameters."""
        if self.truth is None:
            return "recorded"
        same = self.truth.vehicle == self.dataset.vehicle
        return "recorded, truth known" if same else "simulated"


def start(sensor=None):
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
    return _or_simulated([drive for drive in sorted(drives, key=lambda d: len(d.dataset.ticks))
                          if not sensor or getattr(drive.dataset, sensor) is not None])


def _or_simulated(drives):
    """The drives, or a simulated short one and a notice if there is none."""
    if not drives:
        display(Markdown("*No dataset is left for this chapter: it runs on a simulated drive "
                         "instead and writes no results.*"))
    return drives or [Drive("simulated", *simulate("short", seed=1), made_up=True)]


def solved(drives, **solvers):
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
    drives = _or_simulated([drive for drive in drives if all(
        solve.allows(drive.dataset, problem) for problem in solvers)])
    found = {drive: {} for drive in drives}
    results = Path(os.environ.get("SLAMLIB_RESULTS") or _data_folder().parent / "results")
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
            continue
        found[drive][problem] = result
        if not drive.made_up and _writes(results / drive.name / problem):
            write_solution(results / drive.name, solution)
            show_doubts(drive, solution.doubts)
        elif not drive.made_up:
            _notice(drive, f"the files of {problem} stay those of the first call of solved in this "
                           "notebook; for comparisons there is attempted.")
    left = [drive for drive in drives if len(found[drive]) == len(solvers)]
    if not left:
        return solved(_or_simulated([]), **solvers)
    by_problem = [{drive: found[drive][problem] for drive in left} for problem in solvers]
    return by_problem if len(solvers) > 1 else by_problem[0]


def _writes(folder):
    """True for the first call that writes a folder, and where JupyterLab runs its cell again."""
    request = getattr(get_ipython(), "parent_header", {})
    this = request.get("metadata", {}).get("cellId"), request.get("header", {}).get("msg_id")
    cell, execution = _WRITTEN.setdefault(folder, this)
    if this[0] and cell == this[0] and execution != this[1]:
        _WRITTEN[folder] = this
    return _WRITTEN[folder] is this


def attempted(drives, function):
    """{Drive: function(Drive)} of the drives on which it can be solved; shows why on others not."""
    found = {}
    for drive in drives:
        try:
            found[drive] = function(drive)
        except solve.UNSOLVABLE as error:
            _notice(drive, f"left out here: {error}.")
    return found


def show_doubts(drive, doubts):
    """Show each Doubt of a list about a Drive."""
    for doubt in doubts:
        _notice(drive, doubt.sentence, doubt=doubt)


def _notice(drive, text, **record):
    """Show a text about a Drive, with a record for `notices`."""
    entry = {KEY: {"dataset": drive.name, **{kind: asdict(each) for kind, each in record.items()}}}
    display(Markdown(f"**{plain(drive.name)}**: {plain(text)}"),
            metadata=entry if record and not drive.made_up else {})


def plain(text):
    """Text (str) with the characters escaped that Markdown or HTML would interpret.

    Names from folders and files pass it. A space replaces a control character.
    """
    seen = "".join(" " if unicodedata.category(sign)[0] == "C" else sign for sign in text)
    return re.sub(r"[^\w\s.,:;/+-]|(?<![^\W_])_|_(?![^\W_])",
                  lambda sign: f"&#{ord(sign[0])};", seen)


def notices(books):
    """Records in executed notebooks, by dataset: {name: list of Doubt and Failure}, each once."""
    found = {}
    for cell in (cell for book in books for cell in book.cells):
        for entry in (each.get("metadata", {}).get(KEY, {}) for each in cell.get("outputs", ())):
            for kind in RECORDS.keys() & entry.keys():
                found.setdefault(entry["dataset"], {})[RECORDS[kind](**entry[kind])] = True
    return {name: [*records] for name, records in found.items()}


def _data_folder():
    here = Path.cwd()
    near = (each / "data" for each in (here, *here.parents) if (each / "data").is_dir())
    return Path(os.environ.get("SLAMLIB_DATA") or next(near, here / "data"))
