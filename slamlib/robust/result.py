"""Stage 7: the result of a fit: every encoder pose and landmark, with covariances.

Encoder poses between the frames are conditioned on both neighbouring frames (`interpolate`).
Antennas whose position the ranges do not determine are in doubt, and their covariances include it.
"""

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import gtsam
import numpy as np

from slamlib.core import increments, se2
from slamlib.core.graph import GUESS_PRIOR_SIGMA
from slamlib.core.increments import odometry_noise
from slamlib.robust.calibration import WHEELS, calibration_table
from slamlib.robust.covariances import posterior_moments
from slamlib.robust.fit import Fit, error_memories, residuals
from slamlib.robust.initialization import (
    SAME_PLACE,
    AntennaRanges,
    other_antenna,
    ranges_by_antenna,
    second_moment,
    trilaterate,
)
from slamlib.robust.linear import Problem, State
from slamlib.robust.solution import GtsamSolution, graph_of, places_of, solved_noise, values_of

MIN_ACCEPTED_RANGES = 5      # number of accepted ranges of an antenna that is not in doubt
SAME_MARKER = 0.05           # m, distance of two markers that must be one
MAX_RELATIVE_SIGMA = 0.025   # of the median range: largest sigma of an antenna not in doubt
MAX_LOG_ODDS = np.log(1000)  # log odds below which another position remains possible
MIN_SHARE = 1e-9             # of a jump, below which there is none between two frames


@dataclass(frozen=True, repr=False)
class SlamResult:
    """The estimate of a drive: lengths in m, angles in rad, covariances in world axes."""

    poses: np.ndarray               # (n, 3), headings continuous
    covariances: np.ndarray         # (n, 3, 3)
    marker: np.ndarray              # (k,) ids, ascending, of markers whose sightings are accepted
    marker_in_world: np.ndarray     # (k, 3)
    marker_covariance: np.ndarray   # (k, 3, 3)
    antenna: np.ndarray             # (a,) ids, ascending, of antennas with ranges
    antenna_in_world: np.ndarray    # (a, 2)
    antenna_covariance: np.ndarray  # (a, 2, 2)
    doubts: dict[int, str]          # antenna id: reason, for antennas in doubt
    c: np.ndarray                   # (p,) estimates of the entries of `calibration`
    c_covariance: np.ndarray        # (p, p), 0 where the stated value is known
    noise_sigma: np.ndarray         # (3,) of the logarithms of `noise`, 0 where not learned
    rejected: np.ndarray            # (s,) bool, beyond the gate, rows of Measurements.sightings
    range_weight: np.ndarray        # (r,) share of its information that each range keeps, 0 to 1
    range_residual: np.ndarray      # (r,) whitened, positive for a range that is too long
    correlation: tuple              # of neighbours' residuals of a marker, and of an antenna
    turn_sigma: np.ndarray          # (f-1,) rad, of odometry's turns between frames, stated wheels
    fit: Fit                        # what was decided, and by which solution
    gtsam: GtsamSolution | None     # what is handed in; None while the engine decides
    agreement: tuple[float, float]  # of both: largest difference, sigmas; relative of sigmas
    places: np.ndarray | None = None     # (m, 2) ids of ArucoReadings, and those in the map

    # Parts of the fit
    calibration = property(attrgetter("fit.problem.measurements.calibration"))   # p stated entries
    released = property(attrgetter("fit.problem.prior.groups"))  # groups that left what is stated
    explanations = property(attrgetter("fit.explanations"))      # sets of groups: each explains it
    noise = property(attrgetter("fit.problem.noise"))            # as given or learned
    slip = property(attrgetter("noise.slip"))                    # sqrt(m), of a wheel after 1 m
    model = property(attrgetter("fit.problem.odometry.model"))   # "arc" or "euler"
    share = property(attrgetter("fit.problem.accepted.share"))   # (s + r,) of memory, `Accepted`
    sightings = property(attrgetter("fit.problem.measurements.sightings"))      # s of the graph
    jumps = property(attrgetter("fit.problem.measurements.jumps"))     # odometry against markers
    wheel = property(lambda self: self.c[WHEELS])                # (3,) m: R_R, R_L, b
    wheel_covariance = property(lambda self: self.c_covariance[WHEELS, WHEELS])      # (3, 3) m^2

    @property
    def converged(self) -> bool:
        """Whether the error had stopped to fall where the last iterations ended."""
        return (self.gtsam or self.fit).converged

    @property
    def calibration_table(self) -> list[dict]:
        """The dicts (p) of `calibration.calibration_table`."""
        return calibration_table(self.calibration, self.c, self.c_covariance, self.released)

    def __repr__(self):
        variance = np.trace(self.covariances[:, :2, :2], axis1=1, axis2=2) / 2
        sigma = 1e3 * np.sqrt(variance).mean()
        released = ", ".join(sorted(self.released)) or "nothing"
        return (f"SlamResult of {len(self.poses)} poses, mean sigma {sigma:.2g} mm per axis\n"
                f"  {len(self.marker)} markers, {self.rejected.sum()} of {len(self.rejected)} "
                f"sightings rejected\n  {len(self.antenna)} antennas, {len(self.doubts)} in doubt, "
                f"{len(self.range_weight)} ranges\n  steps: {self.model}, slip {self.slip:.2g} "
                f"sqrt(m), noise factors {self.noise.sightings:.2g} and {self.noise.ranges:.2g}\n"
                f"  released from vehicle.toml: {released}")

    def graph(self) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """The gtsam.NonlinearFactorGraph that was decided, and gtsam.Values at its solution.

        For factors of one's own, and GTSAM's own tools; `core.graph` has the keys. Nothing is
        averaged over the noise. `core.graph_solution.solve_graph` solves it.
        """
        graph = graph_of(self.fit.problem, solved_noise(self.fit))
        mode = self.fit.state if self.gtsam is None else self.gtsam.mode
        return graph, values_of(self.fit.problem, mode, graph)

    @property
    def unconfirmed(self) -> np.ndarray:
        """Ids of markers with one accepted sighting, or at the place of a marker seen more often.

        Wrong labels make the latter. Antennas like them are in doubt.
        """
        marker, count = np.unique(self.sightings.marker[~self.rejected], return_counts=True)
        count = count[np.isin(marker, self.marker)]
        place = self.marker_in_world[:, :2]
        distance = np.linalg.norm(place[:, None] - place, axis=2)
        doubled = (distance < SAME_MARKER) & (count > count[:, None])
        return self.marker[(count == 1) | doubled.any(axis=1)]


