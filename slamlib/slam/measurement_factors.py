"""Stage 2: weights and robust kernels of the factors of sightings and ranges."""

from dataclasses import dataclass

import gtsam
import numpy as np

from slamlib import se2
from slamlib.slam.measurements import Measurements

WEAK_SIGMA = 1e5             # m and rad, weak prior of markers without accepted sightings
GUESS_PRIOR_SIGMA = 5.0      # m, prior of an antenna at its guessed position


@dataclass(frozen=True)
class MeasurementFactors:
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
        return self.weight[:len(self.measurements.label)].astype(float)

    @property
    def range_weight(self):
        """(r,) weights of the ranges."""
        return self.weight[len(self.measurements.label):].astype(float)

    @property
    def unsupported(self):
        """(u,) rows in `Measurements.marker` of the markers without accepted sightings."""
        m = self.measurements
        return np.flatnonzero(np.bincount(m.label, self.sighting_weight, len(m.marker)) == 0)


def kept_weights(factors, sightings, ranges):
    """Shares of its information, (s,) and (r,), that each measurement keeps, by gates and kernels.

    From MeasurementFactors and the `residuals` of sightings (s, 3) and of ranges (r,).
    """
    def reweighted(weight, kernel, sizes):
        return weight * ([kernel.weight(size) for size in sizes] if kernel else 1.0)

    return (reweighted(factors.sighting_weight, factors.sighting_kernel,
                       np.linalg.norm(sightings, axis=1)),
            reweighted(factors.range_weight, factors.range_kernel, ranges))


def residuals(measurements, state, noise):
    """Whitened residuals, measured minus expected, without kernels, at a State and a Noise.

    Returns
    -------
    (s, 3) of the sightings, in the axes of the vehicle; the third is 0 if the marker is a point.
    (r,) of the ranges, positive for a range that is too long.
    """
    m, s = measurements, measurements.sightings
    difference = s.z - se2.between(state.poses[s.row], state.markers[m.label])
    difference[:, 2] = se2.wrap(difference[:, 2]) * m.as_pose
    C = s.C.copy()
    C[~m.as_pose, 2] = C[~m.as_pose, :, 2] = [0, 0, 1]          # an independent heading
    offset, scale = state.range_calibration
    expected = offset + scale * np.hypot(
        *(state.antennas[m.ranges.antenna] - state.poses[m.ranges.row, :2]).T)
    return (np.linalg.solve(np.linalg.cholesky(C), difference[..., None])[..., 0] / noise.sightings,
            (m.ranges.distance - expected) / m.ranges.sigma / noise.ranges)
