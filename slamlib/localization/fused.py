"""Problem 2, odometry and markers fused by a Kalman filter whose state holds the shared errors.

The state contains the pose X, the wheel parameters w = [R_R, R_L, b] and the markers M_j of the
last frame, in that frame, with covariance P (Smith, Self and Cheeseman, Estimating Uncertain
Spatial Relationships in Robotics, 1990). Odometry predicts

    X' = X Delta(w),    M'_j = Delta(w)^-1 M_j,    w' = w,    P' = F P F^T + L Q L^T,

with Delta(w) = Delta(w_0) + dDelta/dw (w - w_0), F and L the derivatives of the new state by the
old one and by Delta, and Q the noise of Delta: slip, and its share of the rounding of one
difference of counts over the drive (`increments.noise_in_drive`). The sightings Z_j of
the new frame, with covariances C_j, measure the markers M' = H state and update

    state <- state + K (Z - M'),    P <- (I - K H) P',    K = P' H^T S^-1,    S = H P' H^T + C,

with C block-diagonal. Sightings beyond GATE are rejected. Then rejected markers and those out of
view are dropped, and new ones are added with covariance C_j. Without markers the result is the
first-order propagation of odometry; with uninformative odometry and one marker it is `localize`.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize_scalar

from slamlib import increments, se2
from slamlib.increments import SLIP_BOUNDS, log_slip_prior
from slamlib.sightings import GATE, sightings_by_frame

SLIP_FRAMES = 500            # number of frames, the first ones, from which the slip is learned


@dataclass(frozen=True)
class Fusion:
    """Poses and covariances at every pose of the encoder file."""

    poses: np.ndarray            # (n, 3) in the world frame, m and rad
    covariances: np.ndarray      # (n, 3, 3) of [x, y, heading] in world axes
    measured: np.ndarray         # (f,) pose indices from 0 of the frames
    rejected: int                # number of sightings not used; of repeated ones one is used
    slip: float | None = None    # sqrt(m), given or learned
    wheel: np.ndarray | None = None             # (3,) m, R_R, R_L, b estimated at the last frame
    wheel_covariance: np.ndarray | None = None  # (3, 3) m^2


@dataclass(frozen=True)
class _FilterInput:
    """The data of the filter, computed once for all values of slip."""

    dataset: object
    model: str
    vehicle: object              # with the wheel parameters w_0 at which Delta is linearised
    pose: np.ndarray             # (f,) pose indices of the frames, pose 0 among them
    increment: np.ndarray        # (f-1, 3) Delta(w_0)
    by_w: np.ndarray             # (f-1, 3, 3) dDelta/dw
    rounding: np.ndarray         # (f-1, 3, 3) Q without slip
    slipping: np.ndarray         # (f-1, 3, 3) what a slip of 1 sqrt(m) adds to Q
    frames: list                 # of f tuples: marker ids (m,), z (m, 3) and C (m, 3, 3)


@dataclass(frozen=True)
class _State:
    """The filter after a frame with m markers."""

    x: np.ndarray                # (6,) pose X and w - w_0
    ids: np.ndarray              # (m,) marker ids
    M: np.ndarray                # (m, 3) markers in the frame
    P: np.ndarray                # (6 + 3m, 6 + 3m) covariance of x and M
    log_likelihood: float = 0.0  # of the innovations so far, up to a constant
    rejected: int = 0            # number of sightings so far beyond the gate


def fuse(dataset, slip=None, model="arc"):
    """Fusion of a Dataset's odometry and markers; its covariances count shared errors once.

    `slip` in sqrt(m) is the standard deviation of the slip of one wheel after 1 m; None maximises
    the likelihood of the innovations times `log_slip_prior`. `model` is that of the increments,
    "arc" or "euler"; another one raises ValueError.
    """
    given = _filter_input(dataset, model, dataset.vehicle)
    if slip is None:
        first = replace(given, frames=given.frames[:SLIP_FRAMES])
        best = minimize_scalar(
            lambda s: -_filter(first, np.exp(s))[2].log_likelihood - log_slip_prior(s),
            bounds=np.log(SLIP_BOUNDS), method="bounded", options={"xatol": 0.1})
        slip = float(np.exp(best.x))
    wheel = given.vehicle.wheel + _filter(given, slip)[0][-1, 3:]
    given = _filter_input(dataset, model, dataset.vehicle.with_wheel(wheel))    # linearised again
    return _between_frames(given, slip, *_filter(given, slip))


def _filter_input(dataset, model, vehicle):
    """The _FilterInput with odometry linearised at the wheel parameters of this vehicle."""
    ticks, sightings = dataset.ticks, sightings_by_frame(dataset.aruco, extra_frames=[0])
    start, end = sightings.frame[:-1], sightings.frame[1:]
    splits = np.searchsorted(sightings.row, np.arange(1, len(sightings.frame)))
    seen = (np.split(each, splits) for each in (sightings.marker, sightings.z, sightings.C))
    increment, by_w = increments.between_poses(ticks, vehicle, start, end, model)
    rounding, slipping = increments.noise_in_drive(ticks, vehicle, start, end)
    return _FilterInput(
        dataset=dataset, model=model, vehicle=vehicle, pose=sightings.frame, increment=increment,
        by_w=by_w, rounding=rounding, slipping=slipping, frames=list(zip(*seen, strict=True)))


def _filter(given, slip):
    """x (f, 6) and its covariances (f, 6, 6) after every frame, and the last _State."""
    vehicle = given.dataset.vehicle
    state = _State(x=np.append(np.zeros(3), vehicle.wheel - given.vehicle.wheel),
                   ids=np.zeros(0, int), M=np.zeros((0, 3)),
                   P=np.diag([0.0, 0.0, vehicle.sigma_heading, *vehicle.sigma_wheel])**2)
    Q, x, covariances = given.rounding + slip**2 * given.slipping, [], []
    for k, frame in enumerate(given.frames):
        if k > 0:
            state = _predict(state, given.increment[k - 1], given.by_w[k - 1], Q[k - 1])
        state = _update(state, *frame)
        x.append(state.x)
        covariances.append(state.P[:6, :6].copy())
    return np.array(x), np.array(covariances), state


def _predict(state, increment, by_w, Q):
    """The _State after one odometry increment."""
    delta = increment + by_w @ state.x[3:]
    A, B = se2.compose_jacobians(state.x[:3], delta)
    by_delta, by_marker = se2.between_jacobians(delta, state.M)
    F, L = np.eye(len(state.P)), np.zeros((len(state.P), 3))
    F[:3, :3] = A
    L[:3], L[6:] = B, by_delta.reshape(-1, 3)
    F[:, 3:6] += L @ by_w
    rows = 6 + np.arange(3 * len(state.M)).reshape(-1, 3)
    F[rows[:, :, None], rows[:, None, :]] = by_marker
    return replace(state, x=np.append(se2.compose(state.x[:3], delta), state.x[3:]),
                   M=se2.between(delta, state.M), P=F @ state.P @ F.T + L @ Q @ L.T)


def _update(state, ids, z, C):
    """The _State after the sightings of a frame: marker ids (m,), z (m, 3) and C (m, 3, 3)."""
    _, old, new = np.intersect1d(state.ids, ids, assume_unique=True, return_indices=True)
    v = z[new] - state.M[old]
    v[:, 2] = se2.wrap(v[:, 2])
    rows = 6 + 3 * old[:, None] + np.arange(3)
    S = state.P[rows[:, :, None], rows[:, None, :]] + C[new]            # of each sighting alone
    accepted = np.einsum("ni,ni->n", v, np.linalg.solve(S, v[..., None])[..., 0]) < GATE
    # A rejected sighting has the density at the gate, so that rejections do not favour a slip.
    rejected = int(np.count_nonzero(~accepted))
    penalty = rejected * GATE / 2 + np.sum(np.linalg.slogdet(S[~accepted])[1]) / 2
    state = replace(state, log_likelihood=state.log_likelihood - penalty,
                    rejected=state.rejected + rejected)
    if accepted.any():
        state = _correct(state, rows[accepted], v[accepted].ravel(), C[new[accepted]])
    added, kept = np.setdiff1d(np.arange(len(ids)), new), old[accepted]
    rows = np.append(np.arange(6), rows[accepted])
    P = np.zeros(2 * [len(rows) + 3 * len(added)])
    P[:len(rows), :len(rows)] = state.P[rows[:, None], rows]
    rows = len(rows) + np.arange(3 * len(added)).reshape(-1, 3)
    P[rows[:, :, None], rows[:, None, :]] = C[added]
    return replace(state, ids=np.append(state.ids[kept], ids[added]), P=P,
                   M=np.concatenate([state.M[kept], z[added]]))


def _correct(state, rows, v, C):
    """The _State after the Kalman update with innovations v (3m,) of the rows (m, 3) of P."""
    S = state.P[rows.reshape(-1, 1), rows.ravel()]
    block = np.arange(len(v)).reshape(-1, 3)
    S[block[:, :, None], block[:, None, :]] += C
    HP = state.P[rows.ravel()]
    K = np.linalg.solve(S, HP).T
    change, P = K @ v, state.P - K @ HP
    gained = -(v @ np.linalg.solve(S, v) + np.linalg.slogdet(S)[1]) / 2
    return replace(state, x=state.x + change[:6], M=state.M + change[6:].reshape(-1, 3),
                   P=(P + P.T) / 2, log_likelihood=state.log_likelihood + gained)


def _between_frames(given, slip, x, covariances, state):
    """The Fusion: every pose of the encoder file by odometry from the last frame before it."""
    ticks, vehicle = given.dataset.ticks, given.vehicle
    pose = np.arange(len(ticks))
    last = np.searchsorted(given.pose, pose, side="right") - 1
    start = given.pose[last]
    increment, by_w = increments.between_poses(ticks, vehicle, start, pose, given.model)
    rounding, slipping = increments.noise_in_drive(ticks, vehicle, start, pose)
    Q = rounding + slip**2 * slipping
    delta = increment + np.einsum("nij,nj->ni", by_w, x[last, 3:])
    A, B = se2.compose_jacobians(x[last, :3], delta)
    F = np.concatenate([A, B @ by_w], axis=2)
    repeated = len(given.dataset.aruco.pose) - sum(len(ids) for ids, _, _ in given.frames)
    return Fusion(
        poses=se2.compose(x[last, :3], delta),
        covariances=F @ covariances[last] @ np.swapaxes(F, 1, 2) + B @ Q @ np.swapaxes(B, 1, 2),
        measured=given.pose, rejected=state.rejected + repeated, slip=slip,
        wheel=vehicle.wheel + x[-1, 3:], wheel_covariance=covariances[-1, 3:, 3:])
