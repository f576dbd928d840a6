"""Stage 6: what the drive decides.

Memory of errors or slip, arcs or Euler's steps, wrong statements, ids of several places.

Groups of entries of the calibration may leave their stated values (`calibrated`): they get the wide
standard deviations of `calibration.ENTRIES`. The normal equations with columns for all entries give
the likelihood of the whole calibration, all else eliminated, exp(-u^T L u / 2 + h^T u) with u in
wide sigmas. For a prior of precisions P on the entries that are not known, the log evidence is

    h^T (L + P)^-1 h / 2 - log|L + P| / 2 + log|P| / 2,

so that one linearisation ranks all sets of groups (score tests: Rao, Proc. Camb. Phil. Soc. 44(1),
1948). A group that leads decisively is told. One that leads less is released, too, so that the
covariances include it, if its evidence still leads on the same measurements and weights, the last
position stays nearly as certain, and no entry is far from what is stated.

A visit is a run of sightings of an id without a long break. Where a solution rejects most sightings
of a visit, the drive is solved once more with a landmark for every visit, so that only the path
between them ties visits together. A visit whose landmark is further from all earlier places of its
id than this path explains is another place (`places_of_ids`).
"""

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import combinations, compress
from typing import NamedTuple

import numpy as np

from slamlib.core import se2
from slamlib.core.errors import if_solvable
from slamlib.core.increments import TYPICAL_SLIP
from slamlib.core.records import ArucoReadings, Dataset
from slamlib.core.sightings import GATE
from slamlib.robust.calibration import RADII, WHEEL_SCALE, WHEELS, Prior
from slamlib.robust.error_memory import runs
from slamlib.robust.factors import odometry_error, preintegrate_odometry
from slamlib.robust.fit import (
    Fit,
    accepted_measurements,
    has_memory,
    refine,
    refine_like,
    refine_without_memory,
    relinearized,
    residuals,
    turns_by_slip,
)
from slamlib.robust.jumps import (
    UNKNOWN_SIGMA,
    Jumps,
    find_jumps,
    most_together,
    with_overlooked,
)
from slamlib.robust.linear import (
    NormalEquations,
    Problem,
    State,
    laplace_approximation,
    linear_solution,
)
from slamlib.robust.measurements import AcceptedMeasurements
from slamlib.robust.part_faults import camera_bump
from slamlib.robust.result import slam_result

log = logging.getLogger(__name__)

DECISIVE_LEAD = 3.0          # log evidence by which another model of the steps replaces the default
DECISIVE_RELEASE = 6.0       # log evidence by which a group is told to be wrong
FURTHER_ENTRY = 0.5          # log evidence beside it, for each entry of a group but the first
STATED = 3.0                 # log evidence beside it, if standard deviations are stated
ANY_MOMENT = 6.0             # log evidence beside it, for what may happen at any moment
AMBIGUOUS = 4.5              # log evidence within which explanations cannot be told apart
MAX_GROUPS = 5               # number of groups that are wrong at once
MAX_WIDE_SIGMAS = 4.0        # wide sigmas, of an entry; beyond them a statement is grossly wrong
GROSS = 10.0                 # factor on the wide sigmas beyond MAX_WIDE_SIGMAS
MIN_INFORMATION = 1e-3       # about an entry, in wide sigmas, below which it is not considered
MAX_PROPOSALS = 5            # number of sets that are solved
MAX_COST = 1.5               # ratio of sigmas of the last position, by what is released untold
MAX_UNTOLD = 1.0             # wide sigmas, by which what is released untold may be off
MIN_SPARED_SLIP = 4.0        # ratio of the slips without and with jumps that are believed
MIN_JUMP_LEAD = 10.0         # log evidence by which a jump found at the solution is believed
MIN_REJECTED = 3             # number of sightings together, near which a jump may be overlooked

SMALL_SLIP = 2e-3            # sqrt(m), above which slow errors of sensors may be the cause
LARGE_SLIP = 0.01            # sqrt(m), above which errors of images mostly are, if it is none
AS_STATED = 1.25             # ratio of sigmas, within which errors are as large as stated
MIN_OVER_ROUNDING = 4.0      # ratio of variances of a slip and of the rounding of counts

