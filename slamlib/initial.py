"""Where the iterations start: poses from odometry, markers and antennas from what was measured there.

A long drive is begun by its first part, on which odometry has not yet lost the heading, and grown:
from the optimum of one part, with the wheels that it calibrated, odometry goes on to the next.
"""

from dataclasses import replace

import numpy as np
from scipy.optimize import least_squares

from slamlib import odometry, se2
from slamlib.factors import vehicle_with
from slamlib.graph import GUESS, State
from slamlib.localization import localize, most_certain

TRUSTED = 0.5        # rad, sigma of odometry's heading at which the first part of a drive ends
VOTES = 60           # sightings of a marker that are asked where it is, at most
ASKED = 150          # ranges to an antenna that are asked where it is, at most
UNDECIDED = np.log(1000)     # difference of costs below which two places are both possible
ONE_PLACE = 0.2      # of the mean range: places this near to each other are one
ROBUST = 2.0         # sigmas, scale of the Cauchy loss of ranges


def parts(dataset):
    """Numbers of encoder poses of the parts of a drive, each at most double the one before."""
    _, covariances = odometry.first_order(dataset.ticks, dataset.vehicle)
    lost = np.flatnonzero(covariances[:, 2, 2] > TRUSTED**2)
    ends = [len(dataset.ticks)]
    first = max(lost[0], 2) if len(lost) else ends[0]
    while ends[0] > 1.5 * first:
        ends.insert(0, max(first, -(-ends[0] // 2)))
    return ends


def prefix(dataset, count):
    """The dataset until the encoder pose number `count`; whole sensors may be missing then."""
    def until(readings):
        before = None if readings is None else readings.pose < count
        if readings is None or not before.any():
            return None
        return replace(readings, **{name: values[before] for name, values in vars(readings).items()})
    return replace(dataset, ticks=dataset.ticks[:count], aruco=until(dataset.aruco),
                   uwb=until(dataset.uwb))


def from_odometry(graph, landmarks="consensus", antennas="trilateration"):
    """Values at odometry's poses; markers and antennas where one of LANDMARKS and ANTENNAS puts them."""
    d = graph.dataset
    poses, covariances = odometry.first_order(d.ticks, d.vehicle, model=graph.model)
    return at(graph, poses[graph.frame], covariances[graph.frame], landmarks=landmarks,
              antennas=antennas)


def grown(graph, earlier, values):
    """Values that go on, by odometry with calibrated wheels, from those of a graph of a first part."""
    state, d = earlier.state(values), graph.dataset
    last = earlier.frame[-1]
    path, spread = odometry.first_order(d.ticks[last:], vehicle_with(d.vehicle, state.w), state.poses[-1],
                                        np.zeros((3, 3)), model=graph.model)
    old = np.searchsorted(earlier.frame, graph.frame[graph.frame <= last])
    new = graph.frame[graph.frame > last] - last
    return at(graph, np.concatenate([state.poses[old], path[new]]),
              np.concatenate([np.zeros((len(old), 3, 3)), spread[new]]), state.w)


def at(graph, poses, covariances, w=np.zeros(3), landmarks="consensus", antennas="trilateration"):
    """Values at the graph poses (f, 3) with covariances (f, 3, 3), and landmarks seen from there."""
    s = graph.sightings
    A, B = se2.compose_jacobians(poses[s.row], s.z)
    spread = A @ covariances[s.row] @ np.swapaxes(A, 1, 2) + B @ s.C @ np.swapaxes(B, 1, 2)
    markers = LANDMARKS[landmarks](graph, se2.compose(poses[s.row], s.z), spread)
    return graph.values(State(poses, markers, ANTENNAS[antennas](graph, poses, covariances), w))


def _first(graph, in_world, spread):
    return in_world[np.unique(graph.label, return_index=True)[1]]


def _most_certain(graph, in_world, spread):
    order = np.lexsort((np.linalg.slogdet(spread)[1], graph.label))
    return in_world[order[np.unique(graph.label[order], return_index=True)[1]]]


def _mean(graph, in_world, spread):
    """Average by information, of angles about the most certain sighting's."""
    middle = _most_certain(graph, in_world, spread)[graph.label]
    apart = in_world - middle
    apart[:, 2] = se2.wrap(apart[:, 2])
    information = np.linalg.inv(spread)
    total, moment = np.zeros((len(graph.marker), 3, 3)), np.zeros((len(graph.marker), 3))
    np.add.at(total, graph.label, information)
    np.add.at(moment, graph.label, (information @ apart[..., None])[..., 0])
    return _first(graph, middle, None) + np.linalg.solve(total, moment[..., None])[..., 0]


def _consensus(graph, in_world, spread):
    asked = _few_of_each(graph.label, VOTES)
    return in_world[asked[most_certain(graph.label[asked], in_world[asked], spread[asked])]]


def _from_problem2(graph, in_world, spread):
    """Problem 2's map, and the consensus for markers that it does not have."""
    markers = _consensus(graph, in_world, spread)
    found = localize(graph.dataset.aruco)
    if found.frame[0] == 0 and np.isfinite(found.poses[0, 0]):          # the same world
        has = np.isin(graph.marker, found.marker)
        markers[has] = found.marker_in_world[np.searchsorted(found.marker, graph.marker[has])]
    return markers


LANDMARKS = {"first sighting": _first, "most certain sighting": _most_certain,
             "mean by information": _mean, "consensus": _consensus, "problem 2's map": _from_problem2}


def _trilaterated(graph, poses, covariances):
    each = zip(ranges_of(graph, poses, covariances), graph.guess)
    return np.reshape([places(*ranges, guess)[0][0] for ranges, guess in each], (-1, 2))


ANTENNAS = {"guess": lambda graph, poses, covariances: graph.guess, "trilateration": _trilaterated}


def _few_of_each(label, most):
    """Rows of at most `most` entries of every label, evenly chosen."""
    order = np.argsort(label, kind="stable")
    count = np.bincount(label)[label[order]]
    begins = np.searchsorted(label[order], label[order])
    number = np.arange(len(order)) - begins
    few = np.minimum(count, most)
    return np.sort(order[(number * few) // count != ((number - 1) * few) // count])


def ranges_of(graph, poses, covariances):
    """For every antenna: positions (m, 2) it was ranged from, ranges (m,), their sigmas (m,).

    `poses` (f, 3) and `covariances` (f, 3, 3) are those of the graph; the positions' sigmas add to the
    ranges'.
    """
    sigma = np.sqrt(np.trace(covariances[:, :2, :2], axis1=1, axis2=2) / 2)
    for k in range(len(graph.antenna)):
        of = np.flatnonzero(graph.tag == k)
        row = graph.tag_row[of]
        yield poses[row, :2], graph.range[of], np.hypot(graph.sigma[of], sigma[row])


def _asked(ranges):
    """Rows of at most ASKED of them, evenly chosen."""
    return np.unique(np.linspace(0, len(ranges) - 1, ASKED).astype(int))


def places(positions, ranges, sigma, guess):
    """Where an antenna may be: robust trilateration from many starts.

    Parameters
    ----------
    positions : (m, 2) from where it was ranged; ranges, sigma : (m,), all in m.
    guess : (2,) its position as guessed, worth GUESS where the ranges do not decide.

    Returns
    -------
    place : (p, 2) local minima of the Cauchy cost that are apart from each other, the best first.
    cost : (p,) relative to the best, in units of log odds.
    """
    few = _asked(ranges)
    origin, measured, root = positions[few], ranges[few], 1 / sigma[few]

    def residuals(place):
        distance = np.hypot(*(place - origin).T)
        return np.concatenate([root * (distance - measured), (place - guess) / GUESS])

    def jacobian(place):
        apart = place - origin
        along = apart / np.maximum(np.hypot(*apart.T), 1e-9)[:, None]
        return np.concatenate([root[:, None] * along, np.eye(2) / GUESS])

    middle, radius = positions.mean(0), np.median(ranges)
    angle = np.arange(8) * np.pi / 4
    starts = [guess, 2 * middle - guess, *middle + radius * np.stack([np.cos(angle), np.sin(angle)], -1)]
    ends = [least_squares(residuals, start, jacobian, loss="cauchy", f_scale=ROBUST) for start in starts]
    ends = sorted(ends, key=lambda end: end.cost)
    apart = []
    for end in ends:
        if all(np.hypot(*(end.x - other.x)) > ONE_PLACE * radius for other in apart):
            apart.append(end)
    return np.array([end.x for end in apart]), np.array([end.cost - apart[0].cost for end in apart])


def second_moment(positions, ranges, sigma, guess, about):
    """Second moment (2, 2) in m^2 of an antenna's place about the estimate `about` (2,).

    For an antenna that its ranges do not settle, whose places are no ellipse: the posterior, Cauchy
    likelihood of the ranges times the guess, is summed over a polar grid around the path. Other
    parameters as of `places`.
    """
    middle, reach = positions.mean(0), 1.5 * ranges.max() + np.ptp(positions, axis=0).max()
    radius, angle = np.meshgrid(np.linspace(0, reach, 200)[1:], np.linspace(-np.pi, np.pi, 361)[1:])
    place = middle + radius[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1)
    few = _asked(ranges)
    off = np.linalg.norm(place[..., None, :] - positions[few], axis=-1) - ranges[few]
    coarse = np.hypot(sigma[few], reach / 400)                     # a cell is not sharper than its size
    cost = np.sum(ROBUST**2 * np.log1p((off / coarse / ROBUST)**2), axis=-1) / 2 \
        + np.sum((place - guess)**2, axis=-1) / GUESS**2 / 2
    density = radius * np.exp(cost.min() - cost)
    apart = place - about
    return np.einsum("abi,abj,ab->ij", apart, apart, density) / density.sum()
