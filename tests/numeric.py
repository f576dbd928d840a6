"""Numerical derivatives, standard errors, drives, changes of drives and trials, for all tests."""

from dataclasses import replace
from functools import partial

import numpy as np
from joblib import parallel_config
from scipy.stats import t

from slamlib import estimate, studies
from slamlib.core import se2
from slamlib.core.evaluation import anees, ate, nees, nees_band
from slamlib.core.records import ArucoReadings
from slamlib.robust.solution_doubts import solution_doubts
from slamlib.studies.montecarlo import antenna_error
from slamlib.studies.simulation import PATHS, simulate


def short(seed, poses=None, path="short", rounds=1, step=1, **options):
    """A simulated drive whose path is driven `rounds` times, or its first poses.

    Steps of the encoder, and so the images, are `step` times as far apart as usual.
    """
    layout = PATHS[path]
    turns = tuple(rounds * turn for turn in layout.turns)
    PATHS["rounds"] = replace(layout, turns=turns, poses=rounds * layout.poses // step)
    dataset, truth = simulate("rounds", seed, poses=poses, **options)
    return replace(dataset, name=path), truth


def trials(trial, seeds, **options):
    """`studies.run` in this process alone: beside it runs another one of pytest-xdist."""
    with parallel_config("sequential"):
        return studies.run(trial, seeds, **options)


def central_differences(function, x, step=1e-6):
    """Jacobian (..., p) at x (p,) of a function from (p,) to (...)."""
    x = np.asarray(x, dtype=float)
    columns = []
    for i in range(len(x)):
        h = np.zeros(len(x))
        h[i] = step
        columns.append((function(x + h) - function(x - h)) / (2 * step))
    return np.stack(columns, -1)


def decided(differences):
    """True where the mean of paired differences (s,) is above zero in a t test of 2.5 %."""
    error = differences.std(ddof=1) / np.sqrt(len(differences))
    return differences.mean() > t.ppf(0.975, len(differences) - 1) * error


def sightings(pose, marker, z, covariance):
    """ArucoReadings of markers at z (m, 3), with one covariance (3, 3) or one of each."""
    return ArucoReadings(np.array(pose), np.array(marker), np.array(z, float),
                         np.broadcast_to(covariance, (len(z), 3, 3)))


def true_markers(truth, marker):
    """True places (m, 3) of markers with these ids (m,)."""
    return truth.marker_in_world[np.searchsorted(truth.marker, marker)]


def errors_of(covariances, rng):
    """Random errors (m, 3) with these covariances (m, 3, 3)."""
    return (np.linalg.cholesky(covariances) @ rng.normal(size=(len(covariances), 3, 1)))[..., 0]


def mean_nees(found, truth):
    """Mean NEES of the poses of a result; 3 is right."""
    return anees(found.poses, found.covariances, truth.poses)


def aligned_ate(found, truth):
    """ATE in m of a result, after alignment."""
    return ate(found.poses, truth.poses, aligned=True)


def assert_consistent(values, dof=3, probability=0.95):
    """The mean of independent NEES is in its two-sided band."""
    low, high = nees_band(len(values), dof, probability)
    assert low < np.mean(values) < high


def changed(dataset, sensor, **fields):
    """The Dataset with other `fields` of its readings "aruco" or "uwb"."""
    return replace(dataset, **{sensor: replace(getattr(dataset, sensor), **fields)})


aruco, uwb = (partial(changed, sensor=sensor) for sensor in ("aruco", "uwb"))


def only(dataset, rows):
    """The Dataset with some of its sightings."""
    return replace(dataset, aruco=dataset.aruco.select(rows))


def vehicle(**fields):
    """A change of a Dataset: other fields of its Vehicle."""
    return lambda d: replace(d, vehicle=replace(d.vehicle, **fields))


def counts(rows, change):
    """A change of a Dataset: of the counts in some rows."""
    def of(d):
        ticks = d.ticks.copy()
        ticks[rows] = change(ticks[rows])
        return replace(d, ticks=ticks)
    return of


def carried(d, begin, end):
    """The Dataset without what is recorded from pose `begin` to `end`, while the vehicle moves."""
    readings = {}
    for name in ("aruco", "uwb"):
        each = getattr(d, name)
        each = each.select((each.pose < begin) | (each.pose >= end))
        readings[name] = replace(each, pose=each.pose - (end - begin) * (each.pose >= end))
    return replace(d, ticks=np.delete(d.ticks, slice(begin, end), axis=0), **readings)


def seen_from(dataset, camera=(0.0, 0.0, 0.0), size=1.0):
    """The dataset of a camera elsewhere, (3,) or one of each sighting, of larger markers."""
    z = se2.between(camera, dataset.aruco.marker_in_vehicle)
    covariance = se2.rotate_covariance(dataset.aruco.covariance, -np.array(camera)[..., 2])
    scale = np.array([size, size, 1])
    return aruco(dataset, marker_in_vehicle=z / scale,
                 covariance=covariance / np.outer(scale, scale))


def standing(dataset, truth, rows, count, at=0, every=1):
    """The Dataset of a drive that stands for some rows at pose `at`, and its poses.

    It sees its markers there every few rows, while the counts creep by `count` a row.
    """
    seen = replace(dataset.aruco, pose=dataset.aruco.pose + rows * (dataset.aruco.pose > at))
    frames = at + np.arange(every, rows + 1, every)
    here = np.flatnonzero(seen.pose == at)
    joined = seen.select(np.append(np.arange(len(seen.pose)), np.tile(here, len(frames))))
    again = slice(len(seen.pose), None)
    joined.pose[again] = np.repeat(frames, len(here))
    z = se2.between(truth.poses[at], true_markers(truth, joined.marker[again]))
    z += errors_of(joined.covariance[again], np.random.default_rng(0))
    joined.marker_in_vehicle[again] = z
    ticks = np.insert(dataset.ticks, at + 1, np.full((rows, 2), count), axis=0)
    poses = np.insert(truth.poses, at + 1, np.tile(truth.poses[at], (rows, 1)), axis=0)
    order = np.argsort(joined.pose, kind="stable")
    return replace(dataset, ticks=ticks, aruco=joined.select(order), uwb=None), poses


def known_noise(dataset, slip):
    """The Dataset of a drive with this slip in sqrt(m), and the noise that its files state."""
    return vehicle(slip=slip, marker_noise_factor=1.0, range_noise_factor=1.0)(dataset)


def map_nees(found, truth):
    """NEES (k,) of the markers of a SlamResult or a Localization."""
    return nees(found.marker_in_world, found.marker_covariance, true_markers(truth, found.marker))


def wheel_nees(found, truth):
    """Squared error of the wheel parameters over their covariance."""
    error = found.wheel - truth.vehicle.wheel
    return error @ np.linalg.solve(found.wheel_covariance, error)


def slam_trial(seed, ranges=True, markers=True, **options):
    """SLAM with these sensors on one simulated drive of the short path, by its truth.

    "nees" is that of the measured poses, "nees between" that of the others.
    """
    dataset, truth = short(seed, **options)
    found = None
    if markers:
        found = estimate(dataset.without("uwb"))
    else:
        dataset = dataset.without("aruco")
    if ranges:
        found = estimate(dataset, previous=found)
    frame = found.fit.problem.measurements.frame
    values = nees(found.poses, found.covariances, truth.poses)
    numbers = {"nees": np.nanmean(values[frame]),
               "nees between": np.nanmean(np.delete(values, frame)),
               "last nees": values[-1], "wheel nees": wheel_nees(found, truth),
               "ate": ate(found.poses, truth.poses), "slip": found.slip,
               "factor": found.noise.sightings, "arc": found.model == "arc",
               "share": found.share.mean(), "doubts": len(solution_doubts(found))}
    if markers:
        off = found.marker_in_world - true_markers(truth, found.marker)
        numbers |= {"map nees": map_nees(found, truth).mean(),
                    "map worst": np.abs(off)[:, :2].max()}
    if ranges:
        error, squared = antenna_error(found, truth)
        numbers |= {"antenna nees": np.mean(squared), "antenna error": np.sqrt(np.mean(error**2))}
    return numbers


def as_points(aruco, rows, variance=1e4):
    """ArucoReadings of which some rows (mask) are sightings of points: headings are unknown."""
    covariance = aruco.covariance.copy()
    covariance[rows, 2] = covariance[rows, :, 2] = [0, 0, variance]
    return replace(aruco, covariance=covariance)


def without_headings(aruco, rows=slice(None)):
    """ArucoReadings of which some rows have random headings, as their variances say."""
    z = aruco.marker_in_vehicle.copy()
    z[rows, 2] = np.random.default_rng(0).uniform(-np.pi, np.pi, len(z[rows]))
    return replace(as_points(aruco, rows), marker_in_vehicle=z)
