"""Doubts where the solution of problem 3 or 4, a SlamResult, contradicts what the files state."""

from functools import reduce
from typing import NamedTuple

import numpy as np

from slamlib.core import se2
from slamlib.core.sightings import GATE
from slamlib.core.vehicle import Vehicle
from slamlib.robust.choices import DECISIVE_RELEASE, STATED
from slamlib.robust.file_doubts import Doubt
from slamlib.robust.fused import LearnedFusion
from slamlib.robust.jumps import UNKNOWN_SIGMA
from slamlib.robust.linear import NormalEquations
from slamlib.robust.measurements import NOISE_KEYS
from slamlib.robust.noise import BOUNDS, learn_noise
from slamlib.robust.result import SlamResult

MAX_GAP = 30                 # poses, between contradictions that are told as one
MAX_SLIP = 0.02              # sqrt(m), of wheels on the ground
MIN_CONTRADICTING = 0.05     # share of the poses where problem 2's fusion contradicts problem 3
SAME_POSE = 1e-3             # m and rad, standard deviation by which poses of both may differ
MAX_LATE_SHARE = 0.1         # share of the ranges that keep less than half of their weight
MAX_NOISE_FACTOR = 1.5       # on a sigma, or its inverse; beyond it the factor is reported
MIN_FACTOR_SIGMAS = 4.0      # sigmas of the logarithm of a factor that is reported
MAX_REJECTED = 0.1           # share of the sightings that are rejected
MIN_REJECTED_OF_MARKER = 5   # number of its sightings, from which a marker is named
MAX_REJECTED_OF_MARKER = 0.2     # share of its sightings, the same
MAX_MARKERS_NAMED = 8        # of those, in one sentence
MAX_STRETCHES_NAMED = 3      # of the drive, where counts and markers contradict each other
MIN_TOLD_SIGMAS = 2.0        # of its own sigmas, by which an estimate that is named is off
# Sigmas of a pose, by engine and GTSAM. Sightings of points are coordinates in one, bearing and
# distance in the other: up to 0.11 on clean drives.
MAX_DISAGREEMENT = 0.25
# By group of the calibration: its name in a sentence, and what to look at.
GROUPS = {
    "wheel-scale": ("one factor on both wheels", "Measure the wheels under load, and look for "
                    "counts that are lost, doubled or cut off."),
    "wheel-radii": ("the radii of the wheels", "Measure them, or state larger sigmas in "
                    "vehicle.toml."),
    "wheelbase": ("the wheelbase", "Measure it where the wheels touch the ground, or state a "
                  "larger sigma in vehicle.toml."),
    "camera-offset": ("the place of the camera", "Measure it from midway between the wheels, and "
                      "state it in vehicle.toml."),
    "camera-bump": ("a camera that was moved during the drive", "Fasten it, and measure its place "
                    "again."),
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


def solution_doubts(result: SlamResult) -> tuple[Doubt, ...]:
    """Tuple of Doubt where a SlamResult contradicts the files of its drive."""
    doubts = []
    for check in (_encoder_doubts, _calibration_doubts, _noise_doubts, _stated_noise_doubts,
                  _place_doubts, _rejection_doubts, _path_doubts, _agreement_doubts):
        doubts += check(result)
    for antenna, reason in result.doubts.items():
        doubts.append(Doubt("antenna", f"Antenna {antenna} is in doubt: {reason}.",
                            "Look at its rows in UwbReading.txt."))
    return tuple(doubts)


def _calibration_doubts(result):
    """A Doubt on each group of the calibration that decidedly left its stated values.

    Of groups that the drive cannot tell apart, on that which has left it furthest.
    """
    common = frozenset.intersection(*result.explanations)
    of_any = frozenset().union(*result.explanations)
    either = [group for group in GROUPS if group in of_any - common]
    table = np.array(result.calibration_table)
    rows = {group: table[result.calibration.of_group(group)] for group in GROUPS}

    def sigmas_off(row):
        return abs(row["estimate"] - row["stated"]) / row["sigma"]

    def distance(group):
        return max(map(sigmas_off, rows[group]))

    released = [group for group in either if group in result.released]
    furthest = max(released, key=distance, default=None)
    for group, (_, advice) in GROUPS.items():
        if group not in common and group != furthest:
            continue
        off = [row for row in rows[group] if sigmas_off(row) > MIN_TOLD_SIGMAS]
        numbers = " and ".join(map(_estimated_and_stated, off or rows[group]))
        sentence = f"By the drive {numbers}; {_problem(result)} uses this."
        if group == "camera-bump":
            sentence = f"From pose {result.jumps.bump + 1} on the camera is elsewhere. {sentence}"
        if group == furthest:
            instead = [GROUPS[other][0] for other in released if other != group]
            against = [GROUPS[other][0] for other in either if other not in released]
            if instead:
                sentence += (f" It may instead be {' or '.join(instead)}: the drive cannot tell, "
                             "and the covariances include it.")
            if against:
                sentence += (f" The drive also allows {' or '.join(against)}, but what "
                             "vehicle.toml states speaks against it.")
        yield Doubt(group, sentence, advice)


def _problem(result):
    """The problem whose result it is, in words."""
    return "problem 4" if len(result.antenna) else "problem 3"


def _estimated_and_stated(row):
    """An entry of the calibration in words, by its row of `calibration_table`."""
    sigma = row["sigma"]
    decimals = max(0, 1 - int(np.floor(np.log10(sigma))))            # two digits of the sigma
    estimated = (f"{row['name']} = {row['estimate']:.{decimals}f} ± {sigma:.{decimals}f} "
                 f"{row['unit']}")
    stated = f"{row['stated']:.4g}"
    if row["stated_sigma"]:
        stated += f" ± {row['stated_sigma']:.2g}"
    return f"{estimated.rstrip()} (stated: {stated})"


def _encoder_doubts(result, solution="Problem 2's fusion and problems 3 and 4 do"):
    """A Doubt if the markers contradict the counts, by stretches of the drive.

    `solution` begins the sentence on what is done without these counts.
    """
    jumps = result.jumps
    if not len(jumps.start):
        return
    gaps = jumps.start[1:] - jumps.end[:-1]
    begins = np.flatnonzero(gaps > MAX_GAP) + 1
    stretches = np.split(np.arange(len(jumps.start)), begins)
    told = "; ".join(_stretch(jumps, rows) for rows in stretches[:MAX_STRETCHES_NAMED])
    more = len(stretches) - MAX_STRETCHES_NAMED
    if more > 0:
        told += f"; and {more} more times"
    yield Doubt("encoder", (
        f"In encoderReading.txt, {told}. {solution} without these counts."), (
        "Look at the rows, whether the vehicle was pushed or carried, and at the marker ids before "
        "and after."))


def _stretch(jumps, rows):
    """What counts and markers say of the motion over all `rows` (m,) of Jumps, in words."""
    by_counts = reduce(se2.compose, jumps.by_odometry[rows])
    told = "all markers change at once"
    if (jumps.sigma[rows] < UNKNOWN_SIGMA).all():
        by_markers = reduce(se2.compose, jumps.increment[rows])
        off = se2.between(by_markers, by_counts)
        told = f"the markers say {_motion(by_markers)}, which ends {_motion(off)} from there"
    first, last = rows[[0, -1]]
    return (f"between poses {jumps.start[first] + 1} and {jumps.end[last] + 1} the vehicle moved "
            f"by {_motion(by_counts)}, but {told}")


def _motion(increment):
    """Distance and turn of an increment (3,), in words."""
    distance = np.hypot(increment[0], increment[1])
    turn = np.degrees(np.abs(se2.wrap(increment[2])))
    return f"{distance:.2f} m and {turn:.0f}°"


class _Kind(NamedTuple):
    """A kind of measurements."""

    doubt: str               # first word of the kinds of its doubts
    name: str                # in sentences
    file: str
    column: int              # of its factor among the noise parameters


SIGHTINGS = _Kind("marker", "sightings", "ArucoReading.txt", 1)
RANGES = _Kind("range", "ranges", "UwbReading.txt", 2)


def _noise_doubts(result):
    """Doubts on errors with memory, and on learned factors that are not 1."""
    shares = np.split(result.share, [len(result.rejected)])
    for kind, share in zip((SIGHTINGS, RANGES), shares):
        if (share < 1).any():
            yield _memory_doubt(result, kind, share)
        else:
            yield from _factor_doubt(result, kind)


def _memory_doubt(result, kind, share):
    """The Doubt on errors with memory, of which measurements keep the shares (m,)."""
    correlation = result.correlation[kind.column - 1]
    measured = kind.name
    if kind == RANGES:
        m = result.fit.problem.measurements
        measured += f" (antenna {_listed(m.antenna[m.ranges.antenna[share < 1]])})"
    return Doubt(f"{kind.doubt}-memory", (
        f"Errors of successive {measured} are alike: their correlation is {correlation:.2f}. So "
        f"{_problem(result)} counts {len(share)} {kind.name} as {share.sum():.0f}, with "
        f"{result.noise[kind.column]:.2g} times the standard deviations in {kind.file}."), (
        "Look at the calibration of the sensor, and for what moves, blurs, hides or reflects."))


def _factor_doubt(result, kind):
    """A Doubt if the learned noise factor of a kind is decidedly not 1."""
    factor = result.noise[kind.column]
    sigma = result.noise_sigma[kind.column]
    least = max(np.log(MAX_NOISE_FACTOR), MIN_FACTOR_SIGMAS * sigma)
    if sigma == 0 or abs(np.log(factor)) <= least:
        return
    sentence = (f"The {kind.name} scatter {factor:.2f} ± {factor * sigma:.2f} times as much as "
                f"{kind.file} states: {_problem(result)} uses the scatter that was found.")
    if kind == SIGHTINGS and _are_sigmas(result, factor):
        sentence += " So they would if its columns of variances held standard deviations."
    if kind == RANGES:
        late = np.mean(result.range_weight < 0.5)
        if late > MAX_LATE_SHARE:
            sentence += f" {late:.0%} of them are far too long, as without line of sight."
    yield Doubt(f"{kind.doubt}-noise", sentence,
                "Look at how the sensor's covariances were obtained.")


def _stated_noise_doubts(result):
    """A Doubt if the drive contradicts the stated noise, with which it is solved."""
    problem = result.fit.problem
    m = problem.measurements
    stated = m.measured & ~m.learned
    if not stated.any():
        return
    found = learn_noise(NormalEquations(problem, result.fit.state), m.measured)
    if found.lead < DECISIVE_RELEASE + STATED:
        return
    sigma = np.sqrt(np.diag(found.covariance))
    off = np.abs(np.log(found.noise) - np.log(result.noise)) > MIN_FACTOR_SIGMAS * sigma
    told = [f"{NOISE_KEYS[k]} = {found.noise[k]:.2g} ± {found.noise[k] * sigma[k]:.1g} (stated: "
            f"{result.noise[k]:.2g})" for k in np.flatnonzero(stated & off)]
    if told:
        yield Doubt("stated-noise", (
            f"By the drive {' and '.join(told)}; {_problem(result)} uses what is stated, and its "
            "covariances follow from it."), "Leave it out of vehicle.toml: then it is learned.")


def _are_sigmas(result, factor):
    """Whether a noise factor is that of standard deviations s in the columns of variances: root s.

    It is then the standard deviation that these columns state.
    """
    if factor < 2 * np.exp(BOUNDS[0, SIGHTINGS.column]):       # which may be any smaller one
        return False
    stated = np.median(se2.sigmas(result.sightings.C)[:, :2])
    return stated / MAX_NOISE_FACTOR < factor < stated * MAX_NOISE_FACTOR


def _place_doubts(result):
    """A Doubt on ids of markers that stand for several places."""
    if result.places is None:
        return
    ids, places = result.places[result.places[:, 0] != result.places[:, 1]].T
    yield Doubt("places", (
        f"By the path between their sightings, markers {_listed(ids)} were seen at more than one "
        f"place: {_problem(result)} has the others as markers {_listed(places)}."), (
        "Look for ids that are used twice, for markers that were moved, and whether the vehicle "
        "was carried where it saw none."))


def _listed(ids):
    """Ids (m,), each once, in words."""
    return ", ".join(map(str, np.unique(ids)))


def _rejection_doubts(result):
    """A Doubt on sightings that are rejected, if these are many or most of one marker."""
    repeated = result.sightings.contradicting
    left_out = result.rejected.sum() + repeated
    count = len(result.rejected) + repeated
    marker, row, seen = np.unique(
        result.sightings.marker, return_inverse=True, return_counts=True)
    wrong = np.bincount(row, result.rejected, len(marker)).astype(int)
    named = np.flatnonzero((wrong >= MIN_REJECTED_OF_MARKER)
                           & (wrong > MAX_REJECTED_OF_MARKER * seen))
    if left_out <= MAX_REJECTED * count and not len(named):
        return
    sentence = f"{left_out} of {count} sightings contradict the rest and are left out"
    for k in named[:MAX_MARKERS_NAMED]:
        sentence += f", of marker {marker[k]} {wrong[k]} of {seen[k]}"
    if repeated:
        sentence += f", {repeated} by another one of the same marker at the same pose"
    yield Doubt("sightings-rejected", f"{sentence}.", (
        "Look at the marker ids in ArucoReading.txt, for markers that were moved or are there "
        "twice, and for lost counts in encoderReading.txt."))


def fusion_doubts(fusion: LearnedFusion, vehicle: Vehicle) -> tuple[Doubt, ...]:
    """Tuple of Doubt: jumps of a LearnedFusion, and a slip that no wheel has, if it was learned."""
    doubts = list(_encoder_doubts(fusion, "Problem 2's fusion does"))
    if vehicle.slip is None:
        doubts += _slip_doubt(fusion.slip)
    return tuple(doubts)


def contradiction_doubts(poses: np.ndarray, covariances: np.ndarray,
                         by_slam: np.ndarray) -> tuple[Doubt, ...]:
    """Tuple of a Doubt if problem 2's fusion is too far from problem 3's poses `by_slam` (n, 3).

    That is where many of its poses (n, 3) are beyond GATE of its own covariances (n, 3, 3), with
    SAME_POSE added, since a vehicle that stands may be known to rounding.
    """
    added = SAME_POSE**2 * np.eye(3)
    squared = se2.squared_distances(poses, by_slam, covariances + added)
    share = np.mean(squared > GATE)
    if share < MIN_CONTRADICTING:
        return ()
    off = se2.between(by_slam, poses)[:, :2]
    farthest = np.linalg.norm(off, axis=1).max()
    return (Doubt("fusion", (
        f"Problem 2's fusion is up to {farthest:.2g} m from problem 3, and at {share:.0%} of the "
        "poses outside the 99.9 % region of its own covariances: these are too small, or problem 3 "
        "is wrong."), "Prefer problem 3 where nothing else is in doubt."),)


def _slip_doubt(slip):
    """A Doubt if a learned slip, sqrt(m), is one that no wheel has."""
    if slip > MAX_SLIP:
        yield Doubt("wheel-slip", (
            f"By the other sensors each wheel slips by {1e3 * slip:.0f} mm (one standard "
            "deviation) after one metre, far more than wheels do: problem 2's fusion may follow "
            "errors of the sightings, with too small covariances."), (
            "Look whether encoderReading.txt is of the same drive as the other files, with the "
            "same pose ids, and at the standard deviations in ArucoReading.txt. The rounding of "
            "counts that are centimetres apart looks the same."))


def _path_doubts(result):
    """Doubts on slip, and a solution that still changed."""
    if result.noise_sigma[0]:
        yield from _slip_doubt(result.slip)
    if not result.converged:
        yield Doubt("not-converged", (
            "The solution still changed when its number of steps ended: some poses or landmarks "
            "may be far from where the measurements want them."))


def _agreement_doubts(result):
    """A Doubt if GTSAM's solution is not that by which the engine decided."""
    if result.disagreement > MAX_DISAGREEMENT:
        yield Doubt("agreement", (
            f"GTSAM's solution differs by up to {result.disagreement:.2g} standard deviations from "
            "that by which noise and outliers were decided: what was decided may not fit it."))
