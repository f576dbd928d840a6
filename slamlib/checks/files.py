"""Doubts about the files of a drive, from measurements compared with each other before solving.

Markers and wheels both measure increments [x, y, heading] of the vehicle. Wrong axes or signs of
one of them change these to [A (x, y), det(A) heading], A one of the eight symmetries of a square.
Increments do not determine which sensor is wrong: exchanged wheels and a camera mirrored in y and
theta have the same A. Ranges decide it if the guesses of the antennas are accurate enough. Wrong
units show in ratios of lengths, and of stated standard deviations to the scatter of measurements.
"""

from dataclasses import dataclass

import numpy as np

from slamlib import counts, increments, odometry, se2
from slamlib.doubt import Doubt
from slamlib.localization.marker_increments import common_sightings, robust_increments
from slamlib.sightings import MAX_HEADING_SIGMA, sightings_by_frame

MIN_COUNT = 10            # measurements for a decision
MIN_RANGES_PER_ANTENNA = 4
SPAN, MAX_FRAMES = 1.0, 20     # m and frames, over which increments are compared
GENEROUS_SLIP = 1e-2      # sqrt(m), slip of the wheels that explains a difference
GENEROUS_WHEEL = 0.03     # relative standard deviation of the wheel parameters, likewise
MIN_MOTION_SIGMAS = 5.0   # sigmas of distance or turn from which on the vehicle moves
AGREEMENT_GATE = 7.8147   # 95 % quantile of chi-squared with 3 degrees of freedom
MIN_AGREEING_SHARE = 0.7  # of the increments with an accepted A
MIN_GAIN_SIGMAS = 4.0     # sigmas of the number of increments that agree in addition
MIN_DISAGREEMENT = 0.15   # share of an increment by which files of two drives disagree
MIN_FIT_RATIO = 3.0       # ratio of the ranges' median residuals that decides between two paths
MAX_FACTOR = 5.0          # ratio of lengths from which on the unit is in doubt
MAX_SIGMA_RATIO = 15.0    # of a stated standard deviation to the scatter; in degrees it is 57
MAX_ODOMETRY_HEADING_SIGMA = 0.1   # rad, at the end of the path that is compared with ranges
SPREADS = 0.02, 3.5       # ratios of the ranges' standard deviation to its; 0.7 is expected
QUARTILES = 1.35          # distance of the quartiles of a normal distribution of sigma 1
SECOND_DIFFERENCE = 0.6745 * 6**0.5      # median size, of independent errors of sigma 1
# The matrices A, and kind and change of the counts with the effect of the first ones.
AXES = np.array([np.diag(signs) @ order for order in (np.eye(2), np.eye(2)[::-1])
                 for signs in ((1, 1), (1, -1), (-1, 1), (-1, -1))])
COUNTS = (None, ("wheels-swapped", "the columns exchanged"),
          ("wheels-reversed", "both signs reversed"),
          ("wheels-reversed", "both signs reversed and the columns exchanged"))


@dataclass(frozen=True)
class _Compared:
    """n increments of the moving vehicle, by markers with theta as stated (0) and reversed (1)."""

    by_markers: np.ndarray           # (2, n, 3) m and rad; NaN where unknown
    by_wheels: np.ndarray            # (n, 3)
    covariance_markers: np.ndarray   # (2, n, 3, 3)
    covariance_wheels: np.ndarray    # (n, 3, 3), with GENEROUS_SLIP and GENEROUS_WHEEL

    def squared_distances(self, A):
        """Squared Mahalanobis distances (2, n) if the wheels' axes are transformed by A (2, 2)."""
        B = np.zeros((3, 3))
        B[:2, :2], B[2, 2] = A, np.linalg.det(A)
        r = self.by_markers - self.by_wheels @ B.T
        r[..., 2] = se2.wrap(r[..., 2])
        W = self.covariance_markers + B @ self.covariance_wheels @ B.T
        return np.sum(r * np.linalg.solve(W, r[..., None])[..., 0], axis=-1)

    def medians(self):
        """Median distance and turn (2, 2) by markers and by wheels, m and rad, and a clause."""
        medians = np.median([_sizes(self.by_markers[0]), _sizes(self.by_wheels)], axis=1)
        return medians, (
            "the vehicle moves by {:.4g} m and turns by {:.4g} rad by the markers, and by {:.4g} m "
            "and {:.4g} rad by the wheels (medians)".format(*medians.flat))


