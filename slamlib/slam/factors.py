"""Stage 2: errors and derivatives of all factors, in numpy, all factors of a kind at once.

Odometry: with the increment Delta between the frames X and X' the error

    e = log(Delta^-1 X^-1 X')

is that of GTSAM's between factor, except that Delta depends on the wheel parameters. All odometry
factors share these, because the same wheel errors act in every increment.

Measurements: with the calibration of a sensor in the vehicle's origin the factor of a marker with a
heading is GTSAM's between factor, that of a range its range factor; `calibration` has the model.
Without headings a marker is a point. They are whitened, and weighted by their kernels. Derivatives
by poses are by GTSAM's tangent vectors: X moves as X exp(xi), in its own axes.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq

from slamlib import se2
from slamlib.slam.calibration import (
    ANTENNAS,
    CAMERA,
    HEIGHT,
    OFFSET,
    RANGE_LAG,
    RANGES,
    SCALE,
    SIGHTING_LAG,
    SIGHTINGS,
    SIZE,
    TAG_PLACE,
)

MIN_DISTANCE = 1e-9          # m, below which a range has no direction


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


def odometry_error(factors, poses, wheel):
    """Errors (f-1, 3) of OdometryFactors at poses (f, 3) of the frames and `wheel` (3,) m.

    Also their derivatives (f-1, 3, 6) by X_i and X_{i+1}, and (f-1, 3, 3) by the columns WHEELS of
    the calibration. The errors are not whitened.

    What the encoders measure is counts. Their errors in metres and radians grow with the wheels, so
    with `in_counts` the errors are divided by the scale, linearised, that `wheel` has beside the
    stated wheels, for which Q is. Otherwise wheels, and with them all lengths, would be estimated
    too small where nothing else gives the scale.
    """
    change = wheel - factors.wheel
    e, by_first, by_second, by_increment = between_error(
        factors.increment + factors.J_wheel @ change, poses[:-1], poses[1:])
    by_wheel = by_increment @ factors.J_wheel
    radius, ratio = factors.wheel[:2].mean(), factors.wheel / factors.stated
    scale = factors.stated[:2].mean() / radius * np.array([1, 1, ratio[2]]) \
        if factors.in_counts else np.ones(3)
    relative = np.array([3 * [-1 / radius / 2], 3 * [-1 / radius / 2],
                         [0, 0, 1 / factors.wheel[2]]]).T * factors.in_counts   # by the wheels
    linearized = e - by_wheel @ change                              # at the wheels of linearisation
    grown = 1 + relative @ change
    return (scale * (e + (grown - 1) * linearized),
            (scale * grown)[:, None] * np.concatenate([by_first, by_second], axis=2),
            scale[:, None] * (by_wheel + relative * linearized[:, :, None]))


@dataclass(frozen=True)
class LinearizedMeasurements:
    """The m accepted measurements of one kind, linearised at a state, with d errors each."""

    index: np.ndarray        # (m,) row among all measurements of the kind
    row: np.ndarray          # (m,) frame
    landmark: np.ndarray     # (m,) row of the marker, or k plus row of the antenna
    e: np.ndarray            # (m, d) whitened errors, expected minus measured
    J: np.ndarray            # (m, d, p) whitened derivatives by the unknowns of pose and landmark
    J_c: np.ndarray          # (m, d, u) whitened, by u active entries of c, per sigma
    columns: np.ndarray      # (u,) their numbers among the q active entries
    weight: np.ndarray       # (m,) share of its information that a measurement keeps
    error: float             # half the sum of squared errors, or the loss of the kernel


def linearize_measurements(problem, state):
    """The LinearizedMeasurements of sightings of poses, of points, and of ranges at a State."""
    return (linearize_sightings(problem, state, as_pose=True),
            linearize_sightings(problem, state, as_pose=False), linearize_ranges(problem, state))


def linearize_sightings(problem, state, as_pose):
    """The LinearizedMeasurements of markers with a heading (`as_pose`), or of points."""
    accepted, m, s = problem.accepted, problem.measurements, problem.measurements.sightings
    kind = np.flatnonzero(m.as_pose == as_pose)
    index = np.flatnonzero(accepted.sighting_weight[kind])
    rows = kind[index]
    row = s.row[rows]
    motion = delayed(m, row, state.c[SIGHTING_LAG], not problem.active[SIGHTING_LAG])
    e, by_pose, by_marker, by_c = sighting_error(
        s.z[rows], state.poses[row], *motion, state.markers[m.marker_row[rows]], state.c, as_pose)
    U = m.sighting_roots[0 if as_pose else 1][rows]
    return _whitened(
        problem, SIGHTINGS, index, row, m.marker_row[rows], e, [by_pose, by_marker], by_c,
        U, accepted.sighting_weight[rows], problem.noise.sightings, accepted.sighting_kernel)


def linearize_ranges(problem, state):
    """The LinearizedMeasurements of the ranges at a State."""
    accepted, m, r = problem.accepted, problem.measurements, problem.measurements.ranges
    rows = np.flatnonzero(accepted.range_weight)
    antenna, row = r.antenna[rows], r.row[rows]
    motion = delayed(m, row, state.c[RANGE_LAG], not problem.active[RANGE_LAG])
    e, by_pose, by_antenna, by_c = range_error(
        r.distance[rows], state.poses[row], *motion, state.antennas[antenna],
        state.c[ANTENNAS][antenna], state.c)
    by_offset = (antenna[:, None] == np.arange(len(m.antenna)))[:, None]
    return _whitened(
        problem, RANGES, rows, row, len(m.marker) + antenna, e[:, None], [by_pose, by_antenna],
        np.concatenate([by_c, by_offset], axis=2), 1 / r.sigma[rows, None, None],
        accepted.range_weight[rows], problem.noise.ranges, accepted.range_kernel)


def sighting_error(z, poses, motion, velocity, markers, c, as_pose):
    """Errors of sightings z (m, 3), and derivatives by pose, marker and the columns SIGHTINGS of c.

    From poses (m, 3) of the vehicle, its `motion` (m, 3) to where it was when the camera saw, and
    its `velocity` (m, 3) per encoder step there (`delayed`). Of markers with a heading (`as_pose`)
    the errors (m, 3) are log(z^-1 h) of the expected sighting h, as in GTSAM's between factor. Of
    points they are (m, 2), h - z. The derivatives are (m, d, 3), (m, d, 3 or 2) and (m, d, 5).
    """
    camera, size, d = c[CAMERA], c[SIZE], 3 if as_pose else 2
    mounted = se2.compose(motion, camera)                            # camera in vehicle
    Y = se2.compose(poses, mounted)
    seen = se2.between(Y, markers)
    h = seen / [size, size, 1]
    if as_pose:
        difference = se2.between(z, h)
        e = se2.log(difference)
        by_h = se2.log_jacobian(difference) @ se2.between_jacobians(z, h)[1]
        by_marker = se2.rotation(seen[:, 2])
    else:
        e, by_h = (h - z)[:, :2], np.broadcast_to(np.eye(2, 3), (len(z), 2, 3))
        by_marker = se2.rotation(-Y[:, 2])
    by_seen = by_h / [size, size, 1]
    by_Y = -by_seen @ se2.compose_jacobians(np.zeros(3), seen)[0]    # in the axes of the camera
    by_marker = np.concatenate(
        [by_seen[:, :, :2] @ by_marker, by_seen[:, :, 2:]], axis=2)[:, :, :d]
    by_camera = _transported(by_Y, np.r_[0.0, 0.0, camera[2]])
    by_c = np.empty((len(z), d, 5))
    by_c[:, :, :3] = by_camera
    by_c[:, :, 3] = -np.einsum("mdi,mi->md", by_seen[:, :, :2], h[:, :2])
    by_c[:, :, 4] = -np.einsum("mdi,mi->md", _transported(by_Y, camera), velocity)
    return e, _transported(by_Y, mounted), by_marker, by_c


def _transported(by_end, motion):
    """Derivatives (m, d, 3) by a pose X in its axes, from those `by_end` of X composed with motion.

    The derivative of exp(xi) M = M exp(xi') is the adjoint of M^-1.
    """
    R_t = se2.rotation(-motion[..., 2])
    adjoint = np.zeros(motion.shape[:-1] + (3, 3))
    adjoint[..., :2, :2], adjoint[..., 2, 2] = R_t, 1
    lever = np.stack([-motion[..., 1], motion[..., 0]], -1)
    adjoint[..., :2, 2] = (R_t @ lever[..., None])[..., 0]
    return by_end @ adjoint


def camera_poses(measurements, poses, c):
    """Poses (s, 3) of the camera in the world at the sightings, from those of the frames (f, 3)."""
    row = measurements.sightings.row
    motion, _ = delayed(measurements, row, c[SIGHTING_LAG])
    return se2.compose(poses[row], se2.compose(motion, c[CAMERA]))


def tag_positions(measurements, poses, c):
    """Positions (r, 2) in m of the tag in the world at the ranges, from poses of the frames."""
    row = measurements.ranges.row
    motion, _ = delayed(measurements, row, c[RANGE_LAG])
    return se2.compose(poses[row], se2.compose(motion, np.r_[c[TAG_PLACE], 0.0]))[:, :2]


def expected_sightings(measurements, state):
    """Markers (s, 3) as they are seen from a State, without noise."""
    markers = state.markers[measurements.marker_row]
    size = state.c[SIZE]
    return se2.between(camera_poses(measurements, state.poses, state.c), markers) / [size, size, 1]


def expected_ranges(measurements, state):
    """Ranges (r,) in m that are measured from a State, without noise."""
    c, antenna = state.c, measurements.ranges.antenna
    difference = state.antennas[antenna] - tag_positions(measurements, state.poses, c)
    distance = np.sqrt(np.maximum(np.sum(difference**2, axis=1) + 2 * c[HEIGHT], 0))
    return c[OFFSET] + c[ANTENNAS][antenna] + c[SCALE] * distance


def range_error(r, poses, motion, velocity, antennas, offset, c):
    """Errors (m,) of ranges r (m,) m, and derivatives by pose, antenna and c.

    `motion` and `velocity` as in `sighting_error`; `offset` (m,) m is that of each antenna. The
    derivatives are (m, 1, 3), (m, 1, 2), and (m, 1, 6) by the columns of RANGES without the offsets
    of antennas. GTSAM: RangeFactor2D.
    """
    heading = poses[:, 2] + motion[:, 2]
    lever = se2.compose(motion, np.r_[c[TAG_PLACE], 0.0])[:, :2]          # tag in vehicle
    position = se2.compose(poses, np.pad(lever, ((0, 0), (0, 1))))[:, :2]
    difference = antennas - position
    squared = np.sum(difference**2, axis=1) + 2 * c[HEIGHT]
    distance = np.sqrt(np.maximum(squared, MIN_DISTANCE**2))
    slope = np.where(squared > MIN_DISTANCE**2, c[SCALE] / distance, 0.0)
    direction = slope[:, None] * difference                          # by the antenna, in the world
    in_vehicle = -(direction[:, None] @ se2.rotation(poses[:, 2]))[:, 0]
    by_pose = np.concatenate([in_vehicle, np.sum(
        in_vehicle * np.stack([-lever[:, 1], lever[:, 0]], -1), axis=1, keepdims=True)], axis=1)
    by_tag = -(direction[:, None] @ se2.rotation(heading))[:, 0]
    moved = velocity[:, :2] + velocity[:, 2:] * [-c[TAG_PLACE][1], c[TAG_PLACE][0]]
    by_c = np.stack([by_tag[:, 0], by_tag[:, 1], slope, np.ones(len(r)), distance,
                     -np.sum(by_tag * moved, axis=1)], -1)
    e = c[OFFSET] + offset + c[SCALE] * distance - r
    return e, by_pose[:, None], direction[:, None], by_c[:, None]


def delayed(measurements, row, lag, is_known=True):
    """Where the vehicle was `lag` encoder steps before the frames `row` (m,), in the axes there.

    Also its velocities (m, 3) per step at that time, in m and rad, by the smooth path: the noise of
    single steps would bias the delay. Both are 0 where there is no lag and it `is_known`.
    """
    if is_known and not lag:
        return np.zeros((2, len(row), 3))
    path, smooth = measurements.path, measurements.smooth_path
    time = measurements.frame[row] - lag
    i = np.clip(np.floor(time).astype(int), 0, max(len(path) - 2, 0))
    k = np.minimum(i + 1, len(path) - 1)
    there = path[i] + (time - i)[:, None] * (path[k] - path[i])      # or before the first pose
    return (se2.between(path[measurements.frame[row]], there),
            se2.log(se2.between(smooth[i], smooth[k])))


def _whitened(problem, kind, index, row, landmark, e, jacobians, by_c, U, weight, noise_factor,
              kernel):
    """The LinearizedMeasurements of errors e (m, d) with a list of derivatives (m, d, p) each.

    `by_c` (m, d, u) are those by the columns `kind` of the calibration. From square root
    informations U (m, d, d) and weights (m,). `noise_factor` multiplies the standard deviations. A
    kernel weighs a measurement by the norm of its whitened error; that of a range, corrected by the
    bias of its kernel, has the sign of measured minus expected, as in GTSAM.
    """
    active = problem.active[kind]
    columns = np.cumsum(problem.active)[kind][active] - 1
    by_c = by_c[:, :, active] * problem.sigma[kind][active]
    U = U * (np.sqrt(weight) / noise_factor)[:, None, None]
    e = (U @ e[..., None])[..., 0]
    if kind == RANGES:
        e = e + problem.accepted.range_bias
    size, error = -e[:, 0] if e.shape[1] == 1 else np.linalg.norm(e, axis=1), np.sum(e**2) / 2
    if kernel is not None:
        size = size.tolist()
        by_kernel, error = np.array([*map(kernel.weight, size)]), sum(map(kernel.loss, size))
        weight = weight * by_kernel
        U = U * np.sqrt(by_kernel)[:, None, None]
        e = e * np.sqrt(by_kernel)[:, None]
    return LinearizedMeasurements(
        index=index, row=row, landmark=landmark, e=e, J=U @ np.concatenate(jacobians, axis=2),
        J_c=U @ by_c, columns=columns, weight=weight, error=float(error))


@lru_cache(maxsize=8)
def kernel_bias(kernel):
    """Location b, in sigmas, for which a signed kernel weighs the residuals r - b to mean zero.

    Of standard normal residuals r, which a one-sided kernel makes too small on average (b < 0):
    E[weight(r - b) (r - b)] = 0. Ranges are compared with the expected ones plus b sigma.
    """
    r = np.linspace(-6, 6, 241)
    if kernel is None or kernel.weight(3.0) == kernel.weight(-3.0):
        return 0.0

    def mean(b):
        weight = np.array([kernel.weight(x) for x in r - b])
        return np.sum(weight * (r - b) * np.exp(-r**2 / 2))

    return float(brentq(mean, -1, 1))
