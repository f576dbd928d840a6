"""Stage 5: robust rounds, and gates that accept or reject each measurement.

Solving with ever narrower Cauchy kernels keeps the solution out of the wrong minima to which wrong
labels and late ranges lead. A late range is too long, because it lacks the line of sight. At the
solution each measurement is accepted or rejected by a gate. Accepted sightings count in full.
Accepted ranges keep a one-sided kernel, which reduces the weight of late ranges only.
"""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from slamlib.slam.measurement_factors import MeasurementFactors, residuals
from slamlib.slam.noise import Noise, with_known
from slamlib.slam.optimizer import CONVERGED, optimize

CAUCHY_SCALES = (100.0, 30.0, 10.0, 3.0)     # sigmas, scale of the kernel in each round
MIN_RESIDUALS = 20           # number of measurements from which their scatter gives a factor
EARLY_GATE = 3.3             # sigmas; a range that is shorter than expected by more is rejected

_kernel = gtsam.noiseModel.mEstimator
# By name, scales in sigmas. Those of Huber, Cauchy and Tukey have 95 % efficiency on Gaussian noise
# (Zhang, Image and Vision Computing 15(1), 1997). GTSAM gives a kernel the sign of the error only
# if it weighs components.
_scalar = _kernel.Base.ReweightScheme.Scalar
KERNELS = {
    "quadratic": None,
    "Huber": _kernel.Huber.Create(1.345),
    "Cauchy": _kernel.Cauchy.Create(2.385),
    "Geman-McClure": _kernel.GemanMcClure.Create(3.0),
    "Tukey": _kernel.Tukey.Create(4.685),
    "asymmetric Cauchy": _kernel.AsymmetricCauchy.Create(2.385, _scalar),
    "asymmetric Tukey": _kernel.AsymmetricTukey.Create(4.685, _scalar)}
ONE_SIDED = ("asymmetric Cauchy", "asymmetric Tukey")
LATE_KERNEL = KERNELS["asymmetric Tukey"]


@dataclass(frozen=True)
class Acceptance:
    """How measurements are accepted, and with which kernels."""

    sighting_kernel: gtsam.noiseModel.mEstimator.Base | None = None
    gated: bool = True           # whether sightings beyond their gate are rejected
    range_kernel: gtsam.noiseModel.mEstimator.Base | None = LATE_KERNEL
    early: float = EARLY_GATE    # sigmas; a range that is too short by more is rejected
    late: float = np.inf         # sigmas; the same, too long


def acceptance(kernel="asymmetric Tukey", gate=True):
    """The Acceptance with the kernel of this name in KERNELS, for sightings and ranges.

    A one-sided kernel is that of the ranges only, and replaces their gate for late ones. Without
    `gate` nothing is rejected. Raises ValueError if KERNELS has no such name.
    """
    if gate not in (True, False):
        raise ValueError(f"gate must be True or False, not {gate!r}")
    if kernel not in [*KERNELS]:                              # of any type, also not hashable
        raise ValueError(f"kernel must be one of {', '.join(KERNELS)}, not {kernel!r}")
    one_sided = kernel in ONE_SIDED
    return Acceptance(
        sighting_kernel=None if one_sided else KERNELS[kernel], gated=gate,
        range_kernel=KERNELS[kernel], early=EARLY_GATE if gate else np.inf,
        late=EARLY_GATE if gate and not one_sided else np.inf)


def narrow_kernels(problem, state, scales=CAUCHY_SCALES, converged=CONVERGED):
    """The State after one solution for each scale of the Cauchy kernel, with all measurements.

    The scales are in sigmas. After each solution the scatter of the residuals gives the noise of
    the problem. `converged` as in `optimize`.
    """
    m = problem.measurements
    for scale in scales:
        cauchy = _kernel.Cauchy.Create(scale)
        measured = MeasurementFactors(m, m.unit_weights, cauchy, cauchy)
        state = optimize(replace(problem, measured=measured), state, converged=converged).state
        problem = replace(problem, noise=noise_of_scatter(m, state))
    return state


def noise_of_scatter(measurements, state):
    """The Noise with typical slip and factors, at least 1, from the medians of the residuals.

    Without these factors, covariances that are far too small would have most measurements rejected
    before a factor is learned. Known noise parameters are kept.
    """
    sightings, ranges = residuals(measurements, state, Noise())
    # 2.366, 1.386 and 0.455 are the medians of chi-squared with 3, 2 and 1 degrees of freedom.
    squared = np.sum(sightings**2, axis=1) / np.where(measurements.as_pose, 2.366, 1.386)
    return with_known(
        Noise(sightings=_at_least_one(squared), ranges=_at_least_one(ranges**2 / 0.455)),
        measurements.dataset.vehicle)


def _at_least_one(squared):
    """Root of the median of squared residuals over that of chi-squared, if it exceeds 1."""
    return max(1.0, float(np.sqrt(np.median(squared)))) if len(squared) >= MIN_RESIDUALS else 1.0


def accepted(problem, state, rule=Acceptance()):
    """The MeasurementFactors that an Acceptance accepts at a State, with its kernels."""
    weight = within_gates(problem, state, rule.early, rule.late)
    if not rule.gated:
        weight[:len(problem.measurements.label)] = 1
    return MeasurementFactors(problem.measurements, weight, rule.sighting_kernel, rule.range_kernel)


def within_gates(problem, state, early, late):
    """Weights (s + r,): 1 within the gates, else 0.

    The gate of a sighting is the 99.9 % quantile of chi-squared with 3 degrees of freedom, or 2 for
    a point. A range may be too short by `early` and too long by `late` sigmas.
    """
    sightings, ranges = residuals(problem.measurements, state, problem.noise)
    return np.r_[np.sum(sightings**2, axis=1) < problem.measurements.gate,
                 (ranges > -early) & (ranges < late)].astype(float)
