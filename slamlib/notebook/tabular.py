"""Tables of notebooks: rows are dicts of data; what is missing is a dash or an absent column."""

import re

import numpy as np
from IPython.display import Markdown

from slamlib import evaluation, se2
from slamlib.notebook.plotting import places_by_id
from slamlib.slam.calibration import RANGES

DASH = "–"
NUMERIC = re.compile(rf"[-+−>]? ?\d|{DASH}")          # begins a cell of a column of numbers
MINUS = re.compile(r"(?<![\w.])-(?=\d)")
MAX_NUMBER = 1e6             # larger numbers are not shown, because the method failed


def table(rows, caption=None):
    """Table in Markdown, an object that Jupyter shows, of rows (iterable of dict from header).

    Values are str, numbers (three significant digits), or arrays (s,) over drives: mean ± standard
    error, and the median in brackets; of bool, the percentage. None, NaN and absent keys are
    dashes; columns of nothing else are left out. Of consecutive rows with the same first cell only
    the first shows it. `caption` (str) stands below.
    """
    rows = list(rows)
    header = [name for name in dict.fromkeys(name for row in rows for name in row)
              if not all(_missing(row.get(name)) for row in rows)] or [DASH]
    texts = [not all(NUMERIC.match(cell(row.get(name))) for row in rows) for name in header]
    cells = [[cell(row.get(name)) if text else re.sub(MINUS, "−", cell(row.get(name)))
              for name, text in zip(header, texts, strict=True)] for row in rows or [{}]]
    above = [None, *(row[0] for row in cells)]
    cells = [["" if row[0] == first and len(row) > 1 else row[0], *row[1:]]
             for first, row in zip(above, cells, strict=False)]
    lines = [header, ["---" if text else "---:" for text in texts], *cells]
    text = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return Markdown(text + (f"\n\n{caption}" if caption else ""))


def _missing(value):
    return value is None or isinstance(value, float | np.floating) and np.isnan(value)


def cell(value):
    """Text (str) of a value of `table`."""
    if _missing(value):
        return DASH
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{value:,}".replace("-", "−")
    return number(value) if np.ndim(value) == 0 else _over_drives(np.asarray(value))


def number(value, decimals=None):
    """A value with three significant digits, or this number of decimals (str)."""
    if abs(value) > MAX_NUMBER:
        return "> 10⁶"
    if decimals is None:
        decimals = int(np.clip(2 - np.floor(np.log10(abs(value))), 0, 6)) if value else 0
    return f"{value:z,.{decimals}f}".replace("-", "−")


def _over_drives(values):
    """Mean ± standard error and median of values (s,), one a drive, or a percentage of bools."""
    values, unit = (100 * values, " %") if values.dtype == bool else (values.astype(float), "")
    mean = values.mean()
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    decimals = int(np.clip(1 - np.floor(np.log10(error)), 0, 3)) if error > 0 else None
    decimals = 0 if unit else decimals
    text = number(mean, decimals) + (f" ± {number(error, decimals)}" if error > 0 else "")
    return text + (unit or f" ({number(np.median(values), decimals)})")


def accuracy(result, drive):
    """Row of `table` on what a solver found of a Drive: median sigmas, errors where truth is known.

    `result` is (poses, covariances), or has these attributes: a Solution, Localization, Fusion or
    SlamResult. Poses that are NaN are left out. The sigma of position is the larger of x and y.
    """
    poses, covariances = result if isinstance(result, tuple) else (result.poses, result.covariances)
    known = np.isfinite(poses[:, 0])
    frame = getattr(result, "frame", np.arange(len(poses)))[known]
    poses, covariances = poses[known], covariances[known]
    row = {"dataset": drive.name,
           "σ (mm)": 1e3 * np.median(evaluation.position_sigmas(covariances)),
           "σ of δ (mrad)": 1e3 * np.median(evaluation.sigmas(covariances)[:, 2])}
    if drive.truth is None:
        return row
    true = drive.truth.poses
    if world := getattr(result, "world", frame[0] if hasattr(result, "frame") else 0):
        true = se2.between(true[world], true)
    nees = evaluation.nees(poses, covariances, true[frame])
    nees = nees[np.isfinite(nees)]
    return row | {"ATE (mm)": 1e3 * evaluation.ate(poses, true[frame]),
                  "aligned (mm)": 1e3 * evaluation.ate(poses, true[frame], aligned=True),
                  "NEES, mean": nees.mean() if len(nees) else None,
                  "NEES, median": np.median(nees) if len(nees) else None}


def calibration_rows(result, drive):
    """Rows of `table` on the entries of a SlamResult's calibration: stated, estimated, true, used.

    The true value is that of the wheels of a simulated Drive. Without ranges their entries have no
    row; offsets of single antennas, which are stated as zero, have one where they are estimated.
    """
    own = slice(None) if len(result.antenna) else slice(RANGES.start)
    for entry in result.calibration_table[own]:
        sigma, stated_sigma = entry["sigma"], entry["stated_sigma"]
        if not sigma and entry["group"] == "antenna-offsets":
            continue
        digits = f".{np.clip(1 - np.floor(np.log10(sigma)), 0, 7):.0f}f" if sigma else "g"
        true = getattr(drive.truth.vehicle, entry["name"]) if (
            drive.origin == "simulated" and entry["group"] == "wheel-parameters") else None
        yield {"dataset": drive.name, "entry": f"`{entry['name']}`", "unit": entry["unit"] or DASH,
               "stated": f"{entry['stated']:g}" + f" ± {stated_sigma:.3g}" * (stated_sigma > 0),
               "estimated": f"{entry['estimate']:{digits}} ± {sigma:{digits}}" if sigma else None,
               "true": None if true is None else f"{true:{digits}}",
               "used": "statement" if not sigma else "estimate" if entry["released"] else "both"}


def antenna_rows(result, drive):
    """Rows of `table` on the antennas of a SlamResult: position, sigmas, distances in mm."""
    guess, truth = drive.dataset.antenna_guess, drive.truth
    if not len(result.antenna):
        return
    moved = result.antenna_in_world - places_by_id(guess.antenna, guess.position, result.antenna)
    error = np.full(len(moved), np.nan) if truth is None or not len(truth.antenna) else np.hypot(
        *(result.antenna_in_world
          - places_by_id(truth.antenna, truth.antenna_in_world, result.antenna)).T)
    sigma = 1e3 * evaluation.sigmas(result.antenna_covariance)
    for k, antenna in enumerate(result.antenna.tolist()):
        yield {"dataset": drive.name, "antenna": str(antenna) + "?" * (antenna in result.doubts),
               "x (m)": f"{result.antenna_in_world[k, 0]:.3f}",
               "y (m)": f"{result.antenna_in_world[k, 1]:.3f}",
               "σ of x (mm)": sigma[k, 0], "σ of y (mm)": sigma[k, 1],
               "from the guess (mm)": 1e3 * np.hypot(*moved[k]), "error (mm)": 1e3 * error[k]}
