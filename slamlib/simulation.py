"""Stand-ins for the course's logs: datasets in the assignment's format, with their truth.

The vehicle drives a smooth closed path as a sequence of exact circular arcs. Its wheel radii and
wheelbase differ from table 2 by one draw of table 2's sigmas. Each wheel's encoder counts the
travelled distance plus slip, a random walk with variance slip^2 per metre, and rounds the
cumulative angle down to whole counts. The camera sees the markers in a disc around the vehicle,
at a lower rate; the UWB tag ranges to the antennas within reach, at its own rate.
"""

import os
import shutil
import tempfile
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from slamlib import se2
from slamlib.dataset import (AntennaGuess, ArucoReadings, Dataset, DatasetError, Truth, UwbReadings,
                             Vehicle)

# A path is a sum of turning vectors (turns per round, radius in m, phase in rad). Markers are
# missing in a disc: where its centre lies, as a share of the path's length, and its radius in m.
PATHS = {
    "short": SimpleNamespace(
        vectors=((1, 2.9, 0.0), (-1, 0.9, 0.3), (2, 0.7, 2.0), (3, 0.2, 1.0)), poses=2000,
        aruco_every=10, marker_spacing=1.5, markers_missing=None, uwb_every=20, antennas=4),
    "long": SimpleNamespace(
        vectors=((4, 8.9, 0.0), (-3, 3.9, 0.5), (1, 3.3, 1.0)), poses=23000,
        aruco_every=12, marker_spacing=1.9, markers_missing=(0.42, 3.5), uwb_every=25, antennas=8),
}
CAMERA_REACH = 1.8                     # m, a marker further away in the plane is out of the image
UWB_REACH = 15.0                       # m
LATE_RANGE_MEAN = 0.8                  # m, mean of the exponential excess of late ranges
GUESS_SIGMA = 0.35                     # m per axis: antenna guesses are off by about half a metre


def simulate(path="short", seed=0, *, slip=1e-3, late_ranges=0.0, mislabelled=0.0, rounds=1,
             noise=True, vehicle=Vehicle()):
    """A dataset and its truth.

    Parameters
    ----------
    path : "short" (about 20 m, 2,000 poses) or "long" (about 230 m, 23,000 poses, a stretch
        without markers).
    seed : of the random generator; equal arguments give equal data.
    slip : sqrt(m); a wheel that travels s metres turns as for s plus N(0, slip^2 s).
    late_ranges, mislabelled : shares of UWB ranges that are too long (no line of sight), and of
        marker sightings that carry another marker's id.
    rounds : how often the closed path is driven.
    noise : False gives perfect sensors and table 2's vehicle: counts with fractions, exact
        sightings, ranges and antenna guesses. Covariances stay as they would be.
    vehicle : Vehicle, the nominal one.

    Returns
    -------
    dataset : Dataset
    truth : Truth
    """
    layout = PATHS[path]
    rng = np.random.default_rng(seed)
    draws = noise * rng.standard_normal(3)
    true_vehicle = vehicle.with_wheel(vehicle.wheel + vehicle.sigma_wheel * draws)
    ds, dtheta = _drive(layout, rounds)
    poses = _arcs(ds, dtheta)
    ticks = _encoder(ds, dtheta, true_vehicle, slip, noise, rng)
    marker, marker_in_world = _place_markers(layout, poses, rng)
    antenna, antenna_in_world = _place_antennas(layout, poses, rng)
    aruco = _camera(poses, marker, marker_in_world, layout.aruco_every, mislabelled, noise, rng)
    uwb = _uwb(poses, antenna, antenna_in_world, layout.uwb_every, late_ranges, noise, rng)
    offset = GUESS_SIGMA * rng.standard_normal(antenna_in_world.shape)
    guess = AntennaGuess(antenna, antenna_in_world + noise * offset)
    return (Dataset(path, vehicle, ticks, aruco, uwb, guess),
            Truth(poses, marker, marker_in_world, antenna, antenna_in_world, true_vehicle))


def misguess(dataset, truth, error, seed):
    """The dataset with antenna guesses that are wrong by `error` metres, each in a direction of its own."""
    angle = np.random.default_rng(seed).uniform(-np.pi, np.pi, len(truth.antenna))
    off = error * np.stack([np.cos(angle), np.sin(angle)], -1)
    return replace(dataset, antenna_guess=AntennaGuess(truth.antenna, truth.antenna_in_world + off))


def manoeuvre(legs, vehicle=Vehicle(), step=0.01):
    """Counts of a drive in arcs, without noise: to show or test what a certain drive does.

    Parameters
    ----------
    legs : list of (metres, radians) driven and turned in each leg; negative metres are backwards.
    vehicle : Vehicle
    step : m, the longest step.

    Returns
    -------
    (n, 2) counts of the right and left wheel, with fractions; row 0 is zero.
    """
    half, counts = vehicle.wheelbase / 2, [np.zeros((1, 2))]
    for length, turn in legs:
        steps = int(np.ceil(max(abs(length), abs(turn) * half) / step))
        travel = np.array([length + half * turn, length - half * turn]) / steps
        radii = vehicle.wheel[:2]
        counts.append(np.tile(travel * vehicle.ticks_per_revolution / (2 * np.pi * radii), (steps, 1)))
    return np.concatenate(counts)


