"""Stage 6: the slip of the wheels, learned from the drive by the evidence of the graph."""

import numpy as np
from scipy.optimize import minimize_scalar

from slamlib.increments import SLIP_BOUNDS, TYPICAL_SLIP, log_slip_prior
from slamlib.slam.optimizer import log_evidence_of_slip

DECISIVE = 3.0               # log evidence by which data prefer a slip, or a model, to the default
TOLERANCE = 0.05             # of the logarithm of the slip
POSTERIOR = np.arange(-4, 5) / 2     # log slips about the mode at which the posterior is summed


def assumed_slip(slip):
    """The slip to start from, sqrt(m): the given one, at least SLIP_BOUNDS[0], or TYPICAL_SLIP."""
    return TYPICAL_SLIP if slip is None else max(slip, SLIP_BOUNDS[0])


def learned_slip(problem, state):
    """The slip in sqrt(m) that the drive supports, at a State near the solution of the Problem.

    If the evidence prefers another slip to TYPICAL_SLIP by more than DECISIVE, it is the slip of
    greatest evidence. Otherwise it is the root mean square of the slip under evidence times prior,
    which averages the variance over plausible slips.
    """
    evidence = log_evidence_of_slip(problem, state)

    def log_posterior(log_slip):
        return evidence(log_slip) + log_slip_prior(log_slip)

    best, most = maximum(evidence)
    if most - evidence(np.log(TYPICAL_SLIP)) > DECISIVE:
        return float(np.exp(best))
    mode, most = maximum(log_posterior)
    log_slips = mode + POSTERIOR
    density = np.exp([min(0.0, log_posterior(s) - most) if s != mode else 0.0 for s in log_slips])
    mean_square = np.sum(density * np.exp(2 * log_slips)) / np.sum(density)
    return float(np.clip(np.sqrt(mean_square), *SLIP_BOUNDS))


def maximum(function):
    """Argument and value of the maximum of a function of the log slip within SLIP_BOUNDS.

    The bounded search never reaches its bounds, so the lower one, no slip, is tried as well.
    """
    found = minimize_scalar(lambda s: -function(s), bounds=np.log(SLIP_BOUNDS), method="bounded",
                            options={"xatol": TOLERANCE})
    none = np.log(SLIP_BOUNDS[0])
    return max((found.x, -found.fun), (none, function(none)), key=lambda point: point[1])
