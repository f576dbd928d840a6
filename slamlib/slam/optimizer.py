"""Stage 3: a problem is linearised, solved by Gauss-Newton, and its evidence computed.

GTSAM linearises its own factors and eliminates; the linearised odometry is added to its graph.
"""

import re
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import P, W, X

from slamlib.dataset import DatasetError
from slamlib.slam.measurement_factors import point_factors
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
        step, _ = _solve(problem, linearize(problem, state))
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


def linearize(problem, state, linearized=None):
    """The gtsam.GaussianFactorGraph of a Problem at a State.

    `linearized` is that of GTSAM's factors alone, where it has been made already.
    """
    e, (first, second, by_w) = problem.odometry_jacobians(state)
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(problem.measured.graph.linearize(state.values) if linearized is None
                    else linearized)
    for i in range(len(e)):
        graph.add(X(i), first[i], X(i + 1), second[i], W(0), by_w[i], -e[i])
    p = point_factors(problem.measured, state)
    for i, j, by_pose, by_point, error in zip(
            p.row.tolist(), p.label.tolist(), p.by_pose, p.by_point, p.e):
        graph.add(X(i), by_pose, P(j), by_point, -error)
    return graph


def log_evidence_of_slip(problem, state):
    """The function from the logarithm of the slip to the Laplace log evidence, up to a constant.

    With the graph's error e at its optimum, the odometry noise Q and the square root information R
    of all variables,

        log evidence = -e - sum log|Q| / 2 - log|R|

    (MacKay, Neural Computation 4(3), 1992). e is that of the graph linearised at the State, which
    should be near the optimum. The omitted constant depends on the dataset and the weights: only
    problems on the same accepted measurements can be compared.
    """
    linearized = problem.measured.graph.linearize(state.values)

    def log_evidence(log_slip):
        trial = replace(problem, slip=np.exp(log_slip))
        linear = linearize(trial, state, linearized)
        solution, log_root = _solve(trial, linear)
        return -linear.error(solution) - trial.log_determinant / 2 - log_root

    return log_evidence


def log_evidence(problem, state):
    """Laplace log evidence at the problem's own slip, as `log_evidence_of_slip`."""
    return log_evidence_of_slip(problem, state)(np.log(problem.slip))


def _solve(problem, linear):
    """Solution (gtsam.VectorValues) of a linearised graph, and log|R|.

    Cholesky decomposition of the information is fast, but fails where it is ill-conditioned. QR
    decomposition of its root then decides whether the measurements determine every variable.
    """
    m = problem.measurements
    try:
        tree = linear.eliminateMultifrontal(m.ordering)
        return tree.optimize(), tree.logDeterminant()
    except RuntimeError:
        pass
    try:
        net = linear.eliminateSequential(m.ordering, gtsam.EliminateQR)
        diagonals = np.concatenate([np.diag(net.at(i).R()) for i in range(net.size())])
        return net.optimize(), np.sum(np.log(np.abs(diagonals)))
    except RuntimeError as error:                 # GTSAM's, with the variable and much advice
        raise DatasetError(f"{m.dataset.name}: expected measurements that determine every pose and "
                           f"landmark; these do not determine {_variable(m, str(error))}") from None


def _variable(measurements, message):
    """What GTSAM's message about an undetermined variable names, in the words of the files."""
    m, found = measurements, re.search(r"Symbol: ([alpwx])(\d+)", message)
    if found is None:
        return "one of them"
    if found[1] == "w":
        return "the wheel parameters"
    name, ids = {"x": ("pose", m.frame + 1), "l": ("the pose of marker", m.marker),
                 "p": ("the position of marker", m.marker),
                 "a": ("the position of antenna", m.antenna)}[found[1]]
    return f"{name} {ids[int(found[2])]}"


def _halved(step, keys):
    half = gtsam.VectorValues()
    for key in keys:
        half.insert(key, step.at(key) / 2)
    return half
