"""Stage 6: wheels, noise and accepted measurements that agree with each other."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slamlib.slam.evidence import solve
from slamlib.slam.noise import with_known
from slamlib.slam.noise_posterior import NoisePosterior, noise_posterior
from slamlib.slam.normal_equations import NormalEquations
from slamlib.slam.odometry_factors import odometry_factors
from slamlib.slam.optimizer import optimize
from slamlib.slam.problem import Problem
from slamlib.slam.robust import accepted, noise_of_scatter
from slamlib.slam.state import State

MAX_ROUNDS = 6               # of wheels, noise and accepted measurements
FEW = 1e-3                   # share of the measurements whose change says nothing of the noise


@dataclass(frozen=True)
class Fit:
    """A problem with the state that solves it."""

    problem: Problem
    state: State
    log_evidence: float
    posterior: NoisePosterior | None     # of the noise; None where all of it is known

    @cached_property
    def equations(self):
        """The NormalEquations at the state."""
        return NormalEquations(self.problem, self.state)


def solved_by_gtsam(fit):
    """The Fit whose state GTSAM's optimisation of the same graph ends at, from that of the Fit."""
    return replace(fit, state=optimize(fit.problem, fit.state, by_gtsam=True).state)


def refine(problem, state, accept=accepted, factors=odometry_factors):
    """The Fit in which wheels, noise and accepted measurements agree with each other.

    They depend on each other, so each is updated in turn until the accepted measurements no longer
    change. From a Problem and a State near its solution. `accept` makes MeasurementFactors from
    Problem and State; None keeps the problem's. `factors` as of `problem.build`.
    """
    m, model, posterior = problem.measurements, problem.odometry.model, None
    if accept is not None:
        problem = replace(problem, noise=noise_of_scatter(m, state))
    measured = problem.measured if accept is None else accept(problem, state)
    changed = np.inf
    for _ in range(MAX_ROUNDS):
        problem = replace(problem, measured=measured, odometry=factors(m, model, state.w))
        if m.learned.any() and changed > FEW * len(measured.weight):
            optimum = None                                 # frees the equations before
            optimum = optimize(problem, state, max_steps=2)
            state, posterior = optimum.state, noise_posterior(optimum.equations)
            problem = replace(problem, noise=with_known(posterior.noise, m.dataset.vehicle))
        optimum = None
        optimum = optimize(problem, state)
        state = optimum.state
        measured = problem.measured if accept is None else accept(problem, state)
        changed = np.count_nonzero(measured.weight != problem.measured.weight)
        if not changed:
            break
    return Fit(problem, state, solve(optimum.equations, problem.noise)[1], posterior)
