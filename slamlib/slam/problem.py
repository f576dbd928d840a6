"""Stage 3: the factor graph: measurements, odometry and noise.

Factors are those of the measurements (`measurement_factors.py`) and the odometry
(`odometry_factors.py`). The same w acts in every increment. One shared variable models this;
independent noise in each factor does not.
"""

from dataclasses import dataclass

import numpy as np

from slamlib.slam.measurement_factors import MeasurementFactors
from slamlib.slam.measurements import Measurements
from slamlib.slam.noise import Noise
from slamlib.slam.odometry_factors import OdometryFactors, odometry_factors


@dataclass(frozen=True)
class Problem:
    """The factor graph."""

    measurements: Measurements
    odometry: OdometryFactors
    measured: MeasurementFactors
    noise: Noise


def build(measurements, model, noise, relinearize_at=np.zeros(3), factors=odometry_factors):
    """The Problem of all Measurements at weight 1, without kernels.

    The odometry is linear about w = `relinearize_at` (3,), its steps are of the model "arc" or
    "euler", its noise and that of the measurements is by a Noise. `factors` makes the
    OdometryFactors; studies give others.
    """
    return Problem(measurements, factors(measurements, model, relinearize_at),
                   MeasurementFactors(measurements, measurements.unit_weights), noise)
