"""Executes notebooks headless, each in a kernel of its own, at most so many at a time."""

import asyncio
import os
import re
import shutil
import sys
import time

import nbformat
from jupyter_client import AsyncKernelManager
from jupyter_client.kernelspec import KernelSpecManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert.filters import strip_ansi
from tqdm import tqdm

SECONDS_PER_CELL = 1800


class NotebookError(RuntimeError):
    """A notebook that failed; the message names the notebook, the place in it and the reason."""


def read_notebook(source):
    """The notebook of a file; NotebookError if it is none."""
    try:
        return nbformat.read(source, as_version=4)
    except (nbformat.reader.NotJSONError, nbformat.ValidationError) as error:
        reason = str(error).partition("\n")[0]
        raise NotebookError(f"{source.name} is not a notebook: {reason}") from None


class _Loop(asyncio.SelectorEventLoop):
    """Leaves Ctrl-C to asyncio, which stops all kernels; nbclient would go on without its own."""

    def add_signal_handler(self, *_):
        raise RuntimeError("signals are not for single notebooks")


def kernel_environment(settings, data, datasets, jobs):
    """What kernels see: our variables, and no settings of the user that would change a page."""
    (settings / "matplotlibrc").write_text("svg.hashsalt: slamlib\n")
    threads = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS") if jobs > 1 else ()
    environment = {"SOURCE_DATE_EPOCH": "0", "PYTHONHASHSEED": "0"} | dict.fromkeys(threads, "1")
    environment |= os.environ
    environment |= {"SLAMLIB_DATA": str(data), "IPYTHONDIR": str(settings),
                    "MATPLOTLIBRC": str(settings / "matplotlibrc"),
                    "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    for name in ("SLAMLIB_DATASETS", "SLAMLIB_STUDIES"):
        environment.pop(name, None)
    return environment | ({"SLAMLIB_DATASETS": "\n".join(datasets)} if datasets else {})


def execute(books, environment, results, jobs, done):
    """Execute books in place, at most `jobs` at a time; the first failure stops the others.

    Each writes its results to a folder of its own inside `results`, from where they are moved to
    their places when it has ended well.

    Parameters
    ----------
    books : dict from Path to NotebookNode
    environment : dict of the kernels' variables; SLAMLIB_RESULTS is added.
    results : Path
    jobs : number of notebooks at a time.
    done : called with source, book and the names of its results for each notebook that ended well.

    Raises
    ------
    NotebookError : a cell failed.
    """
    try:
        with asyncio.Runner(loop_factory=_Loop) as runner:
            runner.run(_execute_all(books, environment, results, jobs, done))
    except ExceptionGroup as group:
        raise group.exceptions[0] from None


async def _execute_all(books, environment, results, jobs, done):
    slots = asyncio.Semaphore(jobs)

    async def run(source, book, bar):
        stage = results / f".{source.stem}"
        shutil.rmtree(stage, ignore_errors=True)  # of a build that was killed
        stage.mkdir(parents=True)
        try:
            await _execute(source, book, environment | {"SLAMLIB_RESULTS": str(stage)}, slots, bar)
            done(source, book, _publish(stage, results))
        finally:
            shutil.rmtree(stage, ignore_errors=True)

    with tqdm(total=0, unit="cell", leave=False, disable=not sys.stderr.isatty()) as bar:
        async with asyncio.TaskGroup() as group:
            for source, book in books.items():
                group.create_task(run(source, book, bar))


def _publish(stage, results):
    """Move all files of a folder to their places in another; return their names there."""
    names = [file.relative_to(stage) for file in sorted(stage.rglob("*")) if file.is_file()]
    for name in names:
        (results / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(stage / name, results / name)
    return [name.as_posix() for name in names]


async def _execute(source, book, environment, slots, bar):
    """Execute one book in place, by the interpreter that runs this."""
    count = sum(cell.cell_type == "code" and cell.source.strip() != "" for cell in book.cells)
    bar.total += count
    started = []

    def begin(cell, cell_index):
        started.append(cell)
        bar.set_description(f"{source.stem}: cell {len(started)} of {count}")

    manager = AsyncKernelManager(  # with no folder to search only this very interpreter remains
        kernel_name="python3", kernel_spec_manager=KernelSpecManager(kernel_dirs=[]))
    client = NotebookClient(
        book, km=manager, resources={"metadata": {"path": str(source.parent)}},
        timeout=SECONDS_PER_CELL, iopub_timeout=60, raise_on_iopub_timeout=True,
        record_timing=False, store_widget_state=False, shutdown_kernel="immediate",
        extra_arguments=["--IPKernelApp.log_level=ERROR"],
        on_cell_execute=begin, on_cell_executed=lambda **_: bar.update())
    async with slots:
        start = time.monotonic()
        tqdm.write(f"{source.stem}: {count} cells", file=sys.stderr)
        try:
            await client.async_execute(env=environment, cleanup_kc=True)
            _join_printed(book)
        except (CellExecutionError, TimeoutError, RuntimeError) as error:
            if asyncio.current_task().cancelling():  # which nbclient takes for a dead kernel
                raise asyncio.CancelledError from None
            raise NotebookError(_failure(source, started, error)) from None
        finally:
            if manager.has_kernel:
                await manager.shutdown_kernel(now=True)
        tqdm.write(f"{source.stem}: done in {time.monotonic() - start:.1f} s", file=sys.stderr)


def _join_printed(book):
    """Make one output of what a cell printed in a row, which arrives in parts if it takes its time."""
    for cell in book.cells:
        joined = []
        for output in cell.get("outputs", []):
            if joined and "stream" == output.output_type and output.get("name") == joined[-1].get("name"):
                joined[-1].text += output.text
            else:
                joined.append(output)
        if "outputs" in cell:
            cell.outputs = joined


def _failure(source, started, error):
    """Notebook, cell, line and reason of a failure, without colours."""
    place, lines, reason = source.name, [], f"{type(error).__name__}: {error}".splitlines()[0]
    if started:
        place, lines = f"{place}, cell {len(started)}", started[-1].source.splitlines()
    if isinstance(error, CellExecutionError):
        reason = f"{error.ename}: {error.evalue}"
        frame = re.search(r"Cell In\s?\[\d+\], line (\d+)", strip_ansi(error.traceback))
        if frame and int(frame[1]) <= len(lines):
            place, lines = f"{place}, line {frame[1]}", [lines[int(frame[1]) - 1].strip()]
    return strip_ansi("\n    ".join([f"{place}:", *lines[:5]]) + f"\n{reason}")
