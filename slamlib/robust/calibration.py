"""The calibration: what all measurements of a kind share, one vector c of unknowns in the graph.

ENTRIES is its table: for each entry the name, which is also that in `vehicle.toml`, the unit, the
group with which it leaves its stated value, and the wide standard deviation that it has then. An
entry whose stated standard deviation is 0 is known unless its group leaves its stated values. After
ENTRIES the vector has an offset for each antenna. With the pose X of the vehicle and its motion
D(lag) during the last `lag` encoder steps, D = X^-1 X(lag steps earlier), the measurements are

    increment   Delta(right_radius, left_radius, wheelbase)
    sighting    Y^-1 L,   positions over marker_size,   Y = X D(sighting_lag) camera
    range       range_offset + offset of the antenna
                + range_scale sqrt(|A - t|^2 + antenna_height^2),   t = X D(range_lag) tag

with the pose L of the marker and the positions A of the antenna and t of the tag. The entry for the
height is half its square, in which the squared distance is linear. This model and its derivatives
are `factors.sighting_error` and `range_error`; `choices.calibrated` decides what is wrong, and
`checks.solution` tells it. Before the graph, `Dataset.sightings` applies what is stated.
(Kuemmerle, Grisetti, Burgard, Simultaneous Calibration, Localization, and Mapping, IROS 2011.)
"""

from collections import namedtuple
from dataclasses import dataclass

import numpy as np

# The group is also the kind of the doubt. Of a wheel the wide sigma is relative.
Entry = namedtuple("Entry", "name unit group wide")
ENTRIES = (
    Entry("right_radius", "m", "wheel-parameters", 0.05),
    Entry("left_radius", "m", "wheel-parameters", 0.05),
    Entry("wheelbase", "m", "wheel-parameters", 0.05),
    Entry("camera_x", "m", "camera-offset", 0.2),
    Entry("camera_y", "m", "camera-offset", 0.2),
    Entry("camera_turn", "rad", "camera-offset", 0.2),
    Entry("marker_size", "", "marker-size", 0.05),
    Entry("sighting_lag", "poses", "time-offset", 10.0),
    Entry("tag_x", "m", "tag-offset", 0.3),
    Entry("tag_y", "m", "tag-offset", 0.3),
    Entry("antenna_height", "m", "antenna-height", 2.5),
    Entry("range_offset", "m", "range-offset", 0.2),
    Entry("range_scale", "", "range-offset", 0.05),
    Entry("range_lag", "poses", "range-delay", 30.0))
ANTENNA_OFFSETS = Entry("offset of antenna", "m", "antenna-offsets", 0.15)
# Columns of the vector by kind of measurement, then by entry.
WHEELS, SIGHTINGS, RANGES = slice(0, 3), slice(3, 8), slice(8, None)
CAMERA, SIZE, SIGHTING_LAG = slice(3, 6), 6, 7               # columns of sightings
TAG_PLACE, HEIGHT, OFFSET, SCALE = slice(8, 10), 10, 11, 12  # columns of ranges
RANGE_LAG, ANTENNAS = 13, slice(14, None)                    # columns of ranges


@dataclass(frozen=True)
class Calibration:
    """What a Vehicle states of the p entries for the a antennas of a drive."""

    names: tuple             # p of str
    group: np.ndarray        # (p,) of str
    stated: np.ndarray       # (p,)
    sigma: np.ndarray        # (p,) as stated, 0 if known
    wide: np.ndarray         # (p,) if the statement is wrong

    def sigma_without(self, groups, width=1.0):
        """Standard deviations (p,), of `groups` the wide ones times `width`, else as stated."""
        return np.where(np.isin(self.group, list(groups)),
                        np.maximum(width * self.wide, self.sigma), self.sigma)

    def taken_from(self, other, values, default):
        """Values (p,): another drive's Calibration's where it has the entry, or `default`."""
        known = dict(zip(other.names, values))
        return np.array([known.get(name, value) for name, value in zip(self.names, default)])


def calibration_table(calibration, c, covariance, released):
    """List of a dict for each entry of a Calibration, with lengths and angles as in `vehicle.toml`.

    "name", "unit", "group", "stated" and "stated_sigma", "estimate" and "sigma" by the values c
    (p,) and their covariance (p, p), and whether its group is in `released`. The height is 0 where
    half its square, which is estimated, is negative.
    """
    entries = ENTRIES + (len(c) - len(ENTRIES)) * (ANTENNA_OFFSETS,)
    numbers = np.stack([calibration.stated, calibration.sigma, c, np.sqrt(np.diag(covariance))])
    numbers[:2, HEIGHT], numbers[2:, HEIGHT] = (
        _height(*numbers[:2, HEIGHT]), _height(*numbers[2:, HEIGHT]))
    return [{"name": name, "unit": entry.unit, "group": entry.group,
             "released": entry.group in released} | dict(zip(
                ("stated", "stated_sigma", "estimate", "sigma"), column.tolist()))
            for name, entry, column in zip(calibration.names, entries, numbers.T)]


def _height(half_square, sigma):
    """A height and its standard deviation in m, from those of half its square."""
    height = np.sqrt(2 * max(half_square, 0.0))
    return height, sigma / max(height, np.sqrt(sigma / 2)) if sigma else 0.0


def stated_calibration(vehicle, antennas):
    """The Calibration that a Vehicle states, for `antennas` (a,), ids."""
    entries = ENTRIES + len(antennas) * (ANTENNA_OFFSETS,)
    values = np.array([getattr(vehicle, entry.name) for entry in ENTRIES])
    sigma = np.array([getattr(vehicle, f"sigma_{entry.name}") for entry in ENTRIES])
    wide = np.array([entry.wide for entry in entries])
    wide[WHEELS] *= values[WHEELS]
    height, spread = values[HEIGHT], sigma[HEIGHT]
    values[HEIGHT], sigma[HEIGHT] = height**2 / 2, np.hypot(height, spread / 2) * spread
    wide[HEIGHT] = np.hypot(height, wide[HEIGHT] / 2) * wide[HEIGHT]
    return Calibration(
        names=(*(entry.name for entry in ENTRIES),
               *(f"{ANTENNA_OFFSETS.name} {antenna}" for antenna in antennas)),
        group=np.array([entry.group for entry in entries]),
        stated=np.pad(values, (0, len(antennas))), sigma=np.pad(sigma, (0, len(antennas))),
        wide=wide)
