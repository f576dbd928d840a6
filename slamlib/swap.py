"""Stages the files of a run in a folder of its own, then swaps them in as one set.

No system renames the files of several folders at once, so `publish` removes the old set before it
moves in the new one: files of two runs are never side by side, whenever the process is killed.
UNFINISHED.txt exists from before the first of these steps until after the last. The file that sums
up the set, such as summary.json, is removed first and moved in last, so it exists only with all.

`.slamlib.json` in a folder names the files of its set; all others are the user's and stay.
Windows neither removes nor replaces a file that is open.
"""

import errno
import glob
import json
import os
import shutil
import signal
import threading
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path, PurePath, PurePosixPath

from slamlib.locks import CAN_REMOVE_OPEN_FILES, locked, process_exists, try_lock

UNFINISHED = "UNFINISHED.txt"  # exists while the files of a folder are not complete
UNFINISHED_TEXT = ("A run writes the files of this folder, or was ended while it did so: "
            "they are not complete. Run it again.\n")
FILE_LIST = ".slamlib.json"  # holds the names of a set's files
LOCK = ".slamlib.lock"  # in a folder that is written to, and in the stage of a process
STAGE = ".slamlib-stage-"  # and a number
# Signals that end a process; Windows has no SIGHUP.
END_SIGNALS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP")
                    if hasattr(signal, name))


class UnfinishedError(RuntimeError):
    """A folder holds a part of its files; the message names it."""


@dataclass(frozen=True)
class FileSet:
    """The files that one run writes to one folder."""

    folder: Path
    files: dict  # Path of the staged file by name, as `problem1/vehiclePose.mat`
    last: str | None = None  # name of the file that sums up the others
    ours: frozenset = frozenset()  # names that are never a user's


