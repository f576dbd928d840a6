"""Files of results and pages: each is written whole, by one process at a time in a folder."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from slamlib.core.errors import DatasetError

LOCK = ".slamlib.lock"  # name of the file in a folder whose holder writes there
LOCK_TIME = 60.0  # s, after which a process no longer waits for another one


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which is made if there is none.

    Raises DatasetError if nothing can be written there, or another process holds the lock for
    LOCK_TIME. The system releases it when the process that holds it ends.
    """
    file = folder / LOCK
    lock = FileLock(file, timeout=LOCK_TIME)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout:
        raise DatasetError(f"{folder}: expected no other run that writes here, and one did for "
                           f"{LOCK_TIME:g} s: try again when it has ended") from None
    except OSError as error:
        raise DatasetError(
            f"{folder}: expected a folder to write to ({error.strerror})") from None
    try:
        yield
    finally:
        file.unlink()
        lock.release()


def write_file(path: Path, content: bytes):
    """Write a file; a reader finds the old file or the whole new one, never a part.

    Raises DatasetError if it cannot be written.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content)
        os.replace(part, path)
    except OSError as error:
        raise DatasetError(
            f"{path}: expected a file that can be written ({error.strerror})") from None
    finally:
        with suppress(OSError):
            part.unlink()
