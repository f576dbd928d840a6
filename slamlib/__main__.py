"""The command line, `slamlib` or `python -m slamlib`: its options, commands and exit codes."""

import argparse
import os
import signal
import sys
from pathlib import Path

# Set before numpy is imported: the matrices are so small that more threads are slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from slamlib import __version__  # noqa: E402
from slamlib.core.errors import DatasetError, require  # noqa: E402

EXECUTED_NOTEBOOKS = Path("build", "executed")  # folder in which executed notebooks are kept
HAND_IN_PAGES = Path("build", "hand-in")  # folder of the report that is handed in


def main(arguments: list[str] | None = None) -> int:
    """Run one command of `arguments`, or of the command line.

    Returns the exit code: 0, 1 if a notebook failed, 2 for invalid input, 3 if a problem could not
    be solved, 130 if ended by a signal.
    """
    if arguments is None:
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr, for names in other letters
        signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
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
    print(f"slamlib: {reason}", file=sys.stderr)
    return code


def _parser():
    """The parser of the command line; `run` of what it parses is the function of the command."""
    whole = argparse.ArgumentParser(
        prog="slamlib", description="Vehicle SLAM from wheel encoders, markers and UWB ranges.")
    whole.add_argument("--version", action="version", version=f"slamlib {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND")

    def add_command(name, run, help, **options):
        command = commands.add_parser(name, help=help, **options)
        command.set_defaults(run=run)
        return command.add_argument

    add = add_command("report", _build, "execute the notebooks and build the report")
    _add_options_of_a_build(add)
    add("--report", type=Path, default="report", help="folder for the pages (default %(default)s)")

    add = add_command("hand-in", _build, "build the report, and zip it with the result files")
    _add_options_of_a_build(add)
    add("--out", type=Path, default="hand-in.zip", help="the file to write (default %(default)s)")

    add = add_command("solve", _solve, "solve problems without notebooks")
    add("folders", nargs="+", type=Path, metavar="FOLDER", help="a dataset's folder; each of "
        "several has its results in the folder of its name in OUT, and drives.csv is the table "
        "over all")
    add("--out", type=Path, required=True, help="folder for the results")
    add("-j", "--jobs", type=int, default=1, help="datasets solved at a time (default 1)")
    add("--problem", action="append", default=[], metavar="NAME",
        type=lambda text: text.removeprefix("problem"),
        choices=("1", "2", "2_hint", "2_fused", "3", "4"),
        help="one of %(choices)s, of which 2 is markers alone; may be repeated (default: all); 4 "
        "starts from 3 where both are solved")
    add("-v", "--verbose", action="store_true", help="print to stderr what is decided on the way: "
        "kernels, noise, accepted measurements, calibration, and GTSAM's solution")

    add = add_command("simulate", _simulate, "make a dataset with its truth")
    add("folder", type=Path, help="a new or empty folder")
    add("--path", choices=("short", "long"), default="short",
        help="the path that is driven (default short)")
    add("--rounds", type=int, default=1,
        help="how often the path is driven; 44 long ones are a million rows (default 1)")
    add("--seed", type=int, default=0, help="of the random generator (default 0)")
    add("--slip", type=float, default=1e-3,
        help="wheel slip: sigma after one metre, in m (default %(default)s)")
    add("--nlos", type=float, default=0.0,
        help="share of UWB ranges without line of sight, which are too long (default 0)")
    add("--mislabel", type=float, default=0.0,
        help="share of marker sightings that carry another marker's id (default 0)")

    add = add_command("lab", _lab, "open JupyterLab on the notebooks; it is given all other "
                      "arguments, as --no-browser", allow_abbrev=False)
    _add_data_and_notebooks(add)
    return whole


def _add_data_and_notebooks(add):
    add("--data", type=Path, default="data", help="folder of the datasets (default data)")
    add("--notebooks", type=Path, help="folder of the notebooks (default: the folder notebooks "
        "where there is one, else those of the installation)")


def _add_options_of_a_build(add):
    _add_data_and_notebooks(add)
    add("--results", type=Path, default="results",
        help="folder for the .mat files (default results)")
    add("datasets", nargs="*", metavar="DATASET",
        help="names of folders in data/ (all of them when none is named, but simulated ones where "
        "there are others)")
    add("--jobs", type=int, default=2, help="notebooks executed at a time (default 2)")


def _build(options):
    """Build the report, and write the zip to hand in where `out` is given."""
    from slamlib.report import NotebookError, build_report, handin
    from slamlib.report.notebooks import notebooks_folder, read_options
    shown = read_options("report.toml")
    notebooks = options.notebooks or notebooks_folder()
    out = getattr(options, "out", None)
    pages = getattr(options, "report", HAND_IN_PAGES)
    taken = [options.data.resolve(), pages.resolve()]
    require(options.results.resolve() not in taken, options.results,
            "another folder for the results: this one is for the datasets or the pages")
    if out:
        require(not out.is_dir(), out, "a file to write, found a folder")
        shown = handin.hand_in_options(shown)
    try:
        report = build_report(
            notebooks, options.data, pages, options.results, options.datasets or None, shown,
            options.jobs, EXECUTED_NOTEBOOKS)
    except NotebookError as error:
        return _ended(1, error)
    if not shown.author:
        print("report.toml names no author: the PDF's title page has none", file=sys.stderr)
    print("\n".join(summary_lines(report.summaries)), file=sys.stderr)
    if out:
        handin.write_zip(out, report, options.results, shown)
        print(f"hand-in: {out.resolve()}", file=sys.stderr)
    else:
        print(f"report: {report.files[0]} and {report.files[-1]}", file=sys.stderr)
    return _code_of(report.summaries)


def _code_of(summaries):
    """The exit code by the summaries of drives: 3 if a problem failed, else 0."""
    failed = ["failed" in row for summary in summaries for row in summary["problems"].values()]
    return 3 if any(failed) else 0


def summary_lines(summaries: list[dict]) -> list[str]:
    """The summaries of drives as lines: a table, then what failed or is in doubt."""
    from slamlib.solve import drive_table
    table = drive_table(summaries).drop(columns=["seconds", "failed"]).dropna(axis=1, how="all")
    lines = [table.to_string(index=False, na_rep="-", float_format="{:.4g}".format)]
    for summary in summaries:
        name = summary["dataset"]
        for problem, row in summary["problems"].items():
            if "failed" in row:
                lines.append(f"{name}: {problem} could not be solved: {row['failed']}")
        for doubt in summary["doubts"]:
            told = f"{name}: doubt ({doubt['what']}): {doubt['sentence']} {doubt['advice']}"
            lines.append(told.rstrip())
    return lines


def _solve(options):
    """Solve the problems of one dataset or several, and print a table of each."""
    from slamlib.solve import solve_folder, solve_folders
    problems = [f"problem{each}" for each in options.problem]
    how = {"problems": problems, "verbose": options.verbose}
    if len(options.folders) > 1:
        summaries = solve_folders(options.folders, options.out, options.jobs, **how)
    else:
        summaries = [solve_folder(options.folders[0], options.out, **how)]
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
