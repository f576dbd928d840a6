"""Stage 7: the result of a fit: every encoder pose and landmark, with covariances.

Encoder poses between the frames are conditioned on both neighbouring frames (`interpolate`).
Antennas whose position the ranges do not determine are in doubt, and their covariances include it.
"""

from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from slamlib.core import increments, se2
from slamlib.core.graph import GUESS_PRIOR_SIGMA
from slamlib.core.preintegration import odometry_noise
from slamlib.robust.calibration import WHEELS, calibration_table
from slamlib.robust.covariances import posterior_moments
from slamlib.robust.factors import MIN_DISTANCE
from slamlib.robust.fit import Fit, error_memories, residuals
from slamlib.robust.initialization import (
    SAME_PLACE,
    other_antenna,
    ranges_by_antenna,
    second_moment,
    trilaterate,
)
from slamlib.robust.solution import GtsamSolution, graph_and_values

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
    doubts: dict                    # antenna id: reason, for antennas in doubt
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
    released = property(attrgetter("fit.problem.released"))      # groups that left what is stated
    explanations = property(attrgetter("fit.explanations"))      # sets of groups: each explains it
    noise = property(attrgetter("fit.problem.noise"))            # as given or learned
    slip = property(attrgetter("noise.slip"))                    # sqrt(m), of a wheel after 1 m
    model = property(attrgetter("fit.problem.odometry.model"))   # "arc" or "euler"
    share = property(attrgetter("fit.problem.accepted.share"))   # (s + r,) of memory, `Accepted`
    sightings = property(attrgetter("fit.problem.measurements.sightings"))      # s of the graph
    jumps = property(attrgetter("fit.problem.measurements.jumps"))     # odometry against markers
    converged = property(lambda self: self.gtsam.converged if self.gtsam else self.fit.converged)
    calibration_table = property(lambda self: calibration_table(           # list of p dicts
        self.calibration, self.c, self.c_covariance, self.released))
    wheel = property(lambda self: self.c[WHEELS])                # (3,) m: R_R, R_L, b
    wheel_covariance = property(lambda self: self.c_covariance[WHEELS, WHEELS])      # (3, 3) m^2

    def __repr__(self):
        sigma = 1e3 * np.sqrt(np.trace(self.covariances[:, :2, :2], axis1=1, axis2=2) / 2).mean()
        return (f"SlamResult of {len(self.poses)} poses, mean sigma {sigma:.2g} mm per axis\n"
                f"  {len(self.marker)} markers, {self.rejected.sum()} of {len(self.rejected)} "
                f"sightings rejected\n  {len(self.antenna)} antennas, {len(self.doubts)} in doubt, "
                f"{len(self.range_weight)} ranges\n  steps: {self.model}, slip {self.slip:.2g} "
                f"sqrt(m), noise factors {self.noise.sightings:.2g} and {self.noise.ranges:.2g}\n"
                f"  released from vehicle.toml: {', '.join(sorted(self.released)) or 'nothing'}")

    def graph(self):
        """The gtsam.NonlinearFactorGraph that was decided, and gtsam.Values at its solution.

        For factors of one's own, and GTSAM's own tools; `core.graph` has the keys. Nothing is
        averaged over the noise. `core.graph_solution.solve_graph` solves it.
        """
        return graph_and_values(self.fit.problem, self.fit.state)

    @property
    def unconfirmed(self):
        """Ids of markers with one accepted sighting, or at the place of a marker seen more often.

        Wrong labels make the latter. Antennas like them are in doubt.
        """
        marker, count = np.unique(self.sightings.marker[~self.rejected], return_counts=True)
        count, place = count[np.isin(marker, self.marker)], self.marker_in_world[:, :2]
        distance = np.hypot(*(place[:, None] - place).transpose(2, 0, 1))
        other = (distance < SAME_MARKER) & (count > count[:, None])
        return self.marker[(count == 1) | other.any(axis=1)]


