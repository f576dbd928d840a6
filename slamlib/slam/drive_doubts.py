"""Stage 7: doubts where the solution contradicts the files: wheels, noise, ranges, sightings."""

import numpy as np

from slamlib.doubt import Doubt
from slamlib.slam.noise import BOUNDS

MAX_WHEEL_SIGMAS = 4.0       # sigmas, of a wheel parameter from that in vehicle.toml
MIN_WHEEL_SIGMA = 1e-12      # m, of a wheel parameter that studies take as known
MAX_TURN_SIGMA = np.pi / 3   # rad, between two frames; half a turn is three sigmas
MAX_SLIP = 0.02              # sqrt(m), of wheels on the ground
# Log likelihoods: the 99.95 % quantiles of chi-squared with 1, 3 and 2 degrees of freedom, halved.
MIN_TIME_GAIN = 6.0578       # of late sightings
MIN_PLACE_GAIN = 8.8650      # of a camera that is not in the origin
MIN_RANGE_GAIN = 7.6009      # of offset and scale of the ranges
MIN_DELAY = 0.5              # poses, of late sightings that are reported
MAX_DELAY = 10               # poses, above which the estimate of the delay is too small
MIN_PLACE = (0.005, 0.005, 0.005)    # m, m, rad, of a camera whose place is reported
MAX_LATE_SHARE = 0.1         # share of the ranges that keep less than half of their weight
MIN_LEAD = 5.0               # log likelihood by which the only explanation leads the others
MAX_NOISE_FACTOR = 1.5       # on a sigma, or its inverse; beyond it the factor is reported
MIN_FACTOR_SIGMAS = 4.0      # sigmas of the logarithm of a factor that is reported
MAX_CONFIRMED = 1.1          # factor on a sigma, or its inverse, up to which it is confirmed
MAX_CONFIRMED_SIGMAS = 3.0   # sigmas of the logarithm of a factor that is confirmed
MAX_REJECTED = 0.1           # share of the sightings that are rejected
MIN_SIGHTINGS_PER_MARKER = 5         # number of sightings, of which the majority must be accepted
WHEEL_NAMES = ("right_radius", "left_radius", "wheelbase")


def solution_doubts(measurements, result):
    """List of Doubt about the Measurements of a drive, from their SlamResult."""
    return [*calibration_doubts(result), *slip_doubts(result), *noise_doubts(result),
            *sighting_doubts(measurements, result.rejected),
            *(Doubt("antenna", f"Antenna {antenna} is in doubt: {reason}. Its covariance includes "
                               "this; look at its rows in UwbReading.txt.")
              for antenna, reason in result.doubts.items())]


def turn_doubts(problem):
    """List of a Doubt if odometry does not determine the number of turns between two frames.

    By the stated wheels: estimated ones adapt to a wrong number of turns.
    """
    odometry, frame = problem.odometry, problem.measurements.frame
    variance = np.sum((odometry.J_wheel[:, 2] * problem.measurements.dataset.vehicle.sigma_wheel)**2, axis=1) \
        + odometry.covariance(problem.noise.slip)[:, 2, 2]
    if not len(variance) or np.sqrt(variance.max()) < MAX_TURN_SIGMA:
        return []
    k = int(variance.argmax())
    return [Doubt("turns", (
        f"Between poses {frame[k] + 1} and {frame[k + 1] + 1} only the wheels were measured, and "
        f"they know the turn between them to {np.sqrt(variance[k]):.1f} rad (one standard "
        "deviation): whole turns may be missing in the solution, and with them the path between "
        "these poses is wrong."))]


def slip_doubts(result):
    """List of a Doubt if the slip is larger than that of any wheel."""
    if result.slip <= MAX_SLIP or not result.noise_sigma[0]:
        return []
    return [Doubt("wheel-slip", (
        f"By the other sensors each wheel slips by {1e3 * result.slip:.0f} mm (one standard "
        "deviation) after one metre, far more than wheels do: look whether encoderReading.txt is "
        "of the same drive as the other files, with the same pose ids."))]


