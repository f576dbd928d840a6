"""Stage 6: whether the wheels drive in arcs or in Euler's steps, decided by the evidence."""

from dataclasses import replace

import numpy as np

from slamlib.slam.evidence import log_evidence
from slamlib.slam.fit import refine
from slamlib.slam.linear_factors import range_factors
from slamlib.slam.noise_posterior import greatest_density
from slamlib.slam.odometry_factors import odometry_factors
from slamlib.slam.optimizer import optimize

DECISIVE = 3.0               # log evidence by which data prefer a model to the default


def better_model(fit, model, slip=None):
    """The Fit of another model of the odometry steps if its evidence is DECISIVE, else `fit`.

    The evidences are those of the same measurements with the same weights, so the weights that the
    kernel of the ranges gives at `fit` are kept. The noise is learned for each model if `slip`, in
    sqrt(m), is None.
    """
    own = replace(fit.problem, measured=_with_fixed_weights(fit))
    other = replace(own, odometry=odometry_factors(own.measurements, model, fit.state.w))
    lead = _log_density(other, optimize(other, fit.state).state, slip) \
        - _log_density(own, fit.state, slip)
    if lead <= DECISIVE:
        return fit
    return refine(replace(fit.problem, odometry=other.odometry), fit.state, slip, accept=None)


def _with_fixed_weights(fit):
    """MeasurementFactors without a kernel of the ranges, whose weights are those it gives."""
    measured = fit.problem.measured
    weight = measured.weight.astype(float)
    ranges = np.flatnonzero(measured.range_weight) + len(measured.sighting_weight)
    weight[ranges] = range_factors(measured, fit.problem.noise, fit.state).weight
    return replace(measured, weight=weight, range_kernel=None)


def _log_density(problem, state, slip):
    """Log evidence of a given noise, or log posterior of a learned one."""
    return (greatest_density if slip is None else log_evidence)(problem, state)
