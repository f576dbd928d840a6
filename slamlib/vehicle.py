"""The vehicle: wheels and sensors as stated, how well they are known, and its encoders' counts."""

import json
from dataclasses import dataclass, field, fields, replace
from numbers import Real

import numpy as np

from slamlib.tables import Limit
from slamlib.textfile import read_toml, require

MAX_REVOLUTIONS = 10.0  # revolutions of a wheel in one step
MODULI = 2**16, 2**15  # numbers of values of counters that wrap around
MIN_MODULUS_RATIO = 32.0  # ratio of a modulus to a large step of the drive, for a decision
# Robust kernels of sightings and ranges, as `slam.fit` has them; the first one is the default.
KERNEL_NAMES = ("asymmetric Tukey", "asymmetric Cauchy", "quadratic", "Huber", "Cauchy",
                "Geman-McClure", "Tukey")


def _number(default, *limit):
    """A field with its Limit(minimum, maximum, unit)."""
    return field(default=default, metadata={"limit": Limit(*limit)})


@dataclass(frozen=True)
class Vehicle:
    """Wheels and sensors with their standard deviations, and noise parameters or None.

    The defaults are the assignment's table 2, which gives no noise, and sensors in the vehicle's
    origin that measure without common errors. `slam.calibration` has the model of each entry.
    """

    right_radius: float = _number(0.1, 1e-3, 2.5, "m")
    left_radius: float = _number(0.1, 1e-3, 2.5, "m")
    wheelbase: float = _number(0.4, 1e-3, 20, "m")
    ticks_per_revolution: float = _number(8000.0, 1, 1e10)
    sigma_right_radius: float = _number(1e-4, 1e-9, 2.5, "m")
    sigma_left_radius: float = _number(1e-4, 1e-9, 2.5, "m")
    sigma_wheelbase: float = _number(1e-4, 1e-9, 20, "m")
    sigma_heading: float = _number(1e-4, 1e-9, 10, "rad")  # of the heading at pose 1
    slip: float | None = _number(None, 0, 0.1, "sqrt(m)")  # sigma after 1 m; None: learned
    marker_noise_factor: float | None = _number(None, 0.01, 100)  # of sigmas in ArucoReading.txt
    range_noise_factor: float | None = _number(None, 0.01, 100)  # of sigmas in UwbReading.txt
    # of sightings and ranges; of ranges alone if it is asymmetric
    kernel: str = field(default=KERNEL_NAMES[0], metadata={"limit": KERNEL_NAMES})
    # whether measurements that contradict the solution are rejected
    gate: bool = field(default=True, metadata={"limit": (True, False)})
    camera_x: float = _number(0.0, -10, 10, "m")  # place of the camera in the vehicle
    camera_y: float = _number(0.0, -10, 10, "m")
    camera_turn: float = _number(0.0, -6.3, 6.3, "rad")  # heading of the camera in the vehicle
    marker_size: float = _number(1.0, 0.5, 2)  # of markers, over that which the detector was told
    sighting_lag: float = _number(0.0, -1000, 1000)  # encoder steps by which sightings are late
    tag_x: float = _number(0.0, -10, 10, "m")  # place of the UWB tag in the vehicle
    tag_y: float = _number(0.0, -10, 10, "m")
    antenna_height: float = _number(0.0, 0, 100, "m")  # of the antennas over the tag
    range_offset: float = _number(0.0, -100, 100, "m")  # of all ranges
    range_scale: float = _number(1.0, 0.5, 2)  # of all ranges, measured over true distance
    range_lag: float = _number(0.0, -1000, 1000)  # encoder steps by which the ranges are late
    sigma_camera_x: float = _number(0.0, 0, 10, "m")  # this and all below: 0 if known
    sigma_camera_y: float = _number(0.0, 0, 10, "m")
    sigma_camera_turn: float = _number(0.0, 0, 6.3, "rad")
    sigma_marker_size: float = _number(0.0, 0, 2)
    sigma_sighting_lag: float = _number(0.0, 0, 1000)
    sigma_tag_x: float = _number(0.0, 0, 10, "m")
    sigma_tag_y: float = _number(0.0, 0, 10, "m")
    sigma_antenna_height: float = _number(0.0, 0, 100, "m")
    sigma_range_offset: float = _number(0.0, 0, 100, "m")
    sigma_range_scale: float = _number(0.0, 0, 2)
    sigma_range_lag: float = _number(0.0, 0, 1000)

    @property
    def wheel(self):
        """Wheel parameters [R_R, R_L, b], (3,) in m."""
        return np.array([self.right_radius, self.left_radius, self.wheelbase])

    @property
    def sigma_wheel(self):
        """Standard deviations of the wheel parameters, (3,) in m."""
        return np.array([self.sigma_right_radius, self.sigma_left_radius, self.sigma_wheelbase])

    def with_wheel(self, wheel):
        """The Vehicle with the wheel parameters `wheel` (3,) in m and unchanged sigmas."""
        right, left, base = map(float, wheel)
        return replace(self, right_radius=right, left_radius=left, wheelbase=base)


