"""Places of an antenna from ranges to it, by robust trilateration.

It serves the start values (stage 5) and the antennas in doubt (stage 7).
"""

from dataclasses import dataclass

import numpy as np

from slamlib.slam.measurement_factors import GUESS_PRIOR_SIGMA

MAX_RANGES = 150     # ranges of an antenna that are used here, evenly chosen
SAME_PLACE = 0.2     # of the median range: places closer than this are one
KERNEL_SCALE = 2.0   # sigmas, of the Cauchy loss of ranges
DIRECTIONS = 8       # around the path from which the search starts
MAX_STEPS = 60       # of the search
STEP_TOLERANCE = 1e-6        # m, of a step at which it ends
SMALLEST_CURVATURE = 1e-3    # of the larger one


@dataclass(frozen=True)
class AntennaRanges:
    """The ranges to one antenna, and from where they were measured."""

    positions: np.ndarray    # (m, 2) m, of the vehicle
    distance: np.ndarray     # (m,) m
    sigma: np.ndarray        # (m,) m, that of the vehicle's position included
    guess: np.ndarray        # (2,) m

    def evenly_chosen(self):
        """At most MAX_RANGES of these."""
        chosen = np.unique(np.linspace(0, len(self.distance) - 1, MAX_RANGES).astype(int))
        return AntennaRanges(
            self.positions[chosen], self.distance[chosen], self.sigma[chosen], self.guess)


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
    guess, middle, radius = ranges.guess, ranges.positions.mean(0), np.median(ranges.distance)
    angle = np.arange(DIRECTIONS) * 2 * np.pi / DIRECTIONS
    circle = middle + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
    minima, cost = _minima(
        ranges.evenly_chosen(), np.concatenate([[guess, 2 * middle - guess], circle]))
    separate = []
    for k in np.argsort(cost, kind="stable"):
        if all(np.hypot(*(minima[k] - minima[other])) > SAME_PLACE * radius for other in separate):
            separate.append(k)
    return minima[separate], cost[separate] - cost[separate[0]]


def _minima(ranges, places):
    """Minima (p, 2) of the Cauchy cost that are reached from `places` (p, 2), and their costs (p,).

    Newton's method from all places at once. Where the cost is not convex, its second derivatives
    count by their absolute values; a step that does not descend is repeated with more damping.
    """
    damping, (cost, gradient, hessian) = np.full(len(places), 1e-3), _cost(ranges, places)
    for _ in range(MAX_STEPS):
        curvature, axes = np.linalg.eigh(hessian)
        least = SMALLEST_CURVATURE * np.abs(curvature).max(axis=1, keepdims=True)
        curvature = np.maximum(np.abs(curvature), least) * (1 + damping[:, None])
        along = np.einsum("pik,pi->pk", axes, gradient) / curvature
        step = -np.einsum("pik,pk->pi", axes, along)
        tried = _cost(ranges, places + step)
        better = tried[0] <= cost
        damping = np.where(better, damping / 10, np.maximum(damping, 0.1) * 10)
        places = np.where(better[:, None], places + step, places)
        for own, new in zip((cost, gradient, hessian), tried):
            own[better] = new[better]
        if (np.abs(step).max(axis=1) < STEP_TOLERANCE).all():
            break
    return places, cost


def _cost(ranges, places):
    """The Cauchy cost (p,) of an antenna at `places` (p, 2), its gradient and second derivatives.

    The guess counts as two more measurements.
    """
    apart, root = places[:, None] - ranges.positions, 1 / ranges.sigma
    distance = np.maximum(np.hypot(apart[..., 0], apart[..., 1]), 1e-9)
    e, by_place = root * (distance - ranges.distance), apart / distance[..., None]
    off = (places - ranges.guess) / GUESS_PRIOR_SIGMA
    slope, bend = _of_cauchy(e)                                  # of the cost by the error
    guess_slope, guess_bend = _of_cauchy(off)
    gradient = ((root * slope)[:, None] @ by_place)[:, 0] + guess_slope / GUESS_PRIOR_SIGMA
    across = root * slope / distance                             # by the direction's turn
    along = (root**2 * bend - across)[..., None] * by_place
    hessian = np.swapaxes(by_place, 1, 2) @ along
    hessian[:, [0, 1], [0, 1]] += across.sum(1)[:, None] + guess_bend / GUESS_PRIOR_SIGMA**2
    cost = np.log1p((e / KERNEL_SCALE)**2).sum(1) + np.log1p((off / KERNEL_SCALE)**2).sum(1)
    return KERNEL_SCALE**2 / 2 * cost, gradient, hessian


def _of_cauchy(e):
    """First and second derivative of the Cauchy cost by the error e."""
    squared = (e / KERNEL_SCALE)**2
    return e / (1 + squared), (1 - squared) / (1 + squared)**2


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
    few = ranges.evenly_chosen()
    sigma = np.hypot(few.sigma, reach / 400)                     # at least half a cell of the grid
    cost = np.sum((place - ranges.guess)**2, axis=-1) / GUESS_PRIOR_SIGMA**2 / 2
    for origin, measured, s in zip(few.positions, few.distance, sigma):
        off = np.hypot(place[..., 0] - origin[0], place[..., 1] - origin[1]) - measured
        cost += KERNEL_SCALE**2 * np.log1p((off / s / KERNEL_SCALE)**2) / 2
    density = radius * np.exp(cost.min() - cost)
    apart = place - estimate
    return np.einsum("abi,abj,ab->ij", apart, apart, density) / density.sum()

