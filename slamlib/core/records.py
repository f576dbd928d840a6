"""Records of one drive: its measurements, and what is true where that is known.

Lengths are in metres, angles in radians. Rows of arrays count from 0; marker and antenna ids are
labels. `slamlib.io` reads these records from files.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib.core import se2
from slamlib.core.vehicle import Vehicle, changed


class _Readings:
    """Readings of one sensor: arrays with a row for each reading."""

    def select(self, keep: np.ndarray):
        """The readings that `keep` selects: a mask (m,) of bool or an array of row indices."""
        selected = {name: values[keep] for name, values in vars(self).items()}
        return replace(self, **selected)


@dataclass(frozen=True)
class ArucoReadings(_Readings):
    """Sightings of markers, in ascending order of pose."""

    pose: np.ndarray                 # (m,) int64, row of `Dataset.ticks`
    marker: np.ndarray               # (m,) int64, marker id
    marker_in_vehicle: np.ndarray    # (m, 3) [x, y, heading]; of a file in the camera's axes, the
                                     # vehicle's unless the camera's place is stated (`sightings`)
    covariance: np.ndarray           # (m, 3, 3) of [x, y, heading] in the same axes


@dataclass(frozen=True)
class UwbReadings(_Readings):
    """Ranges between the antennas and the vehicle, in ascending order of pose."""

    pose: np.ndarray                 # (m,) int64, row of `Dataset.ticks`
    antenna: np.ndarray              # (m,) int64, antenna id
    range: np.ndarray                # (m,) m
    sigma: np.ndarray                # (m,) m, standard deviation of the range


NO_SIGHTINGS = ArucoReadings(
    pose=np.zeros(0, int), marker=np.zeros(0, int), marker_in_vehicle=np.zeros((0, 3)),
    covariance=np.zeros((0, 3, 3)))
NO_RANGES = UwbReadings(
    pose=np.zeros(0, int), antenna=np.zeros(0, int), range=np.zeros(0), sigma=np.zeros(0))


@dataclass(frozen=True)
class AntennaGuess:
    """Guessed positions of the antennas, in ascending order of id."""

    antenna: np.ndarray              # (a,) int64, antenna id
    position: np.ndarray             # (a, 2) [x, y] in m


@dataclass(frozen=True, eq=False)        # of arrays, so that only the same one is equal
class Dataset:
    """All measurements of one drive."""

    name: str                        # of the folder
    vehicle: Vehicle
    ticks: np.ndarray                # (n, 2) int64 [right, left], in the step to each; row 0 is 0
    aruco: ArucoReadings | None
    uwb: UwbReadings | None
    antenna_guess: AntennaGuess | None
    notes: tuple[str, ...] = ()      # what was mended or left out while reading, a sentence each

    @property
    def sightings_in_time(self) -> ArucoReadings | None:
        """The ArucoReadings at the poses at which, by the stated lag, they were taken, or None."""
        if self.aruco is None:
            return None
        taken = self.aruco.pose - round(self.vehicle.sighting_lag)
        is_known = (0 <= taken) & (taken < len(self.ticks))
        return replace(self.aruco, pose=taken).select(is_known)

    @property
    def sightings(self) -> ArucoReadings | None:
        """The `sightings_in_time` in the vehicle, by the stated camera and marker size, or None."""
        in_time = self.sightings_in_time
        if in_time is None:
            return None
        stated = self.vehicle
        scale = np.array([stated.marker_size, stated.marker_size, 1])
        marker_in_camera = scale * in_time.marker_in_vehicle
        covariance = scale[:, None] * in_time.covariance * scale
        return replace(
            in_time,
            marker_in_vehicle=se2.compose(stated.camera, marker_in_camera),
            covariance=se2.rotate_covariance(covariance, stated.camera_turn))

    @property
    def ranges(self) -> UwbReadings | None:
        """The UwbReadings corrected for the stated offset and scale, or None."""
        if self.uwb is None:
            return None
        stated = self.vehicle
        return replace(
            self.uwb,
            range=(self.uwb.range - stated.range_offset) / stated.range_scale,
            sigma=self.uwb.sigma / stated.range_scale)

    def stating(self, entries: dict, source: str) -> "Dataset":
        """The Dataset whose Vehicle is `changed` by `entries`; the same one where nothing changes.

        What is kept about a Dataset, such as its jumps, is of this record, not of its values.
        """
        vehicle = changed(self.vehicle, entries, source)
        return self if vehicle == self.vehicle else replace(self, vehicle=vehicle)

    def without(self, sensor: str) -> "Dataset":
        """The Dataset without a sensor, "aruco" or "uwb"; the same one where it has none."""
        if getattr(self, sensor) is None:
            return self
        return replace(self, **{sensor: None})

    def first(self, count: int) -> "Dataset":
        """The Dataset of the first `count` poses; sensors without readings are None."""
        return replace(self, ticks=self.ticks[:count], aruco=_until(self.aruco, count),
                       uwb=_until(self.uwb, count))


def _until(readings, count):
    """The readings at the first `count` poses, or None if there are none."""
    if readings is None:
        return None
    early = readings.pose < count
    return readings.select(early) if early.any() else None


@dataclass(frozen=True)
class Truth:
    """True poses, maps and wheel parameters of a simulated or surveyed drive."""

    poses: np.ndarray                # (n, 3) [x, y, heading]; headings are continuous
    marker: np.ndarray               # (k,) int64, marker id, ascending
    marker_in_world: np.ndarray      # (k, 3) [x, y, heading]
    antenna: np.ndarray              # (a,) int64, antenna id, ascending
    antenna_in_world: np.ndarray     # (a, 2) [x, y] in m
    vehicle: Vehicle
    notes: tuple[str, ...] = ()      # as those of a Dataset
