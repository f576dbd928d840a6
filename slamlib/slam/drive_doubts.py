"""Stage 7: what the solution says against the files: wheels, noise, ranges and sightings."""

import numpy as np
from scipy.special import chdtri

from slamlib.doubt import Doubt

MAX_WHEEL_SIGMAS = 4.0       # of a wheel parameter from what vehicle.toml states
SMALLEST_SIGMA = 1e-12       # m, of a wheel parameter that studies take as known
MAX_SLIP = 0.02              # sqrt(m), of wheels that merely slip
MIN_GAIN = chdtri([1, 3], 5e-4) / 2        # log likelihood, of late sightings and of a place
MIN_LATE = 0.5               # poses
MIN_PLACE = (0.005, 0.005, 0.005)            # m, m, rad, of the camera
NEARLY = 5.0                 # log likelihood by which one explanation must lead to be the only one
MAX_FACTOR = 1.5             # of a sigma, more or less, that is reported
DECIDED_SIGMAS = 4.0         # of the logarithm of a factor, that it must differ from 1
MAX_REJECTED = 0.1           # share of the sightings
MIN_SIGHTINGS = 5            # of a marker, from which on most of them must be accepted
WHEELS = ("right_radius", "left_radius", "wheelbase")


def drive_doubts(measurements, found):
    """List of Doubt about the Measurements of a drive, by their SlamResult."""
    return [*geometry_doubts(measurements.dataset.vehicle, found), *slip_doubts(found),
            *noise_doubts(found), *calibration_doubts(found),
            *sighting_doubts(measurements, found.rejected),
            *(Doubt("antenna", f"Antenna {antenna} is in doubt: {reason}. Its covariance includes "
                               "this; look at its rows in UwbReading.txt.")
              for antenna, reason in found.doubts.items())]


def geometry_doubts(vehicle, found):
    """Wheels, late sightings or a place of the camera: what explains most, and what nearly as much.

    Each strains the others, so that two would often be named for one reason.
    """
    explained = {gain: doubt for gain, doubt in (
        _wheels(vehicle, found), _late(found.camera.time), _place(found.camera.place)) if doubt}
    return [doubt for gain, doubt in sorted(explained.items(), reverse=True)
            if gain > max(explained) - NEARLY]


def _wheels(vehicle, found):
    """Log likelihood that the wheels' prior costs, and the Doubt if one of them is far from it."""
    off = (found.wheel - vehicle.wheel) / np.maximum(vehicle.sigma_wheel, SMALLEST_SIGMA)
    far = np.flatnonzero(np.abs(off) > MAX_WHEEL_SIGMAS)
    if not len(far):
        return 0.0, None
    sigma = np.sqrt(np.diag(found.wheel_covariance))
    named = " and ".join(
        f"{WHEELS[k]} is {1e3 * found.wheel[k]:.2f} ± {1e3 * sigma[k]:.2f} mm where "
        f"{1e3 * vehicle.wheel[k]:.2f} ± {1e3 * vehicle.sigma_wheel[k]:.2f} mm was stated"
        for k in far)
    return off @ off / 2, Doubt("wheel-parameters", (
        f"By the other sensors {named}, up to {np.abs(off).max():.0f} standard deviations off: "
        "measure the wheels again, or state values or larger sigmas in vehicle.toml."))


def _late(time):
    """Gain in log likelihood, and the Doubt if sightings are late or early against the encoder."""
    late, sigma = time.estimate[0], time.sigma[0]
    if time.gain < MIN_GAIN[0] or abs(late) < MIN_LATE:
        return time.gain, None
    side, sign = ("late", "large") if late > 0 else ("early", "small")
    return time.gain, Doubt("time-offset", (
        f"The sightings agree best if they are {abs(late):.1f} ± {sigma:.1f} poses {side} against "
        f"the encoder: look whether the pose ids of ArucoReading.txt are too {sign} by about "
        f"{abs(late):.0f}."))


