"""Simulated datasets in the assignment's format, with their truth.

The vehicle drives a smooth closed path as a sequence of exact circular arcs. Its wheel parameters
differ from the nominal ones by one draw of their standard deviations. Each encoder counts the
travelled distance plus slip, a random walk with variance slip^2 per metre, and rounds the total
down to whole counts. The camera sees the markers in a disc around the vehicle; the UWB tag measures
ranges to the antennas within reach. Both have a lower rate than the encoders.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.spatial import KDTree

from slamlib.core import se2
from slamlib.core.odometry import dead_reckoning
from slamlib.core.records import AntennaGuess, ArucoReadings, Dataset, Truth, UwbReadings
from slamlib.core.vehicle import TABLE_2, Vehicle
from slamlib.io.dataset import write_vehicle
from slamlib.io.formats import VEHICLE


@dataclass(frozen=True)
class Layout:
    """A closed path, a sum of rotating vectors, with its markers, antennas and rates."""

    turns: tuple                 # of each vector; twice as many drive the path twice
    radii: tuple                 # m, lengths of the vectors
    phases: tuple                # rad
    poses: int                   # of the encoders
    aruco_every: int             # poses from one camera frame to the next
    marker_spacing: float        # m
    uwb_every: int               # poses from one set of ranges to the next
    antennas: int
    gap_place: float = 0.0       # fraction of the path, centre of a disc without markers
    gap_radius: float = 0.0      # m, of this disc


PATHS = {
    "short": Layout(
        turns=(1, -1, 2, 3), radii=(2.9, 0.9, 0.7, 0.2), phases=(0.0, 0.3, 2.0, 1.0), poses=2000,
        aruco_every=10, marker_spacing=1.5, uwb_every=20, antennas=4),
    "long": Layout(
        turns=(4, -3, 1), radii=(8.9, 3.9, 3.3), phases=(0.0, 0.5, 1.0), poses=23000,
        aruco_every=12, marker_spacing=1.9, uwb_every=25, antennas=8,
        gap_place=0.42, gap_radius=3.5),
}
CAMERA_REACH = 1.8      # m, largest distance in the plane at which a marker is in the image
UWB_REACH = 15.0        # m, largest distance to an antenna that is measured
LATE_RANGE_MEAN = 0.8   # m, mean of the exponential excess of late ranges
SIMULATED_GUESS_SIGMA = 0.35   # m per axis, standard deviation of the antenna guesses
CONFUSED = 0.15         # share of the sightings whose labels `confuse_labels` makes wrong
TWIN_EVERY = 5          # markers, of which one is read as its twin
TWIN_MISREAD = 0.6      # of its sightings
SPEED_SWING = 0.15      # largest deviation of the speed from its mean, over the mean
SPEED_PERIODS = 5       # of the speed, in the whole drive


def simulate(path: str = "short", seed: int = 0, *, slip: float = 1e-3, late_ranges: float = 0.0,
             mislabelled: float = 0.0, memory: float = 0.0, noise: bool = True,
             vehicle: Vehicle = TABLE_2, markers: bool = True, poses: int | None = None
             ) -> tuple[Dataset, Truth]:
    """A simulated dataset and its truth.

    Parameters
    ----------
    path : "short" (about 20 m, 2,000 poses) or "long" (about 230 m, 23,000 poses, one section
        without markers).
    seed : of the random generator; equal arguments give equal data.
    slip : sqrt(m), standard deviation of the slip of one wheel after one metre.
    late_ranges, mislabelled : fractions of the UWB ranges that are too long (no line of sight) and
        of the sightings that have another marker's id.
    memory : correlation of the errors of a marker's sightings from one camera frame to the next.
    noise : False gives the nominal vehicle, fractional counts, and exact sightings, ranges and
        antenna guesses. The stated covariances do not change.
    vehicle : Vehicle, the nominal one.
    markers : False for a vehicle without a camera.
    poses : number of the first poses that are kept; None for all.

    Returns Dataset and Truth.

    >>> dataset, truth = simulate("short", seed=1, late_ranges=0.1)
    >>> dataset.ticks.shape, truth.poses.shape
    ((2000, 2), (2000, 3))
    """
    layout = PATHS[path]
    rng = np.random.default_rng(seed)

    wheel_error = noise * rng.normal(0, vehicle.sigma_wheel)
    true_vehicle = vehicle.with_wheel(vehicle.wheel + wheel_error)
    ds, dtheta = _driven_arcs(layout)
    counts = _counts(ds, dtheta, true_vehicle)
    true_poses = dead_reckoning(counts, true_vehicle, model="arc")
    whole_counts = _encoder(counts, true_vehicle, slip, rng)

    marker, marker_in_world = _place_markers(layout, true_poses, rng)
    antenna, antenna_in_world = _place_antennas(layout.antennas, true_poses, rng)
    truth = Truth(true_poses, marker, marker_in_world, antenna, antenna_in_world, true_vehicle)

    aruco = _camera(truth, layout.aruco_every, mislabelled, memory, noise, rng)
    uwb = _uwb(truth, layout.uwb_every, late_ranges, noise, rng)
    guess_error = SIMULATED_GUESS_SIGMA * rng.standard_normal(antenna_in_world.shape)
    guess = AntennaGuess(antenna, antenna_in_world + noise * guess_error)
    if not markers:
        aruco = None
    dataset = Dataset(path, vehicle, whole_counts if noise else counts, aruco, uwb, guess)
    truth = replace(truth, poses=true_poses[:poses])
    return dataset.first(len(truth.poses)), truth


def misguess(dataset: Dataset, position: np.ndarray, error: float, seed: int) -> Dataset:
    """The Dataset with antenna guesses `error` m from `position` (a, 2), in random directions.

    `position` has the antennas of the guesses in the same order. `seed` is of the random generator.
    """
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi, len(position))
    guess = replace(dataset.antenna_guess, position=position + error * _direction(angle))
    return replace(dataset, antenna_guess=guess)


def confuse_labels(dataset: Dataset, kind: str, seed: int) -> Dataset:
    """The Dataset with wrong labels of a kind, drawn with a seed.

    "random": 15 % of the sightings have the label of any other marker. "in frame": about 10 %
    have exchanged labels with another sighting of the same image. "twins": every fifth marker is
    read as one certain other marker, its twin, in 60 % of its sightings. "none": all are right.
    """
    aruco = dataset.aruco
    rng = np.random.default_rng(seed)
    label = aruco.marker.copy()
    ids, number = np.unique(label, return_inverse=True)
    if kind == "random":
        label = ids[_relabelled(number, len(ids), CONFUSED, rng)]
    elif kind == "in frame":
        for first in np.flatnonzero(rng.uniform(size=len(label)) < CONFUSED / 2):
            second = rng.choice(np.flatnonzero(aruco.pose == aruco.pose[first]))
            label[[first, second]] = label[[second, first]]
    elif kind == "twins":
        ids = rng.permutation(ids)
        misread = rng.uniform(size=len(label)) < TWIN_MISREAD
        for marker, twin in zip(ids[::TWIN_EVERY], ids[1::TWIN_EVERY]):
            label[misread & (aruco.marker == marker)] = twin
    return replace(dataset, aruco=replace(aruco, marker=label))


def manoeuvre(legs: list[tuple[float, float]], vehicle: Vehicle = TABLE_2) -> np.ndarray:
    """Counts (n, 2) of the right and left wheel in a drive in arcs, with fractions, without noise.

    `legs` lists (m, rad), length and turn of each arc; negative lengths are driven backwards. A
    step is at most 1 cm long, or turns a wheel by as much about the middle. Row 0 is zero.
    """
    legs = np.asarray(legs, dtype=float)
    travel = np.abs(legs * [1, vehicle.wheelbase / 2])     # m, of the middle; of a wheel about it
    steps = np.ceil(travel.max(axis=1) / 0.01).astype(int)
    arcs = np.repeat(legs / steps[:, None], steps, axis=0)
    return _counts(arcs[:, 0], arcs[:, 1], vehicle)


def write_dataset(folder: str | Path, dataset: Dataset, truth: Truth | None = None) -> None:
    """Write a Dataset, and its Truth if given, as the assignment's text files.

    Raises FileExistsError if the folder exists.
    """
    folder = Path(folder)
    folder.mkdir(parents=True)
    if dataset.vehicle != TABLE_2:
        write_vehicle(folder / VEHICLE, dataset.vehicle)
    number = np.arange(1, len(dataset.ticks) + 1)
    _write_table(folder / "encoderReading.txt", "%d %d %d", number, dataset.ticks)
    aruco = dataset.aruco
    if aruco is not None:
        row, column = np.triu_indices(3)
        _write_table(folder / "ArucoReading.txt", "%d %d %.5f %.5f %.5f" + 6 * " %.4e",
                     aruco.pose + 1, aruco.marker, aruco.marker_in_vehicle,
                     aruco.covariance[:, row, column])
    uwb = dataset.uwb
    if uwb is not None:
        guess = dataset.antenna_guess
        _write_table(folder / "UwbReading.txt", "%d %d %.4f %.4f",
                     uwb.pose + 1, uwb.antenna, uwb.range, uwb.sigma)
        _write_table(folder / "UwbAntennaGuess.txt", "%d %.3f %.3f", guess.antenna, guess.position)
    if truth is not None:
        folder = folder / "truth"
        write_vehicle(folder / VEHICLE, truth.vehicle)
        _write_table(folder / "vehiclePose.txt", "%d %.6f %.6f %.6f", number, truth.poses)
        _write_table(folder / "ArucoMap.txt", "%d %.6f %.6f %.6f",
                     truth.marker, truth.marker_in_world)
        _write_table(folder / "UwbMap.txt", "%d %.6f %.6f", truth.antenna, truth.antenna_in_world)


def _write_table(path, row_format, *columns):
    """Write columns, arrays (n,) or (n, c)."""
    np.savetxt(path, np.column_stack(columns), fmt=row_format)


def _driven_arcs(layout):
    """Lengths (n-1,) in m and turns (n-1,) in rad of the arcs of the path, at varying speed.

    With s the angle that parametrises a round, the path is the sum of r exp(i (t s + p)) over the
    vectors with turns t, radii r and phases p.
    """
    turns, radii, phases = np.array([layout.turns, layout.radii, layout.phases])[:, :, None]
    amplitudes = 1j * radii * turns

    def velocity(s):
        return np.sum(amplitudes * np.exp(1j * (turns * s + phases)), axis=0)

    fine = np.linspace(0, 2 * np.pi, 10 * layout.poses + 1)
    length = cumulative_simpson(np.abs(velocity(fine)), x=fine, initial=0.0)
    time = np.linspace(0, 1, layout.poses)
    frequency = 2 * np.pi * SPEED_PERIODS
    travelled = length[-1] * (time - SPEED_SWING * np.sin(frequency * time) / frequency)
    s = np.interp(travelled, length, fine)
    heading = np.unwrap(np.angle(velocity(s)))
    return np.diff(travelled), np.diff(heading)


def _counts(ds, dtheta, vehicle):
    """Counts (n, 2), right and left, with fractions, on arcs of length ds and turn dtheta."""
    half_turn = vehicle.wheelbase * dtheta / 2
    steps = np.column_stack([ds + half_turn, ds - half_turn])
    travel = np.pad(steps, ((1, 0), (0, 0)))
    return travel / vehicle.metres_per_count


def _encoder(counts, vehicle, slip, rng):
    """Whole counts (n, 2) of an encoder on wheels that slip, of counts with fractions."""
    steps = counts[1:]
    sigma = slip * np.sqrt(np.abs(steps) / vehicle.metres_per_count)            # of the counts
    slipped = steps + sigma * rng.standard_normal(steps.shape)
    first_fraction = rng.uniform(size=2)
    total = np.floor(np.cumsum(slipped, axis=0) + first_fraction).astype(np.int64)
    return np.diff(total, axis=0, prepend=np.zeros((2, 2), np.int64))


def _place_markers(layout, poses, rng):
    """Ids (k,) and poses (k, 3) of markers on a jittered grid over the driven area."""
    spacing = layout.marker_spacing
    path = poses[:, :2]
    low = path.min(axis=0) - CAMERA_REACH
    high = path.max(axis=0) + CAMERA_REACH
    x = np.arange(low[0], high[0], spacing)
    y = np.arange(low[1], high[1], spacing)
    place = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    place += spacing * rng.uniform(-0.35, 0.35, place.shape)

    closest = KDTree(path[::10]).query(place)[0]
    gap = path[int(layout.gap_place * len(path))]
    outside_gap = distances(place, gap) > layout.gap_radius
    place = place[(closest < CAMERA_REACH) & outside_gap]

    count = len(place)
    ids = np.sort(rng.choice(np.arange(1, max(250, count + 1)), count, replace=False))
    order = rng.permutation(count)
    heading = rng.uniform(-np.pi, np.pi, count)
    return ids, np.column_stack([place[order], heading])


def _place_antennas(count, poses, rng):
    """Ids (a,) and positions (a, 2) of antennas on an ellipse around the driven area."""
    path = poses[:, :2]
    low = path.min(axis=0)
    high = path.max(axis=0)
    sector = np.arange(count) + rng.uniform(-0.2, 0.2, count)
    angle = 2 * np.pi * sector / count + np.pi / 4
    half_axes = 0.6 * (high - low) + 1.0
    position = (low + high) / 2 + half_axes * _direction(angle)
    ids = np.sort(rng.choice(np.arange(1, 60), count, replace=False))
    return ids, position[rng.permutation(count)]


def _camera(truth, every, mislabelled, memory, noise, rng):
    """Sightings of all markers in the disc of CAMERA_REACH around every `every`-th pose."""
    frames = np.arange(0, len(truth.poses), every)
    seen = KDTree(truth.marker_in_world[:, :2]).query_ball_point(
        truth.poses[frames, :2], CAMERA_REACH, return_sorted=True)
    frame = np.repeat(np.arange(len(frames)), [len(markers) for markers in seen])
    marker = np.concatenate(seen).astype(int)
    true_z = se2.between(truth.poses[frames[frame]], truth.marker_in_world[marker])
    covariance = _sighting_covariance(true_z)
    unit_error = _correlated(rng.standard_normal(true_z.shape), frame, marker, memory)
    error = np.linalg.cholesky(covariance) @ unit_error[..., None]
    z = true_z + noise * error[..., 0]
    z[:, 2] = se2.wrap(z[:, 2])
    read_as = _relabelled(marker, len(truth.marker), mislabelled, rng)
    return ArucoReadings(frames[frame], truth.marker[read_as], z, covariance)


def _sighting_covariance(z):
    """Covariances (m, 3, 3) of sightings z (m, 3), which err most along the line of sight."""
    distance = np.hypot(z[:, 0], z[:, 1])
    correlation = [[1, 0, 0], [0, 1, 0.4], [0, 0.4, 1]]
    sigma = [4e-3, 3e-3, 4e-3] + distance[:, None] * [5e-3, 3e-3, 3e-3]
    along_sight = sigma[:, :, None] * correlation * sigma[:, None]
    return se2.rotate_covariance(along_sight, np.arctan2(z[:, 1], z[:, 0]))


def _correlated(error, frame, marker, memory):
    """Errors (m, 3) of unit variance, those of a marker correlated by `memory` a camera frame.

    A Gauss-Markov process made of independent errors (m, 3): e' = rho e + sqrt(1 - rho^2) error.
    """
    found = error.copy()
    order = np.lexsort((frame, marker))
    for last, k in pairwise(order):
        if marker[k] == marker[last]:
            rho = memory**(frame[k] - frame[last])
            found[k] = rho * found[last] + np.sqrt(1 - rho**2) * error[k]
    return found


def _relabelled(label, count, fraction, rng):
    """The labels (m,), numbers below `count`, with another one at a fraction of them."""
    wrong = rng.uniform(size=len(label)) < fraction
    shift = rng.integers(1, max(2, count), len(label))
    return np.where(wrong, (label + shift) % count, label)


def _uwb(truth, every, late_ranges, noise, rng):
    """Ranges to all antennas within UWB_REACH of every `every`-th pose, some of them late."""
    frames = np.arange(every // 2, len(truth.poses), every)
    distance = distances(truth.poses[frames, None], truth.antenna_in_world)
    frame, antenna = np.nonzero(distance < UWB_REACH)
    true_range = distance[frame, antenna]
    count = len(true_range)
    sigma = 0.05 + 0.004 * true_range
    late = rng.uniform(size=count) < late_ranges
    excess = late * rng.exponential(LATE_RANGE_MEAN, count)
    error = noise * sigma * rng.standard_normal(count)
    measured = np.maximum(true_range + error + excess, 1e-3)
    return UwbReadings(frames[frame], truth.antenna[antenna], measured, sigma)


def distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Distances (...) in the plane between points or poses (..., >= 2)."""
    offset = first[..., :2] - second[..., :2]
    return np.hypot(offset[..., 0], offset[..., 1])


def _direction(angle):
    """Unit vectors (n, 2) at angles (n,) in rad."""
    return np.column_stack([np.cos(angle), np.sin(angle)])
