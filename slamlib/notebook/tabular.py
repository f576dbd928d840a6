"""Tables of notebooks: rows are dicts of data; what is missing is a dash or an absent column."""

import re

import numpy as np
from IPython.display import Markdown

from slamlib.core import evaluation
from slamlib.core.kernels import ONE_SIDED
from slamlib.core.odometry import dead_reckoning
from slamlib.notebook.plotting import estimates, places_by_id
from slamlib.robust.calibration import RANGES
from slamlib.robust.measurements import NOISE_KEYS
from slamlib.studies.kernels import mislabelled

DASH = "–"
# What begins a cell of a column of numbers, or is an italic remark in it.
NUMERIC = re.compile(rf"[-+−>]? ?\d(?!\. )|{DASH}|\*[^*]+\*$")
MINUS = re.compile(r"(?<![\w.])-(?=\d)")
MAX_NUMBER = 1e6             # larger numbers are not shown, because the method failed


def table(rows, caption=None):
    """Table in Markdown, an object that Jupyter shows, of rows (iterable of dict from header).

    Values are str, numbers (three significant digits), or arrays (s,) over drives: mean ± standard
    error, and the median in brackets. None, NaN and absent keys are dashes; columns of nothing else
    are left out. Of consecutive rows with the same first cell only the first shows it. `caption`
    (str) stands below.
    """
    rows = [{name: cell(value).replace(" ± ", "\u00a0±\u00a0") for name, value in row.items()}
            for row in rows]
    columns = {name: [row.get(name, DASH) for row in rows] for row in rows for name in row}
    columns = {name: column for name, column in columns.items()
               if set(column) != {DASH}} or {DASH: [DASH]}
    numeric = [all(map(NUMERIC.match, column)) for column in columns.values()]
    first, *others = ([MINUS.sub("−", text) if each else text for text in column]
                      for each, column in zip(numeric, columns.values()))
    if others:
        first = [text * (text != above) for above, text in zip([None, *first], first)]
    lines = [columns, ["---:" if each else "---" for each in numeric], *zip(first, *others)]
    text = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return Markdown(text + (f"\n\n{caption}" if caption else ""))


def cell(value):
    """Text (str) of a value of `table`."""
    if isinstance(value, str):
        return value
    if value is None or np.ndim(value) == 0 and np.isnan(value):
        return DASH
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, int | np.integer):
        return f"{value:,}".replace("-", "−")
    return number(value) if np.ndim(value) == 0 else _over_drives(np.asarray(value, float))


def number(value, decimals=None):
    """A value with three significant digits, or this number of decimals (str)."""
    if abs(value) > MAX_NUMBER:
        return "> 10⁶"
    if decimals is None:
        decimals = int(np.clip(2 - np.floor(np.log10(abs(value))), 0, 6)) if value else 0
    return f"{value:z,.{decimals}f}".replace("-", "−")


def _over_drives(values):
    """Mean ± standard error and median of values (s,), one a drive."""
    error = values.std(ddof=1) / np.sqrt(len(values)) if len(values) > 1 else 0.0
    decimals = int(np.clip(1 - np.floor(np.log10(error)), 0, 3)) if error > 0 else None
    text = number(values.mean(), decimals) + (f" ± {number(error, decimals)}" if error > 0 else "")
    return f"{text} ({number(np.median(values), decimals)})"


def dataset_row(drive):
    """Row of `table` on what a Drive has: poses, length of the path, counts of measurements."""
    d = drive.dataset
    return {"dataset": drive.name, "origin": drive.origin, "encoder poses": len(d.ticks),
            "path by odometry (m)": evaluation.path_length(dead_reckoning(d.ticks, d.vehicle)),
            **{name: f"{len(each.pose):,} at {len(np.unique(each.pose)):,} poses"
               for name, each in (("marker sightings", d.aruco), ("UWB ranges", d.uwb)) if each}}


def vehicle_row(drive):
    """Row of `table` on what is stated of a Drive's vehicle and noise."""
    v = drive.dataset.vehicle
    wheel = {name: f"{mean:g} ± {sigma:g}" for name, mean, sigma in zip(
        ("$R_R$ (m)", "$R_L$ (m)", "$b$ (m)"), v.wheel, v.sigma_wheel, strict=True)}
    return {"dataset": drive.name, **wheel, "$n_0$": f"{v.ticks_per_revolution:g}",
            r"$\sigma_\delta$ (rad)": f"{v.sigma_heading:g}",
            **{f"`{key}`": getattr(v, key) for key in NOISE_KEYS}}


