"""The command line, `slamlib` or `python -m slamlib`: its options, commands and exit codes."""

import argparse
import os
import signal
import sys
import textwrap
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

# Set before numpy is imported: the matrices are so small that more threads are slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from slamlib import __version__  # noqa: E402
from slamlib.dataset import DatasetError, read_dataset, read_truth  # noqa: E402
from slamlib.vehicle import changed  # noqa: E402

EXECUTED_NOTEBOOKS = Path("build", "executed")  # folder in which executed notebooks are kept
# Options of `solve` that replace entries of vehicle.toml.
VEHICLE_OPTIONS = {"kernel": str, "slip": float, "marker_noise_factor": float,
                   "range_noise_factor": float}
# Signals that end a process; Windows has no SIGHUP.
END_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP")
                    if hasattr(signal, name))


def main(arguments=None):
    """Run one command of `arguments` (list of str, or None for the command line's).

    Returns the exit code: 0, 1 if a notebook failed, 2 for invalid input, 3 if a problem could not
    be solved, 128 + n if ended by signal n.
    """
    ended = [signal.SIGINT]
    if arguments is None:
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr, for names in other letters
        _end_as_by_ctrl_c(ended)
    parser = _parser()
    options, options_of_lab = parser.parse_known_args(arguments)
    if options_of_lab and options.run is not _lab:
        parser.error(f"unrecognized arguments: {' '.join(options_of_lab)}")
    options.others = options_of_lab
    try:
        return options.run(options)
    except DatasetError as error:
        print(f"slamlib: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        reason = f"{error.filename}: {error.strerror}" if error.filename else error
        print(f"slamlib: cannot be read or written: {reason}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        with suppress(OSError):  # the terminal may be gone
            print(f"slamlib: ended by {ended[-1].name}", file=sys.stderr)
        return 128 + ended[-1]


def _end_as_by_ctrl_c(ended):
    """Let END_SIGNALS end this process as Ctrl-C does; the list `ended` gets the one that came."""
    def end(number, frame):
        ended.append(signal.Signals(number))
        for each in END_SIGNALS:
            signal.signal(each, signal.SIG_IGN)
        interrupt = signal.getsignal(signal.SIGINT)  # the event loop's, while notebooks run
        (interrupt if callable(interrupt) else signal.default_int_handler)(signal.SIGINT, frame)

    for each in END_SIGNALS:
        if signal.getsignal(each) == signal.SIG_DFL:     # nohup's handler stays
            signal.signal(each, end)


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        """End with exit code 2 and one sentence, without argparse's usage."""
        self.exit(2, f"slamlib: {textwrap.shorten(message, 200, placeholder=' ...')} "
                     f"({self.prog} --help shows the usage)\n")

    def path(self, name, help=None, **options):
        """Add an argument that is a Path."""
        self.add_argument(name, type=Path, help=help, **options)


def _parser():
    """The parser of the command line; `run` of what it parses is the function of the command."""
    prog = Path(sys.argv[0]).name
    whole = _Parser(prog=prog if prog == "slamlib" else "python -m slamlib",
                    description="Vehicle SLAM from wheel encoders, markers and UWB ranges.")
    whole.add_argument("--version", action="version", version=f"slamlib {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND")

    def command(name, run, help, **options):
        parser = commands.add_parser(name, help=help, **options)
        parser.set_defaults(run=run)
        return parser

    report = command("report", _report, "execute the notebooks and build the report")
    report.path("--report", "folder for the pages", default=Path("report"))
    _build_options(report)
    hand_in = command("hand-in", _hand_in,
                      "build the report and put it into a zip, with the result files")
    hand_in.path("--out", "the file to write (default %(default)s)", default=Path("hand-in.zip"))
    _build_options(hand_in)
    _solve_options(command("solve", _solve, "solve problems without notebooks"))
    _simulate_options(command("simulate", _simulate, "make a dataset with its truth"))
    export = command("export", _export, "write results as TUM files or CSV")
    export.path("results", "a folder of results, of one problem's results, or the folder truth of "
                "a dataset", metavar="RESULTS")
    export.add_argument("--format", choices=("tum", "csv"), default="tum", help="tum: trajectories "
                        "with pose numbers as time stamps; csv: all files, with covariances")
    export.path("--out", "folder for the files", required=True)
    lab = command("lab", _lab, "open JupyterLab on the notebooks; it is given all other arguments, "
                  "as --no-browser", allow_abbrev=False)
    lab.path("--data", "folder of the datasets", default=Path("data"))
    lab.path("--notebooks")
    return whole


def _build_options(parser):
    """Add the options of `report` and `hand-in` to a parser."""
    parser.add_argument("datasets", nargs="*", metavar="DATASET",
                        help="names of folders in data/ (all of them when none is named)")
    parser.path("--data", "folder of the datasets", default=Path("data"))
    parser.path("--notebooks", "folder of the notebooks (default: the folder notebooks where "
                "there is one, else those of the installation)")
    parser.path("--results", "folder for the .mat files", default=Path("results"))
    parser.add_argument("--jobs", type=int, default=2, help="notebooks executed at a time")
    parser.add_argument("--code", choices=("none", "method", "all"), help="the code that is shown, "
                        "as in report.toml")
    parser.add_argument("--appendix", action=argparse.BooleanOptionalAction,
                        help="show the notebooks whose title begins with a letter, or leave them "
                             "out (the report has them, the hand-in has not)")
    parser.add_argument("--fresh", action="store_true",
                        help="execute all notebooks and studies, also where nothing changed")


def _solve_options(parser):
    """Add the options of `solve` to its parser."""
    parser.path("folder", "the dataset's folder", metavar="FOLDER")
    parser.path("--out", "folder for the results", required=True)
    parser.add_argument("--problem", action="append", default=[], metavar="NAME",
                        type=lambda text: text.removeprefix("problem"),
                        choices=("1", "2", "2_hint", "2_fused", "3", "4"),
                        help="one of %(choices)s, of which 2 is markers alone; may be repeated "
                             "(default: all); 4 starts from 3 where both are solved")
    for name, kind in VEHICLE_OPTIONS.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, metavar=kind.__name__.upper(),
                            help="instead of that of vehicle.toml")
    parser.path("--plot", "write a picture of map and errors: a .png, .pdf or .svg file",
                metavar="FILE")
    parser.add_argument("--csv", action="store_true", help="write each .mat file as CSV, too")


def _simulate_options(parser):
    """Add the options of `simulate` to its parser."""
    parser.path("folder", "a new or empty folder", metavar="FOLDER")
    parser.add_argument("--path", choices=("short", "long"), default="short")
    parser.add_argument("--rounds", type=int, default=1,
                        help="how often the path is driven; 44 long ones are a million rows")
    parser.add_argument("--seed", type=int, default=0)
    for name, default, help in (
            ("slip", 1e-3, "wheel slip: sigma after one metre, in m (default %(default)s)"),
            ("nlos", 0.0, "share of UWB ranges without line of sight, which are too long"),
            ("mislabel", 0.0, "share of marker sightings that carry another marker's id")):
        parser.add_argument(f"--{name}", type=float, default=default, metavar="NUMBER",
                            help=help)


def _given(options, *names):
    """Options of the command line (dict by name) that were given."""
    return {name: value for name in names if (value := getattr(options, name)) is not None}


def _report(options):
    return _build(options, _shown(options), options.report, _selected_datasets(options),
                  lambda report: f"report: {report.files[0]} and {report.files[-1]}")


def _hand_in(options):
    from slamlib.report import handin
    if options.out.is_dir():
        raise DatasetError(f"{options.out}: expected the name of a file to write, found a folder")
    shown = handin.hand_in_options(_shown(options))
    datasets, omitted = handin.selection(options.data, _selected_datasets(options))

    def finish(report):
        handin.write_zip(options.out, report, options.results, shown, omitted)
        return f"hand-in: {options.out.resolve()}"
    return _build(options, shown, Path("build", "hand-in"), datasets, finish)


def _shown(options):
    """The Options of report.toml; those of the command line replace them."""
    from slamlib.report.notebooks import read_options
    return replace(read_options("report.toml"), **_given(options, "code", "appendix"))


def _build(options, shown, folder, datasets, finish):
    """Build a Report into a folder and print doubts and finish(Report); return the exit code."""
    from slamlib.report import NotebookError, build_report
    from slamlib.report.notebooks import notebooks_folder
    notebooks = options.notebooks or notebooks_folder()
    for out in (folder, options.results):
        _require_elsewhere(out, options.data, notebooks)
    try:
        report = build_report(
            notebooks, options.data, folder, options.results, datasets=datasets, options=shown,
            jobs=options.jobs, kept=EXECUTED_NOTEBOOKS, fresh=options.fresh)
    except NotebookError as error:
        print(f"slamlib: {error}", file=sys.stderr)
        return 1
    if not shown.author:
        print("report.toml names no author: the PDF's title page has none", file=sys.stderr)
    for drive in report.drives:
        for doubt in drive.doubts:
            print(f"{drive.name}: doubt ({doubt.what}): {doubt.sentence}", file=sys.stderr)
    print(finish(report), file=sys.stderr)
    return _exit_code([(drive.name, failure.problem, failure.reason)
                       for drive in report.drives for failure in drive.failures])


def _exit_code(failures):
    """Print each (dataset, problem, reason) not solved; return 3 if there are any, or 0."""
    for dataset, problem, reason in failures:
        print(f"slamlib: {dataset}: {problem} could not be solved: {reason}", file=sys.stderr)
    return 3 if failures else 0


def _selected_datasets(options):
    """Names (list of str) of the datasets, given by names or paths of folders in data/, or None."""
    return [Path(each).name if Path(each).resolve().parent == options.data.resolve() else each
            for each in options.datasets] or None


def _require_elsewhere(out, *folders):
    """Raise DatasetError if a folder that a run replaces is or holds the current one or others."""
    for folder in map(Path.resolve, (Path(), *folders)):
        if folder.is_relative_to(out.resolve()):
            raise DatasetError(f"{out}: expected another folder to write to: this one, which is "
                               f"replaced, is or holds {folder}")


def _solve(options):
    from slamlib.dataset import inventory_lines
    from slamlib.solve import PROBLEMS, allows, title
    from slamlib.summary import solve_to_folder, summary_table
    _require_elsewhere(options.out, options.folder)
    if options.plot and options.plot.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise DatasetError(f"{options.plot}: expected a picture .png, .pdf or .svg")
    dataset, truth = read_dataset(options.folder), read_truth(options.folder)
    dataset = replace(dataset, vehicle=changed(
        dataset.vehicle, _given(options, *VEHICLE_OPTIONS), "slamlib solve"))
    problems = sorted(f"problem{each}" for each in options.problem) or [*PROBLEMS]
    for each in problems if options.problem else ():
        if not allows(dataset, each):
            raise DatasetError(f"{options.folder}: expected the measurements of {each} "
                               f"({title(each, dataset)}), found none")
    print("\n".join(inventory_lines(dataset, truth)), file=sys.stderr)
    summary = solve_to_folder(dataset, truth, options.out, problems, options.csv)
    print(summary_table(summary))
    if options.plot and any("failed" not in row for row in summary["problems"].values()):
        from slamlib.report.overview import result_picture
        result_picture(dataset, truth, options.out, options.plot)
    return _exit_code([(summary["dataset"], name, row["failed"])
                       for name, row in summary["problems"].items() if "failed" in row])


def _simulate(options):
    from slamlib.simulation import simulate, write_dataset
    write_dataset(options.folder, *simulate(
        options.path, options.seed, slip=options.slip, late_ranges=options.nlos,
        mislabelled=options.mislabel, rounds=options.rounds))
    return 0


def _lab(options):
    from slamlib.report.execution import start_lab
    from slamlib.report.notebooks import notebooks_folder
    start_lab(options.notebooks or notebooks_folder(), options.data, EXECUTED_NOTEBOOKS,
              options.others)


def _export(options):
    from slamlib.export import export_results
    for path in export_results(options.results, options.format, options.out):
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
