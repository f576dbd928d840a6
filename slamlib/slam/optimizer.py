"""Stage 3: a problem is linearised and solved by Gauss-Newton.

GTSAM linearises its own factors and eliminates; the linearised odometry is added to its graph.
"""

import re
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, P, W, X, Z

from slamlib.dataset import DatasetError
from slamlib.slam.state import State, state_from_values

CONVERGED = 1e-6             # relative decrease of the error at which iterations end
MAX_STEPS = 40               # of Gauss-Newton
MAX_HALVINGS = 8             # of one step


@dataclass(frozen=True)
class Optimum:
    """Where Gauss-Newton ends."""

    state: State
    error: float
    steps: int


def optimize(problem, state, max_steps=MAX_STEPS):
    """The Optimum from a State, by Gauss-Newton with step halving.

    Raises DatasetError where the measurements do not determine every variable.
    """
    error, steps, decrease = problem.error(state), 0, np.inf
    while steps < max_steps and decrease > CONVERGED * (1 + error):
        steps += 1
        step = _solve(problem, linearize(problem, state))
        for _ in range(MAX_HALVINGS):
            moved = state_from_values(problem.measurements, state.values.retract(step))
            new_error = problem.error(moved)
            if new_error <= error:
                break
            step = _halved(step, state.values.keys())
        else:
            break
        state, error, decrease = moved, new_error, error - new_error
    return Optimum(state, error, steps)


def linearize(problem, state):
    """The gtsam.GaussianFactorGraph of a Problem at a State."""
    e, (first, second, by_w) = problem.odometry_jacobians(state)
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(problem.graph.linearize(state.values))
    for i in range(len(e)):
        graph.add(X(i), first[i], X(i + 1), second[i], W(0), by_w[i], -e[i])
    points, *ranges = problem.other_factors(state)
    for i, j, by_pose, by_point, error in zip(
            points.row.tolist(), points.landmark.tolist(), points.by_pose, points.by_landmark,
            points.e):
        graph.add(X(i), by_pose, P(j), by_point, -error)
    for r in ranges:
        for i, k, by_pose, by_antenna, by_z, error in zip(
                r.row.tolist(), (r.landmark - len(problem.measurements.marker)).tolist(),
                r.by_pose, r.by_landmark, r.by_calibration, r.e):
            graph.add(X(i), by_pose, A(k), by_antenna, Z(0), by_z, -error)
    return graph


def _solve(problem, linear):
    """Solution (gtsam.VectorValues) of a linearised graph.

    Cholesky decomposition of the information is fast, but fails where it is ill-conditioned. QR
    decomposition of its root then decides whether the measurements determine every variable.
    """
    m = problem.measurements
    try:
        return linear.eliminateMultifrontal(m.ordering).optimize()
    except RuntimeError:
        pass
    try:
        return linear.eliminateSequential(m.ordering, gtsam.EliminateQR).optimize()
    except RuntimeError as error:                 # GTSAM's, with the variable and much advice
        raise DatasetError(f"{m.dataset.name}: expected measurements that determine every pose and "
                           f"landmark; these do not determine {_variable(m, str(error))}") from None


def _variable(measurements, message):
    """What GTSAM's message about an undetermined variable names, in the words of the files."""
    m, found = measurements, re.search(r"Symbol: ([alpwxz])(\d+)", message)
    if found is None:
        return "one of them"
    if found[1] in "wz":
        return {"w": "the wheel parameters", "z": "the offset and scale of the ranges"}[found[1]]
    name, ids = {"x": ("pose", m.frame + 1), "l": ("the pose of marker", m.marker),
                 "p": ("the position of marker", m.marker),
                 "a": ("the position of antenna", m.antenna)}[found[1]]
    return f"{name} {ids[int(found[2])]}"


def _halved(step, keys):
    half = gtsam.VectorValues()
    for key in keys:
        half.insert(key, step.at(key) / 2)
    return half
