"""Stage 6: a common offset and scale of the ranges, estimated unless the evidence rejects them.

Without a decision they remain variables: a possible offset makes the antennas less certain.
"""

from dataclasses import replace

from slamlib.slam.acceptance import accepted_measurements
from slamlib.slam.evidence import log_evidence
from slamlib.slam.fit import refine
from slamlib.slam.model_choice import DECISIVE_LEAD


def calibrated(fit, accept=accepted_measurements):
    """The Fit with offset and scale of the ranges as variables.

    `fit` itself if its evidence leads by DECISIVE_LEAD or if there are no ranges. Both are compared
    at its state and on its accepted measurements. `accept` and errors raised as in `refine`.
    """
    if not len(fit.problem.measurements.ranges.row):
        return fit
    m = replace(fit.problem.measurements, calibrated=True)
    problem = replace(fit.problem, accepted=replace(fit.problem.accepted, measurements=m))
    if log_evidence(problem, fit.state) < fit.log_evidence - DECISIVE_LEAD:
        return fit
    return refine(problem, fit.state, accept)
