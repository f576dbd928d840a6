"""Stage 1: all measurements of a dataset as arrays, their weights, their noise and their structure.

Frames are the first encoder pose, the last, and each one with a sighting or a range. Measurements
are numbered: first the s sightings, then the r ranges. Of the three noise parameters, those that a
dataset's Vehicle gives are known; the others are learned from the drive.

Variables are numbered: f poses of frames, k markers, the antennas. Each has three unknowns, in
the order in which they are eliminated, so that the information matrix H consists of blocks (3, 3);
the third unknown of a point has no derivatives. The Structure of H is the same for all states,
kernels and values of the noise.
"""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.noiseModel import mEstimator
from scipy import sparse

from slamlib.core import odometry, se2
from slamlib.core.graph import ORIGIN_SIGMA, guessed
from slamlib.core.increments import SLIP_BOUNDS, TYPICAL_SLIP, odometry_noise
from slamlib.core.records import NO_RANGES, Dataset
from slamlib.core.sightings import (
    MAX_HEADING_SIGMA,
    MIN_MEASUREMENT_SIGMA,
    Sightings,
    sightings_by_frame,
)
from slamlib.core.vehicle import Vehicle
from slamlib.robust.calibration import Calibration, stated_calibration
from slamlib.robust.file_doubts import common_divisor
from slamlib.robust.jumps import NO_JUMPS, Jumps, crawls

NOISE_KEYS = ("slip", "marker_noise_factor", "range_noise_factor")      # of a Vehicle, as in Noise

WEAK_SIGMA = 1e5             # m and rad, of the prior of a marker without accepted sightings


class Noise(NamedTuple):
    """The three noise parameters."""

    slip: float = TYPICAL_SLIP     # sqrt(m), sigma of a wheel's slip after one metre
    sightings: float = 1.0         # factor on the sigmas in ArucoReading.txt
    ranges: float = 1.0            # factor on the sigmas in UwbReading.txt


def with_known(noise: Noise, vehicle: Vehicle) -> Noise:
    """The Noise with the parameters that a Vehicle gives; the slip is at least 1e-5 sqrt(m)."""
    parameters = []
    for own, key in zip(noise, NOISE_KEYS):
        known = getattr(vehicle, key)
        parameters.append(own if known is None else known)
    parameters[0] = max(parameters[0], SLIP_BOUNDS[0])
    return Noise._make(parameters)


def square_root_information(covariance: np.ndarray) -> np.ndarray:
    """Upper triangular U (..., d, d) with U^T U = C^-1, from covariances C: U e is whitened."""
    return np.linalg.cholesky(np.linalg.inv(covariance)).mT


@dataclass(frozen=True)
class Structure:
    """Places of v variables and of the b blocks that connect them in a matrix (3 v, 3 v)."""

    is_pose: np.ndarray      # (v,) bool, the others are points
    rows: np.ndarray         # (v, 3) of the unknowns of every variable
    places: sparse.csc_array     # the matrix with the place of each entry in the data (9 b,)
    diagonal: np.ndarray     # (n,) places of the diagonal in the data of blocks
    variables: np.ndarray    # (m, 2) i and j of the factors: odometry, then sightings, then ranges
    blocks: np.ndarray       # (m, 4) numbers of their blocks (i, i), (i, j), (j, i), (j, j)

    def matrix(self, data: np.ndarray) -> sparse.csc_array:
        """The sparse matrix (n, n), which is symmetric, with the data (9 b,) of its blocks."""
        matrix = copy(self.places)                       # its indices are checked only once
        matrix.data = data[matrix.data]
        return matrix


@dataclass(frozen=True)
class Ranges:
    """Ranges from frames to antennas."""

    row: np.ndarray          # (r,) row of `Measurements.frame`
    antenna: np.ndarray      # (r,) row of `Measurements.antenna`
    distance: np.ndarray     # (r,) m
    sigma: np.ndarray        # (r,) m, at least MIN_MEASUREMENT_SIGMA


