"""The command line, `slamlib` or `python -m slamlib`: its options, commands and exit codes."""

import argparse
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path

# Set before numpy is imported: the matrices are so small that more threads are slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from slamlib import __version__  # noqa: E402
from slamlib.core.errors import DatasetError, require  # noqa: E402

EXECUTED_NOTEBOOKS = Path("build", "executed")  # folder in which executed notebooks are kept
HAND_IN_PAGES = Path("build", "hand-in")  # folder of the report that is handed in
END_SIGNALS = {signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}  # Windows has no SIGHUP


def main(arguments: list[str] | None = None) -> int:
    """Run one command of `arguments`, or of the command line.

    Returns the exit code: 0, 1 if a notebook failed, 2 for invalid input, 3 if a problem could not
    be solved, 130 if ended by a signal.
    """
    if arguments is None:
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr, for names in other letters
        for each in END_SIGNALS:
            if signal.getsignal(each) == signal.SIG_DFL:     # nohup's handler stays
                signal.signal(each, signal.default_int_handler)      # as by Ctrl-C
    parser = _parser()
    options, others = parser.parse_known_args(arguments)
    options.others = others
    if others and options.run is not _lab:
        parser.error(f"unrecognized arguments: {' '.join(others)}")
    try:
        return options.run(options)
    except DatasetError as error:
        return _ended(2, error)
    except OSError as error:
        return _ended(2, f"cannot be read or written: {error}")
    except KeyboardInterrupt:
        return _ended(130, "ended by a signal")


def _ended(code, reason):
    """The exit code, after the reason was printed."""
    with suppress(OSError):  # the terminal may be gone
        print(f"slamlib: {reason}", file=sys.stderr)
    return code


def _parser():
    """The parser of the command line; `run` of what it parses is the function of the command."""
    whole = argparse.ArgumentParser(
        prog="slamlib", description="Vehicle SLAM from wheel encoders, markers and UWB ranges.")
    whole.add_argument("--version", action="version", version=f"slamlib {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND")

    report = commands.add_parser("report", help="execute the notebooks and build the report")
    report.set_defaults(run=_build, out=None)
    _add_options_of_a_build(report)
    _add_path(report, "--report", "folder for the pages", "report")

    hand_in = commands.add_parser(
        "hand-in", help="build the report, and zip it with the result files")
    hand_in.set_defaults(run=_build, report=HAND_IN_PAGES)
    _add_options_of_a_build(hand_in)
    _add_path(hand_in, "--out", "the file to write", "hand-in.zip")

    _add_solve(commands)
    _add_simulate(commands)
    lab = commands.add_parser("lab", allow_abbrev=False, help="open JupyterLab on the notebooks; "
                              "it is given all other arguments, as --no-browser")
    lab.set_defaults(run=_lab)
    _add_data_and_notebooks(lab)
    return whole


def _add_path(command, name, help, default=None):
    if default is not None:
        help += " (default %(default)s)"
    command.add_argument(name, type=Path, default=default, help=help)


def _add_data_and_notebooks(command):
    _add_path(command, "--data", "folder of the datasets", "data")
    _add_path(command, "--notebooks", "folder of the notebooks (default: the folder notebooks "
              "where there is one, else those of the installation)")


def _add_options_of_a_build(command):
    _add_data_and_notebooks(command)
    _add_path(command, "--results", "folder for the .mat files", "results")
    add = command.add_argument
    add("datasets", nargs="*", metavar="DATASET",
        help="names of folders in data/ (all of them when none is named, but simulated ones where "
        "there are others)")
    add("--jobs", type=int, default=2, help="notebooks executed at a time")


def _add_solve(commands):
    command = commands.add_parser("solve", help="solve problems without notebooks")
    command.set_defaults(run=_solve)
    add = command.add_argument
    add("folders", nargs="+", type=Path, metavar="FOLDER", help="a dataset's folder; each of "
        "several has its results in the folder of its name in OUT, and drives.csv is the table "
        "over all")
    add("--out", type=Path, required=True, help="folder for the results")
    add("-j", "--jobs", type=int, default=1, help="datasets solved at a time (default 1); of a "
        "single one, problems 3 and 4 beside the others")
    add("--problem", action="append", default=[], metavar="NAME",
        type=lambda text: text.removeprefix("problem"),
        choices=("1", "2", "2_hint", "2_fused", "3", "4"),
        help="one of %(choices)s, of which 2 is markers alone; may be repeated (default: all); 4 "
             "starts from 3 where both are solved")
    add("--csv", action="store_true", help="write poses and maps as text, too: CSV with "
        "covariances, and trajectories as TUM files for evo")
    add("-v", "--verbose", action="store_true", help="print to stderr what is decided on the way: "
        "kernels, noise, accepted measurements, calibration, and GTSAM's solution")


