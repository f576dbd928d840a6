"""The command line: slamlib {report, solve, simulate, export}, or python -m slamlib."""

import argparse
import os
import signal
import sys
import threading
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

# Set before numpy is imported: the matrices are so small that more threads are slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from slamlib.dataset import (  # noqa: E402
    DatasetError,
    dataset_names,
    read_dataset,
    read_truth,
)


def main(arguments=None):
    """Run one command of `arguments` (list of str, or None for the command line's).

    Returns the exit code: 0, 1 if a notebook failed, 2 for invalid input, 3 if a problem could not
    be solved, 128 + n if ended by signal n.
    """
    options = _parser().parse_args(arguments)
    ended = [signal.SIGINT]
    try:
        with _orderly_end(ended):
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


@contextmanager
def _orderly_end(ended):
    """Let SIGTERM and SIGHUP end a run as Ctrl-C does, and add the signal to the list `ended`."""
    def end(number, frame):
        for each in before:
            signal.signal(each, signal.SIG_IGN)
        ended.append(signal.Signals(number))
        interrupt = signal.getsignal(signal.SIGINT)  # the event loop's, while notebooks run
        (interrupt if callable(interrupt) else signal.default_int_handler)(signal.SIGINT, frame)

    before = {}
    if threading.current_thread() is threading.main_thread():
        before = {each: signal.getsignal(each) for each in (signal.SIGTERM, signal.SIGHUP)
                  if signal.getsignal(each) == signal.SIG_DFL}  # nohup's stays
    for each in before:
        signal.signal(each, end)
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        """End with exit code 2 and one sentence, without argparse's usage."""
        told = " ".join(message.split())
        self.exit(2, f"slamlib: {told} ({self.prog} --help shows the usage)\n")


def _parser():
    prog = Path(sys.argv[0]).name
    parser = _Parser(prog=prog if prog == "slamlib" else "python -m slamlib", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="{report,solve,simulate,export}")

    _report_options(commands.add_parser(
        "report", help="execute the notebooks and build the report"))

    solve = commands.add_parser("solve", help="solve a dataset's problems without notebooks")
    solve.add_argument("folder", type=Path, metavar="FOLDER", help="the dataset's folder")
    solve.add_argument("--out", type=Path, required=True, help="folder for the results")
    solve.set_defaults(run=_solve)

    simulate = commands.add_parser("simulate", help="make a dataset with its truth")
    simulate.add_argument("folder", type=Path, metavar="FOLDER", help="a new or empty folder")
    simulate.add_argument("--path", choices=("short", "long"), default="short")
    simulate.add_argument("--rounds", type=_positive, default=1,
                          help="how often the path is driven; 44 long ones are a million rows")
    simulate.add_argument("--seed", type=_count, default=0)
    simulate.add_argument("--slip", type=_share, default=1e-3, metavar="SQRT_M",
                          help="wheel slip: sigma after one metre, in m (default %(default)s)")
    simulate.add_argument("--nlos", type=_share, default=0.0, metavar="SHARE",
                          help="share of UWB ranges without line of sight, which are too long")
    simulate.add_argument("--mislabel", type=_share, default=0.0, metavar="SHARE",
                          help="share of marker sightings that carry another marker's id")
    simulate.set_defaults(run=_simulate)

    export = commands.add_parser("export", help="write trajectories as TUM files or CSV")
    export.add_argument("results", type=Path, metavar="RESULTS", help="a folder of results, of one "
                        "problem's results, or the folder truth of a dataset")
    export.add_argument("--format", choices=("tum", "csv"), default="tum",
                        help="tum has pose numbers as time stamps; csv has covariances, too")
    export.add_argument("--out", type=Path, required=True, help="folder for the files")
    export.set_defaults(run=_export)
    return parser


def _report_options(report):
    """Add the options of `report` to its parser."""
    report.add_argument("datasets", nargs="*", metavar="DATASET",
                        help="names of folders in data/ (all of them when none is named)")
    report.add_argument("--data", type=Path, default=Path("data"), help="folder of the datasets")
    report.add_argument("--notebooks", type=Path, help="folder of the notebooks (default: the "
                        "folder notebooks where there is one, else those of the installation)")
    report.add_argument("--notebooks-to", type=Path, metavar="FOLDER",
                        help="copy the notebooks to this new or empty folder first, to edit them "
                        "there, and build the report from it")
    report.add_argument("--report", type=Path, default=Path("report"), help="folder for the pages")
    report.add_argument("--results", type=Path, default=Path("results"),
                        help="folder for the .mat files")
    report.add_argument("--jobs", type=_positive, default=2, help="notebooks executed at a time")
    code = report.add_mutually_exclusive_group()
    code.add_argument("--no-code", dest="code", action="store_const", const="none",
                      default="method", help="leave out code cells and printed text")
    code.add_argument("--all-code", dest="code", action="store_const", const="all",
                      help="show the code that plots, prints and tabulates, too")
    report.add_argument("--no-appendix", dest="appendix", action="store_false",
                        help="leave out the notebooks whose title begins with a letter")
    report.add_argument("--author", help="on the PDF's title page, instead of report.toml's")
    report.add_argument("--student-number", help="the same")
    report.add_argument("--fresh", action="store_true",
                        help="execute all notebooks and studies, also where nothing changed")
    report.set_defaults(run=_report)


