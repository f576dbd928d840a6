"""A cache of executed notebooks with the result files that they wrote, a few versions of each.

A notebook is executed again when its code cells, slamlib's code (without the package `report`), an
installed package, a file of the selected datasets, another file beside the notebook or in a folder
there, or one of slamlib's environment variables changed; not when its text, its metadata or outputs
that an editor saved in it did.
"""

import json
import platform
import re
import sys
from io import BytesIO
from pathlib import Path

import joblib
from nbformat import NotebookNode

from slamlib.io.files import write_file
from slamlib.report.execution import LAB_ONLY, Books
from slamlib.report.notebooks import tags_of
from slamlib.studies import runs as memory
from slamlib.studies.runs import digest

VARIABLES = "SLAMLIB_"  # begins the environment variables that are heeded
IGNORED = "SLAMLIB_STUDIES"  # where studies are kept does not matter
UNSEEN = re.compile(r"(^|/)(\.|__pycache__/)|^(build|report|results)/|\.ipynb$")  # paths
HEEDED_TAGS = {"raises-exception", LAB_ONLY}  # the tags of cells that nbclient heeds
VERSIONS = 4  # of each notebook, the last used


def keys(books: Books, datasets: list[Path], environment: dict[str, str]) -> dict[Path, str]:
    """Return the keys of books, digests of what they need.

    `datasets` are the folders of the selected datasets, `environment` the environment variables of
    the kernels. Where slamlib's code is does not matter.
    """
    notebooks = next(iter(books)).parent
    # The names of their folders have the versions; to read what is in them takes long.
    packages = {path.name for folder in sys.path for path in Path(folder).glob("*.dist-info")
                if not path.name.startswith("slamlib-")}
    heeded = {name: environment[name] for name in sorted(environment)
              if name.startswith(VARIABLES) and name != IGNORED}
    common = [sys.version, platform.platform(), sorted(packages), heeded,
              _digests(notebooks, datasets)]
    found = {}
    for source, book in books.items():
        code = [(cell.source, sorted(HEEDED_TAGS.intersection(tags_of(cell))))
                for cell in _code_cells(book)]
        found[source] = digest(json.dumps([common, source.name, code]).encode())
    return found


def _digests(notebooks, datasets):
    """Return names and digests of the files that matter, of slamlib, datasets and notebooks."""
    files = [(memory.SLAMLIB, file) for file in memory.modules("report")]
    files.append((Path(__file__).parent, Path(__file__)))  # for the format of the cache
    for folder in datasets:
        files += [(folder.parent, file) for file in sorted(folder.rglob("*"))]
    files += [(notebooks, file) for file in sorted(notebooks.rglob("*"))
              if not UNSEEN.search(file.relative_to(notebooks).as_posix())]
    return [(file.relative_to(folder).as_posix(), digest(file.read_bytes()))
            for folder, file in files if file.is_file()]


def _code_cells(book):
    return [cell for cell in book.cells if cell.cell_type == "code"]


def recall(folder: Path, source: Path, key: str, book: NotebookNode, results: Path) -> list | None:
    """Return the names of a notebook's results, or None if it must be executed.

    Its result files are written below `results`, and its outputs into `book`, the notebook as it
    is now. `folder` is that of the cache.
    """
    path = folder / f"{source.stem}.{key}.executed"
    try:
        executed, contents = joblib.load(path)
    except Exception:  # it is absent or damaged
        return None
    for cell, (outputs, count) in zip(_code_cells(book), executed, strict=True):
        cell.outputs = outputs
        cell.execution_count = count
    for name, content in contents.items():
        write_file(results / name, content)
    path.touch()
    return list(contents)


def keep(folder: Path, source: Path, key: str, book: NotebookNode, results: Path, names: list):
    """Write an executed notebook with its result files `names` to the cache, as for `recall`.

    Its oldest versions are removed.
    """
    executed = [(cell.outputs, cell.execution_count) for cell in _code_cells(book)]
    contents = {name: (results / name).read_bytes() for name in names}
    file = BytesIO()
    joblib.dump([executed, contents], file, compress=1)  # with a checksum
    write_file(folder / f"{source.stem}.{key}.executed", file.getvalue())
    versions = [path for path in folder.glob("*.executed")
                if path.name.rsplit(".", 2)[0] == source.stem]
    versions.sort(key=lambda path: path.stat().st_mtime_ns)
    for old in versions[:-VERSIONS]:
        old.unlink()
