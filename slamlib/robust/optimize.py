"""Stage 3: the factor graph in GTSAM, and Gauss-Newton with step halving.

A step of `optimize` solves the normal equations in numpy and scipy, or is GTSAM's, which eliminates
the same graph factor by factor: the last steps of every solution, and those where the normal
equations are singular to rounding. All factors but one's own are linearised in numpy. Custom
factors in Python would be slow: GTSAM copies all values for every call.
"""

from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C

from slamlib.core.errors import DatasetError, require
from slamlib.robust.factors import linearize_odometry
from slamlib.robust.linear import NormalEquations, State, retract
from slamlib.robust.measurements import WEAK_SIGMA
from slamlib.robust.own import gtsam_values, variable_keys

CONVERGED = 1e-6             # decrease, over 1 + error, at which iterations end
ROUNDING = 1e-12             # relative increase of the error that is due to float rounding
MAX_STEPS = 40               # number of steps of Gauss-Newton
MAX_HALVINGS = 8             # number of halvings of one step


class Optimum(NamedTuple):
    """The end of Gauss-Newton."""

    equations: NormalEquations
    state: State             # where the error is smallest
    steps: int               # number of steps taken
    converged: bool          # whether the error had stopped to decrease


def optimize(problem, state, max_steps=MAX_STEPS, by_gtsam=False, tolerance=CONVERGED):
    """The Optimum of a Problem from a State.

    It ends where the error decreases by at most `tolerance` times (1 + error). Raises DatasetError
    if the measurements do not determine every variable.
    """
    equations, steps, ended = NormalEquations(problem, state), 0, False
    while steps < max_steps and not ended:
        steps += 1
        state, error = equations.state, equations.error
        step = None if by_gtsam else equations.step()
        if step is None:
            step = gtsam_step(problem, state)
        for scale in 0.5**np.arange(MAX_HALVINGS):
            equations = NormalEquations(problem, retract(problem, state, scale * step))
            if equations.error <= (1 + ROUNDING) * error:
                break
        else:
            equations = NormalEquations(problem, state)
        ended = error - equations.error <= tolerance * (1 + error)
    return Optimum(equations=equations, state=equations.state, steps=steps, converged=ended)


def gtsam_step(problem, state):
    """The Gauss-Newton step delta (n + q,) by GTSAM of a Problem at a State, in sigmas of c.

    Cholesky decomposition of H is fast, but fails if H is ill-conditioned. QR decomposition of its
    root then decides whether the measurements determine every variable. Raises DatasetError if they
    do not.
    """
    m, linear = problem.measurements, linearize(problem, state)
    try:
        solution = linear.optimize()
    except RuntimeError:
        try:
            solution = linear.optimize(gtsam.EliminateQR)
        except RuntimeError:                      # GTSAM's, with much advice
            raise DatasetError(f"{m.dataset.name}: expected measurements that determine every pose "
                               "and landmark") from None
    n = len(m.structure.diagonal)
    step = np.zeros(n + problem.active.sum())
    step[np.r_[m.structure.unknowns, n:len(step)]] = solution.vector(
        gtsam.KeyVector(_keys(problem)))
    return step


def _keys(problem):
    """List of GTSAM's keys of all variables, those of the calibration last, if there are any."""
    return variable_keys(problem.measurements) + [C(0)] * bool(problem.active.any())


def linearize(problem, state):
    """The gtsam.GaussianFactorGraph of a Problem at a State."""
    equations, graph = NormalEquations(problem, state), gtsam.GaussianFactorGraph()
    structure, variables, q = equations.structure, _keys(problem), problem.active.sum()
    width = np.r_[2 + structure.is_pose, q].tolist()
    odometry, _ = linearize_odometry(problem, state, problem.noise.slip)
    for pairs, f in zip(structure.factors, (odometry, *equations.linearized)):
        by_c = np.zeros((*f.e.shape, q))
        by_c[:, :, f.columns] = f.J_c
        for (i, j), e, J, J_c in zip(pairs[f.index].tolist(), f.e, f.J, by_c):
            calibration = (C(0), J_c) if len(f.columns) else ()
            second = () if i == j else (variables[j], J[:, 3:3 + width[j]])
            graph.add(variables[i], J[:, :width[i]], *second, *calibration, -e)
    root = np.sqrt(np.r_[equations.priors.H, np.ones(q)])
    e = equations.priors.border[:, -1] / np.maximum(root, 1 / WEAK_SIGMA)
    first = np.r_[structure.rows(slice(None))[:, 0], len(structure.diagonal)]
    for key, start, count in zip(variables, first, width):
        own = slice(start, start + count)
        if root[start]:
            graph.add(key, np.diag(root[own]), -e[own])
    return graph


def as_gtsam(result):
    """The gtsam.NonlinearFactorGraph of a SlamResult, linearised at its gtsam.Values, and these.

    Priors, odometry, sightings, ranges and factors of one's own, whitened and weighted by noise,
    gates and kernels of the result, each a gtsam.LinearContainerFactor; `slam.own` has the keys.
    The values are those of greatest density, at which nothing is averaged over the noise.
    """
    require(hasattr(result, "fit"), "as_gtsam", "a SlamResult", result)
    problem, state = result.fit.problem, result.fit.state
    values = gtsam_values(problem, state)
    return gtsam.LinearContainerFactor.ConvertLinearGraph(
        linearize(problem, state), values), values
