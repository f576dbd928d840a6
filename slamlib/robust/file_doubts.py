"""Doubts about the files of a drive, from measurements compared with each other before solving.

Markers and wheels both measure increments [x, y, heading] of the vehicle. Wrong axes or signs of
one of them change these to [A (x, y), det(A) heading], A one of the eight symmetries of a square.
Exchanged wheels and a camera mirrored in y and theta have the same A; one wheel that is reversed
has none. Wrong units show in ratios of lengths.
"""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from slamlib.core import odometry
from slamlib.core.marker_increments import distance_and_turn
from slamlib.core.records import Dataset
from slamlib.robust.part_faults import (
    AXES,
    MIN_AGREEING_SHARE,
    MIN_COUNT,
    contradictions,
    moving_increments,
    other_axes,
    with_counts_mended,
    with_headings_reversed,
    with_other_axes,
    with_sightings_inverted,
    without_wrong_counts,
    wrong_counts,
)

MIN_RANGES_PER_ANTENNA = 4
MIN_UNIT_SHARE = 0.9      # of the increments that one factor explains
MAX_FACTOR = 5.0          # ratio of lengths from which on the unit is in doubt
MAX_ODOMETRY_HEADING_SIGMA = 0.1   # rad, at the end of the path that is compared with ranges
# Ratio of the distance of the ranges' quartiles to the path's sigma; 1 is usual
MIN_SPREAD = 0.027
MAX_SPREAD = 4.7
MIN_DIFFERENT_COUNTS = 8  # from which on a common divisor says that counts were cut off
# Kinds of doubts from which most others follow
DECISIVE = ("encoder-dead", "wheels-swapped", "wheels-reversed", "camera-mirrored", "camera-turned",
            "sightings-inverted", "odometry", "units")
# What [x, y] is with each of AXES, and by number of COUNT_CHANGES the kind of doubt and the change.
AXES_NAMES = ("x, y", "x, -y", "-x, y", "-x, -y", "y, x", "-y, x", "y, -x", "-y, -x")
COUNTS = {1: ("wheels-swapped", "the columns exchanged"),
          2: ("wheels-reversed", "both signs reversed"),
          3: ("wheels-reversed", "both signs reversed and the columns exchanged"),
          8: ("wheels-reversed", "the sign of the right wheel reversed"),
          9: ("wheels-reversed", "the sign of the right wheel reversed and the columns exchanged"),
          10: ("wheels-reversed", "the sign of the left wheel reversed"),
          11: ("wheels-reversed", "the sign of the left wheel reversed and the columns exchanged")}


@dataclass(frozen=True)
class Doubt:
    """A possible error in the files of a drive, for the user to check."""

    what: str           # its kind in kebab case ("wheels-swapped"), for programs
    sentence: str       # the finding, with its evidence
    advice: str = ""    # what to check, in which file


def doubts_before_solving(dataset: Dataset) -> list[Doubt]:
    """List of Doubts about the files of a Dataset, where enough is known."""
    doubts = []
    for check in (motion_doubts, range_units, cut_counts, single_rows):
        with suppress(np.linalg.LinAlgError):              # where increments have no covariance
            doubts += list(check(dataset))
        if any(doubt.what == "encoder-dead" for doubt in doubts):
            break                                          # the others need the path by odometry
    return doubts


def merged(doubts: Iterable[Doubt]) -> list[Doubt]:
    """List of Doubt, each kind once with its last sentence; antennas and units by sentence.

    Where files contradict each other decisively, all else is named in one Doubt, as what may follow
    from it.
    """
    last = {}
    for doubt in doubts:
        key = doubt.sentence if doubt.what in ("antenna", "units") else doubt.what
        last[key] = doubt
    causes = []
    others = []
    for doubt in last.values():
        same = causes if doubt.what in DECISIVE else others
        same.append(doubt)
    if not causes or not others:
        return causes + others
    named = ", ".join(dict.fromkeys(doubt.what for doubt in others))
    return [*causes, Doubt(
        "consequences", f"What else contradicts the solutions may follow from this: {named}.",
        "Mend the files first.")]


