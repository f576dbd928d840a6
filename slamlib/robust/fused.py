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
from numpy.polynomial import Polynomial

from slamlib.core import increments, se2
from slamlib.core.errors import require
from slamlib.core.hint import Fusion, sighting_count
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
class _Odometry:
    """Increments by odometry between m pairs of poses."""

    increment: np.ndarray        # (m, 3) Delta(w_0)
    by_w: np.ndarray             # (m, 3, 3) dDelta/dw
    rounding: np.ndarray         # (m, 3, 3) Q without slip
    slipping: np.ndarray         # (m, 3, 3) what a slip of 1 sqrt(m) adds to Q

    def noise(self, slip):
        """Q (m, 3, 3)."""
        return self.rounding + slip**2 * self.slipping


@dataclass(frozen=True)
class _FilterInput:
    """The data of the filter, the same for all values of slip."""

    dataset: Dataset
    vehicle: Vehicle             # with the wheel parameters w_0 at which Delta is linearised
    jumps: Jumps                 # where odometry contradicts the markers
    sightings: Sightings         # of f frames, pose 0 among them
    odometry: _Odometry          # of f-1 increments between them


class _State(NamedTuple):        # three are made at a frame: faster than frozen dataclasses
    """The filter after a frame, and k sightings in it of markers of the frame before."""

    X: np.ndarray                # (3,) pose
    w: np.ndarray                # (3,) m, wheel parameters, less w_0
    marker: np.ndarray           # (m,) ids of the markers in the state, not of rejected ones
    M: np.ndarray                # (m, 3) these markers in the frame
    P: np.ndarray                # (6 + 3m, 6 + 3m) covariance of X, w and M
    log_likelihood: float = 0.0  # of the innovations so far, up to a constant
    rejected: int = 0            # number of sightings so far beyond the gate
    row: np.ndarray | None = None           # (k,) of these in Sightings
    innovation: np.ndarray | None = None    # (k, 3) theirs


def fuse(dataset: Dataset, slip: float | None = None) -> Fusion:
    """Fusion of a Dataset's odometry and markers for problem 2, with correct shared errors.

    `slip` in sqrt(m) is the standard deviation of the slip of one wheel after 1 m; None takes that
    of the dataset's Vehicle or, if it has none, the maximum of the posterior density by the
    innovations and the prior of `increments`. A marker_noise_factor of the Vehicle multiplies the
    standard deviations of the sightings. Increments are exact arcs. Without markers the result is
    the first-order propagation of odometry with the noise of slip.

    >>> from slamlib.studies.simulation import simulate
    >>> dataset, truth = simulate("short", seed=1)
    >>> fuse(dataset, slip=1e-3).poses.shape
    (2000, 3)
    """
    require(isinstance(dataset, Dataset), "fuse", "a Dataset", dataset)
    vehicle = dataset.vehicle
    if slip is None:
        slip = vehicle.slip
    jumps = _believed_jumps(dataset, slip or TYPICAL_SLIP)
    given = _filter_input(dataset, vehicle, jumps)
    if slip is None:
        slip = _likeliest_slip(given)
    w_0 = vehicle.wheel + _filter(given, slip, WHEEL_FRAMES)[-1].w
    given = _filter_input(dataset, vehicle.with_wheel(w_0), jumps)
    states = _filter(given, slip)
    share = _shares(given.sightings, states)
    if (share < 1).any():
        larger = given.sightings.C / share[:, None, None]
        given = replace(given, sightings=replace(given.sightings, C=larger))
        states = _filter(given, slip)
    poses, covariances = _poses_from_frames(given, slip, states)
    repeated = sighting_count(dataset) - len(given.sightings.row)
    last = states[-1]
    return Fusion(
        poses=poses, covariances=covariances, slip=slip, rejected=last.rejected + repeated,
        wheel=w_0 + last.w, wheel_covariance=last.P[3:6, 3:6])


def _believed_jumps(dataset, slip):
    """The Jumps of a Dataset, or NO_JUMPS if these are likelier."""
    found = find_jumps(dataset)
    if not len(found.start):
        return NO_JUMPS

    def log_likelihood(jumps):
        given = _filter_input(dataset, dataset.vehicle, jumps)
        return _filter(given, slip)[-1].log_likelihood

    gain = log_likelihood(found) - log_likelihood(NO_JUMPS)
    least = MIN_JUMP_GAIN * len(found.start)
    if found.are_few:
        least = -least
    return found if gain >= least else NO_JUMPS