def noise_doubts(result):
    """List of Doubt for learned factors on the stated sigmas that differ from 1."""
    late_share = np.mean(result.range_weight < 0.5) if len(result.range_weight) else 0.0
    doubts = []
    for column, what, name, file in ((1, "marker-noise", "sightings", "ArucoReading.txt"),
                                     (2, "range-noise", "ranges", "UwbReading.txt")):
        factor, sigma = getattr(result.noise, name), result.noise_sigma[column]
        if not sigma or abs(np.log(factor)) <= max(
                np.log(MAX_NOISE_FACTOR), MIN_FACTOR_SIGMAS * sigma):
            continue
        outside = (result.noise.logarithms[column] - BOUNDS[:, column]) * [1, -1] < sigma
        number = f"at most {factor:.2g}" if outside[0] else \
            f"at least {factor:.3g}" if outside[1] else f"{factor:.2f} ± {factor * sigma:.2f}"
        reason = (f"{late_share:.0%} of them are far too long, as without line of sight."
                  if name == "ranges" and late_share > MAX_LATE_SHARE else
                  "Look at how the sensor's covariances were obtained.")
        doubts.append(Doubt(what, (
            f"The {name} scatter {number} times as much as {file} states: problems 3 and 4 use the "
            f"scatter that was found, the others the file's. {reason}")))
    return doubts


def calibration_doubts(result):
    """List of a Doubt for each group of the calibration that left its stated values."""
    stated, sigma = result.calibration, np.sqrt(np.diag(result.c_covariance))
    doubts = []
    for group in sorted(result.released):
        rows = np.flatnonzero(stated.group == group)
        numbers = ", ".join(
            f"{stated.names[k]} is {result.c[k]:.4g} ± {sigma[k]:.2g} (stated: {stated.stated[k]:.4g}"
            + (f" ± {stated.sigma[k]:.2g})" if stated.sigma[k] else ")") for k in rows)
        doubts.append(Doubt(group, f"By the drive {numbers}; problems 3 and 4 use this."))
    return doubts


def sighting_doubts(measurements, rejected):
    """List of a Doubt if `rejected` (s,), bool, has many sightings, or the majority of a marker."""
    sentences, repeated = [], measurements.sightings.contradicting
    left_out, count = rejected.sum() + repeated, len(rejected) + repeated
    if left_out > MAX_REJECTED * count:
        sentences.append(f"{left_out} of {count} sightings contradict the rest and are left out"
                         + (f", {repeated} of them another one of the same marker at the same pose"
                            if repeated else ""))
    seen = np.bincount(measurements.marker_row, minlength=len(measurements.marker))
    wrong = np.bincount(measurements.marker_row, rejected, len(measurements.marker))
    markers = measurements.marker[
        (seen >= MIN_SIGHTINGS_PER_MARKER) & (wrong > seen / 2)].tolist()
    if markers:
        sentences.append(f"most sightings of marker{'s' * (len(markers) > 1)} "
                         + ", ".join(map(str, markers)) + " contradict the rest and are left out")
    if not sentences:
        return []
    text = "; ".join(sentences)
    return [Doubt("sightings-rejected", text[0].upper() + text[1:]
                  + ": look at the marker ids in ArucoReading.txt, and for markers that were moved "
                  "or are there twice.")]


def confirmation(result, sensor):
    """A clause on the stated noise of a sensor, "sightings" or "ranges", from a SlamResult.

    The noise is confirmed if the learned factor on its standard deviations is within a tenth of 1,
    or within three of its own standard deviations.
    """
    column, file = {"sightings": (1, "ArucoReading.txt"), "ranges": (2, "UwbReading.txt")}[sensor]
    factor, relative = getattr(result.noise, sensor), result.noise_sigma[column]
    if not relative:
        return f"the standard deviations in {file} are multiplied by {factor:.3g}, as given"
    number = f"{factor:.2f} ± {factor * relative:.2f}"
    if abs(np.log(factor)) < max(
            np.log(MAX_CONFIRMED), MAX_CONFIRMED_SIGMAS * relative):
        return f"the standard deviations in {file} are confirmed (factor {number})"
    return f"the standard deviations in {file} were multiplied by {number}"
