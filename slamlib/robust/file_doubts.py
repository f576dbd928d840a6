"""Doubts about the files of a drive, from measurements compared with each other before solving.

Markers and wheels both measure increments [x, y, heading] of the vehicle. Wrong axes or signs of
one of them change these to [A (x, y), det(A) heading], A one of the eight symmetries of a square.
Exchanged wheels and a camera mirrored in y and theta have the same A. Wrong units show in ratios of
lengths, and of stated standard deviations to the scatter of measurements.
"""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from slamlib.core import odometry, se2
from slamlib.core.marker_increments import (
    common_sightings,
    distance_and_turn,
    distance_and_turn_sigmas,
    robust_increments,
)
from slamlib.core.sightings import sightings_by_frame

MIN_COUNT = 10            # measurements for a decision
MIN_RANGES_PER_ANTENNA = 4
SPAN, MAX_FRAMES = 1.0, 20     # m and frames, over which increments are compared
MIN_MOTION_SIGMAS = 5.0   # sigmas by markers of distance or turn, from which on the vehicle moves
AGREEMENT = 0.1, 3.0     # of an increment and of its sigmas, within which markers and wheels agree
MIN_AGREEING_SHARE = 0.7  # of the increments with an accepted A
MIN_GAIN_SIGMAS = 4.0     # sigmas of the number of increments that agree in addition
MAX_FACTOR = 5.0          # ratio of lengths from which on the unit is in doubt
MAX_SIGMA_RATIO = 15.0    # of a stated standard deviation to the scatter; in degrees it is 57
MAX_ODOMETRY_HEADING_SIGMA = 0.1   # rad, at the end of the path that is compared with ranges
SPREADS = 0.027, 4.7      # ratios of the ranges' quartile distance to the path's sigma; 1 is usual
SECOND_DIFFERENCE = 0.6745 * 6**0.5      # median size, of independent errors of sigma 1
# The matrices A, and by their number kind and change of the counts with the same effect.
AXES = np.array([np.diag(signs) @ order for order in (np.eye(2), np.eye(2)[::-1])
                 for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1))])
COUNTS = {1: ("wheels-swapped", "the columns exchanged"),
          2: ("wheels-reversed", "both signs reversed"),
          3: ("wheels-reversed", "both signs reversed and the columns exchanged")}


@dataclass(frozen=True)
class Doubt:
    """A possible error in the files of a drive, for the user to check.

    `what` is its kind in kebab case ("wheels-swapped"), for programs. `sentence` states the
    evidence and what to check in which file.
    """

    what: str
    sentence: str


def doubts_before_solving(dataset):
    """List of Doubts about the files of a Dataset, where enough is known."""
    doubts = []
    for check in (motion_doubts, range_units, sigma_units):
        with suppress(np.linalg.LinAlgError):              # where increments have no covariance
            doubts += [Doubt(*each) for each in check(dataset)]
    return doubts


def merged(doubts):
    """List of Doubt, each kind once with its last sentence; antennas and units by sentence."""
    return list({doubt.sentence if doubt.what in ("antenna", "units") else doubt.what: doubt
                 for doubt in doubts}.values())


def motion_doubts(dataset):
    """Kinds and sentences on axes, units or drives, the first found."""
    markers, wheels, sigma = moving_increments(dataset)
    if len(wheels) < MIN_COUNT:
        return []
    turned = np.concatenate([wheels[:, :2] @ AXES.mT,
                             np.linalg.det(AXES)[:, None, None] * wheels[:, 2:]], axis=2)
    size = np.maximum(*(np.hypot(*distance_and_turn(each).T) for each in (markers[0], wheels)))
    agree = np.linalg.norm(distance_and_turn(markers - turned[:, None]), axis=-1) \
        < AGREEMENT[0] * size + AGREEMENT[1] * np.hypot(*sigma.T)                # (8, 2, n)
    return list(wrong_axes(agree)) or list(wrong_sizes(markers[0], wheels, sigma, agree[0, 0]))


