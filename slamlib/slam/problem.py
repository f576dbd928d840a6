"""Stage 2: the factor graph: odometry, accepted measurements and noise.

All odometry factors share the variable w, because the same wheel errors act in every increment.
Independent noise in each factor would not model this.
"""

from dataclasses import dataclass

import numpy as np

from slamlib.slam.acceptance import AcceptedMeasurements
from slamlib.slam.measurements import Measurements
from slamlib.slam.noise import Noise
from slamlib.slam.odometry_factors import OdometryFactors, preintegrate_odometry


@dataclass(frozen=True)
class Problem:
    """The factor graph."""

    odometry: OdometryFactors
    accepted: AcceptedMeasurements
    noise: Noise

    @property
    def measurements(self) -> Measurements:
        """The Measurements."""
        return self.accepted.measurements


def build_problem(measurements, model, noise, relinearize_at=np.zeros(3),
                  preintegrate=preintegrate_odometry):
    """The Problem of all Measurements with weight 1, without kernels, and of a Noise.

    `preintegrate` makes the OdometryFactors of steps of the `model`, "arc" or "euler", linearised
    at w = `relinearize_at` (3,); studies pass other functions.
    """
    return Problem(preintegrate(measurements, model, relinearize_at),
                   AcceptedMeasurements(measurements, measurements.unit_weights), noise)
