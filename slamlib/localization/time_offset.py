"""How many poses the sightings are late against the encoder, from increments by both.

If the pose ids of all sightings are too large by L poses, the increment by markers between frames
is that of odometry between the same frames L poses earlier. A robust cost over whole poses gives a
first value. Then the difference of both increments is linear in L and the wheel parameters w. With
the increment Delta_o(t) by odometry from pose t to the next frame and the noise e it is

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

SHIFTS = np.arange(-40, 41)             # poses, offsets that are looked for
DECISIVE = 10.0                         # log odds by which one of them must be better than none
START_SLIP = 1e-2                       # sqrt(m), slip that the robust cost assumes
SLIPS = np.geomspace(1e-4, 3e-2, 6)     # sqrt(m), of which the most likely one is taken
SIGMA_WHEEL = 0.02                      # relative, prior of the wheel parameters, not table 2's
SIGMA_OFFSET = 100.0                    # poses, prior of the offset
SMOOTHING = 0.25, 1.0, 4.0              # intervals of frames, to both sides, of mean velocities
MIN_SIGNAL = 0.5                        # share of dDelta_o/dt that is no noise of odometry
ITERATIONS = 4                          # each at the offset, in whole poses, of the one before


def time_offset(dataset, sightings, found):
    """Poses by which the sightings are late (negative: early), its standard deviation, the slip.

    From a Dataset, its Sightings and the MarkerIncrements `found` between consecutive frames. The
    standard deviation is infinite where no offset within SHIFTS can be seen. The slip in sqrt(m) is
    the most likely of SLIPS, scaled as the noise.
    """
    noise = _noise(dataset, sightings.frame)
    shared = _shared_covariances(sightings, found)
    C = np.where(found.usable[:, None, None], found.covariance, np.eye(3)) + noise[0]
    half = [max(1, int(round(each * np.median(np.diff(sightings.frame))))) for each in SMOOTHING]
    slip = START_SLIP
    late = -float(_best_shift(dataset, sightings, found, C + slip**2 * noise[1]))
    for iteration in range(ITERATIONS):
        shift = -int(round(late))
        y, A = _linear_model(dataset, sightings, found, shift, half)
        good = found.usable & _without_outliers(y, C + slip**2 * noise[1], found.usable)
        fits = [_whitened(y, A, C + s**2 * noise[1], shared, good) for s in SLIPS]
        (_, factor, white), slip = max(zip(fits, SLIPS), key=lambda fit: fit[0][0])
        Q = noise[0] + max(slip, increments.TYPICAL_SLIP)**2 * noise[1]
        W = np.linalg.inv(C + slip**2 * noise[1])[good]
        possible = [k for k in range(len(half)) if _noise_share(
            A[good, :, k], W, Q[good], half[k], sightings) < 1 - MIN_SIGNAL]
        if not possible:
            return 0.0, np.inf, slip * np.sqrt(factor)
        sigma, x = min(_offset(white, k) for k in possible)
        late, sigma = x - shift, sigma * np.sqrt(max(factor, 1))
        if abs(late) > SHIFTS[-1]:
            return 0.0, np.inf, slip * np.sqrt(factor)
        if iteration > 0 and -int(round(late)) == shift:
            break
    return late, sigma, slip * np.sqrt(factor)


def _best_shift(dataset, sightings, found, W):
    """By how many poses odometry must be later to fit best, 0 if not decided, by a robust cost.

    It is Cauchy's, of the squared Mahalanobis distances of increments with covariances W (l, 3, 3).
    """
    poses = odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc")
    t = np.clip(sightings.frame + SHIFTS[:, None], 0, len(poses) - 1)
    r = found.increment - se2.between(poses[t[:, :-1]], poses[t[:, 1:]])
    r = r[:, found.usable]
    r[..., 2] = se2.wrap(r[..., 2])
    root = np.linalg.cholesky(np.linalg.inv(W[found.usable]))
    white = np.einsum("kni,nij->knj", r, root)
    cost = GATE / 2 * np.log1p(np.sum(white**2, axis=2) / GATE).sum(axis=1)
    best = SHIFTS[cost.argmin()]
    return best if cost[SHIFTS == 0] - cost.min() > DECISIVE else 0


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
    travelled = odometry.cumulative(odometry.steps(dataset.ticks, dataset.vehicle)[0])
    velocity = np.stack([_velocity(poses[:, 2], travelled, t, each) for each in half], -1)
    by_time = by_start @ velocity[:-1] + by_end @ velocity[1:]
    by_wheel = (by_start @ by_w[t[:-1]] + by_end @ by_w[t[1:]]) * (
        SIGMA_WHEEL * dataset.vehicle.wheel)
    y = np.where(found.usable[:, None], found.increment, 0) - se2.between(
        poses[t[:-1]], poses[t[1:]])
    y[:, 2] = se2.wrap(y[:, 2])
    return y, np.concatenate([-by_time, by_wheel], axis=2)


def _velocity(heading, travelled, t, half):
    """Velocities (f, 3) in world axes, m and rad per pose, at the poses t (f,).

    The speed and turn rate are means over `half` poses to both sides, from the headings and the
    travelled distances (n,); the direction is that of the heading.
    """
    earlier, later = np.clip(t - half, 0, len(heading) - 1), np.clip(t + half, 0, len(heading) - 1)
    steps = np.maximum(later - earlier, 1)
    speed = (travelled[later] - travelled[earlier]) / steps
    turn_rate = (heading[later] - heading[earlier]) / steps
    return np.stack([speed * np.cos(heading[t]), speed * np.sin(heading[t]), turn_rate], -1)


def _without_outliers(y, C, usable):
    """Mask (l,) of differences y (l, 3) within GATE of zero, C (l, 3, 3) scaled to their median."""
    squared = np.einsum("ni,ni->n", y, np.linalg.solve(C, y[..., None])[..., 0])
    return squared < GATE * max(1, np.median(squared[usable]) / 2.37)   # 2.37: chi-squared, 3 dof


def _whitened(y, A, C, shared, good):
    """Log likelihood, factor of the noise and the whitened columns [A, y], (3l, h + 4).

    The noise of y (l, 3) has the covariances C (l, 3, 3), those with the next row `shared`
    (l, 3, 3), times the factor. Rows that are not `good` (l,) are left out. The likelihood is of
    the widest smoothing of the derivatives A (l, 3, h + 3), up to a constant.
    """
    pairs = good & np.append(good[1:], False)
    columns = np.concatenate([A, y[..., None]], axis=2) * good[:, None, None]
    columns = columns.reshape(-1, columns.shape[2])
    try:
        L = cholesky_banded(_banded(C, shared * pairs[:, None, None]), lower=True)
    except np.linalg.LinAlgError:        # shared errors larger than all errors: not this slip
        return -np.inf, 1.0, columns
    white = solve_banded((5, 0), L, columns)
    B, count = white[:, -5:-1], max(3 * np.count_nonzero(good), 1)
    r = white[:, -1] - B @ np.linalg.solve(_information(B), B.T @ white[:, -1])
    factor = max(r @ r / count, 1e-12)
    log_determinant = np.sum(np.log(L[0].reshape(-1, 3))[good])
    return -count / 2 * np.log(factor) - log_determinant, factor, white


def _information(B):
    """Information (4, 4) of L and w / sigma_w with their prior, from whitened columns (3l, 4)."""
    return B.T @ B + np.diag([SIGMA_OFFSET**-2, 1, 1, 1])


def _offset(white, k):
    """Standard deviation and value of L in poses, from whitened columns and smoothing number k."""
    B = white[:, [k, -4, -3, -2]]
    C = np.linalg.inv(_information(B))
    return np.sqrt(C[0, 0]), (C @ B.T @ white[:, -1])[0]


def _noise_share(by_time, W, Q, half, sightings):
    """Share of the squared derivatives by_time (m, 3), weighted by W (m, 3, 3), that is noise.

    The derivative is the difference of mean velocities over `half` poses to both sides of two
    frames. Q (m, 3, 3) is the noise of odometry between the frames.
    """
    steps = np.median(np.diff(sightings.frame))
    of_noise = Q * min(1, 2 * half / steps) / (2 * half**2)
    signal = np.einsum("ni,nij,nj", by_time, W, by_time)
    return np.einsum("nij,nji", W, of_noise) / signal if signal > 0 else 1.0


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
