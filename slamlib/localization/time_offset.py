"""How many poses the sightings are late against the encoder, from increments by both.

If the pose ids of all sightings are too large by L poses, the increment by markers between frames
is that of odometry between the same frames L poses earlier. With the increment Delta_o(t) by
odometry from pose t to the next frame, its derivative by the time t and by the wheel parameters w,
the difference of both increments is linear in L and w:

    Delta_m - Delta_o = -L dDelta_o/dt + dDelta_o/dw (w - w_0) + e.

Only a change of speed or of turn rate shows an offset: at constant velocity dDelta_o/dt is zero.
Generalized least squares estimates L and w from all increments of the drive jointly. The noise e
has the covariance of the wheels' slip, of the rounding of counts and of the sightings. Consecutive
increments share the sightings of the frame between them with opposite sign, so the covariance of e
is block tridiagonal, and errors of sightings cancel over long distances. It is a banded matrix,
whose Cholesky factor takes milliseconds.
"""

import numpy as np
from scipy.linalg import cholesky_banded, solve_banded

from slamlib import increments, odometry, se2
from slamlib.sightings import GATE

SLIPS = np.geomspace(1e-4, 3e-2, 6)     # sqrt(m), of which the most likely one is taken
SIGMA_WHEEL = 0.02                      # relative, prior of the wheel parameters, not table 2's
SIGMA_OFFSET = 100.0                    # poses, prior of the offset
SMOOTHING = 0.25, 1.0, 4.0              # intervals of frames, to both sides, of mean velocities
MIN_SIGNAL = 0.5                        # share of dDelta_o/dt that is no noise of odometry
ITERATIONS = 4                          # each at the offset, in whole poses, of the one before


def time_offset(dataset, sightings, found):
    """Poses by which the sightings are late (negative: early), its standard deviation, the slip.

    From a Dataset, its Sightings and the MarkerIncrements `found` between consecutive frames. The
    slip in sqrt(m) is the most likely of SLIPS, scaled as the noise. With a large slip, velocities
    by odometry are too noisy to show an offset, and its standard deviation is too small. Of
    SMOOTHING, the most likely one is taken; if dDelta_o/dt is mostly noise with it, the standard
    deviation is SIGMA_OFFSET.
    """
    noise = _noise(dataset, sightings.frame)
    shared = _shared_covariances(sightings, found)
    interval = np.median(np.diff(sightings.frame))
    half = [max(1, int(round(each * interval))) for each in SMOOTHING]
    late, slip = 0.0, 1e-2
    for iteration in range(ITERATIONS):
        shift = -int(round(late))
        y, A = _linear_model(dataset, sightings, found, shift, half)
        C = np.where(found.usable[:, None, None], found.covariance, np.eye(3)) + noise[0]
        good = found.usable & _without_outliers(y, C + slip**2 * noise[1], found.usable)
        fits = [_generalized_least_squares(y, A, C + s**2 * noise[1], shared, good) for s in SLIPS]
        (_, k, x, sigma, factor), slip = max(zip(fits, SLIPS))
        late = float(np.clip(x - shift, -SIGMA_OFFSET, SIGMA_OFFSET))
        if iteration > 0 and -int(round(late)) == shift:
            break
    Q = (noise[0] + slip**2 * noise[1])[good]
    of_noise = Q * min(1, 2 * half[k] / interval) / (2 * half[k]**2)
    W = np.linalg.inv(C[good] + slip**2 * noise[1][good])
    by_time = A[good, :, k]
    signal = np.einsum("ni,nij,nj", by_time, W, by_time)
    if np.einsum("nij,nji", W, of_noise) > (1 - MIN_SIGNAL) * signal:
        sigma = SIGMA_OFFSET
    return late, sigma, slip * np.sqrt(factor)


def _noise(dataset, frame):
    """Covariances (l, 3, 3) of odometry's increments by rounding, and by a slip of 1 sqrt(m)."""
    args = dataset.ticks, dataset.vehicle, frame[:-1], frame[1:]
    rounding = increments.noise(*args, 0.0)
    return rounding, increments.noise(*args, 1.0) - rounding


def _shared_covariances(sightings, found):
    """Covariances (l, 3, 3) of every increment with the next, by the sightings that both use."""
    first_use = np.full(len(sightings.z), -1)
    first_use[found.first[found.accepted]] = np.flatnonzero(found.accepted)
    i = np.flatnonzero(found.accepted)
    j = first_use[found.second[i]]
    i, j = i[j >= 0], j[j >= 0]
    shared = np.zeros((len(found.increment), 3, 3))
    np.add.at(shared, found.pair[i], found.by_second[i] @ sightings.C[found.second[i]]
              @ np.swapaxes(found.by_first[j], 1, 2))
    return shared


