"""Problems solved in a chapter: what fails is left out and said, there and on the first page."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import contradicted
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib import solve
from slamlib.dataset import DatasetError
from slamlib.doubt import Doubt
from slamlib.notebook import (
    Drive,
    notices,
    say_doubts,
    show,
    solved,
    solving,
    where_possible,
    write_results,
)
from slamlib.notebook.show import simulated_drive
from slamlib.simulation import simulate

REASON = "expected sightings that agree"
PROBLEM_2 = ["problem2", "problem2_hint", "problem2_fused"]


@pytest.fixture
def said(monkeypatch):
    """What a notebook shows: pairs of Markdown and the metadata of the output."""
    outputs = []
    for module in (show, solving):
        monkeypatch.setattr(module, "display", lambda text, metadata=None: outputs.append(
            (text.data, metadata or {})))
    return outputs


@pytest.fixture(scope="module")
def drives():
    """A drive on which problem 2 can be solved, and one on which it cannot."""
    dataset = simulate("short", seed=3)[0].first(100).without("uwb")
    bad = replace(dataset, aruco=contradicted(dataset.aruco))
    return [Drive("good", dataset, None), Drive("b*d", bad, None)]


def book_of(said):
    """An executed notebook with these outputs."""
    return new_notebook(cells=[new_markdown_cell("# 1"), new_code_cell(outputs=[
        new_output("stream", text="printed"),
        *(new_output("display_data", {"text/markdown": text}, metadata=metadata)
          for text, metadata in said)])])


def test_a_drive_that_fails_is_left_out_and_said_and_its_other_problems_are_found(said, drives):
    left, found = solved(drives, PROBLEM_2)
    assert [drive.name for drive in left] == ["good"]
    assert [set(found[problem]) for problem in PROBLEM_2] == [
        {"good"}, {"good", "b*d"}, {"good", "b*d"}]
    (reason, record), (left_out, plain) = said
    assert "“ArUco” could not be solved on b&#42;d: " + REASON in reason
    assert left_out == "*This chapter leaves out b&#42;d.*" and plain == {}
    failure, = notices([book_of(said), book_of(said)])["b*d"]          # once, of two chapters
    assert failure.problem == "problem2" and failure.reason.startswith(REASON)


def test_a_problem_that_is_not_needed_costs_no_drive(said, drives):
    left, found = solved(drives, PROBLEM_2[1:], optional=PROBLEM_2[:1])
    assert left == drives and set(found["problem2"]) == {"good"}
    assert len(said) == 1 and REASON in said[0][0]


def test_where_every_drive_fails_a_simulated_one_replaces_them(said, drives, tmp_path, monkeypatch):
    left, found = solved(drives[1:], PROBLEM_2)
    assert [drive.made_up for drive in left] == [True]
    assert "no drive is left" in said[-1][0].lower() and "simulated" in said[-1][0]
    assert all(left[0].name in found[problem] for problem in PROBLEM_2)
    monkeypatch.setenv("SLAMLIB_RESULTS", str(tmp_path))
    written = [(drive.name, solution.problem, files)
               for drive, solution, files in write_results(drives[1:] + left, found)]
    assert written == [("b*d", problem, "`vehiclePose.mat`") for problem in PROBLEM_2[1:]]
    assert sorted(file.relative_to(tmp_path).as_posix() for file in tmp_path.rglob("*.*t")) == [
        "b*d/problem2_fused/vehiclePose.mat", "b*d/problem2_hint/vehiclePose.mat"]


def test_problem_4_starts_from_problem_3_only_where_there_is_one(said, monkeypatch):
    dataset = simulate("short", seed=3)[0].first(60)
    previous = []

    def estimate(dataset, **options):
        if dataset.uwb is None and dataset.name == "short":
            raise np.linalg.LinAlgError("Singular matrix")
        previous.append(options.get("previous"))
        return SimpleNamespace(poses=np.zeros((1, 3)), covariances=np.zeros((1, 3, 3)))

    monkeypatch.setattr(solve.slam, "estimate", estimate)
    other = replace(dataset, name="other")
    both = [Drive("short", dataset, None), Drive("other", other, None)]
    left, found = solved(both, ["problem4"], optional=["problem3"])
    assert left == both and set(found["problem3"]) == {"other"}
    assert previous == [None, None, found["problem3"]["other"]]
    assert "matrices lose their digits &#40;Singular matrix&#41;" in said[0][0]


def test_a_simulated_drive_that_fails_is_a_defect(said, drives, monkeypatch):
    def fail(*_):
        raise DatasetError("never")

    monkeypatch.setattr(solve.localization, "localize", fail)
    with pytest.raises(DatasetError, match="never"):
        solved(drives, ["problem2"])
    assert simulated_drive([Drive("simulated", None, None)]).name == "simulated instead"


def test_a_comparison_that_fails_is_said_and_no_failure_of_a_problem(said, drives):
    found = where_possible(drives, lambda drive: solve.find("problem2", drive.dataset), "It")
    assert set(found) == {"good"}
    (text, metadata), = said
    assert f"*It cannot be shown on b&#42;d: {REASON}" in text and metadata == {}


def test_doubts_are_said_where_they_are_found_and_told_to_the_first_page(said, drives):
    doubts = [Doubt("units", "Lengths are in mm."), Doubt("antenna", "Antenna 7 is *far*.")]
    say_doubts(drives[0], doubts)
    say_doubts(Drive("simulated", None, None, made_up=True), doubts)
    assert said[1][0] == "**good**: Antenna 7 is &#42;far&#42;."
    assert notices([book_of(said)]) == {"good": doubts}
    assert notices([new_notebook()]) == {}