@dataclass(frozen=True)
class Measurements:
    """The measurements, with rows of frames, markers and antennas in place of their ids."""

    dataset: Dataset
    frame: np.ndarray        # (f,) encoder pose of every frame, from 0
    path: np.ndarray         # (n, 3) encoder poses by odometry, m and rad; headings continuous
    sightings: Sightings     # s of them
    marker_row: np.ndarray   # (s,) row of `marker`
    marker: np.ndarray       # (k,) ids, ascending
    oriented: np.ndarray     # (k,) bool; a marker without any sighted heading is a point
    ranges: Ranges           # r of them
    antenna: np.ndarray      # (a,) ids, ascending, of antennas with ranges
    guess: np.ndarray        # (a, 2) m, their guessed positions
    calibration: Calibration     # what the Vehicle states of what measurements share
    jumps: Jumps             # where odometry contradicts the markers

    @property
    def as_pose(self) -> np.ndarray:
        """(s,) bool, sightings of markers with a heading."""
        return self.oriented[self.marker_row]

    @property
    def is_bumped(self) -> np.ndarray:
        """(s,) bool, sightings since something moved the camera."""
        return self.frame[self.sightings.row] >= self.jumps.bump

    @property
    def origin_sigma(self) -> np.ndarray:
        """(3,) standard deviations of pose 1: m, m, rad."""
        return np.array([ORIGIN_SIGMA, ORIGIN_SIGMA, self.dataset.vehicle.sigma_heading])

    @property
    def measured(self) -> np.ndarray:
        """(3,) bool, noise parameters of which there are measurements."""
        return np.array([1, len(self.marker_row), len(self.ranges.row)]) > 0

    @property
    def learned(self) -> np.ndarray:
        """(3,) bool, noise parameters that are learned: those of them that are unknown."""
        unknown = [getattr(self.dataset.vehicle, key) is None for key in NOISE_KEYS]
        return self.measured & unknown

    @cached_property
    def odometry_noise(self) -> tuple[np.ndarray, np.ndarray]:
        """Covariances (f-1, 3, 3) of odometry between the frames, as of `odometry_noise`."""
        return odometry_noise(
            self.dataset.ticks, self.dataset.vehicle, self.frame[:-1], self.frame[1:])

    @cached_property
    def crawls(self) -> np.ndarray:
        """(f-1,) bool, intervals between frames in which counts may creep."""
        return crawls(self.dataset.ticks, self.frame[:-1], self.frame[1:])

    @property
    def sighting_covariances(self) -> np.ndarray:
        """Covariances (s, 3, 3) of the errors of sightings; of a point (2, 2) counts.

        `ArucoReading.txt` gives the covariance C in the axes of the vehicle. The error of a marker
        with a heading lives in the axes of the measured pose z: R(heading)^T C R(heading).
        """
        s = self.sightings
        heading = np.where(self.as_pose, s.z[:, 2], 0.0)
        return se2.rotate_covariance(s.C, -heading)

    @cached_property
    def sighting_roots(self) -> np.ndarray:
        """Square root informations (s, 3, 3) of the sightings; of points (2, 2) of them, else 0."""
        C = self.sighting_covariances
        U = square_root_information(C)
        points = ~self.as_pose
        U[points] = 0
        U[points, :2, :2] = square_root_information(C[points, :2, :2])
        return U

    @cached_property
    def structure(self) -> Structure:
        """The Structure of the information matrix."""
        s = self.sightings
        r = self.ranges
        frame = np.arange(len(self.frame))
        marker = len(frame) + self.marker_row
        antenna = len(frame) + len(self.marker) + r.antenna
        first = np.concatenate([frame[:-1], s.row, r.row])
        second = np.concatenate([frame[1:], marker, antenna])
        frames_are_poses = np.ones(len(frame), bool)
        antennas_are_poses = np.zeros(len(self.antenna), bool)
        is_pose = np.concatenate([frames_are_poses, self.oriented, antennas_are_poses])
        return _structure(is_pose, np.stack([first, second], axis=1))


def _structure(is_pose, variables):
    """The Structure of v variables, of which `is_pose` (v,), and m factors of two `variables` each.

    The information matrix has blocks for each factor and, for the priors, one for each variable.
    """
    count = len(is_pose)
    itself = np.repeat(np.arange(count), 2).reshape(-1, 2)
    pairs = np.concatenate([variables, itself])
    position = _elimination_order(count, variables)
    at = position[pairs]
    in_matrix = count * at[:, [0, 0, 1, 1]] + at[:, [0, 1, 0, 1]]    # row after row
    block, number = np.unique(in_matrix, return_inverse=True)
    data = np.arange(9 * len(block)).reshape(-1, 3, 3)
    row_starts = np.searchsorted(block, count * np.arange(count + 1))
    by_rows = sparse.bsr_array((data, block % count, row_starts)).tocsr()
    places = by_rows.T                                   # by columns; the matrix is symmetric
    return Structure(
        is_pose=is_pose, rows=3 * position[:, None] + np.arange(3), places=places,
        diagonal=places.diagonal(), variables=variables, blocks=number[:len(variables)])


