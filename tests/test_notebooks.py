"""The notebooks as they are run for the report: on the stand-ins, and on what a user may bring."""

import html
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from conftest import BROUGHT

from slamlib.dataset import read_dataset
from slamlib.odometry import equation2
from slamlib.report import build_report
from slamlib.results import read_aruco_map, read_vehicle_poses

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def built(report_on_all):
    """The folder of the shared report, and the text of its pages by name."""
    return report_on_all, {page.stem: page.read_text(encoding="utf-8")
                           for page in (report_on_all / "report").glob("*.html")}


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


def test_results_of_problem_2_are_where_there_are_markers(built):
    folder, pages = built
    for data in (folder / "data").iterdir():
        if data.is_dir():
            dataset, results = read_dataset(data), folder / "results" / data.name
            assert (results / "problem2").exists() == (dataset.aruco is not None)
            assert (results / "problem2_fused").exists() == (dataset.aruco is not None)
            if dataset.aruco is not None:
                alone, covariances = read_vehicle_poses(results / "problem2")
                fused, _ = read_vehicle_poses(results / "problem2_fused")
                assert len(alone) == len(fused) == len(dataset.ticks)
                known = np.isfinite(alone[:, 0])
                assert np.isin(np.flatnonzero(known), dataset.aruco.pose).all() and known.any()
                assert (np.isfinite(covariances[:, 0, 0]) == known).all() and np.isfinite(fused).all()
                ids, markers, _ = read_aruco_map(results / "problem2")
                assert np.isin(ids, dataset.aruco.marker).all() and np.isfinite(markers).all()
                assert f"{data.name}/problem2/ArucoMap.mat" in html.unescape(pages["index"])


def test_pages_name_every_dataset_and_say_what_is_left_out(built):
    _, pages = built
    text = html.unescape(re.sub(r"<[^>]+>", "", pages["1_odometry"]))
    sentence = re.search(r"No truth comes with ([^.]*?), so the error of the odometry cannot be shown",
                         text)
    for name in BROUGHT:
        assert name in text and name in pages["index"]
    markers = html.unescape(re.sub(r"<[^>]+>", "", pages["2_aruco_localization"]))
    left_out = re.search(r"There are no markers in ([^:]*): this chapter leaves them out", markers)
    assert set(re.split(", | and ", left_out[1])) >= {"wheels_only", "waits", "one_pose", "backs_up"}
    for name in BROUGHT:
        assert (name in re.split(", | and ", sentence[1])) == (
            name not in ("new seed", "one_sighting", "sparse"))


def test_the_first_page_says_what_is_left_out(built):
    _, pages = built
    text = html.unescape(re.sub(r"<[^>]+>", " ", pages["index"]))
    for sensor, name in (("markers", "wheels_only"), ("UWB ranges", "waits"), ("truth", "no_truth")):
        start = "No truth comes with" if sensor == "truth" else f"There are no {sensor} in"
        assert name in re.search(rf"{start}([^:]*?)(?::|, so errors)", text)[1]
    assert len(re.findall(r"wheels_only\s+odometry \+ ArUco\s+left out: no markers", text)) == 1
    assert re.search(r"no_truth\s+SLAM: odometry \+ ArUco\s+no truth\s+no truth\s[^–]*?rad\s+2,000\s", text)


def test_no_cell_wrote_to_stderr(built):
    """A warning in a page is a defect of the notebook."""
    _, pages = built
    for name, page in pages.items():
        assert "stderr" not in re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL), name


def test_every_chapter_ends_with_one_picture_to_explore_and_no_widget(built):
    _, pages = built
    for name in pages.keys() - {"index"}:
        _, section = pages[name].split('<h2 id="Explore">')
        assert section.count("<figure>") == 1 == section.count('src="data:image/svg+xml;base64,'), name
        assert "<script" not in pages[name] and "widget" not in section, name
        assert not re.search(r"(VBox|Output|interactive)\(", section), name


def test_without_any_markers_chapter_2_can_still_be_read(tmp_path, kept):
    (tmp_path / "data" / "wheels").mkdir(parents=True)
    (tmp_path / "data" / "wheels" / "encoderReading.txt").write_text("1 0 0\n2 100 90\n3 90 100\n")
    (tmp_path / "notebooks").mkdir()
    shutil.copy(ROOT / "notebooks" / "2_aruco_localization.ipynb", tmp_path / "notebooks")
    pages = build_report(tmp_path / "notebooks", tmp_path / "data", tmp_path / "report",
                         tmp_path / "results", kept=kept)
    assert "runs on a simulated drive instead" in pages[1].read_text(encoding="utf-8")
    assert list((tmp_path / "results").iterdir()) == []


def captions(page):
    return re.findall(r'<p class="caption" id="(figure|table)-(\d+)\.(\d+)">', page)


def test_without_truth_nothing_is_missing_from_the_numbers_or_named_in_vain(built, kept, tmp_path):
    folder, with_truth = built
    alone = build_report(ROOT / "notebooks", folder / "data", tmp_path / "report", tmp_path / "results",
                         ["no_truth"], kept=kept)
    pages = {page.stem: page.read_text(encoding="utf-8") for page in alone if page.suffix == ".html"}
    for name in pages.keys() - {"index"}:
        for page in (pages[name], with_truth[name]):
            for kind in ("figure", "table"):
                found = [(int(chapter), int(n)) for which, chapter, n in captions(page) if which == kind]
                assert found == [(int(name[0]), n) for n in range(1, len(found) + 1)] and found, name
        assert len(captions(pages[name])) < len(captions(with_truth[name])), name  # errors are left out
        assert "No truth comes with no_truth" in pages[name], name


def test_no_page_says_nan(built):
    _, pages = built
    for name, page in pages.items():
        assert not re.search(r"\bnan\b", re.sub(r"<pre.*?</pre>", "", page, flags=re.DOTALL)), name


def test_no_page_shows_an_object_s_address(built):
    _, pages = built
    for name, page in pages.items():
        assert not re.search(r" at 0x[0-9a-f]{6}", page), name
