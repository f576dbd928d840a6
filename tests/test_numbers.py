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
from slamlib.robust.file_doubts import doubts_before_solving
from slamlib.studies.simulation import simulate


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
    "moved markers": ({"rounds": 2}, 1400, moved_markers),
    "ranges alone": ({}, 900, lambda d: vehicle(sigma_heading=0.1)(d.without("aruco")))}

NUMBERS = {
    "clean": ("", [0.0740219, 0, -0.0221293, 90.51343, 0.06030478, 0, 0.04948967, -0.05125054,
        -0.05885554, -0.02971923, -0.08281633, 2.597717]),
    "wrong labels and late ranges": ("antenna sightings-rejected", [-0.09456859, 0, -0.01643187,
        78.20053, -0.113744, 0, -0.08973058, 1.029289, 0.01967808, 11.44315, 0.02625995, 9.346641]),
    "memory": ("antenna marker-memory range-memory", [-0.04894439, 0, 0.05706399, 103.9821,
        -0.03115722, 0, -0.02776677, -0.05127993, 0.09273782, -3.832411, 0.09624139, -3.052595]),
    "points": ("antenna", [-0.1161873, 0, 0.09438039, 60.51343, -0.1107597, 0, -0.09411105,
        -0.0512981, 0.1489749, -0.03084906, 0.1242967, 1.741726]),
    "camera and antennas": ("antenna-height camera-offset", [0.0362439, 0, -0.07379241, 139.8468,
        0.02120465, 0, 0.01579533, -0.05124973, -0.08704875, -0.01260784, -0.06125045, 2.503204]),
    "Euler's steps, a slow camera": ("time-offset", [0.0363426, 0, -0.08217368, 137.8468,
        0.02299431, 0, 0.01281777, -0.05090639, -0.0904908, -0.1980426, -0.06041427, -1.089505]),
    "wrong scatter": ("marker-noise range-noise", [0.07389892, 0, -0.02668008, 114.6469, 0.0594933,
        0, 0.05151454, 5.558918, -0.0521681, -0.1897311, -0.07825586, 2.701739]),
    "pushed, a spike, a dead wheel": ("encoder", [-0.0283807, 0, 0.03501923, 183.1801, -0.02704271,
        0, -0.02539982, -0.05125468, -0.006133152, -0.05322791, -0.01466686, -8.060733]),
    "moved markers": ("sightings-rejected", [-0.03875102, 0, -0.001022218, 225.3154, -0.03053639, 0,
        -0.02521152, 1.637242, 0.04340308, -0.792085, 0.01143122, -9.146643]),
    "ranges alone": ("antenna", [0.02467799, 0, 0.03886921, -6.212309])}


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
        facts = {key: each for key, each in solution.facts.items()
                 if key not in ("seconds", "gtsam")}
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
        text = f'"{name}": ("{said}", [{", ".join(f"{each:.7g}" for each in numbers)}]),'
        print(textwrap.fill(text, 100, initial_indent=4 * " ", subsequent_indent=8 * " "))
