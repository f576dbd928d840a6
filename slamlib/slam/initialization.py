"""Stage 4: start values. Poses from odometry, markers by consensus, antennas by trilateration.

On a long drive odometry loses the heading. Therefore its first part is solved by the robust rounds
of stage 5. Odometry with the wheels that this part calibrated then predicts the poses of a longer
part, and so on. Stage 7 uses trilateration again for the antennas in doubt.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import odometry, se2
from slamlib.sightings import consensus
from slamlib.slam.calibration import ANTENNAS, HEIGHT, OFFSET, SCALE, SIGHTING_LAG, SIZE, WHEELS
from slamlib.slam.factors import MIN_DISTANCE, sensor_poses
from slamlib.slam.fit import narrow_kernels
from slamlib.slam.linear import build_problem, state_from_arrays
from slamlib.slam.measurements import GUESS_PRIOR_SIGMA, measure

MAX_ODOMETRY_SIGMA = 0.5     # rad, of odometry's heading at the end of a drive's first part
MAX_FIRST_PART = 1.5         # length of the first part over that which odometry can predict
GROWTH = 4                   # largest ratio of the numbers of poses of a part and the one before
MAX_VOTES = 60               # number of sightings of a marker that enter its consensus

MAX_RANGES = 150             # maximum number of ranges used per antenna, evenly chosen
SAME_PLACE = 0.03            # of the median range: positions closer than this are one
KERNEL_SCALE = 2.0           # sigmas, scale of the Cauchy kernel
START_DIRECTIONS = 8         # number of starts on a circle about the path
MAX_SEARCH_STEPS = 60        # number of steps of the search
STEP_TOLERANCE = 1e-6        # m, length of a step at which the search ends
FIRST_DAMPING = 1e-3         # share of the curvature that is added to it
DAMPING_FACTOR = 10          # by which damping falls after a descent and grows after an ascent
MIN_ASCENT_DAMPING = 0.1     # damping from which it grows after an ascent
SMALLEST_CURVATURE = 1e-3    # of the smaller over the larger second derivative
GRID = (200, 361)            # numbers of radii and angles of the grid of `second_moment`
GRID_MARGIN = 1.5            # of the longest range, by which the grid exceeds the path


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
    A, B = se2.compose_jacobians(camera, z)
    C = A @ covariances[s.row] @ A.mT + B @ s.C @ B.mT
    return state_from_arrays(measurements, poses, markers(measurements, se2.compose(camera, z), C),
                             antennas(measurements, poses, covariances, c), c)


@dataclass(frozen=True)
class AntennaRanges:
    """The ranges to one antenna."""

    positions: np.ndarray    # (m, 2) m, of the tag
    distance: np.ndarray     # (m,) m in the plane, by the calibration
    sigma: np.ndarray        # (m,) m, including that of the vehicle's position
    guess: np.ndarray        # (2,) m, guessed position of the antenna

    def evenly_chosen(self):
        """AntennaRanges of at most MAX_RANGES of these."""
        chosen = np.unique(np.linspace(0, len(self.distance) - 1, MAX_RANGES).astype(int))
        return AntennaRanges(
            self.positions[chosen], self.distance[chosen], self.sigma[chosen], self.guess)


def ranges_by_antenna(measurements, poses, covariances, c, factor=1.0):
    """List of the AntennaRanges of every antenna; parameters as of `state_from_poses`.

    `factor` multiplies the sigmas of the ranges.
    """
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

    The search starts at the guess, at its reflection through the centre of the path, and at
    START_DIRECTIONS points of a circle about this centre, with the median range as radius.

    Returns
    -------
    places : (p, 2) m, with distances above SAME_PLACE, in the order of their costs.
    costs : (p,) negative log posterior, minus that of the first position.
    """
    guess, centre, radius = ranges.guess, ranges.positions.mean(0), np.median(ranges.distance)
    angle = np.arange(START_DIRECTIONS) * 2 * np.pi / START_DIRECTIONS
    circle = centre + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    minima, cost = _minima(
        ranges.evenly_chosen(), np.concatenate([[guess, 2 * centre - guess], circle]))
    distinct = []
    for k in np.argsort(cost, kind="stable"):
        if all(np.hypot(*(minima[k] - minima[j])) > SAME_PLACE * radius for j in distinct):
            distinct.append(k)
    return minima[distinct], cost[distinct] - cost[distinct[0]]


