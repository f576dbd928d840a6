"""Stage 7: by how many encoder poses the sightings are late, from the graph's own residuals.

A sighting that is L poses late belongs to the pose L steps earlier. To first order its error e
changes by -de/dX v L, with v the motion per step in the axes of the vehicle. L is one more unknown
of the normal equations; the Schur complement takes from it what all other variables can explain.
The velocity is that of the solution. That of odometry alone contains the wheels' slip and would
seem to show L where it does not.
"""

import numpy as np

from slamlib import se2
from slamlib.slam.evidence import NormalEquations, decomposition
from slamlib.slam.linear_factors import point_factors, pose_factors

FRAMES = 3                   # to both sides, over which a velocity is averaged
SMALLEST = 1e-9              # share of its information that the other variables leave to L


def time_offset(problem, state):
    """L in poses (negative: sightings are early) and its standard deviation, at the solution.

    0 and infinity where the drive does not show it, as at constant velocity. An offset of a few
    frames is estimated well, a larger one too small.
    """
    m = problem.measurements
    row = np.arange(len(m.frame))
    earlier, later = np.clip(row - FRAMES, 0, None), np.clip(row + FRAMES, None, len(row) - 1)
    moved = se2.between(state.poses[row], state.poses[later]) \
        - se2.between(state.poses[row], state.poses[earlier])
    velocity = moved / np.maximum(m.frame[later] - m.frame[earlier], 1)[:, None]
    equations = NormalEquations(problem, state)
    by_late, gradient, own = np.zeros(equations.size), 0.0, 0.0
    for factors in (pose_factors(problem.measured, problem.noise, state),
                    point_factors(problem.measured, problem.noise, state)):
        J, e = equations.jacobian(factors), factors.e.ravel()
        column = -np.einsum("mdi,mi->md", factors.by_pose, velocity[factors.row]).ravel()
        by_late += J.T @ column
        gradient += column @ e
        own += column @ column
    H, g = equations.information(problem.noise)
    lu = decomposition(H)
    if lu is None:
        return 0.0, np.inf
    rest = lu.solve(np.stack([by_late, g], axis=1))
    information = own - by_late @ rest[:, 0]
    if information <= SMALLEST * own:
        return 0.0, np.inf
    return -(gradient - by_late @ rest[:, 1]) / information, information**-0.5
