"""Writes the files of a run beside a folder, then swaps whole folders.

Files of two runs are never side by side, whenever a process is killed: old folders are moved aside,
then new ones are moved in. If the run is killed in between, a folder is missing until the next run;
the user's files are in the one that was moved aside, and return with that run.
"""

import json
import os
import shutil
import sys
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

FILE_LIST = ".slamlib.json"  # names the files of a run in their folder; all others are the user's


def beside(path: Path, what: str) -> Path:
    """The hidden path of a kind, such as "lock", beside a path."""
    return path.with_name(f".{path.name}.{what}")


@contextmanager
def locked(folder: Path):
    """Hold the lock of a folder; a process that waits for it says so.

    The system releases it when the process that holds it ends.
    """
    file = beside(folder, "lock")
    file.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(file)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        print(f"slamlib: waits for another run, which writes to {folder}", file=sys.stderr)
        lock.acquire()
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes no open file
            file.unlink()
        lock.release()


def write_atomically(path: Path, content: bytes):
    """Write a file; a reader finds the old file or the whole new one, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = beside(path, "part")
    try:
        part.write_bytes(content)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)


@contextmanager
def staging(folder: Path | str):
    """Yield a new empty folder (Path) beside `folder`, which is removed at the end.

    One run at a time has it, and another one waits. Raises OSError if `folder` is a file.
    """
    folder = Path(folder).resolve()
    if folder.exists():
        os.listdir(folder)
    stage = beside(folder, "new")
    with locked(folder):
        shutil.rmtree(stage, ignore_errors=True)        # of a run that was killed
        stage.mkdir()
        try:
            yield stage
        finally:
            shutil.rmtree(stage, ignore_errors=True)


def file_names(folder: Path) -> list[str]:
    """Sorted names of all files in a folder, relative to it."""
    return [file.relative_to(folder).as_posix()
            for file in sorted(folder.rglob("*")) if file.is_symlink() or not file.is_dir()]


def publish(made: dict, ours=()):
    """Put new folders in the place of those of earlier runs, all as one; the user's files stay.

    All that needs space on the disk is written before the first folder is moved.

    Parameters
    ----------
    made : dict from each folder (Path) to the new one (Path), on the same file system.
    ours : names of files that are never a user's, besides those that FILE_LIST names.

    Raises
    ------
    OSError : a file cannot be written or put in its place; in the first case nothing has changed.
    """
    made = {Path(folder).resolve(): new for folder, new in made.items()}
    for folder, new in made.items():
        _add_the_users_files(folder, new, ours)
    for folder in made:
        if folder.exists():
            shutil.rmtree(beside(folder, "old"), ignore_errors=True)
            folder.rename(beside(folder, "old"))
    for folder, new in made.items():
        folder.parent.mkdir(parents=True, exist_ok=True)
        new.rename(folder)
    for folder in made:
        shutil.rmtree(beside(folder, "old"), ignore_errors=True)
        with suppress(OSError):
            folder.rmdir()                              # if it is empty


def _add_the_users_files(folder, new, ours):
    """Copy the files that no run wrote from a folder, and of a killed run's, to the new one."""
    new.mkdir(exist_ok=True)
    made = file_names(new)
    for source in (beside(folder, "old"), folder):
        if not source.exists():
            continue
        for name in set(file_names(source)).difference([FILE_LIST], ours, made, _listed(source)):
            if name.endswith(".part") and Path(name).name.startswith("."):
                continue                                # of a killed `write_atomically`
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / name, new / name, follow_symlinks=False)
            shutil.copystat(source / name, new / name, follow_symlinks=False)
    if made:
        (new / FILE_LIST).write_text(json.dumps(made))


def _listed(folder):
    """Names (set) in the FILE_LIST of a folder, none if there is no list or it is damaged."""
    try:
        return set(json.loads((folder / FILE_LIST).read_bytes()))
    except (OSError, ValueError, TypeError):
        return set()
