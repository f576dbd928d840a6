"""The calibration: what all measurements of a kind share, one vector c of unknowns in the graph.

ENTRIES is its table: for each entry the name, which is also that in `vehicle.toml`, the unit, the
group with which it leaves its stated value, and the wide standard deviation that it has then. An
entry whose stated standard deviation is 0 is known unless its group leaves its stated values. The
bump is how far something moved the camera during the drive; it counts from that moment on. After
ENTRIES the vector has an offset for each antenna. The group WHEEL_SCALE has no entry of its own:
one factor on both radii (load, pressure, counts lost or doubled), which correlates them. With the
pose X of the vehicle and its motion D(lag) during the last `lag` encoder steps, D = X^-1 X(lag
steps earlier), the measurements are

    increment   Delta(right_radius, left_radius, wheelbase)
    sighting    Y^-1 L,   positions over marker_size,   Y = X D(sighting_lag) (camera + bump)
    range       range_offset + offset of the antenna
                + range_scale sqrt(|A - t|^2 + antenna_height^2),   t = X D(range_lag) tag

with the pose L of the marker and the positions A of the antenna and t of the tag. The entry for the
height is half its square, in which the squared distance is linear. This model and its derivatives
are `factors.sighting_error` and `range_error`; `choices.calibrated` decides what is wrong, and
`solution_doubts` says so. Before the graph, `Dataset.sightings` applies what is stated.
(Kuemmerle, Grisetti, Burgard, Simultaneous Calibration, Localization, and Mapping, IROS 2011.)
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from slamlib.core.vehicle import Vehicle


class Entry(NamedTuple):
    """A row of the table of the calibration."""

    name: str
    unit: str
    group: str               # with which it leaves its stated value; also the kind of the doubt
    wide: float              # standard deviation then, in the unit; of a wheel relative


ENTRIES = (
    Entry("right_radius", "m", "wheel-radii", 0.05),
    Entry("left_radius", "m", "wheel-radii", 0.05),
    Entry("wheelbase", "m", "wheelbase", 0.05),
    Entry("camera_x", "m", "camera-offset", 0.2),
    Entry("camera_y", "m", "camera-offset", 0.2),
    Entry("camera_turn", "rad", "camera-offset", 0.2),
    Entry("marker_size", "", "marker-size", 0.05),
    Entry("sighting_lag", "poses", "time-offset", 10.0),
    Entry("bump_x", "m", "camera-bump", 0.2),
    Entry("bump_y", "m", "camera-bump", 0.2),
    Entry("bump_turn", "rad", "camera-bump", 0.2),
    Entry("tag_x", "m", "tag-offset", 0.3),
    Entry("tag_y", "m", "tag-offset", 0.3),
    Entry("antenna_height", "m", "antenna-height", 2.5),
    Entry("range_offset", "m", "range-offset", 0.2),
    Entry("range_scale", "", "range-offset", 0.05),
    Entry("range_lag", "poses", "range-delay", 30.0))
ANTENNA_OFFSETS = Entry("offset of antenna", "m", "antenna-offsets", 0.15)
WHEEL_SCALE = "wheel-scale"
WIDE_SCALE = 0.05            # relative, of both radii together

# Columns of the vector by kind of measurement, then by entry.
WHEELS = slice(0, 3)
RADII = slice(0, 2)
SIGHTINGS = slice(3, 11)
RANGES = slice(11, None)

CAMERA = slice(3, 6)         # of sightings, with the next three
SIZE = 6                     # of marker_size, in `factors.sighting_error`
SIGHTING_LAG = 7
BUMP = slice(8, 11)          # added to CAMERA from `Jumps.bump` on

TAG_PLACE = slice(11, 13)    # of ranges, with all that follow
HEIGHT = 13
OFFSET = 14
SCALE = 15
RANGE_LAG = 16
ANTENNAS = slice(17, None)

POSITIVE = np.r_[WHEELS, SIZE, SCALE]
MAX_RATIO = 2.5              # of these, which are above zero, over what is stated, or the reverse


@dataclass(frozen=True)
class Calibration:
    """What a Vehicle states of the p entries for the a antennas of a drive."""

    names: tuple[str, ...]   # p of them
    group: np.ndarray        # (p,) of str
    stated: np.ndarray       # (p,)
    sigma: np.ndarray        # (p,) as stated, 0 if known
    wide: np.ndarray         # (p,) if the statement is wrong

    def of_group(self, group: str) -> np.ndarray:
        """(p,) bool, the entries that leave their stated values with a group."""
        if group == WHEEL_SCALE:
            return np.arange(len(self.names)) < RADII.stop
        return self.group == group

    def prior(self, groups: Collection[str] = (), width: float = 1.0) -> "Prior":
        """The Prior, of `groups` with the wide standard deviations times `width`."""
        released = np.isin(self.group, list(groups))
        sigma = np.where(released, np.maximum(width * self.wide, self.sigma), self.sigma)
        root = np.diag(sigma)
        if WHEEL_SCALE in groups:
            common = width * WIDE_SCALE * self.stated[RADII]
            covariance = np.diag(sigma[RADII]**2) + np.outer(common, common)
            root[RADII, RADII] = np.linalg.cholesky(covariance)
        return Prior(groups=frozenset(groups), width=width, root=root)

    def is_possible(self, c: np.ndarray) -> np.ndarray:
        """Which entries of c (..., p) can be: wheels and scales, within MAX_RATIO of the stated."""
        found = np.ones(c.shape, bool)
        ratio = c[..., POSITIVE] / self.stated[POSITIVE]
        found[..., POSITIVE] = (ratio > 1 / MAX_RATIO) & (ratio < MAX_RATIO)
        return found

    def taken_from(self, other: "Calibration", values: np.ndarray) -> np.ndarray:
        """Values (p,) of another drive's Calibration where it has the entry, else as stated."""
        known = dict(zip(other.names, values))
        return np.array([known.get(name, value) for name, value in zip(self.names, self.stated)])


