"""Numerical derivatives, standard errors, changed drives and trials, shared by the tests."""

from dataclasses import replace

import numpy as np
from scipy.stats import t

from slamlib import slam
from slamlib.simulation import simulate
from slamlib.slam.linear import state_from_arrays
from slamlib.slam.measurements import with_known_noise
from slamlib.studies.montecarlo import judge_slam


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


def changed(dataset, sensor, **fields):
    """The Dataset with other `fields` of its readings "aruco" or "uwb"."""
    return replace(dataset, **{sensor: replace(getattr(dataset, sensor), **fields)})


def known_noise(dataset, slip):
    """The Dataset of a drive with this slip in sqrt(m), and the noise that its files state."""
    return with_known_noise(dataset, slip, marker_noise_factor=1.0, range_noise_factor=1.0)


def slam_trial(seed, ranges=True, markers=True, **options):
    """`judge_slam` of SLAM on one simulated drive of the short path, with these sensors."""
    dataset, truth = simulate("short", seed, **options)
    found = slam.estimate(dataset.without("uwb")) if markers else None
    if not ranges:
        return judge_slam(found, dataset.without("uwb"), truth)
    dataset = dataset if markers else dataset.without("aruco")
    return judge_slam(slam.estimate(dataset, previous=found), dataset, truth)


def as_points(aruco, rows, variance=1e4):
    """ArucoReadings of which some rows (mask) are sightings of points: headings are unknown."""
    covariance = aruco.covariance.copy()
    covariance[rows, 2] = covariance[rows, :, 2] = [0, 0, variance]
    return replace(aruco, covariance=covariance)


def true_state(measurements, truth):
    """The State of Measurements by the Truth of their drive, with the stated calibration."""
    m, rows = measurements, np.searchsorted(truth.marker, measurements.marker)
    return state_from_arrays(m, truth.poses[m.frame], truth.marker_in_world[rows],
                             truth.antenna_in_world[np.isin(truth.antenna, m.antenna)],
                             m.calibration.stated)
