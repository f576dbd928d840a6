"""Problems 3 and 4: the factor graph in GTSAM.

The variables are X(i), the pose in row i of the encoder file, for the poses with a measurement;
L(id), the pose of a marker, or P(id), its position where no sighting has a heading; A(id), the
position of an antenna; and W(0), the wheel parameters [R_R, R_L, b] in standard deviations from
what is stated. Poses are gtsam.Pose2, positions gtsam.Point2, all in the frame of pose 1.

    odometry    log(Delta(w)^-1 X_i^-1 X_k)        a custom factor (`batch`): all share w
    sighting    log(Z^-1 X^-1 L)                   BetweenFactorPose2, or BearingRangeFactor2D
    range       |A - p| - r                        RangeFactor2D, with a robust kernel

Decisions are what enters the graph, and how much it counts. `count_everything` decides nothing: all
measurements count as the files state them, which is the plain solver of chapters 3 and 4.
`robust.solution` decides more, and builds the graph that is handed in. GTSAM moves a pose by
X exp(xi): errors and covariances of its poses are in the axes of the pose itself.
"""

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, P, W, X

from slamlib.core import odometry, se2
from slamlib.core.batch import Batch
from slamlib.core.errors import require
from slamlib.core.increments import TYPICAL_SLIP, OdometryIncrements, odometry_error, preintegrate
from slamlib.core.kernels import KERNELS, ONE_SIDED_BIAS, kernel_of, symmetric
from slamlib.core.records import (
    NO_RANGES,
    NO_SIGHTINGS,
    AntennaGuess,
    ArucoReadings,
    Dataset,
    UwbReadings,
)
from slamlib.core.sightings import MAX_HEADING_SIGMA, consensus

ORIGIN_SIGMA = 1e-5          # m, of the position of pose 1, which is zero by definition
GUESS_PRIOR_SIGMA = 5.0      # m, of an antenna about its guessed position
INDICES = 2**56              # number of indices of a symbol; those of ids below 0 are the last


@dataclass(frozen=True)
class Decisions:
    """What enters the graph of a drive, with which noise."""

    odometry: OdometryIncrements
    slip: float                          # sqrt(m), sigma of a wheel's slip after one metre
    sigma_heading: float                 # rad, of pose 1
    root_wheel: np.ndarray               # (3, 3) m: root root^T is the wheels' prior covariance
    sightings: ArucoReadings             # those that count, in the vehicle, with their covariances
    ranges: UwbReadings                  # those that count, with their standard deviations
    guess: AntennaGuess | None
    points: np.ndarray                   # ids of the markers whose heading no sighting knows
    sighting_share: np.ndarray           # (s,) of its information that each sighting keeps
    range_share: np.ndarray              # (r,)
    kernel: str                          # name in `kernels.KERNELS`; of ranges alone if asymmetric


def require_rows(dataset: Dataset, poses: np.ndarray, source: str):
    """Raise DatasetError, which names the source, unless poses are rows of a Dataset's ticks."""
    count = len(dataset.ticks)
    for pose in poses:
        is_whole = isinstance(pose, int | np.integer) and not isinstance(pose, bool)
        require(is_whole and 0 <= pose < count, source, f"rows from 0 to {count - 1} for poses",
                pose)


def count_everything(dataset: Dataset, kernel: str = "Cauchy", slip: float = TYPICAL_SLIP,
                     extra: np.ndarray = ()) -> Decisions:
    """The Decisions by which all measurements of a Dataset count as its files state them.

    `kernel` is a name in `kernels.KERNELS`, of sightings and ranges, `slip` is in sqrt(m), and
    `extra` are further encoder poses that are variables. Camera, size of the markers, offset and
    scale of the ranges are as stated, and the delay of the sightings to whole steps; the delay of
    the ranges and the height of the antennas are ignored, and the tag is at the vehicle's origin.
    Raises DatasetError for another kernel, slip or pose.
    """
    known = ", ".join(KERNELS)
    require(kernel in KERNELS, "count_everything", f"one of {known} for kernel", kernel)
    require(0 < slip < np.inf, "count_everything", "a slip above 0", slip)
    require_rows(dataset, extra, "count_everything")
    sightings = dataset.sightings or NO_SIGHTINGS
    ranges = dataset.ranges or NO_RANGES
    ends = [0, len(dataset.ticks) - 1]
    frames = np.unique(np.concatenate([ends, sightings.pose, ranges.pose, extra]).astype(int))
    return Decisions(
        odometry=preintegrate(dataset, frames),
        slip=slip,
        sigma_heading=dataset.vehicle.sigma_heading,
        root_wheel=np.diag(dataset.vehicle.sigma_wheel),
        sightings=sightings,
        ranges=ranges,
        guess=dataset.antenna_guess,
        points=markers_without_heading(sightings),
        sighting_share=np.ones(len(sightings.pose)),
        range_share=np.ones(len(ranges.pose)),
        kernel=kernel)


