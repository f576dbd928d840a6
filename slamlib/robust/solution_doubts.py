"""Doubts where the solution of problem 3 or 4, a SlamResult, contradicts what the files state."""

from functools import reduce
from itertools import chain

import numpy as np

from slamlib.core import se2
from slamlib.robust.file_doubts import Doubt
from slamlib.robust.jumps import UNKNOWN_SIGMA
from slamlib.robust.noise import BOUNDS

MAX_TURN_SIGMA = np.pi / 3   # rad, between two frames; half a turn is three sigmas
MAX_GAP = 30                 # poses, between contradictions that are told as one
MAX_SLIP = 0.02              # sqrt(m), of wheels on the ground
MAX_LATE_SHARE = 0.1         # share of the ranges that keep less than half of their weight
MAX_NOISE_FACTOR = 1.5       # on a sigma, or its inverse; beyond it the factor is reported
MIN_FACTOR_SIGMAS = 4.0      # sigmas of the logarithm of a factor that is reported
MAX_REJECTED = 0.1           # share of the sightings that are rejected
MIN_REJECTED_OF_MARKER, MAX_REJECTED_OF_MARKER = 5, 0.2      # number, and share of its sightings
MAX_MARKERS_NAMED = 8        # of those with most rejected sightings
MAX_DISAGREEMENT = 0.1       # sigmas of a pose, and relative of a sigma, by engine and GTSAM
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
    return tuple(Doubt(*each) for each in chain(
        _of_encoder(result), _of_calibration(result), _of_noise(result),
        _of_sightings(result), _of_the_path(result), _of_agreement(result),
        (("antenna", f"Antenna {antenna} is in doubt: {reason}. Look at its rows in UwbReading.txt.")
         for antenna, reason in result.doubts.items())))


def _of_calibration(result):
    """Kind and sentence on each group of the calibration that decidedly left its stated values.

    Of groups that the drive cannot tell apart, on that which is furthest from what is stated.
    """
    common = frozenset.intersection(*result.explanations)
    either = frozenset().union(*result.explanations) - common
    rows = [row for row in result.calibration_table if row["group"] in common | either]
    distance = {group: max(abs(row["estimate"] - row["stated"]) / row["sigma"]
                           for row in rows if row["group"] == group) for group in either}
    furthest = max(distance, key=distance.get, default=None)
    for group in (group for group in GROUPS if group in common | {furthest}):
        numbers = " and ".join(
            f"{row['name']} = {row['estimate']:.4g} ± {row['sigma']:.2g} {row['unit']}".rstrip()
            + f" (stated: {row['stated']:.4g}"
            + (f" ± {row['stated_sigma']:.2g})" if row["stated_sigma"] else ")")
            for row in rows if row["group"] == group)
        others = " or ".join(GROUPS[other][0] for other in GROUPS if other in either - {group})
        instead = f" It may instead be {others}: the drive cannot tell, and the covariances " \
            "include it." if group == furthest else ""
        yield group, (f"By the drive {numbers}; problem {3 + bool(len(result.antenna))} uses this."
                      f"{instead} {GROUPS[group][1]}")


def _of_encoder(result):
    """Kind and sentence if the markers contradict the counts, by stretches of the drive."""
    jumps, sentences = result.jumps, []
    if not len(jumps.start):
        return
    gaps = jumps.start[1:] - jumps.end[:-1]
    for group in np.split(np.arange(len(gaps) + 1), np.flatnonzero(gaps > MAX_GAP) + 1):
        ends = [reduce(se2.compose, each[group]) for each in (jumps.increment, jumps.by_odometry)]
        by_markers, by_counts, off = (
            f"{np.hypot(*end[:2]):.2f} m and {abs(np.degrees(se2.wrap(end[2]))):.0f} degrees"
            for end in (*ends, se2.between(*ends)))
        told = f"the markers say {by_markers}, which ends {off} from there" \
            if (jumps.sigma[group] < UNKNOWN_SIGMA).all() else "all markers change at once"
        sentences.append(f"between poses {jumps.start[group[0]] + 1} and "
                         f"{jumps.end[group[-1]] + 1} the vehicle moved by {by_counts}, but {told}")
    more = f"; and {len(sentences) - 3} more times" if len(sentences) > 3 else ""
    yield "encoder", "In encoderReading.txt, " + "; ".join(sentences[:3]) + more + (
        ". Problem 2's fusion and problems 3 and 4 do without these counts. Look at the rows, and "
        "whether the vehicle was pushed or carried.")


