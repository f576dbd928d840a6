"""Stage 4: start values. Poses from odometry, markers by consensus, antennas by trilateration.

On a long drive odometry loses the heading. Therefore its first part is solved by the robust rounds
of stage 5. Odometry with the wheels that this part calibrated then predicts the poses of a longer
part, and so on. Each part tells the slip: wheels that are calibrated with a slip that is far too
small explain the slip, and predict badly. Stage 7 uses trilateration again for the antennas in
doubt.
"""

from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.graph import GUESS_PRIOR_SIGMA
from slamlib.core.increments import TYPICAL_SLIP
from slamlib.core.records import Dataset
from slamlib.core.sightings import consensus
from slamlib.robust.calibration import ANTENNAS, HEIGHT, OFFSET, SCALE, SIGHTING_LAG, SIZE, WHEELS
from slamlib.robust.factors import MIN_DISTANCE, sensor_poses
from slamlib.robust.fit import CAUCHY_SCALES, narrow_kernels
from slamlib.robust.linear import State, build_problem, state_from_arrays
from slamlib.robust.measurements import Measurements, Noise, measure, with_known
from slamlib.robust.noise import learn_noise
from slamlib.robust.optimize import cauchy_minimum

MAX_ODOMETRY_SIGMA = 0.5     # rad, of odometry's heading at the end of a part
MAX_FIRST_PART = 1.5         # length of the first part over that which odometry can predict
MIN_GROWTH = 1.5             # least ratio of a part that the slip shortens to the one before
GROWTH = 4                   # largest ratio of the numbers of poses of a part and the one before

MAX_RANGES = 150             # maximum number of ranges used per antenna, evenly chosen
SAME_PLACE = 0.03            # of the median range: positions closer than this are one
KERNEL_SCALE = 2.0           # sigmas, scale of the Cauchy kernel
START_DIRECTIONS = 3         # number of starts on a circle about the path
TOLERANCE = 1e-6             # relative, of cost, at which the search ends

FITTING = 3.0                # sigmas, error of a range that fits a position
MIN_OTHERS = 10              # number of ranges that fit the position of another antenna
MIN_TOO_SHORT = 0.2          # share of contradicting ranges; without line of sight they are long
MIN_FITTING = 0.5            # share of contradicting ranges that fit one other position


def initial_state(measurements: Measurements, model: str,
                  slip: float = TYPICAL_SLIP) -> tuple[State, Noise]:
    """The State from which a drive is solved, by odometry of the model "arc" or "euler".

    And the Noise with the slip that is known, or that a long drive's parts tell, else the one that
    is given, sqrt(m). Raises DatasetError as `optimize`, for the first part of a long drive.
    """
    dataset = measurements.dataset
    frame = measurements.frame
    noise = with_known(Noise(slip), dataset.vehicle)
    lengths = part_lengths(dataset, noise.slip)
    part = None
    state = None
    count = lengths[0]
    while count < len(dataset.ticks):
        longer = measure(dataset.first(count), frame[frame < count], measurements.jumps)
        state = odometry_state(longer, model, part, state)
        optimum = narrow_kernels(build_problem(longer, model, noise), state)
        if longer.learned[0]:
            noise = Noise(learn_noise(optimum.equations).noise.slip)
            scattered = optimum.equations.problem.noise._replace(slip=noise.slip)
            optimum = narrow_kernels(
                build_problem(longer, model, scattered), optimum.state, CAUCHY_SCALES[-1:])
        state = optimum.state
        part = longer
        planned = next(length for length in lengths if length > count)
        count = min(planned, _predictable(dataset, count, noise.slip))
    return odometry_state(measurements, model, part, state), noise


