"""Studies run over seeds in parallel, and kept between builds of the report.

A study depends on the code of the numerics, on the packages that compute it, and on its trial,
seeds and options; it does not depend on a user's datasets. While a report is built,
SLAMLIB_STUDIES names the folder of the studies that are kept. Without it each is computed. Times
that a trial measures are kept, too, so pages must not print them. SLAMLIB_SEEDS, a number, cuts
every study to its first seeds; tests of pages use it. In JupyterLab a long study shows a bar.
"""

import hashlib
import os
import platform
import shutil
import sys
import warnings
from importlib.metadata import version
from pathlib import Path

import numpy as np
from joblib import Memory
from tqdm.auto import tqdm

from slamlib.studies import workers

SLAMLIB = Path(__file__).parents[1]
PAGE_PACKAGES = ("notebook", "report")     # imports run downwards: no study depends on them
NUMERIC_PACKAGES = ("numpy", "scipy", "gtsam")
THREADS = ("OMP_", "OPENBLAS_", "MKL_")    # prefixes of variables that set numbers of threads
BAR_AFTER = 5.0                            # s, duration of a study from which on it shows a bar


def run(trial, seeds, jobs=2, **options):
    """Numbers of trial(seed, **options) for all seeds: a dict of (s,) arrays.

    Parameters
    ----------
    trial : function of a module in slamlib.studies that returns a dict of numbers.
    seeds : iterable of int.
    jobs : number of processes.
    """
    name = f"{trial.__module__}.{trial.__name__}"
    seeds = list(seeds)[:int(os.environ.get("SLAMLIB_SEEDS", len(seeds)))]
    arguments = trial, name, seeds, options, _threads(), jobs
    folder = os.environ.get("SLAMLIB_STUDIES")
    ours = name.startswith(f"{__package__}.")
    if not folder or not ours or code_digest() != CODE_DIGEST:          # or edited meanwhile
        return _compute(*arguments)
    forget(folder, keep=CODE_DIGEST)
    memory = Memory(Path(folder) / CODE_DIGEST, verbose=0, compress=True)  # finds damaged files
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Exception while loading results")    # computed again
        return memory.cache(_compute, ignore=["trial", "jobs"])(*arguments)


def _compute(trial, name, seeds, options, threads, jobs):
    """The numbers of `run`; joblib distinguishes studies by all arguments but trial and jobs."""
    rows = list(tqdm(workers.rows(trial, seeds, options, jobs), total=len(seeds),
                     desc=trial.__name__, leave=False, delay=BAR_AFTER,
                     disable="SLAMLIB_RESULTS" in os.environ or "ipykernel" not in sys.modules))
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


def _threads():
    """The environment's variables that set numbers of threads, sorted pairs of name and value."""
    return sorted(item for item in os.environ.items() if item[0].startswith(THREADS))


def forget(folder, keep=None):
    """Remove the studies in a folder, except those of the code with the digest `keep`."""
    for kept in Path(folder).glob("[0-9a-f]" * 64):
        if kept.name != keep:
            shutil.rmtree(kept, ignore_errors=True)


def code_digest():
    """Digest (str) of what all studies depend on: the current slamlib, Python and packages."""
    return digest(repr([
        platform.python_implementation(), platform.python_version(), platform.platform(),
        [version(package) for package in NUMERIC_PACKAGES],
        [(str(file.relative_to(SLAMLIB)), digest(file.read_bytes()))
         for file in modules(*PAGE_PACKAGES)]]).encode())


def modules(*without):
    """Paths of slamlib's modules and styles, except __main__ and the packages `without` (str)."""
    return sorted(file for file in SLAMLIB.rglob("*")
                  if file.suffix in (".py", ".mplstyle") and file.name != "__main__.py"
                  and file.relative_to(SLAMLIB).parts[0] not in without)


def digest(content):
    """The SHA-256 of bytes, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


CODE_DIGEST = code_digest()                # of the code that this process imported
