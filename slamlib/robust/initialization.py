"""Stage 4: start values. Poses from odometry, markers by consensus, antennas by trilateration.

On a long drive odometry loses the heading. Therefore its first part is solved by the robust rounds
of stage 5. Odometry with the wheels that this part calibrated then predicts the poses of a longer
part, and so on. Stage 7 uses trilateration again for the antennas in doubt.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from slamlib.core import odometry, se2
from slamlib.core.graph import GUESS_PRIOR_SIGMA
from slamlib.core.sightings import consensus
from slamlib.robust.calibration import ANTENNAS, HEIGHT, OFFSET, SCALE, SIGHTING_LAG, SIZE, WHEELS
from slamlib.robust.factors import MIN_DISTANCE, sensor_poses
from slamlib.robust.fit import narrow_kernels
from slamlib.robust.linear import build_problem, state_from_arrays
from slamlib.robust.measurements import measure

MAX_ODOMETRY_SIGMA = 0.5     # rad, of odometry's heading at the end of a drive's first part
MAX_FIRST_PART = 1.5         # length of the first part over that which odometry can predict
GROWTH = 4                   # largest ratio of the numbers of poses of a part and the one before
MAX_VOTES = 60               # number of sightings of a marker that enter its consensus

MAX_RANGES = 150             # maximum number of ranges used per antenna, evenly chosen
SAME_PLACE = 0.03            # of the median range: positions closer than this are one
KERNEL_SCALE = 2.0           # sigmas, scale of the Cauchy kernel
START_DIRECTIONS = 3         # number of starts on a circle about the path
TOLERANCE = 1e-4             # relative, of cost and position, at which the search ends


def initial_state(measurements, model):
    """The State from which a drive is solved, by odometry of the model "arc" or "euler".

    Raises DatasetError as `optimize`, for the first part of a long drive.
    """
    part, state = None, None
    *counts, _ = part_lengths(measurements.dataset)
    frame = measurements.frame
    for count in counts:
        earlier, part = part, measure(
            measurements.dataset.first(count), frame[frame < count], measurements.jumps)
        state = odometry_state(part, model, earlier, state)
        state = narrow_kernels(build_problem(part, model), state)
    return odometry_state(measurements, model, part, state)


def part_lengths(dataset):
    """List of the numbers of encoder poses of the parts of a drive, which all start at pose 1.

    Each part is at most GROWTH times as long as the one before; the last one is the whole drive.
    """
    _, covariances = odometry.first_order(
        dataset.ticks, dataset.vehicle, initial_covariance=np.zeros((3, 3)))
    lost = np.flatnonzero(covariances[:, 2, 2] > MAX_ODOMETRY_SIGMA**2)
    ends = [len(dataset.ticks)]
    first = max(lost[0], 2) if len(lost) else ends[0]
    while ends[0] > MAX_FIRST_PART * first:
        ends.insert(0, max(first, -(-ends[0] // GROWTH)))
    return ends


def odometry_state(measurements, model, part=None, solved=None, **landmarks):
    """The State with poses by odometry of the model "arc" or "euler".

    Of Measurements of which a first `part` has the State `solved`, the later poses are those of
    odometry from the last pose of the part, with its wheels. `landmarks` are the keywords `markers`
    and `antennas` of `state_from_poses`.
    """
    d, frame, jumps = measurements.dataset, measurements.frame, measurements.jumps
    if part is None:
        poses, covariances = odometry.first_order(d.ticks, d.vehicle, model=model)
        return state_from_poses(measurements, jumps.mended(frame, poses[frame]),
                                covariances[frame], **landmarks)
    last, stated = part.frame[-1], measurements.calibration.stated
    poses, covariances = odometry.first_order(
        d.ticks[last:], d.vehicle.with_wheel(solved.c[WHEELS]), solved.poses[-1], np.zeros((3, 3)),
        model=model)
    old, new = np.searchsorted(part.frame, frame[frame <= last]), frame[frame > last] - last
    poses = np.concatenate([solved.poses[old], poses[new]])
    return state_from_poses(
        measurements, jumps.mended(frame, poses, last),
        np.concatenate([np.zeros((len(old), 3, 3)), covariances[new]]),
        measurements.calibration.taken_from(part.calibration, solved.c, stated), **landmarks)


def consensus_markers(measurements, in_world, covariances):
    """(k, 3) poses of the markers, each by one of its sightings (`sightings.consensus`).

    `in_world` (s, 3) and `covariances` (s, 3, 3) are the marker poses by each sighting.
    """
    return in_world[consensus(measurements.marker_row, in_world, covariances, MAX_VOTES)]


def trilaterated_antennas(measurements, poses, covariances, c):
    """(a, 2) positions of the antennas, m, by the best minimum of their trilateration."""
    by_antenna = ranges_by_antenna(measurements, poses, covariances, c)
    return np.reshape([trilaterate(ranges)[0][0] for ranges in by_antenna], (-1, 2))


def state_from_poses(measurements, poses, covariances, c=None, markers=consensus_markers,
                     antennas=trilaterated_antennas):
    """The State with these poses of the frames, and landmarks by their measurements from there.

    Poses (f, 3) and covariances (f, 3, 3) are in world axes, c (p,) is the calibration, None
    as stated. The functions `markers` and `antennas` initialise the landmarks; studies pass others.
    """
    s = measurements.sightings
    if c is None:
        c = measurements.calibration.stated.copy()
        c[SIGHTING_LAG] += measurements.jumps.lag
    camera, z = sensor_poses(measurements, poses, c)[0], s.z * [c[SIZE], c[SIZE], 1]
    in_world = se2.compose_uncertain(camera, covariances[s.row], z, s.C)
    return state_from_arrays(measurements, poses, markers(measurements, *in_world),
                             antennas(measurements, poses, covariances, c), c)


@dataclass(frozen=True)
class AntennaRanges:
    """The ranges to one antenna."""

    positions: np.ndarray    # (m, 2) m, of the tag
    distance: np.ndarray     # (m,) m in the plane, by the calibration
    sigma: np.ndarray        # (m,) m, including that of the vehicle's position
    guess: np.ndarray        # (2,) m, guessed position of the antenna


def ranges_by_antenna(measurements, poses, covariances, c, factor=1.0):
    """List of the AntennaRanges of every antenna, sigmas times `factor`; as `state_from_poses`."""
    r, by_antenna = measurements.ranges, []
    positions = sensor_poses(measurements, poses, c)[1][:, :2]
    slant = (r.distance - c[OFFSET] - c[ANTENNAS][r.antenna]) / c[SCALE]
    plane = np.sqrt(np.maximum(slant * np.abs(slant) - 2 * c[HEIGHT], 0)) \
        if c[HEIGHT] else slant
    sigma = factor * r.sigma / c[SCALE] * np.maximum(slant / np.maximum(plane, r.sigma), 1)
    position_sigma = np.sqrt(np.trace(covariances[:, :2, :2], axis1=1, axis2=2) / 2)
    for k, guess in enumerate(measurements.guess):
        rows = np.flatnonzero(r.antenna == k)
        by_antenna.append(AntennaRanges(
            positions[rows], plane[rows],
            np.hypot(sigma[rows], position_sigma[r.row[rows]]), guess))
    return by_antenna


def trilaterate(ranges):
    """Possible positions of an antenna with these AntennaRanges: minima of a Cauchy cost.

    The guess counts as two more measurements. The search starts there, and at START_DIRECTIONS
    points of a circle about the centre of the path, with the median range as radius: three are on
    both sides of any line through this centre.

    Returns
    -------
    places : (p, 2) m, with distances above SAME_PLACE, in the order of their costs.
    costs : (p,) negative log posterior, minus that of the first position.
    covariances : (p, 2, 2) m^2, of the position about each of them, from the curvature there.
    """
    guess, centre, radius = ranges.guess, ranges.positions.mean(0), np.median(ranges.distance)
    angle = np.arange(START_DIRECTIONS) * 2 * np.pi / START_DIRECTIONS
    circle = centre + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    used = np.unique(np.linspace(0, len(ranges.distance) - 1, MAX_RANGES).astype(int))
    positions, distance, sigma = ranges.positions[used], ranges.distance[used], ranges.sigma[used]

    def errors(place):
        return np.r_[(np.hypot(*(place - positions).T) - distance) / sigma,
                     (place - guess) / GUESS_PRIOR_SIGMA]

    def derivatives(place):
        difference = place - positions
        slope = np.maximum(np.hypot(*difference.T), MIN_DISTANCE) * sigma
        return np.r_[difference / slope[:, None], np.eye(2) / GUESS_PRIOR_SIGMA]

    minima = sorted((least_squares(errors, start, derivatives, loss="cauchy", f_scale=KERNEL_SCALE,
                                   ftol=TOLERANCE, xtol=TOLERANCE)
                     for start in (guess, *circle)), key=lambda each: each.cost)
    distinct = []
    for each in minima:
        if all(np.hypot(*(each.x - other.x)) > SAME_PLACE * radius for other in distinct):
            distinct.append(each)
    return (np.array([each.x for each in distinct]),
            np.array([each.cost - minima[0].cost for each in distinct]),
            np.linalg.inv([each.jac[:-2].T @ each.jac[:-2] + np.eye(2) / GUESS_PRIOR_SIGMA**2
                           for each in distinct]))


def second_moment(places, costs, covariances, estimate):
    """Second moment (2, 2), m^2, of an antenna's position about its estimate (2,).

    From what `trilaterate` returns: a mixture of Gaussians, each with the mass of its minimum.
    """
    mass = np.exp(-costs) * np.sqrt(np.linalg.det(covariances))
    off = places - estimate
    return np.tensordot(mass / mass.sum(), covariances + off[:, :, None] * off[:, None], 1)
