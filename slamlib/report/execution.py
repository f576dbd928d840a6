"""Executes notebooks without a display, each in its own kernel, a limited number at a time.

JupyterLab starts with the same settings and the same kept studies.
"""

import asyncio
import json
import os
import re
import shutil
import socket
import sys
import time
from importlib.util import find_spec
from pathlib import Path

from jupyter_client import AsyncKernelManager
from jupyter_client.kernelspec import KernelSpecManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert.filters import strip_ansi
from nbconvert.preprocessors import CoalesceStreamsPreprocessor
from tqdm import tqdm

from slamlib.core.errors import require
from slamlib.io import swap
from slamlib.studies.runs import ONE_THREAD

CELL_TIMEOUT = 1800  # s, in which a cell must end
TRANSPORT = "ipc" if hasattr(socket, "AF_UNIX") else "tcp"  # Windows has no Unix sockets
LAB_ONLY = "lab-only"  # tag of cells that are not executed, and not shown on pages or in the PDF
STUDIES = "studies"  # in the cache, besides executed notebooks
SETTINGS = "settings"  # there, too: of kernels, and JupyterLab's where the user has no others
OVERRIDES = {"@jupyterlab/apputils-extension:notification": {
    "fetchNews": "false", "checkForUpdates": False}}  # without a question when it opens


class NotebookError(RuntimeError):
    """A notebook failed; the message names the notebook, the position in it and the reason."""


class _Loop(asyncio.SelectorEventLoop):
    """Refuses nbclient's signal handlers, so that Ctrl-C stops all kernels through asyncio."""

    def add_signal_handler(self, *_):
        raise RuntimeError("notebooks install no signal handlers")


def kernel_environment(settings, data, datasets, studies):
    """Return the kernels' environment variables (dict of str) without settings that change pages.

    `settings`, `data` and `studies` (Path) are the folders of the kernels' own settings, of the
    datasets and of the studies that are kept, `datasets` the selected names (list of str) or None.
    """
    (settings / "matplotlibrc").write_text("svg.hashsalt: slamlib\n")
    return {"SOURCE_DATE_EPOCH": "0", "PYTHONHASHSEED": "0"} | ONE_THREAD | os.environ | {
        "SLAMLIB_DATA": str(data), "SLAMLIB_DATASETS": "\n".join(datasets or []),
        "SLAMLIB_STUDIES": str(studies.resolve()), "IPYTHONDIR": str(settings),
        "MATPLOTLIBRC": str(settings / "matplotlibrc"),
        "MPLBACKEND": "module://matplotlib_inline.backend_inline"}


def execute(books, environment, results, jobs, finish):
    """Execute notebooks in place, at most `jobs` at a time; the first failure stops the others.

    Each of `books` (dict from Path to NotebookNode) writes to its own folder, SLAMLIB_RESULTS. When
    it ended without error, its files are moved to `results` (Path), a folder of this build alone,
    and finish(Path, NotebookNode, names of the files) is called. NotebookError if a cell failed.
    """
    try:
        with asyncio.Runner(loop_factory=_Loop) as runner:
            runner.run(_execute_all(books, environment, results, jobs, finish))
    except ExceptionGroup as group:
        raise group.exceptions[0] from None


async def _execute_all(books, environment, results, jobs, finish):
    slots, settings = asyncio.Semaphore(jobs), Path(environment["IPYTHONDIR"])
    cells = sum(cell.cell_type == "code" for book in books.values() for cell in book.cells)

    async def run(number, source, book):
        stage = results / f".{source.stem}"
        stage.mkdir(parents=True)
        try:
            async with slots:
                await _execute(source, book, environment | {"SLAMLIB_RESULTS": str(stage)},
                               settings / f"{number}.json", bar)
            names = swap.file_names(stage)
            for name in names:
                (results / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(stage / name, results / name)
            finish(source, book, names)
        finally:
            shutil.rmtree(stage, ignore_errors=True)

    with tqdm(total=cells, unit="cell", leave=False, disable=None) as bar:  # on a terminal only
        async with asyncio.TaskGroup() as group:
            for number, (source, book) in reversed([*enumerate(books.items())]):
                group.create_task(run(number, source, book))        # later chapters take longer


async def _execute(source, book, environment, connection, bar):
    """Execute one notebook in place with this interpreter.

    The kernel listens at sockets beside the file `connection` (Path): nobody else can take them.
    """
    started, start = [], time.monotonic()
    manager = AsyncKernelManager(  # no folders to search: kernels of the user are not found
        kernel_name="python3", kernel_spec_manager=KernelSpecManager(kernel_dirs=[]),
        transport=TRANSPORT, connection_file=str(connection))
    client = NotebookClient(
        book, km=manager, resources={"metadata": {"path": str(source.parent)}},
        timeout=CELL_TIMEOUT, iopub_timeout=60, raise_on_iopub_timeout=True,
        record_timing=False, store_widget_state=False, skip_cells_with_tag=LAB_ONLY,
        shutdown_kernel="immediate", extra_arguments=["--IPKernelApp.log_level=ERROR"],
        on_cell_execute=lambda cell, **_: started.append(cell),
        on_cell_executed=lambda **_: bar.update())
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
    tqdm.write(f"{source.stem}: executed in {time.monotonic() - start:.1f} s", file=sys.stderr)


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


def start_lab(notebooks, data, kept, arguments):
    """Replace this process by JupyterLab with its `arguments`; folders as of `build_report`."""
    require(find_spec("jupyterlab"), "lab", "JupyterLab, as by pip install jupyterlab", "none")
    settings = kept.resolve() / SETTINGS
    settings.mkdir(parents=True, exist_ok=True)
    (settings / "overrides.json").write_text(json.dumps(OVERRIDES))
    options = [f"--LabApp.app_settings_dir={settings}",
               "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate"]
    # As in containers; JupyterLab listens to this machine alone. Windows has no such numbers.
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        options.append("--allow-root")
    selected = os.environ.get("SLAMLIB_DATASETS", "").split("\n")
    os.execve(sys.executable,
              [sys.executable, "-m", "jupyterlab", *options, *arguments, str(notebooks)],
              kernel_environment(settings, data.resolve(), selected, kept / STUDIES))
