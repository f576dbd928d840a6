"""Numerical derivatives and standard errors, shared by the tests."""

import numpy as np


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
    """True if the mean of paired differences (s,) exceeds zero by two standard errors."""
    return differences.mean() > 2 * differences.std(ddof=1) / np.sqrt(len(differences))
