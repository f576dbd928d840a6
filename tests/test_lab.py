"""The cells that only JupyterLab shows."""

import asyncio

import nbformat
import pytest
from conftest import copied
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell
from numeric import short

from slamlib.studies.simulation import write_dataset


@pytest.mark.slow
def test_what_is_in_jupyterlab_only_runs_and_other_values_of_the_sliders_draw_another_picture(
        tmp_path, monkeypatch):
    """Chapter 1 on 300 poses; the pages are without these cells."""
    copied(tmp_path / "notebooks", "1_odometry.ipynb")
    write_dataset(tmp_path / "data" / "short", short(1, 300)[0])
    monkeypatch.setenv("SLAMLIB_DATA", str(tmp_path / "data"))
    book = nbformat.read(tmp_path / "notebooks" / "1_odometry.ipynb", as_version=4)
    book.cells += [new_code_cell(f"explored({right}, 0.0, 0.0)") for right in (0.0, 0.2)]
    place = {"metadata": {"path": tmp_path / "notebooks"}}
    # A reply whose arrival is missed is looked for again after this many seconds.
    asyncio.run(NotebookClient(book, resources=place, timeout=60).async_execute())
    first, second = (cell.outputs[0].data["image/svg+xml"] for cell in book.cells[-2:])
    assert first != second
