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

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from slamlib.core import increments, se2
from slamlib.core.errors import require
from slamlib.core.hint import Fusion
from slamlib.core.increments import SLIP_BOUNDS, SLIP_FACTOR, TYPICAL_SLIP
from slamlib.core.records import Dataset
from slamlib.core.sightings import GATE, Sightings, sightings_by_frame
from slamlib.core.vehicle import Vehicle
from slamlib.robust.error_memory import error_memory
from slamlib.robust.jumps import NO_JUMPS, Jumps, find_jumps

SLIP_FRAMES = 500            # number of frames, the first ones, from which the slip is learned
WHEEL_FRAMES = 5000          # number of frames, the first ones, that give the wheel parameters w_0
MIN_JUMP_GAIN = 10.0         # log likelihood by each of many jumps; the loss by each of a few
MAX_SLIP_STEPS = 30          # number of parabolas
LOG_SLIP_TOLERANCE = 0.05    # of the natural logarithm of the slip


@dataclass(frozen=True)
class _FilterInput:
    """The data of the filter, the same for all values of slip."""

    dataset: Dataset
    vehicle: Vehicle             # with the wheel parameters w_0 at which Delta is linearised
    jumps: Jumps                 # where odometry contradicts the markers
    sightings: Sightings         # of f frames, pose 0 among them
    odometry: tuple              # of f-1 increments between them, see `_odometry`


class _State(NamedTuple):        # two are made at a frame: faster than frozen dataclasses
    """The filter after a frame, and how k markers of the frame before were seen in it."""

    x: np.ndarray                # (6,) pose X and w - w_0
    marker: np.ndarray           # (m,) ids of the markers in the state, not of rejected ones
    M: np.ndarray                # (m, 3) these markers in the frame
    P: np.ndarray                # (6 + 3m, 6 + 3m) covariance of x and M
    log_likelihood: float = 0.0  # of the innovations so far, up to a constant
    rejected: int = 0            # number of sightings so far beyond the gate
    new: np.ndarray | None = None        # (k,) their rows in the frame
    v: np.ndarray | None = None  # (k, 3) their innovations


def fuse(dataset, slip=None):
    """Fusion of a Dataset's odometry and markers for problem 2, with correct shared errors.

    `slip` in sqrt(m) is the standard deviation of the slip of one wheel after 1 m; None takes that
    of the dataset's Vehicle or, if it has none, the maximum of the posterior density by the
    innovations and the prior of `increments`. A marker_noise_factor of the Vehicle multiplies the
    standard deviations of the sightings. Increments are exact arcs.

    >>> from slamlib.studies.simulation import simulate
    >>> dataset, truth = simulate("short", seed=1)
    >>> fuse(dataset, slip=1e-3).poses.shape
    (2000, 3)
    """
    require(isinstance(dataset, Dataset), "fuse", "a Dataset", dataset)
    slip = dataset.vehicle.slip if slip is None else slip
    vehicle, jumps = dataset.vehicle, find_jumps(dataset)
    if len(jumps.start):
        without, gain = (_filter(_filter_input(dataset, vehicle, each), slip or TYPICAL_SLIP)[2]
                         .log_likelihood for each in (NO_JUMPS, jumps))
        least = MIN_JUMP_GAIN * len(jumps.start)
        if gain - without < (-least if jumps.are_few else least):
            jumps = NO_JUMPS
    given = _filter_input(dataset, vehicle, jumps)
    slip = _likeliest_slip(given) if slip is None else slip
    wheel = vehicle.wheel + _filter(given, slip, WHEEL_FRAMES)[0][-1, 3:]
    given = _filter_input(dataset, vehicle.with_wheel(wheel), jumps)
    x, covariances, state, *innovations = _filter(given, slip)
    C = _with_memory(given.sightings, *innovations)
    if (C != given.sightings.C).any():
        given = replace(given, sightings=replace(given.sightings, C=C))
        x, covariances, state, *_ = _filter(given, slip)
    poses, pose_covariances = _poses_from_frames(given, slip, x, covariances)
    repeated = len(dataset.aruco.pose) - len(given.sightings.row)
    return Fusion(
        poses=poses, covariances=pose_covariances, slip=slip,
        rejected=state.rejected + repeated, wheel=wheel + x[-1, 3:],
        wheel_covariance=covariances[-1, 3:, 3:])


def _likeliest_slip(given):
    """Slip in sqrt(m) of maximum posterior density, by parabolas over the logarithm of slip.

    The first three points are the median of the prior and one standard deviation to both sides.
    """
    middle, step = np.log([TYPICAL_SLIP, SLIP_FACTOR])

    def log_density(log_slip):
        return _filter(given, np.exp(log_slip), SLIP_FRAMES)[2].log_likelihood \
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
    s = sightings_by_frame(dataset.sightings, extra_frames=[0])
    return _FilterInput(
        dataset=dataset, vehicle=vehicle, jumps=jumps,
        sightings=replace(s, C=(vehicle.marker_noise_factor or 1.0)**2 * s.C),
        odometry=_odometry(dataset.ticks, vehicle, jumps, s.frame[:-1], s.frame[1:]))


def _odometry(ticks, vehicle, jumps, start, end):
    """Delta(w_0) (m, 3), dDelta/dw, Q without slip, and what a slip of 1 sqrt(m) adds to Q."""
    increment, by_w = increments.between_poses(ticks, vehicle, start, end, "arc")
    rounding, slipping = increments.noise_in_drive(ticks, vehicle, start, end)
    jump, unknown = jumps.added(start, end)
    return se2.compose(increment, jump), by_w, rounding + unknown, slipping


