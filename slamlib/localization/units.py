"""Doubts about units, from ratios of lengths and of standard deviations in the files of a drive.

Lengths are those by sightings, ranges, antenna guesses and wheels. Stated standard deviations are
compared with the scatter of the measurements.
"""

import numpy as np

from slamlib import odometry, se2
from slamlib.doubt import Doubt

MIN_FACTOR = 5.0           # ratio of lengths from which on the unit is in doubt
MIN_UNIT_MEASUREMENTS = 10      # number of measurements for a decision
MIN_RANGES_PER_ANTENNA = 4  # if no antenna has MIN_UNIT_MEASUREMENTS; all together need as many
NOISE_SIGMAS = 2.0         # sigmas by which noise spreads few ranges
MAX_ODOMETRY_HEADING_SIGMA = 0.1   # rad, at the end of the part of the path that is compared
MIN_EXTENT = 1e-3          # m, standard deviation of the path that ranges are compared with
MAX_SPREAD_FACTOR = 50.0   # ratio of the path's extent to the spread of the ranges
MIN_MEDIAN_SIGMAS = 5.0    # sigmas of a median distance or turn that is compared
# The standard deviation of ranges to an antenna far away is that of the path in one direction, at
# most that of the path in the plane, and 0.7 of it for a path without a preferred direction.
RANGE_SPREAD = 0.7
# Second differences of independent errors of standard deviation 1 have the median size 0.6745 of
# their standard deviation sqrt(1 + 4 + 1).
SECOND_DIFFERENCE = 0.6745 * 6**0.5
MAX_SIGMA_RATIO = 15.0     # of a stated standard deviation to the scatter; in degrees it is 57


def path_and_antennas(dataset, min_ranges=MIN_UNIT_MEASUREMENTS):
    """The first part of odometry's path (p, 2) in m, and the ranges on it by antenna.

    The path ends where the heading's standard deviation exceeds MAX_ODOMETRY_HEADING_SIGMA. Of
    every antenna with `min_ranges` ranges there is a tuple: poses (m,), ranges (m,) and its guess
    (2,) in m. Both are empty without ranges or guesses.
    """
    if dataset.uwb is None or dataset.antenna_guess is None:
        return np.zeros((0, 2)), []
    poses, covariances = odometry.first_order(dataset.ticks, dataset.vehicle, model="arc")
    lost = np.flatnonzero(covariances[:, 2, 2] > MAX_ODOMETRY_HEADING_SIGMA**2)
    path, antennas = poses[:lost[0] if len(lost) else len(poses), :2], []
    for antenna, guess in zip(dataset.antenna_guess.antenna, dataset.antenna_guess.position):
        ranges = dataset.uwb.select(
            (dataset.uwb.antenna == antenna) & (dataset.uwb.pose < len(path)))
        if len(ranges.pose) >= min_ranges:
            antennas.append((ranges.pose, ranges.range, guess))
    return path, antennas


def median_motions(*increments):
    """Median lengths in m and turns in rad, two lists, of several arrays (n, 3) of increments."""
    return ([np.median(np.hypot(*increment[:, :2].T)) for increment in increments],
            [np.median(np.abs(se2.wrap(increment[:, 2]))) for increment in increments])


def sighting_units(by_markers, by_wheels, sigma):
    """Doubts about the units of sightings and wheels, from increments (n, 3) of the moving vehicle.

    `sigma` (2,) are standard deviations of distance and turn, in m and rad. Medians below
    MIN_MEDIAN_SIGMAS of them, by markers and by wheels, are not compared.
    """
    lengths, turns = median_motions(by_markers, by_wheels)
    length_factor, turn_factor = (
        _unit_factor(*medians) if max(medians) > MIN_MEDIAN_SIGMAS * s else 1.0
        for medians, s in zip((lengths, turns), sigma))
    if length_factor == 1 and turn_factor == 1:
        return []
    if length_factor == 1:
        look = "the unit of wheelbase in vehicle.toml (metres)"
    elif turn_factor == 1:
        look = ("the unit of x and y in ArucoReading.txt (metres), and of the radii and wheelbase "
                "in vehicle.toml (metres)")
    else:
        look = ("the unit of the radii (metres) and ticks_per_revolution in vehicle.toml, and the "
                "counts in encoderReading.txt")
    return [Doubt("units", (
        f"Between the same poses the vehicle moves by {lengths[0]:.4g} m and turns by "
        f"{turns[0]:.4g} rad by the markers, and by {lengths[1]:.4g} m and {turns[1]:.4g} rad by "
        f"the wheels (medians): look at {look}."))]


