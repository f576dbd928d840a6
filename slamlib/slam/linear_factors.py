"""Stage 2: the factors of sightings and ranges, linearised in numpy, whitened, with their kernels.

GTSAM linearises the same factors, one by one, but for two kinds: sightings of points, and ranges
with an offset and a scale.
"""

from dataclasses import dataclass

import numpy as np

from slamlib.slam.errors import between_error, point_error, range_error
from slamlib.slam.state import RANGE_SIGMA


@dataclass(frozen=True)
class LinearFactors:
    """The accepted measurements of one kind at a state: m of them, with d errors each."""

    index: np.ndarray                # (m,) which of all measurements of the kind
    row: np.ndarray                  # (m,) frame
    landmark: np.ndarray             # (m,) first the markers, then the antennas
    e: np.ndarray                    # (m, d) expected minus measured, whitened
    by_pose: np.ndarray              # (m, d, 3)
    by_landmark: np.ndarray          # (m, d, 3), or (m, d, 2) of positions
    weight: np.ndarray               # (m,) share of its information that a measurement keeps
    error: float                     # half the sum of squares, or the kernel's loss
    by_calibration: np.ndarray | None = None       # (m, 1, 2) of ranges by offset and scale


def linear_factors(factors, noise, state):
    """The LinearFactors of sightings of poses, of points, and of ranges."""
    return (pose_factors(factors, noise, state), point_factors(factors, noise, state),
            range_factors(factors, noise, state))


def pose_factors(factors, noise, state):
    """The LinearFactors of the sightings of markers with a heading."""
    m, s = factors.measurements, factors.measurements.sightings
    index = np.flatnonzero(factors.sighting_weight[m.as_pose])
    rows = np.flatnonzero(m.as_pose)[index]
    e, by_pose, by_marker, _ = between_error(s.z[rows], state.poses[s.row[rows]],
                                             state.markers[m.label[rows]])
    return _whitened(index, s.row[rows], m.label[rows], (e, by_pose, by_marker),
                     m.sighting_roots[0][rows], factors.sighting_weight[rows], noise.sightings,
                     factors.sighting_kernel)


def point_factors(factors, noise, state):
    """The LinearFactors of the sightings of markers without one."""
    m, s = factors.measurements, factors.measurements.sightings
    index = np.flatnonzero(factors.sighting_weight[~m.as_pose])
    rows = np.flatnonzero(~m.as_pose)[index]
    linear = point_error(s.z[rows, :2], state.poses[s.row[rows]], state.markers[m.label[rows], :2])
    return _whitened(index, s.row[rows], m.label[rows], linear, m.sighting_roots[1][rows],
                     factors.sighting_weight[rows], noise.sightings, factors.sighting_kernel)


def range_factors(factors, noise, state):
    """The LinearFactors of the ranges, offset + scale * distance."""
    m, r = factors.measurements, factors.measurements.ranges
    rows = np.flatnonzero(factors.range_weight)
    offset, scale = state.range_calibration
    distance, by_pose, by_antenna = range_error(
        np.zeros(len(rows)), state.poses[r.row[rows]], state.antennas[r.antenna[rows]])
    linear = ((offset + scale * distance - r.distance[rows])[:, None], scale * by_pose,
              scale * by_antenna)
    by_calibration = RANGE_SIGMA * np.stack([np.ones_like(distance), distance], -1)[:, None]
    return _whitened(
        rows, r.row[rows], len(m.marker) + r.antenna[rows], linear, 1 / r.sigma[rows, None, None],
        factors.range_weight[rows], noise.ranges, factors.range_kernel, by_calibration)


def _whitened(index, row, landmark, linear, root, weight, factor, kernel, by_calibration=None):
    """The LinearFactors of errors and derivatives.

    From square root informations (m, d, d) and weights (m,). `factor` multiplies the standard
    deviations. A kernel weighs a measurement by the size of its
    whitened error. That of a range has the sign of measured minus expected.
    """
    root = root * (np.sqrt(weight) / factor)[:, None, None]
    e = (root @ linear[0][..., None])[..., 0]
    size, error = -e[:, 0] if e.shape[1] == 1 else np.linalg.norm(e, axis=1), np.sum(e**2) / 2
    if kernel is not None:
        size = size.tolist()
        by_kernel, error = np.array([*map(kernel.weight, size)]), sum(map(kernel.loss, size))
        weight = weight * by_kernel
        root = root * np.sqrt(by_kernel)[:, None, None]
        e = e * np.sqrt(by_kernel)[:, None]
    return LinearFactors(
        index=index, row=row, landmark=landmark, e=e, by_pose=root @ linear[1],
        by_landmark=root @ linear[2],
        weight=weight, error=float(error),
        by_calibration=None if by_calibration is None else root @ by_calibration)
