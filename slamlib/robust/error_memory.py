"""Memory of errors: which share of its information a measurement keeps beside its neighbours.

Errors of successive measurements of a landmark are often alike: the camera sees a marker from
nearly the same place, an echo stays. Counted as independent, n of them would weigh n times as much
as one. With the correlation rho of the errors of two measurements of a landmark, each one keeps the
share 1 / (1 + sum of rho with all others) of its information (the design effect: Kish, Survey
Sampling, 1965, section 5.4).

The solution takes over a part of the errors: a marker the mean of its own, the path what is slow.
So products of residuals are not those of errors. What is expected of these follows from the
posterior, as in the EM algorithm (Dempster, Laird and Rubin, J. Royal Statistical Society B 39(1),
1977). If draws from it change the residuals r and r' by v and v', errors u and u' in standard
deviations have

    mean of u u' = mean of r r' + mean of v v'.

Where shares and noise fit each other, the mean of u^2 is near 1. What it lacks is added at each
lag, since the solution then takes over more than its posterior says:

    rho = mean of u u' + 1 - mean of u^2.

Not so for ranges: what those of an antenna have in common is an entry of the calibration. A wall
may stand before one antenna and not before the others: if those of at least half are independent,
each has its own memory (`memory_of_each`). Else all have the same. The path takes over the errors
of the antenna that counts most, so that its residuals show less memory the more it counts. What is
not used for this, such as an echo, keeps as much as the others do on average: it must not outweigh
them.

After a break the sensor sees the landmark from elsewhere, with another error.
"""

from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np

MAX_LAG = 100                # number of typical intervals over which errors are compared
MAX_PAUSE = 10               # of these, without a measurement, after which errors are independent
MIN_CORRELATION = 0.05       # of neighbours' errors, below which errors are independent
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

    @property
    def significance(self) -> float:
        """The correlation in its standard deviations."""
        return self.correlation / self.sigma


class _Pairs(NamedTuple):
    """Pairs of measurements in the same run, with a lag of up to MAX_LAG."""

    first: np.ndarray            # (p,) rows of the earlier ones
    second: np.ndarray           # (p,) rows of the later ones
    lag: np.ndarray              # (p,) typical intervals between them
    product: np.ndarray          # (p,) expected, of their errors


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


def error_memory(landmark: np.ndarray, pose: np.ndarray, r: np.ndarray, changes: np.ndarray,
                 used: np.ndarray, adds_lack: bool = True) -> Memory:
    """The Memory of measurements of `landmark` (m,), rows or ids, at encoder poses (m,).

    r (m, d) are residuals in standard deviations of the errors; k draws from the posterior change
    them by `changes` (m, d, k). Those not `used` (m,) do not count. `adds_lack` is whether what the
    mean of u^2 lacks of 1 is added.
    """
    rows = np.flatnonzero(used)
    rows = rows[np.lexsort((pose[rows], landmark[rows]))]
    share = np.ones(len(used))
    none = Memory(correlation=0.0, sigma=1.0, share=share)
    if len(np.unique(landmark[rows])) == len(rows):      # none is measured twice
        return none
    errors = np.concatenate([r[..., None], changes / np.sqrt(changes.shape[2])], axis=2)[rows]
    errors = errors.reshape(len(rows), -1) / np.sqrt(r.shape[1])
    variance = np.mean(_products(errors, errors))
    if variance < MIN_VARIANCE:
        return none
    pairs = _pairs(landmark[rows], pose[rows], errors)
    count = np.bincount(pairs.lag, minlength=MAX_LAG + 1)
    covariance = np.bincount(pairs.lag, pairs.product, MAX_LAG + 1) / np.maximum(count, 1)
    correlation = covariance[1] / variance
    neighbours = count[1] * r.shape[1]
    sigma = 1 / np.sqrt(max(neighbours, 1))
    if correlation >= max(MIN_CORRELATION, MIN_SIGNIFICANCE * sigma):
        rho = covariance + adds_lack * max(0.0, 1 - variance)
        remembered = (rho >= MIN_RHO) & (count >= MIN_PAIRS)
        remembered[0] = True                         # pairs of less than half an interval
        rho[~np.logical_and.accumulate(remembered)] = 0.0
        rho_of_pair = np.maximum(rho, 0)[pairs.lag]
        with_later = np.bincount(pairs.first, rho_of_pair, len(rows))
        with_earlier = np.bincount(pairs.second, rho_of_pair, len(rows))
        share[rows] = 1 / (1 + with_later + with_earlier)
        share[~used] = share[rows].mean()
    return Memory(correlation, sigma, share)


def memory_of_each(landmark: np.ndarray, *columns: np.ndarray) -> Memory:
    """One Memory of all landmarks, or one of each if those of at least half are independent.

    The other `columns` are those of `error_memory`. What the mean of u^2 lacks is not added.
    Independent are errors that have no memory one by one nor, of these landmarks, all together. The
    correlation of several memories is the most significant one.
    """
    columns = landmark, *columns

    def memory_of(rows):
        return error_memory(*(column[rows] for column in columns), adds_lack=False)

    of_all = memory_of(slice(None))
    numbers = np.unique(landmark)
    each = [memory_of(landmark == number) for number in numbers]
    others = [number for number, memory in zip(numbers, each)
              if (memory.share == 1).all() and memory.sigma < MIN_PAIRS**-0.5]
    if 2 * len(others) < len(each) or (memory_of(np.isin(landmark, others)).share < 1).any():
        return of_all
    share = np.empty(len(landmark))
    for number, memory in zip(numbers, each):
        share[landmark == number] = memory.share
    strongest = max(each, key=attrgetter("significance"), default=of_all)
    return replace(strongest, share=share)


def _products(first, second):
    """Scalar products (m,) of rows (m, w)."""
    return np.einsum("ij,ij->i", first, second)


def _pairs(landmark, pose, errors):
    """The _Pairs of `errors` (m, w) sorted by `landmark` (m,), then by `pose` (m,)."""
    interval, run = runs(landmark, pose, MAX_PAUSE)
    found = []
    for step in range(1, min(MAX_LAG, len(run) - 1) + 1):
        lag = np.rint((pose[step:] - pose[:-step]) / interval)
        close = (run[step:] == run[:-step]) & (lag <= MAX_LAG)
        if not close.any():
            break
        first = np.flatnonzero(close)
        product = _products(errors[:-step], errors[step:])[close]
        found.append((first, first + step, lag[close].astype(int), product))
    return _Pairs(*map(np.concatenate, zip(*found)))
