"""Simulated drives that are not as their files state, spoilt in one way at a time."""

from dataclasses import replace

import numpy as np

from slamlib import estimate
from slamlib.core import se2
from slamlib.core.records import Dataset
from slamlib.studies.montecarlo import both_graphs, judged
from slamlib.studies.simulation import distances, simulate

CAMERA = np.array([0.10, 0.05, 0.03])         # m, m, rad, of a camera that is not at the origin
BUMP = np.array([0.05, -0.03, 0.06])          # m, m, rad, by which something moves it
OPTIONS = {"slip of 3 mm": {"slip": 3e-3}, "3 % wrong labels": {"mislabelled": 0.03},
           "errors with memory": {"memory": 0.9}}     # of `simulate`


def with_camera_at(dataset: Dataset, camera: np.ndarray, first: int = 0) -> Dataset:
    """The Dataset of a camera at this pose (3,) from encoder pose `first` on, as no file says."""
    aruco = dataset.aruco
    camera = np.where((aruco.pose >= first)[:, None], camera, 0.0)
    return replace(dataset, aruco=replace(
        aruco, marker_in_vehicle=se2.between(camera, aruco.marker_in_vehicle),
        covariance=se2.rotate_covariance(aruco.covariance, -camera[:, 2])))


def with_counts(dataset: Dataset, rows: slice | int, change) -> Dataset:
    """The Dataset with the counts in `rows` changed by a function of them, (m, 2)."""
    ticks = dataset.ticks.copy()
    ticks[rows] = np.rint(change(ticks[rows]))
    return replace(dataset, ticks=ticks)


def with_ids_twice(dataset: Dataset, marker: np.ndarray, places: np.ndarray) -> Dataset:
    """The Dataset in which pairs of markers (k,), at places (k, 3) far apart, share an id."""
    apart = np.triu(distances(places[:, None], places))
    ids = dataset.aruco.marker.copy()
    for _ in range(len(marker) // 2):
        first, second = np.unravel_index(apart.argmax(), apart.shape)
        ids[ids == marker[second]] = marker[first]
        for k in (first, second):
            apart[k] = apart[:, k] = 0.0
    return replace(dataset, aruco=replace(dataset.aruco, marker=ids))


SPOILED = {
    "as stated": lambda d, _: d,
    "slip of 3 mm": lambda d, _: d,
    "3 % wrong labels": lambda d, _: d,
    "camera elsewhere": lambda d, _: with_camera_at(d, CAMERA),
    "errors with memory": lambda d, _: d,
    # by half a radian on the spot, which the vehicle does not turn
    "wheels spin once": lambda d, _: with_counts(d, 1000, lambda n: n + [1273, -1273]),
    "counts lost in 300 poses": lambda d, _: with_counts(d, slice(900, 1200), lambda n: 0 * n),
    "wheels exchanged in 400 poses": lambda d, _: with_counts(
        d, slice(800, 1200), lambda n: n[:, ::-1]),
    "6 % slip on a carpet": lambda d, _: with_counts(d, slice(900, 1200), lambda n: 1.06 * n),
    "camera moved once": lambda d, _: with_camera_at(d, BUMP, first=900),
    "every id twice": lambda d, truth: with_ids_twice(d, truth.marker, truth.marker_in_world)}


def needs(seed: int) -> dict:
    """The plain graph and `estimate` in each of SPOILED, on one short drive.

    Returns
    -------
    dict of "nees" and "ate" in m of poses with sightings, as "as stated, plain nees".
    """
    numbers = {}
    for case, spoil in SPOILED.items():
        dataset, truth = simulate("short", seed, **OPTIONS.get(case, {}))
        dataset = spoil(dataset.without("uwb"), truth)
        for name, at, poses, C in both_graphs(dataset, estimate(dataset)):
            numbers |= judged(f"{case}, {name}", poses, C, truth.poses[at])
    return numbers
