"""Stage 4: start values. Poses from odometry, markers by consensus, antennas by trilateration.

On a long drive odometry loses the heading. Therefore its first part is solved by the robust rounds
of stage 5. Odometry with the wheels that this part calibrated then predicts the poses of a longer
part, and so on.
"""

import numpy as np

from slamlib import odometry, se2
from slamlib.sightings import consensus, evenly_chosen
from slamlib.slam.measurements import measure
from slamlib.slam.noise import Noise, with_known
from slamlib.slam.odometry_factors import preintegrate_odometry
from slamlib.slam.problem import build_problem
from slamlib.slam.robust import narrow_kernels
from slamlib.slam.state import state_from_arrays
from slamlib.slam.trilateration import ranges_by_antenna, trilaterate

MAX_ODOMETRY_SIGMA = 0.5     # rad, of odometry's heading at the end of a drive's first part
MAX_FIRST_PART = 1.5         # length of the first part over that which odometry can predict
GROWTH = 4                   # largest ratio of the numbers of poses of a part and the one before
MAX_VOTES = 60               # number of sightings of a marker that enter its consensus


def initial_state(measurements, model, preintegrate=preintegrate_odometry):
    """The State from which a drive is solved; `model` and `preintegrate` as in `build_problem`.

    Raises DatasetError as `optimize`, for the first part of a long drive.
    """
    dataset, noise = measurements.dataset, with_known(Noise(), measurements.dataset.vehicle)
    part, state = None, None
    for count in part_lengths(dataset):
        whole = count == len(dataset.ticks)
        earlier, part = part, measurements if whole else measure(dataset.first(count))
        state = odometry_state(part, model) if earlier is None else extended(
            part, model, earlier, state)
        if not whole:
            problem = build_problem(part, model, noise, preintegrate=preintegrate)
            state = narrow_kernels(problem, state)
    return state


def part_lengths(dataset):
    """List of the numbers of encoder poses of the parts of a drive, which all start at pose 1.

    Each part is at most GROWTH times as long as the one before; the last one is the whole drive.
    """
    _, covariances = odometry.first_order(
        dataset.ticks, dataset.vehicle, initial_covariance=np.zeros((3, 3)))
    lost = np.flatnonzero(covariances[:, 2, 2] > MAX_ODOMETRY_SIGMA**2)
    ends = [len(dataset.ticks)]
    first = max(lost[0], 2) if len(lost) else ends[0]
    while ends[0] > MAX_FIRST_PART * first:
        ends.insert(0, max(first, -(-ends[0] // GROWTH)))
    return ends


def odometry_state(measurements, model, **landmarks):
    """The State with poses by odometry of the model "arc" or "euler".

    `landmarks` are the keywords `markers` and `antennas` of `state_from_poses`.
    """
    d, frame = measurements.dataset, measurements.frame
    poses, covariances = odometry.first_order(d.ticks, d.vehicle, model=model)
    return state_from_poses(measurements, poses[frame], covariances[frame], **landmarks)


def extended(measurements, model, part, solved):
    """The State of Measurements of which a first `part` has the State `solved`.

    Later poses are those of odometry from the last pose of the part, with its wheels.
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
    """(k, 3) poses of the markers, each by one of its sightings.

    It is the most certain one with at least half the maximum support (`sightings.consensus`).

    `in_world` (s, 3) and `covariances` (s, 3, 3) are the marker poses by each sighting.
    """
    chosen = evenly_chosen(measurements.marker_row, MAX_VOTES)
    best = consensus(measurements.marker_row[chosen], in_world[chosen], covariances[chosen])
    return in_world[chosen[best]]


def trilaterated_antennas(measurements, poses, covariances):
    """(a, 2) positions of the antennas, m, by the best minimum of their trilateration."""
    by_antenna = ranges_by_antenna(measurements, poses, covariances)
    return np.reshape([trilaterate(ranges)[0][0] for ranges in by_antenna], (-1, 2))


def state_from_poses(measurements, poses, covariances, w=np.zeros(3), markers=consensus_markers,
                     antennas=trilaterated_antennas):
    """The State with these poses of the frames, and landmarks by their measurements from there.

    Poses (f, 3) and covariances (f, 3, 3) are in world axes, w (3,) in units of sigma. The
    functions `markers` and `antennas` initialise the landmarks; studies pass others.
    """
    s = measurements.sightings
    A, B = se2.compose_jacobians(poses[s.row], s.z)
    C = A @ covariances[s.row] @ np.swapaxes(A, 1, 2) + B @ s.C @ np.swapaxes(B, 1, 2)
    return state_from_arrays(
        measurements, poses, markers(measurements, se2.compose(poses[s.row], s.z), C),
        antennas(measurements, poses, covariances), w)
