"""Stage 7: antennas whose position the ranges do not determine."""

import numpy as np

from slamlib.slam.factors import MIN_DISTANCE
from slamlib.slam.initialization import SAME_PLACE, ranges_by_antenna, second_moment, trilaterate
from slamlib.slam.measurements import GUESS_PRIOR_SIGMA

MIN_ACCEPTED_RANGES = 5      # number of accepted ranges of an antenna that is not in doubt
MAX_RELATIVE_SIGMA = 0.025   # of the median range: largest sigma of an antenna not in doubt
MAX_LOG_ODDS = np.log(1000)  # log odds below which another position remains possible


def antenna_doubts(problem, state, frame_covariances, covariances, range_weight):
    """Reasons to doubt antennas, and covariances that include the doubt, at a Problem's solution.

    From covariances (f, 3, 3) of the frames and (a, 2, 2) of the antennas, in world axes, and the
    share `range_weight` (r,) of its information that each range keeps.

    Returns
    -------
    sentences : dict of the reason for each antenna in doubt, by its id.
    covariances : (a, 2, 2) m^2, in doubt at least the second moment of the position.
    """
    m, r, sentences, covariances = (
        problem.measurements, problem.measurements.ranges, {}, covariances.copy())
    by_antenna = ranges_by_antenna(
        m, state.poses, frame_covariances, state.c, problem.noise.ranges)
    for k, (antenna, ranges) in enumerate(zip(m.antenna.tolist(), by_antenna)):
        sentence = _doubt(ranges, state.antennas[k], range_weight[r.antenna == k])
        if sentence is not None:
            sentences[antenna] = sentence
            covariances[k] = max(covariances[k], second_moment(ranges, state.antennas[k]),
                                 key=np.trace)
    return sentences, covariances


def _doubt(ranges, estimate, weight):
    """The reason why an antenna is in doubt whose ranges have the weights (m,), or None."""
    distance, count = np.median(ranges.distance), np.count_nonzero(weight > 0.5)
    places, costs = trilaterate(ranges)
    elsewhere = np.hypot(*(places - estimate).T) > SAME_PLACE * distance
    possible = places[elsewhere & (costs < MAX_LOG_ODDS)]
    if count < MIN_ACCEPTED_RANGES:
        return f"only {count} of its {len(ranges.distance)} ranges agree"
    if len(possible):
        return "its ranges fit as well at " + " and ".join(
            "({:.1f}, {:.1f})".format(*place) for place in possible)
    if count < len(ranges.distance) / 2:
        return f"{len(ranges.distance) - count} of its {len(ranges.distance)} ranges disagree"
    if _sigma_by_ranges(ranges, estimate, weight) > MAX_RELATIVE_SIGMA * distance:
        return "its ranges are too few or come from too few directions"
    return None


def _sigma_by_ranges(ranges, estimate, weight):
    """Largest standard deviation in m of an antenna, in any direction, by its ranges alone.

    Its covariance in the world also includes the uncertain heading of pose 1, which rotates the
    whole map.
    """
    difference = estimate - ranges.positions
    direction = difference / np.maximum(np.hypot(*difference.T), MIN_DISTANCE)[:, None]
    information = direction.T @ (direction * (weight / ranges.sigma**2)[:, None])
    return 1 / np.sqrt(max(np.linalg.eigvalsh(information)[0], GUESS_PRIOR_SIGMA**-2))
