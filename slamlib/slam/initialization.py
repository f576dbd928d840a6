"""Stage 5: start values. Poses from odometry, markers by consensus, antennas by trilateration.

On a long drive odometry loses the heading. There the first part is solved, then odometry with the
wheels that this part calibrated predicts the next poses, until there are GROWTH times as many, and
so on.
"""

import numpy as np

from slamlib import odometry, se2
from slamlib.sightings import consensus, evenly_chosen
from slamlib.slam.measurements import measure
from slamlib.slam.noise import Noise, with_known
from slamlib.slam.odometry_factors import odometry_factors
from slamlib.slam.problem import build
from slamlib.slam.robust import narrow_kernels
from slamlib.slam.state import state_from_arrays
from slamlib.slam.trilateration import ranges_by_antenna, trilaterate

MAX_ODOMETRY_SIGMA = 0.5     # rad, of odometry's heading at the end of a drive's first part
GROWTH = 4                   # poses of a part over those of the part before, at most
MAX_VOTES = 60               # sightings of a marker among which the consensus is sought


def initial_state(measurements, model, factors=odometry_factors):
    """The State from which a whole drive is solved; `model` and `factors` as of `problem.build`."""
    dataset, part, state = measurements.dataset, None, None
    for count in parts(dataset):
        whole = count == len(dataset.ticks)
        earlier, part = part, measurements if whole else measure(dataset.first(count))
        state = odometry_state(part, model) if earlier is None else extended(
            part, model, earlier, state)
        if not whole:
            noise = with_known(Noise(), dataset.vehicle)
            state = narrow_kernels(build(part, model, noise, factors=factors), state)
    return state


def parts(dataset):
    """How many encoder poses each part of a drive has; every part starts at pose 1.

    Each is at most GROWTH times as long as the one before; the last one is the whole drive.
    """
    _, covariances = odometry.first_order(
        dataset.ticks, dataset.vehicle, initial_covariance=np.zeros((3, 3)))
    lost = np.flatnonzero(covariances[:, 2, 2] > MAX_ODOMETRY_SIGMA**2)
    ends = [len(dataset.ticks)]
    first = max(lost[0], 2) if len(lost) else ends[0]
    while ends[0] > 1.5 * first:
        ends.insert(0, max(first, -(-ends[0] // GROWTH)))
    return ends


def odometry_state(measurements, model, **landmarks):
    """The State on odometry's poses; `landmarks` are keywords of `state_from_poses`."""
    d, frame = measurements.dataset, measurements.frame
    poses, covariances = odometry.first_order(d.ticks, d.vehicle, model=model)
    return state_from_poses(measurements, poses[frame], covariances[frame], **landmarks)


def extended(measurements, model, part, solved):
    """The State of Measurements whose first frames are those of `part`, with its State `solved`.

    Later frames are on odometry from the last pose of the part, with its wheels.
    """
    d, frame, last = measurements.dataset, measurements.frame, part.frame[-1]
    poses, covariances = odometry.first_order(
        d.ticks[last:], d.vehicle.with_deviation(solved.w), solved.poses[-1], np.zeros((3, 3)),
        model=model)
    old = np.searchsorted(part.frame, frame[frame <= last])
    new = frame[frame > last] - last
    return state_from_poses(
        measurements, np.concatenate([solved.poses[old], poses[new]]),
        np.concatenate([np.zeros((len(old), 3, 3)), covariances[new]]), solved.w)


def consensus_markers(measurements, in_world, covariances):
    """(k, 3) markers, each at its most certain sighting of those that most others agree with.

    `in_world` (s, 3) and `covariances` (s, 3, 3) are where the sightings put their markers.
    """
    chosen = evenly_chosen(measurements.label, MAX_VOTES)
    best = consensus(measurements.label[chosen], in_world[chosen], covariances[chosen])
    return in_world[chosen[best]]


def trilaterated_antennas(measurements, poses, covariances):
    """(a, 2) antennas at the best place of their trilateration."""
    each = ranges_by_antenna(measurements, poses, covariances)
    return np.reshape([trilaterate(ranges)[0][0] for ranges in each], (-1, 2))


def state_from_poses(measurements, poses, covariances, w=np.zeros(3), markers=consensus_markers,
                     antennas=trilaterated_antennas):
    """The State at the frames' poses, with every landmark where its measurements put it.

    Poses (f, 3) and covariances (f, 3, 3) are in world axes, w (3,) in units of sigma. The
    functions `markers` and `antennas` place the landmarks; studies give others.
    """
    s = measurements.sightings
    A, B = se2.compose_jacobians(poses[s.row], s.z)
    spread = A @ covariances[s.row] @ np.swapaxes(A, 1, 2) + B @ s.C @ np.swapaxes(B, 1, 2)
    return state_from_arrays(
        measurements, poses, markers(measurements, se2.compose(poses[s.row], s.z), spread),
        antennas(measurements, poses, covariances), w)
