"""The numbers that a dataset may hold: one table, which the reader checks and data/README.md shows.

The limits are far wider than vehicles, cameras and antennas need. A number outside of them is in
another unit, or so large or small beside the others that float64 cannot hold both.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """The closed interval in which a number lies."""

    least: float
    most: float | str        # a str names the entry of the same file that is the largest value
    unit: str
    what: str                # what the number is

    def __str__(self):
        most = self.most if isinstance(self.most, str) else f"{self.most:g}"
        return f"from {self.least:g} to {most} {self.unit}".rstrip()

    def expected(self, name):
        """What a message says that is expected of the number `name`."""
        return f"{'a positive ' if self.least > 0 else ''}{name} {self} ({self.what})"


_RADIUS = Limit(1e-3, 2.5, "m", "the radius of a wheel in metres")
_SIGHTED = Limit(-1e4, 1e4, "m", "a place in the vehicle's frame in metres")
_VARIANCE = Limit(1e-18, 1e8, "m^2", "the square of a standard deviation in metres")
_GUESS = Limit(-1e6, 1e6, "m", "a place in the frame of pose 1 in metres")
_TRUE = Limit(-1e9, 1e9, "m", "a place in metres")
_TRUE_ANGLE = Limit(-1e9, 1e9, "rad", "an angle in radians")
_FACTOR = Limit(0.01, 100, "", "what the stated standard deviations are multiplied by")


def _of(parameter):
    return Limit(1e-9, parameter, "m",
                 f"a standard deviation in metres, not larger than {parameter} itself")


# By the name of a file, and by column or entry.
LIMITS = {
    "vehicle.toml": {
        "right_radius": _RADIUS, "left_radius": _RADIUS,
        "wheelbase": Limit(1e-3, 20, "m", "the distance between the wheels in metres"),
        "ticks_per_revolution": Limit(1, 1e10, "", "counts of an encoder in one revolution"),
        "sigma_right_radius": _of("right_radius"), "sigma_left_radius": _of("left_radius"),
        "sigma_wheelbase": _of("wheelbase"),
        "sigma_heading": Limit(1e-9, 10, "rad", "a standard deviation in radians; from pi on the "
                               "heading is unknown"),
        "slip": Limit(0, 0.1, "sqrt(m)", "the standard deviation in metres of a wheel's slip after "
                      "one metre"),
        "marker_noise_factor": _FACTOR, "range_noise_factor": _FACTOR},
    "ArucoReading.txt": {
        "x": _SIGHTED, "y": _SIGHTED, "theta": Limit(-6.3, 6.3, "rad", "an angle in radians"),
        "s_xx": _VARIANCE, "s_yy": _VARIANCE,
        "s_thetatheta": Limit(1e-18, 1e14, "rad^2",
                              "the square of a standard deviation in radians")},
    "UwbReading.txt": {
        "range": Limit(-5e4, 1e5, "m", "a distance in metres"),
        "sigma": Limit(1e-9, 1e4, "m", "a standard deviation in metres")},
    "UwbAntennaGuess.txt": {"x": _GUESS, "y": _GUESS},
    "vehiclePose.txt": {"x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "ArucoMap.txt": {"x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "UwbMap.txt": {"x": _TRUE, "y": _TRUE},
}