def motion_doubts(dataset: Dataset) -> list[Doubt]:
    """List of Doubts about dead wheels, else about axes, else about units or drives."""
    dataset = without_wrong_counts(dataset)
    markers, wheels, sigma, poses = moving_increments(dataset)
    if len(wheels) < MIN_COUNT:
        return []
    with_both_signs = np.stack([markers, with_headings_reversed(dataset)])
    off = contradictions(with_both_signs, with_other_axes(dataset, wheels, poses), sigma)
    off[len(AXES):, 1] = np.inf                # either one wheel is reversed or theta, not both
    dead = ~dataset.ticks.any(axis=0)
    if dead.any() and np.mean(off[0, 0] < 1) < MIN_AGREEING_SHARE:
        return [_dead_doubt(dead)]
    stretch = other_axes(off, poses)
    if stretch is not None:
        return [_axes_doubt(stretch, stretch.is_mended(len(dataset.ticks)))]
    stated = np.mean(off[0, 0] < 1)
    if stated > 0.5:
        return []
    inverted = np.mean(contradictions(with_sightings_inverted(dataset), wheels, sigma) < 1)
    if inverted > MIN_AGREEING_SHARE:
        return [_inverted_doubt(stated, inverted)]
    return list(wrong_sizes(markers, wheels, sigma))


def _dead_doubt(dead):
    """The Doubt on wheels, right and left, that are `dead` (2,): all their counts are 0."""
    wheels = " and the ".join(np.array(["right", "left"])[dead])
    return Doubt("encoder-dead", (
        f"All counts of the {wheels} wheel in encoderReading.txt are 0, and the markers say that "
        "the vehicle moved otherwise. Only problem 2 from markers alone does without them."),
        "Look at the encoder, and at the columns of the file.")


def _inverted_doubt(stated, inverted):
    """The Doubt on sightings that are the vehicle in the marker, by shares that agree."""
    return Doubt("sightings-inverted", (
        f"Increments of the vehicle by markers and by wheels agree at {stated:.0%} of the places, "
        f"and at {inverted:.0%} if ArucoReading.txt has the vehicle as the marker sees it in place "
        "of the marker as the vehicle does."), (
        "Look at the frame of x, y and theta in ArucoReading.txt, and invert the poses."))


def _axes_doubt(stretch, is_mended):
    """The Doubt on OtherAxes, which may be mended for the solutions."""
    k = stretch.axes
    changes = []
    if k < len(AXES):
        is_mirror = np.linalg.det(AXES[k]) < 0
        heading = "-theta" if is_mirror != stretch.is_reversed else "theta"
        changes.append(f"sightings with [{AXES_NAMES[k]}, {heading}] in place of [x, y, theta] in "
                       "ArucoReading.txt")
        what = "camera-mirrored" if is_mirror or stretch.is_reversed else "camera-turned"
    if k in COUNTS and not stretch.is_reversed:
        what, change_of_counts = COUNTS[k]
        changes.insert(0, f"{change_of_counts} in encoderReading.txt")
    sentence = (f"Between poses {stretch.first + 1} and {stretch.last + 1}, increments of the "
                f"vehicle by markers and by wheels agree at {stretch.stated.mean():.0%} of "
                f"{len(stretch.stated)} places, and at {stretch.agreeing.mean():.0%} with "
                f"{', or as well with '.join(changes)}.")
    if is_mended:
        sentence += " Problem 2's fusion and problems 3 and 4 use the counts changed so."
    return Doubt(what, sentence, (
        "Look at the order of right and left and at the signs in encoderReading.txt, and at the "
        "axes of the camera."))


def wrong_sizes(markers: np.ndarray, wheels: np.ndarray,
                sigma: np.ndarray) -> Iterator[Doubt]:
    """Doubt, if increments (n, 3) by markers and wheels, of which most disagree, do so in size.

    They are of other units if they agree where those by wheels are multiplied by one factor in
    length and one in turn, else of other drives. A camera that is turned changes neither length nor
    turn. `sigma` (n, 2) is that of lengths and turns by markers.
    """
    agree = contradictions(markers, wheels, sigma) < 1
    sizes = [distance_and_turn(each) for each in (markers, wheels)]
    by_markers, by_wheels = np.median(sizes, axis=1)
    of_markers, of_wheels = [_along_x(each) for each in (markers, wheels)]
    agree_in_size = contradictions(of_markers, of_wheels, sigma) < 1
    if agree_in_size.mean() > MIN_AGREEING_SHARE:
        return
    sentence = (f"Between the same poses the vehicle moves by {by_markers[0]:.4g} m and turns by "
                f"{by_markers[1]:.4g} rad by the markers, and by {by_wheels[0]:.4g} m and "
                f"{by_wheels[1]:.4g} rad by the wheels (medians); they agree at "
                f"{agree.mean():.0%} of {len(agree)} places")
    factor = by_markers / np.maximum(by_wheels, 1e-9)
    scaled = contradictions(of_markers, factor[[0, 0, 1]] * of_wheels, sigma) < 1
    if scaled.mean() > MIN_UNIT_SHARE:
        yield Doubt("units", (
            f"{sentence}, and at {scaled.mean():.0%} with {factor[0]:.3g} times the length and "
            f"{factor[1]:.3g} times the turn by the wheels."), (
            "Look at the units of x and y in ArucoReading.txt (metres), of the radii (metres) and "
            "ticks_per_revolution, and of the wheelbase in vehicle.toml (metres)."))
    else:
        yield Doubt("odometry", f"{sentence}.", (
            "Look whether encoderReading.txt and ArucoReading.txt are of the same drive and count "
            "the same poses."))