def moving_increments(dataset):
    """Increments of the moving vehicle between n pairs of frames about SPAN apart.

    Returns those by markers (2, n, 3), with theta as stated and reversed, by wheels (n, 3), and the
    standard deviations of distance and turn by markers (n, 2).
    """
    s = sightings_by_frame(dataset.sightings)
    path = odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc")
    step = np.hypot(*np.diff(path[s.frame, :2], axis=0).T)
    typical = np.median(step) if len(step) else SPAN
    span = max(1, min(int(SPAN / max(typical, SPAN / MAX_FRAMES) + 0.5), len(s.frame) // 4))
    wheels = se2.between(path[s.frame[:-span]], path[s.frame[span:]])
    common = common_sightings(s.row, s.marker, span)
    found, reversed_theta = (robust_increments(s.z @ S, S @ s.C @ S, *common, len(wheels))
                             for S in (np.eye(3), np.diag([1.0, 1.0, -1.0])))
    sigma = distance_and_turn_sigmas(found.covariance)
    size = np.maximum(distance_and_turn(found.increment), distance_and_turn(wheels))
    moving = found.usable & (size > MIN_MOTION_SIGMAS * sigma).any(axis=1)
    return (np.array([found.increment, reversed_theta.increment])[:, moving], wheels[moving],
            sigma[moving])


def wrong_axes(agree):
    """Kinds and sentences, if with other axes or signs significantly more increments agree.

    `agree` (8, 2, n) tells it by AXES, for theta as stated and reversed.
    """
    k, reverse = np.unravel_index(agree.sum(axis=2).argmax(), agree.shape[:2])
    A, stated, found = AXES[k], agree[0, 0], agree[k, reverse]
    if found.mean() < MIN_AGREEING_SHARE or \
            found.sum() - stated.sum() <= MIN_GAIN_SIGMAS * np.sum(found != stated)**0.5:
        return
    mirrors = np.linalg.det(A) < 0
    right = ["-" * int(row.sum() < 0) + "xy"[np.abs(row).argmax()] for row in A.T]
    possible = [("camera-mirrored" if mirrors or reverse else "camera-turned", (
        f"sightings with [{', '.join(right)}, {'-' * int(mirrors != reverse)}theta] in place of "
        "[x, y, theta] in ArucoReading.txt"))]
    if k in COUNTS and not reverse:
        possible.insert(0, (COUNTS[k][0], (
            f"{COUNTS[k][1]} in encoderReading.txt (look at the order of right and left, and at "
            "the signs of the counts)")))
    for what, change in possible:
        others = "".join(f" Equally possible: {each}." for _, each in possible if each != change)
        yield what, ("Increments of the vehicle by markers and by wheels agree at "
                     f"{stated.mean():.0%} of {len(stated)} places, and at {found.mean():.0%} with "
                     f"{change}.{others}")


def wrong_sizes(markers, wheels, sigma, agree):
    """Kind and sentence, if increments (n, 3) by markers and wheels are of other units or drives.

    Of other units if the medians of length or turn differ by MAX_FACTOR, of other drives if most
    increments do not agree, `agree` (n,). `sigma` (n, 2) is that of lengths and turns by markers.
    """
    medians = np.median([distance_and_turn(markers), distance_and_turn(wheels)], axis=1)
    least = np.maximum(MAX_FACTOR * medians.min(axis=0), MIN_MOTION_SIGMAS * np.median(sigma, 0))
    units = ((medians.max(axis=0) > least) & (medians[1] > 0)).any()
    if units or agree.mean() <= 0.5:
        yield "units" if units else "odometry", (
            "Between the same poses the vehicle moves by {:.4g} m and turns by {:.4g} rad by the "
            "markers, and by {:.4g} m and {:.4g} rad by the wheels (medians); they agree at {:.0%} "
            "of {} places: look {}.").format(*medians.flat, agree.mean(), len(agree), (
                "at the units of x and y in ArucoReading.txt (metres), of the radii (metres) and "
                "ticks_per_revolution, and of the wheelbase in vehicle.toml (metres)") if units else
                "whether encoderReading.txt and ArucoReading.txt are of the same drive and count "
                "the same poses")


def range_units(dataset):
    """Kind and sentence, if ranges do not fit the size of odometry's path, or the guesses.

    Of the path while its heading is known, and of antennas with MIN_RANGES_PER_ANTENNA on it.
    """
    if dataset.uwb is None or dataset.antenna_guess is None:
        return
    poses, covariances = odometry.first_order(dataset.ticks, dataset.vehicle, model="arc")
    path = poses[np.cumsum(covariances[:, 2, 2] > MAX_ODOMETRY_HEADING_SIGMA**2) == 0, :2]
    heard = dataset.uwb.select(dataset.uwb.pose < len(path))
    antennas = [(heard.pose[mine], heard.range[mine], guess) for antenna, guess in zip(
                    dataset.antenna_guess.antenna, dataset.antenna_guess.position)
                if np.count_nonzero(mine := heard.antenna == antenna) >= MIN_RANGES_PER_ANTENNA]
    if sum(len(r) for _, r, _ in antennas) < MIN_COUNT or not path.any():
        return
    extent, noise = np.hypot(*path.std(axis=0)), 3 * np.median(dataset.uwb.sigma)
    spread, typical, distance = np.median([
        (np.subtract(*np.percentile(r, [75, 25])), np.median(r),
         np.median(np.hypot(*(path[pose] - guess).T))) for pose, r, guess in antennas], axis=0)
    if not SPREADS[0] * extent <= spread <= SPREADS[1] * extent + noise \
            or max(typical, distance) > MAX_FACTOR * min(typical, distance):
        yield "units", (
            f"The ranges to an antenna have the median {typical:.4g} m and quartiles "
            f"{spread:.4g} m apart; the path by the wheels spreads by {extent:.4g} m, and its "
            f"median distance to the guess is {distance:.4g} m: look at the units of "
            "UwbReading.txt, UwbAntennaGuess.txt and of the radii in vehicle.toml (metres), and at "
            "the columns of UwbReading.txt.")


def sigma_units(dataset):
    """Kind and sentence for stated sigmas far above the scatter of a landmark's measurements.

    Second differences of successive measurements show the scatter; motion only increases it. A
    heading that is stated to be worse than pi is unknown.
    """
    compared = [] if (a := dataset.aruco) is None else [
        (a.pose, a.marker, a.marker_in_vehicle[:, k], np.sqrt(a.covariance[:, k, k]), name)
        for k, name in enumerate(("s_xx (m^2)", "s_yy (m^2)", "s_thetatheta (rad^2)"))]
    if (r := dataset.uwb) is not None:
        compared.append((r.pose, r.antenna, r.range, r.sigma, "sigma (m)"))
    for pose, landmark, values, sigma, name in compared:
        order, heading = np.lexsort([pose, landmark]), "rad" in name
        second = np.diff(values[order], 2)[landmark[order][2:] == landmark[order][:-2]]
        if len(second) < MIN_COUNT:
            continue
        second = np.abs(se2.wrap(second) if heading else second)
        scatter, stated = np.median(second) / SECOND_DIFFERENCE, np.median(sigma)
        if 0 < MAX_SIGMA_RATIO * scatter < stated < (np.pi if heading else np.inf):
            yield "units", (
                f"Successive measurements scatter by {scatter:.3g} at most, but their stated "
                f"standard deviation is {stated:.3g} (medians): look at the unit of {name} in "
                f"{'UwbReading.txt' if name == 'sigma (m)' else 'ArucoReading.txt'}.")
