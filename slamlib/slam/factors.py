"""Stage 2: the factor graph: values of its variables, and its factors, in numpy.

Variables (`State`) are the frames' poses X_i, the markers L_j (points P_j if no sighting has a
heading), the antennas A_k, the errors w of the wheel parameters, and the calibration c of the
ranges. All factors of a kind are linearised at once.

Odometry: with the increment Delta(w) = Delta(0) + dDelta/dw w between the frames X and X' the error

    e = log(Delta(w)^-1 X^-1 X')

is that of GTSAM's between factor, except that the measurement depends on w. All odometry factors
share w, because the same wheel errors act in every increment. The noise of Delta, with covariance
Q, is the quantization of the encoders and wheel slip, in the axes of the increment's end. All
derivatives by w are per standard deviation of a wheel parameter; those of
`increments.between_poses` are per metre.

Measurements: the factor of a marker with a heading is GTSAM's between factor, that of a range its
range factor. Without headings a marker is a point. They are whitened, and weighted by their
kernels. Derivatives by poses are by GTSAM's tangent vectors: X moves as X exp(xi), in its own axes.
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

CALIBRATION_SIGMA = np.array([0.2, 0.05])    # m and 1, prior of offset and scale of the ranges
MINIMUM_SIGMA = 1e-5         # m, standard deviation of an increment's end along x and y
MIN_DISTANCE = 1e-9          # m, below which a range has no direction


@dataclass(frozen=True)
class State:
    """Values of all variables."""

    poses: np.ndarray        # (f, 3) m, m, rad; headings continuous
    markers: np.ndarray      # (k, 3), heading 0 where a marker is a point
    antennas: np.ndarray     # (a, 2) m
    w: np.ndarray            # (3,) in units of sigma
    c: np.ndarray            # (2,) in units of CALIBRATION_SIGMA, 0 without calibration

    @property
    def range_calibration(self):
        """(2,) offset in m and scale of the ranges: measured = offset + scale * distance."""
        return np.array([0.0, 1.0]) + CALIBRATION_SIGMA * self.c


def state_from_arrays(measurements, poses, markers, antennas, w, c=np.zeros(2)):
    """The State of poses (f, 3), markers (k, 3), antennas (a, 2), w (3,) and c (2,).

    Headings become continuous: between two frames they turn by odometry's angle, up to half a turn.
    """
    turn, poses = measurements.turn, np.array(poses, dtype=float)
    correction = se2.wrap(np.diff(poses[:, 2]) - turn)
    poses[:, 2] = odometry.cumulative(turn + correction, se2.wrap(poses[0, 2]))
    markers = np.array(markers, dtype=float)
    markers[~measurements.oriented, 2] = 0
    return State(poses=poses, markers=markers, antennas=np.asarray(antennas, dtype=float),
                 w=np.asarray(w, dtype=float), c=np.asarray(c, dtype=float))


def retract(measurements, state, delta):
    """The State after a step delta (n,) in m and rad, of w and c without unit.

    Poses and markers move in their own axes, as GTSAM's do: X becomes X delta.
    """
    m, v, rows = measurements, measurements.variables, measurements.structure.rows
    markers = state.markers.copy()
    markers[m.oriented] = se2.compose(
        markers[m.oriented], delta[rows(v.markers[m.oriented], 3)])
    markers[~m.oriented, :2] += delta[rows(v.markers[~m.oriented], 2)]
    return state_from_arrays(
        m, se2.compose(state.poses, delta[rows(v.frames, 3)]), markers,
        state.antennas + delta[rows(v.antennas, 2)], state.w + delta[rows(v.w, 3)[0]],
        state.c + delta[rows(v.c, 2)[0]] if m.calibrated else state.c)


def between_error(z, first, second):
    """Errors log(z^-1 X^-1 X') (m, 3) and their derivatives by X, X', and the coordinates of z.

    Measured poses z, first poses X and second poses X' are (m, 3), m, m, rad; the derivatives
    (m, 3, 3). GTSAM: BetweenFactorPose2.
    """
    h = se2.between(first, second)
    difference = se2.between(z, h)
    log_jacobian, origin = se2.log_jacobian(difference), np.zeros(3)
    _, by_second = se2.compose_jacobians(difference, origin)         # difference xi for X' xi
    h_by_first, _ = se2.compose_jacobians(origin, h)                 # xi^-1 h for X xi
    by_z, by_h = se2.between_jacobians(z, h)
    return (se2.log(difference), -log_jacobian @ by_h @ h_by_first, log_jacobian @ by_second,
            log_jacobian @ by_z)


@dataclass(frozen=True)
class OdometryFactors:
    """Odometry factors between consecutive frames, for every value of the slip."""

    model: str               # of a step, "arc" or "euler"
    increment: np.ndarray    # (f-1, 3) Delta(0), extrapolated linearly: m, m, rad
    J_w: np.ndarray          # (f-1, 3, 3) dDelta/dw, per sigma of each wheel parameter
    quantization: np.ndarray  # (f-1, 3, 3) covariance without slip, in the axes of the end
    slipping: np.ndarray     # (f-1, 3, 3) covariance of slip 1 sqrt(m), in the same axes

    def covariance(self, slip):
        """Covariances Q (f-1, 3, 3) for a slip in sqrt(m)."""
        return self.quantization + slip**2 * self.slipping

    def whitening(self, slip):
        """Square root information U (f-1, 3, 3), U^T U = Q^-1, and sum log|Q|, for a slip."""
        U = square_root_information(self.covariance(slip))
        return U, -2 * float(np.sum(np.log(np.diagonal(U, axis1=1, axis2=2))))


def preintegrate_odometry(measurements, model, relinearize_at=(0.0, 0.0, 0.0)):
    """The OdometryFactors of Measurements, linearised at w = `relinearize_at` (3,).

    `model` is "arc" or "euler". dDelta/dw accumulates over the encoder steps between two frames
    (preintegration with calibration parameters: Forster et al., IEEE T-RO 33(1), 2017).
    """
    dataset, start, end = measurements.dataset, measurements.frame[:-1], measurements.frame[1:]
    vehicle = dataset.vehicle.with_deviation(np.asarray(relinearize_at))
    increment, by_wheel = increments.between_poses(dataset.ticks, vehicle, start, end, model)
    quantization, slipping = odometry_noise(dataset.ticks, vehicle, start, end)
    by_w, turn = by_wheel * vehicle.sigma_wheel, -increment[:, 2]
    return OdometryFactors(
        model=model, increment=increment - by_w @ relinearize_at, J_w=by_w,
        quantization=se2.rotate_covariance(quantization, turn),
        slipping=se2.rotate_covariance(slipping, turn))


def odometry_noise(ticks, vehicle, start, end, steps=None):
    """Quantization and slipping (m, 3, 3) by `increments.noise_in_drive`, made regular.

    A vehicle that stands still has no lateral noise, but the graph needs the inverse of
    Q: MINIMUM_SIGMA is added. Axes are those of the increments' starts, lengths in m.
    """
    quantization, slipping = increments.noise_in_drive(ticks, vehicle, start, end, steps)
    quantization[:, [0, 1], [0, 1]] += MINIMUM_SIGMA**2
    return quantization, slipping


def odometry_error(factors, poses, w):
    """Errors (f-1, 3) of OdometryFactors, and their derivatives (f-1, 3, 9) by X_i, X_{i+1} and w.

    At poses (f, 3) of the frames and w (3,). The errors are not whitened.
    """
    increment = factors.increment + factors.J_w @ w
    e, by_first, by_second, by_increment = between_error(increment, poses[:-1], poses[1:])
    return e, np.concatenate([by_first, by_second, by_increment @ factors.J_w], axis=2)


@dataclass(frozen=True)
class LinearizedMeasurements:
    """The m accepted measurements of one kind, linearised at a state, with d errors each."""

    index: np.ndarray        # (m,) row among all measurements of the kind
    row: np.ndarray          # (m,) frame
    landmark: np.ndarray     # (m,) row of the marker, or k plus row of the antenna
    e: np.ndarray            # (m, d) whitened errors, expected minus measured
    J: np.ndarray            # (m, d, p) whitened derivatives by the unknowns of pose, landmark, c
    weight: np.ndarray       # (m,) share of its information that a measurement keeps
    error: float             # half the sum of squared errors, or the loss of the kernel


def linearize_measurements(accepted, noise, state):
    """The LinearizedMeasurements of sightings of poses, of points, and of ranges.

    From AcceptedMeasurements, a Noise and a State.
    """
    return (linearize_sightings(accepted, noise, state, as_pose=True),
            linearize_sightings(accepted, noise, state, as_pose=False),
            linearize_ranges(accepted, noise, state))


def linearize_sightings(accepted, noise, state, as_pose):
    """The LinearizedMeasurements of markers with a heading (`as_pose`), or of points."""
    m, s = accepted.measurements, accepted.measurements.sightings
    kind = np.flatnonzero(m.as_pose == as_pose)
    index = np.flatnonzero(accepted.sighting_weight[kind])
    rows = kind[index]
    pose, marker = state.poses[s.row[rows]], state.markers[m.marker_row[rows]]
    e, by_pose, by_marker, *_ = between_error(s.z[rows], pose, marker) if as_pose \
        else point_error(s.z[rows, :2], pose, marker[:, :2])
    U = m.sighting_roots[0 if as_pose else 1][rows]
    return _whitened(index, s.row[rows], m.marker_row[rows], e, [by_pose, by_marker], U,
                     accepted.sighting_weight[rows], noise.sightings, accepted.sighting_kernel)


def linearize_ranges(accepted, noise, state):
    """The LinearizedMeasurements of the ranges at a State, whitened by a Noise.

    The expected range in m is offset + scale * distance, with the range calibration of the State.
    """
    m, r = accepted.measurements, accepted.measurements.ranges
    rows = np.flatnonzero(accepted.range_weight)
    offset, scale = state.range_calibration
    distance, *jacobians = range_error(
        np.zeros(len(rows)), state.poses[r.row[rows]], state.antennas[r.antenna[rows]])
    e = (offset + scale * distance - r.distance[rows])[:, None]
    jacobians = [scale * jacobian for jacobian in jacobians]
    if m.calibrated:
        by_offset_and_scale = np.stack([np.ones_like(distance), distance], -1)
        jacobians.append((CALIBRATION_SIGMA * by_offset_and_scale)[:, None])
    return _whitened(rows, r.row[rows], len(m.marker) + r.antenna[rows], e, jacobians,
                     1 / r.sigma[rows, None, None], accepted.range_weight[rows], noise.ranges,
                     accepted.range_kernel)


def point_error(z, pose, point):
    """Errors R^T (point - t) - z (m, 2) of points z (m, 2) m measured from poses (t, R), (m, 3).

    Also their derivatives by pose (m, 2, 3) and point (m, 2, 2).
    """
    R_t = se2.rotation(-pose[:, 2])
    expected = (R_t @ (point - pose[:, :2])[..., None])[..., 0]
    by_pose = np.zeros((len(z), 2, 3))
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = -1
    by_pose[:, 0, 2], by_pose[:, 1, 2] = expected[:, 1], -expected[:, 0]
    return expected - z, by_pose, R_t


def range_error(r, pose, antenna):
    """Errors |antenna - t| - r (m,) of ranges r (m,) m from poses (m, 3) to antennas (m, 2) m.

    Also their derivatives by pose (m, 1, 3) and antenna (m, 1, 2). GTSAM: RangeFactor2D.
    """
    difference = antenna - pose[:, :2]
    distance = np.hypot(*difference.T)
    direction = difference[:, None, :] / np.maximum(distance, MIN_DISTANCE)[:, None, None]
    by_position = -direction @ se2.rotation(pose[:, 2])
    by_pose = np.concatenate([by_position, np.zeros((len(r), 1, 1))], axis=2)
    return distance - r, by_pose, direction


def _whitened(index, row, landmark, e, jacobians, U, weight, noise_factor, kernel):
    """The LinearizedMeasurements of errors e (m, d) with a list of derivatives (m, d, p) each.

    From square root informations U (m, d, d) and weights (m,). `noise_factor` multiplies the
    standard deviations. A kernel weighs a measurement by the norm of its whitened error; that of a
    range has the sign of measured minus expected, as in GTSAM.
    """
    U = U * (np.sqrt(weight) / noise_factor)[:, None, None]
    e = (U @ e[..., None])[..., 0]
    size, error = -e[:, 0] if e.shape[1] == 1 else np.linalg.norm(e, axis=1), np.sum(e**2) / 2
    if kernel is not None:
        size = size.tolist()
        by_kernel, error = np.array([*map(kernel.weight, size)]), sum(map(kernel.loss, size))
        weight = weight * by_kernel
        U = U * np.sqrt(by_kernel)[:, None, None]
        e = e * np.sqrt(by_kernel)[:, None]
    return LinearizedMeasurements(index=index, row=row, landmark=landmark, e=e,
                                  J=U @ np.concatenate(jacobians, axis=2), weight=weight,
                                  error=float(error))


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
