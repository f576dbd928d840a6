"""The command line, `slamlib` or `python -m slamlib`: its options, commands and exit codes."""

import argparse
import os
import signal
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

# Set before numpy is imported: the matrices are so small that more threads are slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from slamlib import __version__  # noqa: E402
from slamlib.core.errors import DatasetError, require  # noqa: E402
from slamlib.core.vehicle import changed  # noqa: E402
from slamlib.io.dataset import read_dataset, read_truth  # noqa: E402

EXECUTED_NOTEBOOKS = Path("build", "executed")  # folder in which executed notebooks are kept
END_SIGNALS = {signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}  # Windows has no SIGHUP


def main(arguments=None):
    """Run one command of `arguments` (list of str, or None for the command line's).

    Returns the exit code: 0, 1 if a notebook failed, 2 for invalid input, 3 if a problem could not
    be solved, 130 if ended by a signal.
    """
    if arguments is None:
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr, for names in other letters
        for each in END_SIGNALS:
            if signal.getsignal(each) == signal.SIG_DFL:     # nohup's handler stays
                signal.signal(each, signal.default_int_handler)      # as by Ctrl-C
    parser = _parser()
    options, options.others = parser.parse_known_args(arguments)
    if options.others and options.run is not _lab:
        parser.error(f"unrecognized arguments: {' '.join(options.others)}")
    try:
        return options.run(options)
    except DatasetError as error:
        reason, code = error, 2
    except OSError as error:
        reason, code = f"cannot be read or written: {error}", 2
    except KeyboardInterrupt:
        reason, code = "ended by a signal", 130
    with suppress(OSError):  # the terminal may be gone
        print(f"slamlib: {reason}", file=sys.stderr)
    return code


def _parser():
    """The parser of the command line; `run` of what it parses is the function of the command."""
    whole = argparse.ArgumentParser(
        prog="slamlib", description="Vehicle SLAM from wheel encoders, markers and UWB ranges.")
    whole.add_argument("--version", action="version", version=f"slamlib {__version__}")
    commands = whole.add_subparsers(required=True, metavar="COMMAND")

    def command(name, run, help, *paths, **options):
        """Add a command with (option, default, help) of its paths."""
        parser = commands.add_parser(name, help=help, **options)
        parser.set_defaults(run=run)
        for option, default, help in paths:
            parser.add_argument(option, type=Path, default=default,
                                help=help + " (default %(default)s)" * bool(default))
        return parser.add_argument

    data = "--data", "data", "folder of the datasets"
    notebooks = ("--notebooks", None, "folder of the notebooks (default: the folder notebooks "
                 "where there is one, else those of the installation)")
    made = data, notebooks, ("--results", "results", "folder for the .mat files")
    for add in (command("report", _build, "execute the notebooks and build the report", *made,
                        ("--report", "report", "folder for the pages")),
                command("hand-in", _build, "build the report, and zip it with the result files",
                        *made, ("--out", "hand-in.zip", "the file to write"))):
        add("datasets", nargs="*", metavar="DATASET",
            help="names of folders in data/ (all of them when none is named)")
        add("--jobs", type=int, default=2, help="notebooks executed at a time")
        add("--fresh", action="store_true",
            help="execute all notebooks and studies, also where nothing changed")

    _add_solve_and_simulate(command)
    command("lab", _lab, "open JupyterLab on the notebooks; it is given all other arguments, as "
            "--no-browser", data, notebooks, allow_abbrev=False)
    return whole


def _add_solve_and_simulate(command):
    add = command("solve", _solve, "solve problems without notebooks",
                  ("folder", None, "the dataset's folder"),
                  ("--plot", None, "write a picture of map and errors: a .png, .pdf or .svg file"))
    add("--out", type=Path, required=True, help="folder for the results")
    add("--problem", action="append", default=[], metavar="NAME",
        type=lambda text: text.removeprefix("problem"),
        choices=("1", "2", "2_hint", "2_fused", "3", "4"),
        help="one of %(choices)s, of which 2 is markers alone; may be repeated (default: all); 4 "
             "starts from 3 where both are solved")
    add("--kernel", help="instead of that of vehicle.toml")
    add("--slip", type=float, help="instead of that of vehicle.toml")
    add("--csv", action="store_true", help="write poses and maps as text, too: CSV with "
        "covariances, and trajectories as TUM files for evo")

    add = command("simulate", _simulate, "make a dataset with its truth",
                  ("folder", None, "a new or empty folder"))
    add("--path", choices=("short", "long"), default="short")
    add("--rounds", type=int, default=1,
        help="how often the path is driven; 44 long ones are a million rows")
    add("--seed", type=int, default=0)
    add("--slip", type=float, default=1e-3,
        help="wheel slip: sigma after one metre, in m (default %(default)s)")
    add("--nlos", type=float, default=0.0,
        help="share of UWB ranges without line of sight, which are too long")
    add("--mislabel", type=float, default=0.0,
        help="share of marker sightings that carry another marker's id")


