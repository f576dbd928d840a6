"""JupyterLab as a user sees it: a notebook is opened and run, and a slider is moved."""

import json
import os
import sys

import pytest
from conftest import ROOT, copied
from test_concurrency import start, wait_for
from test_report import make_data

from slamlib.__main__ import main
from slamlib.io.dataset import read_dataset
from slamlib.report import execution
from slamlib.studies.simulation import write_dataset

SECONDS = 300
NEWS = "Would you like to get notified about official Jupyter news?"


@pytest.fixture
def lab(tmp_path, monkeypatch):
    """Address and token of a JupyterLab on a copy of a notebook and 300 poses of `short`."""
    copied(tmp_path / "notebooks", "1_odometry.ipynb")
    write_dataset(tmp_path / "data" / "short", read_dataset(ROOT / "data" / "short").first(300))
    monkeypatch.setenv("HOME", str(tmp_path))                       # without settings of the user
    server = start(tmp_path, "lab", "--no-browser", "--ip", "127.0.0.1", "--port", "0")
    told = tmp_path / ".local" / "share" / "jupyter" / "runtime" / f"jpserver-{server.pid}.json"
    wait_for(told.with_name(f"jpserver-{server.pid}-open.html"), server)      # written after it
    yield json.loads(told.read_text())
    server.kill()
    server.communicate()


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
def test_moving_a_slider_changes_the_picture(chromium, lab):
    from playwright.sync_api import expect
    expect.set_options(timeout=1000 * SECONDS)
    page = chromium.new_page(viewport={"width": 1300, "height": 1000})
    page.set_default_timeout(1000 * SECONDS)
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{lab['url']}lab/tree/1_odometry.ipynb?token={lab['token']}&reset")
    # Before the kernel is the notebook's own, JupyterLab asks which one shall run the cells.
    page.get_by_text("Python 3 (ipykernel) | Idle", exact=True).wait_for()
    page.get_by_role("menuitem", name="Run", exact=True).click()
    page.get_by_text("Run All Cells", exact=True).click()
    cell = page.locator(".jp-CodeCell").filter(has=page.get_by_role("slider"))
    picture = cell.locator("img")
    expect(picture).to_have_count(1)
    first = picture.get_attribute("src")
    cell.get_by_role("slider").first.press("ArrowLeft")
    expect(picture).not_to_have_attribute("src", first)
    expect(picture).to_have_count(1)
    expect(page.locator("[data-mime-type*=stderr], [data-mime-type*=error]")).to_have_count(0)
    expect(page.get_by_text(NEWS)).to_have_count(0)
    assert not [url for url in asked if not url.startswith((lab["url"], "data:", "blob:"))]
