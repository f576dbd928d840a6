"""Stage 7: the result of a fit: every encoder pose and landmark, with covariances.

Antennas whose position the ranges do not determine are in doubt, and their covariances include it.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib import se2
from slamlib.sightings import Sightings
from slamlib.slam.calibration import WHEELS, Calibration, calibration_table
from slamlib.slam.covariances import posterior_moments
from slamlib.slam.factors import MIN_DISTANCE, linearize_measurements, odometry_error
from slamlib.slam.fit import kept_weights, residuals
from slamlib.slam.initialization import (
    SAME_PLACE,
    ranges_by_antenna,
    second_moment,
    trilaterate,
)
from slamlib.slam.interpolation import interpolate
from slamlib.slam.measurements import GUESS_PRIOR_SIGMA, AcceptedMeasurements, Noise

MIN_ACCEPTED_RANGES = 5      # number of accepted ranges of an antenna that is not in doubt
MAX_RELATIVE_SIGMA = 0.025   # of the median range: largest sigma of an antenna not in doubt
MAX_LOG_ODDS = np.log(1000)  # log odds below which another position remains possible


@dataclass(frozen=True)
class SlamResult:
    """The estimate of a drive: lengths in m, angles in rad, covariances in world axes."""

    poses: np.ndarray               # (n, 3), headings continuous
    covariances: np.ndarray         # (n, 3, 3)
    marker: np.ndarray              # (k,) ids, ascending, of markers whose sightings are accepted
    marker_in_world: np.ndarray     # (k, 3)
    marker_covariance: np.ndarray   # (k, 3, 3)
    antenna: np.ndarray             # (a,) ids, ascending, of antennas with ranges
    antenna_in_world: np.ndarray    # (a, 2)
    antenna_covariance: np.ndarray  # (a, 2, 2)
    doubts: dict                    # antenna id: reason, for antennas in doubt
    calibration: Calibration        # p entries with what is stated of them
    c: np.ndarray                   # (p,) their estimates
    sigma: np.ndarray               # (p,) of their prior, 0 of what is known
    c_covariance: np.ndarray        # (p, p), 0 where the stated value is known
    released: frozenset             # groups of entries that left their stated values
    explanations: tuple             # of sets of groups, each of which explains this, or one empty
    noise: Noise                    # as given or learned
    noise_sigma: np.ndarray         # (3,) of its logarithms, 0 where not learned
    model: str                      # "arc" or "euler", as given or chosen
    log_evidence: float             # Laplace, up to a constant of dataset and accepted measurements
    chi2_per_dof: float             # of the accepted measurements, by the files' covariances
    chi2_per_dof_of_all: float      # the same of all measurements
    rejected: np.ndarray            # (s,) bool, beyond the gate, rows of Measurements.sightings
    residual: np.ndarray            # (s, 3) whitened residuals of the sightings
    range_weight: np.ndarray        # (r,) share of its information that each range keeps, 0 to 1
    range_residual: np.ndarray      # (r,) whitened, positive for a range that is too long
    sightings: Sightings            # s of them, and the frames
    turn_sigma: np.ndarray          # (f-1,) rad, of odometry's turns between frames, stated wheels
    converged: bool                 # whether the last iterations ended before their number did

    @property
    def slip(self):
        """Standard deviation of a wheel's slip after one metre, sqrt(m), as given or learned."""
        return self.noise.slip

    @property
    def calibration_table(self):
        """List of a dict for each of the p entries, by `calibration.calibration_table`."""
        return calibration_table(self.calibration, self.c, self.c_covariance, self.released)

    @property
    def wheel(self):
        """Wheel parameters R_R, R_L, b, (3,) m."""
        return self.c[WHEELS]

    @property
    def wheel_covariance(self):
        """Their covariance (3, 3), m^2."""
        return self.c_covariance[WHEELS, WHEELS]


def slam_result(fit):
    """The SlamResult of a Fit.

    Raises DatasetError and LinAlgError as `marginal_covariances`.
    """
    problem, m = fit.problem, fit.problem.measurements
    state, marginal, slip = posterior_moments(fit)
    poses, pose_covariances = interpolate(
        replace(problem, noise=replace(problem.noise, slip=slip)), state, marginal.pairs)
    residual, range_residual = residuals(m, state, problem.noise)
    sighting_weight, range_weight = kept_weights(problem.accepted, residual, range_residual)
    mapped, marker_covariance = _mapped(problem, marginal.markers)
    markers = state.markers[mapped]
    markers[:, 2] = se2.wrap(markers[:, 2])
    sentences, antenna_covariances = antenna_doubts(
        problem, state, pose_covariances[m.frame], marginal.antennas, range_weight)
    return SlamResult(
        poses=poses, covariances=pose_covariances,
        marker=m.marker[mapped], marker_in_world=markers,
        marker_covariance=se2.rotate_covariance(
            marker_covariance[mapped], markers[:, 2] * m.oriented[mapped]),
        antenna=m.antenna, antenna_in_world=state.antennas,
        antenna_covariance=antenna_covariances, doubts=sentences,
        calibration=m.calibration, c=state.c, sigma=problem.sigma, c_covariance=marginal.c,
        released=problem.released, explanations=fit.explanations,
        noise=problem.noise, noise_sigma=np.zeros(3) if fit.posterior is None
        else np.sqrt(np.diag(fit.posterior.covariance)),
        model=problem.odometry.model, log_evidence=float(fit.log_evidence),
        chi2_per_dof=chi2_per_dof(problem, state, np.r_[sighting_weight, range_weight]),
        chi2_per_dof_of_all=chi2_per_dof(problem, state, m.unit_weights),
        rejected=problem.accepted.sighting_weight == 0, residual=residual,
        range_weight=range_weight, range_residual=range_residual,
        sightings=m.sightings, turn_sigma=turn_sigma(problem), converged=fit.converged)


