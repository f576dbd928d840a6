"""Stage 6: a common offset and scale of the ranges, kept where the evidence decides for them."""

from dataclasses import replace

from slamlib.slam.evidence import log_evidence
from slamlib.slam.fit import refine
from slamlib.slam.model_choice import DECISIVE
from slamlib.slam.state import state_from_arrays


def calibrated(fit, slip=None):
    """The Fit with offset and scale of the ranges as variables if its evidence is DECISIVE.

    Otherwise `fit`. Both are compared at the state and on the accepted measurements of `fit`.
    """
    problem, state = fit.problem, fit.state
    if not len(problem.measurements.ranges.row):
        return fit
    m = replace(problem.measurements, calibrated=True)
    other = replace(problem, measurements=m, measured=replace(problem.measured, measurements=m))
    start = state_from_arrays(m, state.poses, state.markers, state.antennas, state.w)
    if log_evidence(other, start) < fit.log_evidence + DECISIVE:
        return fit
    return refine(other, start, slip)
