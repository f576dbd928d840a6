"""Stage 2: errors and derivatives of all factors, in numpy, all factors of a kind at once.

With the increment Delta between the frames X and X' the error of odometry, log(Delta^-1 X^-1 X'),
is that of GTSAM's between factor, except that Delta depends on the wheel parameters, which all
odometry factors share. Of a sensor in the vehicle's origin the factor of a marker with a heading is
GTSAM's between factor, that of a range its range factor; `calibration` has the model. Without
headings a marker is a point. Errors are whitened, and weighted by their kernels. Derivatives by
poses are by GTSAM's tangent vectors: X moves as X exp(xi), in its own axes.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.preintegration import preintegrate
from slamlib.robust import calibration
from slamlib.robust.calibration import RANGES, SIGHTINGS, WHEELS
from slamlib.robust.measurements import Connections, square_root_information

MIN_DISTANCE = 1e-9          # m, below which a range has no direction
SMOOTHED_STEPS = 11          # encoder steps over which velocities are averaged


def preintegrate_odometry(measurements, model, wheel=None):
    """The OdometryIncrements of Measurements, linearised at `wheel` (3,) m, None for that stated.

    `model` is "arc" or "euler". Jumps are added where there are some.
    """
    m, jumps = measurements, measurements.jumps
    increments = replace(preintegrate(m.dataset, m.frame, model, wheel), in_counts=False)
    jump, unknown = jumps.added(m.frame[:-1], m.frame[1:])
    return replace(
        increments, increment=se2.compose(increments.increment, jump),
        quantization=increments.quantization + unknown)


def odometry_error(factors, poses, wheel):
    """Errors (f-1, 3) of OdometryIncrements at poses (f, 3) of the frames and `wheel` (3,) m.

    Also their derivatives (f-1, 3, 6) by X_i and X_{i+1}, and (f-1, 3, 3) by the columns WHEELS of
    the calibration. The errors are not whitened. Encoders measure counts, and errors in metres and
    radians grow with the wheels. So with `in_counts` they are divided by the scale, linearised,
    that `wheel` has beside the stated wheels, for which Q is. Otherwise all lengths would be
    estimated too small where nothing else gives the scale.
    """
    change = wheel - factors.wheel
    z, h = factors.increment + factors.J_wheel @ change, se2.between(poses[:-1], poses[1:])
    difference, (by_z, by_h) = se2.between(z, h), se2.between_jacobians(z, h)
    e, J = se2.log(difference), se2.log_jacobian(difference)
    by_first = -J @ by_h @ _moved_by(h)
    by_second = J @ se2.compose_jacobians(difference, np.zeros(3))[1]         # by X' xi
    by_poses, by_wheel = np.concatenate([by_first, by_second], axis=2), J @ by_z @ factors.J_wheel
    if not factors.in_counts:
        return e, by_poses, by_wheel
    radius, ratio = factors.wheel[:2].mean(), factors.wheel / factors.stated
    scale = factors.stated[:2].mean() / radius * np.array([1, 1, ratio[2]])
    relative = np.array([3 * [-1 / radius / 2], 3 * [-1 / radius / 2],
                         [0, 0, 1 / factors.wheel[2]]]).T                      # by the wheels
    linearized = e - by_wheel @ change                              # at the wheels of linearisation
    grown = 1 + relative @ change
    return (scale * (e + (grown - 1) * linearized), (scale * grown)[:, None] * by_poses,
            scale[:, None] * (by_wheel + relative * linearized[:, :, None]))


@dataclass(frozen=True)
class LinearizedFactors:
    """The m factors of one kind, linearised at a state, with d errors each."""

    connections: Connections     # with these variables, those of rejected measurements left out
    e: np.ndarray            # (m, d) whitened errors, expected minus measured
    J: np.ndarray            # (m, d, 6) whitened derivatives by the unknowns of both variables
    J_c: np.ndarray          # (m, d, u) whitened, by u active entries of c, per sigma
    columns: np.ndarray      # (u,) their numbers among the q active entries
    weight: np.ndarray | None = None     # (m,) share of its information that each keeps, or all
    error: float | None = None           # loss of the kernel, of measurements


def linearize_odometry(problem, state, slip):
    """The LinearizedFactors of odometry with a slip in sqrt(m), and sum log|Q|."""
    factors, active = problem.odometry, problem.active[WHEELS]
    e, J, J_c = odometry_error(factors, state.poses, state.c[WHEELS])
    U = square_root_information(factors.covariance(slip))
    log_determinant = -2 * float(np.sum(np.log(np.diagonal(U, axis1=1, axis2=2))))
    e, J_c = (U @ e[..., None])[..., 0], J_c[:, :, active] * problem.sigma[WHEELS][active]
    return LinearizedFactors(
        connections=problem.measurements.structure.odometry, e=e, J=U @ J, J_c=U @ J_c,
        columns=np.arange(active.sum())), log_determinant


def linearize_measurements(problem, state):
    """The LinearizedFactors of sightings and of ranges."""
    m, c = problem.measurements, state.c
    s, r = m.sightings, m.ranges

    def motions(row, lag):
        return delayed(m, row, c[lag], not problem.active[lag])

    seen, ranged = (np.flatnonzero(kind.weight) for kind in problem.accepted)
    sightings = sighting_error(
        s.z[seen], state.poses[s.row[seen]], *motions(s.row[seen], calibration.SIGHTING_LAG),
        state.markers[m.marker_row[seen]], c, m.as_pose[seen])
    ranges = range_error(
        r.distance[ranged], state.poses[r.row[ranged]],
        *motions(r.row[ranged], calibration.RANGE_LAG), state.antennas, r.antenna[ranged], c)
    return (_whitened(problem, 0, seen, m.sighting_roots[seen], *sightings),
            _whitened(problem, 1, ranged, 1 / r.sigma[ranged, None, None], *ranges))


def sighting_error(z, poses, motion, velocity, markers, c, as_pose):
    """Errors of sightings z (m, 3), and derivatives by pose, marker and the columns SIGHTINGS of c.

    From poses (m, 3) of the vehicle, its `motion` to where it was when the camera saw, and its
    `velocity` per encoder step there (`delayed`), each (m, 3) or (3,). Of markers with a heading,
    `as_pose` (m,), the errors (m, 3) are log(z^-1 h) of the expected sighting h, of points h - z
    and 0. The derivatives are (m, 3, 3), (m, 3, 3) and (m, 3, 5). GTSAM: BetweenFactorPose2.
    """
    camera, size = c[calibration.CAMERA], c[calibration.SIZE]
    mounted = se2.compose(motion, camera)                            # camera in vehicle
    Y = se2.compose(poses, mounted)
    seen = se2.between(Y, markers)
    h = seen / [size, size, 1]
    difference = se2.between(z, h)
    e, by_h = se2.log(difference), \
        se2.log_jacobian(difference) @ se2.between_jacobians(z, h)[1]
    e[~as_pose], by_h[~as_pose] = (h - z)[~as_pose] * [1, 1, 0], np.diag([1.0, 1, 0])
    by_seen, turn = by_h / [size, size, 1], np.where(as_pose, seen[:, 2], -Y[:, 2])
    by_marker = np.concatenate([                                     # a point's in the world
        by_seen[:, :, :2] @ se2.rotation(turn), by_seen[:, :, 2:]], axis=2)
    by_pose, by_camera, by_lag = _by_sensor(-by_seen @ _moved_by(seen), mounted, camera, velocity)
    by_size = -np.einsum("mdi,mi->md", by_seen[:, :, :2], h[:, :2])
    return e, by_pose, by_marker, np.concatenate(
        [by_camera, by_size[:, :, None], by_lag[:, :, None]], axis=2)


def range_error(r, poses, motion, velocity, antennas, antenna, c):
    """Errors (m, 1) of ranges r (m,), m, to the rows `antenna` (m,) of antennas (a, 2), m.

    Also derivatives by pose (m, 1, 3), antenna (m, 1, 2) and the columns RANGES of c (m, 1, 6 + a).
    `motion` and `velocity` as in `sighting_error`. GTSAM: RangeFactor2D.
    """
    tag = np.r_[c[calibration.TAG_PLACE], 0.0]
    mounted = se2.compose(motion, tag)                               # tag in vehicle
    Y = se2.compose(poses, mounted)
    difference = antennas[antenna] - Y[:, :2]
    squared = np.sum(difference**2, axis=1) + 2 * c[calibration.HEIGHT]
    distance = np.sqrt(np.maximum(squared, MIN_DISTANCE**2))
    slope = np.where(squared > MIN_DISTANCE**2, c[calibration.SCALE] / distance, 0.0)
    by_antenna = (slope[:, None] * difference)[:, None]              # in the world
    by_Y = np.pad(-by_antenna @ se2.rotation(Y[:, 2]), ((0, 0), (0, 0), (0, 1)))
    by_pose, by_tag, by_lag = _by_sensor(by_Y, mounted, tag, velocity)
    by_c = np.c_[by_tag[:, 0, :2], slope, np.ones(len(r)), distance, by_lag,
                 np.eye(len(antennas))[antenna]]
    e = c[calibration.OFFSET] + c[calibration.ANTENNAS][antenna] + c[calibration.SCALE] * distance
    return (e - r)[:, None], by_pose, by_antenna, by_c[:, None]


def _by_sensor(by_Y, mounted, place, velocity):
    """Derivatives by the vehicle's pose and a sensor's place, (m, d, 3), and by its lag (m, d).

    From those by the pose Y of the sensor, in its axes (m, d, 3). Its `place` (3,) in the vehicle
    is `mounted` with the motion since; `velocity` is the vehicle's, both (m, 3) or (3,).
    """
    return (by_Y @ inverse_adjoint(mounted), by_Y @ inverse_adjoint(place * [0, 0, 1]),
            -(by_Y @ inverse_adjoint(place) @ velocity[..., None])[..., 0])


def inverse_adjoint(motion):
    """Derivatives (..., 3, 3) of xi' by xi where exp(xi) M = M exp(xi'), of motions M (..., 3)."""
    adjoint, R_t = _moved_by(motion), se2.rotation(-motion[..., 2])
    adjoint[..., :2, :2], adjoint[..., :2, 2:] = R_t, R_t @ adjoint[..., :2, 2:]
    return adjoint


def _moved_by(h):
    """Derivatives (..., 3, 3) of exp(xi) h by xi, at 0, of poses h (..., 3)."""
    return se2.compose_jacobians(np.zeros(3), h)[0]


def sensor_poses(measurements, poses, c):
    """Poses in the world of the camera at the sightings (s, 3), of the tag at the ranges (r, 3).

    From poses (f, 3) of the frames and the calibration c (p,). The tag has the vehicle's heading.
    """
    m, tag = measurements, np.r_[c[calibration.TAG_PLACE], 0.0]
    kinds = ((m.sightings.row, calibration.SIGHTING_LAG, c[calibration.CAMERA]),
             (m.ranges.row, calibration.RANGE_LAG, tag))
    return [se2.compose(poses[row], se2.compose(delayed(m, row, c[lag])[0], place))
            for row, lag, place in kinds]


def delayed(measurements, row, lag, is_known=True):
    """Where the vehicle was `lag` encoder steps before the frames `row` (m,), in the axes there.

    Also its velocities (m, 3) per step at that time, in m and rad, by a smooth path: the noise of
    single steps would bias the delay. Both are 0 (3,) where there is no lag and it `is_known`.
    """
    if is_known and not lag:
        return np.zeros((2, 3))
    path, half = measurements.path, SMOOTHED_STEPS // 2
    total = odometry.cumulative(np.pad(path, ((half, half), (0, 0)), "edge"))
    smooth = (total[SMOOTHED_STEPS:] - total[:-SMOOTHED_STEPS]) / SMOOTHED_STEPS
    time = measurements.frame[row] - lag
    i = np.clip(np.floor(time).astype(int), 0, max(len(path) - 2, 0))
    k = np.minimum(i + 1, len(path) - 1)
    there = path[i] + (time - i)[:, None] * (path[k] - path[i])      # or before the first pose
    return (se2.between(path[measurements.frame[row]], there),
            se2.log(se2.between(smooth[i], smooth[k])))


def _whitened(problem, kind, rows, U, e, by_pose, by_landmark, by_c):
    """The LinearizedFactors of the measurements `rows` of a kind, 0 for sightings, 1 for ranges.

    From square root informations U (m, d, d) as stated, errors e (m, d), and derivatives, `by_c`
    (m, d, u) by the columns of the kind in the calibration. Shares multiply the loss. A kernel
    weighs a measurement by the norm of its whitened error; that of a range, corrected by the bias
    of its kernel, has the sign of measured minus expected, as in GTSAM.
    """
    accepted, columns = problem.accepted[kind], (SIGHTINGS, RANGES)[kind]
    weight, share, active = accepted.weight[rows], accepted.share[rows], problem.active[columns]
    U = U * (np.sqrt(weight) / problem.noise[1 + kind])[:, None, None]
    e = (U @ e[..., None])[..., 0] + accepted.bias
    kept, loss = share, np.sum(e**2, axis=1) / 2
    if accepted.kernel is not None:
        size = (-e[:, 0] if e.shape[1] == 1 else np.linalg.norm(e, axis=1)).tolist()
        kept, loss = (share * [*map(accepted.kernel.weight, size)],
                      np.array([*map(accepted.kernel.loss, size)]))
    U = U * np.sqrt(kept)[:, None, None]
    J = np.zeros((*e.shape, 6))
    J[:, :, :3 + by_landmark.shape[2]] = U @ np.concatenate([by_pose, by_landmark], axis=2)
    return LinearizedFactors(
        connections=(problem.measurements.structure.sightings, problem.measurements.structure.ranges)[kind].select(rows), e=e * np.sqrt(kept)[:, None], J=J,
        J_c=U @ (by_c[:, :, active] * problem.sigma[columns][active]),
        columns=np.cumsum(problem.active)[columns][active] - 1, weight=weight * kept,
        error=float(np.sum(share * loss)))
