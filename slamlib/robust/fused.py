"""Problem 2, odometry and markers fused by Kalman filters whose state contains the shared errors.

The state contains the pose X, the shared parameters s (wheels w = [R_R, R_L, b], camera c, size of
the markers) and the markers M_j of the last frame, in the camera, with covariance P (Smith, Self
and Cheeseman, Estimating Uncertain Spatial Relationships in Robotics, 1990). Odometry predicts

    X' = X Delta(w),    M'_j = D^-1 M_j,    D = c^-1 Delta(w) c,    s' = s,
    P' = F P F^T + L Q L^T,

with Delta(w) = Delta(w_0) + dDelta/dw (w - w_0), lengths in D over the size, F and L the
derivatives of the new state by the old one and by Delta, and Q the noise of Delta
(`increments.noise_in_drive`). The sightings Z_j of the new frame, with covariances C_j, measure the
markers M' = H state and update

    state <- state + K (Z - M'),    P <- (I - K H) P',    K = P' H^T S^-1,    S = H P' H^T + C,

with C block-diagonal. Sightings beyond GATE are rejected. Then the filter removes rejected markers
and those out of view, and adds new ones with covariance C_j. Without markers the result is the
first-order propagation of odometry; with uninformative odometry and one marker it is `localize`.

Errors of a marker in successive frames are alike, with the correlation `memory`. The last sighting
tells the last error, so what is expected and measured is Z = M' + memory (Z_last - M), with the
covariance (1 - memory^2) C of the new part of the error (Bryson and Henrikson, Estimation using
sampled data containing sequentially correlated noise, 1968).

Nobody states the slip. So several filters run side by side, each with its slip, and their mean is
taken with their probabilities by the innovations so far (multiple models: Bar-Shalom, Li and
Kirubarajan 2001, section 11.6). Stretches of the drive tell in advance which slips are tried, the
memory, and whether the camera is elsewhere than stated.
"""

from dataclasses import dataclass, replace
from itertools import product
from typing import NamedTuple

import numpy as np

from slamlib.core import increments, se2
from slamlib.core.errors import require
from slamlib.core.hint import Fusion, sighting_count
from slamlib.core.increments import SLIP_BOUNDS, SLIP_FACTOR, TYPICAL_SLIP
from slamlib.core.odometry import cumulative
from slamlib.core.records import Dataset
from slamlib.core.sightings import GATE, Sightings, sightings_by_frame
from slamlib.core.vehicle import Vehicle
from slamlib.robust.calibration import CAMERA, SIZE, WHEELS, stated_calibration
from slamlib.robust.jumps import NO_JUMPS, Jumps, find_jumps

SLIPS = TYPICAL_SLIP * SLIP_FACTOR ** np.arange(-1.0, 4.0)     # sqrt(m), of the first filters
MEMORIES = (0.0, 0.6, 0.9, 0.95)            # correlations of successive errors of a marker
FINE_STEPS = 1.4 ** np.arange(-2.0, 3.0)     # slips of the last filters, over the likeliest one
STRETCHES = 10               # of the drive, in which the first filters run
STRETCH_FRAMES = 20          # at most, of each
CRAWL = 0.1                  # of the typical speed, below which counts may creep
PRICE = 6.0                  # log density by which errors have memory, and by which the camera errs
MIN_JUMP_GAIN = 10.0         # log likelihood by each of many jumps; the loss by each of a few
SHARED = slice(3, 10)        # of the state
FIXED = 10                   # rows of the state before those of the markers


@dataclass(frozen=True)
class _Odometry:
    """Increments by odometry between m pairs of poses."""

    increment: np.ndarray        # (m, 3) Delta(w_0)
    by_w: np.ndarray             # (m, 3, 3) dDelta/dw
    rounding: np.ndarray         # (m, 3, 3) Q without slip
    slipping: np.ndarray         # (m, 3, 3) what a slip of 1 sqrt(m) adds to Q

    def noise(self, slip):
        """Q (m, k, 3, 3) by slips (k,) or (m, k)."""
        variance = np.square(slip)[..., None, None]
        return self.rounding[:, None] + variance * self.slipping[:, None]


