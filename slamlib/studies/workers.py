"""Processes for trials, connected by pipes only; none outlives its parent, no semaphore remains.

Process pools have named semaphores, which stay in shared memory if a kernel is killed, and workers
that outlive it. A pipe is closed when the process at its other end ends.
"""

import atexit
import os
import pickle
import signal
import subprocess
import sys
import traceback
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from queue import SimpleQueue

from joblib import wrap_non_picklable_objects

# The matrices are small: more threads cost time.
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
COMMAND = "from slamlib.studies.workers import _serve; _serve()"
WAITING = {}  # by process (Popen) that waits for a study, the environment of its start


def rows(trial, seeds, options, jobs):
    """Yield what trial(seed, **options) returns for each of `seeds` (list of int), in their order.

    With more than one of `jobs` the trials run in further processes with one thread each. Raises
    the exception of a trial, and RuntimeError if one of these processes is killed.
    """
    if jobs == 1:
        yield from (trial(seed, **options) for seed in seeds)
        return
    trial = wrap_non_picklable_objects(trial, keep_wrapper=False)  # one that a notebook defines
    with ExitStack() as stack:
        idle = SimpleQueue()
        for _ in range(min(jobs, len(seeds))):
            idle.put(stack.enter_context(_worker()))

        def row(seed):
            worker = idle.get()
            try:
                return _answer(worker, (trial, seed, options))
            finally:
                idle.put(worker)

        yield from stack.enter_context(ThreadPoolExecutor(jobs)).map(row, seeds)


@contextmanager
def _worker():
    """Context of a process (Popen) with the import path of this one.

    Later it waits for the next study, which saves the imports, until this process ends. If it owes
    an answer it ends at once.
    """
    environment = ONE_THREAD | os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    worker = next((process for process, started_in in WAITING.items()
                   if started_in == environment and process.poll() is None), None)
    if worker is None:
        worker = subprocess.Popen([sys.executable, "-c", COMMAND], env=environment,
                                  stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        worker.owes = False
    WAITING.pop(worker, None)
    try:
        yield worker
    finally:
        if worker.owes or worker.poll() is not None:
            _end(worker)
        else:
            WAITING[worker] = environment


def _end(worker):
    with suppress(OSError):                                 # unread input, if it was killed
        worker.stdin.close()
    worker.stdout.close()
    worker.wait()


@atexit.register
def _end_all():
    for worker in WAITING:
        _end(worker)


def _answer(worker, call):
    """What a worker returns for a call, a tuple (trial, seed, options)."""
    worker.owes = True
    try:
        pickle.dump(call, worker.stdin)
        worker.stdin.flush()
        answer = pickle.load(worker.stdout)
        worker.owes = False
    except (EOFError, OSError, pickle.UnpicklingError):
        raise RuntimeError("a process that ran a study ended, "
                           f"with exit code {worker.wait()}") from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def _serve():
    """Answer the calls that stdin brings, on stdout, until either end of a pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)            # which interrupts the parent, too
    with suppress(EOFError, OSError), os.fdopen(os.dup(1), "wb") as answers:
        os.dup2(2, 1)                                       # stdout carries answers only
        while True:
            trial, seed, options = pickle.load(sys.stdin.buffer)
            try:
                answer = trial(seed, **options)
            except Exception as error:
                error.add_note(traceback.format_exc())
                answer = error
            pickle.dump(answer, answers)
            answers.flush()
