"""Stage 3: Gauss-Newton with step halving, by which the engine decides.

A step solves the normal equations in numpy and scipy. Where these are singular to rounding, GTSAM's
QR decomposition of the same linearised factors tells whether the measurements determine every
variable. What is handed in GTSAM solves itself (`robust.solution`).
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from slamlib.core.graph_solution import CONVERGED, descended, eliminated
from slamlib.robust.factors import linearize_odometry
from slamlib.robust.linear import NormalEquations, Problem, State, retract
from slamlib.robust.measurements import WEAK_SIGMA

MAX_STEPS = 40               # number of steps of Gauss-Newton


@dataclass(frozen=True)
class Optimum:
    """The end of Gauss-Newton."""

    equations: NormalEquations
    state: State             # where the error is smallest
    steps: int               # number of steps taken
    converged: bool          # whether the error had stopped to decrease


def optimize(problem: Problem, state: State, max_steps: int = MAX_STEPS,
             tolerance: float = CONVERGED) -> Optimum:
    """The Optimum of a Problem from a State.

    It ends where the error decreases by at most `tolerance` times (1 + error). Raises DatasetError
    if the measurements do not determine every variable.
    """
    equations = NormalEquations(problem, state)
    steps = 0
    ended = False
    while steps < max_steps and not ended:
        steps += 1
        error = equations.error
        step = equations.step()
        if step is None:
            step = gtsam_step(problem, equations)
        equations = after_step(equations, step)
        ended = error - equations.error <= tolerance * (1 + error)
    return Optimum(equations=equations, state=equations.state, steps=steps, converged=ended)


def after_step(equations: NormalEquations, step: np.ndarray) -> NormalEquations:
    """The NormalEquations after a step, halved until the error does not grow."""
    problem = equations.problem

    def moved(fraction):
        there = NormalEquations(problem, retract(problem, equations.state, fraction * step))
        return there, there.error

    return descended(moved, equations, equations.error)[0]


def gtsam_step(problem: Problem, equations: NormalEquations) -> np.ndarray:
    """The Gauss-Newton step delta (n + q,) by GTSAM of NormalEquations, in sigmas of c.

    Raises DatasetError if the measurements do not determine every variable.
    """
    structure = problem.measurements.structure
    _, solution = eliminated(linearize(problem, equations))
    n = len(structure.diagonal)
    q = problem.active.sum()
    step = np.zeros(n + q)
    keys = list(range(len(structure.is_pose) + bool(q)))
    step[np.concatenate([structure.unknowns, np.arange(n, n + q)])] = solution.vector(keys)
    return step


def linearize(problem: Problem, equations: NormalEquations) -> gtsam.GaussianFactorGraph:
    """The gtsam.GaussianFactorGraph of NormalEquations; keys number the variables, c is last."""
    graph = gtsam.GaussianFactorGraph()
    is_pose = equations.structure.is_pose
    q = problem.active.sum()
    calibration = len(is_pose)
    width = 2 + is_pose
    variables = equations.structure.variables
    odometry = linearize_odometry(problem, equations.state, problem.noise.slip)
    for factors in (odometry, *equations.linearized):
        by_c = np.zeros((*factors.e.shape, q))
        by_c[:, :, factors.columns] = factors.J_c
        for k, (i, j) in enumerate(variables[factors.index].tolist()):
            J = factors.J[k]
            terms = [i, J[:, :width[i]], j, J[:, 3:3 + width[j]]]
            if q:
                terms += [calibration, by_c[k]]
            graph.add(*terms, -factors.e[k])
    add_priors(graph, equations, width, q)
    return graph


def add_priors(graph: gtsam.GaussianFactorGraph, equations: NormalEquations, width: np.ndarray,
               q: int):
    """Add the priors of the variables, each of this width (v,), and of q unknowns of c."""
    structure = equations.structure
    priors = equations.priors
    root = np.sqrt(np.append(priors.H[structure.diagonal], np.ones(q)))
    e = priors.border[:, -1] / np.maximum(root, 1 / WEAK_SIGMA)
    first = structure.rows[:, 0]
    for variable, (start, size) in enumerate(zip(first, width)):
        rows = slice(start, start + size)
        if root[start]:
            graph.add(variable, np.diag(root[rows]), -e[rows])
    if q:
        rows = slice(len(structure.diagonal), None)
        graph.add(len(width), np.diag(root[rows]), -e[rows])
