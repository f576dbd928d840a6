"""The summary that opens the report: its numbers are those of the files, and gaps are told."""

import base64
import re
from pathlib import Path

import numpy as np
import pytest

from slamlib import evaluation, overview, plotting, se2
from slamlib.dataset import read_dataset, read_truth
from slamlib.execution import NotebookError
from slamlib.pages import html_page
from slamlib.results import write_vehicle_poses
from slamlib.simulation import simulate, write_dataset
from slamlib.solve import Solution, solve, summarize, write

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """Three drives, two of which lack something, with the results of problems 1 to 3."""
    folder = tmp_path_factory.mktemp("overview")
    dataset, truth = simulate("short", seed=5)
    write_dataset(folder / "data" / "all", dataset, truth)
    for name, lacking in (("no_truth", ["truth"]), ("wheels_only", [
            "truth", "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt"])):
        (folder / "data" / name).mkdir()
        for file in (folder / "data" / "all").iterdir():
            if file.name not in lacking and file.is_file():
                (folder / "data" / name / file.name).write_bytes(file.read_bytes())
    written = []
    for name in ("all", "no_truth", "wheels_only"):
        for solution in solve(read_dataset(folder / "data" / name)):
            write(folder / "results" / name, solution)
            written.append(f"{name}/{solution.problem}/vehiclePose.mat")
    return folder, written


def rows_of(folder, written, names=("all", "no_truth", "wheels_only")):
    """The rows of the table of results: {(dataset, title): cells}; and the whole text."""
    drives = overview.read_drives(folder / "data", folder / "results", names, written)
    text = "\n\n".join(cell.source for cell in overview.summary("Title", drives).cells)
    table = text[text.index("| dataset | problem"):].split("\n\n")[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.split("\n")[2:]]
    return {tuple(row[:2]): row[2:] for row in cells}, text, drives


def metres(text):
    value, unit = text.split("\u00a0")
    return float(value) * {"m": 1, "mm": 1e-3, "rad": 1, "mrad": 1e-3}[unit]


def test_titles_are_those_of_the_solutions():
    short = read_dataset(ROOT / "data" / "short")
    for dataset in (short, short.without("aruco")):
        for solution in solve(dataset):
            assert solution.problem in overview.TITLES and overview.ROLES.keys() <= overview.TITLES.keys()
            assert overview.title_of(solution.problem, dataset) == solution.title


def test_numbers_are_those_of_the_solver(project):
    folder, written = project
    rows, _, _ = rows_of(folder, written)
    data = folder / "data" / "all"
    for solution in solve(read_dataset(data)):
        expected = summarize(solution, read_truth(data))
        ate, aligned, position, heading, poses = rows["all", solution.title]
        assert int(poses.replace(",", "")) == expected["estimated_poses"]
        for shown, wanted in ((position, max(expected["last_sigma"][:2])), (ate, expected["ate_m"]),
                              (heading, expected["last_sigma"][2]),
                              (aligned, expected["ate_aligned_m"])):
            assert metres(shown) == pytest.approx(wanted, rel=5e-3)


def test_what_is_left_out_is_told_with_its_reason(project):
    folder, written = project
    rows, text, _ = rows_of(folder, written)
    assert rows["no_truth", "odometry"][:2] == ["no truth", "no truth"]
    assert "No truth comes with no_truth and wheels_only" in text
    assert rows["wheels_only", "ArUco"] == ["left out: no markers", *["–"] * 4]
    assert rows["wheels_only", "odometry"][-1] == "2,000"
    assert "There are no markers in wheels_only" in text
    assert "There are no UWB ranges in wheels_only" in text


def test_a_problem_that_is_not_known_appears_by_its_folder(project, tmp_path):
    folder, written = project
    poses = np.zeros((2000, 3))
    write_vehicle_poses(folder / "results" / "all" / "problem9", poses, np.zeros((2000, 3, 3)))
    rows, _, drives = rows_of(folder, [*written, "all/problem9/vehiclePose.mat"], ["all", "no_truth"])
    assert rows["all", "problem9"][2:] == ["0.00\u00a0mm", "0.00\u00a0mrad", "2,000"]
    assert rows["no_truth", "problem9"][0] == "no result"
    assert [s.problem for s in drives[0].solutions][-1] == "problem9"


def test_the_world_is_the_first_pose_with_an_estimate():
    drive = simulate("short", seed=6)
    truth = drive[1]
    poses = np.full_like(truth.poses, np.nan)
    poses[40:] = se2.between(truth.poses[40], truth.poses[40:])
    solution = Solution("problem2", "ArUco", poses, np.zeros((len(poses), 3, 3)), 40)
    row = overview._row(overview.Drive("x", *drive, (solution,)), "problem2", solution)
    assert metres(row[2]) == pytest.approx(0, abs=1e-9)
    assert evaluation.ate(poses, truth.poses) > 0.1  # in the wrong frame


def test_the_picture_is_the_same_every_time_and_needs_no_display(project):
    folder, written = project
    pictures, again = (next(cell for cell in overview.summary("T", rows_of(folder, written)[2]).cells
                            if cell.cell_type == "code").outputs[0].data for _ in range(2))
    assert pictures == again and set(pictures) == {plotting.WIDE, plotting.NARROW}
    for text in pictures.values():
        assert text.count("<path") > 10
        assert not re.search(r"<dc:date|/tmp/|http://(?!www.w3.org|purl.org|creativecommons)", text)


def test_the_page_has_the_picture_wide_and_for_phones_narrow(project):
    folder, written = project
    book = overview.summary("T", rows_of(folder, written)[2])
    page, _ = html_page(Path("index"), book, [])
    pictures = next(cell for cell in book.cells if cell.cell_type == "code").outputs[0].data
    wide, narrow = (base64.b64encode(pictures[kind].encode()).decode()
                    for kind in (plotting.WIDE, plotting.NARROW))
    picture = re.search("<picture>(.*)</picture>", page)[1]
    assert picture.count(f' src="data:image/svg+xml;base64,{wide}"') == 1
    assert picture.count(f' srcset="data:image/svg+xml;base64,{narrow}"') == 1
    assert picture.count('media="screen and (max-width: 40rem)"') == 1


@pytest.mark.parametrize("content, reason", [(b"", "cannot be read"), (None, "must hold")])
def test_poses_that_are_none_are_told_in_one_sentence(project, content, reason):
    folder, _ = project
    place = folder / "results" / "all" / "broken"
    write_vehicle_poses(place, np.zeros((7, 3)), np.zeros((7, 3, 3)))
    if content is not None:
        (place / "vehiclePose.mat").write_bytes(content)
    with pytest.raises(NotebookError, match=f"all/broken/vehiclePose.mat, .*{reason}"):
        rows_of(folder, ["all/broken/vehiclePose.mat"], ["all"])


def test_names_are_shown_as_they_are():
    assert overview.plain("a_b*c|<d> $e$") == "a_b&#42;c&#124;&#60;d&#62; &#36;e&#36;"
