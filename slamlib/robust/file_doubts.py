"""Doubts about the files of a drive, from measurements compared with each other before solving.

Markers and wheels both measure increments [x, y, heading] of the vehicle. Wrong axes or signs of
one of them change these to [A (x, y), det(A) heading], A one of the eight symmetries of a square.
Exchanged wheels and a camera mirrored in y and theta have the same A. Wrong units show in ratios of
lengths, and of stated standard deviations to the scatter of measurements.
"""

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.marker_increments import (
    common_sightings,
    distance_and_turn,
    distance_and_turn_sigmas,
    robust_increments,
)
from slamlib.core.records import Dataset
from slamlib.core.sightings import sightings_by_frame

MIN_COUNT = 10            # measurements for a decision
MIN_RANGES_PER_ANTENNA = 4
SPAN = 1.0                # m, over which increments are compared
OVERLAP = 4               # number of increments at each place, at least
MAX_FRAMES = 20           # over which increments are compared
MIN_MOTION_SIGMAS = 5.0   # sigmas by markers of distance or turn, from which on the vehicle moves
# Markers and wheels agree within the sum of these
AGREEMENT_RATIO = 0.1     # of an increment
AGREEMENT_SIGMAS = 3.0    # sigmas of the increment by markers
MIN_AGREEING_SHARE = 0.7  # of the increments with an accepted A
MIN_GAIN_SIGMAS = 2.5     # sigmas of the number of increments that agree in addition
MIN_SPANS = 3.0           # of increments, that a stretch is longer; one jump spoils two
FINER = 20                # times, in which the search for the ends of a stretch becomes finer
MAX_STRETCH = 0.5         # of the drive, in which wheels are exchanged; else the camera may be
MAX_FACTOR = 5.0          # ratio of lengths from which on the unit is in doubt
MAX_SIGMA_RATIO = 15.0    # of a stated standard deviation to the scatter; in degrees it is 57
MAX_ODOMETRY_HEADING_SIGMA = 0.1   # rad, at the end of the path that is compared with ranges
# Ratio of the distance of the ranges' quartiles to the path's sigma; 1 is usual
MIN_SPREAD = 0.027
MAX_SPREAD = 4.7
SECOND_DIFFERENCE = 0.6745 * 6**0.5      # median size, of independent errors of sigma 1
MIN_DIFFERENT_COUNTS = 8  # from which on a common divisor says that counts were cut off
# Kinds of doubts from which most others follow
DECISIVE = ("wheels-swapped", "wheels-reversed", "camera-mirrored", "camera-turned", "odometry",
            "units")
# The matrices A, what [x, y] is with each, and by their number the kind of doubt and the change of
# the counts with the same effect.
AXES = np.array([np.diag(signs) @ order for order in (np.eye(2), np.eye(2)[::-1])
                 for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1))])
AXES_NAMES = ("x, y", "x, -y", "-x, y", "-x, -y", "y, x", "-y, x", "y, -x", "-y, -x")
COUNTS = {1: ("wheels-swapped", "the columns exchanged"),
          2: ("wheels-reversed", "both signs reversed"),
          3: ("wheels-reversed", "both signs reversed and the columns exchanged")}
# By number of AXES: increments (n, 3) by wheels @ MOTIONS are (8, 1, n, 3) with these axes.
MOTIONS = np.zeros((8, 1, 3, 3))
MOTIONS[:, 0, :2, :2] = AXES.mT
MOTIONS[:, 0, 2, 2] = np.linalg.det(AXES)
EXCHANGED = (1, 3)
REVERSED = (2, 3)


@dataclass(frozen=True)
class Doubt:
    """A possible error in the files of a drive, for the user to check."""

    what: str           # its kind in kebab case ("wheels-swapped"), for programs
    sentence: str       # the finding, with its evidence
    advice: str = ""    # what to check, in which file


