"""What the notebooks share: which datasets they run on, where results go, sentences and tables."""

import os
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
from IPython.core.interactiveshell import InteractiveShell
from IPython.display import Markdown, display
from matplotlib.figure import Figure
from matplotlib_inline.backend_inline import set_matplotlib_formats

from slamlib import plotting
from slamlib.dataset import Dataset, Truth, dataset_names, read_dataset, read_truth
from slamlib.simulation import simulate


@dataclass(frozen=True)
class Log:
    """A dataset with its name and, for figures and tables only, its truth (or None)."""

    name: str
    dataset: Dataset
    truth: Truth | None
    made_up: bool = False          # a simulated drive to read a chapter by, no dataset of the user's

    @property
    def origin(self):
        """What is known of where the data come from: true wheel radii are known in simulations only."""
        if self.truth is None:
            return "recorded"
        return "recorded, truth known" if self.truth.vehicle == self.dataset.vehicle else "simulated"


def start():
    """Set the look of the figures and read the logs.

    The data folder is SLAMLIB_DATA, or else the nearest `data` in this folder or above it.
    SLAMLIB_DATASETS selects folders in it by name, one a line; by default all are read.

    Returns
    -------
    list of Log, by name but the shortest drive first.

    Raises
    ------
    DatasetError
        A dataset is not as it must be, or there is none.
    """
    plotting.use_style()
    _show_figures()
    data = _folder("SLAMLIB_DATA", "data")
    selected = os.environ.get("SLAMLIB_DATASETS")
    names = dataset_names(data, selected.split("\n") if selected else None)
    logs = [Log(name, read_dataset(data / name), read_truth(data / name)) for name in names]
    return sorted(logs, key=lambda log: len(log.dataset.ticks))


def _show_figures():
    """As SVG in JupyterLab; where the report is built, wide and narrow, for its pages to choose from."""
    if interactive():
        set_matplotlib_formats("svg", metadata={"Date": None})
    else:
        set_matplotlib_formats()
        InteractiveShell.instance().display_formatter.mimebundle_formatter.for_type(
            Figure, lambda fig, **_: plotting.pictures(fig))


def results_folder(log):
    """Where this log's results go: SLAMLIB_RESULTS, or else `results` beside the data folder."""
    results = os.environ.get("SLAMLIB_RESULTS")
    return (Path(results) if results else _folder("SLAMLIB_DATA", "data").parent / "results") / log.name


def with_truth(logs, lost):
    """The logs that have truth; for the others a sentence says that `lost` cannot be shown."""
    without = [log.name for log in logs if log.truth is None]
    if without:
        say(f"*No truth comes with {listed(without)}, so {lost} cannot be shown there.*")
    return [log for log in logs if log.truth is not None]


def with_sensor(logs, sensor, name):
    """The logs whose dataset has this sensor; a sentence names the others.

    Where there is none, a simulated short drive takes their place, so that the chapter can be read.
    """
    without = [log.name for log in logs if getattr(log.dataset, sensor) is None]
    if len(without) == len(logs):
        say(f"*No dataset has {name}. This chapter runs on a simulated drive instead, and writes no "
            "results.*")
        return [Log("simulated", *simulate("short", seed=1), made_up=True)]
    if without:
        say(f"*There are no {name} in {listed(without)}: this chapter leaves them out.*")
    return [log for log in logs if log.name not in without]


def interactive():
    """True in JupyterLab, False where the report is built."""
    return "SLAMLIB_RESULTS" not in os.environ


def listed(names):
    """a, b and c."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def say(markdown):
    """Show a sentence with computed numbers as text."""
    display(Markdown(markdown))


def captioned(fig, caption):
    """Show a figure, and directly below it its caption, which may hold computed numbers."""
    display(fig)
    plt.close(fig)                      # or it would be shown again at the end of the cell
    say(caption)


def table(header, rows, caption=None, texts=1):
    """Show a table: header is a list of str, rows are lists of str; the first `texts` columns are text."""
    text = table_text(header, rows, texts)
    say(text + (f"\n\n{caption}" if caption else ""))


def table_text(header, rows, texts=1):
    """A table in Markdown, of which the first `texts` columns are text and the others numbers."""
    lines = [header, ["---"] * texts + ["---:"] * (len(header) - texts), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _folder(variable, name):
    if os.environ.get(variable):
        return Path(os.environ[variable])
    here = Path.cwd()
    return next((p / name for p in (here, *here.parents) if (p / name).is_dir()), here / name)
