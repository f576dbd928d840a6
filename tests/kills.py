"""Kills solve and report at every step, and runs several builds at once.

    python tests/kills.py [steps] [report-steps] [builds]

prints a table of counts; without arguments it does all. It is not part of the suite, of which
test_concurrency.py runs a part. Runs are forks of this process, so that none waits for imports; it
imports no more than they need, because a large process forks slowly. A folder that a run of A or B
writes to is judged by the bytes that undisturbed runs wrote.
"""

import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from slamlib import summary, swap
from slamlib.__main__ import main
from slamlib.dataset import read_dataset
from slamlib.simulation import simulate, write_dataset

STEPS = {"os.rename", "os.remove", "os.mkdir", "os.rmdir"}      # audit events, also of pathlib
MINE = {"notes.txt": "of the user", "mine/data.mat": "mine", "problem1/notes.txt": "too"}
CODE = """from slamlib import solve
from slamlib.notebook import results_folder, start
for drive in start():
    for problem in {problems}:
        if solve.allows(drive.dataset, problem):
            solution = solve.problem_solution(problem, drive.dataset)
            solve.write_solution(results_folder(drive), solution)"""


def started(arguments, folder, at_step=None):
    """Process id of a fork that runs `main` in a folder, and kills itself before a step if told."""
    process = os.fork()
    if process:
        return process
    code = 9
    try:
        os.chdir(folder)
        for number in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), number)
        if at_step is not None:
            _kill_at(at_step)
        code = main(list(map(str, arguments)))
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


def ended(process):
    """Exit code of a process, -9 if it was killed."""
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])


def run(arguments, folder):
    """Run `main` undisturbed."""
    code = ended(started(arguments, folder))
    assert code == 0, f"exit code {code}"


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


def judge(folder, references):
    """Which reference, "A" or "B", a folder holds, finished; else "unfinished" or "MIXED: ...".

    Never may files of two runs be side by side, nor a part of them. The user's files must be as
    they were. A folder that a run was replacing is missing, and the old one is beside it.
    """
    if not folder.exists():
        return "unfinished" if swap.beside(folder, "old").exists() else "MIXED: lost all"
    found = contents(folder)
    owners = [name for name, files in references.items() if found == files]
    for name, text in MINE.items():
        if not (folder / name).is_file() or (folder / name).read_text() != text:
            return "MIXED: lost " + name
    return owners[0] if owners else "MIXED: " + " ".join(sorted(found))


def left(folder):
    """What lies in a folder that is no run's and no user's, empty folders too."""
    return [str(path.relative_to(folder)) for path in folder.rglob("*")
            if path.name.startswith(".") and path.name != swap.FILE_LIST
            or path.is_dir() and not any(path.iterdir())]


def put_mine(folder):
    """Write the user's files."""
    for name, text in MINE.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def make_drives(root):
    """Folders A (all sensors) and B (another drive, without ranges), each with data/short."""
    for name, seed in (("A", 3), ("B", 4)):
        dataset = simulate("short", seed)[0].first(40)
        write_dataset(root / name / "short", dataset.without("uwb") if name == "B" else dataset)


class Runs:
    """A command between the drives A and B, which writes `folders` below `root`."""

    def __init__(self, root):
        self.root = root
        make_drives(root)
        self.prepare()
        self.references, self.copies = {}, {}
        for name in "AB":
            self.reset()
            run(self.arguments(name), root)
            self.references[name] = {folder: contents(root / folder) for folder in self.folders}
            self.copies[name] = root / f"copy_{name}"
            for folder in self.folders:
                shutil.copytree(root / folder, self.copies[name] / folder)
                put_mine(self.copies[name] / folder)

    def reset(self, name=None):
        """Make the finished files of a drive, if one is named, those of the folders."""
        for path in (*(self.root / Path(folder).parts[0] for folder in self.folders),
                     *self.root.glob(".*")):                # of a run that was killed
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
        for folder in self.folders if name else ():
            shutil.copytree(self.copies[name] / folder, self.root / folder)

    def state(self):
        """What `judge` says of all folders; where none is missing, they are of one run."""
        states = {judge(self.root / folder, {
            name: files[folder] for name, files in self.references.items()})
            for folder in self.folders}
        mixed = [state for state in states if state.startswith("MIXED")]
        if mixed or "unfinished" in states:
            return mixed[0] if mixed else "unfinished"
        return states.pop() if len(states) == 1 else "MIXED: " + " and ".join(sorted(states))

    def left(self):
        """What is there and should not be after an undisturbed run."""
        return [name for folder in ("out", "results", "report", "build/executed")
                for name in left(self.root / folder)] + [
                    path.name for path in self.root.iterdir() if path.name.startswith(".")]


