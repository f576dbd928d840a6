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

from slamlib.io import swap
from slamlib.report.execution import LAB_ONLY
from slamlib.studies import runs as memory
from slamlib.studies.runs import digest

VARIABLES, IGNORED = "SLAMLIB_", "SLAMLIB_STUDIES"  # begins those heeded, but this one
UNSEEN = re.compile(r"(^|/)(\.|__pycache__/)|^(build|report|results)/|\.ipynb$")  # paths
HEEDED_TAGS = {"raises-exception", LAB_ONLY}  # the tags of cells that nbclient heeds
VERSIONS = 4  # of each notebook, the last used


def keys(books, datasets, environment):
    """Return {source: key} of books (dict from Path to NotebookNode), digests of what they need.

    `datasets` (list of Path) are the folders of the selected datasets, `environment` (dict of str)
    the environment variables of the kernels. Where slamlib's code is does not matter.
    """
    notebooks = next(iter(books)).parent
    files = [(memory.SLAMLIB, file) for file in memory.modules("report")]
    files += [(Path(__file__).parent, Path(__file__))]                 # for the format of the cache
    files += [(folder.parent, file) for folder in datasets for file in sorted(folder.rglob("*"))]
    files += [(notebooks, file) for file in sorted(notebooks.rglob("*"))
              if not UNSEEN.search(file.relative_to(notebooks).as_posix())]
    common = [
        platform.python_implementation(), platform.python_version(), platform.platform(),
        sorted({path.name for folder in sys.path for path in Path(folder).glob("*.dist-info")
                if not path.name.startswith("slamlib-")}),             # reading them takes long
        [(file.relative_to(folder).as_posix(), digest(file.read_bytes()))
         for folder, file in files if file.is_file()],
        sorted((name, value) for name, value in environment.items()
               if name.startswith(VARIABLES) and name != IGNORED)]
    return {source: digest(json.dumps([common, source.name, [
        (cell.source, sorted(HEEDED_TAGS.intersection(cell.metadata.get("tags", ()))))
        for cell in _code_cells(book)]]).encode()) for source, book in books.items()}


def _code_cells(book):
    return [cell for cell in book.cells if cell.cell_type == "code"]


def recall(folder, source, key, book, results):
    """Return the names of a notebook's results, or None if it must be executed.

    Its result files are written below `results` (Path), and its outputs into `book`, the
    NotebookNode as it is now. `folder` is that of the cache, `source` the notebook's Path.
    """
    path = Path(folder, f"{source.stem}.{key}.executed")
    try:
        executed, contents = joblib.load(path)
    except Exception:  # it is absent or damaged
        return None
    for cell, (outputs, count) in zip(_code_cells(book), executed, strict=True):
        cell.outputs, cell.execution_count = outputs, count
    for name, content in contents.items():
        swap.write_atomically(results / name, content)
    path.touch()
    return [*contents]


def keep(folder, source, key, book, results, names):
    """Write an executed notebook with its result files `names` to the cache, as for `recall`.

    Its oldest versions are removed.
    """
    executed = [(cell.outputs, cell.execution_count) for cell in _code_cells(book)]
    content = BytesIO()
    joblib.dump([executed, {name: (results / name).read_bytes() for name in names}], content,
                compress=1)  # with a checksum
    swap.write_atomically(Path(folder, f"{source.stem}.{key}.executed"), content.getvalue())
    versions = [file for file in Path(folder).glob("*.executed")
                if file.name.rsplit(".", 2)[0] == source.stem]
    for old in sorted(versions, key=lambda file: file.stat().st_mtime_ns)[:-VERSIONS]:
        old.unlink()