def _elimination_order(count, variables):
    """Positions (v,) of the variables, `count` of them, in the order that COLAMD eliminates them.

    From the two `variables` (m, 2) of each factor. On long drives SuperLU is faster by it than by
    its own minimum degree, which fills in as much.
    """
    graph = gtsam.SymbolicFactorGraph()
    for variable in range(count):
        graph.push_factor(variable)
    for first, second in variables.tolist():
        graph.push_factor(first, second)
    order = gtsam.Ordering.ColamdSymbolicFactorGraph(graph)
    return np.argsort([order.at(k) for k in range(count)])


def measure(dataset: Dataset, extra_poses: Sequence[int] = (),
            jumps: Jumps = NO_JUMPS) -> Measurements:
    """The Measurements of a Dataset.

    `extra_poses`, encoder poses from 0, are frames without a measurement. `jumps` are those of
    odometry. Raises DatasetError for an antenna with ranges but without a guess.
    """
    uwb = dataset.uwb or NO_RANGES
    ends = [0, len(dataset.ticks) - 1]
    sightings = sightings_by_frame(dataset.aruco, np.concatenate([ends, extra_poses, uwb.pose]))
    marker, marker_row = np.unique(sightings.marker, return_inverse=True)
    has_heading = sightings.C[:, 2, 2] < MAX_HEADING_SIGMA**2
    antenna = np.unique(uwb.antenna)
    guess = guessed(dataset.antenna_guess, antenna)
    ranges = Ranges(
        row=np.searchsorted(sightings.frame, uwb.pose),
        antenna=np.searchsorted(antenna, uwb.antenna),
        distance=uwb.range,
        sigma=np.maximum(uwb.sigma, MIN_MEASUREMENT_SIGMA))
    return Measurements(
        dataset=dataset,
        frame=sightings.frame,
        path=odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc"),
        sightings=sightings,
        marker_row=marker_row,
        marker=marker,
        oriented=np.bincount(marker_row, has_heading, len(marker)) > 0,
        ranges=ranges,
        antenna=antenna,
        guess=np.reshape(list(guess.values()), (-1, 2)),
        calibration=stated_calibration(with_cut_counts(dataset), antenna),
        jumps=jumps)


def with_cut_counts(dataset: Dataset) -> Vehicle:
    """The Vehicle of a Dataset, whose wheels are as uncertain as its counts.

    If all counts are multiples of d > 1, up to d - 1 counts of each row may have been cut off.
    """
    vehicle = dataset.vehicle
    divisor = common_divisor(dataset.ticks)
    if divisor < 2:
        return vehicle
    typical = np.median(np.abs(dataset.ticks[dataset.ticks != 0]))
    sigma = np.maximum(vehicle.sigma_wheel, vehicle.wheel * (divisor - 1) / 2 / typical)
    right, left, base = sigma.tolist()
    return replace(
        vehicle, sigma_right_radius=right, sigma_left_radius=left, sigma_wheelbase=base)


@dataclass(frozen=True)
class Accepted:
    """Which of the m measurements of a kind are accepted, and their robust kernel."""

    weight: np.ndarray       # (m,) of its information, 0 if it is rejected
    share: np.ndarray        # (m,) of it that its neighbours leave each (`memory`)
    kernel: mEstimator.Base | None = None      # None: quadratic
    bias: float = 0.0        # sigmas, of the kernel (`kernels.ONE_SIDED_BIAS`)

    def kept(self, residual: np.ndarray) -> np.ndarray:
        """(m,) weights, including the kernel's, by signed or absolute whitened residuals (m,)."""
        if self.kernel is None:
            return self.weight
        return self.weight * [self.kernel.weight(x) for x in residual - self.bias]


class AcceptedMeasurements(NamedTuple):
    """The accepted measurements of both kinds."""

    sightings: Accepted
    ranges: Accepted

    @property
    def share(self) -> np.ndarray:
        """(s + r,) shares of the sightings, then of the ranges."""
        return np.concatenate([self.sightings.share, self.ranges.share])

    def with_shares(self, shares: Iterable[np.ndarray]) -> "AcceptedMeasurements":
        """The same with other shares, (s,) of the sightings and (r,) of the ranges."""
        of_sightings, of_ranges = shares
        return AcceptedMeasurements(
            replace(self.sightings, share=of_sightings), replace(self.ranges, share=of_ranges))


def accept_all(measurements: Measurements,
               kernel: mEstimator.Base | None = None) -> AcceptedMeasurements:
    """The AcceptedMeasurements that count all of Measurements in full, by one kernel or none."""
    def all_of(kind):
        full = np.ones(len(kind.row))
        return Accepted(full, full, kernel)

    return AcceptedMeasurements(all_of(measurements.sightings), all_of(measurements.ranges))