VISIT_GAP = 30               # typical intervals between sightings of a marker, that end a visit
MIN_VISIT = 3                # number of accepted sightings of a visit that is compared
MAX_REJECTED_SHARE = 0.5     # of the sightings of a visit
MAX_SLIP_RATIO = 2.0         # of the slips with and without an explanation that is believed
MIN_SPARED = 2               # number of sightings, by each more jump, or by each place of an id if
                             # their errors are independent
MAX_LOST = 0.1               # of these, number that may be rejected instead
LOST_WEIGHT = 2              # number of these that outweigh one that is rejected instead
PLACE_GATE = 60.0            # squared distance of x, y, heading in sigmas, beyond it another place
MIN_SIGMA = 0.02             # m or rad, of the path between two visits


def memory_or_slip(problem: Problem, state: State) -> Fit:
    """The Fit of a Problem, near its solution, that explains slow errors by memory, or by slip.

    Slow errors of sensors bend the path as slip does. A learned slip explains them if errors are
    independent then. Unless it is small, they must be as large as stated, too, and it must turn the
    vehicle. Otherwise memory comes first: where wheels slip, it finds the slip, too.

    Errors that all markers of an image share, as of its time, look like slip, too, often a large
    one. Where a slip that memory finds, or a large one, does not turn the vehicle, it is held small
    and the sightings have larger errors instead.
    """
    by_slip = refine_without_memory(replace(problem, memory_first=False), state)
    slip, *factors = by_slip.problem.noise
    is_as_stated = np.abs(np.log(factors)).max() < np.log(AS_STATED)
    explains = (_is_small_slip(by_slip) or is_as_stated) and not has_memory(by_slip)
    if explains and _is_slip(by_slip):
        return by_slip
    fit = by_slip
    if not explains or slip < LARGE_SLIP:
        fit = if_solvable(refine, replace(problem, memory_first=True), state) or by_slip
        if _is_slip(fit):
            return fit
    return if_solvable(refine, replace(problem, max_slip=SMALL_SLIP), state) or fit


def _is_slip(fit):
    """Whether the slip of a Fit is small, turns the vehicle, or may be the rounding of counts."""
    return _is_small_slip(fit) or _is_rounding(fit) or turns_by_slip(fit.problem, fit.state)


def _is_small_slip(fit):
    """Whether the slip of a Fit is small, or known."""
    return fit.problem.noise.slip < SMALL_SLIP or not fit.problem.measurements.learned[0]


def _is_rounding(fit):
    """Whether the slip of a Fit between two frames may be the rounding of the counts there."""
    m = fit.problem.measurements
    along = m.odometry_noise[1][:, 0, 0]
    variance = fit.problem.noise.slip**2 * np.median(along)
    rounding = m.dataset.vehicle.metres_per_count.max()**2 / 6       # of a difference of two
    return variance < MIN_OVER_ROUNDING * rounding


def better_model(fit: Fit) -> Fit:
    """The Fit by Euler's steps if their evidence leads that of arcs by DECISIVE_LEAD, or arcs."""
    present = replace(fit.problem, accepted=_with_fixed_weights(fit))
    model = present.odometry.model
    other = "arc" if model == "euler" else "euler"
    odometry = preintegrate_odometry(
        present.measurements, other, present.odometry.wheel, present.noise.slip)
    of_present = _log_evidence_at(fit.state, present)
    of_other = _log_evidence_at(fit.state, replace(present, odometry=odometry))
    needed_lead = DECISIVE_LEAD if other == "euler" else -DECISIVE_LEAD
    is_better = of_other - of_present > needed_lead
    log.info("model of the steps: log evidence %.1f of %s, %.1f of %s: %s", of_present, model,
             of_other, other, other if is_better else model)
    if not is_better:
        return fit
    better = refine(replace(fit.problem, odometry=odometry), fit.state, accept=None)
    return replace(better, explanations=fit.explanations, lead=fit.lead)


def _log_evidence_at(state, problem):
    return laplace_approximation(NormalEquations(problem, state), problem.noise)[1]


