"""Numbers as text: three significant digits, and means over drives with their standard errors."""

import numpy as np

from slamlib.notebook.show import listed

LARGE = 1e4                  # means above it tell nothing but that a method fails


def number(value):
    """A value with three significant digits and at most two decimals (str)."""
    size = abs(value)
    return _text(value, 0 if size >= 100 else 1 if size >= 10 else 2)


def three_digits(value):
    """A value with three significant digits (str), however small it is."""
    return f"{value:{',.0f' if abs(value) >= 100 else '#.3g'}}".removesuffix(".")


def mean_and_error(series):
    """Mean of a series (n,) over drives, and its standard error."""
    series = np.asarray(series, float)
    return series.mean(), series.std(ddof=1) / np.sqrt(len(series))


def with_error(series, scale=1.0, signed=False):
    """Mean ± standard error (str) of `scale` times a series (n,) over drives.

    The error has two digits, with at most three decimals.
    """
    mean, error = mean_and_error(scale * np.asarray(series, float))
    if mean > LARGE:
        return f"> {LARGE:,.0f}"
    decimals = int(np.clip(1 - np.floor(np.log10(error)), 0, 3)) if error > 0 else 2
    return f"{_plus(mean, signed)}{_text(mean, decimals)} ± {_text(error, decimals)}"


def share(yes, signed=False):
    """Share in percent ± standard error (str) of a series (n,) of 0 and 1, or of shares."""
    mean, error = mean_and_error(100 * np.asarray(yes, float))
    text = _plus(mean, signed) + _text(mean, 0)
    return f"{text}\u00a0±\u00a0{error:.0f}\u00a0%" if error else f"{text}\u00a0%"


def _text(value, decimals):
    return f"{value:z,.{decimals}f}".replace("-", "−")


def _plus(mean, signed):
    return "+" if signed and mean > 0 else ""


def decided(series):
    """True if the mean of a series (n,) over drives is beyond two standard errors."""
    mean, error = mean_and_error(series)
    return bool(abs(mean) > 2 * error)


def verdict(study, ways, default, key, scale):
    """How ways differ from the default on the same drives: parts of a sentence (str).

    `study` has series (n,) by the name "way key"; differences are multiplied by `scale`.
    """
    groups = {"larger with": [], "smaller with": [], "undecided with": []}
    for way in ways:
        if way != default:
            more = scale * (study[f"{way} {key}"] - study[f"{default} {key}"])
            group = "undecided with" if not decided(more) else \
                "larger with" if more.mean() > 0 else "smaller with"
            groups[group].append(f"{way} ({with_error(more, signed=True)})")
    return "; ".join(f"{group} {listed(found)}"
                     for group, found in groups.items() if found)
