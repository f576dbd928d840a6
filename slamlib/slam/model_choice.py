"""Stage 6: whether the wheels drive in arcs or in Euler's steps, decided by the evidence."""

from dataclasses import replace

import numpy as np

from slamlib.slam.fit import refine
from slamlib.slam.odometry_factors import odometry_factors
from slamlib.slam.optimizer import log_evidence_of_slip, optimize
from slamlib.slam.slip import DECISIVE, maximum

NEARLY = 1.0                 # log evidence below DECISIVE at which the other model is solved too


def better_model(fit, model, slip=None):
    """The Fit of another model of the odometry steps if its evidence is DECISIVE, else `fit`.

    The evidences are those of the same accepted measurements. The slip in sqrt(m) is learned for
    each model if it is None. The other model is solved in full only if the greatest evidence of its
    linearised problem comes within NEARLY of being decisive.
    """
    other = replace(fit.problem, odometry=odometry_factors(
        fit.problem.measurements, model, fit.state.w))
    decisive = fit.log_evidence + DECISIVE
    near = optimize(other, fit.state, max_steps=2).state
    evidence = log_evidence_of_slip(other, near)
    ceiling = maximum(evidence)[1] if slip is None else evidence(np.log(fit.problem.slip))
    if ceiling <= decisive - NEARLY:
        return fit
    solved = refine(other, fit.state, slip, accept=None)
    return solved if solved.log_evidence > decisive else fit