def _place(place):
    """Gain in log likelihood, and the Doubt if the camera is not in the vehicle's origin."""
    if place.gain < MIN_GAIN[1] or (np.abs(place.estimate) < MIN_PLACE).all():
        return place.gain, None
    (x, y, turn), sigma = place.estimate, place.sigma
    return place.gain, Doubt("camera-offset", (
        "The sightings agree best from a camera that is not in the vehicle's origin, midway "
        f"between the wheels, but at x = {x:.3f} ± {sigma[0]:.3f} m, y = {y:.3f} ± "
        f"{sigma[1]:.3f} m and turned by {turn:.3f} ± {sigma[2]:.3f} rad: look whether "
        "ArucoReading.txt gives the markers in the axes of the vehicle."))


def slip_doubts(found):
    """A slip that no wheel has."""
    if found.slip <= MAX_SLIP or not found.noise_sigma[0]:
        return []
    return [Doubt("wheel-slip", (
        f"By the other sensors each wheel slips by {1e3 * found.slip:.0f} mm (one standard "
        "deviation) after one metre, far more than wheels do: look whether encoderReading.txt is "
        "of the same drive as the other files, with the same pose ids."))]


def noise_doubts(found):
    """Factors on the stated sigmas that differ from 1."""
    return [Doubt(what, (
        f"The {name} scatter {factor:.3g} times as much as {file} states (the factor is known to "
        f"{100 * sigma:.0f} %): problems 3 and 4 use the scatter that was found, the others the "
        "file's. Look at how the sensor's covariances were obtained."))
        for what, name, file, factor, sigma in (
            ("marker-noise", "sightings", "ArucoReading.txt", found.noise.sightings,
             found.noise_sigma[1]),
            ("range-noise", "ranges", "UwbReading.txt", found.noise.ranges, found.noise_sigma[2]))
        if abs(np.log(factor)) > max(np.log(MAX_FACTOR), DECIDED_SIGMAS * sigma)]


def calibration_doubts(found):
    """Ranges that calibrated themselves."""
    if not found.range_calibration_sigma.any():
        return []
    (offset, scale), (sigma, scale_sigma) = found.range_calibration, found.range_calibration_sigma
    return [Doubt("range-offset", (
        f"The ranges of UwbReading.txt are {offset:.3f} ± {sigma:.3f} m plus {scale:.4f} ± "
        f"{scale_sigma:.4f} times the distance. Problem 4 corrects this; calibrate the antennas."))]


def sighting_doubts(measurements, rejected):
    """Many rejected sightings, or most of a marker's; `rejected` (s,) bool."""
    sentences = []
    if rejected.sum() > MAX_REJECTED * len(rejected):
        sentences.append(f"{rejected.sum()} of {len(rejected)} sightings contradict the rest and "
                         "are left out")
    count = np.bincount(measurements.label, minlength=len(measurements.marker))
    wrong = np.bincount(measurements.label, rejected, len(measurements.marker))
    most = measurements.marker[(count >= MIN_SIGHTINGS) & (wrong > count / 2)].tolist()
    if most:
        sentences.append("most sightings of marker " + ", ".join(map(str, most))
                         + " contradict the rest and are left out")
    return [Doubt("sightings-rejected", "; ".join(sentences).capitalize()
                  + ": look at the marker ids in ArucoReading.txt, at markers that were moved or "
                  "are there twice.")] if sentences else []


def confirmation(found, sensor):
    """What a SlamResult says of the stated noise of a sensor, "sightings" or "ranges": a clause.

    It is confirmed where the factor on its standard deviations is within a tenth of 1 or within
    three standard deviations of it.
    """
    column, file = {"sightings": (1, "ArucoReading.txt"), "ranges": (2, "UwbReading.txt")}[sensor]
    factor, relative = getattr(found.noise, sensor), found.noise_sigma[column]
    number = f"{factor:.2f} ± {factor * relative:.2f}"
    if abs(np.log(factor)) < max(np.log(1.1), 3 * relative):
        return f"the standard deviations in {file} are confirmed (factor {number})"
    return f"the standard deviations in {file} were multiplied by {number}"
