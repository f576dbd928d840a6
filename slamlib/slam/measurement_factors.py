"""Stage 2: the factors of sightings and ranges: which are accepted, and their robust kernels."""

from dataclasses import dataclass

import gtsam
import numpy as np

from slamlib import se2
from slamlib.slam.measurements import Measurements

WEAK_SIGMA = 1e5             # m and rad, prior of a marker without accepted sightings
GUESS_PRIOR_SIGMA = 5.0      # m, of a guessed antenna position: decides where ranges do not


@dataclass(frozen=True)
class MeasurementFactors:
    """The accepted measurements and their robust kernels.

    A weight is the share of its information that a measurement keeps: 0 if it is rejected, 1 if it
    is accepted. Graduated non-convexity and chi-squared also use weights between them.
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
        """(u,) rows of the markers without accepted sightings."""
        m = self.measurements
        return np.flatnonzero(np.bincount(m.label, self.sighting_weight, len(m.marker)) == 0)


def kept_weights(factors, sightings, ranges):
    """Shares of its information, (s,) and (r,), that each measurement keeps, by gates and kernels.

    From MeasurementFactors and the `residuals` of sightings (s, 3) and of ranges (r,).
    """
    sizes = np.linalg.norm(sightings, axis=1), ranges
    return tuple(weight * ([kernel.weight(size) for size in each] if kernel else 1.0)
                 for weight, kernel, each in zip(
                     (factors.sighting_weight, factors.range_weight),
                     (factors.sighting_kernel, factors.range_kernel), sizes))


def residuals(measurements, state, noise):
    """Whitened measured minus expected values, without kernels.

    Returns
    -------
    (s, 3) of the sightings, in the axes of the vehicle; the heading of a point's is 0.
    (r,) of the ranges, positive for a range that is too long.
    """
    m, s = measurements, measurements.sightings
    off = s.z - se2.between(state.poses[s.row], state.markers[m.label])
    off[:, 2] = se2.wrap(off[:, 2]) * m.as_pose
    C = s.C.copy()
    C[~m.as_pose, 2] = C[~m.as_pose, :, 2] = [0, 0, 1]          # an independent heading
    offset, scale = state.range_calibration
    expected = offset + scale * np.hypot(
        *(state.antennas[m.ranges.antenna] - state.poses[m.ranges.row, :2]).T)
    return (np.linalg.solve(np.linalg.cholesky(C), off[..., None])[..., 0] / noise.sightings,
            (m.ranges.distance - expected) / m.ranges.sigma / noise.ranges)
