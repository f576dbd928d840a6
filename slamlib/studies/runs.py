"""Studies run over seeds by joblib, and kept between builds of the report.

A study depends on the code of the numerics, on the packages that compute it, and on its trial,
seeds and options; it does not depend on a user's datasets. While a report is built,
SLAMLIB_STUDIES names the folder of the studies that are kept. Without it each is computed. Times
that a trial measures are kept, too, so pages must not print them. SLAMLIB_SEEDS, a number, cuts
every study to its first seeds; tests of pages use it. In JupyterLab a long study shows a bar.
"""

import hashlib
import os
import platform
import warnings
from collections.abc import Callable, Iterable
from importlib.metadata import version
from pathlib import Path

import pandas as pd
from joblib import Memory, Parallel, delayed
from tqdm.auto import tqdm

SLAMLIB = Path(__file__).parents[1]
PAGE_PACKAGES = ("notebook", "report")     # imports run downwards: no study depends on them
NUMERIC_PACKAGES = ("numpy", "scipy", "gtsam")
# The matrices are small: more threads cost time.
ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
KEPT = 200                                 # number of studies that are kept, the last used
BAR_AFTER = 5.0                            # s, duration of a study from which on it shows a bar


def run(trial: Callable, seeds: Iterable[int], **options) -> pd.DataFrame:
    """DataFrame of what trial(seed, **options) returns, a dict, with one row for each seed.

    Parameters
    ----------
    trial : function; if it is of a module in slamlib.studies, the study is kept.
    seeds : iterable of int.
    """
    most = int(os.environ.get("SLAMLIB_SEEDS", 0)) or None
    seeds = list(seeds)[:most]
    name = f"{trial.__module__}.{trial.__name__}"
    folder = None
    if name.startswith(f"{__package__}.") and code_digest() == CODE_DIGEST:    # not edited since
        folder = os.environ.get("SLAMLIB_STUDIES")
    memory = Memory(folder, verbose=0, compress=True)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Exception while loading results")    # computed again
        rows = memory.cache(_rows, ignore=["trial"])(trial, name, seeds, options, CODE_DIGEST)
    memory.reduce_size(items_limit=KEPT)
    return pd.DataFrame(rows, index=pd.Index(seeds, name="seed"))


def _rows(trial, name, seeds, options, code):
    """The rows of `run`, a list of dict, which joblib keeps by all arguments but trial."""
    # A build executes several notebooks at a time, and kills their kernels, after which further
    # processes would wait for minutes.
    in_build = "SLAMLIB_RESULTS" in os.environ
    processes = Parallel(1 if in_build else -1)
    bar = tqdm(seeds, desc=trial.__name__, leave=False, delay=BAR_AFTER, disable=in_build)
    return processes(delayed(trial)(seed, **options) for seed in bar)


def code_digest() -> str:
    """Digest (str) of what all studies depend on: the current slamlib, Python and packages."""
    packages = [version(package) for package in NUMERIC_PACKAGES]
    files = [(str(file.relative_to(SLAMLIB)), digest(file.read_bytes()))
             for file in modules(*PAGE_PACKAGES)]
    state = [platform.python_version(), platform.platform(), packages, files]
    return digest(repr(state).encode())


def modules(*without: str) -> list[Path]:
    """Paths of slamlib's modules and styles, except __main__ and the packages `without` (str)."""
    return sorted(file for file in SLAMLIB.rglob("*")
                  if file.suffix in (".py", ".mplstyle") and file.name != "__main__.py"
                  and file.relative_to(SLAMLIB).parts[0] not in without)


def digest(content: bytes) -> str:
    """The SHA-256 of bytes, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


CODE_DIGEST = code_digest()                # of the code that this process imported
