"""A real log in the assignment's format: Plaza 2, a mower with radio ranges on a lawn.

Joseph Djugash's range-only SLAM logs come with GTSAM (`Plaza1_.mat`, `Plaza2_.mat`): increments of
distance and heading, ranges to four radio beacons, the beacons' surveyed places, and the path by
differential GPS. They differ from the assignment in four ways, all settled here:

* increments become counts of two wheels, fine enough that their rounding does not matter, on a
  vehicle whose wheel parameters are known to a few percent only;
* a range belongs to the pose next in time;
* radio ranges are too long in proportion. The factor, and the ranges' sigma, are measured on Plaza 1
  against its surveyed truth, as one would calibrate a sensor; Plaza 2's truth is not touched;
* the true heading of Plaza 2 looks backwards along the path, and is turned by pi.
"""

import gtsam
import numpy as np
from scipy.io import loadmat
from scipy.stats import median_abs_deviation

from slamlib import se2
from slamlib.dataset import AntennaGuess, Dataset, Truth, UwbReadings, Vehicle

COUNT = 1e-4         # m, travel of a wheel in one count
RADIUS, BASE = 0.2, 0.8           # m, of the vehicle whose wheels would have counted
SLOPPY = 0.03        # share of their value to which the wheel parameters are known
GUESS_SIGMA = 2.0    # m per axis, of the guessed places of the beacons


def read_plaza2(seed=0):
    """Plaza 2 as a Dataset with ranges and without markers, and its Truth.

    `seed` is that of the errors of the antenna guess, which the log does not have.

    Returns
    -------
    dataset : Dataset
    truth : Truth, in the frame of pose 1.
    """
    scale, sigma = _calibrate(*_load(1))
    path, increments, ranges, beacons = _load(2)
    base, metres = BASE / 2, increments[:, 1:3]
    wheels = np.stack([metres[:, 0] + base * metres[:, 1], metres[:, 0] - base * metres[:, 1]], -1)
    total = np.rint(np.cumsum(np.concatenate([np.zeros((1, 2)), wheels]), axis=0) / COUNT).astype(int)
    ticks = np.diff(total, axis=0, prepend=np.zeros((1, 2), int))
    vehicle = Vehicle(RADIUS, RADIUS, BASE, 2 * np.pi * RADIUS / COUNT,
                      SLOPPY * RADIUS, SLOPPY * RADIUS, SLOPPY * BASE)

    pose = _nearest(path[:, 0], ranges[:, 0])
    order = np.argsort(pose, kind="stable")
    uwb = UwbReadings(pose[order], ranges[order, 2].astype(int), ranges[order, 3] / scale,
                      np.full(len(ranges), sigma))
    poses = path[:, 1:4] + [0, 0, np.pi]
    start = poses[0]
    antenna = np.sort(beacons[:, 0].astype(int))
    place = beacons[np.argsort(beacons[:, 0]), 1:3]
    place = se2.between(start, np.column_stack([place, np.zeros(len(place))]))[:, :2]
    guess = place + GUESS_SIGMA * np.random.default_rng(seed).standard_normal(place.shape)
    poses = se2.between(start, poses)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return (Dataset("Plaza 2", vehicle, ticks, None, uwb, AntennaGuess(antenna, guess)),
            Truth(poses, np.zeros(0, int), np.zeros((0, 3)), antenna, place, vehicle))


def _load(number):
    """Path [t, x, y, heading], increments [t, metres, radians], ranges [t, -, beacon, m], beacons."""
    content = loadmat(gtsam.findExampleDataFile(f"Plaza{number}_.mat"))
    return content["GT"], content["DR"], content["TD"], content["TL"]


def _calibrate(path, _, ranges, beacons):
    """Factor by which ranges are too long, and their standard deviation in m, both by medians."""
    of = np.array([beacons[beacons[:, 0] == beacon, 1:3][0] for beacon in ranges[:, 2]])
    distance = np.hypot(*(path[_nearest(path[:, 0], ranges[:, 0]), 1:3] - of).T)
    scale = np.median(ranges[:, 3] / distance)
    return scale, median_abs_deviation(ranges[:, 3] / scale - distance, scale="normal")


def _nearest(times, wanted):
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return after - (wanted - times[after - 1] < times[after] - wanted)
