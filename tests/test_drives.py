"""Problems solved in a chapter: results are written, and what fails or is doubted is said."""

import logging

import numpy as np
import pytest
from conftest import contradicted
from numeric import short

from slamlib import fuse, localize
from slamlib.core.errors import DatasetError
from slamlib.io.results import read_structs, read_summary
from slamlib.notebook import Drive, attempt, drives, show_doubts, start, write_results
from slamlib.robust.file_doubts import Doubt
from slamlib.studies.simulation import write_dataset

REASON = "expected sightings that agree"


@pytest.fixture
def said(monkeypatch, tmp_path):
    """The texts that a notebook shows; its results are in tmp_path / "results"."""
    texts = []
    monkeypatch.setenv("SLAMLIB_RESULTS", str(tmp_path / "results"))
    monkeypatch.setattr(drives, "display", lambda text: texts.append(text.data))
    return texts


@pytest.fixture(scope="module")
def good():
    """A drive on which every problem can be solved."""
    return Drive("good", short(3, 100)[0].without("uwb"), None)


@pytest.fixture(scope="module")
def bad(good):
    """A drive on which problem 2 cannot be solved by the markers alone."""
    return Drive("b*d", contradicted(good.dataset), None)


def test_a_problem_that_fails_is_said_and_in_the_summary_and_the_others_are_written(
        said, bad, tmp_path):
    with attempt(bad, "problem2"):
        localize(bad.dataset.sightings)
        raise AssertionError("never reached")
    with attempt(bad, "problem2_fused"):
        write_results(bad, "problem2_fused", fuse(bad.dataset))
    text, = said
    assert text.startswith(
        "**b&#42;d**: The problem &#8220;ArUco&#8221; could not be solved: " + REASON)
    problems = read_summary(tmp_path / "results" / "b*d")["problems"]
    assert problems["problem2"]["failed"].startswith(REASON)
    assert "failed" not in problems["problem2_fused"]


def test_a_second_result_of_a_problem_replaces_the_first(said, good, tmp_path):
    for x in (1.0, 2.0):
        write_results(good, "problem1", (np.full((100, 3), x), np.zeros((100, 3, 3))))
    _, poses, _ = read_structs(tmp_path / "results" / "good" / "problem1", "vehiclePose")
    assert poses[0, 0] == 2.0


def test_a_comparison_that_fails_is_said_and_no_failure_of_a_problem(said, bad, tmp_path):
    with attempt(bad):
        localize(bad.dataset.sightings)
    assert said[0].startswith("**b&#42;d**: left out here: " + REASON)
    assert not (tmp_path / "results").exists()


def test_a_defect_is_no_failure(said, good):
    with pytest.raises(ZeroDivisionError), attempt(good, "problem1"):
        raise ZeroDivisionError


def test_doubts_are_said_with_the_name_of_the_drive(said, good):
    show_doubts(good, [Doubt("antenna", "Antenna 7 is *far*.")])
    assert said == ["**good**: Antenna 7 is &#42;far&#42;."]


@pytest.fixture
def data(monkeypatch, tmp_path, look):
    """A data folder with a simulated drive, a recorded one, and a longer one without markers."""
    dataset, _ = short(3, 60)
    folder = tmp_path / "data"
    write_dataset(folder / "stand_in", *short(3, 30))
    write_dataset(folder / "wheels", dataset.without("aruco").without("uwb"), None)
    write_dataset(folder / "mine", dataset.first(40), None)
    monkeypatch.setenv("SLAMLIB_DATA", str(folder))
    monkeypatch.delenv("SLAMLIB_DATASETS", raising=False)
    return folder


def test_recorded_drives_are_shown_alone_by_length_and_with_a_sensor(data):
    assert [drive.name for drive in start()] == ["mine", "wheels"]
    assert [drive.name for drive in start("aruco")] == ["mine"]


def test_selected_drives_are_shown_the_recorded_ones_first(data, monkeypatch):
    monkeypatch.setenv("SLAMLIB_DATASETS", "stand_in\nmine")
    assert [drive.name for drive in start()] == ["mine", "stand_in"]
    monkeypatch.setenv("SLAMLIB_DATASETS", "absent")
    with pytest.raises(DatasetError, match="absent"):
        start()


def test_where_no_drive_has_the_sensor_it_is_said(data, monkeypatch):
    monkeypatch.setenv("SLAMLIB_DATASETS", "wheels")
    with pytest.raises(DatasetError, match="UWB ranges to antennas with a guess, found none"):
        start("uwb")


def test_what_slamlib_warns_of_is_said_of_the_drive(said, good):
    with attempt(good):
        logging.getLogger("slamlib.core.graph_solution").warning("no step lowers the error")
    assert said == ["**good**: no step lowers the error"]
