"""Executed notebooks, kept until something changes that they depend on, a few versions of each.

A notebook is executed again when its cells, slamlib's code (but for what only makes the pages), a
package, a file of the selected datasets, a file beside the notebook or a variable of its environment is
another than it was, and when a result that it wrote is no longer as it wrote it. What it was before is
still kept, so that another selection of datasets and then the first one again cost one execution.
"""

import json
import platform
from copy import deepcopy
from importlib.metadata import distributions
from pathlib import Path

import nbformat

from slamlib.studies import PRESENTATION, digest, modules, read_checked, write_checked

VARIABLES = ("SLAMLIB_", "PYTHON", "MPL", "OMP_", "OPENBLAS_", "MKL_", "LANG", "LC_", "TZ",
             "SOURCE_DATE_EPOCH")  # how the names of those begin that may change what a cell says

VERSIONS = 4  # of a notebook, those that were used last


def fingerprint(datasets, beside, environment):
    """A digest of all that notebooks depend on besides their own cells.

    Parameters
    ----------
    datasets : list of Path, the folders of the selected datasets.
    beside : Path, the folder of the notebooks; other files in it may be read by them.
    environment : dict of the kernels' environment variables.
    """
    files = [*modules(PRESENTATION), *(file for folder in datasets for file in sorted(folder.rglob("*"))),
             *(file for file in sorted(beside.iterdir()) if file.suffix != ".ipynb")]
    return digest(json.dumps([
        platform.python_implementation(), platform.python_version(), platform.platform(),
        sorted(f"{package.name} {package.version}" for package in distributions()),
        [(str(file), digest(file.read_bytes())) for file in files if file.is_file()],
        sorted((name, value) for name, value in environment.items()
               if name.startswith(VARIABLES) and name != "MPLBACKEND")]).encode())


def key_of(source, book, common):
    """The digest of a notebook that is not yet executed, and of the `common` fingerprint."""
    book = deepcopy(book)
    for cell in book.cells:
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    return digest(json.dumps([source.name, nbformat.writes(book), common]).encode())


def recall(folder, source, key, results):
    """The executed notebook and the names of its results, or None if it must be executed again."""
    place = _place(folder, source, key)
    content = read_checked(place)
    if content is None:
        return None
    kept = json.loads(content)
    try:
        for name, expected in kept["results"].items():
            if digest((results / name).read_bytes()) != expected:
                return None
        place.touch()
    except OSError:
        return None
    return nbformat.reads(kept["book"], as_version=4), list(kept["results"])


def keep(folder, source, key, book, results, names):
    """Keep an executed notebook, with the digests of the results (by name) that it wrote."""
    content = json.dumps({
        "book": nbformat.writes(book),
        "results": {name: digest((results / name).read_bytes()) for name in names}}).encode()
    write_checked(_place(folder, source, key), content)
    versions = [file for file in Path(folder).glob("*.executed")
                if file.name.rsplit(".", 2)[0] == source.stem]
    for old in sorted(versions, key=lambda file: file.stat().st_mtime_ns)[:-VERSIONS]:
        old.unlink()


def _place(folder, source, key):
    return Path(folder) / f"{source.stem}.{key}.executed"