def _along_x(increments):
    """Increments (n, 3) of the same length and turn, straight ahead."""
    length = np.linalg.norm(increments[:, :2], axis=1)
    return np.column_stack([length, np.zeros(len(length)), increments[:, 2]])


def range_units(dataset: Dataset) -> Iterator[Doubt]:
    """Doubt, if ranges do not fit the size of odometry's path, or the guesses.

    Of the path while its heading is known, with its wheels mended, and of antennas with
    MIN_RANGES_PER_ANTENNA on it.
    """
    dataset = with_counts_mended(dataset)
    guesses = dataset.antenna_guess
    if dataset.uwb is None or guesses is None:
        return
    path = _certain_path(dataset)
    heard = dataset.uwb.select(dataset.uwb.pose < len(path))
    sizes = []
    for antenna, guess in zip(guesses.antenna, guesses.position):
        own = heard.select(heard.antenna == antenna)
        if len(own.range) >= MIN_RANGES_PER_ANTENNA:
            lower, typical, upper = np.percentile(own.range, [25, 50, 75])
            distances = np.linalg.norm(path[own.pose] - guess, axis=1)
            sizes.append([upper - lower, typical, np.median(distances)])
    if len(heard.range) < MIN_COUNT or not sizes or not path.any():
        return
    spread, typical, distance = np.median(sizes, axis=0)
    extent = np.linalg.norm(path.std(axis=0))
    noise = 3 * np.median(dataset.uwb.sigma)
    fits = MIN_SPREAD * extent <= spread <= MAX_SPREAD * extent + noise
    if not fits or max(typical, distance) > MAX_FACTOR * min(typical, distance):
        yield Doubt("units", (
            f"The ranges to an antenna have the median {typical:.4g} m and quartiles "
            f"{spread:.4g} m apart; the path by the wheels spreads by {extent:.4g} m, and its "
            f"median distance to the guess is {distance:.4g} m."), (
            "Look at the units of UwbReading.txt, UwbAntennaGuess.txt and of the radii in "
            "vehicle.toml (metres), and at the columns of UwbReading.txt."))


def _certain_path(dataset):
    """Positions (n, 2) by odometry, as long as their heading is known."""
    poses, covariances = odometry.first_order(dataset.ticks, dataset.vehicle, model="arc")
    uncertain = covariances[:, 2, 2] > MAX_ODOMETRY_HEADING_SIGMA**2
    return poses[np.cumsum(uncertain) == 0, :2]


def cut_counts(dataset: Dataset) -> Iterator[Doubt]:
    """Doubt, if counts have a common divisor."""
    divisor = common_divisor(dataset.ticks)
    if divisor > 1:
        yield Doubt("encoder-counts", (
            f"All counts of encoderReading.txt are multiples of {divisor}. If the rest of each row "
            "was cut off, every distance by the wheels is too short, by an unknown factor."), (
            "Look at how the counts were read, and at ticks_per_revolution in vehicle.toml."))


def single_rows(dataset: Dataset) -> Iterator[Doubt]:
    """Doubt, if there are `wrong_counts`."""
    wrong = wrong_counts(dataset)
    rows = np.flatnonzero((2 * np.abs(wrong) > np.abs(dataset.ticks - wrong)).any(axis=1))
    if len(rows):
        yield Doubt("encoder-rows", (
            f"In {len(rows)} of {len(wrong)} rows of encoderReading.txt, the first at pose "
            f"{rows[0] + 1}, counts are lost, late or doubled, as far as the rows around or "
            "the markers tell. Problem 2's fusion and problems 3 and 4 assume that the wheels go "
            "on as in the rows around."),
            "Look at how the counts were read, and whether the vehicle stops for single rows.")


def common_divisor(ticks: np.ndarray) -> int:
    """Greatest common divisor of counts (n, 2), of fractions or a few different counts 1."""
    whole = np.rint(ticks).astype(int)
    if not np.array_equal(whole, ticks):
        return 1
    divisor = int(np.gcd.reduce(whole, axis=None))
    if divisor > 1 and len(np.unique(np.abs(whole))) < MIN_DIFFERENT_COUNTS:
        return 1
    return divisor
