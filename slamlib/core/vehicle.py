"""The vehicle: wheels and sensors as stated, how well they are known, and what each may be."""

import json
from dataclasses import dataclass, replace
from numbers import Real

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
    kernel: str = "asymmetric Tukey"     # of sightings and ranges; of ranges alone if asymmetric
    gate: bool = True                    # whether what contradicts the solution is rejected
    camera_x: float = 0.0                # m, place of the camera in the vehicle
    camera_y: float = 0.0                # m
    camera_turn: float = 0.0             # rad, heading of the camera in the vehicle
    marker_size: float = 1.0             # of markers, over that which the detector was told
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
        return (self.minimum <= x) & (x <= self.maximum) & (not self.whole or x == np.rint(x))


def _limits():
    """What each entry of vehicle.toml may be: a Limit(minimum, maximum, unit), or values."""
    metres, sigma_metres = Limit(-10, 10, "m"), Limit(0, 10, "m")
    radius, factor = Limit(1e-3, 2.5, "m"), Limit(0.01, 100)
    ratio, sigma_ratio = Limit(0.5, 2), Limit(0, 2)
    lag, sigma_lag = Limit(-1000, 1000), Limit(0, 1000)
    return {
        "right_radius": radius,
        "left_radius": radius,
        "wheelbase": Limit(1e-3, 20, "m"),
        "ticks_per_revolution": Limit(1, 1e10),
        "sigma_right_radius": Limit(1e-9, 2.5, "m"),
        "sigma_left_radius": Limit(1e-9, 2.5, "m"),
        "sigma_wheelbase": Limit(1e-9, 20, "m"),
        "sigma_heading": Limit(1e-9, 10, "rad"),
        "slip": Limit(0, 0.1, "sqrt(m)"),
        "marker_noise_factor": factor,
        "range_noise_factor": factor,
        "kernel": tuple(KERNELS),
        "gate": (True, False),
        "camera_x": metres,
        "camera_y": metres,
        "camera_turn": Limit(-6.3, 6.3, "rad"),
        "marker_size": ratio,
        "sighting_lag": lag,
        "tag_x": metres,
        "tag_y": metres,
        "antenna_height": Limit(0, 100, "m"),
        "range_offset": Limit(-100, 100, "m"),
        "range_scale": ratio,
        "range_lag": lag,
        "sigma_camera_x": sigma_metres,
        "sigma_camera_y": sigma_metres,
        "sigma_camera_turn": Limit(0, 6.3, "rad"),
        "sigma_marker_size": sigma_ratio,
        "sigma_sighting_lag": sigma_lag,
        "sigma_tag_x": sigma_metres,
        "sigma_tag_y": sigma_metres,
        "sigma_antenna_height": Limit(0, 100, "m"),
        "sigma_range_offset": Limit(0, 100, "m"),
        "sigma_range_scale": sigma_ratio,
        "sigma_range_lag": sigma_lag,
    }


VEHICLE_LIMITS = _limits()


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
