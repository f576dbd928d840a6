"""Stage 7: what the solution says against the files: wheels, noise, ranges and sightings."""

import numpy as np

from slamlib.doubt import Doubt
from slamlib.slam.noise import BOUNDS

MAX_WHEEL_SIGMAS = 4.0       # of a wheel parameter from what vehicle.toml states
SMALLEST_SIGMA = 1e-12       # m, of a wheel parameter that studies take as known
MAX_TURN_SIGMA = np.pi / 3   # rad, between two frames; half a turn is three sigmas
MAX_SLIP = 0.02              # sqrt(m), of wheels that merely slip
MIN_GAIN = 6.0578, 8.8650    # log likelihood, of late sightings and of a place: the 99.95 %
                             # quantile of chi-squared with 1 and 3 degrees of freedom, halved
MIN_LATE = 0.5               # poses
MANY_POSES = 10              # from which on the estimate of late sightings is too small
MIN_PLACE = (0.005, 0.005, 0.005)            # m, m, rad, of the camera
MIN_GAIN_RANGES = 7.6009     # the same, of the ranges' offset and scale
MANY_LATE = 0.1              # share of the ranges with less than half of their weight
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


def turn_doubts(problem):
    """Doubt where a Problem's wheels leave the turn between two frames open by whole turns.

    By the wheels as vehicle.toml states them: those of a solution that lost a turn explain it.
    """
    odometry, frame = problem.odometry, problem.measurements.frame
    variance = np.sum(odometry.by_w[:, 2]**2, axis=1) \
        + odometry.noise(problem.noise.slip)[:, 2, 2]
    if not len(variance) or np.sqrt(variance.max()) < MAX_TURN_SIGMA:
        return []
    k = int(variance.argmax())
    return [Doubt("turns", (
        f"Between poses {frame[k] + 1} and {frame[k + 1] + 1} only the wheels were measured, and "
        f"they know the turn between them to {np.sqrt(variance[k]):.1f} rad (one standard "
        "deviation): whole turns may be missing in the solution, and with them the path between "
        "these poses is wrong."))]


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
    off = in_sigmas(vehicle, found.wheel)
    if not far_off(vehicle, found.wheel).any():
        return 0.0, None
    return off @ off / 2, Doubt("wheel-parameters", (
        f"By the other sensors {wheels_in_words(vehicle, found.wheel)}, up to "
        f"{np.abs(off).max():.0f} standard deviations off: measure the wheels again, or state "
        "values or larger sigmas in vehicle.toml." + marker_size(vehicle, found.wheel)))


def in_sigmas(vehicle, wheel):
    """Differences (3,) of parameters `wheel` (3,), m, from a Vehicle's, in its sigmas."""
    return (wheel - vehicle.wheel) / np.maximum(vehicle.sigma_wheel, SMALLEST_SIGMA)


def far_off(vehicle, wheel):
    """(3,) bool, parameters that differ from a Vehicle's by more than MAX_WHEEL_SIGMAS."""
    return np.abs(in_sigmas(vehicle, wheel)) > MAX_WHEEL_SIGMAS


def wheels_in_words(vehicle, wheel):
    """The parameters in `wheel` (3,), m, that are far off a Vehicle's."""
    return " and ".join(
        f"{WHEELS[k]} is {1e3 * wheel[k]:.1f} mm (stated: {1e3 * vehicle.wheel[k]:.1f} ± "
        f"{1e3 * vehicle.sigma_wheel[k]:.1f} mm)" for k in np.flatnonzero(far_off(vehicle, wheel)))


def marker_size(vehicle, wheel):
    """What else explains radii in `wheel` (3,) that differ from a Vehicle's by one factor."""
    factors = wheel[:2] / vehicle.wheel[:2]
    off = factors.mean() - 1
    if abs(off) < 2 * np.ptp(factors):
        return ""
    return (f" The same is seen if all lengths in ArucoReading.txt are {abs(off):.1%} too "
            f"{'large' if off > 0 else 'small'}, as for printed markers of another size than the "
            "detector was told.")


