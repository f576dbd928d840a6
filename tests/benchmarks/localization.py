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
    print(f"{'method':26}{'slip':>8}{'NEES':>9}{'at end':>9}{'ATE (m)':>10}{'of odometry':>13}")
    for slip in (0.0, 1e-3, 3e-3):
        runs = studies.run(montecarlo.problem2_trial, seeds, slip=slip)
        drift = rms(runs["odometry ate"])
        for method, name in METHODS.items():
            print(f"{name:26}{slip:8g}{runs[f'{method} nees'].mean():9.2f}"
                  f"{runs[f'{method} last nees'].mean():9.2f}{rms(runs[f'{method} ate']):10.4f}"
                  f"{rms(runs[f'{method} ate']) / drift:13.2f}")
        learned = np.percentile(runs["slip"], [10, 50, 90])
        print(f"{'map':26}{slip:8g}{runs['map nees'].mean():9.2f}\n"
              f"{'wheel parameters':26}{slip:8g}{runs['wheel nees'].mean():9.2f}   learned slip "
              f"(10, 50, 90 %): {learned[0]:.1e}, {learned[1]:.1e}, {learned[2]:.1e}")


if __name__ == "__main__":
    main(range(1000, 1100) if "large" in sys.argv[1:] else SEEDS)
