"""Stage 6: what the drive decides: arcs or Euler's steps, wrong statements, ids of several places.

Groups of entries of the calibration may leave their stated values (`calibrated`): they get the wide
standard deviations of `calibration.ENTRIES`. The normal equations with columns for all entries give
the likelihood of the whole calibration, all else eliminated, exp(-u^T L u / 2 + h^T u) with u in
wide sigmas. For a prior of precisions P on the entries that are not known, the log evidence is

    h^T (L + P)^-1 h / 2 - log|L + P| / 2 + log|P| / 2,

so that one linearisation ranks all sets of groups (score tests: Rao, Proc. Camb. Phil. Soc. 44(1),
1948). What leads decisively is told; what leads at all is solved as well, and the covariances
include it, if its evidence still leads on the same measurements with the same weights.

A visit is a run of sightings of an id without a long break. Where a solution rejects most sightings
of a visit, the drive is solved once more with a landmark for every visit, so that only the path
between them ties visits together. A visit whose landmark is further from all earlier places of its
id than this path explains is another place (`places_of_ids`).
"""

from collections import namedtuple
from dataclasses import replace
from itertools import combinations

import numpy as np

from slamlib.core import se2
from slamlib.core.errors import DatasetError
from slamlib.core.odometry import MODELS
from slamlib.core.sightings import GATE
from slamlib.robust.calibration import WHEELS
from slamlib.robust.error_memory import runs
from slamlib.robust.factors import odometry_error, preintegrate_odometry
from slamlib.robust.fit import accepted_measurements, refine, residuals
from slamlib.robust.jumps import NO_JUMPS, find_jumps
from slamlib.robust.linear import NormalEquations, laplace_approximation, linear_solution
from slamlib.robust.result import slam_result

DECISIVE_LEAD = 3.0          # log evidence by which another model of the steps replaces the default
DECISIVE_RELEASE = 6.0       # log evidence by which a group is told to be wrong
FURTHER_ENTRY = 0.5          # log evidence beside it, for each entry of a group but the first
STATED = 3.0                 # log evidence beside it, if standard deviations are stated
AMBIGUOUS = 3.0              # log evidence within which explanations cannot be told apart
MAX_WIDE_SIGMAS = 4.0        # wide sigmas, of an entry; beyond them a statement is grossly wrong
GROSS = 10.0                 # factor on the wide sigmas then
MIN_INFORMATION = 1e-3       # about an entry, in wide sigmas, below which it is not considered
MAX_PROPOSALS = 5            # number of sets that are solved
MIN_JUMP_LEAD = 10.0         # log evidence by which a jump found at the solution is believed

VISIT_GAP = 30               # typical intervals between sightings of a marker, that end a visit
MIN_VISIT = 3                # number of accepted sightings of a visit that is compared
MAX_REJECTED_SHARE = 0.5     # of the sightings of a visit
MAX_STILL_REJECTED = 0.5     # of the rejected sightings, by an explanation that is believed
PLACE_GATE = 60.0            # squared distance of x, y, heading in sigmas, beyond it another place
MIN_SIGMA = 0.02             # m or rad, of the path between two visits


def better_model(fit):
    """The Fit by Euler's steps if their evidence leads that of arcs by DECISIVE_LEAD, or arcs."""
    current = replace(fit.problem, accepted=_with_fixed_weights(fit))
    other, = {*MODELS} - {current.odometry.model}
    odometry = replace(preintegrate_odometry(
        current.measurements, other, current.odometry.wheel), in_counts=True)
    of_current, of_other = (laplace_approximation(
        NormalEquations(each, fit.state), current.noise)[1]
        for each in (current, replace(current, odometry=odometry)))
    if of_other - of_current <= (DECISIVE_LEAD if other == "euler" else -DECISIVE_LEAD):
        return fit
    return replace(refine(replace(fit.problem, odometry=odometry), fit.state, accept=None),
                   explanations=fit.explanations)


def calibrated(fit):
    """The Fit in which groups of the calibration have left their stated values."""
    tried, stated = [], fit.problem.measurements.calibration.stated
    for _ in range(MAX_PROPOSALS):
        problem, proposal = fit.problem, _proposal(fit)
        if np.array_equal(proposal.sigma, problem.sigma):
            fit = replace(fit, explanations=proposal.explanations)
            break
        if proposal.groups in tried:
            break
        tried.append(proposal.groups)
        state = replace(fit.state, c=np.where(proposal.sigma > 0, fit.state.c, stated))
        try:
            proposed = refine(
                replace(problem, sigma=proposal.sigma, released=proposal.groups), state)
            lead = _lead(proposed, fit)
        except (DatasetError, np.linalg.LinAlgError):
            break
        if lead < (0.0 if proposal.lead >= 0 else proposal.lead - DECISIVE_RELEASE):
            break
        fit = replace(proposed, explanations=proposal.explanations)
    return fit


_Proposal = namedtuple("_Proposal", "explanations groups sigma lead")


