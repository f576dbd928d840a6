"""The errors, sigmas and slips of small drives, clean and spoilt, are those of `numbers.csv`.

Whether they are right other tests judge. These notice a change that was not meant. After one that
was, `python tests/test_numbers.py` writes the new ones.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numeric import aruco, as_points, counts, short, uwb, vehicle

from slamlib import solve

NUMBERS = Path(__file__).with_name("numbers.csv")
PROBLEMS = ("problem2", "problem2_fused", "problem3", "problem4")
COLUMNS = ["drive", "problem", "ate_m", "last_sigma_m", "slip_sqrt_m", "doubts"]


def slow_errors_of_ranges(d):
    return uwb(d, range=d.uwb.range + 0.3 * np.sin(d.uwb.pose / 60 + d.uwb.antenna))


def some_points(d):
    return vehicle(kernel="Huber")(replace(d, aruco=as_points(d.aruco, d.aruco.marker % 3 == 0)))


def camera_and_antennas(d):
    offset = 0.2 * np.cos(d.uwb.antenna)
    d = uwb(d, range=np.hypot(d.uwb.range, 1.0) + offset)
    return vehicle(camera_x=0.1, camera_turn=0.05, sigma_camera_turn=0.01, tag_x=0.1)(d)


def late_sightings(d):
    late = replace(d.aruco, pose=d.aruco.pose + 4)
    return replace(d, aruco=late.select(d.aruco.pose < 890))


def small_sigmas(d):
    return aruco(uwb(d, sigma=d.uwb.sigma / 3), covariance=d.aruco.covariance / 30)


def spike_and_dead_wheel(d):
    spike = counts([600], lambda ticks: ticks + [1500, 0])
    dead = counts(slice(900, 950), lambda ticks: ticks * [0, 1])
    return dead(spike(d))


def moved_markers(d):
    moved = (d.aruco.pose > 900) & (d.aruco.marker % 2 == 1)
    return aruco(d, marker_in_vehicle=d.aruco.marker_in_vehicle + 0.4 * moved[:, None])


# Options of the simulation, number of poses, and what is changed.
DRIVES = {
    "clean": ({}, 600, lambda d: d),
    "wrong labels and late ranges": ({"mislabelled": 0.15, "late_ranges": 0.3}, 500, lambda d: d),
    "memory": ({"memory": 0.9}, 700, slow_errors_of_ranges),
    "points": ({}, 400, some_points),
    "camera and antennas": ({}, 900, camera_and_antennas),
    "late sightings": ({"slip": 1e-4}, 900, late_sightings),
    "wrong scatter": ({"slip": 5e-3}, 600, small_sigmas),
    "a spike and a dead wheel": ({}, 1200, spike_and_dead_wheel),
    "moved markers": ({"rounds": 2}, 1400, moved_markers),
    "ranges alone": ({}, 900, lambda d: vehicle(sigma_heading=0.1)(d.without("aruco")))}


def numbers(drive):
    """The rows of a drive, one for each problem, as a DataFrame."""
    options, poses, change = DRIVES[drive]
    dataset, truth = short(8, poses, **options)
    rows = []
    for solution in solve.solutions(change(dataset), PROBLEMS):
        doubts = sorted({doubt.what for doubt in solution.doubts})
        row = {"drive": drive, "problem": solution.problem, "doubts": " ".join(doubts)}
        rows.append(solve.summarize(solution, truth) | row)
    return pd.DataFrame(rows, columns=COLUMNS)


@pytest.mark.parametrize("drive", DRIVES)
def test_errors_sigmas_slips_and_doubts_are_what_they_were(drive):
    table = pd.read_csv(NUMBERS, keep_default_na=False, na_values={"slip_sqrt_m": ""})
    expected = table[table["drive"] == drive].reset_index(drop=True)
    found = numbers(drive)
    pd.testing.assert_frame_equal(found, expected, check_dtype=False, rtol=1e-5, atol=1e-9)


if __name__ == "__main__":
    pd.concat(map(numbers, DRIVES)).to_csv(NUMBERS, index=False, float_format="%.7g")