@dataclass(frozen=True)
class Prior:
    """The Gaussian prior of the p entries about what is stated.

    They are c = stated + root u, with standard normal u; q of these are unknown.
    """

    groups: frozenset        # that leave their stated values
    width: float             # of their wide standard deviations
    root: np.ndarray         # (p, p) lower triangular, 0 in rows and columns of what is known

    @property
    def active(self) -> np.ndarray:
        """(p,) bool, entries among the unknowns."""
        return np.diag(self.root) > 0

    def of(self, columns: slice) -> np.ndarray:
        """Derivatives of these entries by their unknowns."""
        return self.root[columns, columns][:, self.active[columns]]

    def unknowns(self, off: np.ndarray) -> np.ndarray:
        """u (q,) of entries that are `off` (p,) what is stated."""
        active = self.active
        return np.linalg.solve(self.root[np.ix_(active, active)], off[active])


def calibration_table(calibration: Calibration, c: np.ndarray, covariance: np.ndarray,
                      released: Collection[str]) -> list[dict]:
    """A dict for each entry of a Calibration, with lengths and angles as in `vehicle.toml`.

    "name", "unit", "group", "stated" and "stated_sigma", "estimate" and "sigma" by the values c
    (p,) and their covariance (p, p), and whether its group is in `released`. The height is 0 where
    half its square, which is estimated, is negative.
    """
    stated = _with_height(calibration.stated, calibration.sigma)
    estimated = _with_height(c, np.sqrt(np.diag(covariance)))
    table = []
    for k, entry in enumerate(_entries(len(c) - len(ENTRIES))):
        table.append({
            "name": calibration.names[k],
            "unit": entry.unit,
            "group": entry.group,
            "released": any(calibration.of_group(group)[k] for group in released),
            "stated": float(stated[0, k]),
            "stated_sigma": float(stated[1, k]),
            "estimate": float(estimated[0, k]),
            "sigma": float(estimated[1, k])})
    return table


def _entries(antenna_count):
    """The p entries of the vector for so many antennas."""
    return ENTRIES + antenna_count * (ANTENNA_OFFSETS,)


def _with_height(values, sigma):
    """Values and standard deviations (2, p) with the height, m, in place of half its square."""
    table = np.stack([values, sigma])
    height = np.sqrt(2 * max(table[0, HEIGHT], 0.0))
    spread = table[1, HEIGHT]
    table[0, HEIGHT] = height
    if spread:
        table[1, HEIGHT] = spread / max(height, np.sqrt(spread / 2))
    return table


def stated_calibration(vehicle: Vehicle, antennas: Sequence[int]) -> Calibration:
    """The Calibration that a Vehicle states, for `antennas` (a,), ids."""
    entries = _entries(len(antennas))
    stated = np.zeros(len(entries))         # offsets of antennas, and a bump, are 0, and known
    sigma = np.zeros(len(entries))
    for k, entry in enumerate(ENTRIES):
        if entry.group != "camera-bump":
            stated[k] = getattr(vehicle, entry.name)
            sigma[k] = getattr(vehicle, f"sigma_{entry.name}")
    wide = np.array([entry.wide for entry in entries])
    wide[WHEELS] *= stated[WHEELS]
    height = stated[HEIGHT]
    stated[HEIGHT] = height**2 / 2
    sigma[HEIGHT] = _sigma_of_half_square(height, sigma[HEIGHT])
    wide[HEIGHT] = _sigma_of_half_square(height, wide[HEIGHT])
    names = [entry.name for entry in ENTRIES]
    names += [f"{ANTENNA_OFFSETS.name} {antenna}" for antenna in antennas]
    return Calibration(names=tuple(names), group=np.array([entry.group for entry in entries]),
                       stated=stated, sigma=sigma, wide=wide)


def _sigma_of_half_square(height, sigma):
    """Standard deviation of h^2 / 2, in m^2, for a height h and its standard deviation in m."""
    return np.hypot(height, sigma / 2) * sigma
