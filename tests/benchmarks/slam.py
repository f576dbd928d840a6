"""Errors of problem 3 beside a plain GTSAM script, of kernels for late ranges, and with memory.

    python tests/benchmarks/slam.py [large]
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np  # noqa: E402

sys.path.insert(0, str(Path(__file__).parent))

from plain_gtsam import plain  # noqa: E402

from slamlib import studies  # noqa: E402
from slamlib.evaluation import ate, nees_band  # noqa: E402
from slamlib.simulation import simulate  # noqa: E402
from slamlib.studies import correlation, kernels, montecarlo, workers  # noqa: E402

SEEDS = range(8)


def trial(seed, slip):
    """Problem 3 on one drive: aligned ATE in m by slamlib, with known noise, and by plain; NEES."""
    numbers = montecarlo.learned_noise(seed, slip)
    dataset, truth = simulate("short", seed, slip=slip)
    poses, _ = plain(dataset.without("uwb"), marginals=False)
    return (numbers["aligned"], numbers["known aligned"], ate(poses, truth.poses, aligned=True),
            numbers["nees"])


def errors(seeds):
    """Print the errors of problem 3, with slamlib and plain."""
    low, high = nees_band(len(seeds))
    print(f"Problem 3: rms of the aligned ATE over {len(seeds)} drives of the short path, "
          f"noise learned (NEES of consistent estimates: {low:.2f} to {high:.2f})")
    print(f"{'slip':>8}{'ATE (mm)':>10}{'of known noise':>16}{'of plain':>10}{'NEES':>8}")
    for slip in (0.0, 1e-3, 3e-3):
        runs = np.array([*workers.rows(trial, seeds, {"slip": slip}, 2)])
        rms = np.sqrt(np.mean(runs[:, :3]**2, axis=0))
        print(f"{slip:8g}{1e3 * rms[0]:10.2f}{rms[0] / rms[1]:16.2f}{rms[0] / rms[2]:10.2f}"
              f"{runs[:, 3].mean():8.2f}")


def compare_kernels(seeds):
    """Print the errors and NEES of the kernels for late ranges."""
    print(f"\nProblem 4 without markers: late ranges, {len(seeds)} drives of the short path")
    for late in (0.0, 0.05, 0.15, 0.30):
        runs = studies.run(kernels.late_ranges, seeds, markers=False, late_ranges=late)
        print(f"{100 * late:.0f} % late{'':12}{'ATE (mm)':>10}{'NEES':>8}{'antennas (mm)':>15}"
              f"{'NEES':>8}")
        for method in kernels.RANGE_METHODS:
            of = {key: runs[f"{method} {key}"]
                  for key in ("ate", "nees", "antenna error", "antenna nees")}
            print(f"  {method:18}{1e3 * np.sqrt(np.mean(of['ate']**2)):10.1f}"
                  f"{of['nees'].mean():8.2f}"
                  f"{1e3 * np.sqrt(np.mean(of['antenna error']**2)):15.1f}"
                  f"{of['antenna nees'].mean():8.2f}")


def correlated_errors(seeds):
    """Print NEES and ATE of problems 2 to 4 by the correlation of successive sightings' errors."""
    print(f"\nErrors with memory: {len(seeds)} drives of the short path")
    print(f"{'':14}{'NEES':>7}{'median':>8}{'ATE (mm)':>10}")
    for each in (0.0, 0.5, 0.9, 0.97):
        runs = studies.run(correlation.correlated_errors, seeds, correlation=each, poses=2000)
        print(f"correlation {each:g}")
        for method in correlation.METHODS:
            values = runs[f"{method} nees"]
            print(f"  {method:12}{values.mean():7.2f}{np.median(values):8.2f}"
                  f"{1e3 * runs[f'{method} ate'].mean():10.2f}")


def main(seeds):
    errors(seeds)
    compare_kernels(seeds)
    correlated_errors(seeds)


if __name__ == "__main__":
    main(range(24) if "large" in sys.argv[1:] else SEEDS)
