"""Kills a run before each of its steps, and prints a line of counts for each kind of run.

A part of test_concurrency.py. Runs are forks of this process, so that none waits for imports; it
imports no more than they need, because a large process forks slowly. A folder that a run of A or B
writes to is judged by the bytes that undisturbed runs wrote.
"""

import json
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path

from slamlib import summary, swap
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
    """Bytes of a run's files by name: not those of the user, nor what begins with a dot."""
    return {name: _plain(folder / name) for name in swap.file_names(folder)
            if name not in MINE and not any(part.startswith(".") for part in Path(name).parts)}


def _plain(file):
    """Bytes of a file, of a summary without its times."""
    content = file.read_bytes()
    if file.name == "summary.json":
        summary = json.loads(content)
        for row in summary["problems"].values():
            del row["seconds"]
        content = json.dumps(summary).encode()
    return content


class Solves:
    """The command solve, of two drives whose problems are solved once: only files are written."""

    folders = ("out",)

    def __init__(self, root):
        self.root, found = root, {}
        for name, seed in (("A", 3), ("B", 4)):
            dataset = simulate("short", seed)[0].first(40)
            write_dataset(root / name, dataset.without("uwb") if name == "B" else dataset)
            found[name] = [*summary.solutions(read_dataset(root / name))]
        summary.solutions = lambda dataset, problems: (
            each for each in found[dataset.name] if each.problem in problems)

    def run(self, name):
        """One run, in a process of its own; the exit code."""
        return main(["solve", str(self.root / name), "--out", str(self.root / "out")])


class Swaps:
    """Two folders that are swapped as one, as a report and its results."""

    folders = ("one", "two")

    def __init__(self, root):
        self.root = root

    def run(self, name):
        """One run, in a process of its own; the exit code."""
        one, two = (self.root / each for each in self.folders)
        with swap.staging(one) as new_one, swap.staging(two) as new_two:
            for stage in (new_one, new_two):
                for file in ("both.txt", f"{name}.txt", f"problem1/{name}.txt"):
                    swap.write_atomically(stage / file, f"{file} of {name}".encode())
            swap.publish({one: new_one, two: new_two})
        return 0


class Judge:
    """What the folders of runs hold."""

    def __init__(self, runs):
        self.root, self.folders = runs.root, runs.folders
        self.references, self.copies = {}, {}
        for name in "AB":
            self.reset()
            assert run(runs.run, name) == 0
            self.references[name] = {each: contents(self.root / each) for each in self.folders}
            self.copies[name] = self.root / f"copy_{name}"
            for each in self.folders:
                shutil.copytree(self.root / each, self.copies[name] / each)
                for mine, text in MINE.items():
                    swap.write_atomically(self.copies[name] / each / mine, text.encode())

    def reset(self, name=None):
        """Make the finished files of a drive, if one is named, those of the folders."""
        for path in (*(self.root / each for each in self.folders), *self.root.glob(".*")):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        for each in self.folders if name else ():
            shutil.copytree(self.copies[name] / each, self.root / each)

    def state(self):
        """Which run, "A" or "B", the folders are of, finished; "unfinished" or "MIXED: ..." else.

        Never may files of two runs be side by side, nor a part of them. The user's files must be as
        they were. A folder that a run was replacing is missing, and the old one is beside it.
        """
        states = set()
        for each in self.folders:
            folder = self.root / each
            if not folder.exists():
                states.add("unfinished" if swap.beside(folder, "old").exists() else "MIXED: lost")
                continue
            found = contents(folder)
            owners = [name for name in "AB" if found == self.references[name][each]]
            kept = all((folder / name).is_file() and (folder / name).read_text() == text
                       for name, text in MINE.items())
            states.add(owners[0] if owners and kept else f"MIXED: {sorted(found)}, {kept=}")
        mixed = [state for state in states if state.startswith("MIXED")]
        if mixed or "unfinished" in states:
            return mixed[0] if mixed else "unfinished"
        return states.pop() if len(states) == 1 else "MIXED: A and B"

    def left(self):
        """What is hidden or empty, and should not be there after an undisturbed run."""
        return [str(path) for each in self.folders for path in (self.root / each).rglob("*")
                if path.name.startswith(".") and path.name != swap.FILE_LIST
                or path.is_dir() and not any(path.iterdir())] + [*self.root.glob(".*")]


def at_every_step(runs, judge, begin, then):
    """Counts after kills before each step of a run of `then`, where that of `begin` ended well.

    After every third one a run is undisturbed.
    """
    counts, step, code = Counter(), 0, -9
    while code == -9:
        step += 1
        judge.reset(begin)
        code = run(runs.run, then, step)
        counts["killed"] += code == -9
        state = judge.state()
        counts[state.partition(":")[0]] += 1
        if step % 3 == 0 or state.startswith("MIXED"):
            print(f"step {step}: {state}", file=sys.stderr)
            assert run(runs.run, then) == 0
            counts["runs after"] += 1
            counts["MIXED"] += judge.state() != then
            counts["LEFT"] += len(judge.left())
    assert code == 0
    return counts


if __name__ == "__main__":
    memory = Path("/dev/shm")                                    # where many small files are fast
    for kind, begin, then in ((Solves, "A", "B"), (Swaps, "B", "A")):
        with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
            runs = kind(Path(folder).resolve())
            print(json.dumps(at_every_step(runs, Judge(runs), begin, then)), flush=True)
