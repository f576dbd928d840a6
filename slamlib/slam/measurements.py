"""Stage 1: all measurements of a dataset as arrays, their weights, and their noise.

Frames (keyframes) are the encoder poses that are variables X_i of the graph: the first, the last,
and each one with a sighting or a range. Measurements are numbered: first the s sightings, then the
r ranges.

Noise has three parameters: slip, the standard deviation of a wheel's slip after one metre, and two
factors on the standard deviations that the files state for sightings and for ranges. Those that a
dataset's Vehicle gives are known; the others are learned from the drive.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, P, X

from slamlib import odometry, se2
from slamlib.dataset import Dataset, UwbReadings
from slamlib.increments import SLIP_BOUNDS, TYPICAL_SLIP
from slamlib.sightings import (
    MAX_HEADING_SIGMA,
    MIN_MEASUREMENT_SIGMA,
    Sightings,
    sightings_by_frame,
)
from slamlib.slam.calibration import Calibration, stated_calibration
from slamlib.slam.structure import Variables, block_structure

NOISE_KEYS = ("slip", "marker_noise_factor", "range_noise_factor")      # of a Vehicle, as in Noise

SMOOTHED_STEPS = 5           # encoder steps to both sides, over which velocities are averaged
# Standard deviations of the priors of variables
ORIGIN_SIGMA = 1e-5          # m, of the position of pose 1, which is zero by definition
WEAK_SIGMA = 1e5             # m and rad, of a marker without accepted sightings
GUESS_PRIOR_SIGMA = 5.0      # m, of an antenna about its guessed position


@dataclass(frozen=True)
class Noise:
    """The three noise parameters."""

    slip: float = TYPICAL_SLIP     # sqrt(m), sigma of a wheel's slip after one metre
    sightings: float = 1.0         # factor on the sigmas in ArucoReading.txt
    ranges: float = 1.0            # factor on the sigmas in UwbReading.txt

    @property
    def logarithms(self):
        """(3,) natural logarithms of slip and both factors."""
        return np.log([self.slip, self.sightings, self.ranges])

    @classmethod
    def from_logarithms(cls, logarithms):
        """The Noise of `logarithms` (3,)."""
        return cls(*np.exp(logarithms).tolist())


def with_known_noise(dataset, slip=None, marker_noise_factor=None, range_noise_factor=None):
    """The Dataset whose Vehicle has these noise parameters; None leaves that of the Vehicle."""
    values = zip(NOISE_KEYS, (slip, marker_noise_factor, range_noise_factor))
    return replace(dataset, vehicle=replace(dataset.vehicle, **{
        key: value for key, value in values if value is not None}))


def is_known(vehicle):
    """(3,) bool, which noise parameters a Vehicle gives."""
    return np.array([getattr(vehicle, key) is not None for key in NOISE_KEYS])


def with_known(noise, vehicle):
    """The Noise with the parameters that a Vehicle gives; the slip is at least 1e-5 sqrt(m)."""
    known = (getattr(vehicle, key) for key in NOISE_KEYS)
    slip, sightings, ranges = (
        value if stated is None else stated
        for stated, value in zip(known, (noise.slip, noise.sightings, noise.ranges)))
    return Noise(max(slip, SLIP_BOUNDS[0]), sightings, ranges)


def square_root_information(covariance):
    """Upper triangular U (..., d, d) with U^T U = C^-1, from covariances C: U e is whitened."""
    return np.swapaxes(np.linalg.cholesky(np.linalg.inv(covariance)), -1, -2)


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

    @property
    def turn(self):
        """(f-1,) rad, change of heading to the next frame by odometry."""
        return np.diff(self.path[self.frame, 2])

    @cached_property
    def smooth_path(self):
        """(n, 3) averages of `path` over SMOOTHED_STEPS to both sides, at the ends over fewer."""
        step = np.arange(len(self.path))
        reach = np.minimum(np.minimum(step, step[::-1]), SMOOTHED_STEPS)
        total = odometry.cumulative(self.path)
        return (total[step + reach + 1] - total[step - reach]) / (2 * reach + 1)[:, None]

    @property
    def origin_sigma(self):
        """(3,) standard deviations of pose 1: m, m, rad."""
        return np.array([ORIGIN_SIGMA, ORIGIN_SIGMA, self.dataset.vehicle.sigma_heading])

    @property
    def learned(self):
        """(3,) bool, noise parameters that are learned: unknown ones with measurements."""
        return ~is_known(self.dataset.vehicle) & [
            True, len(self.marker_row) > 0, len(self.ranges.row) > 0]

    @property
    def as_pose(self):
        """(s,) bool, sightings of markers with a heading."""
        return self.oriented[self.marker_row]

    @property
    def unit_weights(self):
        """(s + r,) weight 1 for every measurement."""
        return np.ones(len(self.marker_row) + len(self.ranges.row))

    @cached_property
    def sighting_roots(self):
        """Square root informations (s, 3, 3) of the sightings, and (s, 2, 2) of their positions.

        `ArucoReading.txt` gives the covariance C in the axes of the vehicle. The error of a marker
        with a heading lives in the axes of the measured pose z: R(heading)^T C R(heading).
        """
        s = self.sightings
        return (square_root_information(se2.rotate_covariance(s.C, -s.z[:, 2])),
                square_root_information(s.C[:, :2, :2]))

    @cached_property
    def variables(self):
        """The Variables, numbered."""
        counts = np.cumsum([len(self.frame), len(self.marker), len(self.antenna)])
        return Variables(*np.split(np.arange(counts[-1]), counts[:-1]))

    @property
    def factor_variables(self):
        """Numbers of the variables of odometry, sightings of poses, those of points, and ranges.

        (f-1, 2) of X_i and X_{i+1}, (m, 2) of frames and markers, twice, and (r, 2) of frames and
        antennas.
        """
        v, s, r = self.variables, self.sightings, self.ranges
        sightings = np.stack([s.row, v.markers[self.marker_row]], -1)
        return [np.stack([v.frames[:-1], v.frames[1:]], -1), sightings[self.as_pose],
                sightings[~self.as_pose], np.stack([r.row, v.antennas[r.antenna]], -1)]

    @cached_property
    def ordering(self):
        """Elimination ordering (COLAMD) of all variables but the calibration, which is last."""
        graph, s, r = gtsam.SymbolicFactorGraph(), self.sightings, self.ranges
        graph.push_factor(X(0))
        for i, j in zip(s.row.tolist(), self.marker_row.tolist()):
            graph.push_factor(X(i), (L if self.oriented[j] else P)(j))
        for i, k in zip(r.row.tolist(), r.antenna.tolist()):
            graph.push_factor(X(i), A(k))
        for i in range(len(self.frame) - 1):
            graph.push_factor(X(i), X(i + 1))
        return gtsam.Ordering.ColamdSymbolicFactorGraph(graph)

    @cached_property
    def structure(self):
        """The Structure of the information matrix."""
        v, order = self.variables, self.ordering
        numbers = {"x": v.frames, "l": v.markers, "p": v.markers, "a": v.antennas}
        keys = (gtsam.Symbol(order.at(i)) for i in range(order.size()))
        elimination_order = np.argsort([numbers[chr(key.chr())][key.index()] for key in keys])
        width = np.full(len(elimination_order), 2)
        width[np.r_[v.frames, v.markers[self.oriented]]] = 3
        return block_structure(width, elimination_order, self.factor_variables)

    @cached_property
    def factor_places(self):
        """(places, rows) in the matrix of each kind of factors, in the order `factor_variables`."""
        return [(self.structure.places(variables), self.structure.rows_of_factors(variables))
                for variables in self.factor_variables]


def measure(dataset, extra_poses=()):
    """The Measurements of a Dataset.

    `extra_poses`, encoder poses from 0, are frames without a measurement: tests compare a graph of
    all poses with poses interpolated between the frames.
    """
    uwb = dataset.uwb or UwbReadings(*np.zeros((2, 0), int), *np.zeros((2, 0)))
    sightings = sightings_by_frame(dataset.aruco, np.r_[
        0, len(dataset.ticks) - 1, np.array(extra_poses, int), uwb.pose])
    marker, marker_row = np.unique(sightings.marker, return_inverse=True)
    has_heading = sightings.C[:, 2, 2] < MAX_HEADING_SIGMA**2
    antenna, guess = np.unique(uwb.antenna), dataset.antenna_guess
    ranges = Ranges(np.searchsorted(sightings.frame, uwb.pose),
                    np.searchsorted(antenna, uwb.antenna), uwb.range,
                    np.maximum(uwb.sigma, MIN_MEASUREMENT_SIGMA))
    return Measurements(
        dataset=dataset, frame=sightings.frame,
        path=odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc"),
        sightings=sightings, marker_row=marker_row, marker=marker,
        oriented=np.bincount(marker_row, has_heading, len(marker)) > 0,
        ranges=ranges, antenna=antenna,
        guess=guess.position[np.searchsorted(guess.antenna, antenna)] if len(antenna)
        else np.zeros((0, 2)), calibration=stated_calibration(dataset.vehicle, antenna))


@dataclass(frozen=True)
class AcceptedMeasurements:
    """The accepted measurements and their robust kernels.

    A weight is the share of its information that a measurement keeps: 0 if it is rejected, 1 if it
    is accepted. Graduated non-convexity and chi-squared also use weights between 0 and 1.
    """

    measurements: Measurements
    weight: np.ndarray                       # (s + r,) sightings, then ranges
    sighting_kernel: gtsam.noiseModel.mEstimator.Base | None = None      # None: quadratic
    range_kernel: gtsam.noiseModel.mEstimator.Base | None = None
    range_bias: float = 0.0                  # sigmas, of the range kernel (`factors.kernel_bias`)

    @property
    def sighting_weight(self):
        """(s,) weights of the sightings."""
        return self.weight[:len(self.measurements.marker_row)].astype(float)

    @property
    def range_weight(self):
        """(r,) weights of the ranges."""
        return self.weight[len(self.measurements.marker_row):].astype(float)

    @property
    def unsupported(self):
        """(u,) rows in `Measurements.marker` of the markers without accepted sightings."""
        m = self.measurements
        return np.flatnonzero(np.bincount(m.marker_row, self.sighting_weight, len(m.marker)) == 0)
