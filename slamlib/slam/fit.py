"""Stage 6: wheels, noise and accepted measurements, estimated in turn until they agree."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slamlib.slam.acceptance import accepted_measurements
from slamlib.slam.evidence import laplace_approximation
from slamlib.slam.noise import with_known
from slamlib.slam.noise_learning import NoisePosterior, learn_noise
from slamlib.slam.normal_equations import NormalEquations
from slamlib.slam.odometry_factors import preintegrate_odometry
from slamlib.slam.optimizer import optimize
from slamlib.slam.problem import Problem
from slamlib.slam.robust import noise_of_scatter
from slamlib.slam.state import State

MAX_ROUNDS = 6               # number of rounds of wheels, noise and accepted measurements
NEGLIGIBLE_CHANGE = 1e-3     # share of the measurements whose weight may change at the same noise


@dataclass(frozen=True)
class Fit:
    """A problem with the state that solves it."""

    problem: Problem
    state: State
    log_evidence: float                  # Laplace, up to a constant
    posterior: NoisePosterior | None     # None if all noise parameters are known

    @cached_property
    def equations(self):
        """The NormalEquations at the state."""
        return NormalEquations(self.problem, self.state)


def solved_by_gtsam(fit):
    """The Fit after GTSAM's optimisation, started at the state of `fit`.

    Raises DatasetError as `optimize`.
    """
    return replace(fit, state=optimize(fit.problem, fit.state, by_gtsam=True).state)


def refine(problem, state, accept=accepted_measurements, preintegrate=preintegrate_odometry):
    """The Fit in which wheels, noise and accepted measurements agree with each other.

    They depend on each other, so each is updated in turn until the accepted measurements no longer
    change. From a Problem and a State near its solution. `accept` makes AcceptedMeasurements from
    Problem and State; None keeps those of the problem. `preintegrate` as in `build_problem`. Raises
    DatasetError as `optimize`, and numpy.linalg.LinAlgError if odometry's covariance is singular.
    """
    m, model, posterior = problem.measurements, problem.odometry.model, None
    if accept is not None:
        problem = replace(problem, noise=noise_of_scatter(m, state))
    accepted = problem.accepted if accept is None else accept(problem, state)
    changed = np.inf
    for _ in range(MAX_ROUNDS):
        problem = replace(problem, accepted=accepted, odometry=preintegrate(m, model, state.w))
        if m.learned.any() and changed > NEGLIGIBLE_CHANGE * len(accepted.weight):
            optimum = None                                 # frees the equations of the last round
            optimum = optimize(problem, state, max_steps=2)
            state, posterior = optimum.state, learn_noise(optimum.equations)
            problem = replace(problem, noise=with_known(posterior.noise, m.dataset.vehicle))
        optimum = None
        optimum = optimize(problem, state)
        state = optimum.state
        accepted = problem.accepted if accept is None else accept(problem, state)
        changed = np.count_nonzero(accepted.weight != problem.accepted.weight)
        if not changed:
            break
    _, log_evidence = laplace_approximation(optimum.equations, problem.noise)
    return Fit(problem, state, log_evidence, posterior)