def write_atomically(path, content):
    """Write bytes to a Path; a reader finds the old file or the whole new one, never a part.

    Raises OSError, which names the path, also if the disk is full.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_temporaries(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        if error.filename or not error.errno:
            raise
        raise _os_error(error.errno, path) from None
    finally:
        temporary.unlink(missing_ok=True)


def _remove_temporaries(path):
    """Remove temporary files of `write_atomically` to this path by processes that ended."""
    for file in path.parent.glob(f".{glob.escape(path.name)}.*"):
        process = file.name.rpartition(".")[2]
        if process.isdecimal() and not process_exists(int(process)):
            file.unlink(missing_ok=True)


@contextmanager
def staging(folder):
    """Yield a new empty folder (Path) of this process in `folder`, and remove it at the end.

    Folders of processes that ended are removed first. The name has the lowest free number, so that
    consecutive runs have the same paths.
    """
    folder = Path(folder)
    with locked(folder / LOCK):
        for stage in folder.glob(f"{STAGE}*"):
            if not _held(stage):
                shutil.rmtree(stage, ignore_errors=True)
        stage = next(path for n in count(1) if not (path := folder / f"{STAGE}{n}").exists())
        (stage / "files").mkdir(parents=True)
        file = open(stage / LOCK, "w")
        try_lock(file)
    try:
        yield stage / "files"
    finally:
        # Without the lock another process could take the number while no file of it is open.
        with nullcontext() if CAN_REMOVE_OPEN_FILES else locked(folder / LOCK):
            if not CAN_REMOVE_OPEN_FILES:
                file.close()
            shutil.rmtree(stage, ignore_errors=True)
            file.close()


def _held(stage):
    """True if the process that made a folder by `staging` still exists."""
    try:
        with open(stage / LOCK, "r+") as file:
            return not try_lock(file)
    except OSError:
        return False


def require_staged(stage):
    """Raise OSError if this folder by `staging` was removed, and with it files of this run."""
    if not (stage.parent / LOCK).exists():
        raise FileNotFoundError(
            errno.ENOENT, "was removed while a run wrote to it", str(stage.parent))


def file_names(folder):
    """Sorted names (list of str) of all files in a folder (Path), relative to it."""
    return [file.relative_to(folder).as_posix()
            for file in sorted(folder.rglob("*")) if file.is_file()]


def require_finished(folder):
    """Raise UnfinishedError if the files of a run in this folder (Path) are not complete."""
    if (folder / UNFINISHED).exists():
        raise UnfinishedError(f"{folder}: expected the files of a run that ended well; "
                              f"{UNFINISHED} says that it did not: run it again")


def publish(sets):
    """Replace the files that earlier runs wrote by those of each FileSet, all sets as one.

    All folders, and all that needs space on the disk, are made before the first file is removed.
    Raises OSError if a file cannot be put in its place.
    """
    with ExitStack() as stack:
        sets = [file_set for file_set in sets if file_set.files or any(
            (file_set.folder / name).exists() for name in [UNFINISHED, *_earlier_names(file_set)])]
        pairs = [(file_set, stack.enter_context(staging(file_set.folder))) for file_set in sets]
        for folder in sorted({file_set.folder for file_set in sets}):  # all processes in this order
            stack.enter_context(locked(folder / LOCK))
        for file_set in sets:
            _check(file_set)
        for file_set, control in pairs:
            _prepare(file_set, control)
        with _signals_delayed():
            for step in (_mark, _remove_old, _move_new, _finish):
                for file_set, control in pairs:
                    step(file_set, control)


@contextmanager
def _signals_delayed():
    """Delay signals that have handlers in this process until the end of the block."""
    waiting, handlers = [], {}
    if threading.current_thread() is threading.main_thread():
        handlers = {number: handler for number in (signal.SIGINT, *END_SIGNALS)
                    if callable(handler := signal.getsignal(number))}
    for number in handlers:
        signal.signal(number, lambda number, _: waiting.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in waiting:
            signal.raise_signal(number)


def _check(file_set):
    """Raise OSError if a file cannot be put in its place, or an earlier one cannot be removed."""
    for name, staged in file_set.files.items():
        target = file_set.folder / name
        parent = next(folder for folder in target.parents if folder.exists())
        if not parent.is_dir():
            raise _os_error(errno.ENOTDIR, parent)
        if parent.stat().st_dev != staged.stat().st_dev:
            raise _os_error(errno.EXDEV, target)
        if target.is_dir():
            raise _os_error(errno.EISDIR, target)
    for name in () if CAN_REMOVE_OPEN_FILES else sorted(_earlier_names(file_set)):
        with suppress(FileNotFoundError):        # PermissionError if a program has it open
            open(file_set.folder / name, "r+b").close()
    for folder in sorted({(file_set.folder / name).parent for name in _all_names(file_set)}):
        if folder.is_dir() and not os.access(folder, os.W_OK):
            raise _os_error(errno.EACCES, folder)


def _prepare(file_set, control):
    """Stage the control files, list old and new files in FILE_LIST, and make folders."""
    write_atomically(control / UNFINISHED, UNFINISHED_TEXT.encode())
    write_atomically(control / "after", json.dumps(sorted(file_set.files)).encode())
    write_atomically(control / FILE_LIST, json.dumps(sorted(_all_names(file_set))).encode())
    os.replace(control / FILE_LIST, file_set.folder / FILE_LIST)
    for name in file_set.files:
        (file_set.folder / name).parent.mkdir(parents=True, exist_ok=True)


def _os_error(number, path):
    return OSError(number, os.strerror(number), str(path))


def _mark(file_set, control):
    os.replace(control / UNFINISHED, file_set.folder / UNFINISHED)


def _remove_old(file_set, control):
    for name in sorted(_earlier_names(file_set), key=lambda name: name != file_set.last):
        path = file_set.folder / name
        _remove_temporaries(path)
        if path.is_symlink() or path.is_file():
            path.unlink()


def _move_new(file_set, control):
    for name in sorted(file_set.files, key=lambda name: name == file_set.last):
        os.replace(file_set.files[name], file_set.folder / name)


def _finish(file_set, control):
    folders = {parent for name in _earlier_names(file_set)
               for parent in PurePosixPath(name).parents[:-1]}
    for folder in sorted(folders, reverse=True):
        with suppress(OSError):  # it is not empty
            (file_set.folder / folder).rmdir()
    os.replace(control / "after", file_set.folder / FILE_LIST)
    (file_set.folder / UNFINISHED).unlink(missing_ok=True)


def _all_names(file_set):
    return _earlier_names(file_set) | file_set.files.keys()


def _earlier_names(file_set):
    """Names (set of str) of files of earlier runs in a set's folder, also of removed ones."""
    file = file_set.folder / FILE_LIST
    try:
        written = json.loads(file.read_bytes()) if file.is_file() else []
    except (ValueError, RecursionError):
        written = []                    # not written by slamlib
    return {name for name in (written if isinstance(written, list) else ())
            if isinstance(name, str) and name and "\0" not in name
            and ".." not in PurePath(name).parts and not PurePath(name).anchor} | file_set.ours
