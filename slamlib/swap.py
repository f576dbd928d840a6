"""Files that runs leave: staged in a folder of the run's own, then swapped in as one set.

No system renames the files of several folders at once, so `publish` removes the old set before it
moves in the new one: files of two runs are never side by side, at whichever step the process is
killed. UNFINISHED.txt is there from before the first of these steps until after the last, and the
file that sums up the set, as summary.json, goes first and comes last, so it is only there with all.

`.slamlib.json` in a folder names the files of its set; whatever else is there is the user's and
stays. Windows neither removes nor replaces a file that is open.
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

from slamlib.locks import REMOVABLE, locked, runs, take

MARKER = "UNFINISHED.txt"
SENTENCE = ("A run writes the files of this folder, or was ended while it did so: "
            "they are not complete. Run it again.\n")
WRITTEN = ".slamlib.json"  # the names of a set's files
LOCK = ".slamlib.lock"
STAGE = ".slamlib-stage-"  # and a number
ENDS = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))


class UnfinishedError(RuntimeError):
    """A folder holds a part of its files; the message names it."""


@dataclass(frozen=True)
class Set:
    """What one run writes to one folder."""

    folder: Path
    files: dict  # from name, as `problem1/vehiclePose.mat`, to the Path of the staged file
    last: str | None = None  # name of the file that sums up the others
    ours: frozenset = frozenset()  # names that are no user's, whoever wrote them


def write(path, content):
    """Write bytes to a Path; a reader finds the old file or the whole new one, never a part.

    OSError names the path, also where a disk is full.
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
    """Remove what processes that are gone left of `write` to this path."""
    for file in path.parent.glob(f".{glob.escape(path.name)}.*"):
        process = file.name.rpartition(".")[2]
        if process.isdecimal() and not runs(int(process)):
            file.unlink(missing_ok=True)


@contextmanager
def staging(folder):
    """Yield a new empty folder (Path) of this process in `folder`, and remove it at the end.

    Those of processes that are gone are removed first. The lowest free number makes its name, so
    that runs which follow each other have the same paths.
    """
    folder = Path(folder)
    with locked(folder / LOCK):
        for stage in folder.glob(f"{STAGE}*"):
            if not _held(stage):
                shutil.rmtree(stage, ignore_errors=True)
        stage = next(path for n in count(1) if not (path := folder / f"{STAGE}{n}").exists())
        (stage / "files").mkdir(parents=True)
        file = open(stage / LOCK, "w")
        take(file)
    try:
        yield stage / "files"
    finally:
        with nullcontext() if REMOVABLE else locked(folder / LOCK):  # nobody else takes its number
            if not REMOVABLE:
                file.close()
            shutil.rmtree(stage, ignore_errors=True)
            file.close()


def _held(stage):
    """True if the process that made a folder by `staging` is still there."""
    try:
        with open(stage / LOCK, "r+") as file:
            return not take(file)
    except OSError:
        return False


def require_staged(stage):
    """Raise OSError if somebody removed this folder by `staging`, and with it files of this run."""
    if not (stage.parent / LOCK).exists():
        raise FileNotFoundError(
            errno.ENOENT, "was removed while a run wrote to it", str(stage.parent))


def names(folder):
    """Sorted names (list of str) of all files in a folder (Path), relative to it."""
    return [file.relative_to(folder).as_posix()
            for file in sorted(folder.rglob("*")) if file.is_file()]


def require_finished(folder):
    """Raise UnfinishedError if the files of a run in this folder (Path) are not complete."""
    if (folder / MARKER).exists():
        raise UnfinishedError(f"{folder}: expected the files of a run that ended well; {MARKER} "
                              "says that it did not: run it again")


def publish(sets):
    """Replace the files that earlier runs wrote by those of each Set, all sets as one.

    Until the first file is removed nothing has changed: by then all that needs space on the disk,
    and all folders, are there. OSError if a file cannot be put in its place.
    """
    with ExitStack() as stack:
        sets = [each for each in sets
                if each.files or any((each.folder / name).exists() for name in [
                    MARKER, *_old(each)])]
        pairs = [(each, stack.enter_context(staging(each.folder))) for each in sets]
        for folder in sorted({each.folder for each in sets}):  # in this order by all processes
            stack.enter_context(locked(folder / LOCK))
        for each in sets:
            _check(each)
        for each, control in pairs:
            _prepare(each, control)
        with _undisturbed():
            for step in (_mark, _remove_old, _move_new, _finish):
                for each, control in pairs:
                    step(each, control)


@contextmanager
def _undisturbed():
    """Let signals that handlers of this process turn into an end wait until the block is done."""
    waiting, handlers = [], {}
    if threading.current_thread() is threading.main_thread():
        handlers = {number: handler for number in (signal.SIGINT, *ENDS)
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


def _check(each):
    """Raise OSError where a file cannot be put in its place, or an earlier one not be removed."""
    for name, staged in each.files.items():
        target = each.folder / name
        parent = next(folder for folder in target.parents if folder.exists())
        if not parent.is_dir():
            raise _os_error(errno.ENOTDIR, parent)
        if parent.stat().st_dev != staged.stat().st_dev:
            raise _os_error(errno.EXDEV, target)
        if target.is_dir():
            raise _os_error(errno.EISDIR, target)
    for name in () if REMOVABLE else sorted(_old(each)):  # one that a program shows stays as it is
        with suppress(FileNotFoundError):
            open(each.folder / name, "r+b").close()
    for folder in sorted({(each.folder / name).parent for name in _old(each) | each.files.keys()}):
        if folder.is_dir() and not os.access(folder, os.W_OK):
            raise _os_error(errno.EACCES, folder)


def _prepare(each, control):
    """Stage the control files, name all files that may be found from now on, and make folders."""
    write(control / MARKER, SENTENCE.encode())
    write(control / "after", json.dumps(sorted(each.files)).encode())
    write(control / WRITTEN, json.dumps(sorted(_old(each) | each.files.keys())).encode())
    os.replace(control / WRITTEN, each.folder / WRITTEN)
    for name in each.files:
        (each.folder / name).parent.mkdir(parents=True, exist_ok=True)


def _os_error(number, path):
    return OSError(number, os.strerror(number), str(path))


def _mark(each, control):
    os.replace(control / MARKER, each.folder / MARKER)


def _remove_old(each, control):
    for name in sorted(_old(each), key=lambda name: name != each.last):
        path = each.folder / name
        _remove_temporaries(path)
        if path.is_symlink() or path.is_file():
            path.unlink()


def _move_new(each, control):
    for name in sorted(each.files, key=lambda name: name == each.last):
        os.replace(each.files[name], each.folder / name)


def _finish(each, control):
    folders = {parent for name in _old(each) for parent in PurePosixPath(name).parents[:-1]}
    for folder in sorted(folders, reverse=True):
        with suppress(OSError):  # it is not empty
            (each.folder / folder).rmdir()
    os.replace(control / "after", each.folder / WRITTEN)
    (each.folder / MARKER).unlink(missing_ok=True)


def _old(each):
    """Names (set of str) of all files in a set's folder that may be a run's, also removed ones."""
    file = each.folder / WRITTEN
    try:
        written = json.loads(file.read_bytes()) if file.is_file() else []
    except (ValueError, RecursionError):
        written = []                    # not ours: what it should name is the user's
    return {name for name in (written if isinstance(written, list) else ())
            if isinstance(name, str) and name and "\0" not in name
            and ".." not in PurePath(name).parts and not PurePath(name).anchor} | each.ours
