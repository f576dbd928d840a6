"""Stage 7: the result of a fit, every encoder pose and landmark in world axes."""

from dataclasses import dataclass, replace

import numpy as np

from slamlib import se2
from slamlib.slam.covariances import covariances
from slamlib.slam.doubts import antenna_doubts
from slamlib.slam.interpolation import interpolate
from slamlib.slam.measurement_factors import MeasurementFactors, residuals


@dataclass(frozen=True)
class SlamResult:
    """The estimate of a drive: lengths in m, angles in rad, covariances in world axes."""

    poses: np.ndarray               # (n, 3), headings continuous
    covariances: np.ndarray         # (n, 3, 3)
    marker: np.ndarray              # (k,) ids, ascending; most sightings are accepted
    marker_in_world: np.ndarray     # (k, 3)
    marker_covariance: np.ndarray   # (k, 3, 3)
    antenna: np.ndarray             # (a,) ids, ascending, of antennas with ranges
    antenna_in_world: np.ndarray    # (a, 2)
    antenna_covariance: np.ndarray  # (a, 2, 2)
    doubts: dict                    # antenna id: sentence, for antennas in doubt
    wheel: np.ndarray               # (3,) R_R, R_L, b
    wheel_covariance: np.ndarray    # (3, 3)
    slip: float                     # sqrt(m), as given or learned
    model: str                      # "arc" or "euler", as given or chosen
    log_evidence: float             # Laplace, up to a constant of dataset and accepted measurements
    chi2_per_dof: float             # of the accepted measurements
    rejected: np.ndarray            # (s,) bool, beyond the gate, rows of Measurements.sightings
    residual: np.ndarray            # (s, 3) whitened residuals of the sightings
    range_weight: np.ndarray        # (r,) share of its information that each range keeps, 0 to 1
    range_residual: np.ndarray      # (r,) whitened, positive for a range that is too long


def result(fit):
    """The SlamResult of a Fit."""
    problem, state, m = fit.problem, fit.state, fit.problem.measurements
    measured, vehicle = problem.measured, m.dataset.vehicle
    marginal = covariances(problem, state)
    poses, pose_covariances = interpolate(problem, state, marginal.pairs)
    residual, range_residual = residuals(m, state)
    range_weight = measured.range_weight
    if measured.range_kernel is not None:
        range_weight = range_weight * [measured.range_kernel.weight(r) for r in range_residual]
    doubts = antenna_doubts(m, state, pose_covariances[m.frame], marginal.antennas, range_weight)
    mapped, marker_covariance = _mapped(measured, marginal.markers)
    markers = state.markers[mapped]
    markers[:, 2] = se2.wrap(markers[:, 2])
    return SlamResult(
        poses=poses, covariances=pose_covariances,
        marker=m.marker[mapped], marker_in_world=markers,
        marker_covariance=se2.rotate_covariance(
            marker_covariance[mapped], markers[:, 2] * m.oriented[mapped]),
        antenna=m.antenna, antenna_in_world=state.antennas, antenna_covariance=doubts.covariances,
        doubts=doubts.sentences, wheel=vehicle.wheel + vehicle.sigma_wheel * state.w,
        wheel_covariance=vehicle.sigma_wheel[:, None] * marginal.w * vehicle.sigma_wheel,
        slip=float(problem.slip), model=problem.odometry.model,
        log_evidence=float(fit.log_evidence),
        chi2_per_dof=_chi2_per_dof(problem, state, range_weight),
        rejected=measured.sighting_weight == 0, residual=residual,
        range_weight=range_weight, range_residual=range_residual)


def _mapped(measured, blocks):
    """Rows of the markers of which more sightings are accepted than rejected, and all covariances.

    The covariances (k, 3, 3) are in GTSAM's axes. The heading of a point has the variance of its
    best sighting.
    """
    m, accepted = measured.measurements, measured.sighting_weight > 0
    agree, differ = (np.bincount(m.label[which], minlength=len(m.marker))
                     for which in (accepted, ~accepted))
    padded = np.zeros((len(m.marker), 3, 3))
    for j, (block, oriented) in enumerate(zip(blocks, m.oriented)):
        padded[j, :len(block), :len(block)] = block
        if not oriented:
            padded[j, 2, 2] = m.sightings.C[m.label == j, 2, 2].min()
    return np.flatnonzero(agree > differ), padded


def _chi2_per_dof(problem, state, range_weight):
    """Chi-squared with the final weights, over its degrees of freedom.

    A measurement counts by its dimension (a range by its weight), and a landmark takes its own.
    Odometry and priors have as many errors as there are poses and wheel parameters.
    """
    m, accepted = problem.measurements, problem.measured.sighting_weight > 0
    quadratic = MeasurementFactors(m, np.r_[accepted, range_weight])
    used = np.bincount(m.label[accepted], np.where(m.as_pose[accepted], 3, 2), len(m.marker))
    freedom = np.sum(np.maximum(used - np.where(m.oriented, 3, 2), 0)) \
        + np.sum(range_weight) - 2 * len(m.antenna)
    return 2 * replace(problem, measured=quadratic).error(state) / max(1, freedom)