def accuracy(result, drive):
    """Row of `table` on what a solver found of a Drive: median sigmas, errors where truth is known.

    `result` as of `plotting.estimates`. The sigma of position is the larger of x and y.
    """
    _, poses, covariances, true = estimates(result, drive)
    row = {"dataset": drive.name,
           "σ (mm)": 1e3 * np.median(evaluation.position_sigmas(covariances)),
           "σ of δ (mrad)": 1e3 * np.median(evaluation.sigmas(covariances)[:, 2])}
    if true is None:
        return row
    nees = evaluation.nees(poses, covariances, true)
    nees = nees[np.isfinite(nees)]
    return row | {"ATE (mm)": 1e3 * evaluation.ate(poses, true),
                  "aligned (mm)": 1e3 * evaluation.ate(poses, true, aligned=True),
                  "NEES, mean": nees.mean() if len(nees) else None,
                  "NEES, median": np.median(nees) if len(nees) else None}


def learned_row(result, drive):
    """Row of `table` on what a SlamResult learned of a Drive's noise and rejected.

    The truth of a simulated Drive says how many wrong labels are rejected. A kernel for ranges
    alone is absent, because sightings then count in full within the gate.
    """
    vehicle = result.fit.problem.measurements.dataset.vehicle
    factor, sigma = result.noise.sightings, result.noise_sigma
    row = {"dataset": drive.name, "gate": vehicle.gate,
           "kernel": None if vehicle.kernel in ONE_SIDED else vehicle.kernel,
           "slip (mm)": f"{1e3 * result.slip:.2f} ± {1e3 * result.slip * sigma[0]:.2f}",
           "factor": f"{factor:.2f} ± {factor * sigma[1]:.2f}", "step": result.model,
           "sightings": len(result.rejected), "rejected": result.rejected.sum()}
    if drive.origin == "simulated":
        wrong = mislabelled(result.fit.problem.measurements, drive.truth)
        row["of wrong labels"] = f"{(wrong & result.rejected).sum()} of {wrong.sum()}"
    return row


def calibration_rows(result, drive):
    """Rows of `table` on the entries of a SlamResult's calibration: stated, estimated, true, used.

    The true value is that of the wheels of a simulated Drive. Without ranges their entries have no
    row; offsets of single antennas, which are stated as zero, have one where they are estimated.
    The last one is the factor on the standard deviations of the ranges.
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
    if len(result.antenna):
        given, factor = drive.dataset.vehicle.range_noise_factor, result.noise.ranges
        sigma = factor * result.noise_sigma[2]
        yield {"dataset": drive.name, "entry": "`range_noise_factor`", "unit": DASH,
               "stated": given, "estimated": None if given else f"{factor:.2f} ± {sigma:.2f}",
               "used": "statement" if given else "estimate"}


def antenna_rows(result, drive):
    """Rows of `table` on the antennas of a SlamResult: position, sigmas, distances in mm.

    `d²` is the squared error in units of the covariance, `down-weighted` the percentage of the
    ranges that keep less than half of their weight, `by 0.1 m` how far an antenna would be
    elsewhere, on the same path, if all its ranges were 0.1 m too long.
    """
    if not len(result.antenna):
        return
    place, C, uwb = result.antenna_in_world, result.antenna_covariance, drive.dataset.uwb
    guess, truth = drive.dataset.antenna_guess, drive.truth
    moved = place - places_by_id(guess.antenna, guess.position, result.antenna)
    off = np.full_like(place, np.nan) if truth is None else place - places_by_id(
        truth.antenna, truth.antenna_in_world, result.antenna)
    for k, antenna in enumerate(result.antenna.tolist()):
        own = uwb.antenna == antenna
        away = place[k] - result.poses[uwb.pose[own], :2]
        root = np.sqrt(result.range_weight[own]) / uwb.sigma[own]
        direction = away / np.maximum(np.hypot(*away.T), 1e-9)[:, None]
        shift = np.linalg.lstsq(root[:, None] * direction, 0.1 * root)[0]
        yield {"dataset": drive.name, "antenna": f"{antenna}{'?' * (antenna in result.doubts)}",
               "x (m)": f"{place[k, 0]:.3f}", "y (m)": f"{place[k, 1]:.3f}",
               "σ of x (mm)": 1e3 * np.sqrt(C[k, 0, 0]), "σ of y (mm)": 1e3 * np.sqrt(C[k, 1, 1]),
               "from the guess (mm)": 1e3 * np.hypot(*moved[k]),
               "error (mm)": 1e3 * np.hypot(*off[k]),
               "d²": off[k] @ np.linalg.solve(C[k], off[k]),
               "down-weighted (%)": 100 * np.mean(result.range_weight[own] < 0.5),
               "by 0.1 m (mm)": 1e3 * np.hypot(*shift)}
