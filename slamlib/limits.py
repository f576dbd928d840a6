"""Columns of the tables and entries of vehicle.toml, with the limits of their numbers.

The limits are far wider than vehicles, cameras and antennas need. A number beyond them has another
unit, or a magnitude so far from the others that float64 loses digits. data/README.md lists them.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Limit:
    """The closed interval in which a number lies."""

    minimum: float
    maximum: float | str     # a str names the entry of the same file that is the maximum
    unit: str = ""
    whole: bool = False

    def __str__(self):
        maximum = self.maximum if isinstance(self.maximum, str) else f"{self.maximum:g}"
        return f"from {self.minimum:g} to {maximum} {self.unit}".rstrip()


_ANY = Limit(-1e15, 1e15)               # float64 represents whole numbers up to there exactly
_WHOLE = Limit(-1e15, 1e15, whole=True)  # ids and counts
_VARIANCE = Limit(1e-18, 1e8, "m^2")
_IN_VEHICLE, _GUESS, _TRUE = (Limit(-size, size, "m") for size in (1e4, 1e6, 1e9))
_ANGLE, _TRUE_ANGLE = (Limit(-size, size, "rad") for size in (6.3, 1e9))
_RADIUS, _FACTOR, _PLACE = Limit(1e-3, 2.5, "m"), Limit(0.01, 100), Limit(-10, 10, "m")
_SENSORS = {
    "camera_x": _PLACE, "camera_y": _PLACE, "camera_turn": _ANGLE, "marker_size": Limit(0.5, 2),
    "sighting_lag": Limit(-1000, 1000), "tag_x": _PLACE, "tag_y": _PLACE,
    "antenna_height": Limit(0, 100, "m"), "range_offset": Limit(-100, 100, "m"),
    "range_scale": Limit(0.5, 2), "range_lag": Limit(-1000, 1000)}
# Robust kernels of sightings and ranges, as `slam.fit` has them; the first one is the default.
KERNEL_NAMES = ("asymmetric Tukey", "asymmetric Cauchy", "quadratic", "Huber", "Cauchy",
           "Geman-McClure", "Tukey")
# Limits by the name of a file, and by its column, in the order of the file, or entry; a tuple lists
# what an entry may be.
LIMITS = {
    "encoderReading.txt": {"pose id": _WHOLE, "right ticks": _WHOLE, "left ticks": _WHOLE},
    "ArucoReading.txt": {
        "pose id": _WHOLE, "marker id": _WHOLE, "x": _IN_VEHICLE, "y": _IN_VEHICLE, "theta": _ANGLE,
        "s_xx": _VARIANCE, "s_xy": _ANY, "s_xtheta": _ANY, "s_yy": _VARIANCE, "s_ytheta": _ANY,
        "s_thetatheta": Limit(1e-18, 1e14, "rad^2")},
    "UwbReading.txt": {"pose id": _WHOLE, "antenna id": _WHOLE, "range": Limit(-5e4, 1e5, "m"),
                       "sigma": Limit(1e-9, 1e4, "m")},
    "UwbAntennaGuess.txt": {"antenna id": _WHOLE, "x": _GUESS, "y": _GUESS},
    "vehiclePose.txt": {"pose id": _WHOLE, "x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "ArucoMap.txt": {"marker id": _WHOLE, "x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "UwbMap.txt": {"antenna id": _WHOLE, "x": _TRUE, "y": _TRUE},
    "vehicle.toml": {
        "right_radius": _RADIUS, "left_radius": _RADIUS, "wheelbase": Limit(1e-3, 20, "m"),
        "ticks_per_revolution": Limit(1, 1e10),
        **{f"sigma_{name}": Limit(1e-9, name, "m")
           for name in ("right_radius", "left_radius", "wheelbase")},
        "sigma_heading": Limit(1e-9, 10, "rad"), "slip": Limit(0, 0.1, "sqrt(m)"),
        "marker_noise_factor": _FACTOR, "range_noise_factor": _FACTOR, "kernel": KERNEL_NAMES,
        "gate": (True, False), **_SENSORS,
        **{f"sigma_{name}": Limit(0, limit.maximum, limit.unit)
           for name, limit in _SENSORS.items()}},
}
