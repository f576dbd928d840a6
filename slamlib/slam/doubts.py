"""Stage 7: antennas whose place their ranges do not settle."""

from dataclasses import dataclass, replace

import numpy as np

from slamlib.slam.measurement_factors import GUESS_PRIOR_SIGMA
from slamlib.slam.trilateration import SAME_PLACE, ranges_by_antenna, second_moment, trilaterate

MIN_RANGES = 5               # accepted ranges of an antenna that is not in doubt
MAX_RELATIVE_SIGMA = 0.025   # of its median range: largest sigma of an antenna not in doubt
MAX_LOG_ODDS = np.log(1000)  # another place remains possible below these log odds


@dataclass(frozen=True)
class AntennaDoubts:
    """Which antennas are in doubt, and the covariances that include it."""

    sentences: dict          # antenna id: why
    covariances: np.ndarray  # (a, 2, 2) m^2, in doubt at least the second moment of all places


def antenna_doubts(problem, state, frame_covariances, covariances, range_weight):
    """The AntennaDoubts about the State that solves a Problem.

    From covariances (f, 3, 3) of the frames and (a, 2, 2) of the antennas, and the share of its
    information that each range keeps, `range_weight` (r,).
    """
    measurements, sentences, covariances = problem.measurements, {}, covariances.copy()
    offset, scale = state.range_calibration
    r = measurements.ranges
    corrected = replace(r, distance=(r.distance - offset) / scale,
                        sigma=r.sigma * problem.noise.ranges / scale)
    each = ranges_by_antenna(replace(measurements, ranges=corrected), state.poses,
                             frame_covariances)
    for k, (antenna, ranges) in enumerate(zip(measurements.antenna.tolist(), each)):
        weight = range_weight[measurements.ranges.antenna == k]
        sentence = _doubt(ranges, state.antennas[k], weight)
        if sentence is not None:
            sentences[antenna] = sentence
            covariances[k] = max(covariances[k], second_moment(ranges, state.antennas[k]),
                                 key=np.trace)
    return AntennaDoubts(sentences, covariances)


def _doubt(ranges, estimate, weight):
    """Why an antenna whose ranges have the weights (m,) is in doubt, or None."""
    distance, count = np.median(ranges.distance), np.count_nonzero(weight > 0.5)
    places, costs = trilaterate(ranges)
    other = np.hypot(*(places - estimate).T) > SAME_PLACE * distance
    possible = places[other & (costs < MAX_LOG_ODDS)]
    if count < MIN_RANGES:
        return f"only {count} of its {len(ranges.distance)} ranges agree"
    if len(possible):
        return "its ranges fit as well at " + " and ".join(
            "({:.1f}, {:.1f})".format(*place) for place in possible)
    if count < len(ranges.distance) / 2:
        return f"{len(ranges.distance) - count} of its {len(ranges.distance)} ranges disagree"
    if _own_sigma(ranges, estimate, weight) > MAX_RELATIVE_SIGMA * distance:
        return "its ranges are too few or come from too few directions"
    return None


def _own_sigma(ranges, estimate, weight):
    """Largest standard deviation in m of an antenna by its ranges alone, in any direction.

    Its covariance in the world has the uncertain heading of pose 1 as well, which turns the whole
    map and says nothing about the antenna.
    """
    apart = estimate - ranges.positions
    direction = apart / np.maximum(np.hypot(*apart.T), 1e-9)[:, None]
    information = direction.T @ (direction * (weight / ranges.sigma**2)[:, None])
    return 1 / np.sqrt(max(np.linalg.eigvalsh(information)[0], GUESS_PRIOR_SIGMA**-2))