def slam_result(fit, by_gtsam=None):
    """The SlamResult of a Fit, with the GtsamSolution of its graph or, without one, the engine's.

    Cross-covariances of neighbouring frames, by which encoder poses between them follow, are the
    engine's. Raises LinAlgError as `marginal_covariances`.
    """
    problem, m = fit.problem, fit.problem.measurements
    state, marginal, slip = posterior_moments(fit)
    agreement, landmarks, c_covariance = (0.0, 0.0), marginal.landmarks, marginal.c
    if by_gtsam is not None:
        agreement = agreement_of(by_gtsam, state, marginal)
        state, landmarks, c_covariance = by_gtsam.state, by_gtsam.landmarks, by_gtsam.c
    poses, pose_covariances = interpolate(
        replace(problem, noise=problem.noise._replace(slip=slip)), state, marginal.pairs)
    if by_gtsam is not None:
        pose_covariances[m.frame] = se2.rotate_covariance(
            by_gtsam.frames, state.poses[:, 2])
    range_residual, rejected = residuals(problem, state)[1], problem.accepted.sightings.weight == 0
    range_weight = problem.accepted.ranges.kept(range_residual)
    markers, antennas = np.split(landmarks.copy(), [len(m.marker)])
    best = np.full(len(m.marker), np.inf)         # a point has the heading of its best sighting
    np.minimum.at(best, m.marker_row, m.sightings.C[:, 2, 2])
    markers[~m.oriented, 2, 2] = best[~m.oriented]
    balance = np.bincount(m.marker_row, np.where(rejected, -1, 1), len(m.marker))
    mapped = balance > 0                          # markers with more accepted than rejected ones
    place = np.c_[state.markers[mapped, :2], se2.wrap(state.markers[mapped, 2])]
    sentences, antenna_covariances = antenna_doubts(
        problem, state, pose_covariances[m.frame], antennas[:, :2, :2], range_weight)
    return SlamResult(
        poses=poses, covariances=pose_covariances,
        marker=m.marker[mapped], marker_in_world=place,
        marker_covariance=se2.rotate_covariance(markers[mapped], place[:, 2]),
        antenna=m.antenna, antenna_in_world=state.antennas,
        antenna_covariance=antenna_covariances, doubts=sentences,
        c=state.c, c_covariance=c_covariance, noise_sigma=np.zeros(3) if fit.posterior is None
        else np.sqrt(np.diag(fit.posterior.covariance)),
        rejected=rejected, range_weight=range_weight, range_residual=range_residual,
        correlation=tuple(each.correlation for each in error_memories(problem, state)),
        gtsam=by_gtsam, agreement=agreement,
        turn_sigma=turn_sigma(problem), fit=fit)


def agreement_of(by_gtsam, state, marginal):
    """Largest difference of GTSAM's poses and markers from the engine's, in its sigmas.

    Also the largest relative difference of their sigmas. From the engine's mean State and
    Covariances.
    """
    found = np.concatenate([by_gtsam.state.poses, by_gtsam.state.markers])
    engine = np.concatenate([state.poses, state.markers])
    frames = np.concatenate([marginal.pairs[:1, :3, :3], marginal.pairs[:, 3:6, 3:6]])
    landmarks = marginal.landmarks[:len(state.markers)]
    of_engine = np.concatenate([frames, landmarks])
    of_gtsam = np.concatenate([by_gtsam.frames, by_gtsam.landmarks[:len(state.markers)]])
    in_both = np.diagonal(of_gtsam, axis1=1, axis2=2) > 0
    sigma = se2.sigmas(np.where(in_both[:, :, None], of_engine, 1.0))
    off = np.abs(se2.difference(se2.between(engine, found), np.zeros(3))) / sigma
    ratio = np.abs(se2.sigmas(np.where(in_both[:, :, None], of_gtsam, 1.0)) / sigma - 1)
    return float(off[in_both].max(initial=0.0)), float(ratio[in_both].max(initial=0.0))


def turn_sigma(problem):
    """Standard deviations (f-1,), rad, of the turns between frames by odometry of stated wheels."""
    m, odometry = problem.measurements, problem.odometry
    known = ~m.jumps.share(m.frame[:-1], m.frame[1:]).any(axis=1)        # else by markers
    variance = np.sum((odometry.J_wheel[:, 2] * m.dataset.vehicle.sigma_wheel)**2, axis=1)
    return known * np.sqrt(variance + odometry.covariance(problem.noise.slip)[:, 2, 2])


def antenna_doubts(problem, state, frame_covariances, covariances, range_weight):
    """Reasons to doubt antennas, and covariances that include the doubt, at a Problem's solution.

    From covariances (f, 3, 3) of the frames and (a, 2, 2) of the antennas, in world axes, and the
    share `range_weight` (r,) of its information that each range keeps. Reasons are a dict by id; in
    doubt the second moment of the position is added to a covariance.
    """
    m, sentences, covariances = problem.measurements, {}, covariances.copy()
    by_antenna = ranges_by_antenna(
        m, state.poses, frame_covariances, state.c, problem.noise.ranges)
    for k, (place, ranges) in enumerate(zip(state.antennas, by_antenna)):
        found = trilaterate(ranges)
        sentence = _doubt(ranges, place, range_weight[m.ranges.antenna == k], *found[:2])
        if sentence is not None:
            sentences[int(m.antenna[k])] = sentence
            covariances[k] += second_moment(*found, place)
    return sentences, covariances