def calibrated(fit: Fit) -> Fit:
    """The Fit in which groups of the calibration have left their stated values."""
    tried = []
    for _ in range(MAX_PROPOSALS):
        proposal = _proposal(fit)
        if np.array_equal(proposal.prior.root, fit.problem.prior.root):
            fit = replace(fit, explanations=proposal.explanations)
            break
        if proposal.prior.groups in tried:
            break
        tried.append(proposal.prior.groups)
        proposed = _released(fit, proposal)
        if proposed is None:
            if proposal.prior.groups < fit.problem.prior.groups:
                fit = replace(fit, explanations=proposal.explanations)
            break
        fit = proposed
    return replace(fit, explanations=_confirmed(fit))


def _confirmed(fit):
    """The explanations of a Fit that its solutions with and without their groups confirm.

    What the Jumps say of the camera is confirmed already.
    """
    m = fit.problem.measurements
    confirmed = []
    for some in fit.explanations:
        needed = sum(_price(m.calibration, group) for group in some - m.jumps.groups)
        if fit.lead >= needed:
            confirmed.append(some)
    is_released = any(some <= fit.problem.prior.groups for some in confirmed)
    return tuple(confirmed) if is_released else (frozenset(),)


class _Proposal(NamedTuple):
    """Which groups of the calibration are to leave their stated values."""

    explanations: tuple      # of frozensets of groups, each of which explains the drive
    prior: Prior             # of the calibration, with the groups that are to be released
    lead: float              # log evidence over that of the prior as it is


def _released(fit, proposal):
    """The Fit with a _Proposal, or None if its evidence does not lead, or it is not solved."""
    stated = fit.problem.measurements.calibration.stated
    c = np.where(proposal.prior.active, fit.state.c, stated)
    problem = replace(fit.problem, prior=proposal.prior)
    names = ", ".join(sorted(proposal.prior.groups)) or "nothing"
    solve = memory_or_slip if problem.memory_first else refine
    proposed = if_solvable(solve, problem, replace(fit.state, c=c))
    if proposed is None or not _is_solved(proposed):
        log.info("calibration: %s released, no solution: refused", names)
        return None
    lead = _lead(proposed, fit)
    needed = 0.0 if proposal.lead >= 0 else proposal.lead - DECISIVE_RELEASE
    needed += _price_of_far(proposed, proposal.prior.groups - fit.problem.prior.groups)
    is_kept = lead >= needed
    log.info("calibration: %s released, log evidence %+.1f (predicted %+.1f): %s", names, lead,
             proposal.lead, "kept" if is_kept else "refused")
    if not is_kept:
        return None
    return replace(proposed, explanations=proposal.explanations, lead=fit.lead + lead)


def _price_of_far(fit, groups):
    """The prices of those groups whose entries are far from what is stated: they must be certain.

    Small errors of statements are common, large ones are not.
    """
    calibration = fit.problem.measurements.calibration
    off = np.abs(fit.state.c - calibration.stated) > MAX_UNTOLD * calibration.wide
    return sum(_price(calibration, group) for group in groups
               if off[calibration.of_group(group)].any())


def _is_solved(fit):
    """Whether the rounds of a Fit ended, with a possible calibration."""
    is_possible = fit.problem.measurements.calibration.is_possible(fit.state.c)
    return fit.converged and is_possible.all()


class _Sets(NamedTuple):
    """s sets of groups that may leave what is stated, by the likelihood of the calibration."""

    groups: list[frozenset]      # (s,)
    priors: list[Prior]          # (s,)
    evidence: np.ndarray         # (s,) log evidence, -inf where what is released cannot be
    merit: np.ndarray            # (s,) log evidence less the prices of the groups
    surprise: np.ndarray         # (s,) part of the prices, of groups that are stated in full
    furthest: np.ndarray         # (s,) largest posterior mean of what is released, in its sigmas
    variance: np.ndarray         # (s,) m^2, of the last position