def _likeliest_slip(given):
    """Slip in sqrt(m) of maximum posterior density, by parabolas over the logarithm of slip.

    The first three points are the median of the prior and one standard deviation to both sides.
    Each parabola needs one more filter; `scipy.optimize` would need twice as many in all.
    """
    median = np.log(TYPICAL_SLIP)
    sigma = np.log(SLIP_FACTOR)

    def log_density(log_slip):
        last = _filter(given, np.exp(log_slip), SLIP_FRAMES)[-1]
        return last.log_likelihood - ((log_slip - median) / sigma)**2 / 2

    x = median + sigma * np.arange(-1, 2)
    y = np.array([log_density(each) for each in x])
    for _ in range(MAX_SLIP_STEPS):
        best = np.argmax(y)
        if best == 0:
            log_slip = x[0] - sigma
        elif best == len(x) - 1:
            log_slip = x[-1] + sigma
        else:
            around = slice(best - 1, best + 2)
            parabola = Polynomial.fit(x[around], y[around], deg=2)
            log_slip = parabola.deriv().roots()[0]
        log_slip = np.clip(log_slip, *np.log(SLIP_BOUNDS))
        if abs(log_slip - x[best]) < LOG_SLIP_TOLERANCE:
            break
        place = np.searchsorted(x, log_slip)
        x = np.insert(x, place, log_slip)
        y = np.insert(y, place, log_density(log_slip))
    return float(np.exp(log_slip))


def _filter_input(dataset, vehicle, jumps=NO_JUMPS):
    """The _FilterInput with odometry linearised at the wheel parameters of `vehicle`."""
    s = sightings_by_frame(dataset.sightings, extra_frames=[0])
    noise_factor = vehicle.marker_noise_factor or 1.0
    return _FilterInput(
        dataset=dataset, vehicle=vehicle, jumps=jumps,
        sightings=replace(s, C=noise_factor**2 * s.C),
        odometry=_odometry(dataset.ticks, vehicle, jumps, s.frame[:-1], s.frame[1:]))


def _odometry(ticks, vehicle, jumps, start, end):
    """The _Odometry from poses `start` to poses `end`, (m,)."""
    increment, by_w = increments.between_poses(ticks, vehicle, start, end, "arc")
    rounding, slipping = increments.noise_in_drive(ticks, vehicle, start, end)
    jump, unknown = jumps.added(start, end)
    return _Odometry(se2.compose(increment, jump), by_w, rounding + unknown, slipping)


def _filter(given, slip, frames=None):
    """The _State after each of the first `frames` frames; None takes all."""
    vehicle = given.dataset.vehicle
    s = given.sightings
    Q = given.odometry.noise(slip)
    sigma = np.append([0.0, 0.0, vehicle.sigma_heading], vehicle.sigma_wheel)
    state = _State(
        X=np.zeros(3), w=vehicle.wheel - given.vehicle.wheel, marker=np.zeros(0, int),
        M=np.zeros((0, 3)), P=np.diag(sigma**2))
    begin = np.searchsorted(s.row, np.arange(1, len(s.frame)))
    rows_by_frame = np.split(np.arange(len(s.row)), begin)
    states = []
    for k, rows in enumerate(rows_by_frame[:frames]):
        if k > 0:
            state = _predicted(state, given.odometry, Q, k - 1)
        state = _updated(state, s, rows)
        states.append(state)
    return states


def _shares(s, states):
    """Shares (s,) of their information that Sightings keep where errors have memory.

    See `slamlib.robust.error_memory`.
    """
    row = np.concatenate([each.row for each in states])
    innovation = np.concatenate([each.innovation for each in states])
    root = np.linalg.cholesky(s.C[row])
    u = np.linalg.solve(root, innovation[..., None])[..., 0]
    used = np.sum(u**2, axis=1) < GATE
    share = np.ones(len(s.C))
    share[row] = error_memory(s.marker[row], s.frame[s.row[row]], u, used).share
    return share


