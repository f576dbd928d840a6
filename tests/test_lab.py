"""JupyterLab as a user sees it: a notebook is opened and run, and a slider is moved."""

import json
import os
import re
import shlex
import subprocess
import sys
import time

import pytest
from conftest import ROOT, copied

from slamlib.io.dataset import read_dataset
from slamlib.studies.simulation import write_dataset

SECONDS = 300
NEWS = "Would you like to get notified about official Jupyter news?"


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Address and token of a JupyterLab on a copy of a notebook and 300 poses of `short`."""
    folder = tmp_path_factory.mktemp("lab")
    copied(folder / "notebooks", "1_odometry.ipynb")
    write_dataset(folder / "data" / "short", read_dataset(ROOT / "data" / "short").first(300))
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith(("SLAMLIB_", "JUPYTER"))}
    for name in ("HOME", "IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR",
                 "JUPYTER_RUNTIME_DIR", "JUPYTERLAB_SETTINGS_DIR", "JUPYTERLAB_WORKSPACES_DIR"):
        environment[name] = str(folder / name.lower())
    recipe = subprocess.run(
        ["make", "-n", "lab", "ARGS=--no-browser --ip 127.0.0.1 --port 0"], cwd=ROOT, check=True,
        text=True, capture_output=True).stdout.replace("\\\n", " ")
    options = shlex.split(re.search("-m jupyterlab (.*)", recipe)[1])
    with open(folder / "log", "w") as log:
        server = subprocess.Popen([sys.executable, "-m", "jupyterlab", *options], cwd=folder,
                                  env=environment, stdout=log, stderr=subprocess.STDOUT)
    try:
        yield _started(server, folder)
    finally:
        server.kill()
        server.wait()


def _started(server, folder):
    """What the server writes into its runtime folder when it listens: `url` and `token`."""
    deadline = time.monotonic() + SECONDS
    while time.monotonic() < deadline and server.poll() is None:
        for file in (folder / "jupyter_runtime_dir").glob("jpserver-*.json"):
            if (text := file.read_text()).rstrip().endswith("}"):              # written to the end
                return json.loads(text)
        time.sleep(0.1)
    pytest.fail("JupyterLab did not start:\n" + (folder / "log").read_text()[-2000:])


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
    assert first.startswith("data:image/svg+xml")
    slider = cell.get_by_role("slider").first
    slider.press("ArrowLeft")
    expect(picture).not_to_have_attribute("src", first)
    slider.press("ArrowRight")                      # the same values give the same picture, alone
    expect(picture).to_have_attribute("src", first)
    expect(picture).to_have_count(1)
    expect(page.locator("[data-mime-type*=stderr], [data-mime-type*=error]")).to_have_count(0)
    expect(page.get_by_text(NEWS)).to_have_count(0)
    assert not [url for url in asked if not url.startswith((lab["url"], "data:", "blob:"))]
