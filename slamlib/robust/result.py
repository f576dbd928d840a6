"""Stage 7: the result of a fit: every encoder pose and landmark, with covariances.

Encoder poses between the frames are conditioned on both neighbouring frames (`interpolate`).
Antennas whose position the ranges do not determine are in doubt, and their covariances include it.
"""

from dataclasses import dataclass
from operator import attrgetter

import gtsam
import numpy as np

from slamlib.core import increments, se2
from slamlib.core.graph import GUESS_PRIOR_SIGMA
from slamlib.core.increments import odometry_noise
from slamlib.robust.calibration import WHEELS, calibration_table
from slamlib.robust.factors import inverse_adjoint
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
from slamlib.robust.solution import (
    GtsamSolution,
    graph_of,
    places_of,
    solve_by_gtsam,
    values_of,
)

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
    fit: Fit                        # what was decided, and by which solution
    gtsam: GtsamSolution            # what is handed in
    disagreement: float             # largest difference of both, sigmas
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
        return self.gtsam.converged

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

        For factors of one's own, and GTSAM's own tools; `core.graph` has the keys.
        `core.graph_solution.solve_graph` solves it.
        """
        graph = graph_of(self.fit.problem)
        return graph, values_of(self.fit.problem, self.gtsam.state, graph)

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


def slam_result(fit: Fit) -> SlamResult:
    """The SlamResult of a Fit, by GTSAM's solution of its graph.

    Raises DatasetError where the measurements do not determine every variable.
    """
    problem = fit.problem
    m = problem.measurements
    solution = solve_by_gtsam(fit)
    state = solution.state
    poses, covariances = interpolate(problem, solution)

    rejected = problem.accepted.sightings.weight == 0
    mapped = _mostly_accepted(m, rejected)
    markers = state.markers[mapped]
    markers[:, 2] = se2.wrap(markers[:, 2])
    of_markers, of_antennas = np.split(solution.landmarks, [len(m.marker)])
    of_markers = _with_sighted_headings(m, of_markers)[mapped]

    range_residual = residuals(problem, state)[1]
    range_weight = problem.accepted.ranges.kept(range_residual)
    doubts, of_antennas = antenna_doubts(
        problem, state, covariances[m.frame], of_antennas[:, :2, :2], range_weight)

    noise_sigma = np.zeros(3)
    if fit.posterior is not None:
        noise_sigma = np.sqrt(np.diag(fit.posterior.covariance))
    memories = error_memories(problem, state, problem.accepted)
    return SlamResult(
        poses=poses, covariances=covariances,
        marker=m.marker[mapped], marker_in_world=markers,
        marker_covariance=se2.rotate_covariance(of_markers, markers[:, 2]),
        antenna=m.antenna, antenna_in_world=state.antennas, antenna_covariance=of_antennas,
        doubts=doubts, c=state.c, c_covariance=solution.c, noise_sigma=noise_sigma,
        rejected=rejected, range_weight=range_weight, range_residual=range_residual,
        correlation=tuple(memory.correlation for memory in memories),
        fit=fit, gtsam=solution, disagreement=_difference_from(fit, solution))


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


def _difference_from(fit, solution):
    """Largest difference of a GtsamSolution from the solution of a Fit, in its own sigmas.

    Antennas with few ranges, which hardly determine them, are left out.
    """
    antenna_count = np.bincount(fit.problem.measurements.ranges.antenna)
    blocks = np.concatenate([solution.frames, solution.landmarks])
    variances = np.diagonal(blocks, axis1=1, axis2=2)
    known = variances > 0
    known[len(known) - len(antenna_count):][antenna_count < MIN_ACCEPTED_RANGES] = False
    difference = se2.between(places_of(fit.state), places_of(solution.state))
    difference[:, 2] = se2.wrap(difference[:, 2])
    off = np.abs(difference[known]) / np.sqrt(variances[known])
    return float(off.max(initial=0.0))


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


def interpolate(problem: Problem, solution: GtsamSolution) -> tuple[np.ndarray, np.ndarray]:
    """Every encoder pose (n, 3) and its covariance (n, 3, 3) in world axes, given the frames.

    A pose k between the frames a and b depends only on them and on the wheels w. X_a Delta_ak(w)
    and X_b Delta_kb(w)^-1 are two estimates of it, with independent noise of the encoder steps
    before and after it. Their average by information is the conditional mean, exact to first order.
    Its covariance is that of X_a and of the motion from there to X_b, whose errors are far smaller
    where a and b err alike. That the wheels correlate with both is neglected: they hardly matter
    between two poses that are known.
    """
    m = problem.measurements
    state = solution.state
    frames = solution.frames
    to_world = np.tile(np.eye(3), (len(frames), 1, 1))
    to_world[:, :2, :2] = se2.rotation(state.poses[:, 2])
    own, both = np.split(solution.pairs[:, :3], 2, axis=2)
    adjoint = inverse_adjoint(se2.between(state.poses[:-1], state.poses[1:]))
    with_motion = both - own @ adjoint.mT                # of X_a and of X_a^-1 X_b
    of_motion = solution.pairs[:, 3:, 3:] - adjoint @ both - with_motion.mT @ adjoint.mT
    wheels = solution.c[WHEELS, WHEELS]
    pose = np.arange(len(m.dataset.ticks))
    last = np.searchsorted(m.frame, pose, side="right") - 1      # frame at each pose or before it
    poses = state.poses[last]
    covariances = (to_world @ frames @ to_world.mT)[last]

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
    poses[inner] = before.pose + np.einsum("nij,nj->ni", gain_b, difference)
    since_a = se2.between(state.poses[a], poses[inner])
    by_a = se2.compose_jacobians(state.poses[a], since_a)[0] @ to_world[a]
    by_motion = gain_b @ after.by_frame @ to_world[a + 1]
    by_wheel = gain_a @ before.by_wheel + gain_b @ after.by_wheel
    of_frame = by_a @ own[a] @ by_a.mT
    between = by_a @ with_motion[a] @ by_motion.mT
    of_frames = of_frame + between + between.mT + by_motion @ of_motion[a] @ by_motion.mT
    of_wheels = by_wheel @ wheels @ by_wheel.mT
    covariances[inner] = of_frames + of_wheels + gain_a @ N_a
    return poses, (covariances + covariances.mT) / 2
