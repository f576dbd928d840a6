"""Monte Carlo studies, kept from one build of the report to the next.

A study depends on slamlib's code (but for what only shows it), on the packages that compute it, and on its
trial, seeds and options, but not on a user's datasets. While a report is built, SLAMLIB_STUDIES names the
folder of those that are kept; without this variable each is computed. Times that a trial measures are kept
as well, and are not for a page.
"""

import hashlib
import os
import platform
from importlib.metadata import version
from io import BytesIO
from pathlib import Path

import joblib
import numpy as np

from slamlib.results import write_atomically

# Modules that make pages of what notebooks have shown, and are not imported by them.
PRESENTATION = ("cache", "cover", "execution", "formulas", "numbering", "overview", "pages", "pdf", "report",
                "__main__")

# What notebooks show studies by, but do not compute them by.
SHOWING = ("explore", "notebook", "plotting")

PACKAGES = ("numpy", "scipy", "gtsam")
THREADS = ("OMP_", "OPENBLAS_", "MKL_")  # how the names of variables begin


def code():
    """A digest of all that every study depends on: slamlib, Python and packages, as they now are."""
    files = [file for file in modules(PRESENTATION + SHOWING) if file.suffix == ".py"]
    return digest(repr([
        platform.python_implementation(), platform.python_version(), platform.platform(),
        [version(package) for package in PACKAGES],
        [(file.name, digest(file.read_bytes())) for file in files]]).encode())


def place(trial, seeds, options):
    """Where this study is kept, or None if it is not to be: no folder is named, or not ours to know."""
    folder = os.environ.get("SLAMLIB_STUDIES")
    if not folder or trial.__module__ != "slamlib.montecarlo":
        return None
    threads = sorted(item for item in os.environ.items() if item[0].startswith(THREADS))
    return Path(folder) / f"{CODE}.{joblib.hash([trial.__name__, seeds, options, threads])}.study"


def recall(where):
    """The numbers of the study at this place, a dict of arrays, or None if it must be computed."""
    content = where and read_checked(where)
    if not content:
        return None
    with np.load(BytesIO(content)) as numbers:
        return dict(numbers)


def keep(where, numbers):
    """Keep a study's numbers, and none that other code computed; nothing if `where` is None."""
    if where is None or code() != CODE:  # edited in the meantime: processes may have run either
        return
    buffer = BytesIO()
    np.savez(buffer, **numbers)
    write_checked(where, buffer.getvalue())
    forget(where.parent, but=CODE)


def forget(folder, but=None):
    """Remove the studies of a folder, all of them or all but those of one `code`."""
    for file in Path(folder).glob("*.study"):
        if file.name.split(".")[0] != but:
            file.unlink(missing_ok=True)


def modules(others):
    """Paths of slamlib's modules, without the `others` (names), and of its matplotlib style."""
    return sorted(file for file in Path(__file__).parent.iterdir()
                  if file.suffix in (".py", ".mplstyle") and file.stem not in others)


def read_checked(path):
    """What was written to the file, or None if it is absent or damaged."""
    try:
        expected, _, content = path.read_bytes().partition(b"\n")
    except OSError:
        return None
    return content if expected.decode("ascii", "replace") == digest(content) else None


def write_checked(path, content):
    """Write bytes to the file, with their digest in front."""
    write_atomically(path, digest(content).encode() + b"\n" + content)


def digest(content):
    """The SHA-256 of bytes, in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()


CODE = code()  # that this process runs, which files edited later do not change
