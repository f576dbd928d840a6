"""Problems 3 and 4 compared with a plain GTSAM script: error, time and memory.

    python tests/benchmarks/slam.py [ROWS]

ROWS is the largest number of encoder rows of the longer drives.
"""

import json
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np  # noqa: E402
from joblib import Parallel, delayed  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))

from plain_gtsam import plain  # noqa: E402

from slamlib import slam, studies  # noqa: E402
from slamlib.dataset import read_dataset  # noqa: E402
from slamlib.evaluation import ate, nees_band  # noqa: E402
from slamlib.simulation import simulate  # noqa: E402
from slamlib.studies import kernels, montecarlo  # noqa: E402

SEEDS = range(20)
TIME_LIMIT = 900             # s, for one solution of one problem
LONG = Path(__file__).parents[2] / "data" / "long"


def trial(seed, slip):
    """Problem 3 on one drive: aligned ATE in m by slamlib, with known noise, and by plain; NEES."""
    numbers = montecarlo.learned_slips(seed, slip)
    dataset, truth = simulate("short", seed, slip=slip)
    poses, _ = plain(dataset.without("uwb"), marginals=False)
    return (numbers["aligned"], numbers["known aligned"], ate(poses, truth.poses, aligned=True),
            numbers["nees"])


def drive(rounds):
    """The Dataset data/long (0), or that of a simulated long path driven so many times."""
    return read_dataset(LONG) if rounds == 0 else simulate("long", 3, rounds=rounds)[0]


def measure(rounds, problem, script):
    """Time in s, peak memory in MB beyond the data, and encoder rows of one solution.

    Parameters
    ----------
    rounds : as of `drive`.
    problem : 3 or 4.
    script : "slamlib" or "plain".
    """
    dataset = drive(rounds) if problem == 4 else drive(rounds).without("uwb")
    previous = (slam.estimate(dataset.without("uwb"))
                if (problem, script) == (4, "slamlib") else None)
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    if script == "plain":
        plain(dataset)
    else:
        slam.estimate(dataset, previous=previous)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return seconds, (peak - before) / 1024, len(dataset.ticks)


def alone(*arguments):
    """measure(*arguments) in a process of its own, or None after TIME_LIMIT."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_send, args=(theirs, *arguments))
    process.start()
    done = ours.poll(TIME_LIMIT)
    if not done:
        process.kill()
    result = ours.recv() if done else None
    process.join()
    return result


def _send(pipe, *arguments):
    pipe.send(measure(*arguments))


def errors(seeds=SEEDS):
    """Print the errors of problem 3, with slamlib and plain."""
    low, high = nees_band(len(seeds))
    print(f"Problem 3: rms of the aligned ATE over {len(seeds)} drives of the short path, "
          f"noise learned (NEES of consistent estimates: {low:.2f} to {high:.2f})")
    print(f"{'slip':>8}{'ATE (mm)':>10}{'of known noise':>16}{'of plain':>10}{'NEES':>8}")
    for slip in (0.0, 1e-3, 3e-3):
        runs = np.array(Parallel(n_jobs=2)(delayed(trial)(seed, slip) for seed in seeds))
        rms = np.sqrt(np.mean(runs[:, :3]**2, axis=0))
        print(f"{slip:8g}{1e3 * rms[0]:10.2f}{rms[0] / rms[1]:16.2f}{rms[0] / rms[2]:10.2f}"
              f"{runs[:, 3].mean():8.2f}")


def compare_kernels(seeds=range(12)):
    """Print the errors, NEES and times of the kernels for late ranges."""
    print(f"\nProblem 4 without markers: late ranges, {len(seeds)} drives of the short path")
    for late in (0.0, 0.05, 0.15, 0.30):
        runs = studies.run(kernels.late_ranges, seeds, markers=False, late_ranges=late)
        print(f"{100 * late:.0f} % late{'':12}{'ATE (mm)':>10}{'NEES':>8}{'antennas (mm)':>15}"
              f"{'NEES':>8}{'seconds':>9}")
        for way in kernels.RANGES:
            of = {key: runs[f"{way} {key}"]
                  for key in ("ate", "nees", "antenna error", "antenna nees", "seconds")}
            print(f"  {way:18}{1e3 * np.sqrt(np.mean(of['ate']**2)):10.1f}"
                  f"{of['nees'].mean():8.2f}"
                  f"{1e3 * np.sqrt(np.mean(of['antenna error']**2)):15.1f}"
                  f"{of['antenna nees'].mean():8.2f}{of['seconds'].mean():9.2f}")


def growth(largest):
    """Print time and memory against the length of the drive, up to `largest` encoder rows."""
    print("\nProblems 3 and 4 (after 3), each in its own process: seconds and MB beyond the data")
    print(f"{'rows':>11}{'problem':>9}{'slamlib':>10}{'MB':>7}{'plain':>9}{'MB':>7}{'ratio':>8}"
          f"{'ms a row':>10}")
    for rounds in [0] * LONG.exists() + [r for r in (1, 4, 43) if 23_000 * r <= largest]:
        for problem in (3, 4):
            ours, memory, rows = alone(rounds, problem, "slamlib")
            plain_alone = alone(rounds, problem, "plain")
            theirs, their_memory, _ = plain_alone or (TIME_LIMIT, np.nan, rows)
            print(f"{rows:11,}{problem:9}{ours:10.1f}{memory:7.0f}{'' if plain_alone else '>':>2}"
                  f"{theirs:7.1f}{their_memory:7.0f}{'' if plain_alone else '<':>2}"
                  f"{ours / theirs:6.2f}{1e3 * ours / rows:10.3f}", flush=True)


def whole():
    """Print the time of `slamlib solve`, all problems, and of the plain script, problem 4."""
    with tempfile.TemporaryDirectory() as out:
        start = time.perf_counter()
        subprocess.run([sys.executable, "-m", "slamlib", "solve", LONG, "--out", out], check=True,
                       stdout=subprocess.DEVNULL)
        ours = time.perf_counter() - start
        problems = json.loads(Path(out, "summary.json").read_text())["problems"]
    start = time.perf_counter()
    program = ("import sys; sys.path.insert(0, sys.argv[1]); from plain_gtsam import plain; "
               "from slamlib.dataset import read_dataset; plain(read_dataset(sys.argv[2]))")
    subprocess.run([sys.executable, "-c", program, str(Path(__file__).parent), LONG], check=True)
    theirs = time.perf_counter() - start
    print(f"\nsolve {LONG.name}, whole process: {ours:.1f} s; plain script, problem 4, "
          f"whole process: {theirs:.1f} s; ratio {ours / theirs:.2f}")
    parts = {name: row["seconds"] for name, row in problems.items()}
    parts["start, reading, writing"] = ours - sum(parts.values())
    print("\n".join(f"  {name:25}{seconds:6.1f} s" for name, seconds in parts.items()))


def main(largest=100_000):
    errors()
    compare_kernels()
    if LONG.exists():
        whole()
    growth(largest)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