def _proposal(fit):
    """Which groups of the calibration of a Fit the evidence wants to be released: a _Proposal.

    `explanations`, frozensets of groups, are the best set and others that come within AMBIGUOUS of
    it, neither part of it nor more: the drive cannot tell them apart. Each of their groups must
    raise the log evidence by its prior odds: DECISIVE_RELEASE, FURTHER_ENTRY more for each of its
    entries but one, and STATED more if its standard deviations are stated. `groups` are all of
    theirs, and what else raises the evidence: not certain enough to be told, but the covariances
    have to include it. `lead` is the log evidence over that of the prior as it is. Of `sigma` (p,)
    the wide ones are multiplied by GROSS if an entry would be further off than MAX_WIDE_SIGMAS.
    """
    calibration = fit.problem.measurements.calibration
    L, h = _likelihood(fit)
    informed = np.diag(L) > 0
    doubtful = informed & (calibration.wide > calibration.sigma)
    candidates = sorted({*calibration.group[doubtful].tolist()})
    stated = frozenset(calibration.group[calibration.sigma > 0].tolist())
    entries = {each: np.count_nonzero(calibration.group == each) for each in candidates}
    sets = [frozenset(some) for count in range(len(candidates) + 1)
            for some in combinations(candidates, count)]
    for width in (1.0, GROSS):
        found = _log_evidence(L, h, informed / calibration.wide * [
            calibration.sigma_without(some, width) for some in sets])
        evidence, largest = (dict(zip(sets, each.tolist())) for each in found)
        merit = {some: evidence[some] - DECISIVE_RELEASE * len(some) - STATED * len(some & stated)
                 - FURTHER_ENTRY * sum(entries[each] - 1 for each in some) for some in sets}
        best = max(merit, key=merit.get)
        if not best or largest[best] < MAX_WIDE_SIGMAS:
            break
    explanations = tuple(some for some in merit if some == best or (
        merit[some] > merit[best] - AMBIGUOUS and not some < best and not some > best))
    certain = frozenset().union(*explanations)
    more = max((some for some in evidence if certain <= some), key=evidence.get)
    present, _ = _log_evidence(L, h, fit.problem.sigma / calibration.wide * informed)
    return _Proposal(explanations, more, calibration.sigma_without(more, width),
                     evidence[more] - present)


def _log_evidence(L, h, sigma):
    """Log evidences (...) of priors with standard deviations (..., p), 0 where an entry is known.

    From the information L (p, p) and h (p,) of the likelihood. Also the largest posterior mean of
    an entry, (...), in its standard deviations, in which the equations are solved.
    """
    posterior = np.eye(len(h)) + sigma[..., :, None] * L * sigma[..., None, :]
    mean = np.linalg.solve(posterior, (sigma * h)[..., None])[..., 0]
    return (np.sum(sigma * h * mean, axis=-1) / 2 - np.linalg.slogdet(posterior)[1] / 2,
            np.abs(mean).max(axis=-1))


def _likelihood(fit):
    """Information L (p, p) and h (p,) about the calibration, in wide sigmas from what is stated."""
    calibration = fit.problem.measurements.calibration
    equations = NormalEquations(replace(fit.problem, sigma=calibration.wide), fit.state)
    H, border, *_ = equations.sums(fit.problem.noise, consistent=True)
    solution = linear_solution(equations.structure, H, border)
    u = (fit.state.c - calibration.stated) / calibration.wide
    L, h = np.zeros((len(u), len(u))), np.zeros(len(u))
    if solution is None:
        return L, h
    information = solution.S - np.eye(len(u))              # without the prior
    some = np.diag(information) > MIN_INFORMATION
    values, axes = np.linalg.eigh(information[np.ix_(some, some)])
    information = axes * np.maximum(values, 0) @ axes.T
    L[np.ix_(some, some)] = information
    h[some] = information @ u[some] - (solution.gradient - u)[some]
    return L, h


def _lead(proposed, present):
    """Log evidence of a Fit minus that of another, on the weights of `proposed`, noise learned."""
    fixed = _with_fixed_weights(proposed)
    first, second = (refine(replace(proposed.problem, accepted=fixed, sigma=each.problem.sigma),
                            each.state, accept=None) for each in (proposed, present))
    return first.log_density - second.log_density


def _with_fixed_weights(fit):
    """AcceptedMeasurements in which weights replace the kernel of the ranges."""
    accepted, (_, late) = fit.problem.accepted, residuals(fit.problem, fit.state)
    return accepted._replace(ranges=replace(
        accepted.ranges, weight=accepted.ranges.kept(late), kernel=None))


def most_consistent(dataset, solve):
    """The Fit that rejects few sightings, and `SlamResult.places`, None if each id is one place.

    `solve` makes the Fit of Jumps and of places. Jumps of odometry, or else places of ids, are
    believed where they spare most of the sightings that are rejected without them. A few jumps need
    no such support. Where a solution stretches odometry beyond the slip that it learned, most of
    all over a way without markers, one more jump is believed if the evidence leads decisively.
    """
    jumps = find_jumps(dataset)
    fit = solve(jumps if jumps.are_few else replace(NO_JUMPS, lag=jumps.lag))
    if len(jumps.start) and not jumps.are_few:
        other = solve(jumps)
        fit = other if spares_sightings(other, fit) else fit
    if has_rejected_visits(fit):
        places = places_of_ids(dataset.aruco, solve)
        if places is not None and spares_sightings(other := solve(places=places), fit):
            return other, places
    jumps = with_stretched(fit)
    if jumps and (other := solve(jumps)).log_density > fit.log_density + MIN_JUMP_LEAD:
        return other, None
    return fit, None


