"""Stage 7: errors that all sightings share, from the residuals of the solution.

A camera that is late by L poses sees the markers from the pose of the vehicle L steps earlier. A
camera at the pose xi = [x, y, heading] in the vehicle, not in its origin, sees them from X exp(xi).
To first order the error e of a sighting changes by

    -de/dX v L,    de/dX xi,

with v the motion per step in the axes of the vehicle. The graph has no such unknown L or xi. Its
estimate and information follow from the normal equations with columns for it; the Schur complement
subtracts what all other variables can explain. v is that of the solution: odometry alone contains
the slip of the wheels, and would bias L.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import se2
from slamlib.slam.evidence import consistency_factor
from slamlib.slam.normal_equations import decomposition

VELOCITY_FRAMES = 3          # number of frames to both sides over which a velocity is averaged
MIN_INFORMATION = 1e-9       # share of the information that the Schur complement must leave


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
