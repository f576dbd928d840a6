"""Stage 2: sightings and ranges linearised in numpy, whitened and weighted by their kernels.

GTSAM linearises the same factors one by one, except for sightings of points and for ranges whose
offset and scale are variables.
"""

from dataclasses import dataclass

import numpy as np

from slamlib.slam.errors import between_error, point_error, range_error
from slamlib.slam.state import RANGE_SIGMA


@dataclass(frozen=True)
class LinearFactors:
    """The m accepted measurements of one kind, linearised at a state, with d errors each."""

    index: np.ndarray        # (m,) row among all measurements of the kind
    row: np.ndarray          # (m,) frame
    landmark: np.ndarray     # (m,) row of the marker, or k plus row of the antenna
    e: np.ndarray            # (m, d) whitened errors
    J: np.ndarray            # (m, d, p) whitened derivatives by the unknowns of pose, landmark, c
    weight: np.ndarray       # (m,) share of its information that a measurement keeps
    error: float             # half the sum of squared errors, or the loss of the kernel


def linearize_measurements(factors, noise, state):
    """The LinearFactors of sightings of poses, of points, and of ranges.

    From MeasurementFactors, a Noise and a State.
    """
    return (sighting_factors(factors, noise, state, as_pose=True),
            sighting_factors(factors, noise, state, as_pose=False),
            range_factors(factors, noise, state))


def sighting_factors(factors, noise, state, as_pose):
    """The LinearFactors of the sightings of markers with a heading (`as_pose`), or of points."""
    m, s = factors.measurements, factors.measurements.sightings
    kind = np.flatnonzero(m.as_pose == as_pose)
    index = np.flatnonzero(factors.sighting_weight[kind])
    rows = kind[index]
    pose, marker = state.poses[s.row[rows]], state.markers[m.label[rows]]
    e, by_pose, by_marker, *_ = between_error(s.z[rows], pose, marker) if as_pose \
        else point_error(s.z[rows, :2], pose, marker[:, :2])
    U = m.sighting_roots[0 if as_pose else 1][rows]
    return _whitened(index, s.row[rows], m.label[rows], e, [by_pose, by_marker], U,
                     factors.sighting_weight[rows], noise.sightings, factors.sighting_kernel)


def range_factors(factors, noise, state):
    """The LinearFactors of the ranges; expected is offset + scale * distance."""
    m, r = factors.measurements, factors.measurements.ranges
    rows = np.flatnonzero(factors.range_weight)
    offset, scale = state.range_calibration
    distance, *jacobians = range_error(
        np.zeros(len(rows)), state.poses[r.row[rows]], state.antennas[r.antenna[rows]])
    e = (offset + scale * distance - r.distance[rows])[:, None]
    jacobians = [scale * jacobian for jacobian in jacobians]
    if m.calibrated:
        jacobians.append(RANGE_SIGMA * np.stack([np.ones_like(distance), distance], -1)[:, None])
    return _whitened(rows, r.row[rows], len(m.marker) + r.antenna[rows], e, jacobians,
                     1 / r.sigma[rows, None, None], factors.range_weight[rows], noise.ranges,
                     factors.range_kernel)


def _whitened(index, row, landmark, e, jacobians, U, weight, factor, kernel):
    """The LinearFactors of errors e (m, d) with a list of derivatives (m, d, p) each.

    From square root informations U (m, d, d) and weights (m,). `factor` multiplies the standard
    deviations. A kernel weighs a measurement by the norm of its whitened error; that of a range
    has the sign of measured minus expected.
    """
    U = U * (np.sqrt(weight) / factor)[:, None, None]
    e = (U @ e[..., None])[..., 0]
    size, error = -e[:, 0] if e.shape[1] == 1 else np.linalg.norm(e, axis=1), np.sum(e**2) / 2
    if kernel is not None:
        size = size.tolist()
        by_kernel, error = np.array([*map(kernel.weight, size)]), sum(map(kernel.loss, size))
        weight = weight * by_kernel
        U = U * np.sqrt(by_kernel)[:, None, None]
        e = e * np.sqrt(by_kernel)[:, None]
    return LinearFactors(index=index, row=row, landmark=landmark, e=e,
                         J=U @ np.concatenate(jacobians, axis=2), weight=weight,
                         error=float(error))
