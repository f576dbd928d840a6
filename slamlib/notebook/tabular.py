"""Tables of notebooks: rows are dicts of data; what is missing is a dash or an absent column."""

import re
from collections.abc import Iterable, Iterator

import numpy as np
import pandas as pd
from IPython.display import Markdown

from slamlib.core import evaluation, se2
from slamlib.notebook.plotting import estimates, places_by_id
from slamlib.robust.calibration import RANGES

DASH = "–"
# What begins a cell of a column of numbers, or is an italic remark in it.
NUMERIC = re.compile(rf"[-+−>]? ?\d(?!\. )|{DASH}|\*[^*]+\*$")


def table(rows: Iterable[dict]) -> Markdown:
    """Table in Markdown, an object that Jupyter shows, of rows (iterable of dict from header).

    Values are str, numbers (three significant digits), or arrays (s,) over drives: mean ± standard
    error, and the median in brackets. None, NaN and absent keys are dashes; columns of nothing else
    are left out. Of consecutive rows with the same first cell only the first shows it.
    """
    texts = [{name: cell(value) for name, value in row.items()} for row in rows]
    columns = pd.DataFrame(texts).fillna(DASH)
    columns = columns.loc[:, (columns != DASH).any()]
    if columns.empty:
        return Markdown(DASH)
    rules = []
    for name in columns:
        is_numeric = columns[name].str.match(NUMERIC).all()
        rules.append("---:" if is_numeric else "---")
    if len(rules) > 1:
        first = columns.iloc[:, 0]
        columns.isetitem(0, first.mask(first == first.shift(), ""))
    lines = [columns, rules, *columns.to_numpy()]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return Markdown(text.replace(" ± ", "\u00a0±\u00a0"))


def cell(value) -> str:
    """Text (str) of a value of `table`."""
    if isinstance(value, str):
        return value
    if np.ndim(value):
        return _over_drives(np.asarray(value, float))
    if pd.isna(value):
        return DASH
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    return number(value)


def number(value: float, decimals: int | None = None) -> str:
    """A value with three significant digits, or this number of decimals (str)."""
    if decimals is None:
        decimals = _decimals(value, 3)
    return f"{value:z,.{decimals}f}".replace("-", "−")


def _decimals(value, digits):
    """Number (int) of decimals, at most 7, with this number of significant digits of a value."""
    exponent = np.floor(np.log10(abs(value) or 1))
    return int(np.clip(digits - 1 - exponent, 0, 7))


def estimate(value: float, sigma: float) -> str:
    """Text (str) of a value ± its standard deviation, which has two digits."""
    decimals = _decimals(sigma, 2)
    return f"{number(value, decimals)} ± {number(sigma, decimals)}"


def _over_drives(values):
    """Mean ± standard error and median of values (s,), one a drive."""
    error = pd.Series(values).sem()
    if error > 0:
        decimals = _decimals(error, 2)
        return f"{estimate(values.mean(), error)} ({number(np.median(values), decimals)})"
    return f"{number(values.mean())} ({number(np.median(values))})"


def true_places(drive, kind: str, ids: np.ndarray) -> np.ndarray:
    """True places (k, c) of landmarks (k,) of a `kind`, NaN where a Drive does not know them."""
    truth = drive.truth
    if truth is None:
        return np.full((len(ids), 2), np.nan)
    return places_by_id(getattr(truth, kind), getattr(truth, f"{kind}_in_world"), ids)


def accuracy(result, drive) -> dict:
    """Row of `table` on what a solver found of a Drive: median sigmas, errors where truth is known.

    `result` as of `plotting.estimates`. The sigma of position is the larger of x and y.
    """
    found = estimates(result, drive)
    position_sigma = evaluation.position_sigmas(found.covariances)
    heading_sigma = se2.sigmas(found.covariances)[:, 2]
    row = {"dataset": drive.name, "σ (mm)": 1e3 * np.median(position_sigma),
           "σ of δ (mrad)": 1e3 * np.median(heading_sigma)}
    if found.true is not None:
        row["ATE (mm)"] = 1e3 * evaluation.ate(found.poses, found.true)
        row["aligned (mm)"] = 1e3 * evaluation.ate(found.poses, found.true, aligned=True)
        row["NEES"] = evaluation.anees(found.poses, found.covariances, found.true)
    return row


