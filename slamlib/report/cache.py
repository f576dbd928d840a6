"""A cache of executed notebooks, a few versions of each.

A notebook is executed again when its cells, slamlib's code (without the package `report`), an
installed package, a file of the selected datasets, another file beside the notebook or an
environment variable changed. The result files that it wrote are kept with it. Earlier versions
stay, so returning to an earlier selection of datasets executes nothing.
"""

import json
import platform
from copy import deepcopy
from importlib.metadata import distributions
from io import BytesIO
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import nbformat

from slamlib import swap
from slamlib.studies.memory import digest, modules

VARIABLES = ("SLAMLIB_", "PYTHON", "MPL", "OMP_", "OPENBLAS_", "MKL_", "LANG", "LC_", "TZ",
             "SOURCE_DATE_EPOCH")  # prefixes of environment variables that may change an output
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

    Its result files are written below `results`.

    Parameters
    ----------
    folder, results : str or Path, the folder of the cache; Path, the folder for the result files.
    source, key : Path of the notebook and str by `key_of`.
    """
    path = Path(folder, f"{source.stem}.{key}.executed")
    try:
        checksum, _, content = path.read_bytes().partition(b"\n")
    except OSError:
        return None
    if checksum != _checksum(key, content):
        return None
    try:
        archive = ZipFile(BytesIO(content))
        book = nbformat.reads(archive.read(BOOK).decode(), as_version=4)
        nbformat.validate(book)
        names = json.loads(archive.read(NAMES))
        whole = not archive.testzip() and archive.namelist() == [
            BOOK, NAMES, *(RESULTS + name for name in names)]
    except Exception:  # zipfile, zlib, json and nbformat raise many kinds
        return None
    if not whole or any(".." in name.split("/") for name in names):
        return None
    for name in names:
        swap.write(results / name, archive.read(RESULTS + name))
    path.touch()
    return book, names


def _checksum(key, content):
    return digest(key.encode() + content).encode()


def keep(folder, source, key, book, results, names):
    """Write an executed notebook to the cache, and remove its oldest versions.

    Parameters
    ----------
    folder, source, key, results : as in `recall`.
    book : NotebookNode, executed.
    names : list of str, the result files that it wrote, relative to `results`.
    """
    content = BytesIO()
    with ZipFile(content, "w", ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as archive:
        archive.writestr(BOOK, nbformat.writes(book))
        archive.writestr(NAMES, json.dumps(names))
        for name in names:
            archive.write(results / name, RESULTS + name)
    content = content.getvalue()
    swap.write(Path(folder, f"{source.stem}.{key}.executed"),
               _checksum(key, content) + b"\n" + content)
    versions = [file for file in Path(folder).glob("*.executed")
                if file.name.rsplit(".", 2)[0] == source.stem]
    for old in sorted(versions, key=lambda file: file.stat().st_mtime_ns)[:-VERSIONS]:
        old.unlink()
