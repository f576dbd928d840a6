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
from pathlib import Path

from slamlib import solve, swap
from slamlib.__main__ import main
from slamlib.dataset import read_dataset
from slamlib.simulation import simulate, write_dataset

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
    """Bytes of the files in a folder by name, but those that begin with a dot."""
    return {name: _plain(folder / name) for name in swap.file_names(folder)
            if not Path(name).name.startswith(".")}


def _plain(file):
    """Bytes of a file, of a summary without its times."""
    return re.sub(rb'"seconds": [^\n]*', b"", file.read_bytes())


def solves(root):
    """The command solve, of two drives whose problems are solved once: only files are written."""
    found = {}
    for name, seed in (("A", 3), ("B", 4)):
        dataset = simulate("short", seed)[0].first(40)
        write_dataset(root / name, dataset.without("uwb") if name == "B" else dataset)
        found[name] = [*solve.solutions(read_dataset(root / name))]
    solve.solutions = lambda dataset, problems: (
        each for each in found[dataset.name] if each.problem in problems)
    return lambda name: main(["solve", str(root / name), "--out", str(root / "one")])


def swaps(root):
    """Two folders that are swapped as one, as a report and its results."""
    def swapped(name):
        one, two = root / "one", root / "two"
        with swap.staging(one) as new_one, swap.staging(two) as new_two:
            for stage in (new_one, new_two):
                for file in ("both.txt", f"{name}.txt", f"problem1/{name}.txt"):
                    swap.write_atomically(stage / file, f"{file} of {name}".encode())
            swap.publish({one: new_one, two: new_two})
        return 0
    return swapped


class Judge:
    """What the folders (list of Path) of runs hold: the files of A or of B, and the user's."""

    def __init__(self, folders, function):
        self.folders, self.root, self.expected = folders, folders[0].parent, {}
        for name in "AB":
            self.reset()
            for folder in folders:
                for mine, text in MINE.items():
                    swap.write_atomically(folder / mine, text.encode())
            assert run(function, name) == 0
            self.expected[name] = [*map(contents, folders)]
            assert all(MINE.keys() <= found.keys() for found in self.expected[name])
            for folder in folders:
                shutil.copytree(folder, self.root / f"copy_{name}" / folder.name)

    def reset(self, name=None):
        """Make the folders those after the run of a name, or remove them."""
        for path in (*self.folders, *self.root.glob(".*")):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        if name:
            shutil.copytree(self.root / f"copy_{name}", self.root, dirs_exist_ok=True)

    def state(self):
        """Which run, "A" or "B", the folders are of, finished; "unfinished" or "MIXED: ..." else.

        Never may files of two runs be side by side, nor a part of them. The user's files must be as
        they were. A folder that a run was replacing is missing, and the old one is beside it.
        """
        found = [contents(folder) if folder.exists() else None for folder in self.folders]
        if any(each is None and not swap.beside(folder, "old").exists()
               for each, folder in zip(found, self.folders)):
            return "MIXED: lost"
        owners = {next((name for name in "AB" if each == self.expected[name][k]), "MIXED")
                  for k, each in enumerate(found) if each is not None}
        if "MIXED" in owners or None not in found and len(owners) > 1:
            return f"MIXED: {owners}, {[sorted(each or {}) for each in found]}"
        return "unfinished" if None in found else owners.pop()

    def left(self):
        """What is hidden or empty, and should not be there after an undisturbed run."""
        return [path for folder in self.folders for path in folder.rglob("*")
                if path.name.startswith(".") and path.name != swap.FILE_LIST
                or path.is_dir() and not any(path.iterdir())] + [*self.root.glob(".*")]


def at_every_step(function, judge, begin, then):
    """Counts after kills before each step of a run of `then`, where that of `begin` ended well.

    After every third one a run is undisturbed.
    """
    counts, step, code = Counter(), 0, -9
    while code == -9:
        step += 1
        judge.reset(begin)
        code = run(function, then, step)
        counts["killed"] += code == -9
        state = judge.state()
        counts[state.partition(":")[0]] += 1
        if step % 3 == 0 or state.startswith("MIXED"):
            print(f"step {step}: {state}", file=sys.stderr)
            assert run(function, then) == 0
            counts["runs after"] += 1
            counts["MIXED"] += judge.state() != then
            counts["LEFT"] += len(judge.left())
    assert code == 0
    return counts


if __name__ == "__main__":
    memory = Path("/dev/shm")                                    # where many small files are fast
    for kind, names, begin, then in ((solves, ["one"], *"AB"), (swaps, ["one", "two"], *"BA")):
        with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
            root = Path(folder).resolve()
            function = kind(root)
            judge = Judge([root / name for name in names], function)
            print(json.dumps(at_every_step(function, judge, begin, then)), flush=True)