class _Engine(NamedTuple):
    """The engine's solution, with the fields of a GtsamSolution that a result needs."""

    state: State
    frames: np.ndarray           # (f, 3, 3)
    landmarks: np.ndarray        # (k + a, 3, 3)
    c: np.ndarray                # (p, p)


def slam_result(fit: Fit, by_gtsam: GtsamSolution | None = None) -> SlamResult:
    """The SlamResult of a Fit, with the GtsamSolution of its graph or, without one, the engine's.

    Cross-covariances of neighbouring frames, by which encoder poses between them follow, are the
    engine's. Raises LinAlgError as `marginal_covariances`.
    """
    problem = fit.problem
    m = problem.measurements
    state, marginal, slip = posterior_moments(fit)
    engine = _Engine(state, _of_frames(marginal.pairs, m), marginal.landmarks, marginal.c)
    solution = by_gtsam or engine
    state = solution.state
    averaged = replace(problem, noise=problem.noise._replace(slip=slip))
    poses, covariances = interpolate(averaged, state, marginal.pairs)
    covariances[m.frame] = se2.rotate_covariance(solution.frames, state.poses[:, 2])

    rejected = problem.accepted.sightings.weight == 0
    mapped = _mostly_accepted(m, rejected)
    markers = state.markers[mapped]
    markers[:, 2] = se2.wrap(markers[:, 2])
    of_markers, of_antennas = np.split(solution.landmarks, [len(m.marker)])
    of_markers = _with_sighted_headings(m, of_markers)[mapped]

    _, range_residual = residuals(problem, state)
    range_weight = problem.accepted.ranges.kept(range_residual)
    doubts, of_antennas = antenna_doubts(
        problem, state, covariances[m.frame], of_antennas[:, :2, :2], range_weight)

    noise_sigma = np.zeros(3)
    if fit.posterior is not None:
        noise_sigma = np.sqrt(np.diag(fit.posterior.covariance))
    memories = error_memories(problem, state)
    few_ranges = np.bincount(m.ranges.antenna) < MIN_ACCEPTED_RANGES
    return SlamResult(
        poses=poses, covariances=covariances,
        marker=m.marker[mapped], marker_in_world=markers,
        marker_covariance=se2.rotate_covariance(of_markers, markers[:, 2]),
        antenna=m.antenna, antenna_in_world=state.antennas, antenna_covariance=of_antennas,
        doubts=doubts, c=state.c, c_covariance=solution.c, noise_sigma=noise_sigma,
        rejected=rejected, range_weight=range_weight, range_residual=range_residual,
        correlation=tuple(memory.correlation for memory in memories),
        turn_sigma=turn_sigma(problem), fit=fit, gtsam=by_gtsam,
        agreement=_agreement(solution, engine, few_ranges))


def _mostly_accepted(measurements, rejected):
    """True (k,) for markers with more accepted than `rejected` (s,) sightings."""
    vote = np.where(rejected, -1, 1)
    return np.bincount(measurements.marker_row, vote, len(measurements.marker)) > 0


