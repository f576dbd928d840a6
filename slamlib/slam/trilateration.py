"""Places of an antenna from ranges to it, by robust trilateration.

It serves the start values (stage 5) and the antennas in doubt (stage 7).
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from slamlib.slam.measurement_factors import GUESS_PRIOR_SIGMA

MAX_RANGES = 150     # ranges of an antenna that are used here, evenly chosen
SAME_PLACE = 0.2     # of the median range: places closer than this are one
KERNEL_SCALE = 2.0   # sigmas, of the Cauchy loss of ranges
DIRECTIONS = 8       # around the path from which the search starts


@dataclass(frozen=True)
class AntennaRanges:
    """The ranges to one antenna, and from where they were measured."""

    positions: np.ndarray    # (m, 2) m, of the vehicle
    distance: np.ndarray     # (m,) m
    sigma: np.ndarray        # (m,) m, that of the vehicle's position included
    guess: np.ndarray        # (2,) m


def ranges_by_antenna(measurements, poses, covariances):
    """List of the AntennaRanges of every antenna.

    The frames' poses (f, 3), m and rad, and covariances (f, 3, 3) are in world axes.
    """
    r, sigma = measurements.ranges, np.sqrt(np.trace(covariances[:, :2, :2], axis1=1, axis2=2) / 2)
    each = [np.flatnonzero(r.antenna == k) for k in range(len(measurements.antenna))]
    return [AntennaRanges(poses[r.row[own], :2], r.distance[own],
                          np.hypot(r.sigma[own], sigma[r.row[own]]), guess)
            for own, guess in zip(each, measurements.guess)]


def trilaterate(ranges):
    """Possible places of an antenna with these AntennaRanges: minima of a Cauchy cost.

    The search starts at the guess, at its point reflection in the path's middle, and at points on a
    circle about this middle in DIRECTIONS, with the median range as radius.

    Returns
    -------
    places : (p, 2) m, further apart than SAME_PLACE, in the order of their costs.
    costs : (p,) above the least one, in units of log odds.
    """
    chosen = _evenly_chosen(ranges)
    origin, measured = ranges.positions[chosen], ranges.distance[chosen]
    root = 1 / ranges.sigma[chosen]
    guess = ranges.guess

    def residuals(place):
        distance = np.hypot(*(place - origin).T)
        return np.concatenate([root * (distance - measured), (place - guess) / GUESS_PRIOR_SIGMA])

    def jacobian(place):
        apart = place - origin
        direction = apart / np.maximum(np.hypot(*apart.T), 1e-9)[:, None]
        return np.concatenate([root[:, None] * direction, np.eye(2) / GUESS_PRIOR_SIGMA])

    middle, radius = ranges.positions.mean(0), np.median(ranges.distance)
    angle = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    circle = middle + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    minima = [least_squares(residuals, start, jacobian, loss="cauchy", f_scale=KERNEL_SCALE)
              for start in (guess, 2 * middle - guess, *circle)]
    separate = []
    for minimum in sorted(minima, key=lambda minimum: minimum.cost):
        if all(np.hypot(*(minimum.x - other.x)) > SAME_PLACE * radius for other in separate):
            separate.append(minimum)
    costs = np.array([minimum.cost for minimum in separate])
    return np.array([minimum.x for minimum in separate]), costs - costs[0]


def second_moment(ranges, estimate):
    """Second moment (2, 2) m^2 of an antenna's place about its estimate (2,), by AntennaRanges.

    For an antenna that its ranges do not determine, so that no ellipse describes its place. The
    posterior, the Cauchy likelihood of the ranges times the guess, is summed over a polar grid. The
    cost is added range by range: the whole grid times all ranges would take 500 MB.
    """
    middle = ranges.positions.mean(0)
    reach = 1.5 * ranges.distance.max() + np.ptp(ranges.positions, axis=0).max()
    radius, angle = np.meshgrid(np.linspace(0, reach, 200)[1:], np.linspace(-np.pi, np.pi, 361)[1:])
    place = middle + radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    chosen = _evenly_chosen(ranges)
    sigma = np.hypot(ranges.sigma[chosen], reach / 400)          # at least half a cell of the grid
    cost = np.sum((place - ranges.guess)**2, axis=-1) / GUESS_PRIOR_SIGMA**2 / 2
    for origin, measured, s in zip(ranges.positions[chosen], ranges.distance[chosen], sigma):
        off = np.hypot(place[..., 0] - origin[0], place[..., 1] - origin[1]) - measured
        cost += KERNEL_SCALE**2 * np.log1p((off / s / KERNEL_SCALE)**2) / 2
    density = radius * np.exp(cost.min() - cost)
    apart = place - estimate
    return np.einsum("abi,abj,ab->ij", apart, apart, density) / density.sum()


def _evenly_chosen(ranges):
    """Rows of at most MAX_RANGES of them."""
    return np.unique(np.linspace(0, len(ranges.distance) - 1, MAX_RANGES).astype(int))
