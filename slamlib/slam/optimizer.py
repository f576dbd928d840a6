"""Stage 3: a problem is linearised, solved by Gauss-Newton, and its evidence computed.

GTSAM linearises its own factors and eliminates; the linearised odometry is added to its graph.
"""

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
        step = _eliminate(problem, linearize(problem, state)).optimize()
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
        tree = _eliminate(trial, linear)
        return -linear.error(tree.optimize()) - trial.log_determinant / 2 - tree.logDeterminant()

    return log_evidence


def log_evidence(problem, state):
    """Laplace log evidence at the problem's own slip, as `log_evidence_of_slip`."""
    return log_evidence_of_slip(problem, state)(np.log(problem.slip))


def _eliminate(problem, linear):
    """Bayes tree of a linearised graph; DatasetError where it is singular."""
    try:
        return linear.eliminateMultifrontal(problem.measurements.ordering)
    except RuntimeError as error:                 # GTSAM's, with the variable and much advice
        reason = str(error).strip().partition("\n")[0]
        raise DatasetError(
            f"{problem.measurements.dataset.name}: expected measurements that determine every pose "
            f"and landmark; the graph of these cannot be solved ({reason})") from None


def _halved(step, keys):
    half = gtsam.VectorValues()
    for key in keys:
        half.insert(key, step.at(key) / 2)
    return half
