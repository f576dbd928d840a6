"""Problem 2, odometry and markers fused by a Kalman filter whose state contains the shared errors.

The state contains the pose X, the wheel parameters w = [R_R, R_L, b] and the markers M_j of the
last frame, in that frame, with covariance P (Smith, Self and Cheeseman, Estimating Uncertain
Spatial Relationships in Robotics, 1990). Odometry predicts

    X' = X Delta(w),    M'_j = Delta(w)^-1 M_j,    w' = w,    P' = F P F^T + L Q L^T,

with Delta(w) = Delta(w_0) + dDelta/dw (w - w_0), F and L the derivatives of the new state by the
old one and by Delta, and Q the noise of Delta (`increments.noise_in_drive`). The sightings Z_j of
the new frame, with covariances C_j, measure the markers M' = H state and update

    state <- state + K (Z - M'),    P <- (I - K H) P',    K = P' H^T S^-1,    S = H P' H^T + C,

with C block-diagonal. Sightings beyond GATE are rejected. Then the filter removes rejected markers
and those out of view, and adds new ones with covariance C_j. Without markers the result is the
first-order propagation of odometry; with uninformative odometry and one marker it is `localize`.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from slamlib import increments, se2
from slamlib.dataset import Dataset
from slamlib.increments import SLIP_BOUNDS, SLIP_FACTOR, TYPICAL_SLIP
from slamlib.marker_increments import common_sightings
from slamlib.memory import error_memory
from slamlib.odometry_gate import NO_JUMPS, Jumps, find_jumps
from slamlib.sightings import GATE, sightings_by_frame
from slamlib.textfile import require_type

SLIP_FRAMES = 500            # number of frames, the first ones, from which the slip is learned
WHEEL_FRAMES = 5000          # number of frames, the first ones, that give the wheel parameters w_0
MIN_JUMP_GAIN = 10.0         # log likelihood by each of many jumps; the loss by each of a few
MAX_SLIP_STEPS = 30          # number of parabolas
LOG_SLIP_TOLERANCE = 0.05    # of the natural logarithm of the slip


@dataclass(frozen=True)
class Fusion:
    """Poses and covariances by fusion, for every pose of the encoder file."""

    poses: np.ndarray            # (n, 3) in the world frame, m and rad
    covariances: np.ndarray      # (n, 3, 3) of [x, y, heading] in world axes
    rejected: int                # number of sightings not used; repeated ones are used once
    slip: float | None = None    # sqrt(m), given or learned
    wheel: np.ndarray | None = None             # (3,) m, R_R, R_L, b estimated at the last frame
    wheel_covariance: np.ndarray | None = None  # (3, 3) m^2


@dataclass(frozen=True)
class _FilterInput:
    """The data of the filter, the same for all values of slip."""

    dataset: object
    vehicle: object              # with the wheel parameters w_0 at which Delta is linearised
    pose: np.ndarray             # (f,) pose indices of the frames, pose 0 among them
    marker: np.ndarray           # (s,) ids of the markers of all sightings, frame by frame
    increment: np.ndarray        # (f-1, 3) Delta(w_0)
    J_w: np.ndarray              # (f-1, 3, 3) dDelta/dw
    rounding: np.ndarray         # (f-1, 3, 3) Q without slip
    slipping: np.ndarray         # (f-1, 3, 3) what a slip of 1 sqrt(m) adds to Q
    jumps: Jumps                 # where odometry contradicts the markers
    frames: list                 # of f tuples: z (m, 3) and C (m, 3, 3) of a frame's sightings, and
                                 # rows of common markers in the previous and in this frame


class _State(NamedTuple):        # three are made at a frame: faster than frozen dataclasses
    """The filter after a frame with m sightings; rejected markers are not in the state."""

    x: np.ndarray                # (6,) pose X and w - w_0
    M: np.ndarray                # (k, 3) markers in the frame
    P: np.ndarray                # (6 + 3k, 6 + 3k) covariance of x and M
    place: np.ndarray            # (m,) row in M of each sighting's marker, -1 if rejected
    log_likelihood: float = 0.0  # of the innovations so far, up to a constant
    rejected: int = 0            # number of sightings so far beyond the gate
    new: np.ndarray | None = None        # (u,) rows of the sightings that were compared with M
    v: np.ndarray | None = None  # (u, 3) their innovations


def fuse(dataset, slip=None):
    """Fusion of a Dataset's odometry and markers for problem 2, with correct shared errors.

    `slip` in sqrt(m) is the standard deviation of the slip of one wheel after 1 m; None takes that
    of the dataset's Vehicle or, if it has none, the maximum of the posterior density by the
    innovations and the prior of `increments`. A marker_noise_factor of the Vehicle multiplies the
    standard deviations of the sightings. Increments are exact arcs.

    >>> from slamlib.simulation import simulate
    >>> dataset, truth = simulate("short", seed=1)
    >>> fuse(dataset, slip=1e-3).poses.shape
    (2000, 3)
    """
    require_type(dataset, Dataset, "fuse")
    slip = dataset.vehicle.slip if slip is None else slip
    jumps = find_jumps(dataset)
    given = _filter_input(dataset, dataset.vehicle, jumps)
    if len(jumps.start):
        other = _filter_input(dataset, dataset.vehicle)
        gain, = np.diff([_filter(each, slip or TYPICAL_SLIP)[2].log_likelihood
                         for each in (other, given)])
        least = MIN_JUMP_GAIN * len(jumps.start)
        if gain < (-least if jumps.are_few else least):
            given, jumps = other, NO_JUMPS
    if slip is None:
        slip = _likeliest_slip(replace(given, frames=given.frames[:SLIP_FRAMES]))
    first = replace(given, frames=given.frames[:WHEEL_FRAMES])
    wheel = given.vehicle.wheel + _filter(first, slip)[0][-1, 3:]
    given = _filter_input(dataset, dataset.vehicle.with_wheel(wheel), jumps)
    x, covariances, state, innovations = _filter(given, slip)
    frames = _frames_with_memory(given, innovations)
    if frames is not None:
        given = replace(given, frames=frames)
        x, covariances, state, _ = _filter(given, slip)
    poses, pose_covariances = _poses_from_frames(given, slip, x, covariances)
    repeated = len(dataset.aruco.pose) - sum(len(z) for z, *_ in given.frames)
    return Fusion(
        poses=poses, covariances=pose_covariances, slip=slip,
        rejected=state.rejected + repeated, wheel=given.vehicle.wheel + x[-1, 3:],
        wheel_covariance=covariances[-1, 3:, 3:])


def _likeliest_slip(given):
    """Slip in sqrt(m) of maximum posterior density, by parabolas over the logarithm of slip.

    The first three points are the median of the prior and one standard deviation to both sides.
    """
    middle, step = np.log([TYPICAL_SLIP, SLIP_FACTOR])

    def log_density(log_slip):
        return _filter(given, np.exp(log_slip))[2].log_likelihood \
            - ((log_slip - middle) / step)**2 / 2

    points = {point: log_density(point) for point in middle + step * np.arange(-1, 2)}
    for _ in range(MAX_SLIP_STEPS):
        best = max(points, key=points.get)
        below = max((point for point in points if point < best), default=None)
        above = min((point for point in points if point > best), default=None)
        if below is None or above is None:                     # the maximum is further outside
            vertex = np.clip(best + (step if above is None else -step), *np.log(SLIP_BOUNDS))
        else:
            slopes = [(points[point] - points[best]) / (point - best) for point in (below, above)]
            vertex = (below + best) / 2 - slopes[0] * (above - below) / 2 / (slopes[1] - slopes[0])
        if not abs(vertex - best) >= LOG_SLIP_TOLERANCE:                # or not finite: no parabola
            break
        points[vertex] = log_density(vertex)
    return float(np.exp(vertex if np.isfinite(vertex) else best))


def _filter_input(dataset, vehicle, jumps=NO_JUMPS):
    """The _FilterInput with odometry linearised at the wheel parameters of `vehicle`."""
    ticks, sightings = dataset.ticks, sightings_by_frame(dataset.sightings, extra_frames=[0])
    start, end = sightings.frame[:-1], sightings.frame[1:]
    begins = np.searchsorted(sightings.row, np.arange(len(sightings.frame)))
    pair, first, second = common_sightings(sightings.row, sightings.marker)
    splits = np.searchsorted(pair, np.arange(len(start)))
    C = (vehicle.marker_noise_factor or 1.0)**2 * sightings.C
    seen = (np.split(values, begins[1:]) for values in (sightings.z, C))
    common = (np.split(rows, splits) for rows in (first - begins[pair], second - begins[pair + 1]))
    increment, by_w = increments.between_poses(ticks, vehicle, start, end, "arc")
    rounding, slipping = increments.noise_in_drive(ticks, vehicle, start, end)
    jump, unknown = jumps.added(start, end)
    return _FilterInput(
        dataset=dataset, vehicle=vehicle, pose=sightings.frame, marker=sightings.marker,
        increment=se2.compose(increment, jump), J_w=by_w,
        rounding=rounding + unknown, slipping=slipping, jumps=jumps,
        frames=list(zip(*seen, *common, strict=True)))


def _filter(given, slip):
    """x (f, 6) and its covariances (f, 6, 6) after every frame, the last _State, and innovations.

    Innovations are (u,) rows of the sightings at a frame and (u, 3) for every frame.
    """
    vehicle = given.dataset.vehicle
    state = _State(x=np.append(np.zeros(3), vehicle.wheel - given.vehicle.wheel),
                   M=np.zeros((0, 3)), place=np.zeros(0, int),
                   P=np.diag([0.0, 0.0, vehicle.sigma_heading, *vehicle.sigma_wheel])**2)
    Q, x, covariances, innovations = given.rounding + slip**2 * given.slipping, [], [], []
    for k, frame in enumerate(given.frames):
        if k > 0:
            state = _predicted(state, given.increment[k - 1], given.J_w[k - 1], Q[k - 1])
        state = _updated(state, *frame)
        x.append(state.x)
        covariances.append(state.P[:6, :6].copy())
        innovations.append((state.new, state.v))
    return np.array(x), np.array(covariances), state, innovations


def _frames_with_memory(given, innovations):
    """`frames` whose covariances are larger where errors have memory, else None.

    A covariance is divided by the share that its sighting keeps (`slamlib.memory`).
    """
    sizes = [len(z) for z, *_ in given.frames]
    begins = np.cumsum(sizes) - sizes
    rows = np.concatenate([begin + new for begin, (new, _) in zip(begins, innovations)])
    v = np.concatenate([v for _, v in innovations])
    C = np.concatenate([C for _, C, *_ in given.frames])
    u = np.linalg.solve(np.linalg.cholesky(C[rows]), v[..., None])[..., 0]
    used = np.sum(u**2, axis=1) < GATE
    share = error_memory(given.marker[rows], np.repeat(given.pose, sizes)[rows], u, used).share
    if (share == 1).all():
        return None
    kept = np.ones(len(C))
    kept[rows] = share
    shares = np.split(kept, begins[1:])
    return [(z, C / s[:, None, None], *common) for (z, C, *common), s in zip(given.frames, shares)]


def _predicted(state, increment, by_w, Q):
    """The _State after one odometry increment.

    The derivatives are those of `se2.compose` and `se2.between`, written out: the arrays of one
    frame are so small that calls take longer than arithmetic.
    """
    delta = increment + by_w @ state.x[3:]
    x, y, heading = state.x[:3].tolist()
    turned, back = _rotation(heading), _rotation(-delta[2])
    pose, M = state.x[:3] + turned @ delta, (state.M - delta) @ back.T
    F, L = np.eye(len(state.P)), np.zeros((len(state.P), 3))
    F[0, 2], F[1, 2] = y - pose[1], pose[0] - x
    L[:3] = turned
    L[6:] = np.tile(-back, (len(M), 1))
    L[6::3, 2], L[7::3, 2] = M[:, 1], -M[:, 0]
    F[:, 3:6] += L @ by_w
    rows = 6 + np.arange(3 * len(M)).reshape(-1, 3)
    F[rows[:, :, None], rows[:, None, :]] = back
    return state._replace(x=np.concatenate([pose, state.x[3:]]), M=M,
                          P=F @ state.P @ F.T + L @ Q @ L.T)


def _rotation(angle):
    """The matrix (3, 3) that turns the position of [x, y, heading] by an angle in rad."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _updated(state, z, C, earlier, later):
    """The _State after a frame's sightings z (m, 3) and C (m, 3, 3), as in `_FilterInput`."""
    known = state.place[earlier] >= 0
    old, new = state.place[earlier[known]], later[known]
    v = z[new] - state.M[old]
    v[:, 2] = se2.wrap(v[:, 2])
    state = state._replace(new=new, v=v)
    rows = 6 + 3 * old[:, None] + np.arange(3)
    S = state.P[rows[:, :, None], rows[:, None, :]] + C[new]            # of each sighting alone
    accepted = (v * np.linalg.solve(S, v[..., None])[..., 0]).sum(axis=1) < GATE
    if not accepted.all():
        # A rejected sighting has the density at the gate, so that rejections do not favour a slip.
        density = np.sum(GATE + np.linalg.slogdet(S[~accepted])[1]) / 2
        state = state._replace(log_likelihood=state.log_likelihood - density,
                               rejected=state.rejected + int(np.count_nonzero(~accepted)))
        old, rows = old[accepted], rows[accepted]
    if len(rows):
        state = _corrected(state, rows.ravel(), v[accepted].ravel(), C[new[accepted]])
    added = np.ones(len(z), bool)
    added[new] = False
    kept, rows = len(old), np.concatenate([np.arange(6), rows.ravel()])
    P = np.zeros(2 * [len(rows) + 3 * np.count_nonzero(added)])
    P[:len(rows), :len(rows)] = state.P[rows[:, None], rows]
    rows = len(rows) + np.arange(len(P) - len(rows)).reshape(-1, 3)
    P[rows[:, :, None], rows[:, None, :]] = C[added]
    place = np.full(len(z), -1)
    place[new[accepted]] = np.arange(kept)
    place[added] = kept + np.arange(len(rows))
    return state._replace(P=P, M=np.concatenate([state.M[old], z[added]]), place=place)


