"""Simulated datasets in the assignment's format, with their truth.

The vehicle drives a smooth closed path as a sequence of exact circular arcs. Its wheel parameters
differ from the nominal ones by one draw of their standard deviations. Each encoder counts the
travelled distance plus slip, a random walk with variance slip^2 per metre, and rounds the total
down to whole counts. The camera sees the markers in a disc around the vehicle; the UWB tag measures
ranges to the antennas within reach. Both have a lower rate than the encoders.
"""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from slamlib.core import se2
from slamlib.core.errors import require
from slamlib.core.odometry import cumulative, dead_reckoning
from slamlib.core.records import AntennaGuess, ArucoReadings, Dataset, Truth, UwbReadings
from slamlib.core.vehicle import TABLE_2

# A path is a sum of rotating vectors (turns per round, radius in m, phase in rad). `marker_spacing`
# is in m; no markers are in a disc with its centre at a fraction of the path and its radius in m.
PATHS = {
    "short": SimpleNamespace(
        vectors=((1, 2.9, 0.0), (-1, 0.9, 0.3), (2, 0.7, 2.0), (3, 0.2, 1.0)), poses=2000,
        aruco_every=10, marker_spacing=1.5, markers_missing=(0.0, 0.0), uwb_every=20, antennas=4),
    "long": SimpleNamespace(
        vectors=((4, 8.9, 0.0), (-3, 3.9, 0.5), (1, 3.3, 1.0)), poses=23000,
        aruco_every=12, marker_spacing=1.9, markers_missing=(0.42, 3.5), uwb_every=25, antennas=8),
}
CAMERA_REACH = 1.8      # m, largest distance in the plane at which a marker is in the image
UWB_REACH = 15.0        # m, largest distance to an antenna that is measured
LATE_RANGE_MEAN = 0.8   # m, mean of the exponential excess of late ranges
SIMULATED_GUESS_SIGMA = 0.35   # m per axis, standard deviation of the antenna guesses


def simulate(path="short", seed=0, *, slip=1e-3, late_ranges=0.0, mislabelled=0.0, memory=0.0,
             rounds=1, noise=True, vehicle=TABLE_2):
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
    rounds : number of times that the closed path is driven.
    noise : False gives the nominal vehicle, fractional counts, and exact sightings, ranges and
        antenna guesses. The stated covariances do not change.
    vehicle : Vehicle, the nominal one.

    Returns Dataset and Truth. Raises DatasetError if there is no such path, or a number is beyond
    its limits.

    >>> dataset, truth = simulate("short", seed=1, late_ranges=0.1)
    >>> dataset.ticks.shape, truth.poses.shape
    ((2000, 2), (2000, 3))
    """
    shares = slip, late_ranges, mislabelled
    require(path in PATHS and seed >= 0 and rounds >= 1 and all(0 <= each <= 1 for each in shares),
            "simulate", f"one of the paths {', '.join(PATHS)}, a seed from 0 on, rounds from 1 on, "
            "slip and shares from 0 to 1")
    layout = PATHS[path]
    rng = np.random.default_rng(seed)
    true_vehicle = vehicle.with_wheel(vehicle.wheel + noise * rng.normal(0, vehicle.sigma_wheel))
    counts = _counts(*_driven_arcs(layout, rounds), true_vehicle)
    poses = dead_reckoning(counts, true_vehicle, model="arc")
    whole = _encoder(counts, true_vehicle, slip, rng)
    marker, marker_in_world = _place_markers(layout, poses, rng)
    antenna, antenna_in_world = _place_antennas(layout, poses, rng)
    aruco = _camera(poses, marker, marker_in_world, layout.aruco_every, mislabelled, memory,
                    noise, rng)
    uwb = _uwb(poses, antenna, antenna_in_world, layout.uwb_every, late_ranges, noise, rng)
    offset = SIMULATED_GUESS_SIGMA * rng.standard_normal(antenna_in_world.shape)
    guess = AntennaGuess(antenna, antenna_in_world + noise * offset)
    return (Dataset(name=path, vehicle=vehicle, ticks=whole if noise else counts, aruco=aruco,
                    uwb=uwb, antenna_guess=guess),
            Truth(poses=poses, marker=marker, marker_in_world=marker_in_world, antenna=antenna,
                  antenna_in_world=antenna_in_world, vehicle=true_vehicle))


def misguess(dataset, position, error, seed):
    """The Dataset with antenna guesses `error` m from `position` (a, 2), in random directions.

    `position` has the antennas of the guesses in the same order. `seed` is of the random generator.
    """
    angle = np.random.default_rng(seed).uniform(-np.pi, np.pi, len(position))
    off = error * np.stack([np.cos(angle), np.sin(angle)], -1)
    return replace(dataset, antenna_guess=replace(dataset.antenna_guess, position=position + off))


def mislabel(dataset, fraction, seed):
    """The Dataset with another marker's id at a fraction of its sightings; `seed` as above."""
    ids, label = np.unique(dataset.aruco.marker, return_inverse=True)
    label = _relabelled(label, len(ids), fraction, np.random.default_rng(seed))
    return replace(dataset, aruco=replace(dataset.aruco, marker=ids[label]))


