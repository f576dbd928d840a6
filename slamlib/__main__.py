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

from slamlib.arguments import command_line_parser  # noqa: E402
from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth  # noqa: E402
from slamlib.swap import END_SIGNALS  # noqa: E402

EXECUTED_NOTEBOOKS = Path("build", "executed")  # folder in which executed notebooks are kept


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

    defaults = ()
    if threading.current_thread() is threading.main_thread():
        defaults = [each for each in END_SIGNALS
                    if signal.getsignal(each) == signal.SIG_DFL]  # nohup's handler stays
    for each in defaults:
        signal.signal(each, end)
    try:
        yield
    finally:
        for each in defaults:
            signal.signal(each, signal.SIG_DFL)


def _report(arguments):
    options = _options(arguments)
    report = _built(arguments, options, arguments.report, _selected_datasets(arguments))
    if report is None:
        return 1
    print(f"report: {report.files[0]} and {report.files[-1]}", file=sys.stderr)
    return _report_exit_code(report)


def _hand_in(arguments):
    from slamlib.report import handin
    if arguments.out.is_dir():
        raise DatasetError(f"{arguments.out}: expected the name of a file to write, found a folder")
    options = handin.hand_in_options(_options(arguments))
    datasets, omitted = handin.selection(arguments.data, _selected_datasets(arguments))
    report = _built(arguments, options, Path("build", "hand-in"), datasets, files=False)
    if report is None:
        return 1
    handin.write_zip(arguments.out, report, arguments.results, options, omitted)
    print(f"hand-in: {arguments.out.resolve()}", file=sys.stderr)
    return _report_exit_code(report)


def _options(arguments):
    """The Options of report.toml; those of the command line replace them."""
    from slamlib.report.options import read_options
    options = read_options("report.toml")
    cover = {key: getattr(arguments, key) for key in ("author", "student_number")}
    others = {key: getattr(arguments, key) for key in ("code", "appendix")}
    return replace(options, cover=replace(options.cover, **_stated(cover)), **_stated(others))


def _stated(values):
    return {key: value for key, value in values.items() if value is not None}


def _built(arguments, options, folder, datasets, files=True):
    """The Report that is built into a folder, or None if a notebook failed; prints doubts."""
    from slamlib.report import NotebookError, build_report
    from slamlib.report.sources import copy_notebooks, notebooks_folder
    notebooks = arguments.notebooks or notebooks_folder()
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
        return None
    if not options.cover.author:
        print("report.toml names no author: the PDF's title page has none", file=sys.stderr)
    for drive in report.drives:
        for doubt in drive.doubts:
            print(f"{drive.name}: doubt ({doubt.what}): {doubt.sentence}", file=sys.stderr)
    return report


def _report_exit_code(report):
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


def _solve(options):
    from slamlib.inventory import inventory_lines
    from slamlib.summary import solve_to_folder, summary_table
    dataset, truth = read_dataset(options.folder), read_truth(options.folder)
    print("\n".join(inventory_lines(dataset, truth)), file=sys.stderr)
    summary = solve_to_folder(dataset, truth, options.out, jobs=2)
    print(summary_table(summary))
    return _exit_code([(summary["dataset"], name, row["failed"])
                       for name, row in summary["problems"].items() if "failed" in row])


def _simulate(options):
    from slamlib.simulation import simulate, write_dataset
    dataset, truth = simulate(options.path, options.seed, slip=options.slip,
                              late_ranges=options.nlos, mislabelled=options.mislabel,
                              rounds=options.rounds)
    write_dataset(options.folder, dataset, truth)
    return 0


def _lab(options):
    from slamlib.report.lab import start_lab
    from slamlib.report.sources import notebooks_folder
    start_lab(options.notebooks or notebooks_folder(), options.data, EXECUTED_NOTEBOOKS,
              options.others)


def _export(options):
    from slamlib.export import export_trajectories
    for path in export_trajectories(options.results, options.format, options.out):
        print(path)
    return 0


HANDLERS = {"report": _report, "hand-in": _hand_in, "solve": _solve, "simulate": _simulate,
            "export": _export, "lab": _lab}


if __name__ == "__main__":
    sys.exit(main())