def _proposal(fit):
    """The _Proposal of the groups of the calibration of a Fit that the evidence wants released.

    `explanations` are the best set of groups and others that the drive cannot tell from it, neither
    part of it nor more. The prior releases all groups that are likely, and what else raises the
    evidence: not certain enough to be told, but the covariances include it, unless the last
    position would be far less certain. Wide standard deviations are multiplied by GROSS if an entry
    that is released would be further off than MAX_WIDE_SIGMAS.
    """
    calibration = fit.problem.measurements.calibration
    likelihood = _likelihood(fit)
    for width in (1.0, GROSS):
        sets = _sets(calibration, likelihood, width)
        k = int(sets.merit.argmax())
        best = sets.groups[k]
        if not best or sets.furthest[k] < MAX_WIDE_SIGMAS:
            break
    likely, told = _as_likely(sets, k)
    explanations = tuple(some for some in told if not (some < best or some > best))
    k = _released_set(sets, certain=frozenset().union(*likely), default=k)
    root = _in_wide_sigmas(calibration, likelihood.L, fit.problem.prior.root)
    present = _posterior(likelihood, root)[0]
    return _Proposal(explanations, sets.priors[k], sets.evidence[k] - present)


def _lead_of_group(fit, group):
    """By how much a group raises the log evidence of a Fit, at its linearisation."""
    calibration = fit.problem.measurements.calibration
    prior = fit.problem.prior
    without = calibration.prior(prior.groups - {group}, prior.width)
    likelihood = _likelihood(fit)
    roots = _in_wide_sigmas(calibration, likelihood.L, np.stack([prior.root, without.root]))
    of_all, of_others = _posterior(likelihood, roots)[0]
    log.info("calibration: log evidence %+.1f by %s", of_all - of_others, group)
    return of_all - of_others


def _sets(calibration, likelihood, width):
    """The _Sets of up to MAX_GROUPS groups of which a _Likelihood tells.

    Their wide standard deviations are multiplied by a width.
    """
    L = likelihood.L
    doubtful = (np.diag(L) > 0) & (calibration.wide > calibration.sigma)
    groups = np.unique(calibration.group[doubtful]).tolist()
    if doubtful[RADII].all():
        groups.append(WHEEL_SCALE)
    sets = [frozenset(some) for count in range(MAX_GROUPS + 1)
            for some in combinations(groups, count)]
    priors = [calibration.prior(some, width) for some in sets]
    given = np.array([prior.root for prior in priors])
    is_released = np.diagonal(given, axis1=1, axis2=2) > calibration.sigma
    roots = _in_wide_sigmas(calibration, L, given)
    evidence, mean, variance = _posterior(likelihood, roots)
    c = calibration.stated + np.matvec(given, mean)
    impossible = is_released & ~calibration.is_possible(c)
    evidence[impossible.any(axis=1)] = -np.inf
    price = {group: _price(calibration, group) for group in groups}
    surprise = {group: _surprise(calibration, group) for group in groups}
    prices = np.array([sum(price[group] for group in some) for some in sets])
    surprises = np.array([sum(surprise[group] for group in some) for some in sets])
    return _Sets(sets, priors, evidence, evidence - prices, surprises,
                 furthest=np.max(np.abs(mean), axis=1, where=is_released, initial=0.0),
                 variance=variance)


def _as_likely(sets, best):
    """Those of the _Sets that the drive cannot tell from number `best`, which is one of them.

    In each of them every group is worth its price.

    Returns
    -------
    list of groups, of those within AMBIGUOUS of the best.
    list of groups, of these and one more: the best of those within AMBIGUOUS but for what a stated
        standard deviation costs. It is told, but what was stated more firmly is kept.
    """
    first = sets.groups[best]
    merit = dict(zip(sets.groups, sets.merit))
    of_worth = np.array([all(merit[some] >= merit[some - {group}] for group in some)
                         for some in sets.groups])

    def near(merits):
        return list(compress(sets.groups, of_worth & (merits > merits[best] - AMBIGUOUS)))

    likely = near(sets.merit)
    others = [some for some in near(sets.merit + sets.surprise)
              if some not in likely and not (some <= first or some > first)]
    others.sort(key=merit.get)
    return likely, likely + others[-1:]


def _in_wide_sigmas(calibration, L, roots):
    """Roots (..., p, p) of priors in wide sigmas, 0 of entries that L (p, p) does not inform."""
    return (np.diag(L) > 0)[:, None] / calibration.wide[:, None] * roots


