"""Trials run over seeds, and the rows of the studies that notebooks show.

A study depends on slamlib only, not on a user's datasets. Its rows are a CSV file in the folder
`studies` beside the notebook, from which `rows` reads them. `make studies` executes the notebooks
with SLAMLIB_STUDIES=write: `rows` then computes and writes them. With SLAMLIB_STUDIES=check, as a
test has it, `rows` computes the first two seeds of each again and compares.
"""

import hashlib
import os
import platform
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path

import pandas as pd
from joblib import Parallel, delayed

from slamlib.core.errors import require

FOLDER = Path("studies")                      # from a notebook's folder, in which its kernel runs
SLAMLIB = Path(__file__).parents[1]
TOLERANCE = 1e-3        # relative: tables print three digits
SMALLEST = 1e-6         # m, or a share: smaller differences do not count


def run(trial: Callable, seeds: Iterable[int], **options) -> pd.DataFrame:
    """DataFrame of what trial(seed, **options) returns, a dict, with one row for each seed.

    The seeds are shared among all processors.
    """
    seeds = list(seeds)
    found = Parallel(-1)(delayed(trial)(seed, **options) for seed in seeds)
    return pd.DataFrame(found, index=pd.Index(seeds, name="seed"))


def rows(name: str, trial: Callable, seeds: Iterable[int], **options) -> pd.DataFrame:
    """What `run` returned when `make studies` wrote the file studies/`name`.csv.

    Raises DatasetError if there is no such file, or it is of another trial, options or seeds; and
    AssertionError if a seed that is computed again has other numbers.
    """
    seeds = list(seeds)
    file = FOLDER / f"{name}.csv"
    call = f"# {trial.__name__}, {options}\n"
    mode = os.environ.get("SLAMLIB_STUDIES")
    if mode == "write":
        text = run(trial, seeds, **options).to_csv(float_format="%.7g", lineterminator="\n")
        FOLDER.mkdir(exist_ok=True)
        file.write_text(made_by() + call + text, encoding="utf-8", newline="\n")
    require(file.is_file(), file, "rows that 'make studies' writes, beside the notebook")
    header = file.read_text(encoding="utf-8").splitlines(keepends=True)[:2]
    found = pd.read_csv(file, comment="#", index_col="seed")
    as_written = header[1] == call and list(found.index) == seeds
    require(as_written, file, f"rows of {trial.__name__} by the seeds and options of this call; "
            "studies.run computes others")
    if mode == "check":
        again = run(trial, seeds[:2], **options)
        pd.testing.assert_frame_equal(found.loc[again.index], again, check_dtype=False,
                                      rtol=TOLERANCE, atol=SMALLEST, obj=str(file))
    return found


def made_by() -> str:
    """A line (str) with the digest of the code that computes rows, and the versions it uses."""
    code = hashlib.sha256()
    for package in ("core", "robust", "studies"):
        for file in sorted((SLAMLIB / package).glob("*.py")):
            code.update(file.read_bytes())
    versions = [f"{package} {version(package)}" for package in ("numpy", "scipy", "gtsam")]
    return (f"# slamlib's code {code.hexdigest()[:12]}, Python {platform.python_version()}, "
            f"{', '.join(versions)}\n")