def range_units(dataset):
    """Doubts about the units of ranges and antenna guesses, by comparison with odometry's path."""
    path, antennas = path_and_antennas(dataset)
    few = not antennas
    if few:
        _, antennas = path_and_antennas(dataset, MIN_RANGES_PER_ANTENNA)
    if sum(len(r) for _, r, _ in antennas) < MIN_UNIT_MEASUREMENTS \
            or (extent := np.hypot(*path.std(axis=0))) < MIN_EXTENT:
        return []
    # Between the quartiles lie 1.35 standard deviations of a normal distribution.
    spread = np.median([np.subtract(*np.percentile(r, [75, 25])) / 1.35 for _, r, _ in antennas])
    typical = np.median([np.median(r) for _, r, _ in antennas])
    distance = np.median([np.median(np.hypot(*(path[pose] - guess).T))
                          for pose, _, guess in antennas])
    if few:                        # the path is short: noise may spread the ranges more
        wrong = spread > MIN_FACTOR * extent + NOISE_SIGMAS * np.median(dataset.uwb.sigma)
    else:
        wrong = (_unit_factor(spread, RANGE_SPREAD * extent) > 1
                 or spread < extent / MAX_SPREAD_FACTOR)
    if wrong:
        return [Doubt("units", (
            f"The ranges to an antenna spread by {spread:.4g} m, while the vehicle is within "
            f"{extent:.4g} m by the wheels (standard deviations; median range {typical:.4g} m): "
            "look at the unit of UwbReading.txt (metres) and the order of its columns, and at the "
            "unit of the radii in vehicle.toml (metres)."))]
    if _unit_factor(typical, distance) != 1:
        return [Doubt("units", (
            f"The median range is {typical:.4g} m, and the median distance from the path by the "
            f"wheels to the guessed antennas {distance:.4g} m: look at the unit of "
            "UwbAntennaGuess.txt (metres), and at the unit and the order of columns of "
            "UwbReading.txt."))]
    return []


def sigma_units(dataset):
    """Doubts about the units of standard deviations that are far above the scatter.

    The scatter is that of second differences of successive measurements of a landmark. The motion
    of the vehicle only increases it.
    """
    doubts = []
    if (seen := dataset.aruco) is not None:
        variance = np.diagonal(seen.covariance, axis1=1, axis2=2)
        z = seen.marker_in_vehicle
        doubts += _sigma_doubts("sightings of a marker", "m", [
            _scatter(seen.pose, seen.marker, z[:, k]) for k in (0, 1)],
            np.sqrt(variance[:, :2].mean(axis=1)),
            "s_xx, s_xy and s_yy in ArucoReading.txt (square metres, not standard deviations)")
        doubts += _sigma_doubts("headings of a marker", "rad", [
            _scatter(seen.pose, seen.marker, z[:, 2], se2.wrap)], np.sqrt(variance[:, 2]),
            "s_thetatheta in ArucoReading.txt (square radians)")
    if (ranges := dataset.uwb) is not None:
        doubts += _sigma_doubts("ranges to an antenna", "m", [
            _scatter(ranges.pose, ranges.antenna, ranges.range)], ranges.sigma,
            "sigma in UwbReading.txt (metres)")
    return doubts


def _scatter(pose, landmark, values, wrap=lambda x: x):
    """Standard deviations, one from each second difference of successive values of a landmark."""
    order = np.lexsort([pose, landmark])
    values, landmark = values[order], landmark[order]
    second = wrap(np.diff(wrap(np.diff(values))))
    return np.abs(second[landmark[2:] == landmark[:-2]]) / SECOND_DIFFERENCE


def _sigma_doubts(what, unit, scatters, sigma, look):
    """A Doubt if the stated standard deviations (m,) exceed MAX_SIGMA_RATIO times the scatter."""
    sizes = np.concatenate(scatters)
    if len(sizes) < MIN_UNIT_MEASUREMENTS:
        return []
    scatter, stated = np.median(sizes), np.median(sigma)
    if not 0 < MAX_SIGMA_RATIO * scatter < stated:
        return []
    return [Doubt("units", (
        f"Successive {what} scatter by {scatter:.3g} {unit} at most, while their stated standard "
        f"deviation is {stated:.3g} {unit} (medians): look at the unit of {look}."))]


def _unit_factor(a, b):
    """The ratio a / b; 1 if a / b and b / a are at most MIN_FACTOR, or b is zero."""
    ratio = a / b if b > 0 else 1.0
    return ratio if ratio > MIN_FACTOR or ratio < 1 / MIN_FACTOR else 1.0
