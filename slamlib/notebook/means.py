"""Writes numbers as text: with three digits, and means over drives with their standard errors."""

import numpy as np

from slamlib.notebook.show import listed

MAX_MEAN = 1e4               # larger means are not shown, because the method failed


def number(value):
    """A value with three significant digits and at most two decimals (str)."""
    size = abs(value)
    return _fixed_point(value, 0 if size >= 100 else 1 if size >= 10 else 2)


def three_digits(value):
    """A value with three significant digits (str), however small it is."""
    return f"{value:{',.0f' if abs(value) >= 100 else '#.3g'}}".removesuffix(".")


def mean_and_error(series):
    """Mean of a series (n,) over drives, and its standard error."""
    series = np.asarray(series, float)
    return series.mean(), series.std(ddof=1) / np.sqrt(len(series))


def with_error(series, scale=1.0, signed=False):
    """Mean ± standard error (str) of `scale` times a series (n,) over drives.

    The error has two significant digits and at most three decimals.
    """
    mean, error = mean_and_error(scale * np.asarray(series, float))
    if mean > MAX_MEAN:
        return f"> {MAX_MEAN:,.0f}"
    decimals = int(np.clip(1 - np.floor(np.log10(error)), 0, 3)) if error > 0 else 2
    return f"{_plus(mean, signed)}{_fixed_point(mean, decimals)} ± {_fixed_point(error, decimals)}"


def share(series, signed=False):
    """Percentage ± standard error (str) of a series (n,) of 0 and 1, or of shares."""
    mean, error = mean_and_error(100 * np.asarray(series, float))
    text = _plus(mean, signed) + _fixed_point(mean, 0)
    return f"{text}\u00a0±\u00a0{error:.0f}\u00a0%" if error else f"{text}\u00a0%"


def _fixed_point(value, decimals):
    return f"{value:z,.{decimals}f}".replace("-", "−")


def _plus(mean, signed):
    return "+" if signed and mean > 0 else ""


def is_significant(series):
    """True if the mean of a series (n,) over drives exceeds two standard errors in size."""
    mean, error = mean_and_error(series)
    return bool(abs(mean) > 2 * error)


def verdict(study, methods, default, key, scale):
    """Differences of methods from the default on the same drives, parts of a sentence (str).

    `study` has series (n,) by the name "method key"; differences are multiplied by `scale`.
    """
    groups = {"larger with": [], "smaller with": [], "undecided with": []}
    for method in methods:
        if method != default:
            more = scale * (study[f"{method} {key}"] - study[f"{default} {key}"])
            group = "undecided with" if not is_significant(more) else \
                "larger with" if more.mean() > 0 else "smaller with"
            groups[group].append(f"{method} ({with_error(more, signed=True)})")
    return "; ".join(f"{group} {listed(found)}"
                     for group, found in groups.items() if found)
