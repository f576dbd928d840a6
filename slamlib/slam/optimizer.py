"""Stage 3: Gauss-Newton with step halving.

A step solves the normal equations in numpy and scipy, all factors of a kind at once, or is GTSAM's,
which builds, linearises and eliminates the same graph factor by factor. Start values, kernels and
noise take dozens of steps, by the normal equations. GTSAM takes the last steps of every solution,
and all steps where the normal equations are singular to rounding.
"""

from dataclasses import dataclass

from slamlib.slam.gtsam_graph import gtsam_step
from slamlib.slam.normal_equations import NormalEquations
from slamlib.slam.state import State, retract

CONVERGED = 1e-6             # decrease, over 1 + error, at which iterations end
ROUNDING = 1e-12             # relative increase of the error that is due to float rounding
MAX_GAUSS_NEWTON_STEPS = 40  # number of steps
MAX_HALVINGS = 8             # number of halvings of one step


@dataclass(frozen=True)
class Optimum:
    """The end of Gauss-Newton."""

    equations: NormalEquations
    steps: int                         # number of steps taken

    @property
    def state(self) -> State:
        """The State where the error is smallest."""
        return self.equations.state

    @property
    def error(self):
        """Half the sum of squared whitened errors, kernels applied."""
        return self.equations.error


def optimize(problem, state, max_steps=MAX_GAUSS_NEWTON_STEPS, by_gtsam=False,
             converged=CONVERGED):
    """The Optimum of a Problem from a State.

    It ends where the error decreases by at most `converged` times (1 + error). Raises DatasetError
    if the measurements do not determine every variable.
    """
    equations, steps, ended = NormalEquations(problem, state), 0, False
    while steps < max_steps and not ended:
        steps += 1
        state, error = equations.state, equations.error
        step = None if by_gtsam else equations.step()
        equations = None                                   # of a long drive they are large
        if step is None:
            step = gtsam_step(problem, state)
        for _ in range(MAX_HALVINGS):
            equations = NormalEquations(problem, retract(problem.measurements, state, step))
            if equations.error <= (1 + ROUNDING) * error:
                break
            step = step / 2
        else:
            equations = NormalEquations(problem, state)
            break
        ended = error - equations.error <= converged * (1 + error)
    return Optimum(equations, steps)