def _late(time):
    """Gain in log likelihood, and the Doubt if sightings are late or early against the encoder."""
    late, sigma = time.estimate[0], time.sigma[0]
    if time.gain < MIN_GAIN[0] or abs(late) < MIN_LATE:
        return time.gain, None
    side, sign = ("late", "large") if late > 0 else ("early", "small")
    number = f"{abs(late):.1f} ± {sigma:.1f} poses" if abs(late) < MANY_POSES else \
        f"{abs(late):.0f} poses or more"
    return time.gain, Doubt("time-offset", (
        f"The sightings agree best if they are {number} {side} against the encoder: look whether "
        f"the pose ids of ArucoReading.txt are too {sign}, and whether rows are missing in "
        "encoderReading.txt."))


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
    """Factors on the stated sigmas that were learned and differ from 1."""
    late = np.mean(found.range_weight < 0.5) if len(found.range_weight) else 0.0
    doubts = []
    for column, what, name, file in ((1, "marker-noise", "sightings", "ArucoReading.txt"),
                                     (2, "range-noise", "ranges", "UwbReading.txt")):
        factor, sigma = getattr(found.noise, name), found.noise_sigma[column]
        if not sigma or abs(np.log(factor)) <= max(np.log(MAX_FACTOR), DECIDED_SIGMAS * sigma):
            continue
        outside = (found.noise.logarithms[column] - BOUNDS[:, column]) * [1, -1] < sigma
        number = f"at most {factor:.2g}" if outside[0] else \
            f"at least {factor:.3g}" if outside[1] else f"{factor:.2f} ± {factor * sigma:.2f}"
        reason = (f"{late:.0%} of them are far too long, as without line of sight."
                  if name == "ranges" and late > MANY_LATE else
                  "Look at how the sensor's covariances were obtained.")
        doubts.append(Doubt(what, (
            f"The {name} scatter {number} times as much as {file} states: problems 3 and 4 use the "
            f"scatter that was found, the others the file's. {reason}")))
    return doubts


def calibration_doubts(found):
    """Ranges that calibrated themselves and are not as stated."""
    covariance = found.range_calibration_covariance
    if not covariance.any():
        return []
    off = found.range_calibration - [0, 1]
    if off @ np.linalg.solve(covariance, off) / 2 < MIN_GAIN_RANGES:
        return []
    (offset, scale), (sigma, scale_sigma) = found.range_calibration, found.range_calibration_sigma
    return [Doubt("range-offset", (
        f"The ranges of UwbReading.txt are {offset:.3f} ± {sigma:.3f} m plus {scale:.4f} ± "
        f"{scale_sigma:.4f} times the distance. Problem 4 corrects this; calibrate the antennas."))]


def sighting_doubts(measurements, rejected):
    """Many rejected sightings, or most of a marker's; `rejected` (s,) bool."""
    sentences, repeated = [], measurements.sightings.contradicting
    left_out, count = rejected.sum() + repeated, len(rejected) + repeated
    if left_out > MAX_REJECTED * count:
        sentences.append(f"{left_out} of {count} sightings contradict the rest and are left out"
                         + (f", {repeated} of them another one of the same marker at the same pose"
                            if repeated else ""))
    seen = np.bincount(measurements.label, minlength=len(measurements.marker))
    wrong = np.bincount(measurements.label, rejected, len(measurements.marker))
    most = measurements.marker[(seen >= MIN_SIGHTINGS) & (wrong > seen / 2)].tolist()
    if most:
        sentences.append(f"most sightings of marker{'s' * (len(most) > 1)} "
                         + ", ".join(map(str, most)) + " contradict the rest and are left out")
    if not sentences:
        return []
    text = "; ".join(sentences)
    return [Doubt("sightings-rejected", text[0].upper() + text[1:]
                  + ": look at the marker ids in ArucoReading.txt, and for markers that were moved "
                  "or are there twice.")]


def confirmation(found, sensor):
    """What a SlamResult says of the stated noise of a sensor, "sightings" or "ranges": a clause.

    It is confirmed where the factor on its standard deviations is within a tenth of 1 or within
    three standard deviations of it; a factor that was given says nothing.
    """
    column, file = {"sightings": (1, "ArucoReading.txt"), "ranges": (2, "UwbReading.txt")}[sensor]
    factor, relative = getattr(found.noise, sensor), found.noise_sigma[column]
    if not relative:
        return f"the standard deviations in {file} are multiplied by {factor:.3g}, as given"
    number = f"{factor:.2f} ± {factor * relative:.2f}"
    if abs(np.log(factor)) < max(np.log(1.1), 3 * relative):
        return f"the standard deviations in {file} are confirmed (factor {number})"
    return f"the standard deviations in {file} were multiplied by {number}"
