"""Stage 6: the noise of a drive, learned from its own measurements, and how well it is known.

The evidence times the prior is the posterior of the logarithms of slip and factors. Newton's method
finds its mode, differences give its covariance. Poses and landmarks are averaged over a few points
of it (integrated nested Laplace approximation: Rue, Martino and Chopin, J. R. Stat. Soc. B 71(2),
2009), so that every slip that is possible widens the covariance by its probability.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from slamlib.slam.evidence import solve
from slamlib.slam.first_frames import first_frames
from slamlib.slam.noise import (
    BOUNDS,
    MEDIAN,
    PRIOR_SIGMA,
    Noise,
    from_logarithms,
    is_known,
    log_prior,
)

MAX_DIFFERENCE = 0.2         # of the logarithms, over which derivatives are taken
MIN_DIFFERENCE = 0.003
MAX_STEP = 1.5               # of Newton's method
MAX_STEPS = 12
MANY_FRAMES = 20_000         # of a longer drive, from the first of which the noise is learned
GAIN = 0.01                  # log posterior of a step at which Newton's method ends
ACROSS = 1.5 * np.arange(-2, 3)      # sigmas of log slip, points at which the posterior is summed
NARROW = 0.2                 # sigma of log slip below which one point is enough
NEGLIGIBLE = 1e-3            # weight of a point that is left out
IMPOSSIBLE = -1e12           # log evidence of noise for which the equations are singular


@dataclass(frozen=True)
class NoisePosterior:
    """Noise given the measurements."""

    noise: Noise                 # of greatest posterior density
    covariance: np.ndarray       # (3, 3) of its logarithms; zero for what is not learned
    density: float               # log posterior at `noise`, up to a constant
    points: tuple                # of (weight, Noise), over which estimates are averaged


def noise_posterior(equations):
    """The NoisePosterior by NormalEquations near a problem's solution; starts from its noise."""
    equations = first_frames(equations, MANY_FRAMES)
    log_posterior, start, free = _log_posterior(equations)
    value = log_posterior(start)
    if value < IMPOSSIBLE / 2:                           # singular to rounding: nothing is learned
        given = equations.problem.noise
        return NoisePosterior(given, np.zeros((3, 3)), IMPOSSIBLE, ((1.0, given),))
    frames = len(equations.problem.measurements.frame)
    smallest = 1 / np.sqrt(2 * np.maximum([3 * frames, *equations.counts()], 1))
    mode, density, covariance = _mode(log_posterior, start, value, free, smallest[free])
    return NoisePosterior(from_logarithms(mode), covariance, density,
                          _points(log_posterior, mode, density, covariance))


def density(equations):
    """The log density of the noise that the equations' problem has, up to a constant."""
    log_posterior, noise, _ = _log_posterior(first_frames(equations, MANY_FRAMES))
    return log_posterior(noise)


def greatest_density(equations, posterior):
    """The greatest log density of the noise that `noise_posterior` finds, up to a constant.

    `posterior` is the NoisePosterior of nearly the same equations.
    """
    log_posterior, start, free = _log_posterior(first_frames(equations, MANY_FRAMES))
    covariance = posterior.covariance[np.ix_(free, free)]
    information = np.linalg.inv(covariance)
    scale = np.sqrt(np.diag(information))
    return _mode(log_posterior, start, log_posterior(start), free, np.sqrt(np.diag(covariance)),
                 information / np.outer(scale, scale))[1]


def _log_posterior(equations):
    """The function from `Noise.logarithms` to log density, where it starts, and what is free."""
    problem = equations.problem
    free = problem.measurements.learned

    def log_posterior(logarithms):
        return max(solve(equations, from_logarithms(logarithms))[1], IMPOSSIBLE) \
            + np.sum(log_prior(logarithms)[free])

    start = np.where(free | is_known(problem.measurements.dataset.vehicle),
                     problem.noise.logarithms, np.log(MEDIAN))
    return log_posterior, start, np.flatnonzero(free)


def _mode(function, x, value, free, steps, correlation=None):
    """Argument, value and covariance (3, 3) of the maximum of a log density, by Newton's method.

    From `x` (3,) with its `value`. Derivatives by the components `free` (p,) are differences over
    `steps` (p,), later over standard deviations. `correlation` (p, p) is that of the second
    derivatives where it is known, to save mixed ones.
    """
    steps = np.clip(steps, MIN_DIFFERENCE, MAX_DIFFERENCE)
    for _ in range(MAX_STEPS):
        gradient, hessian = _differences(function, x, value, free, steps, correlation)
        curvature, axes = np.linalg.eigh(-hessian)
        covariance = axes / np.maximum(curvature, PRIOR_SIGMA.max()**-2) @ axes.T
        sigma = np.clip(np.sqrt(np.diag(covariance)), MIN_DIFFERENCE, MAX_DIFFERENCE)
        coarse, steps = (steps > 2 * sigma).any(), sigma
        step = covariance @ gradient
        step *= MAX_STEP / max(MAX_STEP, np.abs(step).max())
        while (new := function(_moved(x, free, step))) < value and np.abs(step / sigma).max() > 0.1:
            step = step / 2
        gained = new - value
        if gained > 0:
            x, value = _moved(x, free, step), new
        if gained < GAIN and not coarse:
            break
    full = np.zeros((len(x), len(x)))
    full[np.ix_(free, free)] = covariance
    return x, value, full


def _moved(x, free, step):
    moved = x.copy()
    moved[free] += step
    return np.clip(moved, *BOUNDS)


def _differences(function, x, value, free, steps, correlation=None):
    """Gradient (p,) and Hessian (p, p) by central differences of the free components by `steps`.

    Mixed second derivatives have the `correlation` (p, p) if it is given.
    """
    unit, pairs = np.diag(steps), list(combinations(range(len(free)), 2))
    offsets = [*unit, *-unit]
    if correlation is None:
        offsets += [unit[i] + unit[j] for i, j in pairs]
    values = np.array([function(_moved(x, free, off)) for off in offsets])
    up, down, both = np.split(values, [len(free), 2 * len(free)])
    gradient, hessian = (up - down) / (2 * steps), np.diag((up + down - 2 * value) / steps**2)
    if correlation is not None:
        scale = np.sqrt(np.abs(np.diag(hessian)))
        return gradient, np.where(np.eye(len(free)), hessian, -correlation * np.outer(scale, scale))
    for (i, j), value_of_both in zip(pairs, both):
        hessian[i, j] = hessian[j, i] = (value_of_both - up[i] - up[j] + value) \
            / (steps[i] * steps[j])
    return gradient, hessian


def _points(log_posterior, mode, density, covariance):
    """(weight, Noise) along the slip, at each the most probable factors.

    What remains uncertain at a point widens its noise: a sigma is replaced by its root mean square.
    """
    sigma = np.sqrt(covariance[0, 0])
    along = covariance[0] / (sigma or 1)     # of all logarithms, for one sigma of slip; 0 if known
    if sigma < NARROW:
        rest, offsets, weights = covariance, [0.0], np.ones(1)
    else:
        rest, offsets = covariance - np.outer(along, along), ACROSS
        logs = np.array([log_posterior(mode + z * along) if z else density for z in offsets])
        weights = np.exp(logs - logs.max())
    mean_square = np.maximum(np.diag(rest), 0)
    return tuple((float(weight), from_logarithms(mode + z * along + mean_square))
                 for weight, z in zip(weights / weights.sum(), offsets) if weight > NEGLIGIBLE)
