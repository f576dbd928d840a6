"""JupyterLab: how it is started, and the cells that only it shows."""

import os
import sys

import nbformat
import pytest
from conftest import ROOT, copied
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell
from test_report import make_data

from slamlib.__main__ import main
from slamlib.io.dataset import read_dataset
from slamlib.report import execution
from slamlib.studies.simulation import write_dataset


def test_jupyterlab_replaces_the_command_and_kernels_see_the_data(tmp_path, monkeypatch):
    """But no SLAMLIB_RESULTS, by which a cell knows that it is in a build."""
    make_data(tmp_path)
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SLAMLIB_DATASETS", "short")
    made = []
    monkeypatch.setattr(os, "execve", lambda *arguments: made.append(arguments))
    main(["lab", "--no-browser", "--port", "9999"])
    (program, command, environment), = made
    assert program == sys.executable and command[1:3] == ["-m", "jupyterlab"]
    assert command[-4:] == ["--no-browser", "--port", "9999", "notebooks"]
    assert environment["SLAMLIB_DATA"] == str(tmp_path / "data")
    assert environment["SLAMLIB_DATASETS"] == "short" and "SLAMLIB_RESULTS" not in environment


def test_where_there_is_no_jupyterlab_it_is_said_how_to_install_it(tmp_path, monkeypatch, capsys):
    (tmp_path / "notebooks").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(execution, "find_spec", lambda _: None)
    assert main(["lab"]) == 2 and "JupyterLab, as by pip install" in capsys.readouterr().err


@pytest.mark.slow
def test_what_is_in_jupyterlab_only_runs_and_other_values_of_the_sliders_draw_another_picture(
        tmp_path, monkeypatch):
    """Chapter 1 on 300 poses of `short`; the pages are without these cells."""
    copied(tmp_path / "notebooks", "1_odometry.ipynb")
    write_dataset(tmp_path / "data" / "short", read_dataset(ROOT / "data" / "short").first(300))
    monkeypatch.setenv("SLAMLIB_DATA", str(tmp_path / "data"))
    book = nbformat.read(tmp_path / "notebooks" / "1_odometry.ipynb", as_version=4)
    book.cells += [new_code_cell(f"explored({right}, 0.0, 0.0)") for right in (0.0, 0.2)]
    NotebookClient(book, resources={"metadata": {"path": tmp_path / "notebooks"}}).execute()
    first, second = (cell.outputs[0].data["image/svg+xml"] for cell in book.cells[-2:])
    assert first != second