def part_lengths(dataset: Dataset, slip: float = TYPICAL_SLIP) -> list[int]:
    """Largest numbers of encoder poses of the parts of a drive, which all start at pose 1.

    Odometry with this slip, sqrt(m), predicts the headings of the first one. Each part is at most
    GROWTH times as long as the one before; the last one is the whole drive.
    """
    by_wheels = odometry.first_order(
        dataset.ticks, dataset.vehicle, initial_covariance=np.zeros((3, 3)))[1][:, 2, 2]
    lost = np.flatnonzero(by_wheels + _by_slip(dataset, slip) > MAX_ODOMETRY_SIGMA**2)
    length = len(dataset.ticks)
    lengths = [length]
    if not len(lost):
        return lengths
    first = max(lost[0], 2)
    while length > MAX_FIRST_PART * first:
        length = max(first, -(-length // GROWTH))        # rounded up
        lengths.insert(0, length)
    return lengths


def _predictable(dataset, count, slip):
    """Number of poses up to which odometry with a slip, sqrt(m), predicts headings after `count`.

    It is at least MIN_GROWTH times `count`.
    """
    variance = _by_slip(dataset, slip)
    predicted = np.searchsorted(variance, variance[count - 1] + MAX_ODOMETRY_SIGMA**2)
    return max(int(predicted), int(MIN_GROWTH * count))


def _by_slip(dataset, slip):
    """Variance (n,) of the headings by odometry, from a slip in sqrt(m)."""
    vehicle = dataset.vehicle
    travel = np.abs(dataset.ticks * vehicle.metres_per_count).sum(axis=1)
    return np.cumsum(slip**2 * travel) / vehicle.wheelbase**2


def odometry_state(measurements: Measurements, model: str, part: Measurements | None = None,
                   solved: State | None = None, **landmarks: Callable) -> State:
    """The State with poses by odometry of the model "arc" or "euler".

    Of Measurements of which a first `part` has the State `solved`, the later poses are those of
    odometry from the last pose of the part, with its wheels. `landmarks` are the keywords `markers`
    and `antennas` of `state_from_poses`.
    """
    dataset = measurements.dataset
    frame = measurements.frame
    jumps = measurements.jumps
    if part is None:
        poses, covariances = odometry.first_order(dataset.ticks, dataset.vehicle, model=model)
        poses = jumps.mended(frame, poses[frame])
        return state_from_poses(measurements, poses, covariances[frame], **landmarks)
    last = part.frame[-1]
    later, growth = odometry.first_order(
        dataset.ticks[last:], dataset.vehicle.with_wheel(solved.c[WHEELS]), solved.poses[-1],
        np.zeros((3, 3)), model=model)
    old = np.searchsorted(part.frame, frame[frame <= last])
    new = frame[frame > last] - last
    poses = np.concatenate([solved.poses[old], later[new]])
    covariances = np.concatenate([np.zeros((len(old), 3, 3)), growth[new]])
    c = measurements.calibration.taken_from(part.calibration, solved.c)
    poses = jumps.mended(frame, poses, last)
    return state_from_poses(measurements, poses, covariances, c, **landmarks)


def consensus_markers(measurements: Measurements, in_world: np.ndarray,
                      covariances: np.ndarray) -> np.ndarray:
    """(k, 3) poses of the markers, each by one of its sightings (`sightings.consensus`).

    `in_world` (s, 3) and `covariances` (s, 3, 3) are the marker poses by each sighting.
    """
    return in_world[consensus(measurements.marker_row, in_world, covariances)]


def trilaterated_antennas(measurements: Measurements, poses: np.ndarray, covariances: np.ndarray,
                          c: np.ndarray) -> np.ndarray:
    """(a, 2) positions of the antennas, m, by the best minimum of their trilateration."""
    by_antenna = ranges_by_antenna(measurements, poses, covariances, c)
    return np.reshape([trilaterate(ranges).places[0] for ranges in by_antenna], (-1, 2))


def state_from_poses(measurements: Measurements, poses: np.ndarray, covariances: np.ndarray,
                     c: np.ndarray | None = None, markers: Callable = consensus_markers,
                     antennas: Callable = trilaterated_antennas) -> State:
    """The State with these poses of the frames, and landmarks by their measurements from there.

    Poses (f, 3) and covariances (f, 3, 3) are in world axes, c (p,) is the calibration, None
    as stated. The functions `markers` and `antennas` initialise the landmarks; studies pass others.
    """
    if c is None:
        c = measurements.calibration.stated.copy()
        c[SIGHTING_LAG] += measurements.jumps.lag
    sightings = measurements.sightings
    camera = sensor_poses(measurements, poses, c)[0]
    z = sightings.z * [c[SIZE], c[SIZE], 1]
    in_world, of_markers = se2.compose_uncertain(
        camera, covariances[sightings.row], z, sightings.C)
    return state_from_arrays(
        measurements, poses, markers(measurements, in_world, of_markers),
        antennas(measurements, poses, covariances, c), c)


@dataclass(frozen=True)
class AntennaRanges:
    """The ranges to one antenna."""

    positions: np.ndarray    # (m, 2) m, of the tag
    distance: np.ndarray     # (m,) m in the plane, by the calibration
    sigma: np.ndarray        # (m,) m, including that of the vehicle's position
    guess: np.ndarray        # (2,) m, guessed position of the antenna

    def select(self, rows: np.ndarray) -> "AntennaRanges":
        """Those of some rows, indices or a mask."""
        return AntennaRanges(
            self.positions[rows], self.distance[rows], self.sigma[rows], self.guess)

    def errors(self, place: np.ndarray) -> np.ndarray:
        """(m,) expected minus measured ranges, in sigmas, to an antenna at `place` (2,), m."""
        expected = np.linalg.norm(place - self.positions, axis=1)
        return (expected - self.distance) / self.sigma

    def directions(self, place: np.ndarray) -> np.ndarray:
        """(m, 2) unit vectors from the tag to a `place` (2,), m."""
        difference = place - self.positions
        distance = np.linalg.norm(difference, axis=1)
        return difference / np.maximum(distance, MIN_DISTANCE)[:, None]


def ranges_by_antenna(measurements: Measurements, poses: np.ndarray, covariances: np.ndarray,
                      c: np.ndarray, factor: float = 1.0) -> list[AntennaRanges]:
    """The AntennaRanges of every antenna, sigmas times `factor`; as `state_from_poses`."""
    r = measurements.ranges
    tag = sensor_poses(measurements, poses, c)[1][:, :2]
    slant = (r.distance - c[OFFSET] - c[ANTENNAS][r.antenna]) / c[SCALE]
    plane = slant
    if c[HEIGHT]:
        plane = np.sqrt(np.maximum(slant * np.abs(slant) - 2 * c[HEIGHT], 0))
    steepness = np.maximum(slant / np.maximum(plane, r.sigma), 1)      # d plane / d slant
    range_sigma = factor * r.sigma / c[SCALE] * steepness
    position_sigma = np.sqrt(np.trace(covariances[:, :2, :2], axis1=1, axis2=2) / 2)
    sigma = np.hypot(range_sigma, position_sigma[r.row])
    return [AntennaRanges(tag, plane, sigma, guess).select(r.antenna == k)
            for k, guess in enumerate(measurements.guess)]


class Trilateration(NamedTuple):
    """Possible positions of an antenna, p minima of a cost, the best one first."""

    places: np.ndarray       # (p, 2) m, with distances above SAME_PLACE
    costs: np.ndarray        # (p,) negative log posterior, minus that of the first position
    covariances: np.ndarray  # (p, 2, 2) m^2, about each position, from the curvature there


def trilaterate(ranges: AntennaRanges) -> Trilateration:
    """The Trilateration of an antenna by its AntennaRanges: minima of a Cauchy cost.

    The guess counts as two more measurements.
    """
    used = np.unique(np.linspace(0, len(ranges.distance) - 1, MAX_RANGES).astype(int))
    some = ranges.select(used)
    radius = np.median(ranges.distance)
    starts = _starts(ranges.guess, ranges.positions.mean(axis=0), radius)
    minima = sorted((_minimum(some, start) for start in starts), key=attrgetter("cost"))
    distinct = []
    for minimum in minima:
        apart = [np.linalg.norm(minimum.x - other.x) for other in distinct]
        if min(apart, default=np.inf) > SAME_PLACE * radius:
            distinct.append(minimum)
    prior = np.eye(2) / GUESS_PRIOR_SIGMA**2
    by_place = [minimum.jac[:-2] for minimum in distinct]        # of the ranges, weighted
    return Trilateration(
        places=np.array([minimum.x for minimum in distinct]),
        costs=np.array([minimum.cost - minima[0].cost for minimum in distinct]),
        covariances=np.linalg.inv([J.T @ J + prior for J in by_place]))


def _starts(guess, centre, radius):
    """(1 + START_DIRECTIONS, 2) positions from which an antenna is searched, m.

    The guess, and points of a circle about the centre of the path, with the median range as radius:
    three are on both sides of any line through this centre.
    """
    angle = np.arange(START_DIRECTIONS) * 2 * np.pi / START_DIRECTIONS
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.vstack([guess, centre + radius * direction])


def _minimum(ranges, start):
    """The minimum next to a start (2,), of the Cauchy cost of AntennaRanges and their guess."""
    def errors(place):
        return np.concatenate([ranges.errors(place), (place - ranges.guess) / GUESS_PRIOR_SIGMA])

    def derivatives(place):
        by_place = ranges.directions(place) / ranges.sigma[:, None]
        return np.concatenate([by_place, np.eye(2) / GUESS_PRIOR_SIGMA])

    return cauchy_minimum(errors, start, derivatives, KERNEL_SCALE, TOLERANCE)


def second_moment(places: np.ndarray, costs: np.ndarray, covariances: np.ndarray,
                  estimate: np.ndarray) -> np.ndarray:
    """Second moment (2, 2), m^2, of an antenna's position about its estimate (2,).

    Of a Trilateration: a mixture of Gaussians, each with the mass of its minimum.
    """
    mass = np.exp(-costs) * np.sqrt(np.linalg.det(covariances))
    off = places - estimate
    about_estimate = covariances + off[:, :, None] * off[:, None]
    return np.tensordot(mass / mass.sum(), about_estimate, 1)


def other_antenna(ranges: AntennaRanges, estimate: np.ndarray, weight: np.ndarray) -> str | None:
    """The reason to doubt an antenna if some of its ranges are to another place, or None.

    Ranges of AntennaRanges with less than half of their weights (m,) contradict the estimate (2,),
    m. Without line of sight all of them are too long, and fit no place. Those to another antenna
    fit one other place, and many are too short; so do direct ones where a wall had the majority.
    """
    others = ranges.select(weight < 0.5)
    if len(others.distance) < MIN_OTHERS:
        return None
    too_short = others.errors(estimate) > FITTING
    if np.mean(too_short) < MIN_TOO_SHORT:
        return None
    place = trilaterate(others).places[0]
    fitting = np.abs(others.errors(place)) < FITTING
    count = np.count_nonzero(fitting)
    if count < max(MIN_OTHERS, MIN_FITTING * len(fitting)):
        return None
    return (f"{count} of its {len(weight)} ranges fit another place, ({place[0]:.1f}, "
            f"{place[1]:.1f}), as if two antennas had this id, or it was moved, or hidden by a "
            "wall in a part of the drive")
