"""Stage 1: all measurements of a dataset as arrays, their weights, their noise and their structure.

Frames are the first encoder pose, the last, and each one with a sighting or a range. Measurements
are numbered: first the s sightings, then the r ranges. Of the three noise parameters, those that a
dataset's Vehicle gives are known; the others are learned from the drive.

Variables are numbered: f poses of frames, k markers, the antennas. Each has three unknowns, in
the order in which they are eliminated, so that the information matrix H consists of blocks (3, 3);
the third unknown of a point has no derivatives. The Structure of H is the same for all states,
kernels and values of the noise.
"""

from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from slamlib.core import odometry, se2
from slamlib.core.graph import ORIGIN_SIGMA
from slamlib.core.increments import SLIP_BOUNDS, TYPICAL_SLIP
from slamlib.core.records import Dataset, UwbReadings
from slamlib.core.sightings import (
    MAX_HEADING_SIGMA,
    MIN_MEASUREMENT_SIGMA,
    Sightings,
    sightings_by_frame,
)
from slamlib.robust.calibration import Calibration, stated_calibration
from slamlib.robust.jumps import NO_JUMPS, Jumps

NOISE_KEYS = ("slip", "marker_noise_factor", "range_noise_factor")      # of a Vehicle, as in Noise

# Standard deviations of the priors of variables
WEAK_SIGMA = 1e5             # m and rad, of a marker without accepted sightings


class Noise(NamedTuple):
    """The three noise parameters."""

    slip: float = TYPICAL_SLIP     # sqrt(m), sigma of a wheel's slip after one metre
    sightings: float = 1.0         # factor on the sigmas in ArucoReading.txt
    ranges: float = 1.0            # factor on the sigmas in UwbReading.txt


def with_known(noise, vehicle):
    """The Noise with the parameters that a Vehicle gives; the slip is at least 1e-5 sqrt(m)."""
    given = [getattr(vehicle, key) for key in NOISE_KEYS]
    slip, *factors = (own if known is None else known for own, known in zip(noise, given))
    return Noise(max(slip, SLIP_BOUNDS[0]), *factors)


