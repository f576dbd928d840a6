"""Errors of problem 3 beside a plain GTSAM script.

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

SEEDS = range(8)


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


if __name__ == "__main__":
    errors(range(24) if "large" in sys.argv[1:] else SEEDS)
