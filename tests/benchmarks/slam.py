"""Problem 3 against a plain GTSAM script: error on many drives, time and memory as drives grow.

    python tests/benchmarks/slam.py [ROWS]      longer drives, up to about so many encoder rows
"""

import os
import resource
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np  # noqa: E402
from joblib import Parallel, delayed  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))

from plain_gtsam import plain  # noqa: E402

from slamlib import slam  # noqa: E402
from slamlib.dataset import read_dataset  # noqa: E402
from slamlib.evaluation import anees, ate, nees_band  # noqa: E402
from slamlib.simulation import simulate  # noqa: E402

SEEDS = range(20)
DATA = Path(__file__).parents[2] / "data"


def trial(seed, slip):
    dataset, truth = simulate("short", seed, slip=slip)
    dataset = dataset.without("uwb")
    found, known = slam.solve(dataset), slam.solve(dataset, slip, "arc")
    return (*(ate(p, truth.poses, aligned=True)
              for p in (found.poses, known.poses, plain(dataset, marginals=False)[0])),
            anees(found.poses, found.covariances, truth.poses))


def parts(dataset):
    """Seconds of the parts of problem 3: graphs, solutions with learned slip, marginals."""
    times = [time.perf_counter()]
    graphs = [slam.Graph(dataset, model) for model in ("euler", "arc")]
    times.append(time.perf_counter())
    solved = [slam.solve_graph(graph) for graph in graphs]
    times.append(time.perf_counter())
    slam.result(*max(solved, key=lambda s: s[-1]))
    times.append(time.perf_counter())
    return np.diff(times)


def main(largest=30_000):
    low, high = nees_band(len(SEEDS))
    print(f"Problem 3: rms of the aligned ATE over {len(SEEDS)} drives of the short path, all learned "
          f"(NEES of consistent estimates: {low:.2f} to {high:.2f})")
    print(f"{'slip':>8}{'ATE (mm)':>10}{'of known noise':>16}{'of plain':>10}{'NEES':>8}")
    for slip in (0.0, 1e-3, 3e-3):
        runs = np.array(Parallel(n_jobs=2)(delayed(trial)(seed, slip) for seed in SEEDS))
        rms = np.sqrt(np.mean(runs[:, :3]**2, axis=0))
        print(f"{slip:8g}{1e3 * rms[0]:10.2f}{rms[0] / rms[1]:16.2f}{rms[0] / rms[2]:10.2f}"
              f"{runs[:, 3].mean():8.2f}")

    print("\nProblem 3 against the plain script, one process, in seconds")
    print(f"{'drive':>12}{'rows':>11}{'graphs':>9}{'solve':>9}{'marginals':>11}{'all':>9}"
          f"{'plain':>9}{'ratio':>8}{'peak MB':>10}")
    drives = {"data/long": read_dataset(DATA / "long")} if (DATA / "long").exists() else {}
    for rows in (10_000, 100_000, 1_000_000):
        if rows <= largest:
            rounds = max(1, rows // 23_000)
            dataset = simulate("long", 3, rounds=rounds)[0]
            drives[f"{rounds} rounds"] = dataset
    for name, dataset in drives.items():
        each = parts(dataset)
        start = time.perf_counter()
        plain(dataset)
        seconds = time.perf_counter() - start
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{name:>12}{len(dataset.ticks):11,}{each[0]:9.1f}{each[1]:9.1f}{each[2]:11.1f}"
              f"{each.sum():9.1f}{seconds:9.1f}{each.sum() / seconds:8.2f}{memory:10.0f}", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
