"""File locks, which the system releases when the process that holds them ends.

They are taken by flock or, on Windows, by msvcrt.
"""

import os
import sys
import time
from contextlib import ExitStack, contextmanager, suppress

import psutil

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None
    import msvcrt

CAN_REMOVE_OPEN_FILES = fcntl is not None  # not on Windows
LOCKED_BYTE = 1 << 30  # offset in bytes of the byte that msvcrt locks, far behind the text
RETRY_INTERVAL = 0.02  # s, between attempts to take a lock


def process_exists(process):
    """True if there is a process with this id."""
    try:
        return psutil.pid_exists(process)
    except OverflowError:
        return False


@contextmanager
def locked(path):
    """Hold a lock file (Path), which is removed at the end.

    A process that waits for the lock prints which process holds it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = _acquired(path)
    try:
        began = time.strftime("%Y-%m-%d %H:%M:%S")
        file.truncate(0)
        with suppress(OSError):  # the disk is full, which later writes report
            os.write(file.fileno(), f"process {os.getpid()}, which has written to {path.parent} "
                                    f"since {began}".encode())
        yield
    finally:
        if CAN_REMOVE_OPEN_FILES:
            path.unlink(missing_ok=True)
            fcntl.flock(file, fcntl.LOCK_UN)  # closing is not enough where a child has it open
        file.close()
        if not CAN_REMOVE_OPEN_FILES:
            with suppress(OSError):  # another process has it open, and waits for it
                path.unlink(missing_ok=True)


def _acquired(path):
    """Return the open file at this path once its lock is ours."""
    while True:
        with ExitStack() as stack:
            file = stack.enter_context(open(path, "a+"))
            if not try_lock(file):
                file.seek(0)
                print(f"slamlib: waits for {file.read() or 'another process'}", file=sys.stderr)
                while not try_lock(file):
                    time.sleep(RETRY_INTERVAL)
            with suppress(FileNotFoundError):  # the holder removes the file before others have it
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    stack.pop_all()
                    return file


def try_lock(file):
    """Take the lock of an open file if it is free; return (bool) whether it was."""
    try:
        if fcntl:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            os.lseek(file.fileno(), LOCKED_BYTE, os.SEEK_SET)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    except (BlockingIOError, PermissionError):
        return False
    return True