def build_graph(decisions: Decisions) -> gtsam.NonlinearFactorGraph:
    """The factor graph of Decisions."""
    graph = gtsam.NonlinearFactorGraph()
    add_priors(graph, decisions)
    add_odometry(graph, decisions)
    add_sightings(graph, decisions)
    add_ranges(graph, decisions)
    return graph


def add_priors(graph: gtsam.NonlinearFactorGraph, decisions: Decisions):
    """Add the priors of pose 1, of the wheel parameters, and of the antennas with ranges."""
    noise = gtsam.noiseModel
    origin = noise.Diagonal.Sigmas([ORIGIN_SIGMA, ORIGIN_SIGMA, decisions.sigma_heading])
    graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), origin))
    graph.add(gtsam.PriorFactorVector(W(0), np.zeros(3), noise.Unit.Create(3)))
    add_antenna_priors(graph, decisions.guess, decisions.ranges.antenna)


def add_antenna_priors(graph: gtsam.NonlinearFactorGraph, guess: AntennaGuess | None,
                       antennas: np.ndarray):
    """Add the prior of each of these antennas, ids (r,), about its guess."""
    noise = gtsam.noiseModel.Isotropic.Sigma(2, GUESS_PRIOR_SIGMA)
    for antenna, position in guessed(guess, antennas).items():
        graph.add(gtsam.PriorFactorPoint2(A(antenna), position, noise))


def guessed(guess: AntennaGuess | None, antennas: np.ndarray) -> dict[int, np.ndarray]:
    """The guessed position (2,) in m of each of these antennas, by the index of its symbol."""
    known = {} if guess is None else dict(zip(guess.antenna.tolist(), guess.position))
    heard = np.unique(antennas).tolist()
    missing = [antenna for antenna in heard if antenna not in known]
    require(not missing, "antenna_guess", "a guess of each antenna with ranges", missing)
    return {index_of(antenna): known[antenna] for antenna in heard}


def index_of(landmark: int) -> int:
    """The index of the symbol of a marker or antenna by its id, which may be negative."""
    return int(landmark) % INDICES


def id_of(key: int) -> int:
    """The id of a marker or antenna by the key of its symbol, the inverse of `index_of`."""
    index = gtsam.symbolIndex(key)
    return index if index < INDICES // 2 else index - INDICES


def add_odometry(graph: gtsam.NonlinearFactorGraph, decisions: Decisions):
    """Add a factor between successive frames, which all depend on the same wheel parameters."""
    increments = decisions.odometry
    root = decisions.root_wheel
    keys = [X(i) for i in increments.frame.tolist()]

    def errors_at(from_pose, to_pose, whitened):
        poses = np.append(from_pose, to_pose[-1:], axis=0)       # of all frames in their order
        wheel = increments.stated + root @ whitened[0]           # that of every increment
        e, by_poses, by_wheel = odometry_error(increments, poses, wheel)
        return e, [by_poses[:, :, :3], by_poses[:, :, 3:], by_wheel @ root]

    batch = Batch([keys[:-1], keys[1:], [W(0)] * len(keys[1:])], errors_at)
    for k, covariance in enumerate(increments.covariance(decisions.slip)):
        graph.add(batch.factor(k, gtsam.noiseModel.Gaussian.Covariance(covariance)))


