"""Stage 6: the noise parameters learned from the drive's own measurements: their posterior.

All three are log-normal a priori, with medians of 1 mm after one metre and of 1, and standard
deviations of a factor of 3 and of 2. The evidence times this prior is the posterior of the
logarithms of slip and factors. Newton's method finds its mode, differences give its covariance.
The solution is that for the mean of this posterior, so that the covariances include that the noise
is uncertain.
"""

import logging
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from slamlib.core.increments import SLIP_FACTOR, TYPICAL_SLIP
from slamlib.core.vehicle import Vehicle
from slamlib.robust.linear import NormalEquations, laplace_approximation
from slamlib.robust.measurements import Noise, with_known

log = logging.getLogger(__name__)

MEDIAN = np.array([TYPICAL_SLIP, 1.0, 1.0])        # sqrt(m), 1, 1: of the prior
PRIOR_SIGMA = np.log([SLIP_FACTOR, 2.0, 2.0])      # (3,) standard deviations of the logarithms
BOUNDS = np.log(MEDIAN) + np.log(100) * np.array([[-1], [1]])      # (2, 3) of the logarithms

MAX_DIFFERENCE = 0.2         # of a logarithm, largest one of a difference quotient
MIN_DIFFERENCE = 0.003       # of a logarithm, smallest one of a difference quotient
MAX_STEP = 1.5               # of a logarithm, longest step of Newton's method
SHORTEST_STEP = 0.1          # sigmas, to which a step that does not ascend is halved
MAX_NEWTON_STEPS = 12        # number of steps of Newton's method
CONVERGED_GAIN = 0.01        # log posterior gained by Newton's last step, beside what it predicts
SINGULAR = -1e12             # log evidence of noise for which the equations are singular

POOR_FACTOR = 1.5            # of sightings, above which errors may be shared


def with_least_slip(noise: Noise, remember: bool, vehicle: Vehicle) -> Noise:
    """The Noise with the typical slip at least, if errors of a kind `remember` earlier ones.

    Slow errors are smoother than the shares of their information say, which makes the slip look
    small, and so do errors that all markers of an image share, for which the factor of the
    sightings is large. A slip that a Vehicle gives stays.
    """
    if remember or noise.sightings > POOR_FACTOR:
        noise = noise._replace(slip=max(noise.slip, TYPICAL_SLIP))
    return with_known(noise, vehicle)


@dataclass(frozen=True)
class NoisePosterior:
    """Posterior of the noise given the measurements."""

    noise: Noise                 # the mode
    covariance: np.ndarray       # (3, 3) of its logarithms, 0 for parameters that are not learned
    log_density: float           # log posterior at the mode, up to a constant
    lead: float = 0.0            # of it over that of the noise from which it was sought

    @property
    def mean(self) -> Noise:
        """The Noise exp(mu + s^2 / 2) of log-normal parameters of the mode exp(mu)."""
        return _noise_of(np.log(self.noise) + np.diag(self.covariance) / 2)


def learn_noise(equations: NormalEquations, is_free: np.ndarray | None = None) -> NoisePosterior:
    """The NoisePosterior by NormalEquations near the solution, from the noise of their problem.

    Of the parameters that `is_free` (3,), None for those that are learned.
    """
    noise = equations.problem.noise
    measurements = equations.problem.measurements
    if is_free is None:
        is_free = measurements.learned
    free = np.flatnonzero(is_free)
    log_posterior = partial(_log_posterior, equations, is_free)
    bounds = BOUNDS.copy()
    bounds[1, 0] = min(bounds[1, 0], np.log(equations.problem.max_slip))
    start = np.clip(np.log(noise), bounds[0], bounds[1])
    at_start = log_posterior(start)
    if at_start < SINGULAR / 2:                          # nothing can be learned
        return NoisePosterior(noise, np.zeros((3, 3)), SINGULAR)
    sightings, ranges = equations.counts()
    count = np.maximum([3 * len(measurements.frame), sightings, ranges], 1)
    sigma = 1 / np.sqrt(2 * count)                       # of the logarithm of a scatter
    mode, value, covariance = _mode(log_posterior, start, at_start, free, sigma[free], bounds)
    learned = _noise_of(mode)
    log.info("noise: slip %.3g mm after 1 m, factors %.3g of sightings and %.3g of ranges, "
             "log posterior %.1f", 1e3 * learned.slip, learned.sightings, learned.ranges, value)
    return NoisePosterior(learned, covariance, value, lead=value - at_start)


def _log_posterior(equations, is_free, logarithms):
    """Log posterior density, up to a constant, of these logarithms (3,) of the noise."""
    evidence = laplace_approximation(equations, _noise_of(logarithms))[1]
    off = (logarithms - np.log(MEDIAN)) / PRIOR_SIGMA
    return max(evidence, SINGULAR) - np.sum(off[is_free]**2) / 2


def _noise_of(logarithms):
    """The Noise with these logarithms (3,)."""
    return Noise(*np.exp(logarithms))


def _mode(log_density, x, value, free, steps, bounds):
    """Argument, value and covariance (3, 3) of the maximum of a log density, by Newton's method.

    From `x` (3,) with its `value`, within `bounds` (2, 3). Derivatives by the components `free`
    (p,) are differences over `steps` (p,), later over standard deviations.
    """
    steps = np.clip(steps, MIN_DIFFERENCE, MAX_DIFFERENCE)

    def moved(step):
        """x with `step` (p,) added to the free components, within the bounds."""
        stepped = x.copy()
        stepped[free] += step
        return np.clip(stepped, bounds[0], bounds[1])

    def density_at(step):
        return log_density(moved(step))

    for _ in range(MAX_NEWTON_STEPS):
        gradient, hessian = _derivatives(density_at, value, steps)
        covariance = _inverse_curvature(-hessian)
        sigma = np.clip(np.sqrt(np.diag(covariance)), MIN_DIFFERENCE, MAX_DIFFERENCE)
        step = covariance @ gradient
        step *= MAX_STEP / max(MAX_STEP, np.abs(step).max())
        new = density_at(step)
        while new < value and np.abs(step / sigma).max() > SHORTEST_STEP:
            step = step / 2
            new = density_at(step)
        gain = new - value
        predicted = gradient @ step / 2
        if gain > 0:
            x = moved(step)
            value = new
        too_coarse = (steps > 2 * sigma).any()
        if min(gain, abs(gain - predicted)) < CONVERGED_GAIN and not too_coarse:
            break
        steps = sigma
    of_all = np.zeros((len(x), len(x)))
    of_all[np.ix_(free, free)] = covariance
    return x, value, of_all


def _derivatives(density_at, value, steps):
    """Gradient (p,) and Hessian (p, p) at 0, by differences over `steps` (p,).

    `density_at` is a function of (p,) with this `value` at 0. A mixed derivative needs one point
    more, at which both components step.
    """
    offsets = np.diag(steps)
    up = np.array([density_at(offset) for offset in offsets]) - value
    down = np.array([density_at(-offset) for offset in offsets]) - value
    hessian = np.diag((up + down) / steps**2)
    for i, j in combinations(range(len(steps)), 2):
        both = density_at(offsets[i] + offsets[j]) - value
        hessian[i, j] = (both - up[i] - up[j]) / (steps[i] * steps[j])
        hessian[j, i] = hessian[i, j]
    return (up - down) / (2 * steps), hessian


def _inverse_curvature(curvature):
    """Inverse (p, p) of a symmetric matrix, in no direction above the widest prior's variance."""
    values, axes = np.linalg.eigh(curvature)
    return axes / np.maximum(values, PRIOR_SIGMA.max()**-2) @ axes.T
