"""Stage 2: errors and derivatives of all factors, in numpy, all factors of a kind at once.

With the increment Delta between the frames X and X' the error of odometry, log(Delta^-1 X^-1 X'),
is that of GTSAM's between factor, except that Delta depends on the wheel parameters, which all
odometry factors share. Of a sensor in the vehicle's origin the factor of a marker with a heading is
GTSAM's between factor, that of a range its range factor; `calibration` has the model. Without
headings a marker is a point. Errors are whitened, and weighted by their kernels. Derivatives by
poses are by GTSAM's tangent vectors: X moves as X exp(xi), in its own axes.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from slamlib.core import se2
from slamlib.core.increments import (
    TYPICAL_SLIP,
    OdometryIncrements,
    count_scale,
    noise_scale,
    odometry_error,
    preintegrate,
    turn_ratio,
)
from slamlib.robust.calibration import (
    ANTENNAS,
    BUMP,
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
    WHEELS,
)
from slamlib.robust.jumps import creep_covariance
from slamlib.robust.measurements import Measurements, square_root_information

MIN_DISTANCE = 1e-9          # m, below which a range has no direction
TURN_WINDOW = 41             # number of increments, whose turns tell what to expect of one
TURN_NOISE = 2.0             # times the slip, by which turns are noisy
SMOOTHED_STEPS = 5           # encoder steps before and after, over which a velocity is averaged


def preintegrate_odometry(measurements: Measurements, model: str,
                          wheel: np.ndarray | None = None,
                          slip: float = TYPICAL_SLIP) -> OdometryIncrements:
    """The OdometryIncrements of Measurements, linearised at `wheel` (3,) m, None for that stated.

    `model` is "arc" or "euler", `slip` in sqrt(m) tells how much of a turn may be noise. Jumps are
    added where there are some. Where the vehicle crawls the increment is uncertain by itself, as
    the stated wheels have it: to them all noise belongs.
    """
    frame = measurements.frame
    increments = _with_noise_as_stated(preintegrate(
        measurements.dataset, frame, model, wheel, measurements.odometry_noise), slip)
    jump, jump_covariance = measurements.jumps.added(frame[:-1], frame[1:])
    off = increments.stated - increments.wheel
    as_stated = increments.increment + increments.J_wheel @ off
    creep = creep_covariance(as_stated, measurements.crawls)
    uncertain = jump_covariance + se2.rotate_covariance(creep, -increments.increment[:, 2])
    return replace(increments, increment=se2.compose(increments.increment, jump),
                   rounding=increments.rounding + uncertain)


def _with_noise_as_stated(increments, slip):
    """The OdometryIncrements in which the noise of turns, as far as it shows, has `noise_scale`.

    A turn is proportional to the radii over the wheelbase, and so would be its noise. Then the
    derivatives would contain the turn as it was counted, with the same noise as its error, and the
    products of both do not average out: on long straight ways released wheels would run away. Also,
    the evidence would prefer a longer wheelbase, by which the noise is smaller. So only the turn
    that is expected, given its neighbours and the noise, depends on the wheels (regression
    calibration: Carroll et al., Measurement Error in Nonlinear Models, 2006; by the filter of Lee,
    IEEE PAMI 2(2), 1980): the mean of the neighbours where all scatter is noise, the turn itself in
    a corner. The noise turned the increment about its middle.
    """
    ratio = turn_ratio(increments)
    steps = np.diff(increments.frame)
    rate = increments.increment[:, 2] / (ratio * steps)
    mean = _mean_of_neighbours(rate)
    scatter = _mean_of_neighbours((rate - mean)**2)
    variance = increments.covariance(TURN_NOISE * slip)[:, 2, 2] / steps**2
    noise = steps * (rate - mean) * variance / np.maximum(scatter, variance)
    x, y = increments.increment[:, :2].T
    about_middle = np.stack([-y / 2, x / 2, np.ones(len(x))], axis=1)
    motion = noise[:, None] * about_middle
    of_wheels = np.array([0.5, 0.5, -1.0]) / increments.wheel        # of the logarithm of a turn
    added = (noise_scale(increments) - ratio) * motion
    return replace(
        increments, increment=increments.increment + added,
        J_wheel=increments.J_wheel - motion[:, :, None] * (ratio * of_wheels))


def _mean_of_neighbours(values):
    """Means (m,) of the TURN_WINDOW values (m,) around each, mirrored at both ends."""
    if not len(values):
        return values
    mirrored = np.pad(values, TURN_WINDOW // 2, mode="symmetric")
    return np.convolve(mirrored, np.full(TURN_WINDOW, 1 / TURN_WINDOW), mode="valid")


@dataclass(frozen=True)
class LinearizedFactors:
    """The m factors of one kind, linearised at a state, with d errors each."""

    index: np.ndarray        # (m,) row among all factors of the Structure; some are rejected
    e: np.ndarray            # (m, d) whitened errors, expected minus measured
    J: np.ndarray            # (m, d, 6) whitened derivatives by the unknowns of both variables
    J_c: np.ndarray          # (m, d, u) whitened, by u active entries of c, per sigma
    columns: np.ndarray      # (u,) their numbers among the q active entries
    error: float = 0.0               # loss of the kernel, of measurements
    count: float = 0.0               # of their errors, as far as they are accepted
    log_determinant: float = 0.0     # sum log|Q / s^2|, of odometry, s its `count_scale`


def linearize_odometry(problem, state, slip: float) -> LinearizedFactors:
    """The LinearizedFactors of odometry with a slip in sqrt(m), of a Problem at a State."""
    e, J, by_wheel = odometry_error(problem.odometry, state.poses, state.c[WHEELS])
    U = _odometry_roots(problem.odometry, slip)
    factors = _whitened(problem, np.arange(len(e)), WHEELS, U, e, J, by_wheel)
    roots = count_scale(problem.odometry, state.c[WHEELS]) * np.linalg.diagonal(U)
    size = np.abs(roots)                     # a step on the way may make a radius negative
    return replace(factors, log_determinant=-2 * np.sum(np.log(size)))


@lru_cache(maxsize=4)
def _odometry_roots(increments, slip):
    """Square root informations (f-1, 3, 3) of OdometryIncrements for a slip in sqrt(m)."""
    return square_root_information(increments.covariance(slip))


def linearize_measurements(problem, state) -> tuple[LinearizedFactors, LinearizedFactors]:
    """The LinearizedFactors of sightings and of ranges, of a Problem at a State."""
    return _linearized_sightings(problem, state), _linearized_ranges(problem, state)


def _linearized_sightings(problem, state):
    m = problem.measurements
    accepted = problem.accepted.sightings
    rows = np.flatnonzero(accepted.weight)
    frame = m.sightings.row[rows]
    motion, velocity = delayed(problem, frame, state.c, SIGHTING_LAG)
    e, by_pose, by_marker, by_c = sighting_error(
        m.sightings.z[rows], state.poses[frame], motion, velocity,
        state.markers[m.marker_row[rows]], state.c, m.as_pose[rows], m.is_bumped[rows])
    J = np.concatenate([by_pose, by_marker], axis=2)
    index = len(m.frame) - 1 + rows                      # after odometry
    factors = _whitened(problem, index, SIGHTINGS, m.sighting_roots[rows], e, J, by_c)
    size = 2 + m.as_pose[rows]
    return _weighted(factors, accepted, rows, problem.noise.sightings, size)


def _linearized_ranges(problem, state):
    m = problem.measurements
    accepted = problem.accepted.ranges
    rows = np.flatnonzero(accepted.weight)
    frame = m.ranges.row[rows]
    motion, velocity = delayed(problem, frame, state.c, RANGE_LAG)
    e, by_pose, by_antenna, by_c = range_error(
        m.ranges.distance[rows], state.poses[frame], motion, velocity, state.antennas,
        m.ranges.antenna[rows], state.c)
    by_heading = np.zeros((len(e), 1, 1))                # antennas have none
    J = np.concatenate([by_pose, by_antenna, by_heading], axis=2)
    index = len(m.frame) - 1 + len(m.marker_row) + rows
    U = 1 / m.ranges.sigma[rows, None, None]
    factors = _whitened(problem, index, RANGES, U, e, J, by_c)
    return _weighted(factors, accepted, rows, problem.noise.ranges, 1)


def _whitened(problem, index, columns, U, e, J, by_c):
    """The LinearizedFactors of errors e (m, d) with square root informations U (m, d, d).

    Their derivatives are J (m, d, 6), and `by_c` (m, d, w) by these w `columns` of the calibration.
    """
    active = problem.active
    number = np.cumsum(active) - 1
    J_c = by_c @ problem.prior.of(columns)
    return LinearizedFactors(index=index, e=(U @ e[:, :, None])[:, :, 0], J=U @ J, J_c=U @ J_c,
                             columns=number[columns][active[columns]])


def _weighted(factors, accepted, rows, noise, size):
    """LinearizedFactors of the measurements `rows`, with the weights by which they are accepted.

    From those by the stated sigmas, the noise factor and the number `size` of errors of each. A
    kernel weighs a measurement by the norm of its whitened error; that of a range, corrected by the
    bias of its kernel, has the sign of measured minus expected, as in GTSAM. Shares multiply the
    loss.
    """
    weight = accepted.weight[rows]
    share = accepted.share[rows]
    scale = np.sqrt(weight) / noise
    e = scale[:, None] * factors.e + accepted.bias
    loss = np.sum(e**2, axis=1) / 2
    kept = share
    if accepted.kernel is not None:
        of_kernel = -e[:, 0] if e.shape[1] == 1 else np.linalg.norm(e, axis=1)
        loss = np.array(list(map(accepted.kernel.loss, of_kernel.tolist())))
        kept = share * list(map(accepted.kernel.weight, of_kernel.tolist()))
    root = np.sqrt(kept)
    scale_J = (root * scale)[:, None, None]
    return replace(factors, e=root[:, None] * e, J=scale_J * factors.J, J_c=scale_J * factors.J_c,
                   error=np.sum(share * loss), count=np.sum(size * weight * kept))


def sighting_error(
        z: np.ndarray, poses: np.ndarray, motion: np.ndarray, velocity: np.ndarray,
        markers: np.ndarray, c: np.ndarray, as_pose: np.ndarray,
        is_bumped: np.ndarray) -> tuple[np.ndarray, ...]:
    """Errors of sightings z (m, 3), and derivatives by pose, marker and the columns SIGHTINGS of c.

    From poses (m, 3) of the vehicle, its `motion` to where it was when the camera saw, and its
    `velocity` per encoder step there (`delayed`), each (m, 3) or (3,). Of markers with a heading,
    `as_pose` (m,), the errors (m, 3) are log(z^-1 h) of the expected sighting h, of points h - z
    and 0. `is_bumped` (m,) is where the camera is elsewhere. The derivatives are (m, 3, 3),
    (m, 3, 3) and (m, 3, 8). GTSAM: BetweenFactorPose2.
    """
    camera = c[CAMERA]
    if is_bumped.any():
        camera = camera + is_bumped[:, None] * c[BUMP]
    unit = [c[SIZE], c[SIZE], 1]
    mounted = se2.compose(motion, camera)                # camera in vehicle
    Y = se2.compose(poses, mounted)
    seen = se2.between(Y, markers)
    h = seen / unit
    difference, _, by_expected = se2.between_with_jacobians(z, h)
    e, J = se2.log_with_jacobian(difference)
    by_h = J @ by_expected
    is_point = ~as_pose
    e[is_point] = (h - z)[is_point] * [1, 1, 0]
    by_h[is_point] = np.diag([1.0, 1, 0])
    by_seen = by_h / unit
    by_marker = by_seen.copy()
    marker_in_camera = np.where(as_pose, seen[:, 2], -Y[:, 2])       # a point moves in the world
    by_marker[:, :, :2] @= se2.rotation(marker_in_camera)
    by_Y = -by_seen @ se2.by_left_perturbation(seen)
    by_pose, by_camera, by_lag = _by_sensor(by_Y, mounted, camera, velocity)
    by_size = -by_seen[:, :, :2] @ h[:, :2, None]
    by_bump = is_bumped[:, None, None] * by_camera
    return e, by_pose, by_marker, np.concatenate([by_camera, by_size, by_lag, by_bump], axis=2)


def range_error(
        r: np.ndarray, poses: np.ndarray, motion: np.ndarray, velocity: np.ndarray,
        antennas: np.ndarray, antenna: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, ...]:
    """Errors (m, 1) of ranges r (m,), m, to the rows `antenna` (m,) of antennas (a, 2), m.

    Also derivatives by pose (m, 1, 3), antenna (m, 1, 2) and the columns RANGES of c (m, 1, 6 + a).
    `motion` and `velocity` as in `sighting_error`. GTSAM: RangeFactor2D.
    """
    tag = _tag_in_vehicle(c)
    mounted = se2.compose(motion, tag)
    Y = se2.compose(poses, mounted)
    difference = antennas[antenna] - Y[:, :2]
    squared = np.sum(difference**2, axis=1) + 2 * c[HEIGHT]
    distance = np.sqrt(np.maximum(squared, MIN_DISTANCE**2))
    slope = np.where(squared > MIN_DISTANCE**2, c[SCALE] / distance, 0.0)
    by_antenna = (slope[:, None] * difference)[:, None]              # in the world
    by_place = -by_antenna @ se2.rotation(Y[:, 2])
    by_Y = np.pad(by_place, ((0, 0), (0, 0), (0, 1)))
    by_pose, by_tag, by_lag = _by_sensor(by_Y, mounted, tag, velocity)
    by_offset = np.eye(len(antennas))[antenna]
    by_c = np.column_stack([by_tag[:, 0, :2], slope, np.ones(len(r)), distance, by_lag[:, 0],
                            by_offset])
    expected = c[OFFSET] + c[ANTENNAS][antenna] + c[SCALE] * distance
    return (expected - r)[:, None], by_pose, by_antenna, by_c[:, None]


def _tag_in_vehicle(c):
    """The pose (3,) of the tag by the calibration c (p,), with the heading of the vehicle."""
    return np.append(c[TAG_PLACE], 0.0)


def _by_sensor(by_Y, mounted, place, velocity):
    """Derivatives by the vehicle's pose and a sensor's place, (m, d, 3), and its lag (m, d, 1).

    From those by the pose Y of the sensor, in its axes (m, d, 3). Its `place` in the vehicle is
    `mounted` with the motion since; `velocity` is the vehicle's, all (m, 3) or (3,).
    """
    by_pose = by_Y @ inverse_adjoint(mounted)
    by_place = by_Y @ inverse_adjoint(place * [0, 0, 1])
    by_lag = -by_Y @ (inverse_adjoint(place) @ velocity[..., None])
    return by_pose, by_place, by_lag


def inverse_adjoint(motion: np.ndarray) -> np.ndarray:
    """Derivatives (..., 3, 3) of xi' by xi where exp(xi) M = M exp(xi'), of motions M (..., 3)."""
    return se2.between_jacobians(motion, motion)[1] @ se2.by_left_perturbation(motion)


def sensor_poses(measurements: Measurements, poses: np.ndarray,
                 c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses in the world of the camera at the sightings (s, 3), of the tag at the ranges (r, 3).

    From poses (f, 3) of the frames and the calibration c (p,). The tag has the vehicle's heading.
    """
    def in_world(row, lag, place):
        motion = _motion_back(measurements, row, lag, round(lag))[0]
        return se2.compose(poses[row], se2.compose(motion, place))

    cameras = c[CAMERA] + measurements.is_bumped[:, None] * c[BUMP]
    camera = in_world(measurements.sightings.row, c[SIGHTING_LAG], cameras)
    tag = in_world(measurements.ranges.row, c[RANGE_LAG], _tag_in_vehicle(c))
    return camera, tag