def map_accuracy(result, drive, kind: str) -> dict:
    """Entries of a row of `table` on the landmarks of a `kind`, "marker" or "antenna".

    Their number, the median of the larger sigma of x and y, and by a Drive's truth of all of them
    the rms error of the position and the mean squared error in units of the covariance. `result`
    is a SlamResult or GraphSolution.
    """
    ids = getattr(result, kind)
    if not len(ids):
        return {}
    covariances = getattr(result, f"{kind}_covariance")
    position_sigma = evaluation.position_sigmas(covariances)
    row = {f"{kind}s": len(ids), "their σ (mm)": 1e3 * np.median(position_sigma)}
    true = true_places(drive, kind, ids)
    if np.isfinite(true).all():
        places = getattr(result, f"{kind}_in_world")
        off = se2.difference(places, true) if kind == "marker" else places - true
        row["error (mm)"] = 1e3 * evaluation.ate(places, true)
        row["their NEES"] = np.nanmean(se2.squared_norms(off, covariances))
    return row


def calibration_rows(result, drive) -> Iterator[dict]:
    """Rows of `table` on what a SlamResult estimates of its calibration: stated and estimated.

    The last row is the factor on the standard deviations of the ranges, if it is learned.
    """
    antenna_count = len(result.antenna)
    for entry in result.calibration_table[:None if antenna_count else RANGES.start]:
        if entry["sigma"]:
            stated = f"{entry['stated']:g}"
            if entry["stated_sigma"]:
                stated += f" ± {entry['stated_sigma']:.3g}"
            estimated = estimate(entry["estimate"], entry["sigma"])
            yield {"dataset": drive.name, "entry": f"`{entry['name']}`",
                   "unit": entry["unit"] or None, "stated": stated, "estimated": estimated,
                   "used": "estimate" if entry["released"] else "both"}
    if antenna_count and not drive.dataset.vehicle.range_noise_factor:
        factor = result.noise.ranges
        yield {"dataset": drive.name, "entry": "`range_noise_factor`",
               "estimated": estimate(factor, factor * result.noise_sigma[2]), "used": "estimate"}


def antenna_rows(result, drive) -> Iterator[dict]:
    """Rows of `table` on the antennas of a SlamResult: position, sigmas, distances in mm.

    `d²` is the squared error in units of the covariance, `down-weighted` the percentage of the
    ranges that keep less than half of their weight.
    """
    ids = result.antenna
    guess = drive.dataset.antenna_guess
    guess = places_by_id(guess.antenna, guess.position, ids)
    moved = 1e3 * np.linalg.norm(result.antenna_in_world - guess, axis=1)
    error = result.antenna_in_world - true_places(drive, "antenna", ids)
    distance = 1e3 * np.linalg.norm(error, axis=1)
    squared = se2.squared_norms(error, result.antenna_covariance)
    sigmas = se2.sigmas(result.antenna_covariance)
    for k, antenna in enumerate(ids):
        name = f"{antenna}"
        if antenna in result.doubts:
            name += "?"
        x, y = map(estimate, result.antenna_in_world[k], sigmas[k])
        own = drive.dataset.uwb.antenna == antenna
        is_light = result.range_weight[own] < 0.5
        yield {"dataset": drive.name, "antenna": name, "x (m)": x, "y (m)": y,
               "from the guess (mm)": moved[k], "error (mm)": distance[k], "d²": squared[k],
               "down-weighted (%)": 100 * is_light.mean()}