def _released_set(sets, certain, default):
    """Number of the most probable of the _Sets that hold `certain`, the `default` if none does.

    With what it releases beside them the sigma of the last position is at most MAX_COST times as
    large.
    """
    holding = [k for k, some in enumerate(sets.groups) if certain <= some]
    if not holding:
        return default
    largest = MAX_COST**2 * sets.variance[holding].min()
    affordable = [k for k in holding if sets.variance[k] <= largest]
    probable = sets.evidence - sets.surprise
    return max(affordable, key=probable.item)


def _price(calibration, group):
    """Log evidence by which a group must raise that of the rest to be told: its prior odds."""
    entries = calibration.of_group(group)
    count = 1 if group == WHEEL_SCALE else np.count_nonzero(entries)
    price = DECISIVE_RELEASE + FURTHER_ENTRY * (count - 1)
    price += ANY_MOMENT * (group == "camera-bump")
    return price + STATED * calibration.sigma[entries].any()


def _surprise(calibration, group):
    """The part of its `_price` by which a group is less probable, if it is stated in full."""
    return STATED * calibration.sigma[calibration.of_group(group)].all()


class _Likelihood(NamedTuple):
    """The likelihood of the calibration, in wide sigmas from what is stated, all else eliminated.

    exp(-u^T L u / 2 + h^T u), and the last position for a known calibration.
    """

    L: np.ndarray            # (p, p)
    h: np.ndarray            # (p,)
    variance: float          # m^2, of the last position
    lever: np.ndarray        # (2, p) m, its derivatives by u


def _posterior(likelihood, root):
    """What priors with roots (..., p, p), as of a Prior, make of a _Likelihood.

    Log evidences (...), means (..., p) of the unknowns, in their standard deviations, in which the
    equations are solved, and variances (...) of the last position.
    """
    L, h, variance, lever = likelihood
    information = np.eye(len(h)) + root.mT @ L @ root
    gradient = h @ root
    mean = np.linalg.solve(information, gradient[..., None])[..., 0]
    log_determinant = np.linalg.slogdet(information).logabsdet
    evidence = np.sum(gradient * mean, axis=-1) / 2 - log_determinant / 2
    moved = (lever @ root).mT
    added = np.sum(moved * np.linalg.solve(information, moved), axis=(-2, -1))
    return evidence, mean, variance + added


def _likelihood(fit):
    """The _Likelihood of the calibration of a Fit."""
    calibration = fit.problem.measurements.calibration
    wide = Prior(frozenset(), 1.0, np.diag(calibration.wide))
    equations = NormalEquations(replace(fit.problem, prior=wide), fit.state)
    sums = equations.sums(fit.problem.noise, consistent=True)
    solution = linear_solution(equations.structure, sums)
    u = (fit.state.c - calibration.stated) / calibration.wide
    p = len(u)
    L = np.zeros((p, p))
    if solution is None:
        return _Likelihood(L, np.zeros(p), 0.0, np.zeros((2, p)))
    without_prior = solution.S - np.eye(p)
    gradient = solution.gradient - u                      # without the prior, too
    known = np.diag(without_prior) > MIN_INFORMATION
    block = np.ix_(known, known)
    values, axes = np.linalg.eigh(without_prior[block])
    L[block] = axes * np.maximum(values, 0) @ axes.T
    position = equations.structure.rows[len(fit.state.poses) - 1, :2]
    selected = np.zeros((len(solution.by_c), 2))
    selected[position] = np.eye(2)
    covariance = solution.lu.solve(selected)[position]
    return _Likelihood(L, np.where(known, L @ u - gradient, 0.0), variance=np.trace(covariance),
                       lever=-solution.by_c[position])


def _lead(proposed, present):
    """Log evidence of a Fit minus that of another, by what both accept, noise learned.

    With the shares of `proposed`. Minus infinity if what both accept has no solution.
    """
    accepted = _with_fixed_weights(proposed)
    in_both = [replace(kind, weight=kind.weight * (other.weight > 0))
               for kind, other in zip(accepted, present.problem.accepted)]

    def log_density(fit):
        problem = replace(fit.problem, accepted=AcceptedMeasurements(*in_both))
        return refine(problem, fit.state, None).log_density

    of_both = [if_solvable(log_density, fit) for fit in (proposed, present)]
    if None in of_both:
        return -np.inf
    return of_both[0] - of_both[1]


