"""The command line: `slamlib` or `python -m slamlib`."""

import os
import signal
import sys
import threading
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

# Set before numpy is imported: the matrices are so small that more threads are slower.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from slamlib.arguments import parser  # noqa: E402
from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth  # noqa: E402
from slamlib.swap import ENDS  # noqa: E402

KEPT = Path("build", "executed")


def main(arguments=None):
    """Run one command of `arguments` (list of str, or None for the command line's).

    Returns the exit code: 0, 1 if a notebook failed, 2 for invalid input, 3 if a problem could not
    be solved, 128 + n if ended by signal n.
    """
    if arguments is None:
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr, for names in other letters
    known = parser()
    options, others = known.parse_known_args(arguments)
    if others and options.command != "lab":
        known.error(f"unrecognized arguments: {' '.join(others)}")
    options.others = others
    ended = [signal.SIGINT]
    try:
        with _orderly_end(ended):
            return RUN[options.command](options)
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
        before = {each: signal.getsignal(each) for each in ENDS
                  if signal.getsignal(each) == signal.SIG_DFL}  # nohup's stays
    for each in before:
        signal.signal(each, end)
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def _report(arguments):
    options = _options(arguments)
    report = _built(arguments, options, arguments.report, _names(arguments))
    if report is None:
        return 1
    print(f"report: {report.files[0]} and {report.files[-1]}", file=sys.stderr)
    return _exit_code(_failures(report))


def _hand_in(arguments):
    from slamlib.report import handin
    if arguments.out.is_dir():
        raise DatasetError(f"{arguments.out}: expected the name of a file to write, found a folder")
    options = handin.hand_in_options(_options(arguments))
    datasets, omitted = handin.selection(arguments.data, _names(arguments))
    report = _built(arguments, options, Path("build", "hand-in"), datasets, files=False)
    if report is None:
        return 1
    handin.write_zip(arguments.out, report, arguments.results, options, omitted)
    print(f"hand-in: {arguments.out.resolve()}", file=sys.stderr)
    return _exit_code(_failures(report))


def _options(arguments):
    """Return the Options of report.toml with what the command line says instead."""
    from slamlib.report.options import read_options
    options = read_options("report.toml")
    cover = {key: getattr(arguments, key) for key in ("author", "student_number")}
    others = {key: getattr(arguments, key) for key in ("code", "appendix")}
    return replace(options, cover=replace(options.cover, **_given(cover)), **_given(others))


def _given(values):
    return {key: value for key, value in values.items() if value is not None}


def _built(arguments, options, folder, datasets, files=True):
    """Return the Report that is built into a folder, or None if a notebook failed; tell doubts."""
    from slamlib.report import NotebookError, build_report
    from slamlib.report.sources import copy_notebooks, notebooks_folder
    notebooks = arguments.notebooks or notebooks_folder()
    if arguments.notebooks_to:
        dataset_names(arguments.data, datasets)            # nothing is copied if there are none
        notebooks = copy_notebooks(notebooks, arguments.notebooks_to)
    try:
        report = build_report(
            notebooks, arguments.data, folder, arguments.results, datasets=datasets,
            options=options, jobs=arguments.jobs, kept=KEPT, fresh=arguments.fresh, files=files)
    except NotebookError as error:
        print(f"slamlib: {error}", file=sys.stderr)
        return None
    if not options.cover.author:
        print("report.toml names no author: the PDF's title page has none", file=sys.stderr)
    for drive in report.drives:
        for doubt in drive.doubts:
            print(f"{drive.name}: doubt ({doubt.what}): {doubt.sentence}", file=sys.stderr)
    return report


def _failures(report):
    return ((drive.name, failure.problem, failure.reason)
            for drive in report.drives for failure in drive.failures)


def _exit_code(failures):
    """Print the (dataset, problem, reason) of what could not be solved; 3 if there is any, or 0."""
    code = 0
    for dataset, problem, reason in failures:
        print(f"slamlib: {dataset}: {problem} could not be solved: {reason}", file=sys.stderr)
        code = 3
    return code


def _names(arguments):
    """Return the names of the datasets, given by names or paths of folders in data/, or None."""
    paths = {dataset: Path(dataset) for dataset in arguments.datasets}
    return [path.name if path.resolve().parent == arguments.data.resolve() else dataset
            for dataset, path in paths.items()] or None


def _solve(options):
    from slamlib.inventory import found
    from slamlib.summary import solve_to_folder, summary_table
    dataset, truth = read_dataset(options.folder), read_truth(options.folder)
    print("\n".join(found(dataset, truth)), file=sys.stderr)
    summary = solve_to_folder(dataset, truth, options.out, jobs=2)
    print(summary_table(summary))
    return _exit_code((summary["dataset"], name, row["failed"])
                      for name, row in summary["problems"].items() if "failed" in row)


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
    start_lab(options.notebooks or notebooks_folder(), options.data, KEPT, options.others)


def _export(options):
    from slamlib.export import export_trajectories
    for path in export_trajectories(options.results, options.format, options.out):
        print(path)
    return 0


RUN = {"report": _report, "hand-in": _hand_in, "solve": _solve, "simulate": _simulate,
       "export": _export, "lab": _lab}


if __name__ == "__main__":
    sys.exit(main())
