"""Problem 2 on simulated drives: NEES and ATE of all methods.

    python tests/benchmarks/localization.py [large]
"""

import sys

import numpy as np

from slamlib import studies
from slamlib.evaluation import nees_band
from slamlib.studies import montecarlo

SEEDS = range(1000, 1012)
METHODS = {"ArUco": "markers alone", "naive": "  without shared errors", "hint": "hint, equation 2",
           "exact hint": "hint, first order", "fused": "fused, shared errors"}


def rms(values):
    """Root mean square of an array."""
    return np.sqrt(np.mean(values**2))


def main(seeds):
    low, high = nees_band(len(seeds))
    print(f"Problem 2: {len(seeds)} drives of the short path; "
          f"NEES of a consistent method: {low:.2f} to {high:.2f}")
    print(f"{'method':26}{'slip':>8}{'NEES':>9}{'ATE (m)':>10}{'of odometry':>13}")
    for slip in (0.0, 1e-3, 3e-3):
        runs = studies.run(montecarlo.problem2_trial, seeds, slip=slip)
        drift = rms(runs["odometry ate"])
        for method, name in METHODS.items():
            print(f"{name:26}{slip:8g}{runs[f'{method} nees'].mean():9.2f}"
                  f"{rms(runs[f'{method} ate']):10.4f}{rms(runs[f'{method} ate']) / drift:13.2f}")


if __name__ == "__main__":
    main(range(1000, 1100) if "large" in sys.argv[1:] else SEEDS)
