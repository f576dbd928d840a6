"""Stage 6: what the evidence decides: arcs or Euler's steps, and which statements are wrong.

Of the calibration, groups of entries may leave their stated values (`calibrated`): they get the
wide standard deviations of `calibration.ENTRIES`. The normal equations with columns for all entries
give the likelihood of the whole calibration, all else eliminated, exp(-u^T L u / 2 + h^T u) with u
in wide sigmas. For a prior of precisions P on the entries that are not known, the log evidence is

    h^T (L + P)^-1 h / 2 - log|L + P| / 2 + log|P| / 2,

so that one linearisation ranks all sets of groups (score tests: Rao, Proc. Camb. Phil. Soc. 44(1),
1948). The set that it proposes is solved, and replaces the present one if its evidence leads
decisively on the same measurements with the same weights.
"""

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from slamlib.dataset import DatasetError
from slamlib.odometry import MODELS
from slamlib.slam.factors import linearize_ranges
from slamlib.slam.fit import accepted_measurements, refine
from slamlib.slam.linear import (
    NormalEquations,
    consistency_factors,
    laplace_approximation,
    linear_solution,
)
from slamlib.slam.noise import equations_of_first_frames, greatest_log_density, log_density
from slamlib.slam.problem import preintegrate_odometry

DECISIVE_LEAD = 3.0          # log evidence by which another model of the steps replaces the default
DECISIVE_RELEASE = 6.0       # log evidence by which a group leaves its stated values
FURTHER_ENTRY = 0.5          # log evidence beside it, for each entry of a group but the first
STATED = 3.0                 # log evidence beside it, if standard deviations are stated
AMBIGUOUS = 3.0              # log evidence within which explanations cannot be told apart
MAX_WIDE_SIGMAS = 4.0        # wide sigmas, of an entry; beyond them a statement is grossly wrong
GROSS = 10.0                 # factor on the wide sigmas then
MIN_ACCEPTED = 0.98          # of the accepted measurements, that a proposed set accepts too
MIN_INFORMATION = 1e-3       # about an entry, in wide sigmas, below which it is not considered
MAX_PROPOSALS = 5            # number of sets that are solved


def better_model(fit):
    """The Fit by Euler's steps if their evidence leads that of arcs by DECISIVE_LEAD, else by arcs.

    Both evidences are on the same measurements with the same weights, so the weights that the
    kernel of the ranges gives at `fit` are kept. The noise is learned for each model.
    """
    current = replace(fit.problem, accepted=_with_fixed_weights(fit))
    other, = {*MODELS} - {current.odometry.model}
    odometry = replace(preintegrate_odometry(
        current.measurements, other, current.odometry.wheel), in_counts=True)
    lead = _log_density(NormalEquations(replace(current, odometry=odometry), fit.state),
                        fit.posterior) \
        - _log_density(NormalEquations(current, fit.state), fit.posterior,
                       is_greatest=not len(current.accepted.range_weight))
    if lead <= (DECISIVE_LEAD if other == "euler" else -DECISIVE_LEAD):
        return fit
    return replace(refine(replace(fit.problem, odometry=odometry), fit.state, accept=None),
                   explanations=fit.explanations)


def calibrated(fit, accept=accepted_measurements):
    """The Fit in which groups of the calibration have left their stated values.

    `accept` as in `refine`. It is that of `fit` if the evidence speaks for none.
    """
    tried = []
    for _ in range(MAX_PROPOSALS):
        proposal = _proposal(fit)
        if np.array_equal(proposal.sigma, fit.problem.sigma):
            return replace(fit, explanations=proposal.explanations)
        if proposal.groups in tried:
            break
        tried.append(proposal.groups)
        stated = fit.problem.measurements.calibration.stated
        state = replace(fit.state, c=np.where(proposal.sigma > 0, fit.state.c, stated))
        problem = replace(fit.problem, sigma=proposal.sigma, released=proposal.groups)
        try:
            proposed = refine(problem, state, accept)
            lead = _lead(proposed, fit)
        except (DatasetError, np.linalg.LinAlgError):
            break
        least = 0.0 if proposal.lead >= 0 else proposal.lead - DECISIVE_RELEASE
        kept, present = (each.problem.accepted.weight.sum() for each in (proposed, fit))
        far = np.abs(proposed.state.c - stated) > MAX_WIDE_SIGMAS * proposal.sigma
        if lead < least or kept < MIN_ACCEPTED * present or far[proposal.sigma > 0].any():
            break
        fit = replace(proposed, explanations=proposal.explanations)
    return fit


@dataclass(frozen=True)
class _Proposal:
    """Which groups of the calibration the evidence wants to be released."""

    explanations: tuple      # of frozensets of groups, of which each one explains the drive
    groups: frozenset        # to release: of all explanations, and what raises the evidence at all
    sigma: np.ndarray        # (p,) with these groups released
    lead: float              # log evidence over that of the prior as it is