@dataclass(frozen=True)
class _FilterInput:
    """The data of the filters."""

    dataset: Dataset
    vehicle: Vehicle             # with the wheel parameters w_0 at which Delta is linearised
    jumps: Jumps                 # where odometry contradicts the markers
    sightings: Sightings         # of f frames, pose 0 among them
    odometry: _Odometry          # of f-1 increments between them


class _State(NamedTuple):        # three are made at a frame: faster than frozen dataclasses
    """h filters after a frame, and k sightings in it of markers of the frame before."""

    X: np.ndarray                # (h, 3) pose
    s: np.ndarray                # (h, 7) wheels, camera, size of the markers
    marker: np.ndarray           # (m,) ids of the markers in the state, not of rejected ones
    z: np.ndarray                # (m, 3) their sightings in the frame
    M: np.ndarray                # (h, m, 3) these markers in the camera
    expected: np.ndarray         # (h, m, 3) predicted sightings, with the errors of the last ones
    memory: np.ndarray           # (h,) correlation of these errors
    P: np.ndarray                # (h, 10 + 3m, 10 + 3m) covariance of X, s and M
    log_density: np.ndarray      # (h,) of the innovations so far and the prior, up to a constant
    rejected: int = 0            # number of sightings so far beyond the gate

    @property
    def weight(self):
        """Probabilities (h,) of the filters."""
        density = np.exp(self.log_density - self.log_density.max())
        return density / density.sum()


