"""Stages 5 and 6: from a Problem and a State to the Fit that the measurements agree on.

Rounds with ever narrower kernels (`narrow_kernels`) keep the solution out of the wrong minima to
which wrong labels and late ranges lead. Then wheels, noise and accepted measurements are estimated
in turn until they agree (`refine`). Accepted sightings count in full, accepted ranges by a
one-sided kernel: without the line of sight a range is too long. Where residuals show that errors
have memory, measurements keep a share of their information (`slamlib.robust.error_memory`).
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from gtsam import noiseModel

from slamlib.core.kernels import KERNELS, ONE_SIDED_BIAS
from slamlib.core.sightings import GATE, MEDIAN_CHI2, POINT_GATE
from slamlib.robust.calibration import RANGE_LAG, SIGHTING_LAG, WHEELS
from slamlib.robust.error_memory import Memory, error_memory, memory_of_each
from slamlib.robust.factors import (
    linearize_measurements,
    linearize_odometry,
    preintegrate_odometry,
)
from slamlib.robust.linear import (
    NormalEquations,
    Problem,
    State,
    errors_after,
    laplace_approximation,
    posterior_draws,
)
from slamlib.robust.measurements import (
    Accepted,
    AcceptedMeasurements,
    Noise,
    accept_all,
    with_known,
)
from slamlib.robust.noise import NoisePosterior, learn_noise, with_least_slip
from slamlib.robust.optimize import Optimum, optimize

log = logging.getLogger(__name__)

RANGE_GATE = 3.3             # sigmas; a range that is shorter than expected by more is rejected
MAX_DIRECT = 3.3             # sigmas, of a range's residual; longer ones are echoes

CAUCHY_SCALES = (10.0, 3.0)   # sigmas, scale of the kernel in each round
ROUGH = 1e-4                 # relative decrease of the error at which a round ends
MIN_RESIDUALS = 20           # number of measurements from which their scatter gives a factor

TURNS_TOGETHER = 10          # number of increments whose errors of heading are added at first
MIN_SUMS = 8                 # number of sums that a drive must hold, if more are added
MIN_TOLD = 0.5               # share of the expected variance of a sum that residuals must have
MIN_WANDERING = 0.25         # variance of the sums of residuals over that expected from slip
TURN_GATE = 2.5              # standard deviations by which chance may lower the log of this ratio
DRAWS = 8                    # number of draws from the posterior, for products of errors
MAX_ROUNDS = 20              # number of rounds of wheels, noise and accepted measurements
FREE_ROUNDS = 12             # of these, after which the shares of memory only fall
NEGLIGIBLE_MOVE = 3e-3       # relative, of a wheel parameter since odometry was linearised
SETTLED_MOVE = 1e-6          # the same, at the solution that is handed in
MAX_SINCE = 0.5              # encoder steps, of a delay since then
NEGLIGIBLE_CHANGE = 1e-3     # share of the measurements whose weight may change at the same noise
SIMILAR_SHARE = 0.03         # relative change of a share of memory that is none


def accepted_measurements(
        problem: Problem, state: State, sightings: tuple[str, bool] | None = None,
        ranges: tuple[str, bool] | None = None) -> AcceptedMeasurements:
    """The AcceptedMeasurements at a State, by kernel and gate of sightings and of ranges.

    `sightings` and `ranges` are a name in KERNELS and whether what contradicts the State is
    rejected; None takes those of the dataset's Vehicle. The gate of a sighting is the 99.9 %
    quantile of chi-squared with 3 degrees of freedom, or 2 for a point. A one-sided kernel is that
    of the ranges only, and replaces their gate for late ones.
    """
    m = problem.measurements
    stated = m.dataset.vehicle.kernel, m.dataset.vehicle.gate
    kernel, gated = sightings or stated
    range_kernel, ranges_gated = ranges or stated
    residual, late = residuals(problem, state)
    squared = np.sum(residual**2, axis=1)
    far = squared >= np.where(m.as_pose, GATE, POINT_GATE)
    wrong = late <= -RANGE_GATE
    if range_kernel not in ONE_SIDED_BIAS:
        wrong |= late >= RANGE_GATE
    return AcceptedMeasurements(
        _unless(gated & far, None if kernel in ONE_SIDED_BIAS else KERNELS[kernel]),
        _unless(ranges_gated & wrong, KERNELS[range_kernel], ONE_SIDED_BIAS.get(range_kernel, 0.0)))


def _unless(rejected, kernel, bias=0.0):
    """The Accepted of measurements that count in full unless `rejected` (m,)."""
    ones = np.ones(len(rejected))
    return Accepted(ones - rejected, ones, kernel, bias)


def residuals(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray]:
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


def error_memories(problem: Problem, state: State,
                   accepted: AcceptedMeasurements) -> tuple[Memory, Memory]:
    """The Memory of the errors of sightings, and that of ranges but echoes, of those `accepted`.

    By the posterior of a Problem at its solution. Raises DatasetError as `posterior_draws`.
    """
    m = problem.measurements
    steps = posterior_draws(NormalEquations(problem, state), DRAWS)
    factors = linearize_measurements(replace(problem, accepted=accept_all(m)), state)
    changes = [errors_after(each, m.structure, steps) for each in factors]
    sightings, ranges = factors
    is_direct = np.abs(ranges.e[:, 0]) < MAX_DIRECT
    of_sightings = error_memory(
        m.marker_row, m.frame[m.sightings.row], sightings.e, changes[0],
        accepted.sightings.weight > 0)
    of_ranges = memory_of_each(
        m.ranges.antenna, m.frame[m.ranges.row], ranges.e, changes[1],
        is_direct & (accepted.ranges.weight > 0))
    return of_sightings, of_ranges


def turns_by_slip(problem: Problem, state: State) -> bool:
    """Whether the heading wanders from odometry as much as by this slip, or is hardly measured.

    Errors of turns that slip explains are white: the variance of the sum of q successive ones is q
    (variance ratio: Lo and MacKinlay, Review of Financial Studies 1(1), 1988). Residuals show the
    part of it that the posterior does not. What is no slip turns the path less, or ahead and back.
    q is TURNS_TOGETHER, doubled until residuals show most. Raises DatasetError as
    `posterior_draws`.
    """
    steps = posterior_draws(NormalEquations(problem, state), DRAWS)
    factors = linearize_odometry(problem, state, problem.noise.slip)
    changes = errors_after(factors, problem.measurements.structure, steps)[:, 2]
    errors = np.column_stack([factors.e[:, 2], changes / np.sqrt(DRAWS)])     # of the headings
    count = len(errors)
    of_each = max(1.0, np.mean(np.sum(errors**2, axis=1)))
    added = np.cumulative_sum(errors, axis=0, include_initial=True)
    q = max(1, min(TURNS_TOGETHER, count // 4))
    longest = max(q, count // MIN_SUMS)
    while q <= min(longest, count):
        variance = np.mean((added[q:] - added[:-q])**2, axis=0) / q
        expected = of_each - variance[1:].sum()          # of residuals
        if expected > MIN_TOLD * of_each:
            ratio = variance[0] / expected
            sigma = np.sqrt(2 * (2 * q**2 + 1) / (3 * q * count))
            log.info("slip %.3g mm after 1 m: headings wander %.2f ± %.2f times as much in %d "
                     "increments", 1e3 * problem.noise.slip, ratio, sigma, q)
            return bool(ratio > min(MIN_WANDERING, np.exp(-TURN_GATE * sigma)))
        q *= 2
    return True


def narrow_kernels(
        problem: Problem, state: State, scales: Sequence[float] = CAUCHY_SCALES) -> Optimum:
    """The Optimum by the last of one or more scales of the Cauchy kernel, with all measurements.

    Each is solved from the one before, with the noise that the scatter of its residuals gives. The
    scales are in sigmas. Raises DatasetError as `optimize`.
    """
    for number, scale in enumerate(scales):
        if number:                                   # the caller judges the last solution
            problem = replace(problem, noise=noise_of_scatter(problem, state))
        cauchy = noiseModel.mEstimator.Cauchy.Create(scale)
        accepted = accept_all(problem.measurements, cauchy)
        problem = replace(problem, accepted=accepted, reference=state.c)
        optimum = optimize(problem, state, tolerance=ROUGH)
        state = optimum.state
        log.info("Cauchy kernel of %g sigmas: error %.6g after %d steps",
                 scale, optimum.equations.error, optimum.steps)
    return optimum


def noise_of_scatter(problem: Problem, state: State) -> Noise:
    """The Noise with the slip of a Problem, and factors from the medians of the residuals, >= 1.

    Without these factors, covariances that are far too small would have most measurements rejected
    before a factor is learned. Known noise parameters are kept.
    """
    m = problem.measurements
    sightings, ranges = residuals(replace(problem, noise=Noise()), state)
    squared = np.sum(sightings**2, axis=1)
    median = np.where(m.as_pose, MEDIAN_CHI2[3], MEDIAN_CHI2[2])
    noise = problem.noise._replace(
        sightings=_scatter(squared / median), ranges=_scatter(ranges**2 / MEDIAN_CHI2[1]))
    return with_known(noise, m.dataset.vehicle)


def _scatter(squared):
    """Factor on standard deviations, >= 1, by squared residuals (m,) over their expected median."""
    if len(squared) < MIN_RESIDUALS:
        return 1.0
    return max(1.0, float(np.sqrt(np.median(squared))))


@dataclass(frozen=True)
class Fit:
    """A Problem with the State that solves it."""

    problem: Problem
    state: State
    log_evidence: float                  # Laplace, up to a constant
    posterior: NoisePosterior | None     # None if all noise parameters are known
    converged: bool              # whether iterations and rounds ended before their number did
    explanations: tuple[frozenset, ...] = (frozenset(),)     # each set of groups explains the drive
    lead: float = 0.0            # log evidence by the groups that left their stated values

    @property
    def log_density(self) -> float:
        """Log posterior density of the noise, or log evidence if all of it is known."""
        return self.log_evidence if self.posterior is None else self.posterior.log_density


def refine(problem: Problem, state: State,
           accept: Callable[..., AcceptedMeasurements] | None = accepted_measurements) -> Fit:
    """The Fit in which wheels, noise and accepted measurements agree with each other.

    They depend on each other, so each is updated in turn until the accepted measurements no longer
    change. From a Problem and a State near its solution. `accept` makes AcceptedMeasurements from
    Problem and State; None keeps those of the problem, with their shares. Raises DatasetError as
    `optimize`, and numpy.linalg.LinAlgError if odometry's covariance is singular.

    Slow errors of sensors and slip explain the same residuals. So the shares that memory leaves of
    the measurements' information are found in turn with the noise: from its start values on if
    `problem.memory_first`, else from the noise as it is learned without them.
    """
    if accept is None:
        given = problem.accepted
        return _settled_fit(problem, state, lambda *_: given)

    def with_memory(problem, state):
        accepted = accept(problem, state)
        memories = error_memories(problem, state, accepted)
        return accepted.with_shares(memory.share for memory in memories)

    problem = replace(problem, noise=noise_of_scatter(problem, state))
    if not problem.memory_first:
        fit = _settled_fit(problem, state, accept)
        if not has_memory(fit):
            return fit
        problem = fit.problem
        state = fit.state
    return _settled_fit(problem, state, with_memory)


def refine_like(problem: Problem, state: State, decided: Fit) -> Fit:
    """The Fit by the last kernel, then as of `refine`, with the explanations of another Fit."""
    optimum = narrow_kernels(problem, state, CAUCHY_SCALES[-1:])
    fit = refine(problem, optimum.state)
    return replace(fit, explanations=decided.explanations, lead=decided.lead)


def refine_without_memory(problem: Problem, state: State) -> Fit:
    """The Fit as of `refine` in which all errors are independent."""
    problem = replace(problem, noise=noise_of_scatter(problem, state))
    return _settled_fit(problem, state, accepted_measurements)


def has_memory(fit: Fit) -> bool:
    """Whether the errors of measurements that a Fit accepts have memory."""
    memories = error_memories(fit.problem, fit.state, fit.problem.accepted)
    return any((memory.share < 1).any() for memory in memories)


def _settled_fit(problem, state, accept):
    """The Fit after rounds of wheels, noise and accepted measurements.

    They end where the calibration is impossible. Memory may come and go, so that after some rounds
    shares only fall. The Problem has the measurements that `accept` made before the last solution.
    """
    m = problem.measurements
    posterior = None
    accepted = accept(problem, state)
    is_settled = False
    for number in range(1, MAX_ROUNDS + 1):
        problem = replace(problem, accepted=accepted)
        if m.learned.any() and not is_settled:
            problem, state, posterior = _settle_noise(relinearized(problem, state), state)
        problem = relinearized(_with_least_slip(problem), state)
        optimum = optimize(problem, state)
        state = optimum.state
        accepted = accept(replace(problem, reference=state.c), state)
        if number > FREE_ROUNDS:
            accepted = accepted.with_shares(
                np.minimum(new.share, old.share) for new, old in zip(accepted, problem.accepted))
        changed = sum(np.count_nonzero(_has_changed(new, old))
                      for new, old in zip(accepted, problem.accepted))
        log.info("round %d: slip %.3g mm after 1 m, factors %.3g and %.3g; accepted %d of %d "
                 "sightings, %d of %d ranges, %d changed", number, 1e3 * problem.noise.slip,
                 problem.noise.sightings, problem.noise.ranges,
                 np.count_nonzero(accepted.sightings.weight), len(accepted.sightings.weight),
                 np.count_nonzero(accepted.ranges.weight), len(accepted.ranges.weight), changed)
        is_linear = _is_linear(problem, state, NEGLIGIBLE_MOVE)
        is_possible = m.calibration.is_possible(state.c).all()
        if (changed == 0 and is_linear) or not is_possible:
            break
        is_settled = changed <= NEGLIGIBLE_CHANGE * len(accepted.share) and is_linear
    return _fit(problem, optimum, posterior)


def _has_changed(new, old):
    """Which measurements (m,) are Accepted otherwise, or with another share of memory."""
    return (new.weight != old.weight) | (np.abs(new.share / old.share - 1) > SIMILAR_SHARE)


def _fit(problem, optimum, posterior):
    """The Fit of a Problem with its Optimum."""
    log_evidence = laplace_approximation(optimum.equations, problem.noise)[1]
    is_linear = _is_linear(problem, optimum.state, NEGLIGIBLE_MOVE)
    return Fit(problem=problem, state=optimum.state, log_evidence=log_evidence, posterior=posterior,
               converged=optimum.converged and is_linear)


def relinearized(problem: Problem, state: State) -> Problem:
    """The Problem at the wheels and delays of a State."""
    odometry = preintegrate_odometry(
        problem.measurements, problem.odometry.model, state.c[WHEELS], problem.noise.slip)
    return replace(problem, odometry=odometry, reference=state.c)


def _is_linear(problem, state, max_move):
    """Whether wheels and delays of a State are near those at which the Problem is linear.

    Wheels within `max_move` of themselves, delays within MAX_SINCE.
    """
    wheels = state.c[WHEELS] / problem.odometry.wheel - 1
    since = (state.c - problem.reference)[[SIGHTING_LAG, RANGE_LAG]]
    return np.abs(wheels).max() < max_move and np.abs(since).max() < MAX_SINCE


def _settle_noise(problem, state):
    """The Problem with the noise learned after two steps from a State, and its posterior."""
    optimum = optimize(problem, state, max_steps=2)
    posterior = learn_noise(optimum.equations)
    noise = with_known(posterior.noise, problem.measurements.dataset.vehicle)
    problem = replace(problem, noise=noise, reference=optimum.state.c)
    return problem, optimum.state, posterior


def settled(fit: Fit) -> Fit:
    """The Fit with the mean of the noise's posterior, and odometry linearised at its own wheels.

    For the same measurements. Rounds that end after MAX_ROUNDS leave odometry linearised elsewhere,
    where increments have other scales.
    """
    problem = fit.problem
    if fit.posterior is not None:
        problem = _with_least_slip(replace(problem, noise=fit.posterior.mean))
    state = fit.state
    for _ in range(MAX_ROUNDS):
        optimum = optimize(problem, state)
        state = optimum.state
        is_linear = _is_linear(problem, state, SETTLED_MOVE)
        if is_linear:
            break
        problem = relinearized(problem, state)
    return replace(fit, problem=problem, state=state, converged=optimum.converged and is_linear)


def _with_least_slip(problem):
    """The Problem with the typical slip at least, if errors of its measurements have memory."""
    remember = any((kind.share < 1).any() for kind in problem.accepted)
    vehicle = problem.measurements.dataset.vehicle
    return replace(problem, noise=with_least_slip(problem.noise, remember, vehicle))
