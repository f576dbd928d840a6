"""Stage 4: which measurements agree. Robust kernels find them, and gates reject the others.

Solving with ever narrower Cauchy kernels keeps wrong labels and late ranges from trapping the
solution. A late range is too long, because it lacks the line of sight. At the solution each
measurement is accepted or rejected by a gate. Accepted sightings count in full. Accepted ranges
keep a one-sided kernel, which reduces the weight of late ranges only.
"""

from dataclasses import replace

import gtsam
import numpy as np

from slamlib.slam.measurement_factors import MeasurementFactors, residuals
from slamlib.slam.noise import Noise
from slamlib.slam.optimizer import CONVERGED, optimize

CAUCHY_SCALES = (100.0, 30.0, 10.0, 3.0)     # sigmas, scale of the kernel in each round
FEW = 20                     # measurements, below which their scatter gives no factor
EARLY_GATE = 3.3             # sigmas; a range that is shorter than expected by more is rejected

_kernel = gtsam.noiseModel.mEstimator
# Tukey's scale, 4.685 sigmas, has 95 % efficiency on Gaussian noise (Zhang, Image and Vision
# Computing 15(1), 1997). GTSAM gives a kernel the sign of the error only if it weighs components.
LATE_KERNEL = _kernel.AsymmetricTukey.Create(4.685, _kernel.Base.ReweightScheme.Scalar)


def narrow_kernels(problem, state, scales=CAUCHY_SCALES, learn=True, converged=CONVERGED):
    """The State after one solution for each scale of the Cauchy kernel, with all measurements.

    The scales are in sigmas of the problem's noise. Unless `learn` is False, this is what the
    scatter of the residuals shows after each solution. `converged` as of `optimize`.
    """
    m = problem.measurements
    for scale in scales:
        cauchy = _kernel.Cauchy.Create(scale)
        measured = MeasurementFactors(m, m.unit_weights, cauchy, cauchy)
        state = optimize(replace(problem, measured=measured), state, converged=converged).state
        if learn:
            problem = replace(problem, noise=noise_of_scatter(m, state))
    return state


def noise_of_scatter(measurements, state):
    """Noise of typical slip whose factors, at least 1, are the residuals' medians at a State.

    Covariances that are far too small would otherwise have most measurements rejected before a
    factor is learned.
    """
    sightings, ranges = residuals(measurements, state, Noise())
    # 2.366, 1.386 and 0.455 are the medians of chi-squared with 3, 2 and 1 degrees of freedom.
    squared = np.sum(sightings**2, axis=1) / np.where(measurements.as_pose, 2.366, 1.386)
    return Noise(sightings=_at_least_one(squared), ranges=_at_least_one(ranges**2 / 0.455))


def _at_least_one(squared):
    """Root of the median of squared residuals over that of chi-squared, if it exceeds 1."""
    return max(1.0, float(np.sqrt(np.median(squared)))) if len(squared) >= FEW else 1.0


def accepted(problem, state):
    """MeasurementFactors of what the gates accept at a State; ranges have LATE_KERNEL."""
    weight = within_gates(problem, state, EARLY_GATE, np.inf)
    return MeasurementFactors(problem.measurements, weight, range_kernel=LATE_KERNEL)


def within_gates(problem, state, early, late):
    """Weights (s + r,): 1 within the gates, else 0.

    The gate of a sighting is the 99.9 % quantile of chi-squared with 3 degrees of freedom, 2 for a
    point. A range may be too short by `early` and too long by `late` sigmas.
    """
    sightings, ranges = residuals(problem.measurements, state, problem.noise)
    return np.r_[np.sum(sightings**2, axis=1) < problem.measurements.gate,
                 (ranges > -early) & (ranges < late)].astype(float)
