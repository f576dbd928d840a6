"""Memory of errors: which share of its information a measurement keeps beside its neighbours.

Errors of successive measurements of a landmark are often alike: the camera sees a marker from
nearly the same place, an echo stays. Counted as independent, n of them would weigh n times as much
as one. With the correlation rho of the errors of two measurements of a landmark, each one keeps the
share 1 / (1 + sum of rho with all others) of its information (the design effect: Kish, Survey
Sampling, 1965, section 5.4).

The landmark takes over what all its errors have in common, and this mean has the variance that the
residuals lack. So it is added: at each lag, for residuals u in the standard deviations of the
errors,

    rho = mean of u u' + 1 - mean of u^2.

The residuals of n independent errors of a landmark correlate by -1/n without their mean, so (1 -
correlation) / n is added to the correlation of neighbours, by which memory is recognised.

After a break the sensor sees the landmark from elsewhere, with another error.
"""

from dataclasses import dataclass

import numpy as np

MAX_LAG = 100                # number of typical intervals over which errors are compared
MAX_PAUSE = 10               # of these, without a measurement, after which errors are independent
MIN_CORRELATION = 0.1        # of neighbours' residuals, below which errors are independent
MIN_SIGNIFICANCE = 5.0       # of its standard deviations, the same
MIN_RHO = 0.05               # below which errors are independent from that lag on
MIN_VARIANCE = 0.01          # of residuals in their sigmas; smaller ones are no errors of sensors
MIN_PAIRS = 30               # number of pairs at a lag, below which it is left out


@dataclass(frozen=True)
class Memory:
    """What the residuals of m measurements of a kind say of the memory of their errors."""

    correlation: float           # of the errors of neighbours, 0 if there are none
    sigma: float                 # its standard deviation where errors are independent
    share: np.ndarray            # (m,) that each measurement keeps, 1 if errors are independent


def runs(landmark, pose, max_pause):
    """Typical interval between measurements of a landmark, and number (m,) of the run of each one.

    `landmark` (m,) and then `pose` (m,) ascend. A pause of more than `max_pause` intervals ends a
    run. At least one landmark is measured twice.
    """
    interval, same = np.diff(pose), landmark[1:] == landmark[:-1]
    typical = np.median(interval[same])
    return typical, np.cumsum(np.r_[False, ~same | (interval > max_pause * typical)])


def error_memory(landmark, pose, u, used):
    """The Memory of measurements of `landmark` (m,), rows or ids, at encoder poses (m,).

    u (m, d) are residuals in standard deviations of the errors; those not `used` (m,) do not count.
    """
    rows, share = np.flatnonzero(used), np.ones(len(used))
    rows = rows[np.lexsort((pose[rows], landmark[rows]))]
    landmark, pose, u = landmark[rows], pose[rows], u[rows]
    variance = np.mean(u**2) if len(np.unique(landmark)) < len(rows) else 0.0
    if variance < MIN_VARIANCE:
        return Memory(correlation=0.0, sigma=1.0, share=share)
    interval, run = runs(landmark, pose, MAX_PAUSE)
    pairs = []
    for step in range(1, min(MAX_LAG, len(rows) - 1) + 1):
        i = np.flatnonzero(run[step:] == run[:-step])
        lag = np.rint((pose[i + step] - pose[i]) / interval).astype(int)
        close = lag <= MAX_LAG
        if not close.any():
            break
        pairs.append(np.stack([i, i + step, lag])[:, close])
    i, j, lag = np.concatenate(pairs, axis=1)
    count = np.bincount(lag, minlength=MAX_LAG + 1)
    product = np.bincount(lag, np.mean(u[i] * u[j], axis=1), MAX_LAG + 1) / np.maximum(count, 1)
    correlation = product[1] / variance
    correlation += (1 - correlation) * len(np.unique(landmark)) / len(rows)
    sigma = 1 / np.sqrt(max(count[1] * u.shape[1], 1))
    if correlation < max(MIN_CORRELATION, MIN_SIGNIFICANCE * sigma):
        return Memory(correlation=correlation, sigma=sigma, share=share)
    rho = product + max(0.0, 1 - variance)
    ends = (rho < MIN_RHO) | (count < MIN_PAIRS)
    ends[0] = False
    rho[np.argmax(ends) if ends.any() else len(rho):] = 0
    share[rows] = 1 / (1 + np.bincount(np.r_[i, j], rho[np.r_[lag, lag]], len(rows)))
    return Memory(correlation=correlation, sigma=sigma, share=share)
