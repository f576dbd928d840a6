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

from slamlib import slam, studies  # noqa: E402
from slamlib.evaluation import anees, ate, nees_band  # noqa: E402
from slamlib.simulation import simulate  # noqa: E402
from slamlib.studies import kernels, montecarlo  # noqa: E402

SEEDS = range(8)
RANGE_METHODS = ("quadratic", "Huber", "Cauchy", "asymmetric Tukey")


def trial(seed, slip):
    """Problem 3 on one drive: aligned ATE in m by slamlib, with known noise, and by plain; NEES."""
    dataset, truth = simulate("short", seed, slip=slip)
    dataset = dataset.without("uwb")
    learned = slam.estimate(dataset)
    known = slam.estimate(dataset, slip, "arc", marker_noise_factor=1.0)
    aligned = {name: ate(poses, truth.poses, aligned=True) for name, poses in (
        ("learned", learned.poses), ("known", known.poses),
        ("plain", plain(dataset, marginals=False)[0]))}
    return aligned | {"nees": anees(learned.poses, learned.covariances, truth.poses)}


def errors(seeds):
    """Print the errors of problem 3, with slamlib and plain."""
    low, high = nees_band(len(seeds))
    print(f"Problem 3: rms of the aligned ATE over {len(seeds)} drives of the short path, "
          f"noise learned (NEES of consistent estimates: {low:.2f} to {high:.2f})")
    print(f"{'slip':>8}{'ATE (mm)':>10}{'of known noise':>16}{'of plain':>10}{'NEES':>8}")
    for slip in (0.0, 1e-3, 3e-3):
        runs = studies.run(trial, seeds, slip=slip)
        rms = np.sqrt((runs**2).mean())
        print(f"{slip:8g}{1e3 * rms['learned']:10.2f}{rms['learned'] / rms['known']:16.2f}"
              f"{rms['learned'] / rms['plain']:10.2f}{runs['nees'].mean():8.2f}")


def compare_kernels(seeds):
    """Print the errors and NEES of the kernels for late ranges."""
    print(f"\nProblem 4 without markers: late ranges, {len(seeds)} drives of the short path")
    for late in (0.0, 0.05, 0.15, 0.30):
        runs = studies.run(kernels.compare, seeds, kind="ranges", methods=RANGE_METHODS,
                           markers=False, late_ranges=late)
        print(f"{100 * late:.0f} % late{'':12}{'ATE (mm)':>10}{'NEES':>8}{'antennas (mm)':>15}"
              f"{'NEES':>8}")
        rms, mean = np.sqrt((runs**2).mean()), runs.mean()
        for name in RANGE_METHODS:
            print(f"  {name:18}{1e3 * rms[f'{name} ate']:10.1f}{mean[f'{name} nees']:8.2f}"
                  f"{1e3 * rms[f'{name} antenna error']:15.1f}{mean[f'{name} antenna nees']:8.2f}")


def correlated_errors(seeds):
    """Print NEES and ATE of problems 2 and 3 by the correlation of successive sightings' errors."""
    print(f"\nErrors with memory: {len(seeds)} drives of the short path")
    print(f"{'':14}{'NEES':>7}{'median':>8}{'ATE (mm)':>10}")
    for each in (0.0, 0.5, 0.9, 0.97):
        runs = studies.run(montecarlo.correlated_errors, seeds, correlation=each)
        print(f"correlation {each:g}")
        for method in montecarlo.MEMORY_METHODS:
            values = runs[f"{method} nees"]
            print(f"  {method:12}{values.mean():7.2f}{values.median():8.2f}"
                  f"{1e3 * runs[f'{method} ate'].mean():10.2f}")


def main(seeds):
    errors(seeds)
    compare_kernels(seeds)
    correlated_errors(seeds)


if __name__ == "__main__":
    main(range(24) if "large" in sys.argv[1:] else SEEDS)