def turn_sigma(problem):
    """Standard deviations (f-1,), rad, of the turns between frames by odometry of stated wheels.

    Estimated wheels adapt to a wrong number of turns.
    """
    stated, odometry = problem.measurements.dataset.vehicle, problem.odometry
    variance = np.sum((odometry.J_wheel[:, 2] * stated.sigma_wheel)**2, axis=1)
    return np.sqrt(variance + odometry.covariance(problem.noise.slip)[:, 2, 2])


def antenna_doubts(problem, state, frame_covariances, covariances, range_weight):
    """Reasons to doubt antennas, and covariances that include the doubt, at a Problem's solution.

    From covariances (f, 3, 3) of the frames and (a, 2, 2) of the antennas, in world axes, and the
    share `range_weight` (r,) of its information that each range keeps.

    Returns
    -------
    sentences : dict of the reason for each antenna in doubt, by its id.
    covariances : (a, 2, 2) m^2, in doubt at least the second moment of the position.
    """
    m, r, sentences, covariances = (
        problem.measurements, problem.measurements.ranges, {}, covariances.copy())
    by_antenna = ranges_by_antenna(
        m, state.poses, frame_covariances, state.c, problem.noise.ranges)
    for k, (antenna, ranges) in enumerate(zip(m.antenna.tolist(), by_antenna)):
        sentence = _doubt(ranges, state.antennas[k], range_weight[r.antenna == k])
        if sentence is not None:
            sentences[antenna] = sentence
            covariances[k] = max(covariances[k], second_moment(ranges, state.antennas[k]),
                                 key=np.trace)
    return sentences, covariances


def _doubt(ranges, estimate, weight):
    """The reason why an antenna is in doubt whose ranges have the weights (m,), or None."""
    distance, count = np.median(ranges.distance), np.count_nonzero(weight > 0.5)
    places, costs = trilaterate(ranges)
    elsewhere = np.hypot(*(places - estimate).T) > SAME_PLACE * distance
    possible = places[elsewhere & (costs < MAX_LOG_ODDS)]
    if count < MIN_ACCEPTED_RANGES:
        return f"only {count} of its {len(ranges.distance)} ranges agree"
    if len(possible):
        return "its ranges fit as well at " + " and ".join(dict.fromkeys(
            "({:.1f}, {:.1f})".format(*place) for place in possible))
    if count < len(ranges.distance) / 2:
        return f"{len(ranges.distance) - count} of its {len(ranges.distance)} ranges disagree"
    if _sigma_by_ranges(ranges, estimate, weight) > MAX_RELATIVE_SIGMA * distance:
        return "its ranges are too few or come from too few directions"
    return None


def _sigma_by_ranges(ranges, estimate, weight):
    """Largest standard deviation in m of an antenna, in any direction, by its ranges alone.

    Its covariance in the world also includes the uncertain heading of pose 1, which rotates the
    whole map.
    """
    difference = estimate - ranges.positions
    direction = difference / np.maximum(np.hypot(*difference.T), MIN_DISTANCE)[:, None]
    information = direction.T @ (direction * (weight / ranges.sigma**2)[:, None])
    return 1 / np.sqrt(max(np.linalg.eigvalsh(information)[0], GUESS_PRIOR_SIGMA**-2))


def _mapped(problem, blocks):
    """Rows of the markers with more accepted than rejected sightings, and covariances of all.

    The covariances (k, 3, 3) are in GTSAM's axes. The heading of a point has the variance of its
    best sighting.
    """
    m, accepted = problem.measurements, problem.accepted.sighting_weight > 0
    balance = np.bincount(m.marker_row, np.where(accepted, 1, -1), len(m.marker))
    covariances = np.zeros((len(m.marker), 3, 3))
    for j, block in enumerate(blocks):
        covariances[j, :len(block), :len(block)] = block
        if not m.oriented[j]:
            covariances[j, 2, 2] = m.sightings.C[m.marker_row == j, 2, 2].min()
    return np.flatnonzero(balance > 0), covariances


def chi2_per_dof(problem, state, weight):
    """Chi-squared by the covariances in the files, over its degrees of freedom.

    With weights (s + r,), a measurement counts by its dimension times its weight, and a landmark
    subtracts its dimension. Odometry and priors have as many errors as poses and calibration
    have unknowns.
    """
    m = problem.measurements
    sightings, ranges = np.split(weight, [len(m.marker_row)])
    accepted = AcceptedMeasurements(measurements=m, weight=weight)
    stated = replace(problem, accepted=accepted, noise=Noise())
    e, *_ = odometry_error(problem.odometry, state.poses, state.c[WHEELS])
    U, _ = problem.odometry.whitening(problem.noise.slip)
    e_c = (state.c - m.calibration.stated)[problem.active] / problem.sigma[problem.active]
    squared = np.sum((U @ e[..., None])**2) + e_c @ e_c + 2 * sum(
        factors.error for factors in linearize_measurements(stated, state))
    used = np.bincount(m.marker_row, sightings * np.where(m.as_pose, 3, 2), len(m.marker))
    freedom = np.sum(np.maximum(used - np.where(m.oriented, 3, 2), 0)) \
        + np.sum(ranges) - 2 * len(m.antenna)
    return float(squared / max(1, freedom))
