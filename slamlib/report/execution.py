"""Executes notebooks without a display, each in its own kernel, a limited number at a time."""

import asyncio
import os
import re
import shutil
import socket
import sys
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import nbformat
from jupyter_client import AsyncKernelManager
from jupyter_client.kernelspec import KernelSpecManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert.filters import strip_ansi
from nbconvert.preprocessors import ClearOutputPreprocessor, CoalesceStreamsPreprocessor
from tqdm import tqdm

from slamlib import locks, swap
from slamlib.report.progress import Progress
from slamlib.studies.workers import ONE_THREAD
from slamlib.textfile import read_regular

CELL_TIMEOUT = 1800  # s, in which a cell must end
POLL = 1.0  # s, between updates of the progress shown
PREFIX = "slamlib-"  # begins the names of temporary folders, before the process id
TRANSPORT = "ipc" if hasattr(socket, "AF_UNIX") else "tcp"  # Windows has no Unix sockets
LONGEST_FOLDER = 70  # characters; paths of sockets in it have at most 103


class NotebookError(RuntimeError):
    """A notebook failed; the message names the notebook, the position in it and the reason."""


class _Loop(asyncio.SelectorEventLoop):
    """Refuses nbclient's signal handlers, so that Ctrl-C stops all kernels through asyncio."""

    def add_signal_handler(self, *_):
        raise RuntimeError("notebooks install no signal handlers")


def read_notebook(source):
    """Return the NotebookNode in a file (Path), without outputs that an editor saved.

    NotebookError if the file is not a notebook, DatasetError if it is no file that can be read.
    """
    data = read_regular(source)
    try:
        book = nbformat.reads(data.decode("utf-8-sig"), as_version=4)
        return ClearOutputPreprocessor().preprocess(book, {})[0]
    except UnicodeDecodeError as error:
        byte, line = error.object[error.start], data.count(b"\n", 0, error.start) + 1
        reason = f"expected UTF-8 text, found the byte 0x{byte:02x} in line {line}"
    except (ValueError, nbformat.ValidationError) as error:
        reason = str(error).partition("\n")[0]
    except Exception:  # on other JSON nbformat fails in many ways
        reason = "expected JSON with cells and metadata"
    raise NotebookError(f"{source.name} is not a notebook: {reason}")


def kernel_environment(settings, data, datasets, studies):
    """Return the kernels' environment variables (dict of str) without settings that change pages.

    `settings` is a folder for the kernels' own settings, `data` that of the datasets (Path),
    `datasets` the selected names (list of str) or None for all, `studies` the folder (Path) of the
    studies that are kept.
    """
    (settings / "matplotlibrc").write_text("svg.hashsalt: slamlib\n")
    return {"SOURCE_DATE_EPOCH": "0", "PYTHONHASHSEED": "0"} | ONE_THREAD | os.environ | {
        "SLAMLIB_DATA": str(data), "SLAMLIB_DATASETS": "\n".join(datasets or []),
        "SLAMLIB_STUDIES": str(studies.resolve()), "IPYTHONDIR": str(settings),
        "MATPLOTLIBRC": str(settings / "matplotlibrc"),
        "MPLBACKEND": "module://matplotlib_inline.backend_inline"}


@contextmanager
def temporary_folder():
    """Yield a new folder (Path) of this process, and remove those of builds that are gone.

    Its path is short enough for sockets in it.
    """
    parent = tempfile.gettempdir()
    parent = Path("/tmp" if TRANSPORT == "ipc" and len(parent) > LONGEST_FOLDER else parent)
    for old in parent.glob(f"{PREFIX}*-*"):
        process = old.name.split("-")[1]
        if process.isdecimal() and not locks.process_exists(int(process)):
            shutil.rmtree(old, ignore_errors=True)
    with tempfile.TemporaryDirectory(dir=parent, prefix=f"{PREFIX}{os.getpid()}-",
                                     ignore_cleanup_errors=True) as folder:
        yield Path(folder)