def doubts_before_solving(dataset, truth=None):
    """List of Doubts about the files of a Dataset and its Truth; empty where too little is known.

    Kinds are units, wheels-swapped, wheels-reversed, camera-mirrored, camera-turned, odometry,
    counts-since-start and those of the truth.
    """
    doubts = [] if truth is None else list(truth.doubts)
    try:
        return _motion_doubts(dataset) + range_units(dataset) + sigma_units(dataset) + doubts
    except np.linalg.LinAlgError:              # where increments have no covariance
        return doubts


def merged(doubts):
    """List of Doubt, each kind once with its last sentence; antennas and units by sentence."""
    return list({doubt.sentence if doubt.what in ("antenna", "units") else doubt.what: doubt
                 for doubt in doubts}.values())


def _motion_doubts(dataset):
    """Doubts about units, axes or drives, the first found; of few sightings, about the counts."""
    compared = _compare(dataset)
    if len(compared.by_wheels) >= MIN_COUNT:
        return (motion_units(compared) or _axes_doubts(dataset, compared)
                or odometry_doubts(compared))
    return [Doubt("counts-since-start", (
        "The counts in encoderReading.txt change gradually from row to row, up to "
        f"{abs(dataset.ticks).max()} in one row: look whether they are counts since the start."
        ))] * counts.may_be_cumulative(dataset.ticks, dataset.vehicle)


def _compare(dataset):
    """The _Compared of a Dataset, between frames about SPAN apart: turns are well above noise."""
    s, args = sightings_by_frame(dataset.sightings), (dataset.ticks, dataset.vehicle)
    step, _ = increments.between_poses(*args, s.frame[:-1], s.frame[1:], "arc")
    typical = np.median(_sizes(step)[:, 0]) if len(step) else SPAN
    span = max(1, min(int(SPAN / max(typical, SPAN / MAX_FRAMES) + 0.5), len(s.frame) // 4))
    start, end = s.frame[:-span], s.frame[span:]
    common = common_sightings(s.row, s.marker, span)
    found = [robust_increments(s.z @ S, S @ s.C @ S, *common, len(start))
             for S in (np.eye(3), np.diag([1.0, 1.0, -1.0]))]
    z, C = (np.array([getattr(each, name) for each in found])
            for name in ("increment", "covariance"))
    wheels, by_w = increments.between_poses(*args, start, end, "arc")
    by_w = by_w * (GENEROUS_WHEEL * dataset.vehicle.wheel)
    generous = (increments.noise_covariances(*args, start, end, GENEROUS_SLIP)
                + by_w @ np.swapaxes(by_w, 1, 2))
    moving = found[0].usable & (_moves(z[0], C[0]) | _moves(wheels, generous))
    return _Compared(z[:, moving], wheels[moving], C[:, moving], generous[moving])


def _sizes(increment):
    """Distance in m and turn in rad, (n, 2), of increments (n, 3)."""
    return np.stack([np.hypot(*increment[:, :2].T), np.abs(se2.wrap(increment[:, 2]))], axis=1)


def _sigmas(covariance):
    """Standard deviations of distance and turn, (n, 2), by covariances (n, 3, 3)."""
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2) @ [[1, 0], [1, 0], [0, 1]])


def _moves(increment, covariance):
    """Mask (n,) of increments whose distance or turn is above MIN_MOTION_SIGMAS sigmas."""
    return (_sizes(increment) > MIN_MOTION_SIGMAS * _sigmas(covariance)).any(axis=1)


