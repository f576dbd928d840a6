"""Stage 6: a common offset and scale of the ranges, but where the evidence decides against them.

Where it does not decide, they remain variables: an offset that is possible moves the antennas.
"""

from dataclasses import replace

from slamlib.slam.evidence import log_evidence
from slamlib.slam.fit import refine
from slamlib.slam.model_choice import DECISIVE
from slamlib.slam.robust import accepted
from slamlib.slam.state import state_from_arrays


def calibrated(fit, accept=accepted):
    """The Fit with offset and scale of the ranges as variables.

    `fit` itself where its evidence leads by DECISIVE or there are no ranges. Both are compared at
    its state and on its accepted measurements. `accept` as of `fit.refine`.
    """
    problem, state = fit.problem, fit.state
    if not len(problem.measurements.ranges.row):
        return fit
    m = problem.measurements.calibrating()
    other = replace(problem, measurements=m, measured=replace(problem.measured, measurements=m))
    start = state_from_arrays(m, state.poses, state.markers, state.antennas, state.w)
    if log_evidence(other, start) < fit.log_evidence - DECISIVE:
        return fit
    return refine(other, start, accept)