def _with_fixed_weights(fit):
    """AcceptedMeasurements in which weights replace the kernel of the ranges."""
    accepted = fit.problem.accepted
    late = residuals(fit.problem, fit.state)[1]
    weight = accepted.ranges.kept(late)
    return accepted._replace(ranges=replace(accepted.ranges, weight=weight, kernel=None))


def most_consistent(
        dataset: Dataset, start: Callable[..., Fit],
        decide: Callable[[Fit], Fit]) -> tuple[Fit, np.ndarray | None]:
    """The Fit that rejects few sightings, and `SlamResult.places`, None if each id is one place.

    `start` makes the Fit of Jumps and of places, undecided or with the decisions that another Fit
    is `like`, and `decide` decides. Jumps of odometry, or else places of ids, are believed where
    they spare sightings that are rejected without them, with the same decisions. A wrong statement
    can look like jumps or places, so the Fit without jumps, and that with places, is free to find
    one before it is compared with the other. A few jumps are also believed if the evidence leads
    and hardly any sighting contradicts them instead, or no marker tells them; a camera that was
    moved, if the evidence leads. Where a solution rejects many sightings together, jumps that show
    only with the slip that was learned are believed, all or the likeliest, if they spare some, with
    no larger slip. Where a solution stretches odometry beyond this slip, most of all over a way
    without markers, one more jump is believed if the evidence leads decisively.
    """
    bump = camera_bump(dataset)
    fit = _with_jumps(dataset, start, decide, bump)
    if bump is not None and _lead_of_group(fit, "camera-bump") < MIN_JUMP_LEAD:
        fit = _with_jumps(dataset, start, decide, None)
    if has_rejected_visits(fit):
        no_jumps = fit.problem.measurements.jumps.none()
        places = places_of_ids(dataset.aruco, partial(start, no_jumps, like=fit))
        if places is not None:
            if _needs_places(if_solvable(start, no_jumps, places, fit), fit, places):
                with_places = decide(start(no_jumps, places))
                without = if_solvable(start, no_jumps, None, with_places)
                if without is None:
                    return with_places, places
                fit = decide(without)
                if _needs_places(with_places, fit, places):
                    return with_places, places
    for jumps in _overlooked(fit):
        count = len(jumps.start) - len(fit.problem.measurements.jumps.start)
        other = _with_more_jumps(fit, jumps)
        is_needed = spares_sightings(other, fit, "more jumps", MIN_SPARED * count)
        if is_needed and other.problem.noise.slip <= fit.problem.noise.slip:
            fit = decide(start(jumps))
            break
    jumps = with_stretched(fit)
    if jumps is not None and _lead_of_jumps(_with_more_jumps(fit, jumps), fit) > MIN_JUMP_LEAD:
        return decide(start(jumps)), None
    return fit, None


def _needs_places(fit, other, places):
    """Whether a Fit with `SlamResult.places` spares enough independent sightings, not if None.

    Several sightings whose errors have memory count as one: slow errors differ from visit to visit
    of most ids, so that a place for each visit would spare many.
    """
    if fit is None:
        return False
    count = len(np.unique(places[places[:, 0] != places[:, 1], 1]))
    least = MIN_SPARED * count / fit.problem.accepted.sightings.share.mean()
    return spares_sightings(fit, other, "places of ids", least)


def _with_more_jumps(fit, jumps):
    """The Fit with more Jumps, from the solution and decisions of a Fit, or None."""
    more = replace(fit.problem.measurements, jumps=jumps)
    problem = relinearized(replace(fit.problem, measurements=more), fit.state)
    return if_solvable(refine_like, problem, fit.state, fit)


def _with_jumps(dataset, start, decide, bump):
    """The Fit with those Jumps of a Dataset that are believed, and a CameraBump or None."""
    if bump is None:
        jumps = find_jumps(dataset)
    else:
        jumps = replace(find_jumps(bump.mended(dataset)), bump=bump.pose)
    found = len(jumps.start)
    no_jumps = jumps.none()
    fit = decide(start(jumps if jumps.are_few else no_jumps))
    if jumps.are_few:
        without = if_solvable(start, no_jumps, None, fit)
        if without is not None:
            without = decide(without)
        are_told = (jumps.sigma < UNKNOWN_SIGMA).all()           # by markers
        if without is not None and are_told:
            is_led = _spares_slip(fit, without) or _lead_of_jumps(fit, without) >= MIN_JUMP_LEAD
            least = -LOST_WEIGHT if is_led else found + jumps.causes
            if not spares_sightings(fit, without, "jumps", least):
                fit = without
    elif found:
        alternative = if_solvable(start, jumps, None, fit)
        if spares_sightings(alternative, fit, "jumps", found + jumps.causes):
            fit = decide(start(jumps))
    log.info("jumps: %d of %d are believed", len(fit.problem.measurements.jumps.start), found)
    return fit


