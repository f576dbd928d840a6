"""Tables of notebooks: rows are dicts of data; what is missing is a dash or an absent column."""

import re
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from IPython.display import Markdown

from slamlib.core import evaluation, se2
from slamlib.core.sightings import GATE
from slamlib.notebook.plotting import estimates, places_by_id
from slamlib.robust.calibration import RANGES, WHEELS
from slamlib.robust.solution import solved_noise

DASH = "–"
# What begins a cell of a column of numbers, or is an italic remark in it.
NUMERIC = re.compile(rf"[-+−>]? ?\d(?!\. )|{DASH}|\*[^*]+\*$")


def table(rows: Iterable[dict]) -> Markdown:
    """Table in Markdown, an object that Jupyter shows, of rows (iterable of dict from header).

    Values are str, numbers (three significant digits), or arrays (s,) over drives: mean ± standard
    error, and the median in brackets. None, NaN and absent keys are dashes; columns of nothing else
    are left out. Of consecutive rows with the same first cell only the first shows it.
    """
    columns = _columns(rows)
    rules = []
    for texts in columns.values():
        numeric = all(map(NUMERIC.match, texts))
        rules.append("---:" if numeric else "---")
    first, *others = columns.values()
    if others:
        first = ["" if text == above else text for above, text in pairwise([None, *first])]
    lines = [columns, rules, *zip(first, *others)]
    return Markdown("\n".join("| " + " | ".join(line) + " |" for line in lines))


def _columns(rows):
    """The texts of a table's columns, {header: list of str}, or one dash if there are none."""
    rows = [{name: cell(value).replace(" ± ", "\u00a0±\u00a0") for name, value in row.items()}
            for row in rows]
    columns = {}
    for name in dict.fromkeys(name for row in rows for name in row):
        column = [row.get(name, DASH) for row in rows]
        if set(column) != {DASH}:
            columns[name] = column
    return columns or {DASH: [DASH]}


def cell(value) -> str:
    """Text (str) of a value of `table`."""
    if isinstance(value, str):
        return value
    if value is None:
        return DASH
    if np.ndim(value):
        return _over_drives(np.asarray(value, float))
    if np.isnan(value):
        return DASH
    if isinstance(value, int | np.integer):
        return f"{value:,}"
    return number(value)


def number(value: float, decimals: int | None = None) -> str:
    """A value with three significant digits, or this number of decimals (str)."""
    if abs(value) > 1e6:                       # the method failed
        return "> 10⁶"
    if decimals is None:
        decimals = _decimals(value, 3, at_most=6) if value else 0
    return f"{value:z,.{decimals}f}".replace("-", "−")


def _decimals(value, digits, at_most):
    """Number (int) of decimals that show this number of significant digits of a value."""
    exponent = np.floor(np.log10(abs(value)))
    return int(np.clip(digits - 1 - exponent, 0, at_most))


def estimate(value: float, sigma: float) -> str:
    """Text (str) of a value ± its standard deviation, which has two digits."""
    decimals = _decimals(sigma, 2, at_most=7) if sigma else 2
    return f"{value:.{decimals}f} ± {sigma:.{decimals}f}".replace("-", "−")


def _over_drives(values):
    """Mean ± standard error and median of values (s,), one a drive."""
    error = 0.0
    if len(values) > 1:
        error = values.std(ddof=1) / np.sqrt(len(values))
    decimals = _decimals(error, 2, at_most=3) if error > 0 else None
    text = number(values.mean(), decimals)
    if error > 0:
        text += f" ± {number(error, decimals)}"
    return f"{text} ({number(np.median(values), decimals)})"


def accuracy(result, drive) -> dict:
    """Row of `table` on what a solver found of a Drive: median sigmas, errors where truth is known.

    `result` as of `plotting.estimates`. The sigma of position is the larger of x and y.
    """
    found = estimates(result, drive)
    position_sigma = evaluation.position_sigmas(found.covariances)
    heading_sigma = evaluation.sigmas(found.covariances)[:, 2]
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
    row = {f"{kind}s": len(ids),
           "their σ (mm)": 1e3 * np.median(evaluation.position_sigmas(covariances))}
    true_ids = getattr(drive.truth, kind, ())
    if np.isin(ids, true_ids).all():
        places = getattr(result, f"{kind}_in_world")
        true = places_by_id(true_ids, getattr(drive.truth, f"{kind}_in_world"), ids)
        off = se2.difference(places, true) if kind == "marker" else places - true
        row["error (mm)"] = 1e3 * np.sqrt(np.mean(np.sum(off[:, :2]**2, axis=1)))
        row["their NEES"] = np.nanmean(se2.squared_norms(off, covariances))
    return row


