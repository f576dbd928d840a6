"""Runs the commands of the command line, `slamlib` or `python -m slamlib`."""

import os
import signal
import sys
import threading
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

# Set before numpy is imported: the matrices are so small that more threads are slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from slamlib.arguments import KNOWN_NOISE, command_line_parser  # noqa: E402
from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth  # noqa: E402

EXECUTED_NOTEBOOKS = Path("build", "executed")  # folder in which executed notebooks are kept
PICTURES = (".png", ".pdf", ".svg")             # endings of files that `solve --plot` writes
# Signals that end a process; Windows has no SIGHUP.
END_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP")
                    if hasattr(signal, name))


def main(arguments=None):
    """Run one command of `arguments` (list of str, or None for the command line's).

    Returns the exit code: 0, 1 if a notebook failed, 2 for invalid input, 3 if a problem could not
    be solved, 128 + n if ended by signal n.
    """
    if arguments is None:
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr, for names in other letters
    parser = command_line_parser()
    options, others = parser.parse_known_args(arguments)
    if others and options.command != "lab":
        parser.error(f"unrecognized arguments: {' '.join(others)}")
    options.others = others
    ended = [signal.SIGINT]
    try:
        with _orderly_end(ended):
            return HANDLERS[options.command](options)
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
    """Let END_SIGNALS end a run as Ctrl-C does; the list `ended` gets the signal that came."""
    def end(number, frame):
        for each in defaults:
            signal.signal(each, signal.SIG_IGN)
        ended.append(signal.Signals(number))
        interrupt = signal.getsignal(signal.SIGINT)  # the event loop's, while notebooks run
        (interrupt if callable(interrupt) else signal.default_int_handler)(signal.SIGINT, frame)

    here = threading.current_thread() is threading.main_thread()
    defaults = [each for each in END_SIGNALS if here
                and signal.getsignal(each) == signal.SIG_DFL]     # nohup's handler stays
    for each in defaults:
        signal.signal(each, end)
    try:
        yield
    finally:
        for each in defaults:
            signal.signal(each, signal.SIG_DFL)


def _report(arguments):
    return _build(
        arguments, _options(arguments), arguments.report, _selected_datasets(arguments),
        lambda report: f"report: {report.files[0]} and {report.files[-1]}")


def _hand_in(arguments):
    from slamlib.report import handin
    if arguments.out.is_dir():
        raise DatasetError(f"{arguments.out}: expected the name of a file to write, found a folder")
    options = handin.hand_in_options(_options(arguments))
    datasets, omitted = handin.selection(arguments.data, _selected_datasets(arguments))

    def finish(report):
        handin.write_zip(arguments.out, report, arguments.results, options, omitted)
        return f"hand-in: {arguments.out.resolve()}"
    return _build(arguments, options, Path("build", "hand-in"), datasets, finish, files=False)


def _options(arguments):
    """The Options of report.toml; those of the command line replace them."""
    from slamlib.report.options import read_options
    names = ("author", "student_number", "code", "appendix")
    return replace(read_options("report.toml"),
                   **_stated({name: getattr(arguments, name) for name in names}))


def _stated(values):
    return {key: value for key, value in values.items() if value is not None}


def _build(arguments, options, folder, datasets, finish, files=True):
    """Build a Report into a folder and print doubts and finish(Report); return the exit code."""
    from slamlib.report import NotebookError, build_report
    from slamlib.report.notebooks import copy_notebooks, notebooks_folder
    notebooks = arguments.notebooks or notebooks_folder()
    for out in (folder, arguments.results):
        _require_elsewhere(out, arguments.data, notebooks)
    if arguments.notebooks_to:
        dataset_names(arguments.data, datasets)            # nothing is copied if there are none
        notebooks = copy_notebooks(notebooks, arguments.notebooks_to)
    try:
        report = build_report(
            notebooks, arguments.data, folder, arguments.results, datasets=datasets,
            options=options, jobs=arguments.jobs, kept=EXECUTED_NOTEBOOKS,
            fresh=arguments.fresh, files=files)
    except NotebookError as error:
        print(f"slamlib: {error}", file=sys.stderr)
        return 1
    if not options.author:
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


def _selected_datasets(arguments):
    """Names (list of str) of the datasets, given by names or paths of folders in data/, or None."""
    return [Path(dataset).name if Path(dataset).resolve().parent == arguments.data.resolve()
            else dataset for dataset in arguments.datasets] or None


def _require_elsewhere(out, *folders):
    """Raise DatasetError if a folder that a run replaces is or holds the current one or others."""
    for folder in map(Path.resolve, (Path(), *folders)):
        if folder.is_relative_to(out.resolve()):
            raise DatasetError(f"{out}: expected another folder to write to: this one, which is "
                               f"replaced, is or holds {folder}")


def _solve(options):
    from slamlib import solve
    from slamlib.dataset import inventory_lines
    from slamlib.slam.fit import KERNELS
    from slamlib.summary import solve_to_folder, summary_table
    _require_elsewhere(options.out, options.folder)
    problems = [f"problem{each.removeprefix('problem')}" for each in options.problem or ()] \
        or list(solve.PROBLEMS)
    for given, known, what in (
            (problems, solve.PROBLEMS, "problem"),
            ([options.kernel] if options.kernel else (), KERNELS, "kernel"),
            ([options.plot.suffix.lower()] if options.plot else (), PICTURES, "picture")):
        for each in (each for each in given if each not in known):
            raise DatasetError(f"expected a {what} of {', '.join(known)}, found {each!r}")
    dataset, truth = read_dataset(options.folder), read_truth(options.folder)
    for each in problems if options.problem else ():
        if not solve.allows(dataset, each):
            raise DatasetError(f"{options.folder}: expected the measurements of {each} "
                               f"({solve.title(each, dataset)}), found none")
    stated = _stated({name: getattr(options, name) for name in (*KNOWN_NOISE, "kernel")})
    dataset = replace(dataset, vehicle=replace(dataset.vehicle, **stated))
    print("\n".join(inventory_lines(dataset, truth)), file=sys.stderr)
    summary = solve_to_folder(dataset, truth, options.out, sorted(problems), options.csv)
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
    from slamlib.report.lab import start_lab
    from slamlib.report.notebooks import notebooks_folder
    start_lab(options.notebooks or notebooks_folder(), options.data, EXECUTED_NOTEBOOKS,
              options.others)


def _export(options):
    from slamlib.export import export_results
    for path in export_results(options.results, options.format, options.out):
        print(path)
    return 0


HANDLERS = {"report": _report, "hand-in": _hand_in, "solve": _solve, "simulate": _simulate,
            "export": _export, "lab": _lab}


if __name__ == "__main__":
    sys.exit(main())
