"""Problems solved in a chapter: what fails is left out and said, there and on the first page."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import contradicted
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib import estimate, fuse, localize, solve
from slamlib.core.errors import DatasetError
from slamlib.io.results import read_structs
from slamlib.notebook import Drive, attempted, drives, notices, show_doubts, solved
from slamlib.robust.file_doubts import Doubt
from slamlib.studies.simulation import simulate

REASON = "expected sightings that agree"
SOLVERS = {"problem2": lambda drive: localize(drive.dataset.sightings),
           "problem2_fused": lambda drive: fuse(drive.dataset)}


@pytest.fixture
def said(monkeypatch, tmp_path):
    """What a notebook shows: pairs of Markdown and the metadata of the output."""
    outputs = []
    monkeypatch.setenv("SLAMLIB_RESULTS", str(tmp_path))
    monkeypatch.setattr(drives, "display", lambda text, metadata=None: outputs.append(
        (text.data, metadata or {})))
    return outputs


@pytest.fixture(scope="module")
def both():
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


def files(folder):
    return sorted(file.relative_to(folder).as_posix() for file in folder.rglob("*.mat"))


def test_a_drive_that_fails_is_left_out_and_said_and_its_other_problems_are_written(
        said, both, tmp_path):
    alone, fused = solved(both, **SOLVERS)
    assert [*alone] == [*fused] == both[:1]
    assert files(tmp_path) == ["b*d/problem2_fused/vehiclePose.mat",
                               "good/problem2/ArucoMap.mat", "good/problem2/vehiclePose.mat",
                               "good/problem2_fused/vehiclePose.mat"]
    (text, _), = said
    assert text.startswith(
        "**b&#42;d**: The problem &#8220;ArUco&#8221; could not be solved: " + REASON)
    failure, = notices([book_of(said), book_of(said)])["b*d"]          # once, of two chapters
    assert failure.problem == "problem2" and failure.reason.startswith(REASON)


@pytest.mark.parametrize("calls, written", [
    ([(None, 1), (None, 2), ("a", 3), ("a", 4)], [1, 1, 1, 1]),       # not in JupyterLab: no cells
    ([("a", 1), ("a", 2), ("a", 2), ("b", 3), ("a", 4)], [1, 2, 2, 2, 5])])
def test_a_second_call_for_a_problem_writes_nothing_unless_its_cell_is_run_again(
        said, both, tmp_path, monkeypatch, calls, written):
    """Calls of a cell and an execution, each with poses of its number."""
    shell, found = SimpleNamespace(), []
    monkeypatch.setattr(drives, "get_ipython", lambda: shell)
    for number, (cell, execution) in enumerate(calls, start=1):
        shell.parent_header = {"metadata": {"cellId": cell}, "header": {"msg_id": execution}}
        poses = np.full((100, 3), float(number)), np.zeros((100, 3, 3))
        result, = solved(both[:1], problem1={both[0]: poses}.get).values()
        assert result is poses
        found.append(read_structs(tmp_path / "good" / "problem1", "vehiclePose")[1][0, 0])
    assert found == written
    told = "**good**: the files of problem1 stay those of the first call of solved in this"
    assert [text[:len(told)] for text, _ in said] == [told] * (len(calls) - len(set(written)))


def test_options_that_vehicle_toml_does_not_state_are_told_in_the_overview(said, both):
    solved(both[:1], problem3=lambda drive: estimate(drive.dataset, kernel="Huber"))
    doubt, = (doubt for doubt in notices([book_of(said)])["good"] if doubt.what == "options")
    assert "problem3 are solved with kernel = Huber, unlike" in doubt.sentence


def test_drives_without_a_sensor_are_left_out(said, both):
    wheels = Drive("wheels", both[0].dataset.without("aruco"), None)
    assert [*solved([wheels, both[0]], problem2=SOLVERS["problem2"])] == both[:1]
    assert said == []


def test_where_every_drive_fails_a_simulated_one_replaces_them(said, both, tmp_path):
    found = solved(both[1:], problem2=SOLVERS["problem2"])
    assert [drive.made_up for drive in found] == [True]
    assert "runs on a simulated drive" in said[-1][0] and files(tmp_path) == []
    said.clear()
    lost = np.zeros((100, 3)), np.full((100, 3, 3), -1.0)              # by rounding
    good = solved(both[:1], problem1=lambda drive: lost if not drive.made_up else
                  solve.find("problem1", drive.dataset))
    assert [drive.made_up for drive in good] == [True]
    assert "matrices lose their digits" in said[0][0] and files(tmp_path) == []


def test_a_simulated_drive_that_fails_is_a_defect(said, both):
    def fail(_):
        raise DatasetError("never")

    with pytest.raises(DatasetError, match="never"):
        solved(both, problem2=fail)


def test_a_comparison_that_fails_is_said_and_no_failure_of_a_problem(said, both):
    assert [*attempted(both, SOLVERS["problem2"])] == both[:1]
    (text, metadata), = said
    assert text.startswith("**b&#42;d**: left out here: " + REASON) and metadata == {}


def test_doubts_are_said_where_they_are_found_and_told_to_the_first_page(said, both):
    doubts = [Doubt("units", "Lengths are in mm."), Doubt("antenna", "Antenna 7 is *far*.")]
    show_doubts(both[0], doubts)
    show_doubts(Drive("simulated", None, None, made_up=True), doubts)
    assert said[1][0] == "**good**: Antenna 7 is &#42;far&#42;."
    assert notices([book_of(said)]) == {"good": doubts}
    assert notices([new_notebook()]) == {}