def learned_row(result, drive) -> dict:
    """Row of `table` on what a SlamResult learned of a Drive's noise."""
    slip_sigma, factor_sigma, _ = result.noise_sigma
    slip = 1e3 * result.slip
    factor = result.noise.sightings
    return {"dataset": drive.name, "slip (mm)": estimate(slip, slip * slip_sigma),
            "in GTSAM": 1e3 * solved_noise(result.fit).slip,
            "factor": estimate(factor, factor * factor_sigma), "step": result.model}


def gate_row(result, drive) -> dict:
    """Row of `table` on the sightings that a SlamResult of a Drive rejects.

    By the truth of their markers, how many of the rejected ones are right, within GATE of the true
    sighting, and how many that are not are missed.
    """
    s = result.sightings
    count = result.rejected.sum()
    row = {"dataset": drive.name, "rejected": f"{count:,} of {len(s.marker):,}"}
    truth = drive.truth
    if truth is not None and np.isin(s.marker, truth.marker).all():
        places = places_by_id(truth.marker, truth.marker_in_world, s.marker)
        z = se2.between(truth.poses[s.frame[s.row]], places)
        is_right = se2.squared_distances(s.z, z, s.C) < GATE
        row["right"] = np.sum(result.rejected & is_right)
        row["missed"] = np.sum(~result.rejected & ~is_right)
    return row


def calibration_rows(result, drive) -> Iterator[dict]:
    """Rows of `table` on what a SlamResult estimates of its calibration: stated, estimated, true.

    The true value is that of the wheels of a simulated Drive. The last row is the factor on the
    standard deviations of the ranges, if it is learned.
    """
    has_ranges = len(result.antenna) > 0
    for k, entry in enumerate(result.calibration_table[:None if has_ranges else RANGES.start]):
        if entry["sigma"]:
            stated = f"{entry['stated']:g}"
            if entry["stated_sigma"]:
                stated += f" ± {entry['stated_sigma']:.3g}"
            row = {"dataset": drive.name, "entry": f"`{entry['name']}`",
                   "unit": entry["unit"] or DASH, "stated": stated,
                   "estimated": estimate(entry["estimate"], entry["sigma"])}
            if k < WHEELS.stop and drive.origin == "simulated":
                row["true"] = f"{getattr(drive.truth.vehicle, entry['name']):.6g}"
            yield row | {"used": "estimate" if entry["released"] else "both"}
    if has_ranges and not drive.dataset.vehicle.range_noise_factor:
        factor = result.noise.ranges
        yield {"dataset": drive.name, "entry": "`range_noise_factor`", "unit": DASH,
               "estimated": estimate(factor, factor * result.noise_sigma[2]), "used": "estimate"}


def antenna_rows(result, drive) -> Iterator[dict]:
    """Rows of `table` on the antennas of a SlamResult: position, sigmas, distances in mm.

    `d²` is the squared error in units of the covariance, `down-weighted` the percentage of the
    ranges that keep less than half of their weight.
    """
    ids = result.antenna
    truth = drive.truth
    guess = drive.dataset.antenna_guess
    guess = places_by_id(guess.antenna, guess.position, ids)
    moved = np.linalg.norm(result.antenna_in_world - guess, axis=1)
    true = np.full_like(result.antenna_in_world, np.nan)
    if truth is not None:
        true = places_by_id(truth.antenna, truth.antenna_in_world, ids)
    error = result.antenna_in_world - true
    squared = se2.squared_norms(error, result.antenna_covariance)
    sigmas = evaluation.sigmas(result.antenna_covariance)
    for k, antenna in enumerate(ids.tolist()):
        name = f"{antenna}"
        if antenna in result.doubts:
            name += "?"
        x, y = map(estimate, result.antenna_in_world[k], sigmas[k])
        own = drive.dataset.uwb.antenna == antenna
        yield {"dataset": drive.name, "antenna": name, "x (m)": x, "y (m)": y,
               "from the guess (mm)": 1e3 * moved[k],
               "error (mm)": 1e3 * np.linalg.norm(error[k]), "d²": squared[k],
               "down-weighted (%)": 100 * np.mean(result.range_weight[own] < 0.5)}
