"""The notebooks as they are run for the report: on the stand-ins, and on what a user may bring."""

import html
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from slamlib.dataset import read_dataset
from slamlib.odometry import equation2
from slamlib.report import build_report
from slamlib.results import read_vehicle_poses
from slamlib.simulation import simulate, write_dataset

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """The report on the committed data, and on a new drive, one without truth and one bare."""
    folder = tmp_path_factory.mktemp("built")
    data = folder / "data"
    shutil.copytree(ROOT / "data", data)
    write_dataset(data / "new seed", *simulate("short", seed=77, late_ranges=0.15))
    shutil.copytree(data / "new seed", data / "no_truth", ignore=lambda *_: ["truth"])
    (data / "wheels_only").mkdir()
    shutil.copy(data / "new seed" / "encoderReading.txt", data / "wheels_only")
    pages = build_report(ROOT / "notebooks", data, folder / "report", folder / "results")
    return folder, {page.stem: page.read_text(encoding="utf-8") for page in pages}


def test_every_notebook_becomes_a_page(built):
    _, pages = built
    notebooks = {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert pages.keys() == notebooks | {"index"} and "1_odometry" in notebooks


def test_results_are_those_of_the_library(built):
    folder, _ = built
    for data in (folder / "data").iterdir():
        if data.is_dir():
            dataset = read_dataset(data)
            expected = equation2(dataset.ticks, dataset.vehicle)
            for got, wanted in zip(read_vehicle_poses(folder / "results" / data.name / "problem1"),
                                   expected):
                np.testing.assert_array_equal(got, wanted)


def test_pages_name_every_dataset_and_say_what_is_left_out(built):
    _, pages = built
    text = html.unescape(re.sub(r"<[^>]+>", "", pages["1_odometry"]))
    for name in ("short", "long", "new seed", "no_truth", "wheels_only"):
        assert name in text and name in pages["index"]
    assert re.search(r"No truth comes with no_truth and wheels_only, so the error of the odometry "
                     r"cannot be shown there", text)


def test_no_cell_wrote_to_stderr(built):
    """A warning in a page is a defect of the notebook."""
    _, pages = built
    for name, page in pages.items():
        assert "stderr" not in re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL), name