def motion_units(compared):
    """List of a Doubt if lengths or turns by markers and by wheels differ by MAX_FACTOR."""
    medians, said = compared.medians()
    (low, high), noise = np.sort(medians, axis=0), _sigmas(compared.covariance_markers[0])
    wrong = (high > np.maximum(MAX_FACTOR * low, MIN_MOTION_SIGMAS * np.median(noise, axis=0)))
    return [Doubt("units", (
        f"Between the same poses {said}: look at the units of x and y in ArucoReading.txt "
        "(metres), of the radii (metres) and ticks_per_revolution, and of the wheelbase in "
        "vehicle.toml (metres)."))] * bool((wrong & (medians[1] > 0)).any())


def _axes_doubts(dataset, compared):
    """Doubts that axes or signs are wrong, if with others significantly more increments agree."""
    agree = np.array([compared.squared_distances(A) < AGREEMENT_GATE for A in AXES])
    k, reverse = np.unravel_index(agree.sum(axis=2).argmax(), agree.shape[:2])
    stated, found = agree[0, 0], agree[k, reverse]
    if found.mean() < MIN_AGREEING_SHARE or \
            found.sum() - stated.sum() <= MIN_GAIN_SIGMAS * np.sum(found != stated)**0.5:
        return []
    A, mirrors = AXES[k], np.linalg.det(AXES[k]) < 0
    right = ["-" * int(row.sum() < 0) + "xy"[np.abs(row).argmax()] for row in A.T]
    possible = [Doubt("camera-mirrored" if mirrors or reverse else "camera-turned", (
        f"sightings with [{', '.join(right)}, {'-' * int(mirrors != reverse)}theta] in place of "
        "[x, y, theta] in ArucoReading.txt"))]
    if 0 < k < len(COUNTS) and not reverse:
        kind, change = COUNTS[k]
        possible.insert(0, Doubt(kind, (
            f"{change} in encoderReading.txt (look at the order of right and left, and at the "
            "signs of the counts)")))
        path, antennas = path_and_antennas(dataset)      # odometry's, with A if wheels are wrong
        fits = [np.median([np.median(np.abs(np.hypot(*(positions[pose] - guess).T) - r))
                           for pose, r, guess in antennas] or 1.0)
                for positions in (path @ A.T, path)]
        if max(fits) >= MIN_FIT_RATIO * min(fits):
            possible = [possible[np.argmin(fits)]]
    return [Doubt(each.what, (
        f"Increments of the vehicle by markers and by wheels agree at {stated.mean():.0%} of "
        f"{len(stated)} places, and at {found.mean():.0%} with {each.sentence}."
        + "".join(f" Equally possible: {other.sentence}." for other in possible if other != each)))
        for each in possible]


def odometry_doubts(compared):
    """List of a Doubt if most increments disagree beyond their noise, and by much of their size.

    Sightings whose stated covariances are too small disagree, but by little.
    """
    markers, wheels = compared.by_markers[0], compared.by_wheels
    off, *sizes = (np.hypot(*_sizes(v).T) for v in (markers - wheels, markers, wheels))
    share = np.mean((compared.squared_distances(np.eye(2))[0] > AGREEMENT_GATE)
                    & (off > MIN_DISAGREEMENT * np.maximum(*sizes)))
    return [Doubt("odometry", (
        f"Markers and wheels disagree beyond their noise at {share:.0%} of {len(off)} places; "
        f"{compared.medians()[1]}: look whether encoderReading.txt and ArucoReading.txt are of the "
        "same drive and count the same poses."))] * bool(share >= 0.5)