def _filter(given, slip, frames=None):
    """x (f, 6) and its covariances (f, 6, 6) after every frame, and the last _State.

    Also rows (u,) of the sightings of a marker that the state has, and their innovations (u, 3).
    `frames` is the number of frames, the first ones; None takes all.
    """
    vehicle, s = given.dataset.vehicle, given.sightings
    increment, by_w, Q, slipping = given.odometry
    Q, x, covariances, rows, v = Q + slip**2 * slipping, [], [], [], []
    state = _State(x=np.append(np.zeros(3), vehicle.wheel - given.vehicle.wheel),
                   marker=np.zeros(0, int), M=np.zeros((0, 3)),
                   P=np.diag([0.0, 0.0, vehicle.sigma_heading, *vehicle.sigma_wheel])**2)
    begins = np.searchsorted(s.row, np.arange(len(s.frame) + 1))
    for k, (begin, end) in enumerate(zip(begins[:frames], begins[1:])):
        if k > 0:
            state = _predicted(state, increment[k - 1], by_w[k - 1], Q[k - 1])
        state = _updated(state, s.marker[begin:end], s.z[begin:end], s.C[begin:end])
        x.append(state.x)
        covariances.append(state.P[:6, :6])
        rows.append(begin + state.new)
        v.append(state.v)
    return np.array(x), np.array(covariances), state, np.concatenate(rows), np.concatenate(v)


def _with_memory(s, rows, v):
    """Covariances (s, 3, 3) of Sightings, larger where errors have memory, by innovations `v`.

    A covariance is divided by the share that its sighting keeps (`slamlib.robust.error_memory`).
    """
    u = np.linalg.solve(np.linalg.cholesky(s.C[rows]), v[..., None])[..., 0]
    used, share = np.sum(u**2, axis=1) < GATE, np.ones(len(s.C))
    share[rows] = error_memory(s.marker[rows], s.frame[s.row[rows]], u, used).share
    return s.C / share[:, None, None]


def _predicted(state, increment, by_w, Q):
    """The _State after one odometry increment."""
    delta = increment + by_w @ state.x[3:]
    by_pose, by_delta = se2.compose_jacobians(state.x[:3], delta)
    M_by_delta, M_by_M = se2.between_jacobians(delta, state.M)
    L = np.concatenate([by_delta, np.zeros((3, 3)), M_by_delta.reshape(-1, 3)])
    F = _joined(np.eye(6), M_by_M)
    F[:3, :3] = by_pose
    F[:, 3:6] += L @ by_w
    return state._replace(
        x=np.append(se2.compose(state.x[:3], delta), state.x[3:]), M=se2.between(delta, state.M),
        P=F @ state.P @ F.T + L @ Q @ L.T)


def _updated(state, marker, z, C):
    """The _State after a frame's sightings of markers (m,), z (m, 3) with C (m, 3, 3)."""
    known = state.marker[:, None] == marker
    old, new = known.nonzero()
    v = se2.difference(z[new], state.M[old])
    rows, each = (6 + 3 * old[:, None] + np.arange(3)).ravel(), np.arange(len(new))
    S = state.P[rows[:, None], rows]
    blocks = S.reshape(2 * (len(new), 3))                               # of the same memory
    S_each = blocks[each, :, each] = blocks[each, :, each] + C[new]
    accepted = (v * np.linalg.solve(S_each, v[..., None])[..., 0]).sum(axis=1) < GATE
    # A rejected sighting has the density at the gate, so that rejections do not favour a slip.
    rejected = GATE + np.linalg.slogdet(S_each[~accepted])[1]
    used = np.repeat(accepted, 3)
    rows, S, u = rows[used], S[used][:, used], v[accepted].ravel()
    HP = state.P[rows]
    solved = np.linalg.solve(S, np.column_stack([HP, u]))
    change, P = HP.T @ solved[:, -1], state.P - HP.T @ solved[:, :-1]
    kept, added = np.concatenate([np.arange(6), rows]), ~known.any(axis=0)
    M = (state.M + change[6:].reshape(-1, 3))[old[accepted]]
    return _State(
        x=state.x + change[:6], M=np.concatenate([M, z[added]]),
        marker=np.concatenate([marker[new[accepted]], marker[added]]),
        P=_joined((P + P.T)[kept[:, None], kept] / 2, C[added]),
        log_likelihood=state.log_likelihood - (
            rejected.sum() + u @ solved[:, -1] + np.linalg.slogdet(S)[1]) / 2,
        rejected=state.rejected + len(rejected), new=new, v=v)


def _joined(P, C):
    """The block-diagonal matrix (n + 3k, n + 3k) of P (n, n) and C (k, 3, 3)."""
    rows = len(P) + np.arange(3 * len(C)).reshape(-1, 3)
    joined = np.zeros(2 * [len(P) + rows.size])
    joined[:len(P), :len(P)] = P
    joined[rows[:, :, None], rows[:, None, :]] = C
    return joined


def _poses_from_frames(given, slip, x, covariances):
    """All poses (n, 3) and covariances, by odometry from the last frame before each.

    `x` and `covariances` are those of `_filter`.
    """
    pose, frame = np.arange(len(given.dataset.ticks)), given.sightings.frame
    last = np.searchsorted(frame, pose, side="right") - 1
    increment, by_w, Q, slipping = _odometry(
        given.dataset.ticks, given.vehicle, given.jumps, frame[last], pose)
    delta = increment + (by_w @ x[last, 3:, None])[..., 0]
    A, B = se2.compose_jacobians(x[last, :3], delta)
    F = np.concatenate([A, B @ by_w], axis=2)
    return (se2.compose(x[last, :3], delta),
            F @ covariances[last] @ F.mT + B @ (Q + slip**2 * slipping) @ B.mT)
