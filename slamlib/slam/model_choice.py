"""Stage 6: the model of the odometry steps, arcs or Euler's, chosen by the evidence."""

from dataclasses import replace

import numpy as np

from slamlib.slam.evidence import laplace_approximation
from slamlib.slam.fit import refine
from slamlib.slam.measurement_factors import linearize_ranges
from slamlib.slam.noise_learning import greatest_log_density, log_density
from slamlib.slam.normal_equations import NormalEquations
from slamlib.slam.odometry_factors import preintegrate_odometry

DECISIVE_LEAD = 3.0          # difference of log evidence from which a model replaces the default


def better_model(fit, model):
    """The Fit of another model of odometry if its evidence leads by DECISIVE_LEAD, else `fit`.

    Both evidences are on the same measurements with the same weights, so the weights that the
    kernel of the ranges gives at `fit` are kept. The noise is learned for each model.
    """
    current = replace(fit.problem, accepted=_with_fixed_weights(fit))
    odometry = preintegrate_odometry(current.measurements, model, fit.state.w)
    alternative = replace(current, odometry=odometry)
    lead = _log_density(NormalEquations(alternative, fit.state), fit.posterior) \
        - _log_density(NormalEquations(current, fit.state), fit.posterior,
                       is_greatest=not len(current.accepted.range_weight))
    if lead <= DECISIVE_LEAD:
        return fit
    return refine(replace(fit.problem, odometry=odometry), fit.state, accept=None)


def _with_fixed_weights(fit):
    """AcceptedMeasurements in which weights replace the kernel of the ranges."""
    accepted = fit.problem.accepted
    weight = accepted.weight.astype(float)
    ranges = np.flatnonzero(accepted.range_weight) + len(accepted.sighting_weight)
    weight[ranges] = linearize_ranges(accepted, fit.problem.noise, fit.state).weight
    return replace(accepted, weight=weight, range_kernel=None)


def _log_density(equations, posterior, is_greatest=False):
    """Log evidence of known noise, or greatest log posterior density of learned noise.

    If `is_greatest`, the noise of the equations' problem is the mode already.
    """
    if posterior is None or not posterior.covariance.any():          # nothing was learned
        return laplace_approximation(equations, equations.problem.noise)[1]
    return log_density(equations) if is_greatest else greatest_log_density(equations, posterior)
