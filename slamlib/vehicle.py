"""The vehicle: wheels and sensors as stated, how well they are known, and how they are weighed."""

import json
from dataclasses import asdict, dataclass, replace
from numbers import Real

import numpy as np

from slamlib.limits import KERNEL_NAMES, LIMITS
from slamlib.textfile import error, quoted, read_toml


@dataclass(frozen=True)
class Vehicle:
    """Wheels and sensors with their standard deviations, and noise parameters or None.

    The defaults are the assignment's table 2, which gives no noise, and sensors in the vehicle's
    origin that measure without common errors. `slam.calibration` has the model of each entry.
    """

    right_radius: float = 0.1  # m
    left_radius: float = 0.1  # m
    wheelbase: float = 0.4  # m
    ticks_per_revolution: float = 8000.0
    sigma_right_radius: float = 1e-4  # m
    sigma_left_radius: float = 1e-4  # m
    sigma_wheelbase: float = 1e-4  # m
    sigma_heading: float = 1e-4  # rad, of the heading at pose 1
    slip: float | None = None  # sqrt(m), sigma of a wheel's slip after 1 m; None: learned
    marker_noise_factor: float | None = None  # of the sigmas in ArucoReading.txt; None: learned
    range_noise_factor: float | None = None  # of the sigmas in UwbReading.txt; None: learned
    kernel: str = KERNEL_NAMES[0]  # of sightings and ranges; of ranges alone if it is asymmetric
    gate: bool = True  # whether measurements that contradict the solution are rejected
    camera_x: float = 0.0  # m, place of the camera in the vehicle
    camera_y: float = 0.0  # m
    camera_turn: float = 0.0  # rad, heading of the camera in the vehicle
    marker_size: float = 1.0  # of the printed markers, over the size that the detector was told
    sighting_lag: float = 0.0  # encoder steps by which the sightings are late
    tag_x: float = 0.0  # m, place of the UWB tag in the vehicle
    tag_y: float = 0.0  # m
    antenna_height: float = 0.0  # m, of the antennas over the tag
    range_offset: float = 0.0  # m, of all ranges
    range_scale: float = 1.0  # of all ranges, measured over true distance
    range_lag: float = 0.0  # encoder steps by which the ranges are late
    sigma_camera_x: float = 0.0  # m; this and all below: 0 if known
    sigma_camera_y: float = 0.0  # m
    sigma_camera_turn: float = 0.0  # rad
    sigma_marker_size: float = 0.0
    sigma_sighting_lag: float = 0.0  # encoder steps
    sigma_tag_x: float = 0.0  # m
    sigma_tag_y: float = 0.0  # m
    sigma_antenna_height: float = 0.0  # m
    sigma_range_offset: float = 0.0  # m
    sigma_range_scale: float = 0.0
    sigma_range_lag: float = 0.0  # encoder steps

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

    def with_deviation(self, w):
        """The Vehicle with wheel parameters wheel + sigma_wheel * w; w (3,) has no unit."""
        return self.with_wheel(self.wheel + self.sigma_wheel * w)


def read_vehicle(files, default):
    """The Vehicle of a folder's `vehicle.toml`, whose entries replace those of a default Vehicle.

    `files` are the `folder.contents`. Raises DatasetError if the file does not have the format.
    """
    path = files.files.get("vehicle.toml")
    if path is None:
        return default
    entries = read_toml(path, "wheelbase = 0.4", [*LIMITS["vehicle.toml"]])
    return changed(default, {key: value for key, (value, _) in entries.items()}, path,
                   {key: line for key, (_, line) in entries.items()})


def changed(vehicle, entries, source, lines=None):
    """The Vehicle with `entries`, values by the names of its fields.

    Raises DatasetError for one that is not within LIMITS, with the `source`, a file or a function,
    and the line, if `lines` has it by name.
    """
    limits, values = LIMITS["vehicle.toml"], asdict(vehicle)
    for key in sorted(entries, key=list(limits).index):    # a parameter before its sigma
        value, limit = entries[key], limits[key]
        if isinstance(limit, tuple):
            ok, expected = isinstance(value, type(limit[0])) and value in limit, " or ".join(
                map(json.dumps, limit))
        else:
            maximum, expected = values.get(limit.maximum, limit.maximum), f"a number {limit}"
            ok = isinstance(value, Real) and not isinstance(value, bool) \
                and limit.minimum <= value <= maximum
        if not ok:
            raise error(source, f"expected {expected} for {key}, found {quoted(value)}",
                        (lines or {}).get(key))
        values[key] = value if isinstance(limit, tuple) else float(value)
    return Vehicle(**values)
