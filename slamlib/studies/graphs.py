"""The evidence of the noise, over the slip."""

from dataclasses import replace

import numpy as np

from slamlib.slam.calibration import WHEELS
from slamlib.slam.factors import preintegrate_odometry
from slamlib.slam.graph import optimize
from slamlib.slam.linear import laplace_approximation


def evidence_curve(fit, slips, model):
    """Log evidence (len(slips),) of slips in sqrt(m), each at its own optimum.

    The measurements are those that the Fit accepts, whatever the model of the odometry steps.
    """
    factors = replace(preintegrate_odometry(
        fit.problem.measurements, model, fit.state.c[WHEELS]), in_counts=True)
    problem, state, curve = replace(fit.problem, odometry=factors), fit.state, []
    for slip in slips:
        problem = replace(problem, noise=replace(problem.noise, slip=slip))
        optimum = optimize(problem, state)
        state = optimum.state
        curve.append(laplace_approximation(optimum.equations, problem.noise)[1])
    return np.array(curve)
