"""Locks of files, which the system releases however the process that holds them ends.

They are those of flock or, on Windows, of msvcrt.
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

REMOVABLE = fcntl is not None  # are files that are open; on Windows they are not
BYTE = 1 << 30  # of a file, far behind its text, is what msvcrt locks
WAIT = 0.02  # s, between attempts to take a lock


def runs(process):
    """True if there is a process with this id."""
    try:
        return psutil.pid_exists(process)
    except OverflowError:
        return False


@contextmanager
def locked(path):
    """Hold a lock file (Path) that is removed at the end; a process that waits says for which."""
    path.parent.mkdir(parents=True, exist_ok=True)
    file = _acquired(path)
    try:
        began = time.strftime("%Y-%m-%d %H:%M:%S")
        file.truncate(0)
        with suppress(OSError):  # a full disk is told by whoever writes more
            os.write(file.fileno(), f"process {os.getpid()}, which has written to {path.parent} "
                                    f"since {began}".encode())
        yield
    finally:
        if REMOVABLE:
            path.unlink(missing_ok=True)
            fcntl.flock(file, fcntl.LOCK_UN)  # closing is not enough where a child has it open
        file.close()
        if not REMOVABLE:
            with suppress(OSError):  # another process has it open, and waits for it
                path.unlink(missing_ok=True)


def _acquired(path):
    """Return the open file at this path once its lock is ours."""
    while True:
        with ExitStack() as stack:
            file = stack.enter_context(open(path, "a+"))
            if not take(file):
                file.seek(0)
                print(f"slamlib: waits for {file.read() or 'another process'}", file=sys.stderr)
                while not take(file):
                    time.sleep(WAIT)
            with suppress(FileNotFoundError):  # the holder removes the file before others have it
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    stack.pop_all()
                    return file


def take(file):
    """Take the lock of an open file if it is free; return (bool) whether it was."""
    try:
        if fcntl:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        else:
            os.lseek(file.fileno(), BYTE, os.SEEK_SET)
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    except (BlockingIOError, PermissionError):
        return False
    return True
