"""Stage 6: wheels, slip and accepted measurements that agree with each other."""

from dataclasses import dataclass, replace

from slamlib.slam.odometry_factors import odometry_factors
from slamlib.slam.optimizer import log_evidence, optimize
from slamlib.slam.problem import Problem
from slamlib.slam.robust import accepted
from slamlib.slam.slip import assumed_slip, learned_slip
from slamlib.slam.state import State

MAX_ROUNDS = 4               # of wheels, slip and accepted measurements


@dataclass(frozen=True)
class Fit:
    """A problem with the state that solves it."""

    problem: Problem
    state: State
    log_evidence: float


def refine(problem, state, slip=None, accept=accepted, factors=odometry_factors):
    """The Fit in which wheels, slip and accepted measurements agree with each other.

    They depend on each other, so each is updated in turn until the accepted measurements no longer
    change. From a Problem and a State near its solution. The slip in sqrt(m) is learned if it is
    None. `accept` makes MeasurementFactors from Problem and State; None keeps the problem's.
    `factors` as of `problem.build`.
    """
    m, model = problem.measurements, problem.odometry.model
    measured = problem.measured if accept is None else accept(problem, state)
    problem = replace(problem, slip=assumed_slip(slip))
    for _ in range(MAX_ROUNDS):
        problem = replace(problem, measured=measured, odometry=factors(m, model, state.w))
        if slip is None:
            state = optimize(problem, state, max_steps=2).state
            problem = replace(problem, slip=learned_slip(problem, state))
        state = optimize(problem, state).state
        measured = problem.measured if accept is None else accept(problem, state)
        if (measured.weight == problem.measured.weight).all():
            break
    return Fit(problem, state, log_evidence(problem, state))