def _proposal(fit):
    """The _Proposal for a Fit.

    Every released group must raise the log evidence by DECISIVE_RELEASE, by FURTHER_ENTRY more for
    each of its entries but one, and by STATED more if its standard deviations are stated: these are
    prior odds. Explanations are the best set and others that come within AMBIGUOUS of it, neither
    part of it nor more: the drive cannot tell them apart. What else raises the evidence is not
    certain enough to be told, but the covariances have to include it. If an entry would be further
    off than MAX_WIDE_SIGMAS, a statement is grossly wrong, and wide sigmas are multiplied by GROSS.
    """
    calibration = fit.problem.measurements.calibration
    L, h = _likelihood(fit)
    informed = np.diag(L) > 0
    doubtful = informed & (calibration.wide > calibration.sigma)
    candidates = frozenset(calibration.group[doubtful].tolist())
    stated = frozenset(calibration.group[calibration.sigma > 0].tolist())
    for width in (1.0, GROSS):
        evidence, merit, largest = {}, {}, {}
        for count in range(len(candidates) + 1):
            for some in map(frozenset, combinations(sorted(candidates), count)):
                sigma = calibration.sigma_without(some, width) / calibration.wide * informed
                evidence[some], largest[some] = _log_evidence(L, h, sigma)
                entries = np.count_nonzero(np.isin(calibration.group, list(some)))
                merit[some] = evidence[some] - DECISIVE_RELEASE * count \
                    - FURTHER_ENTRY * (entries - count) - STATED * len(some & stated)
        best = max(merit, key=merit.get)
        if not best or largest[best] < MAX_WIDE_SIGMAS:
            break
    explanations = tuple(some for some in merit if some == best or (
        merit[some] > merit[best] - AMBIGUOUS and not some < best and not some > best))
    certain = frozenset().union(*explanations)
    more = max((some for some in evidence if certain <= some), key=evidence.get)
    present, _ = _log_evidence(L, h, fit.problem.sigma / calibration.wide * informed)
    return _Proposal(explanations=explanations, groups=more, lead=evidence[more] - present,
                     sigma=calibration.sigma_without(more, width))


def _log_evidence(L, h, sigma):
    """Log evidence of a prior with standard deviations (p,), 0 where an entry is known.

    From the information L (p, p) and h (p,) of the likelihood. Also the largest posterior mean of
    an entry, in its standard deviations.
    """
    used = sigma > 0
    posterior = L[np.ix_(used, used)] + np.diag(sigma[used]**-2.0)
    sign, log_determinant = np.linalg.slogdet(posterior)
    if sign <= 0:
        return -np.inf, 0.0
    mean = np.linalg.solve(posterior, h[used])
    return (h[used] @ mean / 2 - log_determinant / 2 - np.sum(np.log(sigma[used])),
            np.abs(mean / sigma[used]).max(initial=0.0))


def _likelihood(fit):
    """Information L (p, p) and h (p,) of the measurements about the whole calibration.

    In wide sigmas from the stated values, at the noise of the Fit, from the first frames of a long
    drive. Entries of antennas that these do not see have no information.
    """
    calibration = fit.problem.measurements.calibration
    known = replace(fit.problem, sigma=calibration.wide)
    equations = equations_of_first_frames(NormalEquations(known, fit.state))
    H, border, *_ = equations.sums(
        fit.problem.noise, consistency_factors(fit.problem.accepted))
    solution = linear_solution(equations.structure, H, border)
    p = len(calibration.stated)
    L, h = np.zeros((p, p)), np.zeros(p)
    if solution is None:
        return L, h
    part = equations.problem.measurements.calibration
    u = (equations.state.c - part.stated) / part.wide
    information = solution.S - np.eye(len(u))              # without the prior
    some = np.diag(information) > MIN_INFORMATION
    values, axes = np.linalg.eigh(information[np.ix_(some, some)])
    information = axes * np.maximum(values, 0) @ axes.T
    entries = np.array([calibration.names.index(name) for name in part.names])[some]
    L[np.ix_(entries, entries)] = information
    h[entries] = information @ u[some] - (solution.gradient - u)[some]
    return L, h


def _lead(proposed, present):
    """Difference of the log evidence of two Fits, on the measurements and weights of `proposed`.

    The noise is learned for each.
    """
    fixed = _with_fixed_weights(proposed)
    first, second = (refine(replace(problem, accepted=fixed), state, accept=None)
                     for problem, state in ((proposed.problem, proposed.state),
                                            (replace(proposed.problem, sigma=present.problem.sigma),
                                             present.state)))
    return first.log_density - second.log_density


def _with_fixed_weights(fit):
    """AcceptedMeasurements in which weights replace the kernel of the ranges."""
    accepted = fit.problem.accepted
    weight = accepted.weight.astype(float)
    ranges = np.flatnonzero(accepted.range_weight) + len(accepted.sighting_weight)
    weight[ranges] = linearize_ranges(fit.problem, fit.state).weight
    return replace(accepted, weight=weight, range_kernel=None)


def _log_density(equations, posterior, is_greatest=False):
    """Log evidence of known noise, or greatest log posterior density of learned noise.

    If `is_greatest`, the noise of the equations' problem is the mode already.
    """
    if posterior is None or not posterior.covariance.any():          # nothing was learned
        return laplace_approximation(equations, equations.problem.noise)[1]
    return log_density(equations) if is_greatest else greatest_log_density(equations, posterior)
