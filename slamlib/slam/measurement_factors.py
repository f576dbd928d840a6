"""Stage 2: the factors of sightings and ranges, and the priors, by GTSAM (all but points).

* a prior on pose 1, which fixes the world frame, and the prior of table 2 on w;
* a between factor for every sighting, Z_ij = X_i^-1 L_j; for a point its position only, in numpy;
* a range factor for every range, r_ik = |A_k - (x_i, y_i)|, and the guess as a prior on A_k.
"""

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, P, W, X

from slamlib import se2
from slamlib.slam.errors import point_error
from slamlib.slam.measurements import Measurements

WEAK_SIGMA = 1e5             # m and rad, prior of a marker without accepted sightings
GUESS_PRIOR_SIGMA = 5.0      # m, of a guessed antenna position: decides where ranges do not


@dataclass(frozen=True)
class MeasurementFactors:
    """The factors of the accepted measurements, with robust kernels.

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

    @cached_property
    def graph(self):
        """The gtsam.NonlinearFactorGraph of priors, sightings of poses, and ranges."""
        m, graph, model = self.measurements, gtsam.NonlinearFactorGraph(), gtsam.noiseModel
        weight, range_weight = self.sighting_weight, self.range_weight
        graph.add(gtsam.PriorFactorPose2(
            X(0), gtsam.Pose2(), model.Diagonal.Sigmas(m.origin_sigma)))
        graph.add(gtsam.PriorFactorVector(W(0), np.zeros(3), model.Unit.Create(3)))
        for k in np.flatnonzero(weight * m.as_pose):
            i, j, z, covariance = m.between_arguments[k]
            graph.add(gtsam.BetweenFactorPose2(i, j, z, _robust(
                self.sighting_kernel, model.Gaussian.Covariance(covariance / weight[k]))))
        for j in self.unsupported:
            graph.add(gtsam.PriorFactorPose2(
                L(j), gtsam.Pose2(), model.Isotropic.Sigma(3, WEAK_SIGMA)) if m.oriented[j]
                else gtsam.PriorFactorPoint2(
                    P(j), np.zeros(2), model.Isotropic.Sigma(2, WEAK_SIGMA)))
        for k in np.flatnonzero(range_weight):
            noise = model.Isotropic.Sigma(1, m.ranges.sigma[k] / np.sqrt(range_weight[k]))
            graph.add(gtsam.RangeFactor2D(
                X(int(m.ranges.row[k])), A(int(m.ranges.antenna[k])), m.ranges.distance[k],
                _robust(self.range_kernel, noise)))
        for k, position in enumerate(m.guess):
            graph.add(gtsam.PriorFactorPoint2(
                A(k), position, model.Isotropic.Sigma(2, GUESS_PRIOR_SIGMA)))
        return graph


@dataclass(frozen=True)
class PointFactors:
    """The accepted sightings of points, whitened and weighted by their kernel."""

    row: np.ndarray          # (m,) frame
    label: np.ndarray        # (m,) marker
    e: np.ndarray            # (m, 2)
    by_pose: np.ndarray      # (m, 2, 3)
    by_point: np.ndarray     # (m, 2, 2)
    error: float             # half the sum of squares, or the kernel's loss


def point_factors(factors, state):
    """The PointFactors of MeasurementFactors at a State."""
    m, kernel = factors.measurements, factors.sighting_kernel
    rows = np.flatnonzero((factors.sighting_weight > 0) & ~m.as_pose)
    row, label = m.sightings.row[rows], m.label[rows]
    e, *J = point_error(m.sightings.z[rows, :2], state.poses[row], state.markers[label, :2])
    C = m.sightings.C[rows, :2, :2] / factors.sighting_weight[rows, None, None]
    root = np.swapaxes(np.linalg.cholesky(np.linalg.inv(C)), 1, 2)
    size = np.linalg.norm(root @ e[..., None], axis=(1, 2))
    error = np.sum(size**2) / 2 if kernel is None else sum(kernel.loss(d) for d in size)
    if kernel is not None:
        root *= np.sqrt([kernel.weight(d) for d in size])[:, None, None]
    return PointFactors(row=row, label=label, e=(root @ e[..., None])[..., 0],
                        by_pose=root @ J[0], by_point=root @ J[1], error=error)


def residuals(measurements, state):
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
    expected = np.hypot(*(state.antennas[m.ranges.antenna] - state.poses[m.ranges.row, :2]).T)
    return (np.linalg.solve(np.linalg.cholesky(C), off[..., None])[..., 0],
            (m.ranges.distance - expected) / m.ranges.sigma)


def _robust(kernel, noise):
    return gtsam.noiseModel.Robust.Create(kernel, noise) if kernel else noise