def doubts_before_solving(dataset: Dataset) -> list[Doubt]:
    """List of Doubts about the files of a Dataset, where enough is known."""
    doubts = []
    for check in (motion_doubts, range_units, sigma_units, cut_counts):
        with suppress(np.linalg.LinAlgError):              # where increments have no covariance
            doubts += list(check(dataset))
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
    """List of Doubts about axes, else about units or drives."""
    markers, wheels, sigma, poses = moving_increments(dataset)
    if len(wheels) < MIN_COUNT:
        return []
    off = contradictions(markers, wheels @ MOTIONS, sigma)
    stretch = other_axes(off, poses)
    if stretch is not None:
        return [_axes_doubt(stretch, stretch.is_mended(len(dataset.ticks)))]
    return list(wrong_sizes(markers[0], wheels, sigma, off[0, 0] < 1))


def with_wheels_mended(dataset: Dataset) -> Dataset:
    """The Dataset with its counts mended in a stretch in which wheels are exchanged or reversed.

    It is as it was where that is most of the drive: then the camera may as well have other axes. Of
    all ends of the stretch nearby, the increments agree best with the one that is chosen.
    """
    markers, wheels, sigma, poses = moving_increments(dataset, signs=[1])
    if len(wheels) < MIN_COUNT:
        return dataset
    stretch = other_axes(contradictions(markers, wheels @ MOTIONS, sigma), poses)
    if stretch is None or not stretch.is_mended(len(dataset.ticks)):
        return dataset

    def cost(mended):
        """What still contradicts the markers."""
        path = odometry.dead_reckoning(mended.ticks, mended.vehicle, model="arc")
        by_wheels = se2.between(path[poses[:, 0]], path[poses[:, 1]])
        return _limited(contradictions(markers[0], by_wheels, sigma)).sum()

    first = stretch.first
    last = stretch.last
    reach = 2 * int(np.median(np.diff(poses)))
    for _ in range(2):
        near = np.arange(-reach, reach + 1, max(1, reach // FINER))
        first = min(first + near, key=lambda pose: cost(stretch.mended(dataset, pose, last)))
        later = last + near[::-1]                # of equal ones the last: nothing tells at the end
        last = min(later, key=lambda pose: cost(stretch.mended(dataset, first, pose)))
        reach //= FINER
    return stretch.mended(dataset, first, last)


def contradictions(markers: np.ndarray, wheels: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Differences (..., n) of increments (..., n, 3) by markers and by wheels; they agree below 1.

    `sigma` (n, 2) is that of distance and turn by markers.
    """
    size = np.maximum(_size(markers), _size(wheels))
    tolerance = AGREEMENT_RATIO * size + AGREEMENT_SIGMAS * np.linalg.norm(sigma, axis=1)
    return _size(markers - wheels) / tolerance


def _limited(off):
    """The `contradictions`, at most 1, as where markers tell no increment."""
    return np.where(off < 1, off, 1.0)


def _size(increment):
    """Root of the squares of distance in m and turn in rad, (...), of increments (..., 3)."""
    return np.linalg.norm(distance_and_turn(increment), axis=-1)


def moving_increments(
        dataset: Dataset, signs: Sequence[int] = (1, -1)
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Increments of the moving vehicle between n pairs of frames about SPAN apart.

    Returns those by markers (len(signs), n, 3), with theta multiplied by each of the `signs`, by
    wheels (n, 3), the standard deviations of distance and turn by markers (n, 2), and the encoder
    poses of each pair of frames (n, 2), from 0.
    """
    s = sightings_by_frame(dataset.sightings)
    path = odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc")[s.frame]
    span = _span(path)
    wheels = se2.between(path[:-span], path[span:])
    common = np.array(common_sightings(s.row, s.marker, span))
    overlapping = common[:, common[0] % max(1, span // OVERLAP) == 0]
    by_markers = []
    for sign in signs:
        mirror = np.diag([1.0, 1.0, sign])
        by_markers.append(robust_increments(
            s.z @ mirror, mirror @ s.C @ mirror, *overlapping, len(wheels)))
    stated = by_markers[0]
    sigma = distance_and_turn_sigmas(stated.covariance)
    size = np.maximum(distance_and_turn(stated.increment), distance_and_turn(wheels))
    moving = stated.usable & (size > MIN_MOTION_SIGMAS * sigma).any(axis=1)
    markers = np.stack([found.increment for found in by_markers])
    poses = np.column_stack([s.frame[:-span], s.frame[span:]])
    return markers[:, moving], wheels[moving], sigma[moving], poses[moving]


def _span(path):
    """Number of frames over SPAN by the path (f, 3): MAX_FRAMES or a quarter of all at most."""
    if len(path) < 2:
        return 1
    step = np.linalg.norm(np.diff(path[:, :2], axis=0), axis=1)
    frames = SPAN / max(np.median(step), SPAN / MAX_FRAMES)
    return max(1, min(int(frames + 0.5), len(path) // 4))


class OtherAxes(NamedTuple):
    """A stretch of a drive in which markers and wheels agree with other axes or signs."""

    axes: int                # row of AXES
    is_reversed: bool        # whether theta is, too
    first: int               # encoder pose, from 0, at which it begins
    last: int                # at which it ends
    stated: np.ndarray       # (m,) bool, which increments agree as stated
    agreeing: np.ndarray     # (m,) bool, which agree with these axes

    def is_mended(self, count: int) -> bool:
        """Whether counts have the same effect, in less than half of the `count` poses."""
        is_by_counts = self.axes in COUNTS and not self.is_reversed
        return is_by_counts and self.last - self.first < MAX_STRETCH * count

    def mended(self, dataset: Dataset, first: int, last: int) -> Dataset:
        """The Dataset with counts of these axes from the pose `first` to the pose `last`."""
        ticks = dataset.ticks.copy()
        rows = slice(max(first, 0) + 1, last + 1)
        if self.axes in EXCHANGED:
            ticks[rows] = ticks[rows, ::-1]
        if self.axes in REVERSED:
            ticks[rows] = -ticks[rows]
        return replace(dataset, ticks=ticks)


def other_axes(off: np.ndarray, poses: np.ndarray) -> OtherAxes | None:
    """OtherAxes, if significantly more increments agree with them; the stretch may be the drive.

    `off` (8, k, n) are the `contradictions` by AXES, for theta as stated and then reversed, of
    increments between these encoder poses (n, 2). In the stretch they are less by most in all.
    """
    agree = off < 1
    limited = _limited(off)
    gained = limited[0, 0] - limited
    total = np.insert(np.cumsum(gained, axis=2), 0, 0, axis=2)
    rise = total - np.minimum.accumulate(total, axis=2)
    k, is_reversed, end = np.unravel_index(rise.argmax(), rise.shape)
    begin = total[k, is_reversed, :end + 1].argmin()
    if end == 0 or np.ptp(poses[begin:end]) <= MIN_SPANS * np.median(np.diff(poses)):
        return None
    stated = agree[0, 0, begin:end]
    agreeing = agree[k, is_reversed, begin:end]
    gain = agreeing.sum() - stated.sum()
    gain_sigma = np.sum(agreeing != stated)**0.5
    if agreeing.mean() < MIN_AGREEING_SHARE or gain <= MIN_GAIN_SIGMAS * gain_sigma:
        return None
    return OtherAxes(int(k), bool(is_reversed), poses[begin, 0], poses[end - 1, 1], stated,
                     agreeing)


def _axes_doubt(stretch, is_mended):
    """The Doubt on OtherAxes, which may be mended for the solutions."""
    k = stretch.axes
    is_mirror = np.linalg.det(AXES[k]) < 0
    heading = "-theta" if is_mirror != stretch.is_reversed else "theta"
    change = (f"sightings with [{AXES_NAMES[k]}, {heading}] in place of [x, y, theta] in "
              "ArucoReading.txt")
    what = "camera-mirrored" if is_mirror or stretch.is_reversed else "camera-turned"
    if k in COUNTS and not stretch.is_reversed:
        what, change_of_counts = COUNTS[k]
        change = f"{change_of_counts} in encoderReading.txt, or as well with {change}"
    sentence = (f"Between poses {stretch.first + 1} and {stretch.last + 1}, increments of the "
                f"vehicle by markers and by wheels agree at {stretch.stated.mean():.0%} of "
                f"{len(stretch.stated)} places, and at {stretch.agreeing.mean():.0%} with "
                f"{change}.")
    if is_mended:
        sentence += " Problem 2's fusion and problems 3 and 4 use the counts changed so."
    return Doubt(what, sentence, (
        "Look at the order of right and left and at the signs in encoderReading.txt, and at the "
        "axes of the camera."))


def wrong_sizes(markers: np.ndarray, wheels: np.ndarray, sigma: np.ndarray,
                agree: np.ndarray) -> Iterator[Doubt]:
    """Doubt, if increments (n, 3) by markers and wheels are of other units or drives.

    Of other units if the medians of length or turn differ by MAX_FACTOR, of other drives if most
    increments do not agree, `agree` (n,). `sigma` (n, 2) is that of lengths and turns by markers.
    """
    by_markers = np.median(distance_and_turn(markers), axis=0)
    by_wheels = np.median(distance_and_turn(wheels), axis=0)
    least = np.maximum(MAX_FACTOR * np.minimum(by_markers, by_wheels),
                       MIN_MOTION_SIGMAS * np.median(sigma, axis=0))
    differ = np.maximum(by_markers, by_wheels) > least
    what = "odometry"
    advice = ("Look whether encoderReading.txt and ArucoReading.txt are of the same drive and "
              "count the same poses.")
    if (differ & (by_wheels > 0)).any():
        what = "units"
        advice = ("Look at the units of x and y in ArucoReading.txt (metres), of the radii "
                  "(metres) and ticks_per_revolution, and of the wheelbase in vehicle.toml "
                  "(metres).")
    elif agree.mean() > 0.5:
        return
    yield Doubt(what, (
        f"Between the same poses the vehicle moves by {by_markers[0]:.4g} m and turns by "
        f"{by_markers[1]:.4g} rad by the markers, and by {by_wheels[0]:.4g} m and "
        f"{by_wheels[1]:.4g} rad by the wheels (medians); they agree at {agree.mean():.0%} of "
        f"{len(agree)} places."), advice)


def range_units(dataset: Dataset) -> Iterator[Doubt]:
    """Doubt, if ranges do not fit the size of odometry's path, or the guesses.

    Of the path while its heading is known, and of antennas with MIN_RANGES_PER_ANTENNA on it.
    """
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


def common_divisor(ticks: np.ndarray) -> int:
    """Greatest common divisor of counts (n, 2), of fractions or a few different counts 1."""
    whole = np.rint(ticks).astype(int)
    if not np.array_equal(whole, ticks):
        return 1
    divisor = int(np.gcd.reduce(whole, axis=None))
    if divisor > 1 and len(np.unique(np.abs(whole))) < MIN_DIFFERENT_COUNTS:
        return 1
    return divisor


def sigma_units(dataset: Dataset) -> Iterator[Doubt]:
    """Doubts about stated sigmas far above the scatter of a landmark's measurements."""
    seen = dataset.aruco
    heard = dataset.uwb
    if seen is not None:
        columns = {"s_xx (m^2)": 0, "s_yy (m^2)": 1, "s_thetatheta (rad^2)": 2}
        sigma = se2.sigmas(seen.covariance)
        for name, k in columns.items():
            yield from _sigma_unit(seen.pose, seen.marker, seen.marker_in_vehicle[:, k],
                                   sigma[:, k], f"{name} in ArucoReading.txt")
    if heard is not None:
        yield from _sigma_unit(heard.pose, heard.antenna, heard.range, heard.sigma,
                               "sigma (m) in UwbReading.txt")


def _sigma_unit(pose, landmark, values, sigma, column):
    """Doubt about the sigmas (m,) in a column of a file, by measured `values` (m,) of landmarks.

    Second differences of successive measurements show the scatter; motion only increases it. A
    heading that is stated to be worse than pi is unknown.
    """
    order = np.lexsort([pose, landmark])
    landmark = landmark[order]
    second = np.diff(values[order], 2)[landmark[2:] == landmark[:-2]]
    stated = np.median(sigma)
    if "theta" in column:
        second = se2.wrap(second)
        if stated >= np.pi:
            return
    if len(second) < MIN_COUNT:
        return
    scatter = np.median(np.abs(second)) / SECOND_DIFFERENCE
    if 0 < MAX_SIGMA_RATIO * scatter < stated:
        yield Doubt("units", (
            f"Successive measurements scatter by {scatter:.3g} at most, but the standard deviation "
            f"that {column} states is {stated:.3g} (medians)."), f"Look at the unit of {column}.")
