"""A cache of executed notebooks, a few versions of each.

A notebook is executed again when its code cells, slamlib's code (without the package `report`), an
installed package, a file of the selected datasets, another file beside the notebook or an
environment variable changed. Its text, its metadata and outputs that an editor saved in it do not
matter: the kept outputs are put into the notebook as it is now. The result files that it wrote are
kept with it. Earlier versions stay, so returning to an earlier selection of datasets executes
nothing.
"""

import gzip
import json
import platform
import sys
from base64 import b64decode, b64encode
from pathlib import Path

import nbformat

from slamlib import swap
from slamlib.studies.memory import digest, modules

VARIABLES = ("SLAMLIB_", "PYTHON", "MPL", "OMP_", "OPENBLAS_", "MKL_", "LANG", "LC_", "TZ",
             "SOURCE_DATE_EPOCH")  # prefixes of environment variables that may change an output
IGNORED_VARIABLES = ("MPLBACKEND", "SLAMLIB_STUDIES")  # they change no output
HEEDED_TAGS = {"raises-exception", "skip-execution"}  # the tags of cells that nbclient heeds
VERSIONS = 4  # of each notebook, the last used


def fingerprint(datasets, notebooks, environment):
    """Return a digest (str) of everything besides its own cells that a notebook depends on.

    Parameters
    ----------
    datasets, notebooks : list of Path, the folders of the selected datasets; Path, the notebooks'.
    environment : dict of str, the environment variables of the kernels.
    """
    files = [*modules("report"), Path(__file__),  # this one for the format of the cache
             *(file for folder in datasets for file in sorted(folder.rglob("*"))),
             *(file for file in sorted(notebooks.iterdir()) if file.suffix != ".ipynb")]
    return digest(json.dumps([
        platform.python_implementation(), platform.python_version(), platform.platform(),
        installed(),
        [(str(file), digest(file.read_bytes())) for file in files if file.is_file()],
        sorted((name, value) for name, value in environment.items()
               if name.startswith(VARIABLES) and name not in IGNORED_VARIABLES)]).encode())


def installed():
    """Return the sorted names (list of str) of what is installed, each with its version.

    They are names of folders: reading the same from the files in them takes a hundred times longer.
    """
    return sorted(path.name for folder in sys.path for path in Path(folder).glob("*-info"))


def key_of(source, book, common):
    """Return the cache key (str) of a notebook, given as Path and NotebookNode.

    It is a digest of its name, its code cells in order, and the fingerprint `common` (str).
    """
    cells = [(cell.source, sorted(HEEDED_TAGS.intersection(cell.metadata.get("tags", ()))))
             for cell in _code_cells(book)]
    return digest(json.dumps([source.name, cells, common]).encode())


def _code_cells(book):
    return [cell for cell in book.cells if cell.cell_type == "code"]


def entry(folder, source, key):
    """Return the Path of the file in the cache `folder` for a notebook (Path) with this key."""
    return Path(folder, f"{source.stem}.{key}.executed")


def recall(folder, source, key, book, results):
    """Return the names of a notebook's results, or None if it must be executed.

    Its result files are written below `results`, and its outputs into `book`.

    Parameters
    ----------
    folder, results : str or Path, the folder of the cache; Path, the folder for the result files.
    source, key, book : Path of the notebook, str by `key_of`, and NotebookNode as it is now.
    """
    path, cells = entry(folder, source, key), _code_cells(book)
    try:
        found, executed, files = json.loads(gzip.decompress(path.read_bytes()))
        executed = nbformat.from_dict(executed)
        nbformat.validate(executed)
        kept = _code_cells(executed)
        contents = {name: b64decode(content, validate=True) for name, content in files.items()}
    except Exception:  # it is absent, damaged or of another kind
        return None
    if found != key or [cell.source for cell in kept] != [cell.source for cell in cells] \
            or any(".." in name.split("/") or name.startswith("/") for name in contents):
        return None
    for cell, other in zip(cells, kept):
        cell.outputs, cell.execution_count = other.outputs, other.execution_count
    for name, content in contents.items():
        swap.write_atomically(results / name, content)
    path.touch()
    return [*contents]


def keep(folder, source, key, book, results, names):
    """Write an executed notebook to the cache, and remove its oldest versions.

    Parameters
    ----------
    folder, source, key, book, results : as in `recall`, `book` executed.
    names : list of str, the result files that it wrote, relative to `results`.
    """
    files = {name: b64encode((results / name).read_bytes()).decode() for name in names}
    content = json.dumps([key, book, files]).encode()
    swap.write_atomically(entry(folder, source, key), gzip.compress(content, compresslevel=1))
    versions = [file for file in Path(folder).glob("*.executed")
                if file.name.rsplit(".", 2)[0] == source.stem]
    for old in sorted(versions, key=lambda file: file.stat().st_mtime_ns)[:-VERSIONS]:
        old.unlink()
