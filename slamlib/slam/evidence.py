"""Stage 6: the evidence of the noise, from one linearisation for all values of the noise."""

from functools import lru_cache

import numpy as np

from slamlib.slam.normal_equations import NormalEquations, decomposition


def solve(equations, noise):
    """Solution delta (n,) of NormalEquations for a Noise, and the log evidence, up to a constant.

    With half the squared error e at the solution, the odometry noise Q, factors l_s and l_r on the
    sigmas of S errors of sightings and R of ranges, and the information H,

        log evidence = -e - sum log|Q| / 2 - S log l_s - R log l_r - log|H| / 2

    (MacKay, Neural Computation 4(3), 1992). The omitted constant depends on the dataset and the
    weights: only problems on the same accepted measurements can be compared. The log evidence is
    minus infinity where H is singular to rounding.
    """
    H, g, squared, log_determinant = equations.sums(
        noise, consistencies(equations.problem.measured))
    lu = decomposition(equations.structure.matrix(H))
    pivots = np.zeros(1) if lu is None else lu.U.diagonal()
    if (pivots <= 0).any():                              # those of a positive definite H are not
        return np.full(len(g), np.nan), -np.inf
    delta, (sightings, ranges) = -lu.solve(g), equations.counts()
    return delta, -(squared + g @ delta) / 2 - log_determinant / 2 \
        - np.sum(np.log(pivots)) / 2 \
        - sightings * np.log(noise.sightings) - ranges * np.log(noise.ranges)


def consistencies(measured):
    """`consistency` (3,) of the sightings of poses, of points, and of ranges, as by `factors`."""
    return (consistency(measured.sighting_kernel, 3), consistency(measured.sighting_kernel, 2),
            consistency(measured.range_kernel))


@lru_cache(maxsize=8)
def consistency(kernel, size=1):
    """Weighted mean of the squares of standard normal residuals under a kernel's weights.

    A residual has `size` components, and the kernel weighs its length, or its sign too if it is one
    number.

    A kernel takes part of the variance of Gaussian residuals; without this factor the learned sigma
    would be too small (Huber and Ronchetti, Robust Statistics, 2009, chapter 5). It is 1 without
    kernel.
    """
    if kernel is None:
        return 1.0
    r = np.linspace(-6 if size == 1 else 0, 6, 241)
    density = r**(size - 1) * np.exp(-r**2 / 2) * np.array([kernel.weight(x) for x in r])
    return float(np.sum(r**2 * density) / np.sum(density)) / size


def log_evidence(problem, state):
    """Laplace log evidence of a Problem at a State near its optimum, as `solve`."""
    return solve(NormalEquations(problem, state), problem.noise)[1]