def fuse(dataset: Dataset, slip: float | None = None) -> Fusion:
    """Fusion of a Dataset's odometry and markers for problem 2, with correct shared errors.

    `slip` in sqrt(m) is the standard deviation of the slip of one wheel after 1 m; None takes that
    of the dataset's Vehicle or, if it has none, what the innovations say of it. A
    marker_noise_factor of the Vehicle multiplies the standard deviations of the sightings.
    Increments are exact arcs. Without markers the result is the first-order propagation of odometry
    with the noise of slip.

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
    models, w_0 = _learned(dataset, slip, jumps)
    given = _filter_input(dataset, vehicle.with_wheel(w_0), jumps)
    states = _filter(given, models)
    X, s, P, slips = _mixed(states, models[:, 0])
    poses, covariances = _poses_from_frames(given, slips, X, s, P)
    repeated = sighting_count(dataset) - len(given.sightings.row)
    return Fusion(
        poses=poses, covariances=covariances, slip=float(slips[-1]),
        rejected=states[-1].rejected + repeated, wheel=s[-1, WHEELS],
        wheel_covariance=P[-1, 3:6, 3:6], memory=float(models[0, 1]), camera=s[-1, CAMERA])


def _learned(dataset, slip, jumps):
    """Models (h, 3) [slip, memory, camera is elsewhere], by their density in stretches, and w_0."""
    slips = SLIPS if slip is None else [slip]
    models = np.array(list(product(slips, MEMORIES, (False, True))))
    given = _filter_input(_stretches(dataset), dataset.vehicle, jumps)
    last = _filter(given, models)[-1]
    best = models[np.argmax(last.log_density)]
    if slip is None:
        slips = best[0] * FINE_STEPS
    w_0 = last.weight @ last.s[:, WHEELS]
    return np.array([[each, *best[1:]] for each in slips]), w_0


def _stretches(dataset):
    """The Dataset with sightings in some stretches only, which begin after equal distances.

    So many frames at a stand count as one stretch.
    """
    aruco = dataset.aruco
    if aruco is None:
        return dataset
    frame = np.unique(aruco.pose)
    travelled = _travelled(dataset.ticks)[frame]
    begin = np.linspace(travelled[0], travelled[-1], STRETCHES, endpoint=False)
    row = np.searchsorted(travelled, begin)[:, None] + np.arange(STRETCH_FRAMES)
    chosen = frame[row[row < len(frame)]]
    return replace(dataset, aruco=aruco.select(np.isin(aruco.pose, chosen)))


def _travelled(ticks):
    """Sum of the counts of both wheels (n,) up to each pose."""
    return cumulative(np.abs(ticks[1:]).sum(axis=1))


def _mixed(states, slips):
    """Means (f, 3) of X and (f, 7) of s, their covariance (f, 10, 10), and slips (f,)."""
    weight = np.array([each.weight for each in states])
    y = np.array([np.concatenate([each.X, each.s], axis=1) for each in states])
    P = np.array([each.P[:, :FIXED, :FIXED] for each in states])
    mean = np.einsum("fh,fhi->fi", weight, y)
    off = y - mean[:, None]
    spread = off[..., :, None] * off[..., None, :]
    covariance = np.einsum("fh,fhij->fij", weight, P + spread)
    return mean[:, :3], mean[:, SHARED], covariance, np.sqrt(weight @ slips**2)


def _believed_jumps(dataset, slip):
    """The Jumps of a Dataset, or NO_JUMPS if these are likelier."""
    found = find_jumps(dataset)
    if not len(found.start):
        return NO_JUMPS

    models = np.array([[slip, 0.0, False]])

    def log_density(jumps):
        given = _filter_input(dataset, dataset.vehicle, jumps)
        return _filter(given, models)[-1].log_density[0]

    gain = log_density(found) - log_density(NO_JUMPS)
    least = MIN_JUMP_GAIN * len(found.start)
    if found.are_few:
        least = -least
    return found if gain >= least else NO_JUMPS


def _filter_input(dataset, vehicle, jumps=NO_JUMPS):
    """The _FilterInput with odometry linearised at the wheel parameters of `vehicle`."""
    s = sightings_by_frame(dataset.aruco, extra_frames=[0])
    noise_factor = vehicle.marker_noise_factor or 1.0
    return _FilterInput(
        dataset=dataset, vehicle=vehicle, jumps=jumps,
        sightings=replace(s, C=noise_factor**2 * s.C),
        odometry=_odometry(dataset.ticks, vehicle, jumps, s.frame[:-1], s.frame[1:]))


def _odometry(ticks, vehicle, jumps, start, end):
    """The _Odometry from poses `start` to poses `end`, (m,).

    A vehicle that crawls may as well stand, while its counts creep.
    """
    increment, by_w = increments.between_poses(ticks, vehicle, start, end, "arc")
    rounding, slipping = increments.noise_in_drive(ticks, vehicle, start, end)
    jump, unknown = jumps.added(start, end)
    travelled = _travelled(ticks)
    travel = travelled[end] - travelled[start]
    speed = travel / np.maximum(end - start, 1)
    crawls = speed * travel.sum() < CRAWL * (speed @ travel)
    by_w[crawls] = 0.0
    rounding[crawls] += increment[crawls, :, None] * increment[crawls, None]
    return _Odometry(se2.compose(increment, jump), by_w, rounding + unknown, slipping)


def _filter(given, models):
    """The _State after each frame of filters with models (h, 3)."""
    vehicle = given.dataset.vehicle
    sightings = given.sightings
    slip, memory, elsewhere = models.T
    Q = given.odometry.noise(slip)
    calibration = stated_calibration(vehicle, ())
    released = calibration.sigma_without(["camera-offset"])
    sigma = np.zeros((len(models), FIXED))
    sigma[:, 2] = vehicle.sigma_heading
    sigma[:, SHARED] = np.where(elsewhere[:, None], released, calibration.sigma)[:, :SIZE + 1]
    off = np.log(np.maximum(slip, SLIP_BOUNDS[0]) / TYPICAL_SLIP) / np.log(SLIP_FACTOR)
    nothing = np.zeros((len(models), 0, 3))
    state = _State(
        X=np.zeros((len(models), 3)), s=np.tile(calibration.stated[:SIZE + 1], (len(models), 1)),
        marker=np.zeros(0, int), z=nothing[0], M=nothing, expected=nothing, memory=memory,
        P=sigma[:, None]**2 * np.eye(FIXED),
        log_density=-off**2 / 2 - PRICE * (elsewhere + (memory > 0)))
    interval = np.diff(sightings.frame)
    typical = np.median(interval) if len(interval) else 1
    begin = np.searchsorted(sightings.row, np.arange(1, len(sightings.frame)))
    rows_by_frame = np.split(np.arange(len(sightings.row)), begin)
    states = []
    for k, rows in enumerate(rows_by_frame):
        if k > 0:
            over_interval = memory ** (interval[k - 1] / typical)
            state = _predicted(state, given, Q, k - 1, over_interval)
        state = _updated(state, sightings, rows)
        states.append(state)
    return states


def _predicted(state, given, Q, k, memory):
    """The _State after increment k by _Odometry, with noise Q[k].

    Below M the covariance has rows of the expected sightings M' - memory M.
    """
    by_w = given.odometry.by_w[k]
    delta = given.odometry.increment[k] + (state.s[:, WHEELS] - given.vehicle.wheel) @ by_w.T
    by_pose, by_delta = se2.compose_jacobians(state.X, delta)
    D, D_by_delta, D_by_s = _of_camera(delta, state.s)
    M_by_D, M_by_M = se2.between_jacobians(D[:, None], state.M)
    M_by_D = M_by_D.reshape(len(D), -1, 3)
    L = np.zeros(state.P.shape[:2] + (3,))
    L[:, :3] = by_delta
    L[:, FIXED:] = M_by_D @ D_by_delta
    F = _joined(np.zeros((len(D), FIXED, FIXED)) + np.eye(FIXED), M_by_M)
    F[:, :3, :3] = by_pose
    F[:, :, 3:6] += L @ by_w
    F[:, FIXED:, 6:FIXED] += M_by_D @ D_by_s
    M_now = F[:, FIXED:]
    M_before = np.eye(F.shape[1])[FIXED:]
    F = np.concatenate([F, M_now - memory[:, None, None] * M_before], axis=1)
    L = np.concatenate([L, L[:, FIXED:]], axis=1)
    M = se2.between(D[:, None], state.M)
    error = se2.difference(state.z, state.M)
    return state._replace(
        X=se2.compose(state.X, delta), M=M, expected=M + memory[:, None, None] * error,
        memory=memory, P=F @ state.P @ F.mT + L @ Q[k] @ L.mT)


def _of_camera(delta, s):
    """Motion D (h, 3) of the camera in its own axes, and derivatives by Delta and by [c, size]."""
    camera = s[:, CAMERA]
    size = s[:, SIZE:, None]
    moved = se2.compose(delta, camera)
    D = se2.between(camera, moved)
    moved_by_delta, moved_by_camera = se2.compose_jacobians(delta, camera)
    D_by_camera, D_by_moved = se2.between_jacobians(camera, moved)
    by_camera = D_by_camera + D_by_moved @ moved_by_camera
    by_size = -D[..., None] / size
    scale = np.concatenate([1 / size, 1 / size, np.ones_like(size)], axis=1)
    by_size[:, 2] = 0.0
    by_s = scale * np.concatenate([by_camera, by_size], axis=2)
    return D * scale[..., 0], scale * (D_by_moved @ moved_by_delta), by_s


def _updated(state, s, sighted):
    """The _State after a frame, with the rows `sighted` of Sightings."""
    known = state.marker[:, None] == s.marker[sighted]
    old, seen = known.nonzero()
    row = sighted[seen]
    v = se2.difference(s.z[row], state.expected[:, old])
    H = _rows(old + len(state.marker))
    C = (1 - state.memory[:, None, None, None]**2) * s.C[row]         # of the new part of errors
    S = state.P[:, H[:, :, None], H[:, None]] + C                     # of each sighting alone
    squared = se2.squared_norms(v, S)
    accepted = state.weight @ (squared < GATE) >= 0.5
    corrected = _corrected(state, old[accepted], v[:, accepted], C[:, accepted])
    # No filter gains by a rejection, but one that predicts the sighting nevertheless.
    density = squared + np.linalg.slogdet(S)[1]
    wrong = GATE + np.linalg.slogdet(s.C[row])[1]
    loss = np.minimum(density, wrong)[:, ~accepted]
    added = sighted[~known.any(axis=0)]
    sightings = np.append(row[accepted], added)
    new = np.broadcast_to(s.z[added], (len(v), len(added), 3))
    return corrected._replace(
        marker=s.marker[sightings], z=s.z[sightings],
        M=np.concatenate([corrected.M, new], axis=1), P=_joined(corrected.P, s.C[added]),
        log_density=corrected.log_density - np.sum(loss, axis=1) / 2,
        rejected=state.rejected + loss.shape[1])


def _corrected(state, old, v, C):
    """The _State of only the markers `old` (k,) after an update by their innovations (h, k, 3)."""
    v = v.reshape(len(v), -1, 1)
    H = _rows(old + len(state.marker)).ravel()
    kept = np.append(np.arange(FIXED), _rows(old))
    HP = state.P[:, H[:, None], kept]
    S = state.P[:, H[:, None], H] + _joined(np.zeros((len(v), 0, 0)), C)
    weighted = np.linalg.solve(S, np.concatenate([HP, v], axis=2))    # S^-1 [H P', v]
    K = weighted[..., :-1].mT
    change = (K @ v)[..., 0]
    P = state.P[:, kept[:, None], kept] - K @ HP
    squared = np.sum(v * weighted[..., -1:], axis=(1, 2)) + np.linalg.slogdet(S)[1]
    return state._replace(
        X=state.X + change[:, :3], s=state.s + change[:, SHARED],
        M=state.M[:, old] + change[:, FIXED:].reshape(len(v), -1, 3), P=(P + P.mT) / 2,
        log_density=state.log_density - squared / 2)


def _rows(marker):
    """Rows (k, 3) of P of markers, the first ones of M, then those of the expected sightings."""
    return FIXED + 3 * marker[:, None] + np.arange(3)


def _joined(P, C):
    """The block-diagonal matrices (h, n + 3k, n + 3k) of P (h, n, n) and C (..., k, 3, 3)."""
    count, n = P.shape[:2]
    rows = n + np.arange(3 * C.shape[-3]).reshape(-1, 3)
    joined = np.zeros((count, n + rows.size, n + rows.size))
    joined[:, :n, :n] = P
    joined[:, rows[:, :, None], rows[:, None]] = C
    return joined


def _poses_from_frames(given, slip, X, s, P):
    """All poses (n, 3) and covariances, by odometry from the last frame before each."""
    pose = np.arange(len(given.dataset.ticks))
    frame = given.sightings.frame
    last = np.searchsorted(frame, pose, side="right") - 1
    odometry = _odometry(given.dataset.ticks, given.vehicle, given.jumps, frame[last], pose)
    w = s[last, WHEELS] - given.vehicle.wheel
    delta = odometry.increment + np.matvec(odometry.by_w, w)
    A, B = se2.compose_jacobians(X[last], delta)
    F = np.concatenate([A, B @ odometry.by_w], axis=2)
    by_frame = F @ P[last, :6, :6] @ F.mT
    by_odometry = B @ odometry.noise(slip[last, None])[:, 0] @ B.mT
    return se2.compose(X[last], delta), by_frame + by_odometry