def _corrected(state, rows, v, C):
    """The _State after the Kalman update by innovations v (3m,) of these rows (3m,) of P."""
    S, HP = state.P[rows[:, None], rows], state.P[rows]
    block = np.arange(len(v)).reshape(-1, 3)
    S[block[:, :, None], block[:, None, :]] += C
    solved = np.linalg.solve(S, np.column_stack([HP, v]))
    change, P = HP.T @ solved[:, -1], state.P - HP.T @ solved[:, :-1]
    density = (v @ solved[:, -1] + np.linalg.slogdet(S)[1]) / 2
    return state._replace(x=state.x + change[:6], M=state.M + change[6:].reshape(-1, 3),
                          P=(P + P.T) / 2, log_likelihood=state.log_likelihood - density)


def _poses_from_frames(given, slip, x, covariances):
    """All poses (n, 3) and covariances, by odometry from the last frame before each.

    `x` and `covariances` are those of `_filter`.
    """
    pose = np.arange(len(given.dataset.ticks))
    last = np.searchsorted(given.pose, pose, side="right") - 1
    steps = given.dataset.ticks, given.vehicle, given.pose[last], pose
    increment, by_w = increments.between_poses(*steps, "arc")
    rounding, slipping = increments.noise_in_drive(*steps)
    jump, unknown = given.jumps.added(given.pose[last], pose)
    Q = rounding + unknown + slip**2 * slipping
    delta = se2.compose(increment, jump) + np.einsum("nij,nj->ni", by_w, x[last, 3:])
    A, B = se2.compose_jacobians(x[last, :3], delta)
    F = np.concatenate([A, B @ by_w], axis=2)
    return (se2.compose(x[last, :3], delta),
            F @ covariances[last] @ F.mT + B @ Q @ B.mT)
