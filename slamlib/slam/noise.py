"""Stage 6: the noise parameters learned from the drive's own measurements: their posterior.

All three are log-normal a priori, with medians of 1 mm after one metre and of 1, and standard
deviations of a factor of 3 and of 2. The evidence times this prior is the posterior of the
logarithms of slip and factors. Newton's method finds its mode, differences give its covariance.
Poses and landmarks are averaged over a few points of it (integrated nested Laplace approximation:
Rue, Martino and Chopin, J. R. Stat. Soc. B 71(2), 2009), so that the covariances include that the
slip is uncertain. On a very long drive, noise is learned from the first frames only.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from slamlib.increments import SLIP_FACTOR, TYPICAL_SLIP
from slamlib.slam.calibration import ANTENNAS
from slamlib.slam.linear import NormalEquations, laplace_approximation
from slamlib.slam.measurements import Noise, is_known, measure

MEDIAN = np.array([TYPICAL_SLIP, 1.0, 1.0])        # sqrt(m), 1, 1: of the prior
PRIOR_SIGMA = np.log([SLIP_FACTOR, 2.0, 2.0])      # (3,) standard deviations of the logarithms
BOUNDS = np.log(MEDIAN) + np.log(100) * np.array([[-1], [1]])      # (2, 3) of the logarithms

MAX_DIFFERENCE = 0.2         # of a logarithm, largest one of a difference quotient
MIN_DIFFERENCE = 0.003       # of a logarithm, smallest one of a difference quotient
MAX_STEP = 1.5               # of a logarithm, longest step of Newton's method
SHORTEST_STEP = 0.1          # sigmas, to which a step that does not ascend is halved
MAX_NEWTON_STEPS = 12        # number of steps of Newton's method
CONVERGED_GAIN = 0.01        # log posterior gained by the last step of Newton's method
POINT_OFFSETS = 1.5 * np.arange(-2, 3)       # sigmas of log slip, points of the average
SINGLE_POINT_SIGMA = 0.2     # of log slip, below which the mode alone is enough
MIN_POINT_WEIGHT = 1e-3      # probability of a point; less probable ones are left out
SINGULAR = -1e12             # log evidence of noise for which the equations are singular

LEARNING_FRAMES = 20_000     # number of first frames from which noise is learned on a long drive
MIN_MEASUREMENTS = 5000      # of a sensor: they determine the factor on its sigmas to 1 %


def log_prior(logarithms):
    """Log prior density (3,), up to a constant, of each of `Noise.logarithms` (3,)."""
    return -((logarithms - np.log(MEDIAN)) / PRIOR_SIGMA)**2 / 2


@dataclass(frozen=True)
class NoisePosterior:
    """Posterior of the noise given the measurements."""

    noise: Noise                 # the mode
    covariance: np.ndarray       # (3, 3) of its logarithms, 0 for parameters that are not learned
    log_density: float           # log posterior at the mode, up to a constant
    points: tuple                # of (probability, Noise), over which estimates are averaged


def learn_noise(equations):
    """The NoisePosterior by NormalEquations near the solution, from the noise of their problem."""
    equations = equations_of_first_frames(equations)
    log_posterior, start, free = _log_posterior(equations)
    value = log_posterior(start)
    if value < SINGULAR / 2:                             # nothing can be learned
        noise = equations.problem.noise
        return NoisePosterior(noise, np.zeros((3, 3)), SINGULAR, ((1.0, noise),))
    frames = len(equations.problem.measurements.frame)
    smallest = 1 / np.sqrt(2 * np.maximum([3 * frames, *equations.counts()], 1))
    mode, log_density_of_mode, covariance = _mode(log_posterior, start, value, free, smallest[free])
    return NoisePosterior(Noise.from_logarithms(mode), covariance, log_density_of_mode,
                          _points(log_posterior, mode, log_density_of_mode, covariance))


def log_density(equations):
    """Log posterior density of the noise of the equations' problem, up to a constant."""
    log_posterior, noise, _ = _log_posterior(equations_of_first_frames(equations))
    return log_posterior(noise)


def greatest_log_density(equations, posterior):
    """Log posterior density at the mode that `learn_noise` finds, up to a constant.

    `posterior`, the NoisePosterior of nearly the same equations, gives step sizes and correlations.
    """
    log_posterior, start, free = _log_posterior(equations_of_first_frames(equations))
    covariance = posterior.covariance[np.ix_(free, free)]
    information = np.linalg.inv(covariance)
    scale = np.sqrt(np.diag(information))
    return _mode(log_posterior, start, log_posterior(start), free, np.sqrt(np.diag(covariance)),
                 information / np.outer(scale, scale))[1]


def _log_posterior(equations):
    """Log posterior, a function of `Noise.logarithms`, start (3,), and indices of learned ones."""
    problem = equations.problem
    free = problem.measurements.learned

    def log_posterior(logarithms):
        _, evidence = laplace_approximation(equations, Noise.from_logarithms(logarithms))
        return max(evidence, SINGULAR) + np.sum(log_prior(logarithms)[free])

    start = np.where(free | is_known(problem.measurements.dataset.vehicle),
                     problem.noise.logarithms, np.log(MEDIAN))
    return log_posterior, start, np.flatnonzero(free)


