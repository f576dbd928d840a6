"""Stage 2: the factor graph as records: values of its variables, odometry, and what weighs it.

Variables (`State`) are the frames' poses X_i, the markers L_j (points P_j if no sighting has a
heading), the antennas A_k, and the calibration c. The noise of an increment Delta, with covariance
Q, is the quantization of the encoders and wheel slip, in the axes of the increment's end.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import increments, odometry, se2
from slamlib.slam.measurements import (
    AcceptedMeasurements,
    Measurements,
    Noise,
    square_root_information,
)

MINIMUM_SIGMA = 1e-5         # m, standard deviation of an increment's end along x and y


@dataclass(frozen=True)
class State:
    """Values of all variables."""

    poses: np.ndarray        # (f, 3) m, m, rad; headings continuous
    markers: np.ndarray      # (k, 3), heading 0 where a marker is a point
    antennas: np.ndarray     # (a, 2) m
    c: np.ndarray            # (p,) of the calibration, in the units of its entries


def state_from_arrays(measurements, poses, markers, antennas, c):
    """The State of poses (f, 3), markers (k, 3), antennas (a, 2) and calibration c (p,).

    Headings become continuous: between two frames they turn by odometry's angle, up to half a turn.
    """
    turn, poses = measurements.turn, np.array(poses, dtype=float)
    correction = se2.wrap(np.diff(poses[:, 2]) - turn)
    poses[:, 2] = odometry.cumulative(turn + correction, se2.wrap(poses[0, 2]))
    markers = np.array(markers, dtype=float)
    markers[~measurements.oriented, 2] = 0
    return State(poses=poses, markers=markers, antennas=np.asarray(antennas, dtype=float),
                 c=np.asarray(c, dtype=float))


def retract(problem, state, delta):
    """The State after a step delta (n + q,) in m and rad, and in sigmas of the q unknowns of c.

    Poses and markers move in their own axes, as GTSAM's do: X becomes X delta.
    """
    m = problem.measurements
    v, rows, markers, c = m.variables, m.structure.rows, state.markers.copy(), state.c.copy()
    markers[m.oriented] = se2.compose(
        markers[m.oriented], delta[rows(v.markers[m.oriented], 3)])
    markers[~m.oriented, :2] += delta[rows(v.markers[~m.oriented], 2)]
    c[problem.active] += problem.sigma[problem.active] * delta[len(m.structure.diagonal):]
    return state_from_arrays(
        m, se2.compose(state.poses, delta[rows(v.frames, 3)]), markers,
        state.antennas + delta[rows(v.antennas, 2)], c)


@dataclass(frozen=True)
class OdometryFactors:
    """Odometry factors between consecutive frames, for every value of the slip."""

    model: str               # of a step, "arc" or "euler"
    stated: np.ndarray       # (3,) m, wheel parameters as stated, to which the covariances belong
    wheel: np.ndarray        # (3,) m, those of linearisation
    increment: np.ndarray    # (f-1, 3) Delta(wheel): m, m, rad
    J_wheel: np.ndarray      # (f-1, 3, 3) dDelta/dwheel, per m
    quantization: np.ndarray  # (f-1, 3, 3) covariance without slip, in the axes of the end
    slipping: np.ndarray     # (f-1, 3, 3) covariance of slip 1 sqrt(m), in the same axes
    in_counts: bool = False  # whether errors are scaled to the stated wheels: with known slip

    def covariance(self, slip):
        """Covariances Q (f-1, 3, 3) for a slip in sqrt(m)."""
        return self.quantization + slip**2 * self.slipping

    def whitening(self, slip):
        """Square root information U (f-1, 3, 3), U^T U = Q^-1, and sum log|Q|, for a slip."""
        U = square_root_information(self.covariance(slip))
        return U, -2 * float(np.sum(np.log(np.diagonal(U, axis1=1, axis2=2))))


def preintegrate_odometry(measurements, model, wheel=None):
    """The OdometryFactors of Measurements, linearised at `wheel` (3,) m, None for that stated.

    `model` is "arc" or "euler". dDelta/dwheel accumulates over the encoder steps between two frames
    (preintegration with calibration parameters: Forster et al., IEEE T-RO 33(1), 2017).
    """
    dataset, start, end = measurements.dataset, measurements.frame[:-1], measurements.frame[1:]
    vehicle = dataset.vehicle if wheel is None else dataset.vehicle.with_wheel(wheel)
    increment, by_wheel = increments.between_poses(dataset.ticks, vehicle, start, end, model)
    quantization, slipping = (se2.rotate_covariance(part, -increment[:, 2]) for part in
                              odometry_noise(dataset.ticks, dataset.vehicle, start, end))
    return OdometryFactors(
        model=model, stated=dataset.vehicle.wheel, wheel=vehicle.wheel, increment=increment,
        J_wheel=by_wheel, quantization=quantization, slipping=slipping)


def odometry_noise(ticks, vehicle, start, end, steps=None):
    """Quantization and slipping (m, 3, 3) by `increments.noise_in_drive`, made regular.

    A vehicle that stands still has no lateral noise, but the graph needs the inverse of
    Q: MINIMUM_SIGMA is added. Axes are those of the increments' starts, lengths in m.
    """
    quantization, slipping = increments.noise_in_drive(ticks, vehicle, start, end, steps)
    quantization[:, [0, 1], [0, 1]] += MINIMUM_SIGMA**2
    return quantization, slipping


@dataclass(frozen=True)
class Problem:
    """The factor graph."""

    odometry: OdometryFactors
    accepted: AcceptedMeasurements
    noise: Noise
    sigma: np.ndarray        # (p,) of the prior of the calibration, 0 of what is known
    released: frozenset = frozenset()    # groups of the calibration beyond their stated sigmas

    @property
    def measurements(self) -> Measurements:
        """The Measurements."""
        return self.accepted.measurements

    @property
    def active(self):
        """(p,) bool, entries of the calibration that are among the q unknowns."""
        return self.sigma > 0


def build_problem(measurements, model, noise, wheel=None, preintegrate=preintegrate_odometry):
    """The Problem of all Measurements with weight 1, without kernels, and of a Noise.

    `preintegrate` makes the OdometryFactors of steps of the `model`, "arc" or "euler", linearised
    at `wheel` (3,) m, None for the stated one; studies pass other functions. The calibration is as
    stated.
    """
    return Problem(
        odometry=preintegrate(measurements, model, wheel),
        accepted=AcceptedMeasurements(
            measurements=measurements, weight=measurements.unit_weights), noise=noise,
        sigma=measurements.calibration.sigma)
