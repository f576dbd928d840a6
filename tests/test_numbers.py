"""The numbers of small drives, clean and spoilt, are what they were.

Whether they are right other tests judge. These notice a change that was not meant. After one that
was, `python tests/test_numbers.py` prints the new ones.
"""

import textwrap
from dataclasses import replace

import numpy as np
import pytest
from numeric import aruco, as_points, carried, counts, uwb, vehicle

from slamlib import solve
from slamlib.checks.files import doubts_before_solving
from slamlib.simulation import simulate


def few_markers(d):
    """Of every third sighting, some twice and some with the next marker's id."""
    a = d.aruco.select(np.sort(np.r_[:len(d.aruco.pose):3, :len(d.aruco.pose):30]))
    return aruco(d, **{name: getattr(a, name) for name in (
        "pose", "marker_in_vehicle", "covariance")}, marker=np.where(
            np.arange(len(a.pose)) % 9 == 4, np.roll(a.marker, 1), a.marker))


def moved_markers(d):
    z = d.aruco.marker_in_vehicle + 0.4 * ((d.aruco.pose > 900) & (d.aruco.marker % 2))[:, None]
    return aruco(d, marker_in_vehicle=z)


# Options of the simulation, number of poses, and what is changed.
DRIVES = {
    "clean": ({}, 600, lambda d: d),
    "wrong labels and late ranges": ({"mislabelled": 0.15, "late_ranges": 0.3}, 500, lambda d: d),
    "memory": ({"memory": 0.9}, 700, lambda d: uwb(d, range=d.uwb.range + 0.3 * np.sin(
        d.uwb.pose / 60 + d.uwb.antenna))),
    "points": ({}, 400, lambda d: replace(d, aruco=as_points(
        d.aruco, d.aruco.marker % 3 == 0), vehicle=replace(d.vehicle, kernel="Huber"))),
    "camera and antennas": ({}, 900, lambda d: uwb(vehicle(
        camera_x=0.1, camera_turn=0.05, sigma_camera_turn=0.01, tag_x=0.1)(d), range=np.hypot(
            d.uwb.range, 1.0) + 0.2 * np.cos(d.uwb.antenna))),
    "Euler's steps, a slow camera": ({"slip": 1e-4}, 900, lambda d: replace(
        d, aruco=replace(d.aruco, pose=d.aruco.pose + 4).select(d.aruco.pose < 890))),
    "wrong scatter": ({"slip": 5e-3}, 600, lambda d: aruco(uwb(
        d, sigma=d.uwb.sigma / 3), covariance=d.aruco.covariance / 30)),
    "pushed, a spike, a dead wheel": ({}, 1200, lambda d: counts(
        slice(900, 950), lambda t: t * [0, 1])(counts([600], lambda t: t + [1500, 0])(
            carried(d, 300, 306)))),
    "carried": ({}, 800, lambda d: carried(d, 300, 380)),
    "moved markers": ({"rounds": 2}, 1400, moved_markers),
    "few markers": ({}, 1200, few_markers),
    "ranges alone": ({}, 900, lambda d: vehicle(sigma_heading=0.1)(d.without("aruco")))}

