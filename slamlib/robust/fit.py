"""Stages 5 and 6: from a Problem and a State to the Fit that the measurements agree on.

Rounds with ever narrower kernels (`narrow_kernels`) keep the solution out of the wrong minima to
which wrong labels and late ranges lead. Then wheels, noise and accepted measurements are estimated
in turn until they agree (`refine`). Accepted sightings count in full, accepted ranges by a
one-sided kernel: without the line of sight a range is too long. Where residuals show that errors
have memory, measurements keep a share of their information (`slamlib.robust.error_memory`).
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from gtsam import noiseModel

from slamlib.core.kernels import KERNELS, ONE_SIDED
from slamlib.core.sightings import GATE, POINT_GATE
from slamlib.robust.calibration import WHEELS
from slamlib.robust.error_memory import error_memory
from slamlib.robust.factors import linearize_measurements, preintegrate_odometry
from slamlib.robust.linear import Problem, State, laplace_approximation
from slamlib.robust.measurements import (
    Accepted,
    AcceptedMeasurements,
    Noise,
    accept_all,
    with_known,
)
from slamlib.robust.noise import NoisePosterior, learn_noise, with_hidden_errors
from slamlib.robust.optimize import optimize

RANGE_GATE = 3.3             # sigmas; a range that is shorter than expected by more is rejected
MAX_DIRECT = 3.3             # sigmas, of a range's residual; longer ones are echoes

CAUCHY_SCALES = (100.0, 30.0, 10.0, 3.0)     # sigmas, scale of the kernel in each round
ROUGH = 1e-4                 # relative decrease of the error at which a round ends
MIN_RESIDUALS = 20           # number of measurements from which their scatter gives a factor
MEDIAN_CHI2 = {3: 2.366, 2: 1.386, 1: 0.455}         # medians by degrees of freedom

MAX_ROUNDS = 6               # number of rounds of wheels, noise and accepted measurements
NEGLIGIBLE_MOVE = 3e-3       # relative, of a wheel parameter since odometry was linearised
SETTLED_MOVE = 1e-4          # the same, at the solution that is handed in
NEGLIGIBLE_CHANGE = 1e-3     # share of the measurements whose weight may change at the same noise


def accepted_measurements(problem, state, sightings=None, ranges=None):
    """The AcceptedMeasurements at a State, by kernel and gate of sightings and of ranges.

    `sightings` and `ranges` are a name in KERNELS and whether what contradicts the State is
    rejected; None takes those of the dataset's Vehicle. The gate of a sighting is the 99.9 %
    quantile of chi-squared with 3 degrees of freedom, or 2 for a point. A one-sided kernel is that
    of the ranges only, and replaces their gate for late ones.
    """
    m, vehicle = problem.measurements, problem.measurements.dataset.vehicle
    (kernel, gated), (range_kernel, range_gated) = (
        each or (vehicle.kernel, vehicle.gate) for each in (sightings, ranges))
    residual, late = residuals(problem, state)
    far = np.sum(residual**2, axis=1) >= np.where(m.as_pose, GATE, POINT_GATE)
    wrong = (late <= -RANGE_GATE) | (late >= RANGE_GATE) & (range_kernel not in ONE_SIDED)
    return AcceptedMeasurements(
        Accepted(1.0 - (gated & far), np.ones(len(far)),
                 None if kernel in ONE_SIDED else KERNELS[kernel]),
        Accepted(1.0 - (range_gated & wrong), np.ones(len(wrong)), KERNELS[range_kernel],
                 ONE_SIDED.get(range_kernel, 0.0)))


def residuals(problem, state):
    """Whitened residuals, measured minus expected, of all measurements, without kernels.

    Returns
    -------
    (s, 3) of the sightings, in the axes of the measured pose, or for a marker that is a point in
        those of the vehicle with 0 as the third.
    (r,) of the ranges, positive for a range that is too long.
    """
    everything = replace(problem, accepted=accept_all(problem.measurements))
    sightings, ranges = linearize_measurements(everything, state)
    return -sightings.e, -ranges.e[:, 0]


def error_memories(problem, state):
    """The Memory of the errors of sightings, and that of ranges but echoes, at a solution."""
    m, (sightings, ranges) = problem.measurements, problem.accepted
    residual, late = residuals(problem, state)
    direct = (ranges.weight > 0) & (np.abs(late) < MAX_DIRECT)
    return (error_memory(m.marker_row, m.frame[m.sightings.row], residual, sightings.weight > 0),
            error_memory(m.ranges.antenna, m.frame[m.ranges.row], late[:, None], direct))


def narrow_kernels(problem, state, scales=CAUCHY_SCALES):
    """The State after one solution for each scale of the Cauchy kernel, with all measurements.

    The scales are in sigmas. The scatter of the residuals of each solution gives the noise of the
    next. Raises DatasetError as `optimize`.
    """
    for number, scale in enumerate(scales):
        if number:                                   # the caller judges the last solution
            problem = replace(problem, noise=noise_of_scatter(problem, state))
        cauchy = noiseModel.mEstimator.Cauchy.Create(scale)
        accepted = accept_all(problem.measurements, cauchy)
        state = optimize(replace(problem, accepted=accepted), state, tolerance=ROUGH).state
    return state


def noise_of_scatter(problem, state):
    """The Noise with the slip of a Problem, and factors from the medians of the residuals, >= 1.

    Without these factors, covariances that are far too small would have most measurements rejected
    before a factor is learned. Known noise parameters are kept.
    """
    measurements = problem.measurements
    sightings, ranges = residuals(replace(problem, noise=Noise()), state)
    squared = (np.sum(sightings**2, axis=1) / np.where(
        measurements.as_pose, MEDIAN_CHI2[3], MEDIAN_CHI2[2]), ranges**2 / MEDIAN_CHI2[1])
    return with_known(Noise(problem.noise.slip, *(
        max(1.0, float(np.sqrt(np.median(each)))) if len(each) >= MIN_RESIDUALS else 1.0
        for each in squared)), measurements.dataset.vehicle)


@dataclass(frozen=True)
class Fit:
    """A Problem with the State that solves it."""

    problem: Problem
    state: State
    log_evidence: float                  # Laplace, up to a constant
    posterior: NoisePosterior | None     # None if all noise parameters are known
    converged: bool              # whether the last iterations ended before their number did
    explanations: tuple = (frozenset(),)     # sets of groups, each of which explains the drive

    @property
    def log_density(self):
        """Log posterior density of the noise, or log evidence if all of it is known."""
        learned = self.posterior is not None and (self.problem.accepted.share == 1).all()
        return self.posterior.log_density if learned else self.log_evidence


def refine(problem, state, accept=accepted_measurements):
    """The Fit in which wheels, noise and accepted measurements agree with each other.

    They depend on each other, so each is updated in turn until the accepted measurements no longer
    change. The share that memory leaves of their information is found at the end, with the noise as
    it is. From a Problem and a State near its solution. `accept` makes AcceptedMeasurements from
    Problem and State; None keeps those of the problem. Raises DatasetError as `optimize`, and
    numpy.linalg.LinAlgError if odometry's covariance is singular.
    """
    m, model, posterior = problem.measurements, problem.odometry.model, None
    shares, fixed, changed = [kind.share for kind in problem.accepted], accept is None, np.inf
    if fixed:
        given = problem.accepted.with_shares(map(np.ones_like, shares))
        accept = lambda *_: given
    else:
        problem = replace(problem, noise=noise_of_scatter(problem, state))
    accepted = accept(problem, state)
    for _ in range(MAX_ROUNDS):
        problem = replace(problem, accepted=accepted,
                          odometry=preintegrate_odometry(m, model, state.c[WHEELS]))
        if m.learned.any() and changed > NEGLIGIBLE_CHANGE * len(accepted.share):
            optimum = optimize(problem, state, max_steps=2)
            state, posterior = optimum.state, learn_noise(optimum.equations)
            problem = replace(problem, noise=with_known(posterior.noise, m.dataset.vehicle))
        problem = replace(problem, odometry=replace(problem.odometry, in_counts=True))
        optimum = optimize(problem, state)
        state = optimum.state
        accepted = accept(problem, state)
        changed = sum(np.count_nonzero(new.weight != old.weight)
                      for new, old in zip(accepted, problem.accepted))
        moved = np.abs(state.c[WHEELS] / problem.odometry.wheel - 1).max()
        if not changed and moved < NEGLIGIBLE_MOVE:
            break
    if not fixed:
        hidden = replace(problem, noise=with_hidden_errors(
            problem.noise, (True, True), m.dataset.vehicle))
        shares = [memory.share for memory in error_memories(
            replace(hidden, accepted=accept(hidden, state)), state)]
    if any((share < 1).any() for share in shares):
        problem, posterior = _with_shares(problem, state, posterior, shares, accept)
        optimum = optimize(problem, state)
    _, log_evidence = laplace_approximation(optimum.equations, problem.noise)
    return Fit(problem=problem, state=optimum.state, log_evidence=log_evidence, posterior=posterior,
               converged=optimum.converged)


def settled(fit):
    """The Fit with odometry linearised at its own wheels, for the same measurements and noise.

    Rounds that end by their number leave it elsewhere, where the increments have other scales.
    """
    problem, state, converged = fit.problem, fit.state, fit.converged
    for _ in range(MAX_ROUNDS):
        if np.abs(state.c[WHEELS] / problem.odometry.wheel - 1).max() < SETTLED_MOVE:
            break
        odometry = preintegrate_odometry(
            problem.measurements, problem.odometry.model, state.c[WHEELS])
        problem = replace(problem, odometry=replace(odometry, in_counts=True))
        optimum = optimize(problem, state)
        state, converged = optimum.state, optimum.converged
    return replace(fit, problem=problem, state=state, converged=converged)


def _with_shares(problem, state, posterior, shares, accept):
    """The Problem with shares (s,) and (r,) of errors with memory, and its noise's posterior."""
    hidden = partial(with_hidden_errors, vehicle=problem.measurements.dataset.vehicle, remember=[
        (share < 1).any() for share in shares])
    problem = replace(problem, noise=hidden(problem.noise))
    problem = replace(problem, accepted=accept(problem, state).with_shares(shares))
    return problem, posterior and replace(posterior, noise=problem.noise, points=tuple(
        (weight, hidden(noise)) for weight, noise in posterior.points))
