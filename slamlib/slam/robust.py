"""Stage 5: robust rounds with ever narrower kernels, and the noise by the scatter of residuals.

The rounds keep the solution out of the wrong minima to which wrong labels and late ranges lead.
"""

from dataclasses import replace

import gtsam
import numpy as np

from slamlib.slam.acceptance import AcceptedMeasurements, residuals
from slamlib.slam.noise import Noise, with_known
from slamlib.slam.optimizer import CONVERGED, optimize

CAUCHY_SCALES = (100.0, 30.0, 10.0, 3.0)     # sigmas, scale of the kernel in each round
MIN_RESIDUALS = 20           # number of measurements from which their scatter gives a factor
MEDIAN_CHI2 = {3: 2.366, 2: 1.386, 1: 0.455}         # medians by degrees of freedom


def narrow_kernels(problem, state, scales=CAUCHY_SCALES, converged=CONVERGED):
    """The State after one solution for each scale of the Cauchy kernel, with all measurements.

    The scales are in sigmas. The scatter of the residuals of each solution gives the noise of the
    next. `converged` as in `optimize`. Raises DatasetError as `optimize`.
    """
    m = problem.measurements
    for number, scale in enumerate(scales):
        if number:                                   # the caller judges the last solution
            problem = replace(problem, noise=noise_of_scatter(m, state))
        cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(scale)
        accepted = AcceptedMeasurements(m, m.unit_weights, cauchy, cauchy)
        state = optimize(replace(problem, accepted=accepted), state, converged=converged).state
    return state


def noise_of_scatter(measurements, state):
    """The Noise with typical slip and factors, at least 1, from the medians of the residuals.

    Without these factors, covariances that are far too small would have most measurements rejected
    before a factor is learned. Known noise parameters are kept.
    """
    sightings, ranges = residuals(measurements, state, Noise())
    squared = np.sum(sightings**2, axis=1) / np.where(
        measurements.as_pose, MEDIAN_CHI2[3], MEDIAN_CHI2[2])
    return with_known(
        Noise(sightings=_at_least_one(squared), ranges=_at_least_one(ranges**2 / MEDIAN_CHI2[1])),
        measurements.dataset.vehicle)


def _at_least_one(squared):
    """Root of the median of squared residuals over that of chi-squared, if it exceeds 1."""
    return max(1.0, float(np.sqrt(np.median(squared)))) if len(squared) >= MIN_RESIDUALS else 1.0