def manoeuvre(legs, vehicle=TABLE_2):
    """Counts (n, 2) of the right and left wheel in a drive in arcs, with fractions, without noise.

    `legs` lists (m, rad), length and turn of each arc; negative lengths are driven backwards. A
    step is at most 1 cm long, or turns a wheel by as much about the middle. Row 0 is zero.
    """
    legs = np.asarray(legs, dtype=float)
    steps = np.ceil(np.abs(legs * [1, vehicle.wheelbase / 2]).max(axis=1) / 0.01).astype(int)
    return _counts(*np.repeat(legs / steps[:, None], steps, axis=0).T, vehicle)


def write_dataset(folder, dataset, truth=None):
    """Write a Dataset, and its Truth if given, as the assignment's text files.

    Raises DatasetError if the folder exists and is not empty.
    """
    folder = Path(folder)
    require(not folder.exists() or folder.is_dir() and not any(folder.iterdir()), folder,
            "a new or empty folder to write the dataset to")
    a, u, guess = dataset.aruco, dataset.uwb, dataset.antenna_guess
    number = np.arange(1, len(dataset.ticks) + 1)
    tables = {"encoderReading": ("%d %d %d", number, *dataset.ticks.T)}
    if a is not None:
        tables["ArucoReading"] = ("%d %d %.5f %.5f %.5f" + 6 * " %.4e", a.pose + 1, a.marker,
                                  *a.marker_in_vehicle.T, *a.covariance[:, *np.triu_indices(3)].T)
    if u is not None:
        tables["UwbReading"] = "%d %d %.4f %.4f", u.pose + 1, u.antenna, u.range, u.sigma
        tables["UwbAntennaGuess"] = "%d %.3f %.3f", guess.antenna, *guess.position.T
    if truth is not None:
        pose = "%d %.6f %.6f %.6f"
        tables |= {"truth/vehiclePose": (pose, number, *truth.poses.T),
                   "truth/ArucoMap": (pose, truth.marker, *truth.marker_in_world.T),
                   "truth/UwbMap": ("%d %.6f %.6f", truth.antenna, *truth.antenna_in_world.T)}
    (folder if truth is None else folder / "truth").mkdir(parents=True, exist_ok=True)
    if dataset.vehicle != TABLE_2:
        _write_vehicle(folder / "vehicle.toml", dataset.vehicle)
    if truth is not None:
        _write_vehicle(folder / "truth" / "vehicle.toml", truth.vehicle)
    for name, (fmt, *columns) in tables.items():
        with open(folder / f"{name}.txt", "wb") as file:        # the same line ends everywhere
            np.savetxt(file, np.column_stack(columns), fmt=fmt)


def _write_vehicle(path, vehicle):
    """Write the eight entries of the wheels, and of all others those that differ from table 2."""
    lines = [f"{name} = {json.dumps(value)}\n" for row, (name, value) in enumerate(
        vars(vehicle).items()) if row < 8 or value != getattr(TABLE_2, name)]
    path.write_text("".join(lines), encoding="utf-8", newline="\n")


