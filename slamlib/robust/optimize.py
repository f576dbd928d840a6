"""Stage 3: Gauss-Newton with step halving, by which the engine decides.

A step solves the normal equations in numpy and scipy. What is handed in GTSAM solves itself
(`robust.solution`). `cauchy_minimum` is for a few unknowns.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slamlib.core.graph_solution import (
    CONVERGED,
    MAX_LENGTHS,
    ROUNDING,
    descended,
    undetermined,
)
from slamlib.robust.linear import NormalEquations, Problem, State, retract

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
    if the normal equations are singular to rounding.
    """
    equations = NormalEquations(problem, state)
    steps = 0
    halvings = 0
    ended = False
    while steps < max_steps and not ended:
        steps += 1
        error = equations.error
        step = equations.step()
        if step is None:
            raise undetermined()
        equations, halvings = after_step(equations, step, max(halvings - 1, 0))
        ended = error - equations.error <= tolerance * (1 + error) and halvings == 0
    return Optimum(equations=equations, state=equations.state, steps=steps, converged=ended)


def after_step(equations: NormalEquations, step: np.ndarray,
               halvings: int) -> tuple[NormalEquations, int]:
    """The NormalEquations after a step, and how often it was halved until the error did not grow.

    `halvings` come first: a step is often as long as the one before.
    """
    problem = equations.problem
    for number in range(halvings, halvings + MAX_LENGTHS):
        there = NormalEquations(problem, retract(problem, equations.state, 0.5**number * step))
        if there.error <= (1 + ROUNDING) * equations.error:
            return there, number
    return equations, 0


class Minimum(NamedTuple):
    """A minimum of a Cauchy cost of m errors."""

    x: np.ndarray            # (p,)
    cost: float
    jac: np.ndarray          # (m, p), whose square is the curvature of the cost


def cauchy_minimum(errors: Callable, start: np.ndarray, derivatives: Callable, scale: float,
                   tolerance: float) -> Minimum:
    """The Minimum of scale^2 / 2 sum log(1 + (r / scale)^2) next to a start (p,).

    By reweighted Gauss-Newton steps. The functions return the errors r (m,) and their derivatives
    (m, p). It ends where a step lowers the cost by at most `tolerance` times itself.
    """
    def at(x):
        z = errors(x) / scale
        return (x, z), scale**2 / 2 * np.sum(np.log1p(z**2))

    (x, z), cost = at(start)
    for _ in range(MAX_STEPS):
        J = derivatives(x)
        weight = 1 / (1 + z**2)
        weighted = weight * J.T
        step = -scale * np.linalg.solve(weighted @ J, weighted @ z)
        old = cost
        (x, z), cost = descended(lambda part, x=x, step=step: at(x + part * step), (x, z), old)
        if old - cost <= tolerance * old:
            break
    curvature = np.maximum((1 - z**2) / (1 + z**2)**2, np.finfo(float).eps)
    return Minimum(x, cost, np.sqrt(curvature)[:, None] * derivatives(x))