def write_dataset(folder, dataset, truth=None):
    """Write a dataset (and its truth) as the assignment's text files, all of it or nothing.

    Raises DatasetError when the folder exists and is not empty.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DatasetError(f"{folder}: expected a new or empty folder to write the dataset to")
    folder.parent.mkdir(parents=True, exist_ok=True)
    beside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        beside.chmod(0o755)
        _write_sensors(beside, dataset)
        if truth is not None:
            _write_truth(beside / "truth", truth)
        os.replace(beside, folder)
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def _drive(layout, rounds):
    """Arc lengths (n-1,) and turns (n-1,) of the closed path, at a smoothly varying speed."""
    turns, radius, phase = np.array(layout.vectors).T[:, :, None]

    def velocity(u):
        angle = turns * u + phase
        return np.stack([-radius * turns * np.sin(angle), radius * turns * np.cos(angle)]).sum(1)

    fine = np.linspace(0, 2 * np.pi * rounds, 200 * layout.poses // 20 * rounds + 1)
    speed = np.hypot(*velocity(fine))
    middle = np.hypot(*velocity((fine[1:] + fine[:-1]) / 2))
    length = np.concatenate([[0], np.cumsum((speed[1:] + 4 * middle + speed[:-1]) / 6)])  # Simpson
    length *= fine[1]
    time = np.linspace(0, 1, layout.poses * rounds)
    travelled = length[-1] * (time - 0.15 * np.sin(2 * np.pi * 5 * time) / (2 * np.pi * 5))
    direction = velocity(np.interp(travelled, length, fine))
    return np.diff(travelled), np.diff(np.unwrap(np.arctan2(direction[1], direction[0])))


def _arcs(ds, dtheta):
    """Poses (n, 3) along arcs of length ds and turn dtheta, from [0, 0, 0]."""
    heading = np.concatenate([[0], np.cumsum(dtheta)])
    chord, direction = ds * np.sinc(dtheta / (2 * np.pi)), heading[:-1] + dtheta / 2
    return np.stack([np.concatenate([[0], np.cumsum(chord * np.cos(direction))]),
                     np.concatenate([[0], np.cumsum(chord * np.sin(direction))]), heading], -1)


def _encoder(ds, dtheta, vehicle, slip, noise, rng):
    """Counts (n, 2), right and left; whole numbers unless noise is False."""
    travel = np.stack([ds + vehicle.wheelbase * dtheta / 2, ds - vehicle.wheelbase * dtheta / 2], -1)
    slipped = travel + slip * np.sqrt(np.abs(travel)) * rng.standard_normal(travel.shape)
    phase = rng.uniform(size=2)
    metres_per_count = 2 * np.pi * vehicle.wheel[:2] \
        / vehicle.ticks_per_revolution
    if not noise:
        return np.concatenate([np.zeros((1, 2)), travel / metres_per_count])
    total = np.floor(np.cumsum(slipped, axis=0) / metres_per_count + phase).astype(np.int64)
    return np.concatenate([total[:1] * 0, np.diff(total, axis=0, prepend=0)])


def _place_markers(layout, poses, rng):
    """Ids (k,) and poses (k, 3) of ceiling markers on a jittered grid over the driven area."""
    low, high = poses[:, :2].min(0) - CAMERA_REACH, poses[:, :2].max(0) + CAMERA_REACH
    grid = np.stack(np.meshgrid(*(np.arange(a, b, layout.marker_spacing)
                                  for a, b in zip(low, high))), -1).reshape(-1, 2)
    grid += layout.marker_spacing * rng.uniform(-0.35, 0.35, grid.shape)
    near = np.array([np.hypot(*(poses[::10, :2] - p).T).min() < CAMERA_REACH for p in grid])
    if layout.markers_missing is not None:
        share, radius = layout.markers_missing
        centre = poses[int(share * len(poses)), :2]
        near &= np.hypot(*(grid - centre).T) > radius
    grid = grid[near]
    ids = np.sort(rng.choice(np.arange(1, 250), len(grid), replace=False))
    order = rng.permutation(len(grid))
    return ids, np.column_stack([grid[order], rng.uniform(-np.pi, np.pi, len(grid))])


def _place_antennas(layout, poses, rng):
    """Ids (k,) and positions (k, 2) of antennas on an ellipse around the driven area."""
    low, high = poses[:, :2].min(0), poses[:, :2].max(0)
    angle = 2 * np.pi * (np.arange(layout.antennas) + rng.uniform(-0.2, 0.2, layout.antennas)) \
        / layout.antennas + np.pi / 4
    position = (low + high) / 2 + (0.6 * (high - low) + 1.0) * np.stack(
        [np.cos(angle), np.sin(angle)], -1)
    ids = np.sort(rng.choice(np.arange(1, 60), layout.antennas, replace=False))
    return ids, position[rng.permutation(layout.antennas)]


def _camera(poses, marker, marker_in_world, every, mislabelled, noise, rng):
    """Sightings of all markers in the disc of CAMERA_REACH around every `every`-th pose."""
    frames = np.arange(0, len(poses), every)
    in_vehicle = se2.between(poses[frames, None], marker_in_world)
    distance = np.hypot(in_vehicle[..., 0], in_vehicle[..., 1])
    frame, which = np.nonzero(distance < CAMERA_REACH)
    z, d = in_vehicle[frame, which], distance[frame, which]
    covariance = _sighting_covariance(z, d)
    error = (np.linalg.cholesky(covariance) @ rng.standard_normal(z.shape)[..., None])[..., 0]
    z = z + noise * error
    z[:, 2] = se2.wrap(z[:, 2])
    wrong = rng.uniform(size=len(z)) < mislabelled
    other = (which + rng.integers(1, len(marker), len(z))) % len(marker)
    return ArucoReadings(frames[frame], marker[np.where(wrong, other, which)], z, covariance)


def _sighting_covariance(z, distance):
    """Grows with distance; wider along the line of sight; heading tied to the sideways error."""
    along, across, turn = 0.004 + 0.005 * distance, 0.003 + 0.003 * distance, 0.004 + 0.003 * distance
    C = np.zeros((len(z), 3, 3))
    C[:, 0, 0], C[:, 1, 1], C[:, 2, 2] = along**2, across**2, turn**2
    C[:, 1, 2] = C[:, 2, 1] = 0.4 * across * turn
    return se2.rotate_covariance(C, np.arctan2(z[:, 1], z[:, 0]))


def _uwb(poses, antenna, antenna_in_world, every, late_ranges, noise, rng):
    """Ranges to all antennas within UWB_REACH of every `every`-th pose, some of them late."""
    frames = np.arange(every // 2, len(poses), every)
    distance = np.hypot(*(poses[frames, None, :2] - antenna_in_world).transpose(2, 0, 1))
    frame, which = np.nonzero(distance < UWB_REACH)
    r = distance[frame, which]
    sigma = 0.05 + 0.004 * r
    late = rng.uniform(size=len(r)) < late_ranges
    excess = rng.exponential(LATE_RANGE_MEAN, len(r)) * late
    measured = r + noise * sigma * rng.standard_normal(len(r)) + excess
    return UwbReadings(frames[frame], antenna[which], np.maximum(measured, 1e-3), sigma)


def _write_sensors(folder, dataset):
    n = len(dataset.ticks)
    _savetxt(folder / "encoderReading.txt", [np.arange(1, n + 1), *dataset.ticks.T], "%d %d %d")
    if dataset.aruco is not None:
        a = dataset.aruco
        upper = a.covariance[:, *np.triu_indices(3)].T
        _savetxt(folder / "ArucoReading.txt",
                 [a.pose + 1, a.marker, *a.marker_in_vehicle.T, *upper],
                 "%d %d %.5f %.5f %.5f" + 6 * " %.4e")
    if dataset.uwb is not None:
        u = dataset.uwb
        _savetxt(folder / "UwbReading.txt", [u.pose + 1, u.antenna, u.range, u.sigma],
                 "%d %d %.4f %.4f")
    if dataset.antenna_guess is not None:
        g = dataset.antenna_guess
        _savetxt(folder / "UwbAntennaGuess.txt", [g.antenna, *g.position.T], "%d %.3f %.3f")
    if dataset.vehicle != Vehicle():
        _write_vehicle(folder / "vehicle.toml", dataset.vehicle)


def _write_truth(folder, truth):
    folder.mkdir()
    n = len(truth.poses)
    _savetxt(folder / "vehiclePose.txt", [np.arange(1, n + 1), *truth.poses.T], "%d %.6f %.6f %.6f")
    _savetxt(folder / "ArucoMap.txt", [truth.marker, *truth.marker_in_world.T], "%d %.6f %.6f %.6f")
    _savetxt(folder / "UwbMap.txt", [truth.antenna, *truth.antenna_in_world.T], "%d %.6f %.6f")
    _write_vehicle(folder / "vehicle.toml", truth.vehicle)


def _write_vehicle(path, vehicle):
    lines = [f"{name} = {float(value)!r}\n" for name, value in asdict(vehicle).items()]
    path.write_text("".join(lines), encoding="utf-8", newline="\n")


def _savetxt(path, columns, fmt):
    with open(path, "w", encoding="ascii", newline="\n") as file:
        np.savetxt(file, np.column_stack(columns), fmt=fmt)
