"""Stage 7: antennas whose place their ranges do not settle."""

from dataclasses import dataclass

import numpy as np

from slamlib.slam.trilateration import SAME_PLACE, ranges_by_antenna, second_moment, trilaterate

MIN_RANGES = 5               # accepted ranges of an antenna that is not in doubt
MAX_RELATIVE_SIGMA = 0.025   # of its median range: largest sigma of an antenna not in doubt
MAX_LOG_ODDS = np.log(1000)  # another place remains possible below these log odds


@dataclass(frozen=True)
class AntennaDoubts:
    """Which antennas are in doubt, and the covariances that include it."""

    sentences: dict          # antenna id: why
    covariances: np.ndarray  # (a, 2, 2) m^2, in doubt at least the second moment of all places


def antenna_doubts(measurements, state, frame_covariances, covariances, range_weight):
    """The AntennaDoubts about a State of Measurements.

    From covariances (f, 3, 3) of the frames and (a, 2, 2) of the antennas, and the share of its
    information that each range keeps, `range_weight` (r,).
    """
    sentences, covariances = {}, covariances.copy()
    each = ranges_by_antenna(measurements, state.poses, frame_covariances)
    for k, (antenna, ranges) in enumerate(zip(measurements.antenna.tolist(), each)):
        count = np.count_nonzero(range_weight[measurements.ranges.antenna == k] > 0.5)
        sentence = _doubt(ranges, state.antennas[k], covariances[k], count)
        if sentence is not None:
            sentences[antenna] = sentence
            covariances[k] = max(covariances[k], second_moment(ranges, state.antennas[k]),
                                 key=np.trace)
    return AntennaDoubts(sentences, covariances)


def _doubt(ranges, estimate, covariance, count):
    """Why an antenna of which `count` ranges are accepted is in doubt, or None."""
    distance = np.median(ranges.distance)
    places, costs = trilaterate(ranges)
    other = np.hypot(*(places - estimate).T) > SAME_PLACE * distance
    possible = places[other & (costs < MAX_LOG_ODDS)]
    if count < MIN_RANGES:
        return f"only {count} of its ranges agree"
    if len(possible):
        return "its ranges fit as well at " + " and ".join(
            "({:.1f}, {:.1f})".format(*place) for place in possible)
    if count < len(ranges.distance) / 2:
        return f"{len(ranges.distance) - count} of its {len(ranges.distance)} ranges disagree"
    if np.sqrt(np.linalg.eigvalsh(covariance)[-1]) > MAX_RELATIVE_SIGMA * distance:
        return "its ranges are too few or come from too few directions"
    return None
