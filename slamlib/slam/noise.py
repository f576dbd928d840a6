"""Stage 1: the three noise parameters and their prior.

Slip is the standard deviation of a wheel's slip after one metre. Two factors multiply the standard
deviations that the files state for sightings and for ranges. All three are log-normal a priori,
with medians of 1 mm after one metre and of 1, and standard deviations of a factor of 3 and of 2.
Those that a dataset's Vehicle gives are known; the others are learned from the drive.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib.increments import SLIP_BOUNDS, SLIP_FACTOR, TYPICAL_SLIP

MEDIAN = np.array([TYPICAL_SLIP, 1.0, 1.0])        # sqrt(m), 1, 1: of the prior
PRIOR_SIGMA = np.log([SLIP_FACTOR, 2.0, 2.0])      # (3,) standard deviations of the logarithms
NOISE_KEYS = ("slip", "marker_noise_factor", "range_noise_factor")      # of a Vehicle, as in Noise
BOUNDS = np.log(MEDIAN) + np.log(100) * np.array([[-1], [1]])      # (2, 3) of the logarithms


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


def log_prior(logarithms):
    """Log prior density (3,), up to a constant, of each of `Noise.logarithms` (3,)."""
    return -((logarithms - np.log(MEDIAN)) / PRIOR_SIGMA)**2 / 2