def _mode(function, x, value, free, steps, correlation=None):
    """Argument, value and covariance (3, 3) of the maximum of a log density, by Newton's method.

    From `x` (3,) with its `value`. Derivatives by the components `free` (p,) are differences over
    `steps` (p,), later over standard deviations. A known `correlation` (p, p) of the second
    derivatives replaces the mixed ones.
    """
    steps = np.clip(steps, MIN_DIFFERENCE, MAX_DIFFERENCE)
    for _ in range(MAX_NEWTON_STEPS):
        gradient, hessian = _differences(function, x, value, free, steps, correlation)
        curvature, axes = np.linalg.eigh(-hessian)
        covariance = axes / np.maximum(curvature, PRIOR_SIGMA.max()**-2) @ axes.T
        sigma = np.clip(np.sqrt(np.diag(covariance)), MIN_DIFFERENCE, MAX_DIFFERENCE)
        coarse, steps = (steps > 2 * sigma).any(), sigma
        step = covariance @ gradient
        step *= MAX_STEP / max(MAX_STEP, np.abs(step).max())
        while (new := function(_with_step(x, free, step))) < value \
                and np.abs(step / sigma).max() > SHORTEST_STEP:
            step = step / 2
        gain = new - value
        if gain > 0:
            x, value = _with_step(x, free, step), new
        if gain < CONVERGED_GAIN and not coarse:
            break
    full = np.zeros((len(x), len(x)))
    full[np.ix_(free, free)] = covariance
    return x, value, full


def _with_step(x, free, step):
    """x (3,) with `step` (p,) added to the components `free` (p,), within BOUNDS."""
    stepped = x.copy()
    stepped[free] += step
    return np.clip(stepped, *BOUNDS)


def _differences(function, x, value, free, steps, correlation=None):
    """Gradient (p,) and Hessian (p, p) by differences over `steps` (p,) of the components `free`.

    Mixed second derivatives are those of the `correlation` (p, p) if it is not None.
    """
    unit, pairs = np.diag(steps), list(combinations(range(len(free)), 2))
    offsets = [*unit, *-unit]
    if correlation is None:
        offsets += [unit[i] + unit[j] for i, j in pairs]
    values = np.array([function(_with_step(x, free, offset)) for offset in offsets])
    up, down, both = np.split(values, [len(free), 2 * len(free)])
    gradient, hessian = (up - down) / (2 * steps), np.diag((up + down - 2 * value) / steps**2)
    if correlation is not None:
        scale = np.sqrt(np.abs(np.diag(hessian)))
        return gradient, np.where(np.eye(len(free)), hessian, -correlation * np.outer(scale, scale))
    for (i, j), value_ij in zip(pairs, both):
        hessian[i, j] = hessian[j, i] = (value_ij - up[i] - up[j] + value) / (steps[i] * steps[j])
    return gradient, hessian


def _points(log_posterior, mode, log_density_of_mode, covariance):
    """Tuple of (probability, Noise) along the slip, each with the most probable factors.

    Each point has the root mean square exp(mu + s^2) of its log-normal noise parameters.
    `mode` (3,) and `covariance` (3, 3) are of the logarithms; `log_density_of_mode` is the log
    posterior at the mode.
    """
    sigma = np.sqrt(covariance[0, 0])
    direction = covariance[0] / (sigma or 1)     # (3,) for one sigma of log slip; 0 if it is known
    if sigma < SINGLE_POINT_SIGMA:
        remaining, offsets, weights = covariance, [0.0], np.ones(1)
    else:
        remaining, offsets = covariance - np.outer(direction, direction), POINT_OFFSETS
        logs = np.array([log_posterior(mode + offset * direction) if offset else log_density_of_mode
                         for offset in offsets])
        weights = np.exp(logs - logs.max())
    variance = np.maximum(np.diag(remaining), 0)
    return tuple((float(weight), Noise.from_logarithms(mode + offset * direction + variance))
                 for weight, offset in zip(weights / weights.sum(), offsets)
                 if weight > MIN_POINT_WEIGHT)


def equations_of_first_frames(equations):
    """The NormalEquations of the measurements at the first LEARNING_FRAMES.

    The odometry keeps its noise of the whole drive, and every measurement its weight. Returns
    `equations` itself if there are no more frames, or if the first ones have fewer than
    MIN_MEASUREMENTS of the sightings or ranges of the drive.
    """
    problem, state, m = equations.problem, equations.state, equations.problem.measurements
    count = LEARNING_FRAMES
    if len(m.frame) <= count:
        return equations
    part = measure(m.dataset.first(int(m.frame[count - 1]) + 1))
    if len(part.marker_row) < min(MIN_MEASUREMENTS, len(m.marker_row)) \
            or len(part.ranges.row) < min(MIN_MEASUREMENTS, len(m.ranges.row)):
        return equations
    markers = np.searchsorted(m.marker, part.marker)
    antennas = np.searchsorted(m.antenna, part.antenna)
    part = replace(part, oriented=m.oriented[markers])
    accepted = replace(problem.accepted, measurements=part, weight=np.r_[
        problem.accepted.sighting_weight[:len(part.marker_row)],
        problem.accepted.range_weight[:len(part.ranges.row)]])
    odometry = replace(problem.odometry, **{
        name: getattr(problem.odometry, name)[:count - 1]
        for name in ("increment", "J_wheel", "quantization", "slipping")})
    entries = np.r_[:ANTENNAS.start, ANTENNAS.start + antennas]
    return NormalEquations(
        replace(problem, odometry=odometry, accepted=accepted, sigma=problem.sigma[entries]),
        replace(state, poses=state.poses[:count], markers=state.markers[markers],
                antennas=state.antennas[antennas], c=state.c[entries]))
