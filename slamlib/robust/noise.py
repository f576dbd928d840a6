"""Stage 6: the noise parameters learned from the drive's own measurements: their posterior.

All three are log-normal a priori, with medians of 1 mm after one metre and of 1, and standard
deviations of a factor of 3 and of 2. The evidence times this prior is the posterior of the
logarithms of slip and factors. Newton's method finds its mode, differences give its covariance.
Poses and landmarks are averaged over a few points of it (integrated nested Laplace approximation:
Rue, Martino and Chopin, J. R. Stat. Soc. B 71(2), 2009), so that the covariances include that the
slip is uncertain.
"""

from dataclasses import dataclass

import numpy as np

from slamlib.core.increments import SLIP_FACTOR, TYPICAL_SLIP
from slamlib.robust.linear import laplace_approximation
from slamlib.robust.measurements import Noise, with_known

MEDIAN = np.array([TYPICAL_SLIP, 1.0, 1.0])        # sqrt(m), 1, 1: of the prior
PRIOR_SIGMA = np.log([SLIP_FACTOR, 2.0, 2.0])      # (3,) standard deviations of the logarithms
BOUNDS = np.log(MEDIAN) + np.log(100) * np.array([[-1], [1]])      # (2, 3) of the logarithms

MAX_DIFFERENCE = 0.2         # of a logarithm, largest one of a difference quotient
MIN_DIFFERENCE = 0.003       # of a logarithm, smallest one of a difference quotient
MAX_STEP = 1.5               # of a logarithm, longest step of Newton's method
SHORTEST_STEP = 0.1          # sigmas, to which a step that does not ascend is halved
MAX_NEWTON_STEPS = 12        # number of steps of Newton's method
CONVERGED_GAIN = 0.01        # log posterior gained by Newton's last step, beside what it predicts
POINT_OFFSETS = 1.5 * np.arange(-2, 3)       # sigmas of log slip, points of the average
SINGLE_POINT_SIGMA = 0.2     # of log slip, below which the mode alone is enough
MIN_POINT_WEIGHT = 1e-3      # probability of a point; less probable ones are left out
SINGULAR = -1e12             # log evidence of noise for which the equations are singular

HIDDEN_RATIO = 2.0           # largest ratio of errors with memory to what residuals show of them


def with_hidden_errors(noise, remember, vehicle):
    """The Noise with larger factors for errors with memory, of which residuals show only a part.

    The factors of sightings and of ranges, where their errors `remember` (2,), are at least 1, but
    at most HIDDEN_RATIO times the learned ones. Those that a Vehicle gives stay.
    """
    sightings, ranges = (
        max(factor, min(1.0, HIDDEN_RATIO * factor)) if remembers else factor
        for factor, remembers in zip(noise[1:], remember))
    return with_known(Noise(noise.slip, sightings, ranges), vehicle)


@dataclass(frozen=True)
class NoisePosterior:
    """Posterior of the noise given the measurements."""

    noise: Noise                 # the mode
    covariance: np.ndarray       # (3, 3) of its logarithms, 0 for parameters that are not learned
    log_density: float           # log posterior at the mode, up to a constant
    points: tuple                # of (probability, Noise), over which estimates are averaged


def learn_noise(equations):
    """The NoisePosterior by NormalEquations near the solution, from the noise of their problem."""
    noise, m = equations.problem.noise, equations.problem.measurements
    free = np.flatnonzero(m.learned)

    def log_posterior(logarithms):
        _, evidence = laplace_approximation(equations, Noise(*np.exp(logarithms)))
        prior = -((logarithms - np.log(MEDIAN)) / PRIOR_SIGMA)[free]**2 / 2
        return max(evidence, SINGULAR) + np.sum(prior)

    start = np.log(noise)
    value = log_posterior(start)
    if value < SINGULAR / 2:                             # nothing can be learned
        return NoisePosterior(noise, np.zeros((3, 3)), SINGULAR, ((1.0, noise),))
    smallest = 1 / np.sqrt(2 * np.maximum([3 * len(m.frame), *equations.counts()], 1))
    mode, value, covariance = _mode(log_posterior, start, value, free, smallest[free])
    return NoisePosterior(Noise(*np.exp(mode)), covariance, value,
                          _points(log_posterior, mode, value, covariance))


def _mode(function, x, value, free, steps):
    """Argument, value and covariance (3, 3) of the maximum of a log density, by Newton's method.

    From `x` (3,) with its `value`. Derivatives by the components `free` (p,) are differences over
    `steps` (p,), later over standard deviations.
    """
    steps = np.clip(steps, MIN_DIFFERENCE, MAX_DIFFERENCE)

    def moved(step):
        """x with `step` (p,) added to the free components, within BOUNDS."""
        stepped = x.copy()
        stepped[free] += step
        return np.clip(stepped, *BOUNDS)

    for _ in range(MAX_NEWTON_STEPS):
        unit, pairs = np.diag(steps), np.triu_indices(len(free), 1)
        offsets = np.concatenate([unit, -unit, unit[pairs[0]] + unit[pairs[1]]])
        up, down, both = np.split(
            np.array([function(moved(offset)) for offset in offsets]) - value,
            [len(free), 2 * len(free)])
        gradient, hessian = (up - down) / (2 * steps), np.diag((up + down) / steps**2)
        mixed = (both - up[pairs[0]] - up[pairs[1]]) / (steps[pairs[0]] * steps[pairs[1]])
        hessian[pairs] = hessian.T[pairs] = mixed
        curvature, axes = np.linalg.eigh(-hessian)
        covariance = axes / np.maximum(curvature, PRIOR_SIGMA.max()**-2) @ axes.T
        sigma = np.clip(np.sqrt(np.diag(covariance)), MIN_DIFFERENCE, MAX_DIFFERENCE)
        coarse, steps = (steps > 2 * sigma).any(), sigma
        step = covariance @ gradient
        step *= MAX_STEP / max(MAX_STEP, np.abs(step).max())
        while (new := function(moved(step))) < value and np.abs(step / sigma).max() > SHORTEST_STEP:
            step = step / 2
        gain = new - value
        if gain > 0:
            x, value = moved(step), new
        if min(gain, abs(gain - gradient @ step / 2)) < CONVERGED_GAIN and not coarse:
            break
    full = np.zeros((len(x), len(x)))
    full[np.ix_(free, free)] = covariance
    return x, value, full


def _points(log_posterior, mode, value, covariance):
    """Tuple of (probability, Noise) along the slip, each with the most probable factors.

    Each point has the root mean square exp(mu + s^2) of its log-normal noise parameters.
    `mode` (3,), with its `value`, and `covariance` (3, 3) are of the logarithms.
    """
    sigma = np.sqrt(covariance[0, 0])
    direction = covariance[0] / (sigma or 1)     # (3,) for one sigma of log slip; 0 if it is known
    if sigma < SINGLE_POINT_SIGMA:
        remaining, offsets, weights = covariance, [0.0], np.ones(1)
    else:
        remaining, offsets = covariance - np.outer(direction, direction), POINT_OFFSETS
        logs = np.array([log_posterior(mode + offset * direction) if offset else value
                         for offset in offsets])
        weights = np.exp(logs - logs.max())
    variance = np.maximum(np.diag(remaining), 0)
    return tuple((float(weight), Noise(*np.exp(mode + offset * direction + variance)))
                 for weight, offset in zip(weights / weights.sum(), offsets)
                 if weight > MIN_POINT_WEIGHT)
