"""The numbers of small drives, clean and spoilt, are what they were.

Whether they are right other tests judge. These notice a change that was not meant. After one that
was, `python tests/test_numbers.py` prints the new ones.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from numeric import as_points, changed

from slamlib import solve
from slamlib.checks.files import doubts_before_solving
from slamlib.simulation import simulate

aruco, uwb = (partial(changed, sensor=sensor) for sensor in ("aruco", "uwb"))


def vehicle(**fields):
    return lambda d: replace(d, vehicle=replace(d.vehicle, **fields))


def counts(rows, change):
    def of(d):
        ticks = d.ticks.copy()
        ticks[rows] = change(ticks[rows])
        return replace(d, ticks=ticks)
    return of


def carried(d, begin=300, end=380):
    """Nothing is recorded from pose `begin` to `end`, while the vehicle moves."""
    readings = {}
    for name in ("aruco", "uwb"):
        each = getattr(d, name)
        each = each.select((each.pose < begin) | (each.pose >= end))
        readings[name] = replace(each, pose=each.pose - (end - begin) * (each.pose >= end))
    return replace(d, ticks=np.delete(d.ticks, slice(begin, end), axis=0), **readings)


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
    "carried": ({}, 800, carried),
    "moved markers": ({"rounds": 2}, 1400, moved_markers),
    "few markers": ({}, 1200, few_markers),
    "ranges alone": ({}, 900, lambda d: vehicle(sigma_heading=0.1)(d.without("aruco")))}

NUMBERS = {
    "clean": ("", [
        0.023563423, -0.04883637, 0, -0.023632246, 0.1127855, 90.513434, 0.02356213,
        -0.078326031, 0, 0.023508115, -0.077264548, -0.051260871, -0.0016420137,
        0.088198554, -0.045254918, 0.0010379864, 0.080961487, 2.160474]),
    "wrong labels and late ranges": ("antenna sightings-rejected", [
        -0.01320478, 0.039785607, 0, 0.008323254, -0.085436881, 78.200527, -0.013204472,
        0.059095281, 0, -0.013167949, 0.042311862, 1.0292764, 0.0039389809, -0.09230092,
        10.396649, 0.0022472832, -0.087076095, 5.91038]),
    "memory": ("antenna marker-memory range-memory", [
        -0.022372944, 0.037777313, 0, 0.019981525, -0.12420176, 103.98211, -0.022372756,
        0.062078021, 0, -0.022348118, 0.045238694, -0.051277078, 1.706357e-05, -0.064712837,
        -3.4222975, -0.0016866123, -0.064089047, -4.6113827]),
    "points": ("antenna", [
        -0.020486209, 0.08116891, 0, 0.024128286, -0.17955825, 60.513434, -0.020485726,
        0.1161891, 0, -0.020451773, 0.10129598, -0.051304334, 0.0055113435, -0.088142259,
        -0.046297847, 0.0034238194, -0.081510945, 1.4709753]),
    "camera and antennas": ("antenna-height camera-offset", [
        0.020510636, -0.027331496, 0, -0.021145722, 0.072643381, 139.84677, 0.020510401,
        -0.046278969, 0, 0.020428525, -0.038002047, 0.82674596, -0.00084886566, 0.056530682,
        -0.004125229, 0.0030421353, 0.048396227, -0.70053915]),
    "Euler's steps, a slow camera": ("time-offset", [
        0.020535642, -0.027262687, 0, -0.023298094, 0.044316477, 137.84677, 0.020535217,
        -0.044774503, 0, 0.020448767, -0.040128503, -0.050764183, -0.00083382481,
        0.058324872, -0.34697814, 0.0030428008, 0.046141208, 3.08365]),
    "wrong scatter": ("marker-noise range-noise", [
        0.023641605, -0.048866164, 0, -0.025090861, 0.12179879, 114.64694, 0.023625585,
        -0.07935614, 0, 0.023539719, -0.05491983, 7.9182667, -0.0016837534, 0.086241232,
        -0.19290824, 0.00099920165, 0.07921244, 2.3028143]),
    "pushed, a spike, a dead wheel": ("encoder", [
        -0.0076547861, 0.0090291061, 0, -0.0091127349, 0.0082629711, 183.1801,
        -0.0076747357, 0.016483732, 0, -0.0062727479, -0.040406155, -0.05126301,
        -0.01392363, 0.0085141178, -0.066185351, -0.015358011, 0.011481183, -4.7135092]),
    "carried": ("encoder", [
        0.02105873, -0.03301043, 0, -0.0084788766, 0.038251203, 105.66667, 0.021059677,
        -0.05516812, 0, 0.022046129, -0.11979121, -0.051259902, 0.010315643, -0.030055763,
        -0.06482167, 0.01978665, -0.054172513, -2.855785]),
    "moved markers": ("sightings-rejected", [
        -0.011604894, 0.023144788, 0, 0.014165219, -0.041205664, 225.31544, -0.011604628,
        0.038606578, 0, -0.0115985, 0.032509658, 1.637253, 0.0040081418, -0.035210641,
        -0.71469729, -0.00042670966, -0.022880936, -4.0953304]),
    "few markers": ("encoder sightings-rejected", [
        0.011518685, -0.016236292, 0, 0.0020647832, -0.026256993, 71.701914, 0.011556237,
        -0.03093546, 0, 0.01164028, -0.013699283, 2.7853531, -0.0072897511, 0.034200657,
        -2.6280345, -0.0057278969, 0.028743046, -5.1335437]),
    "ranges alone": ("antenna", [
        0.020510636, -0.016056403, 0, 0.02373627, -0.018118237, -4.6438031])}


def digest(drive):
    """Three numbers for each problem of a drive, and the kinds of all its doubts.

    Weighted sums of poses and maps, of the logarithms of their variances, and of the facts.
    """
    options, poses, change = DRIVES[drive]
    dataset = change(simulate("short", seed=8, **options)[0].first(poses))
    found, said = [], {doubt.what for doubt in doubts_before_solving(dataset)}
    for solution in solve.solutions(dataset):
        maps = [each for each in (solution.aruco_map, solution.uwb_map) if each is not None]
        logs = [np.log(1e-12 + np.diagonal(C, axis1=1, axis2=2)) for C in (
            solution.covariances, *(C for *_, C in maps))]
        facts = {key: each for key, each in solution.facts.items() if key != "seconds"}
        found += [weighted(solution.poses, *(place for _, place, _ in maps)),
                  weighted(*logs), weighted(flat(facts))]
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
        print(f'    "{name}": ([{", ".join(f"{each:.8g}" for each in numbers)}],\n'
              f'        "{said}"),')