def _spares_slip(fit, other):
    """Whether another Fit learns a far larger slip than a Fit with jumps."""
    m = fit.problem.measurements
    slip = max(fit.problem.noise.slip, TYPICAL_SLIP)
    return m.learned[0] and other.problem.noise.slip > MIN_SPARED_SLIP * slip


def _lead_of_jumps(fit, other):
    """Log evidence of a Fit with more jumps over that of another, none if there is no solution."""
    lead = -np.inf if fit is None else _lead(fit, other)
    log.info("jumps: log evidence %+.1f", lead)
    return lead


def _overlooked(fit):
    """List of Jumps: those of a Fit, and more that its rejected sightings may tell.

    It is empty where few are rejected together, the slip is given, or the camera is late or was
    moved.
    """
    m = fit.problem.measurements
    rejected = fit.problem.accepted.sightings.weight == 0
    by_frame = np.bincount(m.sightings.row[rejected], minlength=len(m.frame))
    are_together = most_together(by_frame) >= MIN_REJECTED
    if not are_together or not m.learned[0] or m.jumps.groups:
        return []
    return with_overlooked(m.dataset, m.jumps, fit.problem.noise.slip)


def with_stretched(fit: Fit) -> Jumps | None:
    """The Jumps of a Fit and the step that contradicts odometry most, None if that is within GATE.

    Data snooping (Baarda 1968) with the slip that is learned. There is no such step where it is
    given.
    """
    m = fit.problem.measurements
    if not m.learned[0] or not len(m.marker_row) or len(m.frame) < 2:
        return None
    odometry = fit.problem.odometry
    poses = fit.state.poses
    e = odometry_error(odometry, poses, fit.state.c[WHEELS])[0]
    squared = se2.squared_norms(e, odometry.covariance(fit.problem.noise.slip))
    k = int(squared.argmax())
    if squared[k] > GATE:
        return m.jumps.joined_by(
            m.frame[k], m.frame[k + 1], se2.between(poses[k], poses[k + 1]),
            odometry.increment[k], len(m.dataset.ticks))
    return None


def visits(aruco: ArucoReadings) -> np.ndarray:
    """Number (m,) of the visit of every one of ArucoReadings, from 0, by id, then by time."""
    order = np.lexsort((aruco.pose, aruco.marker))
    marker = aruco.marker[order]
    number = np.arange(len(order))
    if (marker[1:] == marker[:-1]).any():
        number = runs(marker, aruco.pose[order], VISIT_GAP)[1]
    return number[np.argsort(order)]


def contradicted(fit: Fit, factor: float) -> np.ndarray:
    """Which sightings (s,), bool, a Fit rejects at this noise factor."""
    problem = replace(fit.problem, noise=fit.problem.noise._replace(sightings=factor))
    return accepted_measurements(problem, fit.state).sightings.weight == 0


def has_rejected_visits(fit: Fit) -> bool:
    """Whether a Fit rejects most sightings of any visit.

    A marker that was moved looks like errors with memory, and the factor learned would hide it.
    """
    m = fit.problem.measurements
    if not len(m.marker_row):
        return False
    factor = fit.problem.noise.sightings
    if (fit.problem.accepted.share < 1).any():
        factor = min(factor, 1.0)
    number = visits(m.dataset.aruco)[m.sightings.index]
    count = np.bincount(number)
    rejected = np.bincount(number, contradicted(fit, factor))
    most_rejected = (count >= MIN_VISIT) & (rejected > MAX_REJECTED_SHARE * count)
    return bool(most_rejected.any())