def _linear_model(dataset, sightings, found, shift, half):
    """Differences y (l, 3) of increments and their derivatives A (l, 3, h + 3) by [L, w / sigma_w].

    Odometry is taken `shift` poses later than the frames. The derivatives by L are of velocities
    that are averaged over each of h numbers of poses, `half`, to both sides.
    """
    poses = odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc")
    by_w = odometry.wheel_jacobian(dataset.ticks, dataset.vehicle, model="arc")
    frame, last = sightings.frame, len(poses) - 1
    t = np.clip(frame + shift, 0, last)
    by_start, by_end = se2.between_jacobians(poses[t[:-1]], poses[t[1:]])
    velocity = np.stack([_velocity(poses, t, each) for each in half], -1)
    by_time = by_start @ velocity[:-1] + by_end @ velocity[1:]
    by_wheel = (by_start @ by_w[t[:-1]] + by_end @ by_w[t[1:]]) * (
        SIGMA_WHEEL * dataset.vehicle.wheel)
    y = np.where(found.usable[:, None], found.increment, 0) - se2.between(
        poses[t[:-1]], poses[t[1:]])
    y[:, 2] = se2.wrap(y[:, 2])
    return y, np.concatenate([-by_time, by_wheel], axis=2)


def _velocity(poses, t, half):
    """Mean velocities (f, 3) in world axes, per pose, at poses t (f,), over `half` to both sides.

    The direction of motion is that of the heading.
    """
    earlier, later = np.clip(t - half, 0, len(poses) - 1), np.clip(t + half, 0, len(poses) - 1)
    moved = se2.between(poses[earlier], poses[later]) / np.maximum(later - earlier, 1)[:, None]
    speed = np.copysign(np.hypot(moved[:, 0], moved[:, 1]), moved[:, 0])
    heading = poses[t, 2]
    return np.stack([speed * np.cos(heading), speed * np.sin(heading), moved[:, 2]], -1)


def _without_outliers(y, C, usable):
    """Mask (l,) of differences y (l, 3) within GATE of zero, C (l, 3, 3) scaled to their median."""
    squared = np.einsum("ni,ni->n", y, np.linalg.solve(C, y[..., None])[..., 0])
    return squared < GATE * max(1, np.median(squared[usable]) / 2.37)   # 2.37: chi-squared, 3 dof


def _generalized_least_squares(y, A, C, shared, good):
    """The most likely fit of L and w to y (l, 3), with one of the derivatives by L in A.

    The noise of y has the covariances C (l, 3, 3), those with the next row `shared` (l, 3, 3),
    times a common factor, which is estimated. Rows that are not `good` (l,) are left out.

    Returns
    -------
    log_likelihood : up to a constant.
    k : column of A (l, 3, h + 3) that is the derivative by L.
    x, sigma : L and its standard deviation, in poses.
    factor : of the covariances.
    """
    pairs = good & np.append(good[1:], False)
    try:
        L = cholesky_banded(_banded(C, shared * pairs[:, None, None]), lower=True)
    except np.linalg.LinAlgError:        # shared errors larger than all errors: not this slip
        return -np.inf, 0, 0.0, SIGMA_OFFSET, 1.0
    columns = np.concatenate([A, y[..., None]], axis=2) * good[:, None, None]
    white = solve_banded((5, 0), L, columns.reshape(-1, columns.shape[2]))
    count = max(3 * np.count_nonzero(good), 1)
    log_determinant = np.sum(np.log(L[0].reshape(-1, 3))[good])
    fits = []
    for k in range(A.shape[2] - 3):
        B = white[:, [k, -4, -3, -2]]
        H = B.T @ B + np.diag([SIGMA_OFFSET**-2, 1, 1, 1])
        x = np.linalg.solve(H, B.T @ white[:, -1])
        factor = max(np.sum((white[:, -1] - B @ x)**2) / count, 1e-12)
        fits.append((-count / 2 * np.log(factor) - log_determinant, k, x[0],
                     np.sqrt(np.linalg.inv(H)[0, 0] * max(factor, 1)), factor))
    return max(fits)


def _banded(diagonal, next_block):
    """The symmetric block tridiagonal matrix as the six lower diagonals that scipy expects.

    `diagonal` (l, 3, 3) are its blocks [k, k] and `next_block` (l, 3, 3) its blocks [k, k + 1]; the
    last of them is not used.
    """
    lower = np.zeros((6, 3 * len(diagonal)))
    for i in range(3):
        for j in range(3):
            if i >= j:
                lower[i - j, j::3] = diagonal[:, i, j]
            lower[3 + i - j, j:-3:3] = next_block[:-1, j, i]
    return lower