def delayed(problem, row: np.ndarray, c: np.ndarray, entry: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the vehicle was before the frames `row` (m,) by a delay, in the axes there (m, 3).

    The delay in encoder steps is `entry` of the calibration c (p,) of a Problem. Also velocities
    (m, 3) per step at that time, in m and rad. Both are 0 (3,) where there is no delay and it is
    known.
    """
    lag = c[entry]
    if lag == 0 and not problem.active[entry]:
        return np.zeros(3), np.zeros(3)
    return _motion_back(problem.measurements, row, lag, round(problem.reference[entry]))


def _motion_back(measurements, row, lag, whole):
    """Motion and velocity as of `delayed`, by the row `whole` steps before and an average velocity.

    The noise of single steps would bias the delay. So would the path between two rows, where the
    rounding of the counts averages out: it would look like a delay of half a step.
    """
    path = measurements.path
    frame = measurements.frame[row]
    last = len(path) - 1
    nearest = np.clip(frame - whole, 0, last)
    first = np.maximum(nearest - SMOOTHED_STEPS, 0)
    end = np.minimum(nearest + SMOOTHED_STEPS, last)
    steps = np.maximum(end - first, 1)[:, None]
    velocity = se2.log(se2.between(path[first], path[end])) / steps
    since = (frame - lag - nearest)[:, None]             # steps, few
    motion = se2.compose(se2.between(path[frame], path[nearest]), since * velocity)
    return motion, velocity
