"""Time of `slamlib solve` beside a plain script; time and memory by length, shape and density."""

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from slamlib import estimate
from slamlib.studies import simulation

HERE, LONG = Path(__file__).parent, Path(__file__).parents[2] / "data" / "long"
PAIRS = 5                    # runs of `solve` and of the plain script, in turn
ROWS = (1_000, 10_000, 100_000)
# Legs of (metres, radians) that are driven again and again; None is the long path, a loop.
SHAPES = {"loop": None, "corridor": [(100, 0)],
          "building": [(9, 0), (0.8, np.pi / 2), (7, 0), (0.8, -np.pi / 2)]}
SPACINGS = {"loop": (4.0, 1.9, 0.9), "corridor": (1.9,), "building": (1.9,)}     # m, of markers
PLAIN = """
import sys, time
sys.path.insert(0, sys.argv[1])
from plain_gtsam import plain
from slamlib.io.dataset import read_dataset
dataset = read_dataset(sys.argv[2])
start = time.perf_counter()
plain(dataset)
print(time.perf_counter() - start)
"""


def solve(folder):
    """Seconds of `slamlib solve` on a folder, and those of each problem (dict)."""
    with tempfile.TemporaryDirectory() as out:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "slamlib", "solve", folder, "--out", out],
                       check=True, stdout=subprocess.DEVNULL)
        seconds = time.perf_counter() - start
        rows = json.loads(Path(out, "summary.json").read_text())["problems"]
    return seconds, {name: row["seconds"] for name, row in rows.items()}


def plain(folder):
    """Seconds of the plain script's problem 4, without reading."""
    return float(subprocess.run([sys.executable, "-c", PLAIN, HERE, folder], check=True,
                                capture_output=True, text=True).stdout)


def pairs():
    """Print the times of `solve` and of the plain script on data/long, one after the other."""
    print(f"solve {LONG.name}, all problems, whole process, beside the plain script's problem 4")
    print(f"{'solve (s)':>12}{'plain (s)':>12}{'ratio':>8}")
    ratios = []
    for _ in range(PAIRS):
        (ours, parts), theirs = solve(LONG), plain(LONG)
        ratios.append(ours / theirs)
        print(f"{ours:12.2f}{theirs:12.2f}{ours / theirs:8.2f}", flush=True)
    print(f"median ratio {np.median(ratios):.2f}; of the last run: " + ", ".join(
        f"{name} {seconds:.2f} s" for name, seconds in parts.items()))


def drive(shape, rows, spacing):
    """A simulated Dataset of a shape with this many rows, without ranges."""
    long = simulation.PATHS["long"]
    rounds = math.ceil(rows / long.poses)
    turns = tuple(rounds * turn for turn in long.turns)
    simulation.PATHS["shape"] = replace(long, turns=turns, poses=rounds * long.poses,
                                        marker_spacing=spacing)
    if SHAPES[shape]:
        once = simulation.manoeuvre(SHAPES[shape])[1:]
        counts = np.tile(once, (math.ceil(rows / len(once)), 1))
        right, left = 2 * np.pi * 0.1 / 8000 * counts.T
        simulation._driven_arcs = lambda *_: ((right + left) / 2, (right - left) / 0.4)
    dataset, _ = simulation.simulate("shape", seed=3, slip=3e-3)
    return dataset.first(rows).without("uwb")


def estimate_once(shape, rows, spacing):
    """Print the seconds of problem 3, the peak memory in MB, and the number of markers."""
    dataset = drive(shape, int(rows), float(spacing))
    start = time.perf_counter()
    result = estimate(dataset)
    seconds = time.perf_counter() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(seconds, memory, len(result.marker))


def shapes():
    """Print the cost of problem 3 by shape and density, with its exponent in the rows."""
    print("\nProblem 3 by the shape of the drive and the spacing of the markers (m)")
    print(f"{'shape':>10}{'spacing':>9}{'rows':>9}{'markers':>9}{'s':>9}{'MB':>7}{'exponent':>10}")
    for shape in SHAPES:
        for spacing in SPACINGS[shape]:
            last = None
            for rows in ROWS:
                told = subprocess.run(
                    [sys.executable, __file__, shape, str(rows), str(spacing)], check=True,
                    capture_output=True, text=True).stdout
                seconds, memory, markers = map(float, told.split())
                exponent = f"{math.log10(seconds / last):.2f}" if last else "-"
                print(f"{shape:>10}{spacing:9.1f}{rows:9,}{markers:9.0f}{seconds:9.2f}{memory:7.0f}"
                      f"{exponent:>10}", flush=True)
                last = seconds


def main():
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.2f} before")
    if LONG.exists():
        pairs()
    shapes()


if __name__ == "__main__":
    if sys.argv[1:]:
        estimate_once(*sys.argv[1:])
    else:
        main()