def _predicted(state, odometry, Q, k):
    """The _State after increment k by _Odometry, with noise Q[k]."""
    by_w = odometry.by_w[k]
    delta = odometry.increment[k] + by_w @ state.w
    by_pose, by_delta = se2.compose_jacobians(state.X, delta)
    M_by_delta, M_by_M = se2.between_jacobians(delta, state.M)
    L = np.concatenate([by_delta, np.zeros((3, 3)), M_by_delta.reshape(-1, 3)])
    F = _joined(np.eye(6), M_by_M)
    F[:3, :3] = by_pose
    F[:, 3:6] += L @ by_w
    P = F @ state.P @ F.T + L @ Q[k] @ L.T
    return state._replace(X=se2.compose(state.X, delta), M=se2.between(delta, state.M), P=P)


def _updated(state, s, sighted):
    """The _State after a frame, with the rows `sighted` of Sightings."""
    known = state.marker[:, None] == s.marker[sighted]
    old, seen = known.nonzero()
    row = sighted[seen]
    v = se2.difference(s.z[row], state.M[old])
    H = _measured_rows(old)
    S = state.P[H[:, :, None], H[:, None]] + s.C[row]                  # of each sighting alone
    accepted = se2.squared_norms(v, S) < GATE
    corrected = _corrected(state, old[accepted], v[accepted], s.C[row[accepted]])
    # A rejected sighting has the density at the gate, so that rejections do not favour a slip.
    squared = GATE + np.linalg.slogdet(S[~accepted])[1]
    added = sighted[~known.any(axis=0)]
    return corrected._replace(
        marker=np.append(corrected.marker, s.marker[added]),
        M=np.append(corrected.M, s.z[added], axis=0), P=_joined(corrected.P, s.C[added]),
        log_likelihood=corrected.log_likelihood - np.sum(squared) / 2,
        rejected=state.rejected + len(squared), row=row, innovation=v)


def _corrected(state, old, v, C):
    """The _State of only the markers `old` (k,) after an update by their innovations v (k, 3)."""
    v = v.ravel()
    H = _measured_rows(old).ravel()
    HP = state.P[H]
    S = HP[:, H] + _joined(np.zeros((0, 0)), C)
    weighted = np.linalg.solve(S, np.column_stack([HP, v]))            # S^-1 [H P', v]
    K = weighted[:, :-1].T
    change = K @ v
    P = state.P - K @ HP
    P = (P + P.T) / 2
    kept = np.append(np.arange(6), H)
    M = state.M + change[6:].reshape(-1, 3)
    squared = v @ weighted[:, -1] + np.linalg.slogdet(S)[1]
    return state._replace(
        X=state.X + change[:3], w=state.w + change[3:6], marker=state.marker[old], M=M[old],
        P=P[kept[:, None], kept], log_likelihood=state.log_likelihood - squared / 2)


def _measured_rows(old):
    """Rows (k, 3) of P that H selects, of markers in rows (k,) of M."""
    return 6 + 3 * old[:, None] + np.arange(3)


def _joined(P, C):
    """The block-diagonal matrix (n + 3k, n + 3k) of P (n, n) and C (k, 3, 3)."""
    n = len(P)
    rows = n + np.arange(3 * len(C)).reshape(-1, 3)
    joined = np.zeros((n + rows.size, n + rows.size))
    joined[:n, :n] = P
    joined[rows[:, :, None], rows[:, None]] = C
    return joined


def _poses_from_frames(given, slip, states):
    """All poses (n, 3) and covariances, by odometry from the last frame before each."""
    pose = np.arange(len(given.dataset.ticks))
    frame = given.sightings.frame
    last = np.searchsorted(frame, pose, side="right") - 1
    odometry = _odometry(given.dataset.ticks, given.vehicle, given.jumps, frame[last], pose)
    X = np.array([each.X for each in states])[last]
    w = np.array([each.w for each in states])[last]
    P = np.array([each.P[:6, :6] for each in states])[last]
    delta = odometry.increment + np.matvec(odometry.by_w, w)
    A, B = se2.compose_jacobians(X, delta)
    F = np.concatenate([A, B @ odometry.by_w], axis=2)
    by_frame = F @ P @ F.mT
    by_odometry = B @ odometry.noise(slip) @ B.mT
    return se2.compose(X, delta), by_frame + by_odometry
