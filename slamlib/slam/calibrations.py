"""Stages 6 and 7: what may be wrong with model, ranges, camera and wheels, judged by the evidence.

The evidence chooses between arcs and Euler's steps (`better_model`).

A common offset and scale of the ranges are estimated unless the evidence rejects them. Without a
decision they remain variables: a possible offset makes the antennas less certain.

A camera that is late by L poses sees the markers from the pose of the vehicle L steps earlier. A
camera at the pose xi = [x, y, heading] in the vehicle, not in its origin, sees them from X exp(xi).
To first order the error e of a sighting changes by

    -de/dX v L,    de/dX xi,

with v the motion per step in the axes of the vehicle. The graph has no such unknown L or xi. Its
estimate and information follow from the normal equations with columns for it; the Schur complement
subtracts what all other variables can explain. v is that of the solution: odometry alone contains
the slip of the wheels, and would bias L.

Learned slip explains any path, so a wheel that is far from its stated value appears as slip, while
its estimate hardly changes. A drive with large slip is solved again with wheels that are known to a
few percent only, and the evidence of both solutions is compared.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib import se2
from slamlib.dataset import DatasetError
from slamlib.doubt import Doubt
from slamlib.slam.drive_doubts import MIN_LEAD, far_off, marker_size, wheels_in_words
from slamlib.slam.factors import linearize_ranges, preintegrate_odometry
from slamlib.slam.fit import accepted_measurements, refine
from slamlib.slam.linear import (
    NormalEquations,
    consistency_factor,
    decomposition,
    laplace_approximation,
    log_evidence,
)
from slamlib.slam.measurements import measure
from slamlib.slam.noise import greatest_log_density, log_density

DECISIVE_LEAD = 3.0          # difference of log evidence from which a model replaces the default

VELOCITY_FRAMES = 3          # number of frames to both sides over which a velocity is averaged
MIN_INFORMATION = 1e-9       # share of the information that the Schur complement must leave

SUSPICIOUS_SLIP = 3e-3       # sqrt(m), from which the wheels are checked
WEAK_WHEEL_SIGMA = 0.05      # relative standard deviation of radii and wheelbase
MIN_ACCEPTED = 0.98          # ratio of the accepted measurements, of other to stated wheels
MAX_SLIP_RATIO = 0.7         # ratio of the slips, of other to stated wheels
# Doubts that wheels far from the stated ones explain.
EXPLAINED = {"wheel-parameters", "wheel-slip", "camera-offset", "time-offset"}


def better_model(fit, model):
    """The Fit of another model of odometry if its evidence leads by DECISIVE_LEAD, else `fit`.

    Both evidences are on the same measurements with the same weights, so the weights that the
    kernel of the ranges gives at `fit` are kept. The noise is learned for each model.
    """
    current = replace(fit.problem, accepted=_with_fixed_weights(fit))
    odometry = preintegrate_odometry(current.measurements, model, fit.state.w)
    alternative = replace(current, odometry=odometry)
    lead = _log_density(NormalEquations(alternative, fit.state), fit.posterior) \
        - _log_density(NormalEquations(current, fit.state), fit.posterior,
                       is_greatest=not len(current.accepted.range_weight))
    if lead <= DECISIVE_LEAD:
        return fit
    return refine(replace(fit.problem, odometry=odometry), fit.state, accept=None)


def _with_fixed_weights(fit):
    """AcceptedMeasurements in which weights replace the kernel of the ranges."""
    accepted = fit.problem.accepted
    weight = accepted.weight.astype(float)
    ranges = np.flatnonzero(accepted.range_weight) + len(accepted.sighting_weight)
    weight[ranges] = linearize_ranges(accepted, fit.problem.noise, fit.state).weight
    return replace(accepted, weight=weight, range_kernel=None)


def _log_density(equations, posterior, is_greatest=False):
    """Log evidence of known noise, or greatest log posterior density of learned noise.

    If `is_greatest`, the noise of the equations' problem is the mode already.
    """
    if posterior is None or not posterior.covariance.any():          # nothing was learned
        return laplace_approximation(equations, equations.problem.noise)[1]
    return log_density(equations) if is_greatest else greatest_log_density(equations, posterior)


def calibrated(fit, accept=accepted_measurements):
    """The Fit with offset and scale of the ranges as variables.

    `fit` itself if its evidence leads by DECISIVE_LEAD or if there are no ranges. Both are compared
    at its state and on its accepted measurements. `accept` and errors raised as in `refine`.
    """
    if not len(fit.problem.measurements.ranges.row):
        return fit
    m = replace(fit.problem.measurements, calibrated=True)
    problem = replace(fit.problem, accepted=replace(fit.problem.accepted, measurements=m))
    if log_evidence(problem, fit.state) < fit.log_evidence - DECISIVE_LEAD:
        return fit
    return refine(problem, fit.state, accept)


@dataclass(frozen=True)
class SharedError:
    """Estimate of p unknowns that are not in the graph."""

    estimate: np.ndarray     # (p,)
    sigma: np.ndarray        # (p,)
    gain: float              # of log likelihood at the estimate


@dataclass(frozen=True)
class CameraOffsets:
    """Offsets of the camera in time and in place, each as if the other were zero."""

    time: SharedError        # (1,) poses by which sightings are late; many are underestimated
    place: SharedError       # (3,) m, m, rad, pose of the camera in the vehicle


def estimate_camera_offsets(equations):
    """The CameraOffsets by the NormalEquations at the State that solves their problem."""
    problem, state = equations.problem, equations.state
    H, g, *_ = equations.sums(
        problem.noise, (1.0, 1.0, consistency_factor(problem.accepted.range_kernel)))
    lu = decomposition(equations.structure.matrix(H))
    velocity, sightings = _velocities(problem.measurements, state), equations.linearized[:2]

    def shared(columns):
        """SharedError with columns (m, d, p) for both kinds of sightings."""
        A = np.concatenate([column.reshape(-1, column.shape[2]) for column in columns])
        information, gradient = A.T @ A, A.T @ np.concatenate([f.e.ravel() for f in sightings])
        cross = np.zeros((len(g), len(information)))
        for f, column, (_, rows) in zip(sightings, columns, problem.measurements.factor_places[1:]):
            if len(f.row):
                np.add.at(cross, rows[f.index], np.swapaxes(f.J, 1, 2) @ column)
        explained = lu.solve(np.column_stack([cross, g]))
        return _estimate(information, information - cross.T @ explained[:, :-1],
                         gradient - cross.T @ explained[:, -1])

    if lu is None or not sum(f.e.size for f in sightings):
        return CameraOffsets(_undetermined(1), _undetermined(3))
    by_pose = [f.J[:, :, :3] for f in sightings]
    delayed = [-J @ velocity[f.row, :, None] for f, J in zip(sightings, by_pose)]
    return CameraOffsets(shared(delayed), shared(by_pose))


def _estimate(full, information, gradient):
    """The SharedError by its information (p, p), `full` (p, p) before the Schur complement."""
    scale = np.sqrt(np.maximum(np.diag(full), 1e-300))
    scaled = information / np.outer(scale, scale)
    if np.linalg.eigvalsh(scaled)[0] < MIN_INFORMATION:
        return _undetermined(len(full))
    covariance = np.linalg.inv(scaled) / np.outer(scale, scale)
    estimate = -covariance @ gradient
    return SharedError(estimate, np.sqrt(np.diag(covariance)), float(-gradient @ estimate / 2))


def _undetermined(count):
    """The SharedError of `count` unknowns without information."""
    return SharedError(np.zeros(count), np.full(count, np.inf), 0.0)


def _velocities(measurements, state):
    """Motion per encoder step (f, 3) at every frame, in its axes."""
    row = np.arange(len(measurements.frame))
    earlier = np.maximum(row - VELOCITY_FRAMES, 0)
    later = np.minimum(row + VELOCITY_FRAMES, len(row) - 1)
    motion = se2.between(state.poses, state.poses[later]) \
        - se2.between(state.poses, state.poses[earlier])
    steps = measurements.frame[later] - measurements.frame[earlier]
    return motion / np.maximum(steps, 1)[:, None]


def with_checked_wheels(result, fit, refit):
    """The SlamResult of a Fit, with a doubt if other wheel parameters explain the drive better.

    `refit` makes a Fit from Measurements and a SlamResult.
    """
    doubted = {doubt.what for doubt in result.drive_doubts}
    if not fit.problem.measurements.learned[0] or not (
            result.slip > SUSPICIOUS_SLIP or doubted & EXPLAINED):
        return result
    dataset, stated = fit.problem.measurements.dataset, fit.problem.measurements.dataset.vehicle
    uncertain = replace(
        stated, sigma_right_radius=WEAK_WHEEL_SIGMA * stated.right_radius,
        sigma_left_radius=WEAK_WHEEL_SIGMA * stated.left_radius,
        sigma_wheelbase=WEAK_WHEEL_SIGMA * stated.wheelbase)
    try:
        alternative = refit(measure(replace(dataset, vehicle=uncertain)), result)
        wheel = stated.wheel + uncertain.sigma_wheel * alternative.state.w
        if alternative.problem.accepted.weight.sum() \
                < MIN_ACCEPTED * fit.problem.accepted.weight.sum() \
                or alternative.problem.noise.slip > MAX_SLIP_RATIO * result.slip \
                or not far_off(stated, wheel).any():
            return result
        accepted = replace(alternative.problem.accepted, measurements=fit.problem.measurements)
        compared = refine(replace(fit.problem, accepted=accepted), fit.state, accept=None)
    except (DatasetError, np.linalg.LinAlgError):
        return result
    lead = alternative.posterior.log_density - compared.posterior.log_density
    if lead < max(MIN_LEAD, result.camera.time.gain, result.camera.place.gain):
        return result
    doubt = Doubt("wheel-parameters", (
        f"The drive is explained far better if {wheels_in_words(stated, wheel)}: measure the "
        "wheels, and state their values or larger sigmas in vehicle.toml."
        + marker_size(stated, wheel)))
    remaining = (doubt for doubt in result.drive_doubts if doubt.what not in EXPLAINED)
    return replace(result, drive_doubts=(doubt, *remaining))
