"""Memory of errors: which share of its information a measurement keeps beside its neighbours.

Errors of successive measurements of a landmark are often alike: the camera sees a marker from
nearly the same place, an echo stays. Counted as independent, n of them would weigh n times as much
as one. With the correlation rho of the errors of two measurements of a landmark, each one keeps the
share 1 / (1 + sum of rho with all others) of its information (the design effect: Kish, Survey
Sampling, 1965, section 5.4).

A marker takes over what all its errors have in common, and this mean has the variance that the
residuals lack. So it is added: at each lag, for residuals u in the standard deviations of the
errors,

    rho = mean of u u' + 1 - mean of u^2.

Nothing is added for an antenna: what its ranges have in common is an entry of the calibration.
What is not used for this, such as an echo, keeps as much as the others do on average: it must not
outweigh them.

The residuals of n independent errors of a landmark correlate by -1/n without their mean, so (1 -
correlation) / n is added to the correlation of neighbours, by which memory is recognised.

After a break the sensor sees the landmark from elsewhere, with another error.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

MAX_LAG = 100                # number of typical intervals over which errors are compared
MAX_PAUSE = 10               # of these, without a measurement, after which errors are independent
MIN_CORRELATION = 0.05       # of neighbours' residuals, below which errors are independent
MIN_SIGNIFICANCE = 4.0       # of its standard deviations, the same
MIN_RHO = 0.05               # below which errors are independent from that lag on
MIN_VARIANCE = 0.01          # of residuals in their sigmas; smaller ones are no errors of sensors
MIN_PAIRS = 30               # number of pairs at a lag, below which it is left out


@dataclass(frozen=True)
class Memory:
    """What the residuals of m measurements of a kind say of the memory of their errors."""

    correlation: float           # of the errors of neighbours, 0 if there are none
    sigma: float                 # its standard deviation where errors are independent
    share: np.ndarray            # (m,) that each measurement keeps, 1 if errors are independent


class _Pairs(NamedTuple):
    """Pairs of measurements in the same run, with a lag of up to MAX_LAG."""

    first: np.ndarray            # (p,) rows of the earlier ones
    second: np.ndarray           # (p,) rows of the later ones
    lag: np.ndarray              # (p,) int, typical intervals between them


def runs(landmark: np.ndarray, pose: np.ndarray, max_pause: float) -> tuple[float, np.ndarray]:
    """Typical interval between measurements of a landmark, and number (m,) of the run of each one.

    `landmark` (m,) and then `pose` (m,) ascend. A pause of more than `max_pause` intervals ends a
    run. At least one landmark is measured twice.
    """
    interval = np.diff(pose)
    same = landmark[1:] == landmark[:-1]
    typical = np.maximum(np.median(interval[same]), 1)   # a pose may have several
    begins = ~same | (interval > max_pause * typical)
    return typical, np.cumulative_sum(begins, include_initial=True)


def error_memory(landmark: np.ndarray, pose: np.ndarray, u: np.ndarray,
                 used: np.ndarray, hides_mean: bool = True) -> Memory:
    """The Memory of measurements of `landmark` (m,), rows or ids, at encoder poses (m,).

    u (m, d) are residuals in standard deviations of the errors; those not `used` (m,) do not count.
    `hides_mean` is whether the landmark takes over the mean of its errors.
    """
    rows = np.flatnonzero(used)
    rows = rows[np.lexsort((pose[rows], landmark[rows]))]
    u = u[rows]
    share = np.ones(len(used))
    landmark_count = len(np.unique(landmark[rows]))
    variance = np.mean(u**2) if landmark_count < len(rows) else 0.0
    if variance < MIN_VARIANCE:
        return Memory(correlation=0.0, sigma=1.0, share=share)
    pairs = _pairs(landmark[rows], pose[rows])
    product = np.mean(u[pairs.first] * u[pairs.second], axis=1)
    count = np.bincount(pairs.lag, minlength=MAX_LAG + 1)
    covariance = np.bincount(pairs.lag, product, MAX_LAG + 1) / np.maximum(count, 1)
    correlation = covariance[1] / variance
    correlation += (1 - correlation) * landmark_count / len(rows)
    neighbours = count[1] * u.shape[1]
    sigma = 1 / np.sqrt(max(neighbours, 1))
    if correlation >= max(MIN_CORRELATION, MIN_SIGNIFICANCE * sigma):
        rho = covariance + hides_mean * max(0.0, 1 - variance)
        remembered = (rho >= MIN_RHO) & (count >= MIN_PAIRS)
        remembered[0] = True                         # pairs of less than half an interval
        rho[~np.logical_and.accumulate(remembered)] = 0.0
        rho_of_pair = rho[pairs.lag]
        with_later = np.bincount(pairs.first, rho_of_pair, len(rows))
        with_earlier = np.bincount(pairs.second, rho_of_pair, len(rows))
        share[rows] = 1 / (1 + with_later + with_earlier)
        share[~used] = share[rows].mean()
    return Memory(correlation, sigma, share)


def _pairs(landmark, pose):
    """The _Pairs of measurements sorted by `landmark` (m,), then by `pose` (m,)."""
    interval, run = runs(landmark, pose, MAX_PAUSE)
    found = []
    for step in range(1, min(MAX_LAG, len(run) - 1) + 1):
        first = np.flatnonzero(run[step:] == run[:-step])
        second = first + step
        distance = pose[second] - pose[first]
        lag = np.rint(distance / interval).astype(int)
        pairs = np.stack([first, second, lag])
        close = lag <= MAX_LAG
        if not close.any():
            break
        found.append(pairs[:, close])
    return _Pairs(*np.concatenate(found, axis=1))
