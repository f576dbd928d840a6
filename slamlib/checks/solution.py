"""Doubts where the solution of problem 3 or 4, a SlamResult, contradicts what the files state."""

import numpy as np

from slamlib.doubt import Doubt
from slamlib.slam.noise import BOUNDS

MAX_TURN_SIGMA = np.pi / 3   # rad, between two frames; half a turn is three sigmas
MAX_SLIP = 0.02              # sqrt(m), of wheels on the ground
MAX_LATE_SHARE = 0.1         # share of the ranges that keep less than half of their weight
MAX_NOISE_FACTOR = 1.5       # on a sigma, or its inverse; beyond it the factor is reported
MIN_FACTOR_SIGMAS = 4.0      # sigmas of the logarithm of a factor that is reported
MAX_CONFIRMED = 1.1          # factor on a sigma, or its inverse, up to which it is confirmed
MAX_CONFIRMED_SIGMAS = 3.0   # sigmas of the logarithm of a factor that is confirmed
MAX_REJECTED = 0.1           # share of the sightings that are rejected
MIN_SIGHTINGS_PER_MARKER = 5         # number of sightings, of which the majority must be accepted
# By group of the calibration: its name in a sentence, and what to look at.
GROUPS = {
    "wheel-parameters": ("the wheels", "Measure them, or state larger sigmas in vehicle.toml."),
    "camera-offset": ("the place of the camera", "Measure it from midway between the wheels, and "
                      "state it in vehicle.toml."),
    "marker-size": ("the size of the markers", "Measure a printed marker, and state its size in "
                    "vehicle.toml. Wheels that are all off by one factor look the same."),
    "time-offset": ("a delay of the sightings", "Look at the pose ids of ArucoReading.txt, and "
                    "whether rows are missing in encoderReading.txt."),
    "tag-offset": ("the place of the UWB tag", "Measure it from midway between the wheels, and "
                   "state it in vehicle.toml."),
    "antenna-height": ("the height of the antennas", "Measure it over the tag, and state it in "
                       "vehicle.toml."),
    "range-offset": ("offset and scale of the ranges", "Calibrate the antennas, and state both in "
                     "vehicle.toml."),
    "range-delay": ("a delay of the ranges", "Look at the pose ids of UwbReading.txt."),
    "antenna-offsets": ("an offset of each antenna", "Calibrate the antennas, and look for walls "
                        "before them.")}


def solution_doubts(result):
    """Tuple of Doubt where a SlamResult contradicts the files of its drive."""
    doubts = [Doubt("antenna", f"Antenna {antenna} is in doubt: {reason}. Its covariance includes "
                               "this; look at its rows in UwbReading.txt.")
              for antenna, reason in result.doubts.items()]
    if not result.converged:
        doubts.append(Doubt("not-converged", (
            "The solution still changed when its number of steps ended: some poses or landmarks "
            "may be far from where the measurements want them.")))
    return tuple(sum((f(result) for f in (calibration_doubts, slip_doubts, noise_doubts,
                                          sighting_doubts, turn_doubts)), []) + doubts)


def calibration_doubts(result):
    """List of a Doubt for each group of the calibration that decidedly left its stated values.

    Of groups that the drive cannot tell apart there is one Doubt, about the one that is furthest
    from what is stated. Groups that are released without a decision only make the covariances
    larger.
    """
    common = frozenset.intersection(*result.explanations)
    either = frozenset().union(*result.explanations) - common
    rows = [row for row in result.calibration_table if row["group"] in common | either]
    distance = {group: max(abs(row["estimate"] - row["stated"]) / row["sigma"]
                           for row in rows if row["group"] == group) for group in either}
    furthest = {max(distance, key=distance.get)} if either else set()
    problem, doubts = "problem 4" if len(result.antenna) else "problem 3", []
    for group in (group for group in GROUPS if group in common | furthest):
        numbers = " and ".join(
            f"{row['name']} = {row['estimate']:.4g} ± {row['sigma']:.2g} {row['unit']}".rstrip()
            + f" (stated: {row['stated']:.4g}"
            + (f" ± {row['stated_sigma']:.2g})" if row["stated_sigma"] else ")")
            for row in rows if row["group"] == group)
        others = " or ".join(GROUPS[other][0] for other in GROUPS if other in either - {group})
        instead = f" It may instead be {others}: the drive cannot tell, and the covariances " \
            "include it." if group in furthest else ""
        doubts.append(Doubt(group, f"By the drive {numbers}; {problem} uses this.{instead} "
                                   f"{GROUPS[group][1]}"))
    return doubts


def turn_doubts(result):
    """List of a Doubt if odometry does not determine the number of turns between two frames."""
    frame, sigma = result.sightings.frame, result.turn_sigma
    if not len(sigma) or sigma.max() < MAX_TURN_SIGMA:
        return []
    k = int(sigma.argmax())
    return [Doubt("turns", (
        f"Between poses {frame[k] + 1} and {frame[k + 1] + 1} only the wheels were measured, and "
        f"they know the turn between them to {sigma[k]:.1f} rad (one standard deviation): whole "
        "turns may be missing in the solution, and with them the path between these poses is "
        "wrong."))]


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


def sighting_doubts(result):
    """List of a Doubt if many sightings are rejected, or the majority of a marker."""
    sentences, rejected, repeated = [], result.rejected, result.sightings.contradicting
    left_out, count = rejected.sum() + repeated, len(rejected) + repeated
    if left_out > MAX_REJECTED * count:
        sentences.append(f"{left_out} of {count} sightings contradict the rest and are left out"
                         + (f", {repeated} of them another one of the same marker at the same pose"
                            if repeated else ""))
    marker, row = np.unique(result.sightings.marker, return_inverse=True)
    seen, wrong = (np.bincount(row, weight, len(marker)) for weight in (None, rejected))
    markers = marker[(seen >= MIN_SIGHTINGS_PER_MARKER) & (wrong > seen / 2)].tolist()
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