# What each entry of vehicle.toml may be: a Limit, or a tuple of values.
VEHICLE_LIMITS = {each.name: each.metadata["limit"] for each in fields(Vehicle)}
TABLE_2 = Vehicle()  # the assignment's nominal vehicle


def read_vehicle(path, default=TABLE_2):
    """The Vehicle of a `vehicle.toml` (Path or None), whose entries replace those of a default.

    Raises DatasetError if the file does not have the format.
    """
    entries = read_toml(path, "wheelbase = 0.4", VEHICLE_LIMITS) if path else {}
    return changed(default, entries, path)


def changed(vehicle, entries, source):
    """The Vehicle with `entries`, values by the names of its fields; None leaves one as it is.

    Raises DatasetError, which names the `source`, for a value that is not within its Limit.
    """
    for key, value in entries.items():
        limit = VEHICLE_LIMITS[key]
        if isinstance(limit, Limit):
            ok = isinstance(value, Real) and type(value) is not bool and limit.holds(value)
            expected = f"a number {limit}"
        else:
            ok = type(value) is type(limit[0]) and value in limit
            expected = " or ".join(map(json.dumps, limit))
        require(ok or value is None, source, f"{expected} for {key}", value)
    return replace(vehicle, **{key: value if isinstance(value, bool | str) else float(value)
                               for key, value in entries.items() if value is not None})


def incremental_counts(table, vehicle):
    """The Table of the encoders, and its counts since the previous pose, (n, 2) int64.

    Those of a counter that wraps around are mended: counts less a modulus, where that makes them
    as small as most others. Raises DatasetError if there is no row, the first is not 0, or a step
    exceeds MAX_REVOLUTIONS.
    """
    read, limit = table.numbers[:, 1:], MAX_REVOLUTIONS * vehicle.ticks_per_revolution
    require(len(read), table.source, "at least the row '1 0 0', found no rows")
    counts, large = read, np.quantile(abs(read[read != 0]), 0.9) if read.any() else 0.0
    for modulus in MODULI:
        less = counts - np.sign(counts) * modulus
        if MIN_MODULUS_RATIO * large < modulus:
            counts = np.where(abs(less) <= 2 * large, less, counts)
    if len(mended := np.flatnonzero((counts != read).any(axis=1))):
        table = table.noted(
            f": {len(mended)} rows were mended whose counts are 2^15 or 2^16 off, as of a counter "
            f"that wraps around, first {table.place(mended[0])}")
    most = np.where(np.arange(len(read)) == 0, 0, limit)
    table.kept(np.insert(abs(counts) <= most[:, None], 0, True, axis=1), (
        f"at most {MAX_REVOLUTIONS:g} wheel revolutions ({limit:g} ticks) since the pose before, "
        "not since the start, and none in the first row"))
    return table, counts.astype(np.int64)
