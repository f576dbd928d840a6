"""Problem 2, fused: the odometry between the measured poses, and the markers at them.

`fuse_increments` is the assignment's hint to the letter: at a measured pose the odometry increment
(equation 2 started from zero) and the marker increment since the last fused pose are fused by
information and composed. It weighs each increment as if its errors were new. They are not:
odometry repeats the same errors of the wheel parameters in every increment, and the markers take
back in the next increment what they got wrong in this one. So it trusts the wrong sensor.

`fuse` fuses the same increments and carries along what they share: a Kalman filter over

    the pose X,  the wheel parameters w = [R_R, R_L, b],  and the markers M_j of the last measured
    pose, in its frame.

Odometry predicts X' = X Delta(w) and M'_j = Delta(w)^-1 M_j, the sightings Z'_j measure M'_j; then
markers out of sight are dropped and new ones added. Without markers this is the exact first-order
propagation of odometry. With worthless odometry and one marker in view it is the localization of
`localization.py`; with several it is better, because it remembers how they stand to each other.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from slamlib import odometry, se2
from slamlib.ties import GATE, gather, tie_consecutive

SLIPS = (1e-5, 3e-2)         # sqrt(m), the bounds within which slip is looked for
TYPICAL_SLIP = 1e-3          # sqrt(m), and the factor within which it mostly lies: a wide prior that
SLIP_FACTOR = 10.0           # decides where the data say nothing
LEARNING = 500               # measured poses, the first ones, from which slip is learned


@dataclass(frozen=True)
class Fusion:
    """Every pose of the encoder file, fused with the markers at the measured ones."""

    poses: np.ndarray            # (n, 3) world frame
    covariances: np.ndarray      # (n, 3, 3)
    measured: np.ndarray         # (f,) indices from 0 of the measured poses
    outliers: int                # sightings left out
    slip: float | None = None    # sqrt(m), as given or learned
    wheel: np.ndarray | None = None             # (3,) estimate of R_R, R_L, b after the last pose
    wheel_covariance: np.ndarray | None = None  # (3, 3)


def fuse_increments(dataset, propagation=odometry.equation2):
    """The assignment's hint: increments fused by information, equation 2 restarted at every fusion.

    With Delta_o, C_o the odometry increment since the last fused pose, I_k and covariance started
    from zero, and Delta_m, C_m the marker increment over the same poses,

        Delta = Delta_o + C_o (C_o + C_m)^-1 (Delta_m - Delta_o),   C = (C_o^-1 + C_m^-1)^-1.

    Where markers tie nothing, odometry goes on alone.

    Parameters
    ----------
    dataset : Dataset with markers.
    propagation : odometry.equation2, or odometry.first_order to see whether the correlation of
        position and heading, which equation 2 lacks, makes a difference.

    Returns
    -------
    Fusion
    """
    ticks, vehicle = dataset.ticks, dataset.vehicle
    sightings = gather(dataset.aruco, also=[0])
    frame = sightings.frame
    ties, _, first, second = tie_consecutive(sightings)
    poses, covariances = [np.zeros((1, 3))], [np.diag([0, 0, vehicle.sigma_heading])[None]**2]
    for k, (start, end) in enumerate(zip(frame, np.r_[frame[1:], len(ticks) - 1])):
        driven = ticks[start:end + 1]
        pose, covariance = poses[-1][-1], covariances[-1][-1]
        path, path_covariance = propagation(driven, vehicle, pose, covariance)
        if k < len(frame) - 1 and ties.usable[k]:
            by_odometry, spread = propagation(driven, vehicle, np.zeros(3), np.zeros((3, 3)))
            difference = ties.increment[k] - by_odometry[-1]
            difference[2] = se2.wrap(difference[2])
            gain = spread[-1] @ np.linalg.inv(spread[-1] + ties.covariance[k])
            delta, C_delta = by_odometry[-1] + gain @ difference, gain @ ties.covariance[k]
            A, B = se2.compose_jacobians(pose, delta)
            path[-1] = se2.compose(pose, delta)
            path_covariance[-1] = A @ covariance @ A.T + B @ (C_delta + C_delta.T) / 2 @ B.T
        poses.append(path[1:])
        covariances.append(path_covariance[1:])
    kept = np.unique(np.r_[first[ties.kept], second[ties.kept]])
    return Fusion(np.concatenate(poses), np.concatenate(covariances), frame,
                  len(dataset.aruco.pose) - len(kept))


def fuse(dataset, slip=None, model="arc"):
    """Incremental localization from odometry and markers that carries their shared errors along.

    Parameters
    ----------
    dataset : Dataset with markers.
    slip : sqrt(m), standard deviation of a wheel's slip after one metre; None learns it by
        maximizing the likelihood of the innovations times a wide prior.
    model : "arc" or "euler", the increments' model.

    Returns
    -------
    Fusion
    """
    problem = _prepare(dataset, model)
    if slip is None:
        best = minimize_scalar(
            lambda s: -_filter(problem, np.exp(s), LEARNING)[0] - log_slip_prior(s),
            bounds=np.log(SLIPS), method="bounded", options={"xatol": 0.1})
        slip = float(np.exp(best.x))
    _, joint, _, _ = _filter(problem, slip)
    problem = _prepare(dataset, model, problem.wheel + joint[-1, 3:])   # about what was learned
    _, joint, joint_covariance, outliers = _filter(problem, slip)
    return _between_frames(problem, joint, joint_covariance, slip, outliers)


def log_slip_prior(log_slip):
    """Logarithm of a lognormal density of the slip, about TYPICAL_SLIP, up to a constant."""
    return -((log_slip - np.log(TYPICAL_SLIP)) / np.log(SLIP_FACTOR))**2 / 2


@dataclass(frozen=True)
class _Problem:
    """What the filter needs, computed once for all values of slip."""

    dataset: object
    model: str
    vehicle: object              # with the wheel parameters about which increments are linear
    wheel: np.ndarray            # (3,) these
    frame: np.ndarray            # (f,) pose 1 and the measured poses
    increment: np.ndarray        # (f-1, 3)
    by_w: np.ndarray             # (f-1, 3, 3)
    rounding: np.ndarray         # (f-1, 3, 3) noise without slip
    slipping: np.ndarray         # (f-1, 3, 3) noise of slip 1
    markers: list                # of f: ids, z, C seen there
    repeated: int                # sightings left out before the filter


def _prepare(dataset, model, wheel=None):
    ticks, vehicle, sightings = dataset.ticks, dataset.vehicle, gather(dataset.aruco, also=[0])
    if wheel is None:
        wheel = vehicle.wheel
    vehicle = vehicle.with_wheel(wheel)
    start, end = sightings.frame[:-1], sightings.frame[1:]
    split = np.searchsorted(sightings.row, np.arange(1, len(sightings.frame)))
    markers = list(zip(*(np.split(values, split)
                         for values in (sightings.marker, sightings.z, sightings.C))))
    rounding = odometry.increment_noise(ticks, vehicle, start, end, 0.0)
    slipping = odometry.increment_noise(ticks, vehicle, start, end, 1.0) - rounding
    return _Problem(dataset, model, vehicle, wheel, sightings.frame,
                    *odometry.increments(ticks, vehicle, start, end, model), rounding, slipping,
                    markers, len(dataset.aruco.pose) - len(sightings.row))


def _filter(problem, slip, most=None):
    """Log likelihood of the innovations, and [X, w] with covariance at every frame, or the first.

    w is kept as its deviation from what the increments are linear about. Returns the log
    likelihood, (f, 6), (f, 6, 6) and the number of sightings beyond the gate.
    """
    vehicle = problem.dataset.vehicle
    state = np.r_[0.0, 0.0, 0.0, vehicle.wheel - problem.wheel]
    P = np.diag([0.0, 0.0, vehicle.sigma_heading, *vehicle.sigma_wheel])**2
    ids, seen, seen_covariance = problem.markers[0]
    M, P = seen, _add_markers(P, seen_covariance)
    joint, joint_covariance = [state], [P[:6, :6]]
    noise = problem.rounding + slip**2 * problem.slipping
    log_likelihood, outliers = 0.0, 0
    for k, (next_ids, seen, seen_covariance) in enumerate(problem.markers[1:most]):
        state, M, P = _predict(state, M, P, problem.increment[k], problem.by_w[k], noise[k])
        _, old, new = np.intersect1d(ids, next_ids, assume_unique=True, return_indices=True)
        innovation = seen[new] - M[old]
        innovation[:, 2] = se2.wrap(innovation[:, 2])
        rows = 6 + 3 * old[:, None] + np.arange(3)
        S_each = P[rows[:, :, None], rows[:, None, :]] + seen_covariance[new]
        squared = np.einsum("ni,ni->n", innovation,
                            np.linalg.solve(S_each, innovation[..., None])[..., 0])
        good = squared < GATE
        outliers += int(np.count_nonzero(~good))
        log_likelihood -= np.sum(~good) * GATE / 2 + np.sum(np.linalg.slogdet(S_each[~good])[1]) / 2
        state, M, P, gained = _update(state, M, P, rows[good].ravel(), innovation[good].ravel(),
                                      seen_covariance[new][good])
        log_likelihood += gained
        fresh = np.setdiff1d(np.arange(len(next_ids)), new)
        staying = old[good]
        P = P[np.ix_(*2 * (np.r_[:6, rows[good].ravel()],))]
        P = _add_markers(P, seen_covariance[fresh])
        M = np.concatenate([M[staying], seen[fresh]])
        ids = np.concatenate([ids[staying], next_ids[fresh]])
        joint.append(state)
        joint_covariance.append(P[:6, :6])
    return log_likelihood, np.array(joint), np.array(joint_covariance), outliers


def _predict(state, M, P, increment, by_w, noise):
    """Move by the odometry increment: X' = X Delta(w), M'_j = Delta(w)^-1 M_j."""
    delta = increment + by_w @ state[3:]
    A, B = se2.compose_jacobians(state[:3], delta)
    by_delta, by_marker = se2.between_jacobians(delta, M)
    F, L = np.eye(len(P)), np.zeros((len(P), 3))
    F[:3, :3] = A
    L[:3], L[6:] = B, by_delta.reshape(-1, 3)
    F[:, 3:6] += L @ by_w
    rows = 6 + np.arange(3 * len(M)).reshape(-1, 3)
    F[rows[:, :, None], rows[:, None, :]] = by_marker
    state = np.concatenate([se2.compose(state[:3], delta), state[3:]])
    return state, se2.between(delta, M), F @ P @ F.T + L @ noise @ L.T


def _update(state, M, P, rows, innovation, seen_covariance):
    """Kalman update with sightings of markers in the state; also their log likelihood."""
    if not len(rows):
        return state, M, P, 0.0
    S = P[np.ix_(rows, rows)] + _block_diagonal(seen_covariance)
    gain = np.linalg.solve(S, P[rows]).T
    change = gain @ innovation
    P = P - gain @ P[rows]
    log_likelihood = -(innovation @ np.linalg.solve(S, innovation) + np.linalg.slogdet(S)[1]) / 2
    return state + change[:6], M + change[6:].reshape(-1, 3), (P + P.T) / 2, log_likelihood


def _block_diagonal(blocks):
    size = 3 * len(blocks)
    whole = np.zeros((size, size))
    rows = np.arange(size).reshape(-1, 3)
    whole[rows[:, :, None], rows[:, None, :]] = blocks
    return whole


def _add_markers(P, covariance):
    old, new = len(P), 3 * len(covariance)
    grown = np.zeros((old + new, old + new))
    grown[:old, :old], grown[old:, old:] = P, _block_diagonal(covariance)
    return grown


def _between_frames(problem, joint, joint_covariance, slip, outliers):
    """Every pose of the encoder file from the last measured one before it, by odometry."""
    ticks, vehicle = problem.dataset.ticks, problem.vehicle
    pose = np.arange(len(ticks))
    last = np.searchsorted(problem.frame, pose, side="right") - 1
    start = problem.frame[last]
    increment, by_w = odometry.increments(ticks, vehicle, start, pose, problem.model)
    noise = np.zeros((len(pose), 3, 3))
    moved = pose > start
    noise[moved] = odometry.increment_noise(ticks, vehicle, start[moved], pose[moved], slip)
    delta = increment + np.einsum("nij,nj->ni", by_w, joint[last, 3:])
    A, B = se2.compose_jacobians(joint[last, :3], delta)
    F = np.concatenate([A, B @ by_w], axis=2)
    covariances = F @ joint_covariance[last] @ np.swapaxes(F, 1, 2) + B @ noise @ np.swapaxes(B, 1, 2)
    return Fusion(se2.compose(joint[last, :3], delta), covariances, problem.frame,
                  outliers + problem.repeated, slip, problem.wheel + joint[-1, 3:],
                  joint_covariance[-1, 3:, 3:])
