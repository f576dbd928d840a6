"""Stage 6: whether the wheels drive in arcs or in Euler's steps, decided by the evidence."""

from dataclasses import replace

import numpy as np

from slamlib.slam.evidence import solve
from slamlib.slam.fit import refine
from slamlib.slam.linear_factors import range_factors
from slamlib.slam.noise_posterior import density, greatest_density
from slamlib.slam.normal_equations import NormalEquations
from slamlib.slam.odometry_factors import odometry_factors

DECISIVE = 3.0               # log evidence by which data prefer a model to the default


def better_model(fit, model):
    """The Fit of another model of the odometry steps if its evidence is DECISIVE, else `fit`.

    The evidences are those of the same measurements with the same weights, so the weights that the
    kernel of the ranges gives at `fit` are kept. The noise is learned for each model.
    """
    own = replace(fit.problem, measured=_with_fixed_weights(fit))
    other = replace(own, odometry=odometry_factors(own.measurements, model, fit.state.w))
    lead = _log_density(NormalEquations(other, fit.state), fit.posterior) \
        - _log_density(NormalEquations(own, fit.state), fit.posterior,
                       is_greatest=not len(own.measured.range_weight))
    if lead <= DECISIVE:
        return fit
    return refine(replace(fit.problem, odometry=other.odometry), fit.state, accept=None)


def _with_fixed_weights(fit):
    """MeasurementFactors without a kernel of the ranges, whose weights are those it gives."""
    measured = fit.problem.measured
    weight = measured.weight.astype(float)
    ranges = np.flatnonzero(measured.range_weight) + len(measured.sighting_weight)
    weight[ranges] = range_factors(measured, fit.problem.noise, fit.state).weight
    return replace(measured, weight=weight, range_kernel=None)


def _log_density(equations, posterior, is_greatest=False):
    """Log evidence of a given noise, or greatest log density of one with this NoisePosterior.

    It is that of the equations' own noise if it `is_greatest` there.
    """
    if posterior is None or not posterior.covariance.any():          # given, or not to be learned
        return solve(equations, equations.problem.noise)[1]
    return density(equations) if is_greatest else greatest_density(equations, posterior)
