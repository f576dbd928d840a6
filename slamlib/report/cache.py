"""A cache of executed notebooks, a few versions of each.

A notebook is executed again when its cells, slamlib's code (without the package `report`), an
installed package, a file of the selected datasets, another file beside the notebook or an
environment variable changed, or when a result file is no longer as the notebook wrote it. Earlier
versions stay, so returning to an earlier selection of datasets executes nothing.
"""

import json
import platform
from copy import deepcopy
from importlib.metadata import distributions
from pathlib import Path

import nbformat

from slamlib.results import write_atomically
from slamlib.studies.memory import digest, modules

VARIABLES = ("SLAMLIB_", "PYTHON", "MPL", "OMP_", "OPENBLAS_", "MKL_", "LANG", "LC_", "TZ",
             "SOURCE_DATE_EPOCH")  # prefixes of environment variables that may change an output
VERSIONS = 4  # of each notebook, the last used


def fingerprint(datasets, notebooks, environment):
    """Return a digest (str) of everything besides its own cells that a notebook depends on.

    Parameters
    ----------
    datasets, notebooks : list of Path, the folders of the selected datasets; Path, the notebooks'.
    environment : dict of str, the environment variables of the kernels.
    """
    files = [*modules("report"),
             *(file for folder in datasets for file in sorted(folder.rglob("*"))),
             *(file for file in sorted(notebooks.iterdir()) if file.suffix != ".ipynb")]
    return digest(json.dumps([
        platform.python_implementation(), platform.python_version(), platform.platform(),
        sorted(f"{package.name} {package.version}" for package in distributions()),
        [(str(file), digest(file.read_bytes())) for file in files if file.is_file()],
        sorted((name, value) for name, value in environment.items()
               if name.startswith(VARIABLES) and name != "MPLBACKEND")]).encode())


def key_of(source, book, common):
    """Return the cache key (str) of a notebook, given as Path and NotebookNode.

    It is a digest of its name, its cells without outputs, and the fingerprint `common` (str).
    """
    book = deepcopy(book)
    for cell in book.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    return digest(json.dumps([source.name, nbformat.writes(book), common]).encode())


def recall(folder, source, key, results):
    """Return an executed notebook and the names of its results, or None if it must be executed.

    Parameters
    ----------
    folder, results : str or Path, the folder of the cache; Path, the folder of the result files.
    source, key : Path of the notebook and str by `key_of`.
    """
    path = Path(folder, f"{source.stem}.{key}.executed")
    try:
        checksum, _, content = path.read_bytes().partition(b"\n")
        if checksum != digest(content).encode():
            return None
        entry = json.loads(content)
        if any(digest((results / name).read_bytes()) != expected
               for name, expected in entry["results"].items()):
            return None
        path.touch()
    except OSError:
        return None
    return nbformat.reads(entry["book"], as_version=4), list(entry["results"])


def keep(folder, source, key, book, results, names):
    """Write an executed notebook to the cache, and remove its oldest versions.

    Parameters
    ----------
    folder, source, key, results : as in `recall`.
    book : NotebookNode, executed.
    names : list of str, the result files that it wrote, relative to `results`.
    """
    content = json.dumps({
        "book": nbformat.writes(book),
        "results": {name: digest((results / name).read_bytes()) for name in names}}).encode()
    write_atomically(Path(folder, f"{source.stem}.{key}.executed"),
                     digest(content).encode() + b"\n" + content)
    versions = [file for file in Path(folder).glob("*.executed")
                if file.name.rsplit(".", 2)[0] == source.stem]
    for old in sorted(versions, key=lambda file: file.stat().st_mtime_ns)[:-VERSIONS]:
        old.unlink()
