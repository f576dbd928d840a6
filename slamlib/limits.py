"""Limits of the numbers in a dataset, which the reader checks and data/README.md lists.

The limits are far wider than vehicles, cameras and antennas need. A number beyond them has another
unit, or a magnitude so far from the others that float64 loses digits.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """The closed interval in which a number lies."""

    minimum: float
    maximum: float | str     # a str names the entry of the same file that is the maximum
    unit: str
    meaning: str             # of the number, with its unit

    def __str__(self):
        maximum = self.maximum if isinstance(self.maximum, str) else f"{self.maximum:g}"
        return f"from {self.minimum:g} to {maximum} {self.unit}".rstrip()

    def expected(self, name):
        """The part of an error message (str) that says what is expected of the number `name`."""
        return f"{'a positive ' if self.minimum > 0 else ''}{name} {self} ({self.meaning})"


_RADIUS = Limit(1e-3, 2.5, "m", "the radius of a wheel in metres")
_SIGHTED = Limit(-1e4, 1e4, "m", "a place in the vehicle's frame in metres")
_VARIANCE = Limit(1e-18, 1e8, "m^2", "the square of a standard deviation in metres")
_GUESS = Limit(-1e6, 1e6, "m", "a place in the frame of pose 1 in metres")
_TRUE = Limit(-1e9, 1e9, "m", "a place in metres")
_TRUE_ANGLE = Limit(-1e9, 1e9, "rad", "an angle in radians")
_FACTOR = Limit(0.01, 100, "", "what the stated standard deviations are multiplied by")
_PLACE = Limit(-10, 10, "m", "a place in the vehicle's frame in metres")
_LAG = Limit(-1000, 1000, "", "a delay in encoder steps")
_SENSORS = {
    "camera_x": _PLACE, "camera_y": _PLACE,
    "camera_turn": Limit(-6.3, 6.3, "rad", "an angle in radians"),
    "marker_size": Limit(0.5, 2, "", "the size of the printed markers over that stated"),
    "sighting_lag": _LAG, "tag_x": _PLACE, "tag_y": _PLACE,
    "antenna_height": Limit(0, 100, "m", "the height of the antennas over the tag in metres"),
    "range_offset": Limit(-100, 100, "m", "a distance in metres"),
    "range_scale": Limit(0.5, 2, "", "measured ranges over true distances"), "range_lag": _LAG}


def _sigma_limit(parameter):
    """The Limit of the standard deviation of a length, at most the length itself."""
    return Limit(1e-9, parameter, "m",
                 f"a standard deviation in metres, not larger than {parameter} itself")


# Limits by the name of a file, and by its column or entry.
LIMITS = {
    "vehicle.toml": {
        "right_radius": _RADIUS, "left_radius": _RADIUS,
        "wheelbase": Limit(1e-3, 20, "m", "the distance between the wheels in metres"),
        "ticks_per_revolution": Limit(1, 1e10, "", "counts of an encoder in one revolution"),
        "sigma_right_radius": _sigma_limit("right_radius"),
        "sigma_left_radius": _sigma_limit("left_radius"),
        "sigma_wheelbase": _sigma_limit("wheelbase"),
        "sigma_heading": Limit(1e-9, 10, "rad", "a standard deviation in radians; from pi on the "
                               "heading is unknown"),
        "slip": Limit(0, 0.1, "sqrt(m)", "the standard deviation in metres of a wheel's slip after "
                      "one metre"),
        "marker_noise_factor": _FACTOR, "range_noise_factor": _FACTOR, **_SENSORS,
        **{f"sigma_{name}": Limit(0, limit.maximum, limit.unit,
                                  f"a standard deviation of {name}; 0 if it is known")
           for name, limit in _SENSORS.items()}},
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
