"""The real log Plaza 2 in the assignment's format: a mower with radio ranges to four beacons.

GTSAM contains Joseph Djugash's range-only SLAM logs (`Plaza1_.mat`, `Plaza2_.mat`): increments of
distance and heading, ranges to four beacons, the surveyed beacons, and the path by differential
GPS. Some differences from the assignment are resolved as follows:

* Increments become counts of two wheels. Rounding to a count is negligible. The wheel parameters
  are taken as known to two percent: on Plaza 1, odometry's distances agree with GPS within one.
* A range is assigned to the pose nearest in time. The mower stands at first, while the gyroscope
  that gave its turns drifts; the drive begins where it moves.
* Radio ranges are too long by a constant factor, which the solver has to find. Their sigma is that
  of Plaza 1 about this factor, from its truth; the truth of Plaza 2 is not used.
* The true heading of Plaza 2 points backwards along the path, so pi is added.
"""

import gtsam
import numpy as np
import pandas as pd
from scipy.io import loadmat

from slamlib.core import se2
from slamlib.core.odometry import cumulative
from slamlib.core.records import AntennaGuess, Dataset, Truth, UwbReadings
from slamlib.core.vehicle import Vehicle
from slamlib.studies.simulation import distances

COUNT = 1e-4                # m, travel of a wheel in one count
RADIUS = 0.2                # m, nominal
BASE = 0.8                  # m, nominal wheelbase
WHEEL_SIGMA = 0.02          # standard deviation of the wheel parameters, relative to their value
STANDING = 0.2              # m, what odometry travels while the mower stands
BEACON_GUESS_SIGMA = 2.0    # m, standard deviation of the guessed beacons on each axis


def read_plaza2(seed: int = 0) -> tuple[Dataset, Truth]:
    """Plaza 2 as a Dataset with ranges and without markers, and its Truth.

    The Truth is in the frame of pose 1. The log has no antenna guess; `seed` is of its errors.
    """
    path, increments, ranges, beacons = _load(2)
    begin = np.argmax(increments.travel.abs().cumsum() > STANDING)
    path = path[begin:]
    ranges = ranges[ranges.time >= path.time.iloc[0]]
    vehicle = Vehicle(
        right_radius=RADIUS, left_radius=RADIUS, wheelbase=BASE,
        ticks_per_revolution=2 * np.pi * RADIUS / COUNT, sigma_right_radius=WHEEL_SIGMA * RADIUS,
        sigma_left_radius=WHEEL_SIGMA * RADIUS, sigma_wheelbase=WHEEL_SIGMA * BASE)

    pose = _nearest(path, ranges)
    _, sigma = ranges_over_distances(1)
    uwb = UwbReadings(pose, ranges.beacon.to_numpy(int), ranges.range.to_numpy(),
                      np.full(len(ranges), sigma))
    uwb = uwb.select(np.argsort(pose, kind="stable"))

    antenna = beacons.index.to_numpy(int)
    poses = path[["x", "y", "heading"]] + [0, 0, np.pi]
    world = poses.iloc[0]
    poses = se2.between(world, poses)
    poses[:, 2] = np.unwrap(poses[:, 2])
    place = se2.between(world, np.pad(beacons, ((0, 0), (0, 1))))[:, :2]
    error = BEACON_GUESS_SIGMA * np.random.default_rng(seed).standard_normal(place.shape)
    dataset = Dataset("Plaza 2", vehicle, _ticks(increments[begin:]), aruco=None, uwb=uwb,
                      antenna_guess=AntennaGuess(antenna, place + error))
    truth = Truth(poses, marker=np.zeros(0, int), marker_in_world=np.zeros((0, 3)),
                  antenna=antenna, antenna_in_world=place, vehicle=vehicle)
    return dataset, truth


def _ticks(increments):
    """Counts (n, 2) of the right and left wheel, from increments of distance and heading."""
    half_turn = BASE / 2 * increments.turn
    right = increments.travel + half_turn
    left = increments.travel - half_turn
    travelled = cumulative(np.column_stack([right, left]))
    total = np.rint(travelled / COUNT).astype(int)
    return np.diff(total, axis=0, prepend=total[:1])


def ranges_over_distances(number: int) -> tuple[float, float]:
    """Factor of measured over true ranges and their standard deviation in m, of a log, by medians.

    From the truth of Plaza 1 or 2.
    """
    path, _, ranges, beacons = _load(number)
    position = path[["x", "y"]].to_numpy()[_nearest(path, ranges)]
    distance = distances(position, beacons.loc[ranges.beacon].to_numpy())
    scale = np.median(ranges.range / distance)
    residual = ranges.range - scale * distance
    deviation = np.abs(residual - np.median(residual))
    return scale, 1.4826 * np.median(deviation)


def _load(number):
    """The tables of a log, with a row for each reading; lengths in m, angles in rad, times in s."""
    content = loadmat(gtsam.findExampleDataFile(f"Plaza{number}_.mat"))
    path = pd.DataFrame(content["GT"], columns=["time", "x", "y", "heading"])
    increments = pd.DataFrame(content["DR"], columns=["time", "travel", "turn"])
    ranges = pd.DataFrame(content["TD"], columns=["time", "tag", "beacon", "range"])
    beacons = pd.DataFrame(content["TL"], columns=["beacon", "x", "y"])
    return path, increments, ranges, beacons.set_index("beacon").sort_index()


def _nearest(path, ranges):
    """Rows (m,) of the path that are nearest in time to each of the ranges."""
    time = path.time.to_numpy()
    return np.searchsorted((time[1:] + time[:-1]) / 2, ranges.time)