def _with_sighted_headings(measurements, covariances):
    """Covariances (k, 3, 3) of markers in which points have the heading of their best sighting."""
    m = measurements
    best = np.full(len(m.marker), np.inf)
    np.minimum.at(best, m.marker_row, m.sightings.C[:, 2, 2])
    covariances = covariances.copy()
    covariances[~m.oriented, 2, 2] = best[~m.oriented]
    return covariances


def _of_frames(pairs, measurements):
    """Covariances (f, 3, 3) of the frames by those of pairs (f-1, 9, 9); of one alone its prior."""
    if not len(pairs):
        return np.diag(measurements.origin_sigma**2)[None]
    return np.concatenate([pairs[:, :3, :3], pairs[-1:, 3:6, 3:6]])


def _agreement(solution, engine, few_ranges):
    """Largest difference of poses and landmarks of a solution from the engine's, in its sigmas.

    Also the largest relative difference of their sigmas. Antennas with `few_ranges` (a,) are left
    out: these hardly determine them.
    """
    variances = _variances(solution)
    in_both = variances > 0
    of_antennas = in_both[len(in_both) - len(few_ranges):]
    of_antennas[few_ranges] = False
    sigma = np.sqrt(_variances(engine)[in_both])
    difference = se2.between(places_of(engine.state), places_of(solution.state))
    difference[:, 2] = se2.wrap(difference[:, 2])
    off = np.abs(difference[in_both]) / sigma
    ratio = np.abs(np.sqrt(variances[in_both]) / sigma - 1)
    return float(off.max(initial=0.0)), float(ratio.max(initial=0.0))


def _variances(solution):
    """Variances (f + k + a, 3) of a solution, of poses and markers in their own axes."""
    blocks = np.concatenate([solution.frames, solution.landmarks])
    return np.diagonal(blocks, axis1=1, axis2=2)


def turn_sigma(problem: Problem) -> np.ndarray:
    """Standard deviations (f-1,), rad, of the turns between frames by odometry of stated wheels."""
    m = problem.measurements
    odometry = problem.odometry
    by_wheels = odometry.J_wheel[:, 2] * m.dataset.vehicle.sigma_wheel
    of_wheels = np.sum(by_wheels**2, axis=1)
    of_slip = odometry.covariance(problem.noise.slip)[:, 2, 2]
    by_markers = m.jumps.share(m.frame[:-1], m.frame[1:]).any(axis=1)
    return np.where(by_markers, 0.0, np.sqrt(of_wheels + of_slip))


def antenna_doubts(problem: Problem, state: State, frame_covariances: np.ndarray,
                   covariances: np.ndarray,
                   range_weight: np.ndarray) -> tuple[dict[int, str], np.ndarray]:
    """Reasons to doubt antennas, and covariances that include the doubt, at a Problem's solution.

    From covariances (f, 3, 3) of the frames and (a, 2, 2) of the antennas, in world axes, and the
    share `range_weight` (r,) of its information that each range keeps. Reasons are a dict by id; in
    doubt the second moment of the position is added to a covariance.
    """
    m = problem.measurements
    by_antenna = ranges_by_antenna(
        m, state.poses, frame_covariances, state.c, problem.noise.ranges)
    reasons = {}
    covariances = covariances.copy()
    for k, ranges in enumerate(by_antenna):
        place = state.antennas[k]
        found = trilaterate(ranges)
        weight = range_weight[m.ranges.antenna == k]
        reason = _doubt(ranges, place, weight, found.places, found.costs)
        if reason is not None:
            reasons[int(m.antenna[k])] = reason
            covariances[k] += second_moment(*found, place)
    return reasons, covariances


def _doubt(ranges, estimate, weight, places, costs):
    """The reason why an antenna is in doubt whose ranges have the weights (m,), or None.

    It may be at `places` (p, 2) of `costs` (p,).
    """
    distance = np.median(ranges.distance)
    total = len(ranges.distance)
    count = np.count_nonzero(weight > 0.5)
    if count < MIN_ACCEPTED_RANGES:
        return f"only {count} of its {total} ranges agree"
    elsewhere = np.linalg.norm(places - estimate, axis=1) > SAME_PLACE * distance
    possible = places[elsewhere & (costs < MAX_LOG_ODDS)]
    if len(possible):
        named = dict.fromkeys(f"({x:.1f}, {y:.1f})" for x, y in possible)
        return f"its ranges fit as well at {' and '.join(named)}, which its covariance includes"
    other = other_antenna(ranges, estimate, weight)
    if other is not None:
        return other
    if count < total / 2:
        return f"{total - count} of its {total} ranges disagree"
    if worst_sigma(ranges, estimate, weight) > MAX_RELATIVE_SIGMA * distance:
        return "its ranges are too few or come from too few directions"
    return None