NUMBERS = {
    "clean": ("", [0.074021899, 0, -0.022129302, 90.513434, 0.060304784, 0, 0.049043606,
        -0.051260871, -0.058855546, -0.045254918, -0.082815942, 2.160474]),
    "wrong labels and late ranges": ("antenna sightings-rejected", [-0.094568585, 0,
        -0.016431873, 78.200527, -0.11374395, 0, -0.092196408, 1.0292764, 0.019678077, 10.396649,
        0.026259415, 5.91038]),
    "memory": ("antenna marker-memory range-memory", [-0.048944386, 0, 0.057063993, 103.98211,
        -0.031157219, 0, -0.029296085, -0.051277078, 0.08970328, -3.4222975, 0.093976856,
        -4.6113827]),
    "points": ("antenna", [-0.1161873, 0, 0.094380395, 60.513434, -0.11075969, 0, -0.095351401,
        -0.051304334, 0.14901164, -0.046297847, 0.12432474, 1.4709753]),
    "camera and antennas": ("antenna-height camera-offset", [0.036243904, 0, -0.073792407,
        139.84677, 0.021204648, 0, 0.020965572, 0.82674596, -0.087036388, -0.004125229,
        -0.061239577, -0.70053915]),
    "Euler's steps, a slow camera": ("time-offset", [0.036342598, 0, -0.082173678, 137.84677,
        0.022994306, 0, 0.011844307, -0.050764183, -0.090490882, -0.34697814, -0.060417274,
        3.08365]),
    "wrong scatter": ("marker-noise range-noise", [0.073898921, 0, -0.02668008, 114.64694,
        0.059493302, 0, 0.056259433, 7.9182667, -0.052167768, -0.19290824, -0.078256205,
        2.3028143]),
    "pushed, a spike, a dead wheel": ("encoder", [-0.028380703, 0, 0.035019227, 183.1801,
        -0.027042707, 0, -0.025777768, -0.05126301, -0.0061471736, -0.066185351, -0.014682906,
        -4.7135092]),
    "carried": ("encoder", [0.10121913, 0, 0.041644493, 105.66667, 0.11539328, 0, 0.090989519,
        -0.051259902, 0.028308461, -0.06482167, 0.025168714, -2.855785]),
    "moved markers": ("sightings-rejected", [-0.038751017, 0, -0.0010222184, 225.31544,
        -0.030536393, 0, -0.023787109, 1.637253, 0.043407972, -0.71469729, 0.011437331,
        -4.0953304]),
    "few markers": ("encoder sightings-rejected", [0.047050195, 0, -0.034895661, 71.701914,
        0.061577475, 0, 0.028449938, 2.7853531, -0.028941553, -2.6280345, -0.032968055,
        -5.1335437]),
    "ranges alone": ("antenna", [0.024677985, 0, 0.038869153, -4.6438031])}


def digest(drive):
    """Two numbers for each problem of a drive, and the kinds of all its doubts.

    Weighted sums of poses, maps and the logarithms of their variances, and of the facts.
    """
    options, poses, change = DRIVES[drive]
    dataset = change(simulate("short", seed=8, **options)[0].first(poses))
    found, said = [], {doubt.what for doubt in doubts_before_solving(dataset)}
    for solution in solve.solutions(dataset):
        maps = [each for each in (solution.aruco_map, solution.uwb_map) if each is not None]
        logs = [np.log(1e-12 + np.diagonal(C, axis1=1, axis2=2)) for C in (
            solution.covariances, *(C for *_, C in maps))]
        facts = {key: each for key, each in solution.facts.items() if key != "seconds"}
        found += [weighted(solution.poses, *(place for _, place, _ in maps), *logs),
                  weighted(flat(facts))]
        said |= {doubt.what for doubt in solution.doubts}
    return found, " ".join(sorted(said))


def weighted(*arrays):
    """Sum of all finite numbers with weights that no exchange or sign leaves as it is."""
    numbers = np.concatenate([np.ravel(each) for each in arrays])
    return float(np.nansum(np.cos(np.arange(len(numbers))**0.7) * numbers) / max(1, len(numbers)))


def flat(facts):
    """All numbers in lists and dicts."""
    if isinstance(facts, (dict, list)):
        each = facts.values() if isinstance(facts, dict) else facts
        return np.concatenate([[], *map(flat, each)])
    return np.array([] if isinstance(facts, str) else [facts], float)


@pytest.mark.parametrize("drive", DRIVES)
def test_numbers(drive):
    said, numbers = NUMBERS[drive]
    found, kinds = digest(drive)
    assert kinds == said
    np.testing.assert_allclose(found, numbers, rtol=1e-5, atol=1e-8)


if __name__ == "__main__":
    for name in DRIVES:
        numbers, said = digest(name)
        text = f'"{name}": ("{said}", [{", ".join(f"{each:.8g}" for each in numbers)}]),'
        print(textwrap.fill(text, 100, initial_indent=4 * " ", subsequent_indent=8 * " "))