def path_and_antennas(dataset):
    """Odometry's path (p, 2) in m while the heading is known, and the ranges on it by antenna.

    Of antennas with MIN_RANGES_PER_ANTENNA there are poses (m,), ranges (m,) and guess (2,), m.
    """
    if dataset.uwb is None or dataset.antenna_guess is None:
        return np.zeros((0, 2)), []
    poses, covariances = odometry.first_order(dataset.ticks, dataset.vehicle, model="arc")
    path = poses[np.cumsum(covariances[:, 2, 2] > MAX_ODOMETRY_HEADING_SIGMA**2) == 0, :2]
    heard = dataset.uwb.select(dataset.uwb.pose < len(path))
    return path, [
        (heard.pose[mine], heard.range[mine], guess)
        for antenna, guess in zip(dataset.antenna_guess.antenna, dataset.antenna_guess.position)
        if np.count_nonzero(mine := heard.antenna == antenna) >= MIN_RANGES_PER_ANTENNA]


def range_units(dataset):
    """List of a Doubt about units of ranges and antenna guesses, compared with odometry's path."""
    path, antennas = path_and_antennas(dataset)
    if sum(len(r) for _, r, _ in antennas) < MIN_COUNT or not path.any():
        return []
    extent, noise = np.hypot(*path.std(axis=0)), 2 * np.median(dataset.uwb.sigma)
    spread, typical, distance = np.median([
        (np.subtract(*np.percentile(r, [75, 25])) / QUARTILES, np.median(r),
         np.median(np.hypot(*(path[pose] - guess).T))) for pose, r, guess in antennas], axis=0)
    if SPREADS[0] * extent <= spread <= SPREADS[1] * extent + noise \
            and max(typical, distance) <= MAX_FACTOR * min(typical, distance):
        return []
    return [Doubt("units", (
        f"The ranges to an antenna spread by {spread:.4g} m and have the median {typical:.4g} m; "
        f"the path by the wheels spreads by {extent:.4g} m, and its median distance to the guess "
        f"is {distance:.4g} m: look at the units of UwbReading.txt, UwbAntennaGuess.txt and of the "
        "radii in vehicle.toml (metres), and at the columns of UwbReading.txt."))]


def sigma_units(dataset):
    """Doubts about stated standard deviations that are far above the scatter of a landmark.

    Second differences of successive measurements show the scatter; motion only increases it.
    Unknown headings are left out, which are above MAX_HEADING_SIGMA while others are not.
    """
    compared, doubts = [], []
    if (seen := dataset.aruco) is not None:
        for columns, unit, look in (
                ([0, 1], "m", "s_xx, s_xy and s_yy in ArucoReading.txt (m^2)"),
                ([2], "rad", "s_thetatheta in ArucoReading.txt (rad^2)")):
            sigma = np.sqrt(seen.covariance[:, columns, columns].max(axis=1))
            limit = np.inf if unit == "m" else np.clip(2 * sigma.min(), MAX_HEADING_SIGMA, np.pi)
            known = seen.select(sigma < limit)
            compared.append((known, known.marker, known.marker_in_vehicle[:, columns],
                             sigma[sigma < limit], unit, look))
    if (r := dataset.uwb) is not None:
        compared.append((r, r.antenna, r.range[:, None], r.sigma, "m",
                         "sigma in UwbReading.txt (metres)"))
    for readings, landmark, values, sigma, unit, look in compared:
        order = np.lexsort([readings.pose, landmark])
        second = np.diff(values[order], 2, axis=0)[landmark[order][2:] == landmark[order][:-2]]
        if second.size < MIN_COUNT:
            continue
        second = np.abs(se2.wrap(second) if unit == "rad" else second)
        scatter, stated = np.median(second) / SECOND_DIFFERENCE, np.median(sigma)
        if 0 < MAX_SIGMA_RATIO * scatter < stated:
            doubts.append(Doubt("units", (
                f"Successive measurements scatter by {scatter:.3g} {unit} at most, but their "
                f"stated standard deviation is {stated:.3g} {unit} (medians): look at the unit of "
                f"{look}.")))
    return doubts
