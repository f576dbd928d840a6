"""Kills a run before each of its steps, and prints a line of counts for each kind of run.

A part of test_concurrency.py. Runs are forks of this process, so that none waits for imports; it
imports no more than they need, because a large process forks slowly. A folder that a run of A or B
writes to is judged by the bytes that undisturbed runs wrote.
"""

import json
import os
import re
import shutil
import signal
import sys
import tempfile
from collections import Counter
from itertools import product
from pathlib import Path

from slamlib import solve
from slamlib.__main__ import main
from slamlib.io import swap
from slamlib.io.dataset import read_dataset
from slamlib.studies.simulation import simulate, write_dataset

STEPS = {"os.rename", "os.remove", "os.mkdir", "os.rmdir"}      # audit events, also of pathlib
MINE = {"notes.txt": "of the user", "mine/data.mat": "mine", "problem1/notes.txt": "too"}


def run(function, name, at_step=None):
    """Exit code of a fork that runs function(name), -9 if it killed itself before a step."""
    process = os.fork()
    if process:
        return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    code = 9
    try:
        for number in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        if at_step is not None:
            _kill_at(at_step)
        code = function(name)
    finally:
        os._exit(code)


def _kill_at(step):
    here, count = os.getpid(), 0

    def hook(event, _):
        nonlocal count
        if event in STEPS and os.getpid() == here:
            count += 1
            if count == step:
                os.kill(here, signal.SIGKILL)

    sys.addaudithook(hook)


def contents(folder):
    """Bytes of the files in a folder by name, without hidden ones and the times in a summary."""
    return {name: re.sub(rb'"seconds": [^\n]*', b"", (folder / name).read_bytes())
            for name in swap.file_names(folder) if not Path(name).name.startswith(".")}


def solves(root, one):
    """The command solve, of two drives whose problems are solved once: only files are written."""
    found = {}
    for name, seed in (("A", 3), ("B", 4)):
        dataset = simulate("short", seed)[0].first(40)
        write_dataset(root / name, dataset.without("uwb") if name == "B" else dataset)
        found[name] = [*solve.solutions(read_dataset(root / name))]
    solve.solutions = lambda dataset, problems: (
        each for each in found[dataset.name] if each.problem in problems)
    return lambda name: main(["solve", str(root / name), "--out", str(one)])


def swaps(_, one, two):
    """Two folders that are swapped as one, as a report and its results."""
    def swapped(name):
        with swap.staging(one) as new_one, swap.staging(two) as new_two:
            for stage in (new_one, new_two):
                for file in ("both.txt", f"{name}.txt", f"problem1/{name}.txt"):
                    swap.write_atomically(stage / file, f"{file} of {name}".encode())
            swap.publish({one: new_one, two: new_two})
        return 0
    return swapped


def state(folders, expected):
    """Which run, "A" or "B", the folders are of, finished; "unfinished" or "MIXED" else.

    Never may files of two runs be side by side, nor a part of them. The user's files must be as
    they were. A folder that a run was replacing is missing, and the old one is beside it.
    """
    found = [contents(folder) if folder.exists() else None for folder in folders]
    lost = any(each is None and not swap.beside(folder, "old").exists()
               for each, folder in zip(found, folders))
    owners = [name for name in "AB" if all(
        each in (None, wanted) for each, wanted in zip(found, expected[name]))]
    return "MIXED" if lost or not owners else "unfinished" if None in found else owners[0]


def at_every_step(function, folders, begin, then):
    """Counts after kills before each step of a run of `then`, where that of `begin` ended well.

    After every third one a run is undisturbed, and nothing may be left that is hidden or empty.
    """
    work, expected = folders[0].parent, {}
    for name in "AB":
        for folder, (mine, text) in product(folders, MINE.items()):
            swap.write_atomically(folder / mine, text.encode())
        assert run(function, name) == 0
        expected[name] = [*map(contents, folders)]
        assert all(MINE.keys() <= found.keys() for found in expected[name])
        work.rename(work.with_name(f"after {name}"))
    counts, step, code = Counter(), 0, -9
    while code == -9:
        step += 1
        shutil.rmtree(work, ignore_errors=True)
        shutil.copytree(work.with_name(f"after {begin}"), work)
        code = run(function, then, step)
        counts["killed"] += code == -9
        found = state(folders, expected)
        counts[found] += 1
        if step % 3 == 0 or found == "MIXED":
            print(f"step {step}: {found}", file=sys.stderr)
            assert run(function, then) == 0
            counts["runs after"] += 1
            counts["MIXED"] += state(folders, expected) != then
            counts["LEFT"] += sum(
                path.name.startswith(".") and path.name != swap.FILE_LIST
                or path.is_dir() and not any(path.iterdir()) for path in work.rglob("*"))
    assert code == 0
    return counts


if __name__ == "__main__":
    memory = Path("/dev/shm")                                    # where many small files are fast
    for kind, names, begin, then in ((solves, ["one"], *"AB"), (swaps, ["one", "two"], *"BA")):
        with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
            root = Path(folder).resolve()
            folders = [root / "work" / name for name in names]
            print(json.dumps(at_every_step(kind(root, *folders), folders, begin, then)), flush=True)