def with_stretched(fit):
    """The Jumps of a Fit and the step that contradicts odometry most, None if that is within GATE.

    Data snooping (Baarda 1968) with the slip that is learned. There is no such step where it is
    given, and none beside factors of one's own, which may be what is wrong.
    """
    m, odometry, poses = fit.problem.measurements, fit.problem.odometry, fit.state.poses
    if not m.learned[0] or not len(m.marker_row) or len(m.frame) < 2:
        return None
    e, *_ = odometry_error(odometry, poses, fit.state.c[WHEELS])
    C = odometry.covariance(fit.problem.noise.slip)
    squared = np.einsum("ni,nij,nj->n", e, np.linalg.inv(C), e)
    k = int(squared.argmax())
    return m.jumps.joined_by(
        m.frame[k], m.frame[k + 1], se2.between(poses[k], poses[k + 1]), odometry.increment[k],
        len(m.dataset.ticks)) if squared[k] > GATE else None


def visits(aruco):
    """Number (m,) of the visit of every one of ArucoReadings, from 0, by id, then by time."""
    order = np.lexsort((aruco.pose, aruco.marker))
    marker, number = aruco.marker[order], np.arange(len(order))
    if (marker[1:] == marker[:-1]).any():
        _, number = runs(marker, aruco.pose[order], VISIT_GAP)
    return number[np.argsort(order)]


def contradicted(fit, factor):
    """Which sightings (s,), bool, a Fit rejects at this noise factor."""
    problem = replace(fit.problem, noise=fit.problem.noise._replace(sightings=factor))
    return accepted_measurements(problem, fit.state).sightings.weight == 0


def has_rejected_visits(fit):
    """Whether a Fit rejects most sightings of any visit.

    A marker that was moved looks like errors with memory, and the factor learned would hide it.
    """
    m, factor = fit.problem.measurements, fit.problem.noise.sightings
    if not len(m.marker_row):
        return False
    factor = factor if (fit.problem.accepted.share == 1).all() else min(factor, 1.0)
    number = visits(m.dataset.aruco)[m.sightings.index]
    count, lost = np.bincount(number), np.bincount(number, contradicted(fit, factor))
    return bool(((count >= MIN_VISIT) & (lost > MAX_REJECTED_SHARE * count)).any())


def spares_sightings(fit, other):
    """Whether a Fit rejects less than MAX_STILL_REJECTED of the sightings that another rejects."""
    factor = min(each.problem.noise.sightings for each in (fit, other))
    count, most = (contradicted(each, factor).sum() for each in (fit, other))
    return bool(count < MAX_STILL_REJECTED * most)


def places_of_ids(aruco, solve):
    """`SlamResult.places` of ArucoReadings, None if each id is one place; `solve` as above.

    The second place of id 12 gets the number 112 where ids have up to two digits, then 212.
    """
    marker, number = aruco.marker, visits(aruco)
    try:
        result = slam_result(solve(places=np.stack([marker, number], axis=1)))
    except (DatasetError, np.linalg.LinAlgError):
        return None
    ids, digits = marker.copy(), 10**len(str(marker.max()))
    accepted = np.flatnonzero(~result.rejected)
    seen = result.sightings.marker[accepted]
    frame = result.sightings.frame[result.sightings.row[accepted]]
    for each in np.unique(marker):
        last = []                                 # of each place the last visit
        for visit in np.intersect1d(number[marker == each], result.marker):
            if np.count_nonzero(seen == visit) < MIN_VISIT:
                continue
            squared = [_squared_distance(result, other, visit, frame[seen == other][-1],
                                         frame[seen == visit][0]) for other in last]
            place = int(np.argmin(squared)) if min(squared, default=np.inf) < PLACE_GATE \
                else len(last)
            last[place:place + 1] = [visit]
            ids[number == visit] += place * digits
    return None if (ids == marker).all() else np.stack([marker, ids], axis=1)


def _squared_distance(result, first, second, pose, later):
    """Squared distance in sigmas of two visits, markers `first` and `second` of a SlamResult.

    The first one was last seen at `pose`, the second one first seen at the pose `later`. The path
    from a pose of covariance P_1 to one of P_2 adds A P_2 A^T - B P_1 B^T to the covariance of a
    place that A and B move with these poses.
    """
    first, second = result.marker_in_world[np.searchsorted(result.marker, [first, second])]
    poses, P = result.poses[[pose, later]], result.covariances[[pose, later]]
    A, _ = se2.compose_jacobians(poses, se2.between(poses, second))
    start, end = A @ P @ A.mT
    values, axes = np.linalg.eigh(end - start)
    off = axes.T @ se2.difference(second, first)
    return float(np.sum(off**2 / np.maximum(values, MIN_SIGMA**2)))
