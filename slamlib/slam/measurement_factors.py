"""Stage 2: the factors of sightings and ranges, linearised in numpy: errors and derivatives.

The factor of a marker with a heading is GTSAM's between factor, that of a range its range factor.
Without headings a marker is a point. All factors of a kind are linearised at once, whitened, and
weighted by their kernels.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import se2
from slamlib.slam.errors import between_error
from slamlib.slam.state import CALIBRATION_SIGMA

MIN_DISTANCE = 1e-9          # m, below which a range has no direction


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
