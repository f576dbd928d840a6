"""The command line, `slamlib` or `python -m slamlib`: its options, commands and exit codes."""

import argparse
import logging
import os
import signal
import sys
from pathlib import Path

# Set before numpy is imported: the matrices are so small that more threads are slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from slamlib.core.errors import DatasetError, require  # noqa: E402

RESULTS = Path("results")  # folder of the .mat files of a build
EXECUTED_NOTEBOOKS = Path("build/executed")  # folder in which executed notebooks are kept
HAND_IN = Path("hand-in.zip")
HAND_IN_PAGES = Path("build/hand-in")  # folder of the report that is handed in


def main(arguments: list[str] | None = None) -> int:
    """Run one command of `arguments`, or of the command line.

    Returns the exit code: 0, 1 if a notebook failed, 2 for invalid input, 3 if a problem could not
    be solved, 130 if ended by a signal.
    """
    if arguments is None:
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr, for names in other letters
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    options = _parser().parse_args(arguments)
    try:
        return options.run(options)
    except DatasetError as error:
        return _ended(2, error)
    except OSError as error:
        return _ended(2, f"expected files that can be read and written, found {error}")
    except KeyboardInterrupt:
        return _ended(130, "ended by a signal")


def _ended(code, reason):
    """The exit code, after the reason was printed."""
    print(f"slamlib: {reason}", file=sys.stderr)
    return code


def _parser():
    """The parser of the command line; `run` of what it parses is the function of the command."""
    whole = argparse.ArgumentParser(
        prog="slamlib", description="Vehicle SLAM from wheel encoders, markers and UWB ranges.")
    commands = whole.add_subparsers(dest="command", required=True)

    def add_command(name, run, help):
        command = commands.add_parser(name, help=help)
        command.set_defaults(run=run)
        return command.add_argument

    for name, help in (("report", "execute the notebooks and build the report"),
                       ("hand-in", "build the report, and zip it with the result files")):
        add = add_command(name, _build, help)
        add("--data", type=Path, default="data", help="folder of the datasets (default data)")
        add("datasets", nargs="*", help="names of folders in it (all of them when none is named, "
            "but simulated ones where there are others)")

    add = add_command("solve", _solve, "solve problems without notebooks")
    add("folders", nargs="+", type=Path, help="a dataset's folder; each of several has its results "
        "in the folder of its name in OUT, and drives.csv is the table over all")
    add("--out", type=Path, required=True, help="folder for the results")
    add("-j", "--jobs", type=int, help="datasets solved at a time (default 1)")
    add("--problem", action="append", default=[],
        choices="1 2 2_hint 2_fused 3 4".split(),
        help="one of %(choices)s, of which 2 is markers alone; may be repeated (default: all); 4 "
        "starts from 3 where both are solved")
    add("-v", "--verbose", action="store_true", help="print to stderr what is decided on the way: "
        "kernels, noise, accepted measurements, calibration, and GTSAM's solution")
    return whole


def _build(options):
    """Build the report, and the zip to hand in where that is the command."""
    from slamlib.report import handin
    from slamlib.report.build import build_report
    from slamlib.report.notebooks import NotebookError, notebooks_folder, read_options
    shown = read_options(Path("report.toml"))
    pages = Path("report")
    if options.command == "hand-in":
        shown = handin.hand_in_options(shown)
        pages = HAND_IN_PAGES
    require(options.data.resolve() != RESULTS.resolve(), options.data,
            "another folder of the datasets: this one is for the results")
    try:
        report = build_report(notebooks_folder(), options.data, pages, RESULTS,
                              EXECUTED_NOTEBOOKS, options.datasets, shown)
    except NotebookError as error:
        return _ended(1, error)
    code = _told(report.summaries)
    if options.command == "hand-in":
        handin.write_zip(HAND_IN, report, RESULTS, shown)
        print(f"hand-in: {HAND_IN.resolve()}", file=sys.stderr)
    else:
        print(f"report: {report.files[0]} and {report.files[-1]}", file=sys.stderr)
    return code


def _told(summaries):
    """The exit code by the summaries of drives, after printing a table, what failed and doubts."""
    from slamlib.solve import drives_table
    table = drives_table(summaries).drop(columns="failed")      # whose sentences are printed below
    known = table.dropna(axis="columns", how="all")
    print(known.to_string(index=False, na_rep="-", float_format="{:.4g}".format))
    code = 0
    for summary in summaries:
        name = summary["dataset"]
        for problem, row in summary["problems"].items():
            if "failed" in row:
                print(f"{name}: {problem} could not be solved: {row['failed']}")
                code = 3
        for doubt in summary["doubts"]:
            print(f"{name}: doubt ({doubt['what']}): {doubt['sentence']} {doubt['advice']}")
    for summary in summaries:
        if "error" in summary:
            code = _ended(2, summary["error"])
    return code


def _solve(options):
    """Solve the problems of one dataset or several, and print a table of each."""
    from slamlib.solve import solve_folder, solve_folders
    problems = [f"problem{each}" for each in options.problem]
    if options.verbose:
        logging.basicConfig(format="%(message)s", level="INFO")
    first, *others = options.folders
    if others:
        summaries = solve_folders(options.folders, options.out, options.jobs, problems)
    else:
        summaries = [solve_folder(first, options.out, problems)]
    code = _told(summaries)
    print(f"results: {options.out.resolve()}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
