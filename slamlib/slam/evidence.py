"""Stage 6: the Laplace evidence, from one linearisation for all values of the noise."""

from functools import lru_cache

import numpy as np

from slamlib.slam.normal_equations import NormalEquations, decomposition


def laplace_approximation(equations, noise):
    """Solution delta (n,) of NormalEquations for a Noise, and the log evidence, up to a constant.

    With the whitened errors e at the solution, the noise factors l_s and l_r of S errors of
    sightings and R of ranges,

        log evidence = -|e|^2 / 2 - sum log|Q| / 2 - S log l_s - R log l_r - log|H| / 2

    (MacKay, Neural Computation 4(3), 1992). The omitted constant depends on the dataset and the
    weights: only problems on the same accepted measurements can be compared. The log evidence is
    minus infinity where H is singular to rounding.
    """
    H, g, squared, log_determinant = equations.sums(
        noise, consistency_factors(equations.problem.accepted))
    lu = decomposition(equations.structure.matrix(H))
    pivots = np.zeros(1) if lu is None else lu.U.diagonal()
    if (pivots <= 0).any():                              # H is not positive definite
        return np.full(len(g), np.nan), -np.inf
    delta, (sightings, ranges) = -lu.solve(g), equations.counts()
    return delta, -(squared + g @ delta) / 2 - log_determinant / 2 \
        - np.sum(np.log(pivots)) / 2 \
        - sightings * np.log(noise.sightings) - ranges * np.log(noise.ranges)


def consistency_factors(accepted):
    """`consistency_factor` (3,) of sightings of poses, of points, and of ranges."""
    return (consistency_factor(accepted.sighting_kernel, 3),
            consistency_factor(accepted.sighting_kernel, 2),
            consistency_factor(accepted.range_kernel))


@lru_cache(maxsize=8)
def consistency_factor(kernel, size=1):
    """Mean of the squares of standard normal residuals of `size` components, weighted by a kernel.

    The kernel weighs a residual by its norm, or by its signed value if `size` is 1. It removes part
    of the variance of Gaussian residuals; without this factor the learned sigma would be too small
    (Huber and Ronchetti, Robust Statistics, 2009, chapter 5). The factor is 1 without kernel.
    """
    if kernel is None:
        return 1.0
    r = np.linspace(-6 if size == 1 else 0, 6, 241)
    density = r**(size - 1) * np.exp(-r**2 / 2) * np.array([kernel.weight(x) for x in r])
    return float(np.sum(r**2 * density) / np.sum(density)) / size


def log_evidence(problem, state):
    """Log evidence of a Problem by `laplace_approximation` at a State near its optimum."""
    return laplace_approximation(NormalEquations(problem, state), problem.noise)[1]
