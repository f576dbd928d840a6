"""JupyterLab as a user sees it: a notebook is opened and run, and a slider of Explore is moved."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SECONDS = 120
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """Address and token of a JupyterLab on copies of a notebook and of the short dataset."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "notebooks").mkdir()
    shutil.copy(ROOT / "notebooks" / "1_odometry.ipynb", folder / "notebooks")
    shutil.copytree(ROOT / "data" / "short", folder / "data" / "short")
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith(("SLAMLIB_", "JUPYTER"))}
    environment |= {"HOME": str(folder)} | {name: str(folder / name.lower()) for name in (
        "IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR",
        "JUPYTERLAB_SETTINGS_DIR", "JUPYTERLAB_WORKSPACES_DIR")}
    with open(folder / "log", "w") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "jupyter", "lab", "--no-browser", "--allow-root",
             "--ServerApp.ip=127.0.0.1", "--ServerApp.port=0",
             "--LabApp.check_for_updates_class=jupyterlab.NeverCheckForUpdate", "notebooks"],
            cwd=folder, env=environment, stdout=log, stderr=subprocess.STDOUT)
    try:
        yield _started(server, folder)
    finally:
        server.terminate()
        try:
            server.wait(30)
        except subprocess.TimeoutExpired:
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


def test_moving_a_slider_changes_the_picture(chromium, lab):
    from playwright.sync_api import expect
    page = chromium.new_page(viewport={"width": 1300, "height": 1000})
    page.set_default_timeout(1000 * SECONDS)
    expect.set_options(timeout=1000 * SECONDS)
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto(f"{lab['url']}lab/tree/1_odometry.ipynb?token={lab['token']}")
    # Before the kernel is the notebook's own, JupyterLab asks which one shall run the cells.
    page.get_by_text("Python 3 (ipykernel) | Idle", exact=True).wait_for()
    page.get_by_role("menuitem", name="Run", exact=True).click()
    page.get_by_text("Run All Cells", exact=True).click()

    cell = page.locator(".jp-CodeCell").filter(has=page.get_by_role("slider"))
    picture, slider = cell.locator("img"), cell.get_by_role("slider").first
    expect(picture).to_have_count(1)
    first, value = picture.get_attribute("src"), slider.get_attribute("aria-valuenow")
    assert first.startswith("data:image/svg+xml")
    slider.press("ArrowLeft")
    expect(slider).not_to_have_attribute("aria-valuenow", value)
    expect(picture).not_to_have_attribute("src", first)
    second = picture.get_attribute("src")
    slider.press("ArrowRight")                      # the same values give the same picture, alone
    expect(picture).to_have_attribute("src", first)
    expect(picture).to_have_count(1)
    assert second != first

    expect(page.locator("[data-mime-type*=stderr], [data-mime-type*=error]")).to_have_count(0)
    away = [url for url in asked if not url.startswith((lab["url"], "data:", "blob:"))]
    assert asked and not away
