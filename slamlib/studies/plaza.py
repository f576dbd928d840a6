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
from scipy.io import loadmat

from slamlib.core import se2
from slamlib.core.records import AntennaGuess, Dataset, Truth, UwbReadings
from slamlib.core.vehicle import Vehicle

COUNT = 1e-4                # m, travel of a wheel in one count
RADIUS, BASE = 0.2, 0.8     # m, nominal wheel radius and wheelbase
WHEEL_SIGMA = 0.02          # standard deviation of the wheel parameters, relative to their value
STANDING = 0.2              # m, what odometry travels while the mower stands
BEACON_GUESS_SIGMA = 2.0    # m, standard deviation of the guessed beacons on each axis


def read_plaza2(seed=0):
    """Plaza 2 as a Dataset with ranges and without markers, and its Truth.

    The Truth is in the frame of pose 1. The log has no antenna guess; `seed` is of its errors.
    """
    _, sigma = ranges_over_distances(1)
    path, increments, ranges, beacons = _load(2)
    begin = np.argmax(np.cumsum(np.abs(increments[:, 1])) > STANDING)
    path, increments = path[begin:], increments[begin:]
    ranges = ranges[ranges[:, 0] >= path[0, 0]]
    travel, turn = increments[:, 1], increments[:, 2]
    wheels = np.stack([travel + BASE / 2 * turn, travel - BASE / 2 * turn], -1)
    total = np.cumsum(np.concatenate([np.zeros((1, 2)), wheels]), axis=0)
    ticks = np.diff(np.rint(total / COUNT).astype(int), axis=0, prepend=np.zeros((1, 2), int))
    vehicle = Vehicle(
        right_radius=RADIUS, left_radius=RADIUS, wheelbase=BASE,
        ticks_per_revolution=2 * np.pi * RADIUS / COUNT, sigma_right_radius=WHEEL_SIGMA * RADIUS,
        sigma_left_radius=WHEEL_SIGMA * RADIUS, sigma_wheelbase=WHEEL_SIGMA * BASE)

    pose = _nearest(path[:, 0], ranges[:, 0])
    uwb = UwbReadings(pose, ranges[:, 2].astype(int), ranges[:, 3],
                      np.full(len(ranges), sigma)).select(np.argsort(pose, kind="stable"))
    poses = path[:, 1:4] + [0, 0, np.pi]
    beacons = beacons[np.argsort(beacons[:, 0])]
    antenna = beacons[:, 0].astype(int)
    place = se2.between(poses[0], beacons[:, 1:3] @ np.eye(2, 3))[:, :2]
    guess = place + BEACON_GUESS_SIGMA * np.random.default_rng(seed).standard_normal(place.shape)
    poses = se2.between(poses[0], poses)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return (Dataset(name="Plaza 2", vehicle=vehicle, ticks=ticks, aruco=None, uwb=uwb,
                    antenna_guess=AntennaGuess(antenna, guess)),
            Truth(poses=poses, marker=np.zeros(0, int), marker_in_world=np.zeros((0, 3)),
                  antenna=antenna, antenna_in_world=place, vehicle=vehicle))


def ranges_over_distances(number):
    """Factor of measured over true ranges and their standard deviation in m, of a log, by medians.

    From the truth of Plaza 1 or 2.
    """
    path, _, ranges, beacons = _load(number)
    place = np.array([beacons[beacons[:, 0] == beacon, 1:3][0] for beacon in ranges[:, 2]])
    distance = np.hypot(*(path[_nearest(path[:, 0], ranges[:, 0]), 1:3] - place).T)
    scale = np.median(ranges[:, 3] / distance)
    off = ranges[:, 3] - scale * distance
    return scale, 1.4826 * np.median(np.abs(off - np.median(off)))


def _load(number):
    """The arrays of a log, with a row for each reading; lengths in m, angles in rad, times in s.

    Path [t, x, y, heading], increments [t, travel, turn], ranges [t, -, beacon, range] and beacons
    [id, x, y].
    """
    content = loadmat(gtsam.findExampleDataFile(f"Plaza{number}_.mat"))
    return content["GT"], content["DR"], content["TD"], content["TL"]


def _nearest(times, wanted):
    """Indices (m,) of the ascending times (n,) nearest to the wanted ones (m,)."""
    return np.searchsorted((times[1:] + times[:-1]) / 2, wanted)