def _report(options):
    from slamlib.report import NotebookError, build_report
    from slamlib.report.cover import read_cover
    from slamlib.report.sources import copy_notebooks, notebooks_folder
    cover = read_cover("report.toml")
    given = {"author": options.author, "student_number": options.student_number}
    cover = replace(cover, **{key: value for key, value in given.items() if value is not None})
    names = [_name(dataset, options.data) for dataset in options.datasets] or None
    notebooks = options.notebooks or notebooks_folder()
    if options.notebooks_to:
        dataset_names(options.data, names)                 # nothing is copied if there are none
        notebooks = copy_notebooks(notebooks, options.notebooks_to)
    try:
        report = build_report(
            notebooks, options.data, options.report, options.results,
            datasets=names, jobs=options.jobs, cover=cover, code=options.code,
            kept=Path("build", "executed"), fresh=options.fresh, appendix=options.appendix)
    except NotebookError as error:
        print(f"slamlib: {error}", file=sys.stderr)
        return 1
    if not cover.author:
        print("report.toml names no author: the PDF's title page has none", file=sys.stderr)
    for drive in report.drives:
        for doubt in drive.doubts:
            print(f"{drive.name}: doubt ({doubt.what}): {doubt.sentence}", file=sys.stderr)
    print(f"report: {report.files[0]} and {report.files[-1]}", file=sys.stderr)
    return _exit_code((drive.name, failure.problem, failure.reason)
                      for drive in report.drives for failure in drive.failures)


def _exit_code(failures):
    """Print the (dataset, problem, reason) of what could not be solved; 3 if there is any, or 0."""
    code = 0
    for dataset, problem, reason in failures:
        print(f"slamlib: {dataset}: {problem} could not be solved: {reason}", file=sys.stderr)
        code = 3
    return code


def _name(dataset, data):
    """Return the name of a dataset, given by its name or by the path of its folder in `data`."""
    path = Path(dataset)
    return path.name if path.resolve().parent == data.resolve() else dataset


def _solve(options):
    from slamlib.summary import solve_to_folder
    summary = solve_to_folder(
        read_dataset(options.folder), read_truth(options.folder), options.out, jobs=2)
    print(_table(summary))
    return _exit_code((summary["dataset"], name, row["failed"])
                      for name, row in summary["problems"].items() if "failed" in row)


def _table(summary):
    """Return the summary as a table, one line for each problem, and below it the doubts."""
    lines = [f"{summary['dataset']}: {summary['poses']} poses",
             f"{'problem':15}{'estimates':>10}{'last x, y, heading':>29}"
             f"{'their sigmas':>27}{'ATE':>11}"]
    for name, row in summary["problems"].items():
        if "failed" in row:
            lines.append(f"{name:15}could not be solved")
            continue
        pose = "{:8.3f} m {:8.3f} m {:7.4f}".format(*row["last_pose"])
        sigma = "{:7.4f} m {:7.4f} m {:6.4f}".format(*row["last_sigma"])
        error = f"{row['ate_m']:9.4f} m" if "ate_m" in row else "no truth"
        lines.append(f"{name:15}{row['estimated_poses']:10}{pose:>29}{sigma:>27}{error:>11}")
    lines += [f"doubt ({doubt['what']}): {doubt['sentence']}" for doubt in summary["doubts"]]
    return "\n".join(lines)


def _simulate(options):
    from slamlib.simulation import simulate, write_dataset
    dataset, truth = simulate(options.path, options.seed, slip=options.slip,
                              late_ranges=options.nlos, mislabelled=options.mislabel,
                              rounds=options.rounds)
    write_dataset(options.folder, dataset, truth)
    return 0


def _export(options):
    from slamlib.export import export
    for path in export(options.results, options.format, options.out):
        print(path)
    return 0


def _count(text):
    return _number(text, int, 0, float("inf"), "a whole number from 0 on")


def _positive(text):
    return _number(text, int, 1, float("inf"), "a whole number from 1 on")


def _share(text):
    return _number(text, float, 0, 1, "a number from 0 to 1")


def _number(text, kind, least, most, expected):
    try:
        value = kind(text)
    except ValueError:
        value = float("nan")
    if not least <= value <= most:
        raise argparse.ArgumentTypeError(f"expected {expected}, found {text[:60]!r}")
    return value


if __name__ == "__main__":
    sys.exit(main())