def _doubt(ranges, estimate, weight, places, costs):
    """The reason why an antenna is in doubt whose ranges have the weights (m,), or None.

    It may be at `places` (p, 2) of `costs` (p,).
    """
    distance = np.median(ranges.distance)
    count, total = np.count_nonzero(weight > 0.5), len(ranges.distance)
    if count < MIN_ACCEPTED_RANGES:
        return f"only {count} of its {total} ranges agree"
    elsewhere = np.linalg.norm(places - estimate, axis=1) > SAME_PLACE * distance
    possible = [f"({x:.1f}, {y:.1f})" for x, y in places[elsewhere & (costs < MAX_LOG_ODDS)]]
    if possible:
        listed = " and ".join(dict.fromkeys(possible))
        return f"its ranges fit as well at {listed}, which its covariance includes"
    other = other_antenna(ranges, estimate, weight)
    if other is not None:
        return other
    if count < total / 2:
        return f"{total - count} of its {total} ranges disagree"
    if worst_sigma(ranges, estimate, weight) > MAX_RELATIVE_SIGMA * distance:
        return "its ranges are too few or come from too few directions"
    return None


def worst_sigma(ranges, estimate, weight):
    """Standard deviation in m of an antenna in the worst direction, by its ranges alone.

    Its covariance in the world also includes the uncertain heading of pose 1.
    """
    difference = estimate - ranges.positions
    direction = difference / np.maximum(np.linalg.norm(difference, axis=1), MIN_DISTANCE)[:, None]
    weighted = direction * (weight / ranges.sigma**2)[:, None]
    information = np.linalg.eigvalsh(direction.T @ weighted)[0]
    return 1 / np.sqrt(max(information, GUESS_PRIOR_SIGMA**-2))


def interpolate(problem, state, pairs):
    """Every encoder pose (n, 3) and its covariance (n, 3, 3) in world axes, given the frames.

    A pose k between the frames a and b depends only on them and on the wheels w. X_a Delta_ak(w)
    and X_b Delta_kb(w)^-1 are two estimates of it, with independent noise of the encoder steps
    before and after it. Their average by information is the conditional mean, exact to first order.

    `pairs` (f-1, 9, 9) as in `Covariances`, at the State that solves the Problem.
    """
    m, poses, frame = problem.measurements, state.poses, problem.measurements.frame
    if not len(pairs):                                       # pose 1 alone: the world's origin
        return poses.copy(), np.diag(m.origin_sigma)[None]**2
    turned, R = np.tile(np.eye(9), (len(pairs), 1, 1)), se2.rotation(poses[:, 2])
    turned[:, :2, :2], turned[:, 3:5, 3:5] = R[:-1], R[1:]
    joint = turned @ pairs @ turned.mT                       # the poses in world axes
    pose = np.arange(len(m.dataset.ticks))
    last, inner = np.searchsorted(frame, pose, side="right") - 1, np.setdiff1d(pose, frame)
    all_poses = poses[last]
    covariances = np.concatenate([joint[:, :3, :3], joint[-1:, 3:6, 3:6]])[last]
    a, b = last[inner], last[inner] + 1
    vehicle, ticks = m.dataset.vehicle.with_wheel(state.c[WHEELS]), m.dataset.ticks
    ends = np.r_[frame[a], inner], np.r_[inner, frame[b]]
    quantization, slipping = odometry_noise(ticks, vehicle, *ends)
    (delta_a, delta_b), (a_by_wheel, b_by_wheel), (Q_a, Q_b), (jump_a, jump_b) = (
        np.split(each, 2) for each in (
            *increments.between_poses(ticks, vehicle, *ends, problem.odometry.model),
            quantization + problem.noise.slip**2 * slipping,
            m.jumps.share(*ends).sum(axis=1)[:, None, None]))
    back = se2.inverse(delta_b)
    A_a, B_a = se2.compose_jacobians(poses[a], delta_a)
    A_b, B_b = se2.compose_jacobians(poses[b], back)
    B_b = B_b @ se2.between_jacobians(delta_b, np.zeros(3))[0]       # of the inverse

    from_a, from_b = se2.compose(poses[a], delta_a), se2.compose(poses[b], back)
    difference = se2.difference(from_b, from_a)
    jump = difference[:, :, None] * difference[:, None] / np.maximum(jump_a + jump_b, MIN_SHARE)
    N_a, N_b = B_a @ Q_a @ B_a.mT + jump_a * jump, B_b @ Q_b @ B_b.mT + jump_b * jump
    gain_b = N_a @ np.linalg.inv(N_a + N_b)
    gain_a = np.eye(3) - gain_b
    F = np.concatenate([gain_a @ A_a, gain_b @ A_b,
                        gain_a @ B_a @ a_by_wheel + gain_b @ B_b @ b_by_wheel], axis=2)
    all_poses[inner] = from_a + np.einsum("nij,nj->ni", gain_b, difference)
    covariances[inner] = F @ joint[a] @ F.mT + gain_a @ N_a
    return all_poses, (covariances + covariances.mT) / 2