def _minima(ranges, places):
    """Minima (p, 2) of the Cauchy cost from the starts `places` (p, 2), and their costs (p,).

    Newton's method from all starts at once, with the absolute values of the second derivatives; a
    step that does not descend is repeated with more damping.
    """
    damping, (cost, gradient, hessian) = np.full(len(places), FIRST_DAMPING), _cost(ranges, places)
    for _ in range(MAX_SEARCH_STEPS):
        curvature, axes = np.linalg.eigh(hessian)
        least = SMALLEST_CURVATURE * np.abs(curvature).max(axis=1, keepdims=True)
        curvature = np.maximum(np.abs(curvature), least) * (1 + damping[:, None])
        along_axes = np.einsum("pik,pi->pk", axes, gradient) / curvature
        step = -np.einsum("pik,pk->pi", axes, along_axes)
        trial = _cost(ranges, places + step)
        better = trial[0] <= cost
        damping = np.where(better, damping / DAMPING_FACTOR,
                           np.maximum(damping, MIN_ASCENT_DAMPING) * DAMPING_FACTOR)
        places = np.where(better[:, None], places + step, places)
        for current, new in zip((cost, gradient, hessian), trial):
            current[better] = new[better]
        if (np.abs(step).max(axis=1) < STEP_TOLERANCE).all():
            break
    return places, cost


def _cost(ranges, places):
    """The Cauchy cost (p,) at `places` (p, 2), its gradient (p, 2) and Hessian (p, 2, 2).

    The guess counts as two more measurements.
    """
    difference, root = places[:, None] - ranges.positions, 1 / ranges.sigma
    distance = np.maximum(np.hypot(difference[..., 0], difference[..., 1]), MIN_DISTANCE)
    e, direction = root * (distance - ranges.distance), difference / distance[..., None]
    e_guess = (places - ranges.guess) / GUESS_PRIOR_SIGMA
    first, second = _cauchy_derivatives(e)
    first_guess, second_guess = _cauchy_derivatives(e_guess)
    gradient = ((root * first)[:, None] @ direction)[:, 0] + first_guess / GUESS_PRIOR_SIGMA
    lateral = root * first / distance                            # because the direction turns
    radial = (root**2 * second - lateral)[..., None] * direction
    hessian = direction.mT @ radial
    hessian[:, [0, 1], [0, 1]] += lateral.sum(1)[:, None] + second_guess / GUESS_PRIOR_SIGMA**2
    cost = np.log1p((e / KERNEL_SCALE)**2).sum(1) + np.log1p((e_guess / KERNEL_SCALE)**2).sum(1)
    return KERNEL_SCALE**2 / 2 * cost, gradient, hessian


def _cauchy_derivatives(e):
    """First and second derivative of the Cauchy cost by the errors e."""
    squared = (e / KERNEL_SCALE)**2
    return e / (1 + squared), (1 - squared) / (1 + squared)**2


def second_moment(ranges, estimate):
    """Second moment (2, 2), m^2, of an antenna's position about its estimate (2,) by AntennaRanges.

    The posterior, the Cauchy likelihood of the ranges times the prior of the guess, is summed over
    a polar grid, range by range: an array of the grid times all ranges would take 500 MB.
    """
    centre = ranges.positions.mean(0)
    longest = np.maximum(ranges.distance, 3 * ranges.sigma).max()
    reach = GRID_MARGIN * longest + np.ptp(ranges.positions, axis=0).max()
    radius, angle = np.meshgrid(np.linspace(0, reach, GRID[0])[1:],
                                np.linspace(-np.pi, np.pi, GRID[1])[1:])
    place = centre + radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    used = ranges.evenly_chosen()
    sigma = np.hypot(used.sigma, reach / GRID[0] / 2)            # at least half a cell of the grid
    cost = np.sum((place - ranges.guess)**2, axis=-1) / GUESS_PRIOR_SIGMA**2 / 2
    for origin, measured, s in zip(used.positions, used.distance, sigma):
        e = (np.hypot(place[..., 0] - origin[0], place[..., 1] - origin[1]) - measured) / s
        cost += KERNEL_SCALE**2 * np.log1p((e / KERNEL_SCALE)**2) / 2
    density = radius * np.exp(cost.min() - cost)
    difference = place - estimate
    return np.einsum("abi,abj,ab->ij", difference, difference, density) / density.sum()