def square_root_information(covariance):
    """Upper triangular U (..., d, d) with U^T U = C^-1, from covariances C: U e is whitened."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)


@dataclass(frozen=True)
class Structure:
    """Places of v variables and of the b blocks that connect them in a matrix (3 v, 3 v)."""

    is_pose: np.ndarray      # (v,) bool, the others are points
    position: np.ndarray     # (v,) of every variable in the elimination
    places: sparse.csc_array     # the matrix with the place of each entry in the data (9 b,)
    factors: list            # of (m, 2) variables of each kind of factor
    blocks: list             # of (m, 4) numbers of their blocks
    diagonal: np.ndarray     # (n,) places of the diagonal in the data of blocks

    def rows(self, variables, width=3):
        """Rows (m, width) of the unknowns of `variables` (m,)."""
        return 3 * self.position[variables][:, None] + np.arange(width)

    @property
    def unknowns(self):
        """Rows of the unknowns of all variables, in the order of their numbers."""
        return self.rows(slice(None))[np.arange(3) < 2 + self.is_pose[:, None]]

    def matrix(self, data):
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
    as_pose = property(lambda self: self.oriented[self.marker_row])    # (s,) bool, with a heading

    @property
    def origin_sigma(self):
        """(3,) standard deviations of pose 1: m, m, rad."""
        return np.array([ORIGIN_SIGMA, ORIGIN_SIGMA, self.dataset.vehicle.sigma_heading])

    @property
    def learned(self):
        """(3,) bool, noise parameters that are learned: unknown ones with measurements."""
        counts = 1, len(self.marker_row), len(self.ranges.row)
        return np.array([getattr(self.dataset.vehicle, key) is None and count > 0
                         for key, count in zip(NOISE_KEYS, counts)])

    @cached_property
    def sighting_roots(self):
        """Square root informations (s, 3, 3) of the sightings; of points (2, 2) of them, else 0.

        `ArucoReading.txt` gives the covariance C in the axes of the vehicle. The error of a marker
        with a heading lives in the axes of the measured pose z: R(heading)^T C R(heading).
        """
        s, points = self.sightings, ~self.as_pose
        U = square_root_information(se2.rotate_covariance(s.C, -s.z[:, 2]))
        U[points] = 0
        U[points, :2, :2] = square_root_information(s.C[points, :2, :2])
        return U

    @cached_property
    def structure(self):
        """The Structure of the information matrix, eliminated in the order of minimum degree."""
        f, k, s, r = len(self.frame), len(self.marker), self.sightings, self.ranges
        is_pose = np.r_[np.ones(f, bool), self.oriented, np.zeros(len(self.antenna), bool)]
        factors = [np.arange(f - 1)[:, None] + [0, 1], np.stack([s.row, f + self.marker_row], -1),
                   np.stack([r.row, f + k + r.antenna], -1)]
        count, ends = len(is_pose), np.cumsum([len(is_pose), *(4 * len(each) for each in factors)])
        row, column = np.concatenate([np.repeat(np.arange(count), 2).reshape(-1, 2), *(
            each[:, [[0, 0], [0, 1], [1, 0], [1, 1]]].reshape(-1, 2) for each in factors)]).T
        neighbours = sparse.csc_array((np.where(row == column, count, 0.5), (row, column)))
        position = splu(neighbours, permc_spec="MMD_AT_PLUS_A").perm_c
        block, number = np.unique(position[row] * count + position[column], return_inverse=True)
        by_rows = sparse.bsr_array((
            np.arange(9 * len(block)).reshape(-1, 3, 3), block % count,
            np.searchsorted(block, count * np.arange(count + 1)))).tocsr()
        places = sparse.csc_array((by_rows.data, by_rows.indices, by_rows.indptr), by_rows.shape)
        return Structure(
            is_pose=is_pose, position=position, places=places, diagonal=places.diagonal(),
            factors=factors, blocks=[each.reshape(-1, 4) for each in np.split(number, ends)[1:-1]])


def measure(dataset, extra_poses=(), jumps=NO_JUMPS):
    """The Measurements of a Dataset.

    `extra_poses`, encoder poses from 0, are frames without a measurement. `jumps` are those of
    odometry.
    """
    uwb = dataset.uwb or UwbReadings(*np.zeros((2, 0), int), *np.zeros((2, 0)))
    extra = np.asarray(extra_poses, dtype=int)
    sightings = sightings_by_frame(
        dataset.aruco, np.concatenate([[0, len(dataset.ticks) - 1], extra, uwb.pose]))
    marker, marker_row = np.unique(sightings.marker, return_inverse=True)
    has_heading = sightings.C[:, 2, 2] < MAX_HEADING_SIGMA**2
    antenna, guess = np.unique(uwb.antenna), dataset.antenna_guess
    ranges = Ranges(
        row=np.searchsorted(sightings.frame, uwb.pose),
        antenna=np.searchsorted(antenna, uwb.antenna), distance=uwb.range,
        sigma=np.maximum(uwb.sigma, MIN_MEASUREMENT_SIGMA))
    return Measurements(
        dataset=dataset, frame=sightings.frame,
        path=odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc"),
        sightings=sightings, marker_row=marker_row, marker=marker,
        oriented=np.bincount(marker_row, has_heading, len(marker)) > 0,
        ranges=ranges, antenna=antenna,
        guess=guess.position[np.searchsorted(guess.antenna, antenna)] if len(antenna)
        else np.zeros((0, 2)), calibration=stated_calibration(dataset.vehicle, antenna),
        jumps=jumps)


@dataclass(frozen=True)
class Accepted:
    """Which of the m measurements of a kind are accepted, and their robust kernel."""

    weight: np.ndarray       # (m,) of its information, 0 if it is rejected
    share: np.ndarray        # (m,) of it that its neighbours leave each (`memory`)
    kernel: gtsam.noiseModel.mEstimator.Base | None = None      # None: quadratic
    bias: float = 0.0        # sigmas, of the kernel (`fit.ONE_SIDED`)

    def kept(self, residual):
        """(m,) weights, including the kernel's, by signed or absolute whitened residuals (m,)."""
        return self.weight * ([self.kernel.weight(x) for x in residual - self.bias]
                              if self.kernel else 1.0)


class AcceptedMeasurements(NamedTuple):
    """The accepted measurements of both kinds."""

    sightings: Accepted
    ranges: Accepted
    share = property(lambda self: np.concatenate([kind.share for kind in self]))      # (s + r,)

    def with_shares(self, shares):
        """The same with other shares, (s,) of the sightings and (r,) of the ranges."""
        return AcceptedMeasurements(*(
            replace(accepted, share=share) for accepted, share in zip(self, shares)))


def accept_all(measurements, kernel=None):
    """The AcceptedMeasurements that count all of Measurements in full, by one kernel or none."""
    return AcceptedMeasurements(*(Accepted(*np.ones((2, len(kind.row))), kernel) for kind in (
        measurements.sightings, measurements.ranges)))