def _driven_arcs(layout, rounds):
    """Lengths (n-1,) in m and turns (n-1,) in rad of the arcs of the path, at varying speed."""
    turns, radius, phase = np.array(layout.vectors).T[:, :, None]

    def velocity(u):
        return np.sum(1j * radius * turns * np.exp(1j * (turns * u + phase)), axis=0)

    fine = np.linspace(0, 2 * np.pi * rounds, 200 * layout.poses // 20 * rounds + 1)
    speed, middle = abs(velocity(fine)), abs(velocity((fine[1:] + fine[:-1]) / 2))
    length = cumulative((speed[1:] + 4 * middle + speed[:-1]) / 6) * fine[1]         # Simpson
    time = np.linspace(0, 1, layout.poses * rounds)
    travelled = length[-1] * (time - 0.15 * np.sin(2 * np.pi * 5 * time) / (2 * np.pi * 5))
    direction = np.angle(velocity(np.interp(travelled, length, fine)))
    return np.diff(travelled), np.diff(np.unwrap(direction))


def _counts(ds, dtheta, vehicle):
    """Counts (n, 2), right and left, with fractions, on arcs of length ds and turn dtheta."""
    half_turn = vehicle.wheelbase * dtheta / 2
    travel = np.pad(np.stack([ds + half_turn, ds - half_turn], -1), ((1, 0), (0, 0)))
    return travel * vehicle.ticks_per_revolution / (2 * np.pi * vehicle.wheel[:2])


def _encoder(counts, vehicle, slip, rng):
    """Whole counts (n, 2) of an encoder on wheels that slip, of counts with fractions."""
    length = 2 * np.pi * vehicle.wheel[:2] / vehicle.ticks_per_revolution      # m, of a count
    slipped = counts[1:] + slip * np.sqrt(abs(counts[1:]) / length) * rng.standard_normal(
        counts[1:].shape)
    total = np.floor(np.cumsum(slipped, axis=0) + rng.uniform(size=2)).astype(np.int64)
    return np.diff(total, axis=0, prepend=[[0, 0], [0, 0]])


def _place_markers(layout, poses, rng):
    """Ids (k,) and poses (k, 3) of markers on a jittered grid over the driven area."""
    low, high = poses[:, :2].min(0) - CAMERA_REACH, poses[:, :2].max(0) + CAMERA_REACH
    axes = (np.arange(*ends, layout.marker_spacing) for ends in zip(low, high))
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)
    grid += layout.marker_spacing * rng.uniform(-0.35, 0.35, grid.shape)
    visible = np.array([np.hypot(*(poses[::10, :2] - p).T).min() < CAMERA_REACH for p in grid])
    fraction, radius = layout.markers_missing
    centre = poses[int(fraction * len(poses)), :2]
    grid = grid[visible & (np.hypot(*(grid - centre).T) > radius)]
    ids = np.sort(rng.choice(np.arange(1, max(250, len(grid) + 1)), len(grid), replace=False))
    order = rng.permutation(len(grid))
    return ids, np.column_stack([grid[order], rng.uniform(-np.pi, np.pi, len(grid))])


def _place_antennas(layout, poses, rng):
    """Ids (a,) and positions (a, 2) of antennas on an ellipse around the driven area."""
    low, high, count = poses[:, :2].min(0), poses[:, :2].max(0), layout.antennas
    angle = 2 * np.pi * (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / count + np.pi / 4
    direction = np.stack([np.cos(angle), np.sin(angle)], -1)
    position = (low + high) / 2 + (0.6 * (high - low) + 1.0) * direction
    ids = np.sort(rng.choice(np.arange(1, 60), count, replace=False))
    return ids, position[rng.permutation(count)]


def _camera(poses, marker, marker_in_world, every, mislabelled, memory, noise, rng):
    """Sightings of all markers in the disc of CAMERA_REACH around every `every`-th pose."""
    frames = np.arange(0, len(poses), every)
    in_vehicle = se2.between(poses[frames, None], marker_in_world)
    distance = np.hypot(in_vehicle[..., 0], in_vehicle[..., 1])
    frame, which = np.nonzero(distance < CAMERA_REACH)
    z, correlation = in_vehicle[frame, which], [[1, 0, 0], [0, 1, 0.4], [0, 0.4, 1]]
    sigma = [4e-3, 3e-3, 4e-3] + distance[frame, which, None] * [5e-3, 3e-3, 3e-3]
    covariance = se2.rotate_covariance(                     # most along the line of sight
        sigma[:, :, None] * correlation * sigma[:, None], np.arctan2(z[:, 1], z[:, 0]))
    error = rng.standard_normal(z.shape)
    order = np.lexsort((frame, which))
    for last, k in zip(order, order[1:]):
        kept = memory**(frame[k] - frame[last]) if which[k] == which[last] else 0.0
        error[k] = kept * error[last] + np.sqrt(1 - kept**2) * error[k]
    z = z + noise * (np.linalg.cholesky(covariance) @ error[..., None])[..., 0]
    z[:, 2] = se2.wrap(z[:, 2])
    marker = marker[_relabelled(which, len(marker), mislabelled, rng)]
    return ArucoReadings(frames[frame], marker, z, covariance)


def _relabelled(label, count, fraction, rng):
    """The labels (m,), numbers below `count`, with another one at a fraction of them."""
    wrong = rng.uniform(size=len(label)) < fraction
    return np.where(wrong, (label + rng.integers(1, max(2, count), len(label))) % count, label)


def _uwb(poses, antenna, antenna_in_world, every, late_ranges, noise, rng):
    """Ranges to all antennas within UWB_REACH of every `every`-th pose, some of them late."""
    frames = np.arange(every // 2, len(poses), every)
    distance = np.hypot(*(poses[frames, None, :2] - antenna_in_world).transpose(2, 0, 1))
    frame, which = np.nonzero(distance < UWB_REACH)
    r = distance[frame, which]
    sigma, late = 0.05 + 0.004 * r, rng.uniform(size=len(r)) < late_ranges
    excess = rng.exponential(LATE_RANGE_MEAN, len(r)) * late
    measured = r + noise * sigma * rng.standard_normal(len(r)) + excess
    return UwbReadings(frames[frame], antenna[which], np.maximum(measured, 1e-3), sigma)
