"""Stage 2: the factors of sightings and ranges, and the priors, by GTSAM.

* a prior on pose 1, which fixes the world frame, and the prior of table 2 on w;
* a between factor for every sighting, Z_ij = X_i^-1 L_j;
* a range factor for every range, r_ik = |A_k - (x_i, y_i)|, and the guess as a prior on A_k.

Two kinds of factors are not GTSAM's but those of `linear_factors.py`: sightings of points, whose
heading is unknown, and ranges whose offset and scale are variables.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, P, W, X, Z

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


def measurement_graph(factors, noise):
    """The gtsam.NonlinearFactorGraph of MeasurementFactors with the factors of a Noise."""
    m, graph, model = factors.measurements, gtsam.NonlinearFactorGraph(), gtsam.noiseModel
    weight = factors.sighting_weight / noise.sightings**2
    for k in np.flatnonzero(weight * m.as_pose):
        i, j, z, covariance = m.between_arguments[k]
        graph.add(gtsam.BetweenFactorPose2(i, j, z, _robust(
            factors.sighting_kernel, model.Gaussian.Covariance(covariance / weight[k]))))
    if not m.calibrated:
        sigma = noise.ranges * m.ranges.sigma
        for k in np.flatnonzero(factors.range_weight):
            graph.add(gtsam.RangeFactor2D(
                X(int(m.ranges.row[k])), A(int(m.ranges.antenna[k])), m.ranges.distance[k],
                _robust(factors.range_kernel, model.Isotropic.Sigma(
                    1, sigma[k] / np.sqrt(factors.range_weight[k])))))
    _add_priors(graph, factors)
    return graph


def _add_priors(graph, factors):
    m, model = factors.measurements, gtsam.noiseModel
    graph.add(gtsam.PriorFactorPose2(
        X(0), gtsam.Pose2(), model.Diagonal.Sigmas(m.origin_sigma)))
    graph.add(gtsam.PriorFactorVector(W(0), np.zeros(3), model.Unit.Create(3)))
    for j in factors.unsupported:
        graph.add(gtsam.PriorFactorPose2(
            L(j), gtsam.Pose2(), model.Isotropic.Sigma(3, WEAK_SIGMA)) if m.oriented[j]
            else gtsam.PriorFactorPoint2(
                P(j), np.zeros(2), model.Isotropic.Sigma(2, WEAK_SIGMA)))
    for k, position in enumerate(m.guess):
        graph.add(gtsam.PriorFactorPoint2(
            A(k), position, model.Isotropic.Sigma(2, GUESS_PRIOR_SIGMA)))
    if m.calibrated:
        graph.add(gtsam.PriorFactorVector(Z(0), np.zeros(2), model.Unit.Create(2)))


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


def _robust(kernel, noise):
    return gtsam.noiseModel.Robust.Create(kernel, noise) if kernel else noise
