"""Gives notebooks their drives and folders of results, and shows sentences and tables."""

import os
import re
import unicodedata
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
from IPython.core.interactiveshell import InteractiveShell
from IPython.display import Markdown, display
from matplotlib.figure import Figure
from matplotlib_inline.backend_inline import set_matplotlib_formats

from slamlib.dataset import Dataset, Truth, dataset_names, read_dataset, read_truth
from slamlib.notebook import inline, plotting
from slamlib.simulation import simulate


@dataclass(frozen=True, eq=False)          # compared by identity, because arrays have no hash
class Drive:
    """A dataset and its truth, which serves figures and tables only."""

    name: str
    dataset: Dataset
    truth: Truth | None
    made_up: bool = False  # True for a simulated drive that replaces datasets without a sensor

    @property
    def origin(self):
        """Origin of the data, a str; only simulations have other true wheel parameters."""
        if self.truth is None:
            return "recorded"
        same = self.truth.vehicle == self.dataset.vehicle
        return "recorded, truth known" if same else "simulated"


def start():
    """List of all drives, the one with the fewest poses first; also sets the style of the figures.

    The environment variable SLAMLIB_DATA names the data folder; by default it is the nearest `data`
    in this folder or above it. SLAMLIB_DATASETS selects datasets by name, one a line.

    Raises
    ------
    DatasetError : a dataset does not follow the format, or there is none.
    """
    plotting.use_style()
    _show_figures()
    data = _folder("SLAMLIB_DATA", "data")
    selected = os.environ.get("SLAMLIB_DATASETS")
    names = dataset_names(data, selected.split("\n") if selected else None)
    drives = [Drive(name, read_dataset(data / name), read_truth(data / name)) for name in names]
    return sorted(drives, key=lambda drive: len(drive.dataset.ticks))


def _show_figures():
    """Show figures as SVG, in the report in two widths, of which its pages choose one."""
    if interactive():
        plt.rcParams["svg.fonttype"] = "path"       # pages bring the typeface
        set_matplotlib_formats("svg", metadata={"Date": None})
    else:
        set_matplotlib_formats()
        InteractiveShell.instance().display_formatter.mimebundle_formatter.for_type(
            Figure, lambda fig, **_: inline.outputs(fig, plotting.svg_pictures(fig)))


def results_folder(drive):
    """Path of the folder for a drive's results.

    It is in SLAMLIB_RESULTS, by default in the folder `results` beside the data folder.
    """
    results = os.environ.get("SLAMLIB_RESULTS")
    folder = Path(results) if results else _folder("SLAMLIB_DATA", "data").parent / "results"
    return folder / drive.name


def with_truth(drives):
    """The drives with truth; errors are shown of these only."""
    return [drive for drive in drives if drive.truth is not None]


def dash_note(drives):
    """Sentence (str) for the caption of a table of errors; empty if all drives have truth."""
    return " A dash stands where no truth is known." if with_truth(drives) != drives else ""


def with_sensor(drives, sensor, name):
    """The drives whose dataset has a sensor, "aruco" or "uwb"; a sentence names the others.

    If no dataset has it, a simulated short drive replaces them, so that the chapter is complete.
    `name` is what the sensor measures, for the sentence.
    """
    without = [drive for drive in drives if getattr(drive.dataset, sensor) is None]
    if len(without) == len(drives):
        say(f"*No dataset has {name}. This chapter runs on a simulated drive instead and writes no "
            "results.*")
        return [simulated_drive(drives)]
    if without:
        names = listed([plain(drive.name) for drive in without])
        say(f"*There are no {name} in {names}: this chapter leaves them out.*")
    return [drive for drive in drives if drive not in without]


def simulated_drive(drives):
    """A simulated short Drive that replaces all drives, with a name that none of them has."""
    name = "simulated"
    while any(drive.name == name for drive in drives):
        name += " instead"
    return Drive(name, *simulate("short", seed=1), made_up=True)


def interactive():
    """True in JupyterLab, False while the report is built."""
    return "SLAMLIB_RESULTS" not in os.environ


def plain(text):
    """Text (str) with the characters escaped that Markdown or HTML would interpret.

    Names from folders and files pass it or `code`. A space replaces a control character.
    """
    return re.sub(r"[^\w\s.,:;/+-]|(?<![^\W_])_|_(?![^\W_])",
                  lambda sign: f"&#{ord(sign[0])};", _seen(text))


def code(text):
    """Text (str), such as a path, as code in Markdown, whatever characters it has."""
    text = _seen(text)
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence} {text} {fence}" if len(fence) > 1 else f"`{text}`"


def _seen(text):
    return "".join(" " if unicodedata.category(sign)[0] == "C" else sign for sign in text)


def listed(names):
    """Names as a str, "a, b and c"."""
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def say(markdown):
    """Show Markdown text, such as a sentence with computed numbers."""
    display(Markdown(markdown))


def captioned(fig, caption):
    """Show a figure and, directly below it, its caption, which may contain computed numbers."""
    display(fig)
    plt.close(fig)  # otherwise it would be shown again at the end of the cell
    say(caption)


def table(header, rows, caption=None, texts=1):
    """Show a table of str and, below it, its caption; parameters as of `table_text`."""
    text = table_text(header, rows, texts)
    say(text + (f"\n\n{caption}" if caption else ""))


def table_text(header, rows, texts=1):
    """Table in Markdown, a str.

    `header` is a list of c str, `rows` a list of such lists, or of one str as a heading of the rows
    below it. The first `texts` columns are aligned left as text, the others right as numbers, with
    minus signs. Of consecutive rows with the same first cell only the first row shows it.
    """
    rows = [row if len(row) > 1 else [*row, *[""] * (len(header) - 1)] for row in rows]
    above = [None, *(row[0] for row in rows)]
    grouped = [["" if row[0] == first else row[0], *row[1:texts],
                *(re.sub(r"(?<![\w.])-(?=\d)", "−", cell) for cell in row[max(1, texts):])]
               for first, row in zip(above, rows, strict=False)]
    lines = [header, ["---"] * texts + ["---:"] * (len(header) - texts), *grouped]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _folder(variable, name):
    if os.environ.get(variable):
        return Path(os.environ[variable])
    here = Path.cwd()
    return next((p / name for p in (here, *here.parents) if (p / name).is_dir()), here / name)
