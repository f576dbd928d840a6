"""Stage 2: the accepted measurements: their weights, robust kernels and gates.

Accepted sightings count in full. Accepted ranges keep a one-sided kernel, which reduces the weight
of late ranges only. A late range is too long, because it lacks the line of sight.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from slamlib import se2
from slamlib.sightings import GATE, POINT_GATE
from slamlib.slam.measurements import Measurements

EARLY_GATE = 3.3             # sigmas; a range that is shorter than expected by more is rejected

_kernel = gtsam.noiseModel.mEstimator
# By name, scales in sigmas. Those of Huber, Cauchy and Tukey have 95 % efficiency on Gaussian noise
# (Zhang, Image and Vision Computing 15(1), 1997). Asymmetric kernels need signed errors, which
# GTSAM passes to them with the scheme Scalar.
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
class AcceptedMeasurements:
    """The accepted measurements and their robust kernels.

    A weight is the share of its information that a measurement keeps: 0 if it is rejected, 1 if it
    is accepted. Graduated non-convexity and chi-squared also use weights between 0 and 1.
    """

    measurements: Measurements
    weight: np.ndarray                       # (s + r,) sightings, then ranges
    sighting_kernel: gtsam.noiseModel.mEstimator.Base | None = None      # None: quadratic
    range_kernel: gtsam.noiseModel.mEstimator.Base | None = None

    @property
    def sighting_weight(self):
        """(s,) weights of the sightings."""
        return self.weight[:len(self.measurements.marker_row)].astype(float)

    @property
    def range_weight(self):
        """(r,) weights of the ranges."""
        return self.weight[len(self.measurements.marker_row):].astype(float)

    @property
    def unsupported(self):
        """(u,) rows in `Measurements.marker` of the markers without accepted sightings."""
        m = self.measurements
        return np.flatnonzero(np.bincount(m.marker_row, self.sighting_weight, len(m.marker)) == 0)


@dataclass(frozen=True)
class AcceptanceRule:
    """How measurements are accepted, and with which kernels."""

    sighting_kernel: gtsam.noiseModel.mEstimator.Base | None = None
    gated: bool = True           # whether sightings beyond their gate are rejected
    range_kernel: gtsam.noiseModel.mEstimator.Base | None = LATE_KERNEL
    early: float = EARLY_GATE    # sigmas; a range that is too short by more is rejected
    late: float = np.inf         # sigmas; the same, too long


def acceptance_rule(kernel="asymmetric Tukey", gate=True):
    """The AcceptanceRule with the kernel of this name in KERNELS, for sightings and ranges.

    A one-sided kernel is that of the ranges only, and replaces their gate for late ones. Without
    `gate` nothing is rejected. Raises ValueError if KERNELS has no such name.
    """
    if gate not in (True, False):
        raise ValueError(f"gate must be True or False, not {gate!r}")
    if kernel not in [*KERNELS]:                              # of any type, also not hashable
        raise ValueError(f"kernel must be one of {', '.join(KERNELS)}, not {kernel!r}")
    one_sided = kernel in ONE_SIDED
    return AcceptanceRule(
        sighting_kernel=None if one_sided else KERNELS[kernel], gated=gate,
        range_kernel=KERNELS[kernel], early=EARLY_GATE if gate else np.inf,
        late=EARLY_GATE if gate and not one_sided else np.inf)


def accepted_measurements(problem, state, rule=AcceptanceRule()):
    """The AcceptedMeasurements that an AcceptanceRule accepts at a State, with its kernels."""
    weight = gate_weights(problem, state, rule.early, rule.late)
    if not rule.gated:
        weight[:len(problem.measurements.marker_row)] = 1
    return AcceptedMeasurements(
        problem.measurements, weight, rule.sighting_kernel, rule.range_kernel)


def gate_weights(problem, state, early, late):
    """Weights (s + r,): 1 within the gates, else 0.

    The gate of a sighting is the 99.9 % quantile of chi-squared with 3 degrees of freedom, or 2 for
    a point. A range may be too short by `early` and too long by `late` sigmas.
    """
    sightings, ranges = residuals(problem.measurements, state, problem.noise)
    squared_gate = np.where(problem.measurements.as_pose, GATE, POINT_GATE)
    return np.r_[np.sum(sightings**2, axis=1) < squared_gate,
                 (ranges > -early) & (ranges < late)].astype(float)


def kept_weights(accepted, sighting_residuals, range_residuals):
    """Shares of its information, (s,) and (r,), that each measurement keeps, by gates and kernels.

    From AcceptedMeasurements and the `residuals` of sightings (s, 3) and of ranges (r,).
    """
    def reweighted(weight, kernel, sizes):
        return weight * ([kernel.weight(size) for size in sizes] if kernel else 1.0)

    return (reweighted(accepted.sighting_weight, accepted.sighting_kernel,
                       np.linalg.norm(sighting_residuals, axis=1)),
            reweighted(accepted.range_weight, accepted.range_kernel, range_residuals))


def residuals(measurements, state, noise):
    """Whitened residuals, measured minus expected, without kernels, at a State and a Noise.

    Returns
    -------
    (s, 3) of the sightings, in the axes of the vehicle; the third is 0 if the marker is a point.
    (r,) of the ranges, positive for a range that is too long.

    The errors e of the factors have the opposite sign, and those of a marker with a heading are
    se2.log of a motion. These residuals are differences of coordinates: their gates need no more.
    """
    m, s = measurements, measurements.sightings
    difference = s.z - se2.between(state.poses[s.row], state.markers[m.marker_row])
    difference[:, 2] = se2.wrap(difference[:, 2]) * m.as_pose
    C = s.C.copy()
    C[~m.as_pose, 2] = C[~m.as_pose, :, 2] = [0, 0, 1]          # an independent heading
    offset, scale = state.range_calibration
    expected = offset + scale * np.hypot(
        *(state.antennas[m.ranges.antenna] - state.poses[m.ranges.row, :2]).T)
    return (np.linalg.solve(np.linalg.cholesky(C), difference[..., None])[..., 0] / noise.sightings,
            (m.ranges.distance - expected) / m.ranges.sigma / noise.ranges)
