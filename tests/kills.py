"""Kills runs at random moments, and prints counts of what they leave; a part of test_concurrency.

Runs are forks of this process, so that none waits for imports. They write the results of two drives
to one folder, in turn.
"""

import json
import os
import signal
import sys
import time
from collections import Counter
from itertools import cycle
from pathlib import Path

import numpy as np
from conftest import file_names

from slamlib import solve
from slamlib.io import files
from slamlib.studies.simulation import simulate

KILLS = 70
PAUSE = 0.02  # s, between two runs
LONGEST = 0.25  # s, before a kill


def contents(folder):
    """Bytes of the files in a folder by name, without hidden ones."""
    return {name: (folder / name).read_bytes() for name in file_names(folder)
            if not Path(name).name.startswith(".")}


def state(found, expected):
    """What files are: "A" or "B", the run that a summary says they are of, "unfinished", or bad."""
    if "summary.json" in found:
        return next((name for name, run in expected.items() if run == found), "MIXED")
    for name, content in found.items():
        if content not in [run.get(name) for run in expected.values()]:
            return "HALF"
    return "unfinished"


def main(out):
    """Print counts of the states after kills, and the state after a run that was not killed."""
    drive = simulate("short", seed=3)[0].first(40)
    drives = {"A": drive, "B": drive.without("uwb")}
    solved = {id(each): list(solve.solutions(each)) for each in drives.values()}
    solve.solutions = lambda dataset, *_: solved[id(dataset)]
    files.write_file(out / "problem4" / "notes.txt", b"of the user")
    expected = {}
    for name, each in drives.items():
        solve.solve_to_folder(each, None, out)
        expected[name] = contents(out)
    rng = np.random.default_rng(0)
    counts = Counter()
    for _ in range(KILLS):
        process = os.fork()
        if not process:
            for each in cycle(drives.values()):
                time.sleep(PAUSE)
                solve.solve_to_folder(each, None, out)
        time.sleep(rng.uniform(0, LONGEST))
        os.kill(process, signal.SIGKILL)
        os.waitpid(process, 0)
        counts[state(contents(out), expected)] += 1
    solve.solve_to_folder(drive, None, out)
    print(json.dumps([counts, state(contents(out), expected)]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
