"""Stage 7: errors that all sightings share, from the residuals of the solution.

A camera that is late by L poses sees the markers from where the vehicle was L steps earlier. A
camera that sits at c = [x, y, heading] in the vehicle, not in its origin, sees them from X exp(c).
To first order the error e of a sighting changes by

    -de/dX v L,    de/dX c,

with v the motion per step in the axes of the vehicle. L, or c, is an unknown that the graph lacks.
Its estimate and information follow from the normal equations with such columns added; the Schur
complement takes from them what all other variables can explain. v is that of the solution: odometry
alone contains the wheels' slip, and would seem to show L where it does not.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import se2
from slamlib.slam.evidence import consistency
from slamlib.slam.normal_equations import decomposition

FRAMES = 3                   # to both sides, over which a velocity is averaged
SMALLEST = 1e-9              # share of its information that the other variables leave to an unknown


@dataclass(frozen=True)
class SharedError:
    """Estimate of p unknowns that the graph lacks."""

    estimate: np.ndarray     # (p,)
    sigma: np.ndarray        # (p,)
    gain: float              # log likelihood that they add at the estimate


@dataclass(frozen=True)
class CameraOffsets:
    """What the sightings show of the camera, each as if the other were zero."""

    time: SharedError        # poses by which the sightings are late; an offset of many frames is
                             # estimated too small
    place: SharedError       # (3,) m, m, rad of the camera in the vehicle


def camera_offsets(equations):
    """The CameraOffsets by the NormalEquations at the State that solves a Problem."""
    problem, state = equations.problem, equations.state
    H, g, *_ = equations.sums(
        problem.noise, (1.0, 1.0, consistency(problem.measured.range_kernel)))
    lu = decomposition(equations.structure.matrix(H))
    velocity, sightings = _velocities(problem.measurements, state), equations.factors[:2]

    def shared(columns):
        """SharedError with columns (m, d, p) for both kinds of sightings."""
        added = [column.reshape(-1, column.shape[2]) for column in columns]
        own, gradient = (sum(a.T @ b for a, b in zip(added, others))
                         for others in (added, [f.e.ravel() for f in sightings]))
        cross = np.zeros((len(g), own.shape[1]))
        for f, column, (_, rows) in zip(sightings, columns, problem.measurements.placed[1:]):
            if len(f.row):
                np.add.at(cross, rows[f.index],
                          np.swapaxes(equations.jacobian(f), 1, 2) @ column)
        rest = lu.solve(np.column_stack([cross, g]))
        return _estimate(own, own - cross.T @ rest[:, :-1], gradient - cross.T @ rest[:, -1])

    none = SharedError(np.zeros(1), np.full(1, np.inf), 0.0)
    if lu is None or not sum(f.e.size for f in sightings):
        return CameraOffsets(none, SharedError(np.zeros(3), np.full(3, np.inf), 0.0))
    late = [-f.by_pose @ velocity[f.row, :, None] for f in sightings]
    return CameraOffsets(shared(late), shared([f.by_pose for f in sightings]))


def _estimate(own, information, gradient):
    """The SharedError of an information (p, p) that is `own` (p, p) before the Schur complement."""
    scale = np.sqrt(np.maximum(np.diag(own), 1e-300))
    scaled = information / np.outer(scale, scale)
    if np.linalg.eigvalsh(scaled)[0] < SMALLEST:
        return SharedError(np.zeros(len(own)), np.full(len(own), np.inf), 0.0)
    covariance = np.linalg.inv(scaled) / np.outer(scale, scale)
    estimate = -covariance @ gradient
    return SharedError(estimate, np.sqrt(np.diag(covariance)), float(-gradient @ estimate / 2))


def _velocities(measurements, state):
    """Motion per encoder step (f, 3) at every frame, in its axes."""
    row = np.arange(len(measurements.frame))
    earlier, later = np.clip(row - FRAMES, 0, None), np.clip(row + FRAMES, None, len(row) - 1)
    moved = se2.between(state.poses, state.poses[later]) \
        - se2.between(state.poses, state.poses[earlier])
    steps = measurements.frame[later] - measurements.frame[earlier]
    return moved / np.maximum(steps, 1)[:, None]
