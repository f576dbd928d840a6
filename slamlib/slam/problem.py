"""Stage 3: the factor graph: measurements, odometry and noise, evaluated at a state.

Factors are those of the measurements (`measurement_factors.py`) and the odometry
(`odometry_factors.py`). The same w acts in every increment. One shared variable models this;
independent noise in each factor does not.

The odometry is linearised in numpy. As a custom factor in Python it would be slow, because GTSAM
copies all values for every call.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from slamlib.slam.linear_factors import point_factors, range_factors
from slamlib.slam.measurement_factors import MeasurementFactors, measurement_graph
from slamlib.slam.measurements import Measurements
from slamlib.slam.noise import Noise
from slamlib.slam.odometry_factors import OdometryFactors, odometry_error, odometry_factors


@dataclass(frozen=True)
class Problem:
    """The factor graph."""

    measurements: Measurements
    odometry: OdometryFactors
    measured: MeasurementFactors
    noise: Noise

    @cached_property
    def graph(self):
        """The gtsam.NonlinearFactorGraph of GTSAM's factors."""
        return measurement_graph(self.measured, self.noise)

    @cached_property
    def whitening(self):
        """U (f-1, 3, 3), square root information of the odometry noise: U^T U = noise^-1."""
        noise = self.odometry.noise(self.noise.slip)
        return np.swapaxes(np.linalg.cholesky(np.linalg.inv(noise)), 1, 2)

    def odometry_jacobians(self, state):
        """Whitened errors (f-1, 3) of the odometry, and a list of their whitened derivatives.

        The derivatives (f-1, 3, 3) are by X_i, X_{i+1} and w.
        """
        U = self.whitening
        e, *jacobians = odometry_error(self.odometry, state.poses, state.w)
        return (U @ e[..., None])[..., 0], [U @ J for J in jacobians]

    def other_factors(self, state):
        """LinearFactors of what GTSAM has no factors for: points, and ranges with a calibration."""
        others = [point_factors(self.measured, self.noise, state)]
        if self.measurements.calibrated:
            others.append(range_factors(self.measured, self.noise, state))
        return others

    def error(self, state):
        """Half the sum of squared whitened errors, kernels applied."""
        e, *_ = odometry_error(self.odometry, state.poses, state.w)
        e = self.whitening @ e[..., None]
        return self.graph.error(state.values) + np.sum(e**2) / 2 \
            + sum(factors.error for factors in self.other_factors(state))


def build(measurements, model, noise, relinearize_at=np.zeros(3), factors=odometry_factors):
    """The Problem of all Measurements at weight 1, without kernels.

    The odometry is linear about w = `relinearize_at` (3,), its steps are of the model "arc" or
    "euler", its noise and that of the measurements is by a Noise. `factors` makes the
    OdometryFactors; studies give others.
    """
    return Problem(measurements, factors(measurements, model, relinearize_at),
                   MeasurementFactors(measurements, measurements.unit_weights), noise)
