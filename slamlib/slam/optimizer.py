"""Stage 3: a problem is solved by Gauss-Newton with step halving.

A step solves the normal equations in numpy and scipy, all factors of a kind at once. Or it is
GTSAM's, which builds, linearises and eliminates the same graph factor by factor. Start values,
kernels and noise take dozens of steps, by the normal equations. GTSAM then takes the last ones
(`estimate`), and it decides where the normal equations are singular to rounding.
"""

from dataclasses import dataclass

from slamlib.slam.gtsam_graph import gtsam_step
from slamlib.slam.normal_equations import NormalEquations
from slamlib.slam.state import State, moved

CONVERGED = 1e-6             # relative decrease of the error at which iterations end
ROUNDING = 1e-12             # relative increase of the error that means nothing
MAX_STEPS = 40               # of Gauss-Newton
MAX_HALVINGS = 8             # of one step


@dataclass(frozen=True)
class Optimum:
    """Where Gauss-Newton ends."""

    equations: NormalEquations
    steps: int

    @property
    def state(self) -> State:
        """The State."""
        return self.equations.state

    @property
    def error(self):
        """Half the sum of squared whitened errors, kernels applied."""
        return self.equations.error


def optimize(problem, state, max_steps=MAX_STEPS, by_gtsam=False, converged=CONVERGED):
    """The Optimum from a State, where the error decreases by less than its share `converged`.

    Raises DatasetError where the measurements do not determine every variable.
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
            equations = NormalEquations(problem, moved(problem.measurements, state, step))
            if equations.error <= (1 + ROUNDING) * error:
                break
            step = step / 2
        else:
            equations = NormalEquations(problem, state)
            break
        ended = error - equations.error <= converged * (1 + error)
    return Optimum(equations, steps)