def spares_sightings(fit: Fit | None, other: Fit, explanation: str, least: float) -> bool:
    """Whether a Fit spares at least so many sightings more than it loses, times LOST_WEIGHT.

    It spares one that another Fit rejects, and loses one that the other accepts; it may lose hardly
    any. A Fit that learns a far larger slip spares them by this slip, not by its explanation.
    """
    if fit is None:
        return False
    factor = min(fit.problem.noise.sightings, other.problem.noise.sightings)
    wrong = contradicted(fit, factor)
    wrong_without = contradicted(other, factor)
    spared = np.count_nonzero(wrong_without & ~wrong)
    lost = np.count_nonzero(wrong & ~wrong_without)
    slips = fit.problem.noise.slip > max(LARGE_SLIP, MAX_SLIP_RATIO * other.problem.noise.slip)
    few_lost = lost <= max(1, MAX_LOST * spared)
    is_believed = spared - LOST_WEIGHT * lost >= least and few_lost and not slips
    log.info("%s: spare %d sightings, lose %d, slip %.3g mm after 1 m, %.3g without: %s",
             explanation, spared, lost, 1e3 * fit.problem.noise.slip,
             1e3 * other.problem.noise.slip, "believed" if is_believed else "not believed")
    return is_believed


def places_of_ids(aruco: ArucoReadings, start: Callable[..., Fit]) -> np.ndarray | None:
    """`SlamResult.places` of ArucoReadings, None if each id is one place.

    `start` makes the Fit of given places.
    """
    marker = aruco.marker
    number = visits(aruco)
    visit_of_id = np.stack([marker, number], axis=1)
    result = if_solvable(lambda: slam_result(start(visit_of_id)))
    if result is None:
        return None
    place = np.zeros_like(marker)
    for each in np.unique(marker):
        of_id = marker == each
        for visit, its_place in _places_of_visits(result, number[of_id]):
            place[number == visit] = its_place
        if place[of_id].any():
            log.info("places: marker %d is seen at %d", each, 1 + place[of_id].max())
    if not place.any():
        return None
    return np.stack([marker, ids_of_places(marker, place)], axis=1)


def _places_of_visits(result, numbers):
    """Each visit of an id that is compared, in the order of time, and its place, from 0.

    By a SlamResult with a landmark for every visit, with its number as id. It is at the place whose
    last visit is nearest, or at another one if all of them are beyond PLACE_GATE.
    """
    accepted = ~result.rejected
    seen = result.sightings.marker[accepted]
    pose = result.sightings.frame[result.sightings.row[accepted]]
    last = {}                                     # visit of each place
    for visit in np.intersect1d(numbers, result.marker):
        poses = pose[seen == visit]
        if len(poses) < MIN_VISIT:
            continue
        squared = [_squared_distance(result, other, visit, pose[seen == other][-1], poses[0])
                   for other in last.values()]
        place = len(last)
        if min(squared, default=np.inf) < PLACE_GATE:
            place = int(np.argmin(squared))
        last[place] = visit
        yield visit, place


def ids_of_places(marker: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Ids (m,) of markers (m,) at places (m,), from 0: where ids have two digits 12, 112, 212.

    The number of the place stands before the digits of the longest id, behind the sign if there is
    one. So no new id is one of the drive.
    """
    digits = len(str(np.abs(marker).max()))
    away_from_zero = np.where(marker < 0, -1, 1)
    return marker + away_from_zero * place * 10**digits


def _squared_distance(result, first, second, pose, later):
    """Squared distance in sigmas of two visits, markers `first` and `second` of a SlamResult.

    The first one was last seen at `pose`, the second one first seen at the pose `later`. The path
    from a pose of covariance P_1 to one of P_2 adds A P_2 A^T - B P_1 B^T to the covariance of a
    place that A and B move with these poses.
    """
    place = result.marker_in_world[np.searchsorted(result.marker, [first, second])]
    poses = result.poses[[pose, later]]
    P = result.covariances[[pose, later]]
    A = se2.compose_jacobians(poses, se2.between(poses, place[1]))[0]
    C = A @ P @ A.mT
    variance, axes = np.linalg.eigh(C[1] - C[0])
    off = axes.T @ se2.difference(place[1], place[0])
    return float(np.sum(off**2 / np.maximum(variance, MIN_SIGMA**2)))