class Solves(Runs):
    """The command solve, with problems that are solved once: only the files are written."""

    folders = ("out",)

    def prepare(self):
        found = {}
        for name in "AB":
            dataset = read_dataset(self.root / name / "short")
            found[dataset.uwb is None] = [*summary.solutions(dataset)]
        summary.solutions = lambda dataset, problems: (
            each for each in found[dataset.uwb is None] if each.problem in problems)

    def arguments(self, name):
        """Of the command line for one drive."""
        return ["solve", self.root / name / "short", "--out", "out"]


class Reports(Runs):
    """The command report of two tiny notebooks; a page holds what the result files say.

    Such pages take no time: notebooks, cache and files are real.
    """

    folders = ("results/short", "report")

    def prepare(self):
        import nbformat

        from slamlib.report import build
        build.render = lambda *_, **__: {}
        build._rendered = lambda books, drives, *_: {
            f"{name}.html": f"{name}: {[each.files for each in drives]}, "
                            f"{[s.poses.tolist() for d in drives for s in d.solutions]}".encode()
            for name in ["index", *(source.stem for source in books)]}
        (self.root / "notebooks").mkdir()
        for name, problems in (("1_one", ["problem1"]), ("2_two", ["problem2", "problem4"])):
            nbformat.write(nbformat.v4.new_notebook(cells=[
                nbformat.v4.new_markdown_cell(f"# {name[0]}. Chapter", id="a"),
                nbformat.v4.new_code_cell(CODE.format(problems=problems), id="b")]),
                self.root / "notebooks" / f"{name}.ipynb")

    def arguments(self, name):
        """Of the command line for one drive."""
        return ["report", "--data", self.root / name]


def count(counts, runs, name, result):
    """Count the state after a kill, and run again undisturbed where a drive is named."""
    counts[result if result in ("A", "B", "unfinished") else "MIXED"] += 1
    if result.startswith("MIXED"):
        print(result, file=sys.stderr)
    if name is None:
        return
    run(runs.arguments(name), runs.root)
    counts["runs after"] += 1
    if runs.state() != name:
        counts["MIXED"] += 1
        print("after:", runs.state(), file=sys.stderr)
    if what := runs.left():
        counts["LEFT"] += 1
        print("left:", what, file=sys.stderr)


def at_every_step(runs, begin, then):
    """Counts after kills before each step of a run of `then`, where that of `begin` ended well.

    After every third one a run is undisturbed.
    """
    counts, step, code = Counter(), 0, -9
    while code == -9:
        step += 1
        runs.reset(begin)
        code = ended(started(runs.arguments(then), runs.root, step))
        counts["killed"] += code == -9
        count(counts, runs, then if code == -9 and step % 3 == 0 else None, runs.state())
    assert code == 0
    return counts


def at_once(runs, builds, times, seed):
    """Counts of rounds of several builds that start at random offsets, with an empty cache."""
    counts, rng = Counter(), random.Random(seed)
    for _ in range(times):
        shutil.rmtree(runs.root / "build", ignore_errors=True)
        runs.reset("B")
        processes = []
        for _ in range(builds):
            processes.append(started(runs.arguments("A"), runs.root))
            time.sleep(rng.uniform(0, 3))
        counts["builds"] += builds
        counts["FAILED"] += sum(ended(process) != 0 for process in processes)
        counts["rounds of the same bytes"] += runs.state() == "A" and not runs.left()
    return counts


STEP_BY_STEP = [("every step, A then B", at_every_step, ("A", "B")),
                ("every step, B then A", at_every_step, ("B", "A"))]
PARTS = {
    "steps": (Solves, STEP_BY_STEP),
    "report-steps": (Reports, STEP_BY_STEP),
    "builds": (Reports, [("two builds at once", at_once, (2, 20, 3)),
                         ("four builds at once", at_once, (4, 20, 4))]),
}


def do(parts):
    """Run parts by name, print a line for each, and return True if nothing was mixed or left."""
    well = True
    for part in parts:
        kind, lines = PARTS[part]
        with tempfile.TemporaryDirectory() as folder:
            runs = kind(Path(folder).resolve())
            for title, function, arguments in lines:
                counts = function(runs, *arguments)
                well &= not any(counts[bad] for bad in ("MIXED", "LEFT", "FAILED"))
                print(f"{part}, {title}: " + ", ".join(
                    f"{number} {what}" for what, number in counts.items()), flush=True)
    return well


if __name__ == "__main__":
    sys.exit(not do(sys.argv[1:] or PARTS))