def _add_simulate(commands):
    command = commands.add_parser("simulate", help="make a dataset with its truth")
    command.set_defaults(run=_simulate)
    _add_path(command, "folder", "a new or empty folder")
    add = command.add_argument
    add("--path", choices=("short", "long"), default="short")
    for name, default, what in (
            ("rounds", 1, "how often the path is driven; 44 long ones are a million rows"),
            ("seed", 0, "of the random generator"),
            ("slip", 1e-3, "wheel slip: sigma after one metre, in m"),
            ("nlos", 0.0, "share of UWB ranges without line of sight, which are too long"),
            ("mislabel", 0.0, "share of marker sightings that carry another marker's id")):
        add(f"--{name}", type=type(default), default=default, help=f"{what} (default %(default)s)")


def _build(options):
    """Build the report, and write the zip to hand in where `out` is given."""
    from slamlib.report import NotebookError, build_report, handin
    from slamlib.report.notebooks import notebooks_folder, read_options
    shown = read_options("report.toml")
    notebooks = options.notebooks or notebooks_folder()
    for other in (options.data, options.report):
        require(options.results.resolve() != other.resolve(), options.results,
                "another folder for the results: this one is for the datasets or the pages")
    datasets = [_name_in(options.data, each) for each in options.datasets] or None
    if options.out:
        require(not options.out.is_dir(), options.out, "a file to write, found a folder")
        shown = handin.hand_in_options(shown)
    try:
        report = build_report(
            notebooks, options.data, options.report, options.results, datasets=datasets,
            options=shown, jobs=options.jobs, kept=EXECUTED_NOTEBOOKS)
    except NotebookError as error:
        return _ended(1, error)
    if not shown.author:
        print("report.toml names no author: the PDF's title page has none", file=sys.stderr)
    print("\n".join(summary_lines(report.summaries)), file=sys.stderr)
    if options.out:
        handin.write_zip(options.out, report, options.results, shown)
        print(f"hand-in: {options.out.resolve()}", file=sys.stderr)
    else:
        print(f"report: {report.files[0]} and {report.files[-1]}", file=sys.stderr)
    return _code_of(report.summaries)


def _code_of(summaries):
    """The exit code by the summaries of drives: 3 if a problem failed, else 0."""
    failed = ["failed" in row for summary in summaries for row in summary["problems"].values()]
    return 3 if any(failed) else 0


def _name_in(data, dataset):
    """The name of a dataset (str), which may be given as its path in the folder `data`."""
    path = Path(dataset)
    return path.name if path.resolve().parent == data.resolve() else dataset


def summary_lines(summaries: list[dict]) -> list[str]:
    """The summaries of drives as lines: a table, then what failed or is in doubt."""
    from slamlib.solve import drive_table
    table = drive_table(summaries).drop(columns=["seconds", "failed"]).dropna(axis=1, how="all")
    lines = table.to_string(index=False, na_rep="-", float_format="{:.4g}".format).splitlines()
    for summary in summaries:
        told = []
        for problem, row in summary["problems"].items():
            if "failed" in row:
                told.append(f"{problem} could not be solved: {row['failed']}")
        told += [f"doubt ({doubt['what']}): {doubt['sentence']}" for doubt in summary["doubts"]]
        lines += [f"{summary['dataset']}: {each}" for each in told]
    return lines


def _solve(options):
    """Solve the problems of one dataset or several, and print a table of each."""
    from slamlib.solve import solve_folder, solve_folders
    how = {"problems": [f"problem{each}" for each in options.problem],
           "text": options.csv, "verbose": options.verbose}
    if len(options.folders) > 1:
        summaries = solve_folders(options.folders, options.out, options.jobs, **how)
    else:
        summaries = [solve_folder(options.folders[0], options.out, jobs=options.jobs, **how)]
    print("\n".join(summary_lines(summaries)))
    errors = [_ended(2, summary["error"]) for summary in summaries if "error" in summary]
    print(f"results: {options.out.resolve()}", file=sys.stderr)
    return 2 if errors else _code_of(summaries)


def _simulate(options):
    from slamlib.studies.simulation import simulate, write_dataset
    dataset, truth = simulate(
        options.path, options.seed, slip=options.slip, late_ranges=options.nlos,
        mislabelled=options.mislabel, rounds=options.rounds)
    write_dataset(options.folder, dataset, truth)
    return 0


def _lab(options):
    from slamlib.report.execution import start_lab
    from slamlib.report.notebooks import notebooks_folder
    start_lab(options.notebooks or notebooks_folder(), options.data, options.others)


if __name__ == "__main__":
    sys.exit(main())