def noise_model(covariance: np.ndarray, kernel: str, share: float) -> gtsam.noiseModel.Base:
    """GTSAM's noise of a measurement that keeps a share of its information, with a kernel.

    The share multiplies the loss. A covariance divided by the share multiplies whitened errors by
    the root of the share, so the scale of the kernel is multiplied by this root, too.
    """
    gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance / share)
    robust = kernel_of(kernel, width=share**0.5)
    return gaussian if robust is None else gtsam.noiseModel.Robust.Create(robust, gaussian)


def markers_without_heading(sightings: ArucoReadings) -> np.ndarray:
    """Ids (k,) of the markers of which no sighting knows the heading."""
    known = sightings.covariance[:, 2, 2] < MAX_HEADING_SIGMA**2
    return np.setdiff1d(sightings.marker, sightings.marker[known])


def add_sightings(graph: gtsam.NonlinearFactorGraph, decisions: Decisions):
    """Add a factor for each sighting.

    The files give the covariance C of Z in the axes of the vehicle; the error of a marker's pose
    lives in those of the measured pose, R(heading)^T C R(heading) (equation 3.1).
    """
    sightings = decisions.sightings
    kernel = symmetric(decisions.kernel)
    in_axes_of_marker = se2.rotate_covariance(
        sightings.covariance, -sightings.marker_in_vehicle[:, 2])
    for k, z in enumerate(sightings.marker_in_vehicle):
        pose = X(sightings.pose[k])
        share = decisions.sighting_share[k]
        marker = sightings.marker[k]
        if marker in decisions.points:
            bearing, distance, C = polar(z, sightings.covariance[k])
            noise = noise_model(C, kernel, share)
            graph.add(gtsam.BearingRangeFactor2D(
                pose, P(index_of(marker)), bearing, distance, noise))
        else:
            noise = noise_model(in_axes_of_marker[k], kernel, share)
            graph.add(gtsam.BetweenFactorPose2(
                pose, L(index_of(marker)), gtsam.Pose2(*z), noise))


def polar(z: np.ndarray, C: np.ndarray) -> tuple[gtsam.Rot2, float, np.ndarray]:
    """Bearing and distance of a sighting z (3,), and their covariance (2, 2) by C (3, 3)."""
    x, y = z[:2]
    distance = np.hypot(x, y)
    bearing = np.arctan2(y, x)
    by_position = np.array([[-y / distance**2, x / distance**2], [x / distance, y / distance]])
    return gtsam.Rot2(bearing), distance, by_position @ C[:2, :2] @ by_position.T


def add_ranges(graph: gtsam.NonlinearFactorGraph, decisions: Decisions):
    """Add a factor for each range, less the bias of a one-sided kernel."""
    ranges = decisions.ranges
    kernel = decisions.kernel
    measured = ranges.range - ONE_SIDED_BIAS.get(kernel, 0.0) * ranges.sigma
    for k, sigma in enumerate(ranges.sigma):
        pose = X(ranges.pose[k])
        antenna = A(index_of(ranges.antenna[k]))
        noise = noise_model(np.array([[sigma**2]]), kernel, decisions.range_share[k])
        graph.add(gtsam.RangeFactor2D(pose, antenna, measured[k], noise))


def initial_values(dataset: Dataset, decisions: Decisions) -> gtsam.Values:
    """Poses by odometry, markers at the consensus of their sightings, antennas at the guesses."""
    values = gtsam.Values()
    values.insert(W(0), np.zeros(3))
    poses, covariances = odometry.first_order(
        dataset.ticks, dataset.vehicle, model=decisions.odometry.model)
    for i in decisions.odometry.frame.tolist():
        values.insert(X(i), gtsam.Pose2(*poses[i]))
    sightings = decisions.sightings
    i = sightings.pose
    in_world, C = se2.compose_uncertain(
        poses[i], covariances[i], sightings.marker_in_vehicle, sightings.covariance)
    for k in consensus(sightings.marker, in_world, C):
        marker = index_of(sightings.marker[k])
        if sightings.marker[k] in decisions.points:
            values.insert(P(marker), in_world[k, :2])
        else:
            values.insert(L(marker), gtsam.Pose2(*in_world[k]))
    for antenna, position in guessed(decisions.guess, decisions.ranges.antenna).items():
        values.insert(A(antenna), position)
    return values
