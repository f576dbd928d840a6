"""Numerical derivatives, standard errors and known noise, shared by the tests."""

import numpy as np
from scipy.stats import t

from slamlib.slam.noise import with_noise


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


def known_noise(dataset, slip):
    """The Dataset of a drive with this slip in sqrt(m), and the noise that its files state."""
    return with_noise(dataset, slip, marker_noise_factor=1.0, range_noise_factor=1.0)
