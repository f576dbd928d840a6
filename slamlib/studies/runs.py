"""Trials run over seeds, and the rows of the studies that notebooks show.

A study depends on slamlib only, not on a user's datasets. Its rows are a CSV file in the folder
`studies` beside the notebook, from which `rows` reads them. `make studies` executes the notebooks
with SLAMLIB_STUDIES=write: `rows` then computes and writes them. With SLAMLIB_STUDIES=check, as a
test has it, `rows` computes the first seed of each again and compares.
"""

import os
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path

import joblib
import pandas as pd

from slamlib.core.errors import require
from slamlib.io.files import write_file

FOLDER = Path("studies")                      # from a notebook's folder, in which its kernel runs
SLAMLIB = Path(__file__).parents[1]
TOLERANCE = 1e-3        # relative: tables print three digits
SMALLEST = 1e-6         # m, or a share: smaller differences do not count
COMPUTING = ("core", "robust", "studies")     # packages on which rows depend


def run(trial: Callable, seeds: Sequence[int], **options) -> pd.DataFrame:
    """DataFrame of what trial(seed, **options) returns, a dict, with one row for each seed.

    More than two seeds are shared among all processors.
    """
    processes = -1 if len(seeds) > 2 else 1
    found = joblib.Parallel(processes)(joblib.delayed(trial)(seed, **options) for seed in seeds)
    return pd.DataFrame(found, seeds).rename_axis("seed")


def rows(name: str, trial: Callable, seeds: Sequence[int], **options) -> pd.DataFrame:
    """What `run` returned when `make studies` wrote the file studies/`name`.csv.

    Raises DatasetError if there is no such file, or it is of another trial, options or seeds; and
    AssertionError if a seed that is computed again has other numbers.
    """
    file = FOLDER / f"{name}.csv"
    call = f"# {trial.__name__}, {options}\n"
    mode = os.environ.get("SLAMLIB_STUDIES")
    if mode == "write":
        text = run(trial, seeds, **options).to_csv(float_format="%.7g", lineterminator="\n")
        write_file(file, f"{made_by()}{call}{text}".encode())
    found = pd.DataFrame()
    if file.exists() and call in file.read_text():
        found = pd.read_csv(file, comment="#", index_col="seed")
    require(list(found.index) == list(seeds), file, f"rows of {trial.__name__} by the seeds and "
            "options of this call, as 'make studies' writes them; studies.run computes others")
    if mode == "check":
        again = run(trial, seeds[:1], **options)
        pd.testing.assert_frame_equal(found.loc[again.index], again, check_dtype=False,
                                      rtol=TOLERANCE, atol=SMALLEST, obj=str(file))
    return found


def made_by() -> str:
    """A line (str) with the digest of the code that computes rows, and versions of packages."""
    files = sorted(file for file in SLAMLIB.rglob("*.py") if file.parent.name in COMPUTING)
    code = joblib.hash([file.read_bytes() for file in files])
    versions = [f"{package} {version(package)}" for package in ("numpy", "scipy", "gtsam")]
    return f"# slamlib's code {code[:12]}, {', '.join(versions)}\n"
