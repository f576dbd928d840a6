"""Stage 2: the noise parameters, which scale the noise of the factors, and their prior.

Slip is the standard deviation of a wheel's slip after one metre. Two factors multiply the standard
deviations that the files state for sightings and for ranges. The logarithms of all three are
normal a priori: a slip of 1 mm and factors of 1, within a factor of 3 and of 2.
"""

from dataclasses import dataclass

import numpy as np

from slamlib.increments import SLIP_BOUNDS, SLIP_FACTOR, TYPICAL_SLIP

MEDIAN = np.array([TYPICAL_SLIP, 1.0, 1.0])
PRIOR_SIGMA = np.log([SLIP_FACTOR, 2.0, 2.0])      # of the logarithms
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


def known_noise(slip):
    """The Noise to start from: with the slip in sqrt(m) that is given, or typical if it is None."""
    return Noise() if slip is None else Noise(max(slip, SLIP_BOUNDS[0]))


def log_prior(logarithms):
    """Log density (3,), up to a constant, of each of `Noise.logarithms`."""
    return -((logarithms - np.log(MEDIAN)) / PRIOR_SIGMA)**2 / 2