def worst_sigma(ranges: AntennaRanges, estimate: np.ndarray, weight: np.ndarray) -> float:
    """Standard deviation in m of an antenna in the worst direction, by its ranges alone.

    Its covariance in the world also includes the uncertain heading of pose 1.
    """
    direction = ranges.directions(estimate)
    weighted = direction * (weight / ranges.sigma**2)[:, None]
    information = np.linalg.eigvalsh(direction.T @ weighted)[0]
    return 1 / np.sqrt(max(information, GUESS_PRIOR_SIGMA**-2))


@dataclass(frozen=True)
class _Side:
    """Estimates of m encoder poses from the frames before them, or from those after them."""

    pose: np.ndarray         # (m, 3)
    by_frame: np.ndarray     # (m, 3, 3) derivative by the pose of the frame
    by_wheel: np.ndarray     # (m, 3, 3) by the wheel parameters
    noise: np.ndarray        # (m, 3, 3) covariance by the encoder steps between both
    jump: np.ndarray         # (m, 1, 1) share of a jump in these steps


def _from_frame(problem, state, row, pose, is_after):
    """The estimates of encoder poses (m,) by odometry from the frames in rows (m,) of a State.

    All frames are before the poses, or all after them.
    """
    m = problem.measurements
    ticks = m.dataset.ticks
    vehicle = m.dataset.vehicle.with_wheel(state.c[WHEELS])
    X = state.poses[row]
    frame = m.frame[row]
    start, end = (pose, frame) if is_after else (frame, pose)
    motion, motion_by_wheel = increments.between_poses(
        ticks, vehicle, frame, pose, problem.odometry.model)
    at_pose, by_frame, by_motion = se2.compose_with_jacobians(X, motion)
    rounding, slipping = odometry_noise(ticks, vehicle, start, end)
    Q = rounding + problem.noise.slip**2 * slipping          # in the axes of `start`
    by_increment = by_motion
    if is_after:
        increment = se2.inverse(motion)
        by_increment = by_motion @ se2.between_jacobians(increment, np.zeros(3))[0]
    return _Side(
        pose=at_pose, by_frame=by_frame, by_wheel=by_motion @ motion_by_wheel,
        noise=by_increment @ Q @ by_increment.mT,
        jump=m.jumps.share(start, end).sum(axis=1)[:, None, None])


def interpolate(problem: Problem, state: State,
                pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Every encoder pose (n, 3) and its covariance (n, 3, 3) in world axes, given the frames.

    A pose k between the frames a and b depends only on them and on the wheels w. X_a Delta_ak(w)
    and X_b Delta_kb(w)^-1 are two estimates of it, with independent noise of the encoder steps
    before and after it. Their average by information is the conditional mean, exact to first order.

    `pairs` (f-1, 9, 9) as in `Covariances`, at the State that solves the Problem.
    """
    m = problem.measurements
    joint = _pairs_in_world(pairs, state.poses[:, 2])
    pose = np.arange(len(m.dataset.ticks))
    last = np.searchsorted(m.frame, pose, side="right") - 1      # frame at each pose or before it
    poses = state.poses[last]
    covariances = _of_frames(joint, m)[last]

    inner = np.setdiff1d(pose, m.frame)
    a = last[inner]
    before = _from_frame(problem, state, a, inner, is_after=False)
    after = _from_frame(problem, state, a + 1, inner, is_after=True)
    difference = se2.difference(after.pose, before.pose)
    squared = difference[:, :, None] * difference[:, None]
    jump = squared / np.maximum(before.jump + after.jump, MIN_SHARE)
    N_a = before.noise + before.jump * jump
    N_b = after.noise + after.jump * jump
    gain_b = N_a @ np.linalg.inv(N_a + N_b)
    gain_a = np.eye(3) - gain_b
    by_pair = np.concatenate([
        gain_a @ before.by_frame, gain_b @ after.by_frame,
        gain_a @ before.by_wheel + gain_b @ after.by_wheel], axis=2)
    poses[inner] = before.pose + np.einsum("nij,nj->ni", gain_b, difference)
    covariances[inner] = by_pair @ joint[a] @ by_pair.mT + gain_a @ N_a
    return poses, (covariances + covariances.mT) / 2


def _pairs_in_world(pairs, heading):
    """Covariances (f-1, 9, 9) of pairs of frames with headings (f,) and wheels, in world axes."""
    R = se2.rotation(heading)
    turn = np.tile(np.eye(9), (len(pairs), 1, 1))
    turn[:, :2, :2] = R[:-1]
    turn[:, 3:5, 3:5] = R[1:]
    return turn @ pairs @ turn.mT
