"""The vehicle: wheels and sensors as stated, how well they are known, and what each may be."""

import json
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path

import numpy as np

from slamlib.core.errors import require
from slamlib.core.kernels import KERNELS


@dataclass(frozen=True)
class Vehicle:
    """Wheels and sensors with their standard deviations, and noise parameters or None.

    The defaults are the assignment's table 2, which gives no noise, and sensors in the vehicle's
    origin that measure without common errors. `robust.calibration` has the model of each entry.
    """

    right_radius: float = 0.1                     # m
    left_radius: float = 0.1                      # m
    wheelbase: float = 0.4                        # m
    ticks_per_revolution: float = 8000.0
    sigma_right_radius: float = 1e-4              # m
    sigma_left_radius: float = 1e-4               # m
    sigma_wheelbase: float = 1e-4                 # m
    sigma_heading: float = 1e-4                   # rad, of the heading at pose 1
    slip: float | None = None                     # sqrt(m), sigma after 1 m; None: learned
    marker_noise_factor: float | None = None      # of the sigmas in ArucoReading.txt
    range_noise_factor: float | None = None       # of the sigmas in UwbReading.txt
    kernel: str = "asymmetric Tukey"     # an asymmetric one: of ranges only
    gate: bool = True                    # whether what contradicts the solution is rejected
    camera_x: float = 0.0                # m, place of the camera in the vehicle
    camera_y: float = 0.0                # m
    camera_turn: float = 0.0             # rad, heading of the camera in the vehicle
    marker_size: float = 1.0             # true size over that which the detector was told
    sighting_lag: float = 0.0            # encoder steps by which sightings are late
    tag_x: float = 0.0                   # m, place of the UWB tag in the vehicle
    tag_y: float = 0.0                   # m
    antenna_height: float = 0.0          # m, of the antennas over the tag
    range_offset: float = 0.0            # m, of all ranges
    range_scale: float = 1.0             # of all ranges, measured over true distance
    range_lag: float = 0.0               # encoder steps by which the ranges are late
    sigma_camera_x: float = 0.0          # m; this and all below: 0 if known
    sigma_camera_y: float = 0.0          # m
    sigma_camera_turn: float = 0.0       # rad
    sigma_marker_size: float = 0.0
    sigma_sighting_lag: float = 0.0      # encoder steps
    sigma_tag_x: float = 0.0             # m
    sigma_tag_y: float = 0.0             # m
    sigma_antenna_height: float = 0.0    # m
    sigma_range_offset: float = 0.0      # m
    sigma_range_scale: float = 0.0
    sigma_range_lag: float = 0.0         # encoder steps

    @property
    def wheel(self) -> np.ndarray:
        """Wheel parameters [R_R, R_L, b], (3,) in m."""
        return np.array([self.right_radius, self.left_radius, self.wheelbase])

    @property
    def sigma_wheel(self) -> np.ndarray:
        """Standard deviations of the wheel parameters, (3,) in m."""
        return np.array([self.sigma_right_radius, self.sigma_left_radius, self.sigma_wheelbase])

    @property
    def metres_per_count(self) -> np.ndarray:
        """Ways of the right and the left wheel in one encoder count, (2,) in m."""
        return 2 * np.pi * self.wheel[:2] / self.ticks_per_revolution

    @property
    def camera(self) -> np.ndarray:
        """Pose [x, y, turn] of the camera in the vehicle, (3,) in m and rad."""
        return np.array([self.camera_x, self.camera_y, self.camera_turn])

    def with_wheel(self, wheel: np.ndarray) -> "Vehicle":
        """The Vehicle with the wheel parameters `wheel` (3,) in m and unchanged sigmas."""
        right, left, base = map(float, wheel)
        return replace(self, right_radius=right, left_radius=left, wheelbase=base)


TABLE_2 = Vehicle()                      # the assignment's nominal vehicle


@dataclass(frozen=True)
class Limit:
    """The closed interval in which a number lies."""

    minimum: float
    maximum: float
    unit: str = ""
    whole: bool = False

    def __str__(self):
        return f"from {self.minimum:g} to {self.maximum:g} {self.unit}".rstrip()

    def holds(self, x):
        """True where numbers are in the interval, and whole if they must be."""
        inside = (self.minimum <= x) & (x <= self.maximum)
        if self.whole:
            return inside & (x == np.rint(x))
        return inside


_RADIUS = Limit(1e-3, 2.5, "m")
_NOISE_FACTOR = Limit(0.01, 100)
_PLACE = Limit(-10, 10, "m")
_RATIO = Limit(0.5, 2)
_LAG = Limit(-1000, 1000)
_WHEELS = {"right_radius": _RADIUS, "left_radius": _RADIUS, "wheelbase": Limit(1e-3, 20, "m")}
_SENSORS = {
    "camera_x": _PLACE,
    "camera_y": _PLACE,
    "camera_turn": Limit(-6.3, 6.3, "rad"),
    "marker_size": _RATIO,
    "sighting_lag": _LAG,
    "tag_x": _PLACE,
    "tag_y": _PLACE,
    "antenna_height": Limit(0, 100, "m"),
    "range_offset": Limit(-100, 100, "m"),
    "range_scale": _RATIO,
    "range_lag": _LAG,
}


def _sigmas(limits, minimum):
    """Limits of standard deviations, up to the largest value of the entry."""
    return {f"sigma_{name}": replace(limit, minimum=minimum) for name, limit in limits.items()}


# What each field of a Vehicle may be: a number within a Limit, or one of several values.
VEHICLE_LIMITS = _WHEELS | _SENSORS | _sigmas(_WHEELS, 1e-9) | _sigmas(_SENSORS, 0) | {
    "ticks_per_revolution": Limit(1, 1e10),
    "sigma_heading": Limit(1e-9, 10, "rad"),
    "slip": Limit(0, 0.1, "sqrt(m)"),
    "marker_noise_factor": _NOISE_FACTOR,
    "range_noise_factor": _NOISE_FACTOR,
    "kernel": tuple(KERNELS),
    "gate": (True, False),
}


def changed(vehicle: Vehicle, entries: dict, source: Path | str | None) -> Vehicle:
    """The Vehicle with `entries`, values by the names of its fields; None leaves one as it is.

    Raises DatasetError, which names the `source`, for a value that is not within its Limit.
    """
    stated = {}
    for key, value in entries.items():
        if value is None:
            continue
        limit = VEHICLE_LIMITS[key]
        if isinstance(limit, Limit):
            is_number = isinstance(value, Real) and not isinstance(value, bool)
            require(is_number and limit.holds(value), source, f"a number {limit} for {key}", value)
            value = float(value)
        else:
            is_listed = type(value) is type(limit[0]) and value in limit
            listed = " or ".join(map(json.dumps, limit))
            require(is_listed, source, f"{listed} for {key}", value)
        stated[key] = value
    return replace(vehicle, **stated)
