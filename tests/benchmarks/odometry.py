"""Time of equation 2 in closed form and by recursion, for drives of different length.

The recursion is that of test_odometry.py.
"""

import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from test_odometry import literal_recursion  # noqa: E402

from slamlib import odometry  # noqa: E402
from slamlib.dataset import read_dataset  # noqa: E402
from slamlib.simulation import simulate  # noqa: E402

DATA = Path(__file__).parents[2] / "data"


def best_of(repeats, function, *arguments):
    """Shortest wall time in seconds of several calls."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function(*arguments)
        times.append(time.perf_counter() - start)
    return min(times)


def main():
    drives = {folder.name: read_dataset(folder) for folder in sorted(DATA.iterdir())
              if (folder / "encoderReading.txt").exists()}
    drives["simulated, 2 rounds"] = simulate("long", seed=3, rounds=2)[0]
    print("Equation 2: closed form against recursion")
    print(f"{'dataset':22}{'poses':>10}{'closed form':>14}{'recursion':>12}{'ratio':>8}")
    for name, drive in drives.items():
        start = np.diag([0, 0, drive.vehicle.sigma_heading**2])
        closed = best_of(5, odometry.equation2, drive.ticks, drive.vehicle)
        stepwise = best_of(2, literal_recursion, drive.ticks, drive.vehicle, [0, 0, 0], start)
        print(f"{name:22}{len(drive.ticks):10,}{closed * 1e3:11.1f} ms{stepwise:10.2f} s"
              f"{stepwise / closed:8.0f}")


if __name__ == "__main__":
    main()