def _build(options):
    """Build the report, and write the zip to hand in where `out` is one of the options."""
    from slamlib.report import NotebookError, build_report, handin
    from slamlib.report.notebooks import notebooks_folder, read_options
    from slamlib.solve import summarize
    shown, omitted, out = read_options("report.toml"), (), vars(options).get("out")
    pages = Path("build", "hand-in") if out else options.report
    notebooks = options.notebooks or notebooks_folder()
    datasets = [Path(each).name if Path(each).resolve().parent == options.data.resolve() else each
                for each in options.datasets] or None            # names, or paths in data/
    for folder, other in ((pages, options.results), (options.results, pages)):
        _require_elsewhere(folder, options.data, notebooks, other)
    if out:
        require(not out.is_dir(), out, "a file to write, found a folder")
        shown = handin.hand_in_options(shown)
        datasets, omitted = handin.selection(options.data, datasets)
    try:
        report = build_report(
            notebooks, options.data, pages, options.results, datasets=datasets, options=shown,
            jobs=options.jobs, kept=EXECUTED_NOTEBOOKS, fresh=options.fresh)
    except NotebookError as error:
        print(f"slamlib: {error}", file=sys.stderr)
        return 1
    if not shown.author:
        print("report.toml names no author: the PDF's title page has none", file=sys.stderr)
    for drive in report.drives:
        rows = {each.problem: summarize(each, drive.truth) for each in drive.solutions} | {
            each.problem: {"failed": each.reason} for each in drive.failures}
        print(summary_table({"dataset": drive.name, "poses": len(drive.dataset.ticks),
                             "problems": rows, "doubts": map(vars, drive.doubts)}), file=sys.stderr)
    if out:
        handin.write_zip(out, report, options.results, shown, omitted)
        print(f"hand-in: {out.resolve()}", file=sys.stderr)
    else:
        print(f"report: {report.files[0]} and {report.files[-1]}", file=sys.stderr)
    return 3 if any(drive.failures for drive in report.drives) else 0


def summary_table(summary):
    """The summary as a table (str), a line for each problem, and sentences on doubts below it."""
    lines = [f"{summary['dataset']}: {summary['poses']} poses",
             f"problem{'estimates':>18}{'last x, y, heading':>29}{'their sigmas':>28}{'ATE':>11}"]
    for name, row in summary["problems"].items():
        if "failed" in row:
            lines.append(f"{name:15}could not be solved: {row['failed']}")
            continue
        numbers = "{:10}{:8.3f} m {:8.3f} m {:7.4f}  {:7.4f} m {:7.4f} m {:6.4f}".format(
            row["estimated_poses"], *row["last_pose"], *row["last_sigma"])
        error = f"{row['ate_m']:.4f} m" if "ate_m" in row else "-"
        lines.append(f"{name:15}{numbers}{error:>11}")
        if once := ", ".join(map(str, row.get("unconfirmed", ()))):
            lines.append(
                f"{'':15}nothing confirms markers {once}: seen once, or where another one is")
    lines += [f"doubt ({doubt['what']}): {doubt['sentence']}" for doubt in summary["doubts"]]
    return "\n".join(lines)


def _require_elsewhere(out, *folders):
    """Raise DatasetError if a folder that a run replaces is or holds the current one or others."""
    for folder in map(Path.resolve, (Path(), *folders)):
        require(not folder.is_relative_to(out.resolve()), out, "another folder to write to: this "
                f"one, which is replaced, is or holds {folder}")


def _solve(options):
    from slamlib.io.dataset import inventory_lines
    from slamlib.solve import PROBLEMS, allows, solve_to_folder, title
    _require_elsewhere(options.out, options.folder, options.folder / "truth")
    require(not options.plot or options.plot.suffix.lower() in (".png", ".pdf", ".svg"), "--plot",
            "a .png, .pdf or .svg file", options.plot)
    dataset, truth = read_dataset(options.folder), read_truth(options.folder)
    dataset = replace(dataset, vehicle=changed(
        dataset.vehicle, {"kernel": options.kernel, "slip": options.slip}, "slamlib solve"))
    problems = sorted(f"problem{each}" for each in options.problem) or [*PROBLEMS]
    for each in problems if options.problem else ():
        require(allows(dataset, each), options.folder,
                f"the measurements of {each} ({title(each, dataset)})")
    print("\n".join(inventory_lines(dataset, truth)), file=sys.stderr)
    summary = solve_to_folder(dataset, truth, options.out, problems, options.csv)
    print(summary_table(summary))
    print(f"results: {options.out.resolve()}", file=sys.stderr)
    if options.plot and any("failed" not in row for row in summary["problems"].values()):
        from slamlib.report.overview import result_picture
        result_picture(dataset, truth, options.out, options.plot)
        print(f"picture: {options.plot.resolve()}", file=sys.stderr)
    return 3 if any("failed" in row for row in summary["problems"].values()) else 0


def _simulate(options):
    from slamlib.studies.simulation import simulate, write_dataset
    write_dataset(options.folder, *simulate(
        options.path, options.seed, slip=options.slip, late_ranges=options.nlos,
        mislabelled=options.mislabel, rounds=options.rounds))
    return 0


def _lab(options):
    from slamlib.report.execution import start_lab
    from slamlib.report.notebooks import notebooks_folder
    start_lab(options.notebooks or notebooks_folder(), options.data, EXECUTED_NOTEBOOKS,
              options.others)


if __name__ == "__main__":
    sys.exit(main())
