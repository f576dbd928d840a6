"""Stage 2: the noise parameters, which scale the noise of the factors, and their prior.

Slip is the standard deviation of a wheel's slip after one metre. Two factors multiply the standard
deviations that the files state for sightings and for ranges. The logarithms of all three are
normal a priori: a slip of 1 mm and factors of 1, within a factor of 3 and of 2. What a dataset's
Vehicle gives of the three is known; the others are learned from the drive.
"""

from dataclasses import dataclass, replace

import numpy as np

from slamlib.increments import SLIP_BOUNDS, SLIP_FACTOR, TYPICAL_SLIP

MEDIAN = np.array([TYPICAL_SLIP, 1.0, 1.0])
PRIOR_SIGMA = np.log([SLIP_FACTOR, 2.0, 2.0])      # of the logarithms
GIVEN = ("slip", "marker_noise_factor", "range_noise_factor")      # of a Vehicle, as in Noise
BOUNDS = np.log(MEDIAN) + np.log(100) * np.array([[-1], [1]])      # (2, 3) of the logarithms


@dataclass(frozen=True)
class Noise:
    """The three noise parameters."""

    slip: float = TYPICAL_SLIP     # sqrt(m), sigma of a wheel's slip after one metre
    sightings: float = 1.0         # of the sigmas in ArucoReading.txt
    ranges: float = 1.0            # of the sigmas in UwbReading.txt

    @property
    def logarithms(self):
        """(3,) natural logarithms of slip and both factors."""
        return np.log([self.slip, self.sightings, self.ranges])


def from_logarithms(logarithms):
    """The Noise of `Noise.logarithms` (3,)."""
    return Noise(*np.exp(logarithms).tolist())


def given(dataset, slip=None, marker_noise_factor=None, range_noise_factor=None):
    """The Dataset whose Vehicle has these noise parameters; None leaves what it has."""
    known = dict(zip(GIVEN, (slip, marker_noise_factor, range_noise_factor)))
    return replace(dataset, vehicle=replace(dataset.vehicle, **{
        name: value for name, value in known.items() if value is not None}))


def is_known(vehicle):
    """(3,) bool, which noise parameters a Vehicle gives."""
    return np.array([getattr(vehicle, name) is not None for name in GIVEN])


def with_known(noise, vehicle):
    """The Noise with what a Vehicle gives in place of its own; a slip is at least 1e-5 sqrt(m)."""
    slip, sightings, ranges = (
        own if (known := getattr(vehicle, name)) is None else known
        for name, own in zip(GIVEN, (noise.slip, noise.sightings, noise.ranges)))
    return Noise(max(slip, SLIP_BOUNDS[0]), sightings, ranges)


def log_prior(logarithms):
    """Log density (3,), up to a constant, of each of `Noise.logarithms`."""
    return -((logarithms - np.log(MEDIAN)) / PRIOR_SIGMA)**2 / 2
