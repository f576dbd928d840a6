"""A cache of executed notebooks, a few versions of each.

A notebook is executed again when its code cells, slamlib's code (without the package `report`), an
installed package, a file of the selected datasets, another file beside the notebook or an
environment variable changed. Its text, its metadata and outputs that an editor saved in it do not
matter: the kept outputs are put into the notebook as it is now. The result files that it wrote are
kept with it. Earlier versions stay, so returning to an earlier selection of datasets executes
nothing.
"""

import json
import platform
from importlib.metadata import distributions
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import nbformat

from slamlib import swap
from slamlib.studies.memory import digest, modules

VARIABLES = ("SLAMLIB_", "PYTHON", "MPL", "OMP_", "OPENBLAS_", "MKL_", "LANG", "LC_", "TZ",
             "SOURCE_DATE_EPOCH")  # prefixes of environment variables that may change an output
IGNORED = ("MPLBACKEND", "SLAMLIB_STUDIES")
HEEDED = {"raises-exception", "skip-execution"}  # the tags of cells that nbclient heeds
VERSIONS = 4  # of each notebook, the last used
BOOK, NAMES, RESULTS = "executed.ipynb", "results.json", "results/"  # in a notebook's ZIP archive


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
               if name.startswith(VARIABLES) and name not in IGNORED)]).encode())


def key_of(source, book, common):
    """Return the cache key (str) of a notebook, given as Path and NotebookNode.

    It is a digest of its name, its code cells in order, and the fingerprint `common` (str).
    """
    cells = [(cell.source, sorted(HEEDED.intersection(cell.metadata.get("tags", ()))))
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
    path = entry(folder, source, key)
    try:
        checksum, _, content = path.read_bytes().partition(b"\n")
    except OSError:
        return None
    if checksum != _checksum(key, content):
        return None
    try:
        archive = ZipFile(BytesIO(content))
        executed = nbformat.reads(archive.read(BOOK).decode(), as_version=4)
        nbformat.validate(executed)
        names = json.loads(archive.read(NAMES))
        whole = not archive.testzip() and archive.namelist() == [
            BOOK, NAMES, *(RESULTS + name for name in names)]
    except Exception:  # zipfile, zlib, json and nbformat raise many kinds
        return None
    cells, kept = _code_cells(book), _code_cells(executed)
    whole = whole and [cell.source for cell in cells] == [cell.source for cell in kept]
    if not whole or any(".." in name.split("/") for name in names):
        return None
    for cell, other in zip(cells, kept):
        cell.outputs, cell.execution_count = other.outputs, other.execution_count
    for name in names:
        swap.write_atomically(results / name, archive.read(RESULTS + name))
    path.touch()
    return names


def _checksum(key, content):
    return digest(key.encode() + content).encode()


def keep(folder, source, key, book, results, names):
    """Write an executed notebook to the cache, and remove its oldest versions.

    Parameters
    ----------
    folder, source, key, book, results : as in `recall`, `book` executed.
    names : list of str, the result files that it wrote, relative to `results`.
    """
    content = BytesIO()
    with ZipFile(content, "w", ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as archive:
        archive.writestr(BOOK, nbformat.writes(book))
        archive.writestr(NAMES, json.dumps(names))
        for name in names:
            archive.write(results / name, RESULTS + name)
    content = content.getvalue()
    swap.write_atomically(entry(folder, source, key), _checksum(key, content) + b"\n" + content)
    versions = [file for file in Path(folder).glob("*.executed")
                if file.name.rsplit(".", 2)[0] == source.stem]
    for old in sorted(versions, key=lambda file: file.stat().st_mtime_ns)[:-VERSIONS]:
        old.unlink()
