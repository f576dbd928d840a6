"""Defines the options of the command line."""

import argparse
import sys
from pathlib import Path

from slamlib import __version__
from slamlib.vehicle import VEHICLE_LIMITS

KNOWN_NOISE = ("slip", "marker_noise_factor", "range_noise_factor")  # options as in vehicle.toml


def _number(kind, low, high, expected):
    """A function that converts text to an int or float in [low, high], for `add_argument`."""
    def converted(text):
        try:
            value = kind(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected {expected}, found {text[:60]!r}")
        return value
    return converted


_count = _number(int, 0, float("inf"), "a whole number from 0 on")
_positive = _number(int, 1, float("inf"), "a whole number from 1 on")
_share = _number(float, 0, 1, "a number from 0 to 1")


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        """End with exit code 2 and one sentence, without argparse's usage."""
        self.exit(2, f"slamlib: {' '.join(message.split())} ({self.prog} --help shows the usage)\n")

    def path(self, name, help=None, **options):
        """Add an argument that is a Path."""
        self.add_argument(name, type=Path, help=help, **options)


def command_line_parser():
    """The ArgumentParser of the command line; `command` of what it parses is the command's name."""
    prog = Path(sys.argv[0]).name
    whole = _Parser(prog=prog if prog == "slamlib" else "python -m slamlib",
                    description="Vehicle SLAM from wheel encoders, markers and UWB ranges.")
    whole.add_argument("--version", action="version", version=f"slamlib {__version__}")
    commands = whole.add_subparsers(dest="command", required=True)
    report = commands.add_parser("report", help="execute the notebooks and build the report")
    report.path("--report", "folder for the pages", default=Path("report"))
    _build_options(report)
    hand_in = commands.add_parser(
        "hand-in", help="build the report and put it into a zip, with the result files")
    hand_in.path("--out", "the file to write (default %(default)s)", default=Path("hand-in.zip"))
    _build_options(hand_in)
    _solve_options(commands.add_parser("solve", help="solve problems without notebooks"))
    _simulate_options(commands.add_parser("simulate", help="make a dataset with its truth"))
    export = commands.add_parser("export", help="write results as TUM files or CSV")
    export.path("results", "a folder of results, of one problem's results, or the folder truth of "
                "a dataset", metavar="RESULTS")
    export.add_argument("--format", choices=("tum", "csv"), default="tum", help="tum: trajectories "
                        "with pose numbers as time stamps; csv: all files, with covariances")
    export.path("--out", "folder for the files", required=True)
    lab = commands.add_parser("lab", help="open JupyterLab on the notebooks; it is given all other "
                                          "arguments, as --no-browser", allow_abbrev=False)
    lab.path("--data", "folder of the datasets", default=Path("data"))
    lab.path("--notebooks")
    return whole


def _solve_options(parser):
    """Add the options of `solve` to its parser."""
    parser.path("folder", "the dataset's folder", metavar="FOLDER")
    parser.path("--out", "folder for the results", required=True)
    parser.add_argument("--problem", action="append", metavar="NAME", help="1, 2 (markers alone), "
                        "2_hint, 2_fused, 3 or 4; may be repeated (default: all); 4 starts from 3 "
                        "where both are solved")
    parser.add_argument("--kernel", metavar="NAME", help="the robust kernel of problems 3 and 4, "
                        "as Huber")
    for name in KNOWN_NOISE:
        limit = VEHICLE_LIMITS[name]
        number = _number(float, limit.minimum, limit.maximum, f"a number {limit}")
        parser.add_argument(f"--{name.replace('_', '-')}", type=number, metavar="NUMBER",
                            help="known, and not learned; as in vehicle.toml")
    parser.path("--plot", "write a picture of map and errors: a .png, .pdf or .svg file",
                metavar="FILE")
    parser.add_argument("--csv", action="store_true", help="write each .mat file as CSV, too")


def _simulate_options(parser):
    """Add the options of `simulate` to its parser."""
    parser.path("folder", "a new or empty folder", metavar="FOLDER")
    parser.add_argument("--path", choices=("short", "long"), default="short")
    parser.add_argument("--rounds", type=_positive, default=1,
                        help="how often the path is driven; 44 long ones are a million rows")
    parser.add_argument("--seed", type=_count, default=0)
    parser.add_argument("--slip", type=_share, default=1e-3, metavar="SQRT_M",
                        help="wheel slip: sigma after one metre, in m (default %(default)s)")
    parser.add_argument("--nlos", type=_share, default=0.0, metavar="SHARE",
                        help="share of UWB ranges without line of sight, which are too long")
    parser.add_argument("--mislabel", type=_share, default=0.0, metavar="SHARE",
                        help="share of marker sightings that carry another marker's id")


def _build_options(parser):
    """Add the options of `report` and `hand-in` to a parser."""
    parser.add_argument("datasets", nargs="*", metavar="DATASET",
                        help="names of folders in data/ (all of them when none is named)")
    parser.path("--data", "folder of the datasets", default=Path("data"))
    parser.path("--notebooks", "folder of the notebooks (default: the folder notebooks where "
                "there is one, else those of the installation)")
    parser.path("--notebooks-to", "copy the notebooks to this new or empty folder first, to edit "
                "them there, and build the report from it", metavar="FOLDER")
    parser.path("--results", "folder for the .mat files", default=Path("results"))
    parser.add_argument("--jobs", type=_positive, default=2, help="notebooks executed at a time")
    code = parser.add_mutually_exclusive_group()
    code.add_argument("--no-code", dest="code", action="store_const", const="none",
                      help="leave out code cells and printed text")
    code.add_argument("--all-code", dest="code", action="store_const", const="all",
                      help="show the code that plots, prints and tabulates, too")
    parser.add_argument("--appendix", action=argparse.BooleanOptionalAction,
                        help="show the notebooks whose title begins with a letter, or leave them "
                             "out (the report has them, the hand-in has not)")
    parser.add_argument("--author", help="on the PDF's title page, instead of report.toml's")
    parser.add_argument("--student-number", help="the same")
    parser.add_argument("--fresh", action="store_true",
                        help="execute all notebooks and studies, also where nothing changed")
