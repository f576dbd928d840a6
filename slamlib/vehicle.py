"""The vehicle: wheel parameters, and what is known of the noise."""

from dataclasses import asdict, dataclass, replace

import numpy as np

from slamlib.limits import LIMITS
from slamlib.textfile import error, quoted, read_toml


@dataclass(frozen=True)
class Vehicle:
    """Wheel parameters, their standard deviations, and what is known of the noise.

    The defaults are the assignment's table 2, in which the noise is not known.
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
        """The vehicle with other wheel parameters (3,) in m and the same standard deviations."""
        right, left, base = map(float, wheel)
        return replace(self, right_radius=right, left_radius=left, wheelbase=base)

    def with_deviation(self, w):
        """The vehicle with wheel parameters wheel + sigma_wheel * w, w (3,) without unit."""
        return self.with_wheel(self.wheel + self.sigma_wheel * w)


def read_vehicle(files, default):
    """The Vehicle of a folder's `vehicle.toml`, whose entries replace those of a default Vehicle.

    `files` are the `folder.contents`. Raises DatasetError if the file does not follow the format.
    """
    path = files.files.get("vehicle.toml")
    if path is None:
        return default
    limits, values = LIMITS["vehicle.toml"], asdict(default)
    entries = read_toml(path, "wheelbase = 0.4", list(values))
    for key in sorted(entries, key=list(limits).index):    # a parameter before its sigma
        (value, line), limit = entries[key], limits[key]
        most = values.get(limit.most, limit.most)
        if type(value) not in (int, float) or not limit.least <= value <= most:
            raise error(path, f"expected {limit.expected(f'number for {key}')}, found "
                        f"{quoted(value)}", line)
        values[key] = float(value)
    return Vehicle(**values)
