"""Problem 2, odometry and markers fused by Kalman filters whose state contains the shared errors.

The state contains the pose X, the shared parameters (how far the wheels w = [R_R, R_L, b] are off
the stated ones, and the camera c) and the markers M_j of the last frames, in the camera, with
covariance P (Smith, Self and Cheeseman, Estimating Uncertain Spatial Relationships in Robotics,
1990). Odometry predicts

    X' = X Delta(w),    M'_j = D^-1 M_j,    D = c^-1 Delta(w) c,    w' = w,    c' = c,
    P' = F P F^T + L Q L^T,

with Delta(w) = Delta(0) + dDelta/dw w, F and L the derivatives of the new state by the old one and
by Delta, and Q the noise of Delta (`increments.noise_in_drive`). The sightings Z of the new frame,
with covariance C, measure these markers, M' = H state, and update

    state <- state + K (Z - M'),    P <- P' - K H P',    K = P' H^T S^-1,    S = H P' H^T + C.

Sightings beyond GATE are rejected. Then the filter removes rejected markers and those without a
sighting in MAX_PAUSE frames, and adds new ones with covariance C. A marker that is missed in a few
frames stays: as a new one it would lose what is known of it. Returns to a place are not used,
unless within these frames. Without markers the result is the first-order propagation of
odometry; with uninformative odometry and one marker it is `localize`.

Errors of a marker in successive frames are alike, with the correlation `memory`. The last sighting
tells the last error, so what is expected and measured is Z = M' + memory (Z_last - M), with the
covariance (1 - memory^2) C of the new part of the error (Bryson and Henrikson, Estimation using
sampled data containing sequentially correlated noise, 1968). For a marker that is missed the state
has, in place of Z_last, the Z that is expected.

Nobody states the slip. So several filters run side by side, each with its slip, and the likeliest
by its innovations is taken (multiple models: Bar-Shalom, Li and Kirubarajan 2001, section 11.6).
Stretches of the drive tell in advance which slips are tried, the memory, and the factor on the
standard deviations of the sightings; the whole drive, whether the camera is elsewhere than stated.
Beside slow errors, or larger ones than stated, no slip below the typical one is tried, as in the
graph. The size of the markers is as stated. With the slip that was learned, smaller jumps show than
before; they are believed if the likeliest filter, near them, is likelier with them.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from slamlib.core import increments, se2
from slamlib.core.errors import require
from slamlib.core.hint import Fusion
from slamlib.core.increments import SLIP_BOUNDS, SLIP_FACTOR, TYPICAL_SLIP
from slamlib.core.records import NO_SIGHTINGS, Dataset
from slamlib.core.sightings import GATE, sightings_by_frame
from slamlib.robust.calibration import stated_calibration
from slamlib.robust.error_memory import MAX_PAUSE
from slamlib.robust.jumps import (
    NO_JUMPS,
    Jumps,
    crawls,
    creep_covariance,
    find_jumps,
    most_together,
    with_overlooked,
)
from slamlib.robust.part_faults import camera_bump, constant_delay, with_counts_mended

SLIPS = TYPICAL_SLIP * SLIP_FACTOR ** np.arange(-1.0, 4.0)     # sqrt(m), of the first filters
FINE_STEPS = 1.4 ** np.arange(-2.0, 3.0)     # slips of the last filters, over the likeliest one
MEMORIES = (0.0, 0.6, 0.9, 0.95)            # correlations of successive errors of a marker
FACTORS = (1.0, 3.0, 9.0)    # on the standard deviations of the sightings
STRETCHES = 10               # of the drive, in which the first filters run
STRETCH_FRAMES = 20          # at most, of each
MAX_ENTRIES = 5e7            # of the covariances of all filters that run side by side
PRICE = 6.0                  # log density by which errors have memory, and by which the camera errs
MIN_JUMP_GAIN = 10.0         # log likelihood by each of many jumps; the loss by each of a few
MIN_REJECTED = 2             # number of sightings together, near which more jumps are sought
# Rows of covariances; those of the markers follow
POSE = slice(0, 3)
WHEELS = slice(3, 6)
CAMERA = slice(6, 9)
SHARED = slice(3, 9)         # both


@dataclass(frozen=True)
class LearnedFusion(Fusion):
    """A Fusion, with what the likeliest filter assumed, and what it estimated at the last frame."""

    slip: float                      # sqrt(m), given or learned
    wheel: np.ndarray                # (3,) m, R_R, R_L, b
    wheel_covariance: np.ndarray     # (3, 3) m^2
    memory: float                    # correlation of the errors of a marker in successive frames
    factor: float                    # on the standard deviations of the sightings
    camera: np.ndarray               # (3,) m and rad, x, y, turn
    jumps: Jumps                     # without whose counts it does


@dataclass(frozen=True)
class _Odometry:
    """Increments by odometry between m pairs of poses."""

    increment: np.ndarray        # (m, 3) Delta by the stated wheels
    by_w: np.ndarray             # (m, 3, 3) dDelta/dw
    rounding: np.ndarray         # (m, 3, 3) Q without slip
    slipping: np.ndarray         # (m, 3, 3) what a slip of 1 sqrt(m) adds to Q

    def delta(self, k, w):
        """Delta (..., 3) of increments k by wheels that are off by w (..., 3)."""
        return self.increment[k] + np.matvec(self.by_w[k], w)

    def noise(self, k, slip):
        """Q (..., 3, 3) of increments k by slips (...) in sqrt(m)."""
        variance = np.square(slip)[..., None, None]
        return self.rounding[k] + variance * self.slipping[k]


class _Models(NamedTuple):
    """What h filters assume."""

    slip: np.ndarray             # (h,) sqrt(m)
    memory: np.ndarray           # (h,) correlation of successive errors of a marker
    elsewhere: np.ndarray        # (h,) True if the camera may be elsewhere than stated
    factor: np.ndarray           # (h,) on the standard deviations of the sightings

    def log_prior(self):
        """Logarithm (h,) of their prior density, up to a constant."""
        slip = np.maximum(self.slip, SLIP_BOUNDS[0])
        off = np.log(slip / TYPICAL_SLIP) / np.log(SLIP_FACTOR)
        surprises = self.elsewhere + (self.memory > 0)
        return -(off**2 + np.log2(self.factor)**2) / 2 - PRICE * surprises


class _State(NamedTuple):        # four are made at a frame: faster than frozen dataclasses
    """h filters at a frame, and the m markers that they keep, of which the first u are not in view.

    A predicted state has X, w, c, the markers and the expected sightings of all of them.
    """

    x: np.ndarray                # (h, 3 + u + m, 3) X, w, c, expected sightings (u), and M
    P: np.ndarray                # (h, 9 + 3u + 3m, 9 + 3u + 3m) covariance of x
    marker: np.ndarray           # (m,) ids of the markers
    row: np.ndarray              # (m,) numbers of the frames of their last sightings
    z: np.ndarray                # (m - u, 3) sightings of the markers in view
    log_density: np.ndarray      # (h,) of the innovations so far and the prior, up to a constant
    rejected: int = 0            # number of sightings so far beyond the gate

    @property
    def likeliest(self):
        """Number of the likeliest filter."""
        return np.argmax(self.log_density)


def fuse(dataset: Dataset, slip: float | None = None) -> LearnedFusion:
    """LearnedFusion of a Dataset's odometry and markers for problem 2, with correct shared errors.

    `slip` in sqrt(m) is the standard deviation of the slip of one wheel after 1 m; None takes that
    of the dataset's Vehicle or, if it has none, what the innovations say of it. A
    marker_noise_factor of the Vehicle multiplies the standard deviations of the sightings.
    Increments are exact arcs. Without markers the result is the first-order propagation of odometry
    with the noise of slip. Raises DatasetError for a slip beyond its limits.

    >>> from slamlib.studies.simulation import simulate
    >>> dataset, truth = simulate("short", seed=1)
    >>> fuse(dataset, slip=1e-3).poses.shape
    (2000, 3)
    """
    require(isinstance(dataset, Dataset), "fuse", "a Dataset", dataset)
    dataset = dataset.stating({"slip": slip}, "fuse")
    dataset = _with_delay_mended(with_counts_mended(dataset))
    slip = dataset.vehicle.slip
    dataset = _with_camera_mended(dataset, slip or TYPICAL_SLIP)
    jumps = _believed_jumps(dataset, slip or TYPICAL_SLIP)
    models = _learned_models(dataset, jumps, slip)
    jumps, states = _with_more_jumps(dataset, jumps, models)
    last = states[-1]
    best = last.likeliest
    slip = models.slip[best]
    x = np.array([state.x[best, :3] for state in states])
    P = np.array([state.P[best, :9, :9] for state in states])
    sightings = _sightings(dataset)
    poses, covariances = _poses_from_frames(dataset, jumps, sightings.frame, slip, x, P)
    aruco = dataset.aruco or NO_SIGHTINGS
    repeated = len(aruco.pose) - len(sightings.row)
    return LearnedFusion(
        poses=poses,
        covariances=covariances,
        rejected=last.rejected + repeated,
        slip=float(slip),
        wheel=dataset.vehicle.wheel + x[-1, 1],
        wheel_covariance=P[-1, WHEELS, WHEELS],
        memory=float(models.memory[best]),
        factor=float(models.factor[best]),
        camera=x[-1, 2],
        jumps=jumps)


def _believed_jumps(dataset, slip):
    """The Jumps of a Dataset, or NO_JUMPS if these are likelier."""
    found = find_jumps(dataset)
    count = len(found.start)
    if count == 0:
        return NO_JUMPS
    gain = _log_density(dataset, found, slip) - _log_density(dataset, NO_JUMPS, slip)
    least = MIN_JUMP_GAIN * count
    if found.are_few:
        least = -least
    return found if gain >= least else NO_JUMPS


def _with_more_jumps(dataset, jumps, models):
    """The Jumps, with those that show by the slip that was learned if they are likelier.

    Also the _State of filters with these _Models after each frame. None is sought where no
    sightings are rejected together, or something may have moved the camera, which may look like a
    jump.
    """
    states = _filter(dataset, jumps, models)
    rejected = np.diff([state.rejected for state in states], prepend=0)
    are_together = most_together(rejected) >= MIN_REJECTED
    if not are_together or camera_bump(dataset) is not None:
        return jumps, states
    best = states[-1].likeliest
    likeliest = _Models(*[field[[best]] for field in models])
    for more in with_overlooked(dataset, jumps, models.slip[best]):
        near = _near(dataset, more.start)
        gain = _log_densities(near, more, likeliest) - _log_densities(near, jumps, likeliest)
        if gain >= MIN_JUMP_GAIN * (len(more.start) - len(jumps.start)):
            return more, _filter(dataset, more, models)
    return jumps, states


def _near(dataset, poses):
    """The Dataset with sightings at most STRETCH_FRAMES frames from encoder poses (m,) only."""
    aruco = dataset.aruco
    frame = np.unique(aruco.pose)
    number = np.searchsorted(frame, aruco.pose)
    off = number[:, None] - np.searchsorted(frame, poses)
    is_near = (np.abs(off) <= STRETCH_FRAMES).any(axis=1)
    return replace(dataset, aruco=aruco.select(is_near))


def _with_delay_mended(dataset):
    """The Dataset whose Vehicle has the delay at which its sightings agree best with the wheels."""
    steps = constant_delay(dataset)
    if steps == 0:                                       # of the same Dataset jumps are known
        return dataset
    lag = dataset.vehicle.sighting_lag + steps
    return replace(dataset, vehicle=replace(dataset.vehicle, sighting_lag=lag))


def _with_camera_mended(dataset, slip):
    """The Dataset with its sightings as of a camera that nothing moved, if that is likelier."""
    bump = camera_bump(dataset)
    if bump is None:
        return dataset
    there = bump.mended(dataset)
    gain = _log_density(there, find_jumps(there), slip) - _log_density(
        dataset, find_jumps(dataset), slip)
    return there if gain >= MIN_JUMP_GAIN else dataset


def _log_density(dataset, jumps, slip):
    """Log density of all innovations of a filter with a slip, up to a constant."""
    return _log_densities(dataset, jumps, _all_models([slip], [0.0], [False], [1.0]))[0]


def _log_densities(dataset, jumps, models):
    """Log densities (h,) of all innovations of filters with these _Models, up to a constant.

    Where many markers are kept at once, fewer filters run side by side, or memory would not do.
    """
    sightings = _sightings(dataset)
    in_spans = np.stack([sightings.row // MAX_PAUSE, sightings.marker], axis=1)
    span = np.unique(in_spans, axis=0)[:, 0]             # of MAX_PAUSE frames, of each marker there
    most = 2 * np.bincount(span, minlength=1).max()
    rows = 9 + 6 * most                                  # of the largest covariance of a filter
    at_once = max(1, int(MAX_ENTRIES / rows**2))
    found = []
    for k in range(0, len(models.slip), at_once):
        part = _Models(*[field[k:k + at_once] for field in models])
        found.append(_filter(dataset, jumps, part)[-1].log_density)
    return np.concatenate(found)


def _learned_models(dataset, jumps, slip):
    """The _Models of the last filters, by the likeliest one in stretches of the drive.

    That one estimates the camera. Stretches say little of it, so the last filters have it both
    elsewhere and as stated.
    """
    tried = SLIPS if slip is None else [slip]
    factors = FACTORS if dataset.vehicle.marker_noise_factor is None else [1.0]
    models = _all_models(tried, MEMORIES, [True], factors)
    likeliest = _log_densities(_stretches(dataset), jumps, models).argmax()
    best = _Models(*[field[likeliest] for field in models])
    slips = tried
    if slip is None:
        are_poor = best.memory > 0 or best.factor > 1    # errors of the sightings
        least = TYPICAL_SLIP if are_poor else SLIP_BOUNDS[0]
        slips = np.unique(np.clip(best.slip * FINE_STEPS, least, SLIP_BOUNDS[1]))
    return _all_models(slips, [best.memory], [False, True], [best.factor])


def _all_models(slips, memories, elsewhere, factors):
    """_Models of all combinations of these, each a sequence."""
    combinations = np.meshgrid(slips, memories, elsewhere, factors)
    return _Models(*[each.ravel() for each in combinations])


def _stretches(dataset):
    """The Dataset with sightings in some stretches only, which begin after equally many frames."""
    aruco = dataset.aruco
    if aruco is None:
        return dataset
    frame = np.unique(aruco.pose)
    period = max(STRETCH_FRAMES, len(frame) // STRETCHES)
    number = np.searchsorted(frame, aruco.pose)
    in_stretch = number % period < STRETCH_FRAMES
    return replace(dataset, aruco=aruco.select(in_stretch))


def _sightings(dataset):
    """Sightings of a Dataset, pose 0 among their frames, by the stated lag, size and noise."""
    vehicle = dataset.vehicle
    s = sightings_by_frame(dataset.sightings_in_time, extra_frames=[0])
    length = vehicle.marker_size
    scale = np.array([length, length, 1.0])
    sigma_scale = scale * (vehicle.marker_noise_factor or 1.0)
    return replace(s, z=scale * s.z, C=sigma_scale[:, None] * s.C * sigma_scale)


def _odometry(dataset, jumps, start, end):
    """The _Odometry from poses `start` to `end`, (m,), which is uncertain where it crawls."""
    ticks = dataset.ticks
    vehicle = dataset.vehicle
    increment, by_w = increments.between_poses(ticks, vehicle, start, end, "arc")
    rounding, slipping = increments.noise_in_drive(ticks, vehicle, start, end)
    crawling = crawls(ticks, start, end)
    by_w[crawling] = 0.0
    uncertain = rounding + creep_covariance(increment, crawling)
    jump, unknown = jumps.added(start, end)
    increment = se2.compose(increment, jump)
    return _Odometry(increment, by_w, uncertain + unknown, slipping)


def _filter(dataset, jumps, models):
    """The _State of filters with these _Models after each frame, without their markers."""
    sightings = _sightings(dataset)
    frame = sightings.frame
    odometry = _odometry(dataset, jumps, frame[:-1], frame[1:])
    interval = np.diff(frame)
    usual = np.median(interval) if len(interval) else 1
    memory = models.memory[:, None] ** (1 / usual)
    variance = models.factor[:, None, None, None]**2
    state = _start(dataset.vehicle, models)
    state = _updated(state, sightings, 0, memory, variance)
    states = [_without_markers(state)]
    for k, steps in enumerate(interval):
        Q = odometry.noise(k, models.slip)
        state = _predicted(state, odometry, k, Q, memory**steps)
        state = _updated(state, sightings, k + 1, memory, variance)
        states.append(_without_markers(state))
    return states


def _without_markers(state):
    """The _State of pose and shared parameters alone, which needs less memory."""
    return state._replace(
        x=state.x[:, :3].copy(), P=state.P[:, :9, :9].copy(), marker=state.marker[:0],
        row=state.row[:0], z=state.z[:0])


def _start(vehicle, models):
    """The _State of filters with these _Models at pose 0."""
    calibration = stated_calibration(vehicle, ())
    released = calibration.prior(["camera-offset"]).root
    shared = np.where(models.elsewhere[:, None], np.diag(released), calibration.sigma)
    count = len(shared)
    sigma = np.zeros((count, 9))
    sigma[:, 2] = vehicle.sigma_heading
    sigma[:, 3:] = shared[:, :6]                                     # of wheels and camera
    x = np.zeros((count, 3, 3))
    x[:, 2] = calibration.stated[calibration.group == "camera-offset"]
    return _State(
        x=x,
        P=sigma[:, :, None]**2 * np.eye(9),
        marker=np.zeros(0, int),
        row=np.zeros(0, int),
        z=np.zeros((0, 3)),
        log_density=models.log_prior())


def _predicted(state, odometry, k, Q, memory):
    """The _State after increment k by _Odometry, with noise Q (h, 3, 3) and memory (h, 1)."""
    count = len(memory)
    unseen = len(state.marker) - len(state.z)
    X = state.x[:, 0]
    M = state.x[:, 3 + unseen:]
    delta = odometry.delta(k, state.x[:, 1])
    D, D_by_delta, D_by_camera = _in_camera(delta, state.x[:, 2])
    X_new, by_X, by_delta = se2.compose_with_jacobians(X, delta)
    M_new, M_by_D, M_by_M = se2.between_with_jacobians(D[:, None], M)
    M_by_D = M_by_D.reshape(count, -1, 3)
    M_by_delta = M_by_D @ D_by_delta
    L = np.concatenate([by_delta, np.zeros((count, 6, 3)), M_by_delta, M_by_delta], axis=1)
    by_w = L @ odometry.by_w[k]
    M_by_camera = M_by_D @ D_by_camera
    left = memory[:, :, None]

    def moved(P):
        """F P, with P (h, 9 + 3u + 3m, n)."""
        before = P[:, 9 + 3 * unseen:]                   # of the markers
        error = -before                                  # Z - M, of which only an expected Z varies
        error[:, :3 * unseen] += P[:, 9:9 + 3 * unseen]
        turned = M_by_M @ before.reshape(M.shape + P.shape[2:])
        after = turned.reshape(before.shape) + M_by_camera @ P[:, CAMERA]
        F_P = np.concatenate(
            [by_X @ P[:, POSE], P[:, SHARED], after, after + left * error], axis=1)
        return F_P + by_w @ P[:, WHEELS]

    z = np.tile(state.z, (count, 1, 1))
    last = np.concatenate([state.x[:, 3:3 + unseen], z], axis=1)
    expected = M_new + left * se2.difference(last, M)
    return state._replace(
        x=np.concatenate([X_new[:, None], state.x[:, 1:3], M_new, expected], axis=1),
        P=moved(moved(state.P).mT) + L @ Q @ L.mT)


def _in_camera(delta, camera):
    """D = c^-1 Delta c (h, 3), the motion of the camera, and its derivatives by Delta and c."""
    moved, moved_by_delta, moved_by_camera = se2.compose_with_jacobians(delta, camera)
    D, D_by_camera, D_by_moved = se2.between_with_jacobians(camera, moved)
    by_camera = D_by_camera + D_by_moved @ moved_by_camera
    return D, D_by_moved @ moved_by_delta, by_camera


def _updated(state, sightings, row, memory, variance):
    """The _State after the frame in this row of Sightings: with the markers seen there or lately.

    `memory` (h, 1) is the correlation of errors after an encoder step, and `variance` (h, 1, 1, 1)
    is over that of the sightings.
    """
    seen = np.arange(*np.searchsorted(sightings.row, [row, row + 1]))
    place, number = np.nonzero(sightings.marker[seen, None] == state.marker)
    known = seen[place]
    new = np.delete(seen, place)
    is_unseen = row - state.row < MAX_PAUSE
    is_unseen[number] = False
    unseen = np.flatnonzero(is_unseen)
    steps = sightings.frame[row] - sightings.frame[state.row[number]]
    new_part = 1 - memory ** (2 * steps)
    C = variance * new_part[:, :, None, None] * sightings.C[known]
    state, accepted = _measured(state, unseen, number, sightings.z[known], C)
    z_new = np.tile(sightings.z[new], (len(variance), 1, 1))
    used = np.append(known[accepted], new)
    return state._replace(
        x=np.concatenate([state.x, z_new], axis=1),
        P=_block_diagonal(state.P, variance * sightings.C[new]),
        marker=np.append(state.marker[unseen], sightings.marker[used]),
        row=np.append(state.row[unseen], sightings.row[used]),
        z=sightings.z[used])


def _measured(state, unseen, number, z, C):
    """The predicted _State after sightings z (m, 3) of markers, and which of them it accepts, (m,).

    With covariances C (h, m, 3, 3); it keeps the `unseen` markers and the accepted ones. A sighting
    beyond the gate of the likeliest filter is wrong. It is equally likely by all filters: as one at
    the gate by the least certain.
    """
    count = len(state.marker)
    expected = 3 + count + number
    rows = _rows(expected)
    innovation = se2.difference(z, state.x[:, expected])
    S = state.P[:, rows[:, :, None], rows[:, None]] + C
    squared = se2.squared_norms(innovation, S)
    accepted = squared[state.likeliest] < GATE
    log_determinant = np.linalg.slogdet(S)[1]
    by_certain = squared + log_determinant
    cost_of_wrong = np.minimum(by_certain, GATE + log_determinant.max(axis=0))
    cost = cost_of_wrong[:, ~accepted].sum(axis=1)

    index = np.concatenate(
        [[0, 1, 2], 3 + count + unseen, 3 + unseen, 3 + number[accepted]])
    kept = _rows(index).ravel()
    H = rows[accepted].ravel()
    HP = state.P[:, H[:, None], kept]
    S = state.P[:, H[:, None], H] + _block_diagonal(np.zeros((len(C), 0, 0)), C[:, accepted])
    innovation = innovation[:, accepted].reshape(len(C), -1, 1)
    solved = np.linalg.solve(S, np.concatenate([HP, innovation], axis=2))
    cost += np.sum(innovation * solved[:, :, -1:], axis=(1, 2)) + np.linalg.slogdet(S)[1]
    gain = solved[:, :, :-1].mT
    x = state.x[:, index]
    P = state.P[:, kept[:, None], kept] - gain @ HP
    return state._replace(
        x=x + (gain @ innovation).reshape(x.shape),
        P=(P + P.mT) / 2,
        log_density=state.log_density - cost / 2,
        rejected=state.rejected + np.count_nonzero(~accepted)), accepted


def _rows(index):
    """Rows (m, 3) of a covariance by numbers (m,) of poses and markers."""
    return 3 * index[:, None] + np.arange(3)


def _block_diagonal(P, C):
    """The block-diagonal matrices (h, n + 3k, n + 3k) of P (h, n, n) and C (..., k, 3, 3)."""
    count, n = P.shape[:2]
    rows = n + np.arange(3 * C.shape[-3]).reshape(-1, 3)
    size = n + rows.size
    blocks = np.zeros((count, size, size))
    blocks[:, :n, :n] = P
    blocks[:, rows[:, :, None], rows[:, None]] = C
    return blocks


def _poses_from_frames(dataset, jumps, frame, slip, x, P):
    """All poses (n, 3) and covariances, by odometry from the last frame before each.

    x (f, 3, 3) and P (f, 9, 9) are those after each `frame`.
    """
    pose = np.arange(len(dataset.ticks))
    last = np.searchsorted(frame, pose, side="right") - 1
    odometry = _odometry(dataset, jumps, frame[last], pose)
    X = x[last, 0]
    delta = odometry.delta(pose, x[last, 1])
    poses, by_X, by_delta = se2.compose_with_jacobians(X, delta)
    F = np.concatenate([by_X, by_delta @ odometry.by_w], axis=2)
    Q = odometry.noise(pose, slip)
    by_frame = F @ P[last, :6, :6] @ F.mT
    by_odometry = by_delta @ Q @ by_delta.mT
    return poses, by_frame + by_odometry
