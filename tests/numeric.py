"""Numerical derivatives, shared by the tests."""

import numpy as np


def central_differences(function, x, step=1e-6):
    """Jacobian of function: (p,) -> (..., ) at x, shape (..., p)."""
    x = np.asarray(x, dtype=float)
    columns = []
    for i in range(len(x)):
        h = np.zeros(len(x))
        h[i] = step
        columns.append((function(x + h) - function(x - h)) / (2 * step))
    return np.stack(columns, -1)
