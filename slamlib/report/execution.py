"""Executes notebooks without a display, each in its own kernel, a limited number at a time."""

import asyncio
import os
import time
from collections.abc import Callable
from copy import deepcopy
from functools import partialmethod
from pathlib import Path
from tempfile import TemporaryDirectory

from jupyter_client import AsyncKernelClient, AsyncKernelManager
from jupyter_client.kernelspec import KernelSpecManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert.filters import strip_ansi
from nbconvert.preprocessors import CoalesceStreamsPreprocessor

from slamlib.report.notebooks import LAB_ONLY, Books, NotebookError

JOBS = 2      # notebooks at a time
# Pages are equal every time. The matrices are small: more threads cost time.
DEFAULTS = {"SOURCE_DATE_EPOCH": "0", "PYTHONHASHSEED": "0", "OPENBLAS_NUM_THREADS": "1",
            "OMP_NUM_THREADS": "1"}


class _Client(AsyncKernelClient):
    """Has no heartbeat: its thread may wake up after its socket was closed with the kernel."""

    start_channels = partialmethod(AsyncKernelClient.start_channels, hb=False)


class _Loop(asyncio.SelectorEventLoop):
    """Refuses nbclient's signal handlers, so that Ctrl-C stops all kernels through asyncio."""

    def add_signal_handler(self, *_):
        raise RuntimeError("notebooks install no signal handlers")


def execute(books: Books, data: Path, datasets: list[str], results: dict[Path, Path],
            finish: Callable):
    """Execute those of some notebooks that have `results`; the first failure stops the others.

    `data` is the folder of the datasets, of which kernels select those that are named. Each
    notebook writes its files to its own folder, SLAMLIB_RESULTS, of `results`. When one has ended,
    finish(Path, the executed notebook, seconds) is called. NotebookError if a cell failed.
    """
    with TemporaryDirectory(ignore_cleanup_errors=True) as settings:
        environment = DEFAULTS | os.environ | {
            "SLAMLIB_DATA": str(data),
            "SLAMLIB_DATASETS": "\n".join(datasets),
            "IPYTHONDIR": settings,                              # without those of the user
            "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
        try:
            with asyncio.Runner(loop_factory=_Loop) as runner:
                runner.run(_execute_all(books, environment, results, finish))
        except ExceptionGroup as group:
            raise group.exceptions[0] from None


async def _execute_all(books, environment, results, finish):
    slots = asyncio.Semaphore(JOBS)

    async def run(source):
        executed = deepcopy(books[source])
        own = environment | {"SLAMLIB_RESULTS": str(results[source])}
        async with slots:
            start = time.monotonic()
            await _execute(source, executed, own)
            finish(source, executed, time.monotonic() - start)

    async with asyncio.TaskGroup() as group:
        for source in reversed(results):                         # later chapters take longer
            group.create_task(run(source))


async def _execute(source, book, environment):
    """Execute one notebook in place with this interpreter."""
    manager = AsyncKernelManager(
        kernel_name="python3", client_factory=_Client,
        kernel_spec_manager=KernelSpecManager(kernel_dirs=[]))  # no kernels of the user are found
    client = NotebookClient(
        book, km=manager, resources={"metadata": {"path": str(source.parent)}},
        iopub_timeout=60, raise_on_iopub_timeout=True, record_timing=False,
        skip_cells_with_tag=LAB_ONLY,
        shutdown_kernel="immediate", extra_arguments=["--IPKernelApp.log_level=ERROR"])
    try:
        await client.async_execute(env=environment, cleanup_kc=True)
    except (CellExecutionError, TimeoutError, RuntimeError) as error:
        if asyncio.current_task().cancelling():  # nbclient reports a cancellation as a dead kernel
            raise asyncio.CancelledError from None
        raise NotebookError(f"{source.name}: {strip_ansi(str(error)).strip()}") from None
    finally:
        if manager.has_kernel:
            await manager.shutdown_kernel(now=True)
    CoalesceStreamsPreprocessor().preprocess(book, {})  # kernels divide them by time