def execute(books, environment, results, jobs, finish, seconds):
    """Execute notebooks in place, at most `jobs` at a time; the first failure stops the others.

    Each notebook writes to its own folder inside `results`, SLAMLIB_RESULTS. When it ended without
    error, its files are moved to `results`. NotebookError if a cell failed.

    Parameters
    ----------
    books, environment : dict from Path to NotebookNode; dict of str, the kernels' variables.
    results, jobs : Path, a folder of this build alone, and int.
    finish : function of Path, NotebookNode and the names (list of str) of the result files, called
        after each notebook.
    seconds : the last three parameters of `Progress`, by which it tells the time left.
    """
    try:
        with asyncio.Runner(loop_factory=_Loop) as runner:
            runner.run(_execute_all(books, environment, results, jobs, finish, seconds))
    except ExceptionGroup as group:
        raise group.exceptions[0] from None


async def _execute_all(books, environment, results, jobs, finish, seconds):
    slots = asyncio.Semaphore(jobs)

    async def run(number, source, book):
        stage = results / f".{source.stem}"
        stage.mkdir(parents=True)
        try:
            async with slots:
                files = {"SLAMLIB_RESULTS": str(stage), "SLAMLIB_PROGRESS": str(told / source.stem)}
                await _execute(source, book, environment | files, folder / f"{number}.json",
                               progress)
            progress.keep(source.stem)
            finish(source, book, _publish(stage, results))
        finally:
            shutil.rmtree(stage, ignore_errors=True)

    with temporary_folder() as folder:
        told = folder / "progress"
        told.mkdir()
        progress = Progress(books, jobs, told, *seconds)
        watching = asyncio.create_task(_watch(progress))
        try:
            async with asyncio.TaskGroup() as group:
                for number, (source, book) in reversed([*enumerate(books.items())]):
                    group.create_task(run(number, source, book))    # later chapters take longer
        finally:
            watching.cancel()
            progress.bar.close()


async def _watch(progress):
    while True:
        progress.show()
        await asyncio.sleep(POLL)


def _publish(stage, results):
    """Move all files of a folder to another, and return their names relative to it."""
    names = swap.file_names(stage)
    for name in names:
        (results / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(stage / name, results / name)
    return names


async def _execute(source, book, environment, connection, progress):
    """Execute one notebook in place with the interpreter that runs this module.

    The kernel listens at sockets beside the file `connection` (Path), where the system has them: a
    port that was free when it was chosen can be taken by another program before the kernel has it.
    """
    name, started, start = source.stem, [], time.monotonic()

    def begin(cell, cell_index):
        started.append(cell)
        progress.begin(name)

    manager = AsyncKernelManager(  # no folders to search: kernels of the user are not found
        kernel_name="python3", kernel_spec_manager=KernelSpecManager(kernel_dirs=[]),
        transport=TRANSPORT, connection_file=str(connection))
    client = NotebookClient(
        book, km=manager, resources={"metadata": {"path": str(source.parent)}},
        timeout=CELL_TIMEOUT, iopub_timeout=60, raise_on_iopub_timeout=True,
        record_timing=False, store_widget_state=False, shutdown_kernel="immediate",
        extra_arguments=["--IPKernelApp.log_level=ERROR"],
        on_cell_execute=begin, on_cell_executed=lambda **_: progress.end(name))
    tqdm.write(f"{name}: {len(progress.cells[name])} cells", file=sys.stderr)
    try:
        await client.async_execute(env=environment, cleanup_kc=True)
        CoalesceStreamsPreprocessor().preprocess(book, {})  # kernels divide them by time
    except (CellExecutionError, TimeoutError, RuntimeError) as error:
        if asyncio.current_task().cancelling():  # nbclient reports a cancellation as a dead kernel
            raise asyncio.CancelledError from None
        raise NotebookError(_failure(source, started, error)) from None
    finally:
        if manager.has_kernel:
            await manager.shutdown_kernel(now=True)
    tqdm.write(f"{name}: done in {time.monotonic() - start:.1f} s", file=sys.stderr)


def _failure(source, started, error):
    """Return the notebook, cell, line and reason of a failure, without colours."""
    reason = f"{type(error).__name__}: {error}".splitlines()[0]
    position = source.name + (f", cell {len(started)}" if started else "")
    lines = started[-1].source.splitlines() if started else []
    if isinstance(error, CellExecutionError):
        reason = f"{error.ename}: {error.evalue}"
        frame = re.search(r"Cell In\s?\[\d+\], line (\d+)", strip_ansi(error.traceback))
        if frame and int(frame[1]) <= len(lines):
            position = f"{position}, line {frame[1]}"
            lines = [lines[int(frame[1]) - 1].strip()]
    return strip_ansi("\n    ".join([f"{position}:", *lines[:5]]) + f"\n{reason}")
