"""The vehicle: its wheel parameters and, where known, the noise of its sensors."""

from dataclasses import asdict, dataclass, replace

import numpy as np

from slamlib.limits import LIMITS
from slamlib.textfile import error, quoted, read_toml


@dataclass(frozen=True)
class Vehicle:
    """Wheel parameters with their standard deviations, and noise parameters or None.

    The defaults are the assignment's table 2, which gives no noise.
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
    limits, values = LIMITS["vehicle.toml"], asdict(default)
    entries = read_toml(path, "wheelbase = 0.4", list(values))
    for key in sorted(entries, key=list(limits).index):    # a parameter before its sigma
        (value, line), limit = entries[key], limits[key]
        maximum = values.get(limit.maximum, limit.maximum)
        if type(value) not in (int, float) or not limit.minimum <= value <= maximum:
            raise error(path, f"expected {limit.expected(f'number for {key}')}, found "
                        f"{quoted(value)}", line)
        values[key] = float(value)
    return Vehicle(**values)