def _of_noise(result):
    """Kinds and sentences on errors with memory, and on learned factors that are not 1."""
    late_share = np.mean(result.range_weight < 0.5) if len(result.range_weight) else 0.0
    for column, what, name, file in ((1, "marker-noise", "sightings", "ArucoReading.txt"),
                                     (2, "range-noise", "ranges", "UwbReading.txt")):
        factor, sigma = getattr(result.noise, name), result.noise_sigma[column]
        share = np.split(result.share, [len(result.rejected)])[column - 1]
        if (share < 1).any():
            yield what.replace("noise", "memory"), (
                f"Errors of successive {name} are alike: the correlation of their residuals is "
                f"{result.correlation[column - 1]:.2f}. So problems 3 and 4 count {len(share)} "
                f"{name} as {share.sum():.0f}, with {factor:.2g} times the standard deviations in "
                f"{file}, because residuals do not show all of such errors. Look at the "
                "calibration of the sensor, and for what blurs, hides or reflects.")
            continue
        if not sigma or abs(np.log(factor)) <= max(
                np.log(MAX_NOISE_FACTOR), MIN_FACTOR_SIGMAS * sigma):
            continue
        outside = (np.log(result.noise)[column] - BOUNDS[:, column]) * [1, -1] < sigma
        number = f"at most {factor:.2g}" if outside[0] else \
            f"at least {factor:.3g}" if outside[1] else f"{factor:.2f} ± {factor * sigma:.2f}"
        reason = (f"{late_share:.0%} of them are far too long, as without line of sight."
                  if name == "ranges" and late_share > MAX_LATE_SHARE else
                  "Look at how the sensor's covariances were obtained.")
        yield what, (f"The {name} scatter {number} times as much as {file} states: problems 3 and "
                     f"4 use the scatter that was found, the others the file's. {reason}")


def _of_sightings(result):
    """Kinds and sentences on ids of several places, and on sightings that are rejected."""
    if result.places is not None:
        ids, places = result.places[result.places[:, 0] != result.places[:, 1]].T
        yield "places", (
            f"By the path between their sightings, markers {', '.join(map(str, np.unique(ids)))} "
            "were seen at more than one place: problems 3 and 4 have the others as markers "
            f"{', '.join(map(str, np.unique(places)))}. Look for ids that are used twice, for "
            "markers that were moved, and whether the vehicle was carried where it saw none.")
    rejected, repeated = result.rejected, result.sightings.contradicting
    left_out, count = rejected.sum() + repeated, len(rejected) + repeated
    marker, row, seen = np.unique(
        result.sightings.marker, return_inverse=True, return_counts=True)
    wrong = np.bincount(row, rejected, len(marker)).astype(int)
    named = np.flatnonzero((wrong >= MIN_REJECTED_OF_MARKER)
                           & (wrong > MAX_REJECTED_OF_MARKER * seen))
    if left_out <= MAX_REJECTED * count and not len(named):
        return
    worst = named[np.argsort(-wrong[named] / seen[named], kind="stable")][:MAX_MARKERS_NAMED]
    yield "sightings-rejected", (
        f"{left_out} of {count} sightings contradict the rest and are left out"
        + "".join(f", of marker {marker[k]} {wrong[k]} of {seen[k]}" for k in sorted(worst))
        + f", {repeated} by another one of the same marker at the same pose" * bool(repeated)
        + ": look at the marker ids in ArucoReading.txt, for markers that were moved or are there "
        "twice, and for lost counts in encoderReading.txt.")


def _of_the_path(result):
    """Kinds and sentences on slip, turns between frames, and a solution that still changed."""
    if result.slip > MAX_SLIP and result.noise_sigma[0]:
        yield "wheel-slip", (
            f"By the other sensors each wheel slips by {1e3 * result.slip:.0f} mm (one standard "
            "deviation) after one metre, far more than wheels do: look whether encoderReading.txt "
            "is of the same drive as the other files, with the same pose ids.")
    frame, sigma = result.sightings.frame, result.turn_sigma
    if sigma.max(initial=0) >= MAX_TURN_SIGMA:
        k = int(sigma.argmax())
        yield "turns", (
            f"Between poses {frame[k] + 1} and {frame[k + 1] + 1} only the wheels were measured, "
            f"and they know the turn between them to {sigma[k]:.1f} rad (one standard deviation): "
            "whole turns may be missing in the solution, and with them the path between these "
            "poses is wrong.")
    if not result.converged:
        yield "not-converged", (
            "The solution still changed when its number of steps ended: some poses or landmarks "
            "may be far from where the measurements want them.")


def _of_agreement(result):
    """Kind and sentence if GTSAM's solution is not that by which the engine decided."""
    off, ratio = result.agreement
    if max(off, ratio) > MAX_DISAGREEMENT:
        yield "agreement", (
            f"GTSAM's solution differs by up to {off:.2g} standard deviations from that by which "
            f"noise and outliers were decided, and its standard deviations by up to {ratio:.0%}: "
            "what was decided may not fit it.")
