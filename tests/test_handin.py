"""The zip to hand in: the assignment's files and names, and a README.txt that is true of them."""

import re
from dataclasses import replace
from types import SimpleNamespace
from zipfile import ZipFile

import numpy as np
import pytest
from test_document import text_of
from test_report import write

from slamlib.__main__ import main
from slamlib.core.errors import DatasetError
from slamlib.io.files import write_file
from slamlib.report import handin
from slamlib.report.notebooks import Options
from slamlib.report.overview import SolvedDrive
from slamlib.robust.file_doubts import Doubt
from slamlib.solve import Failure, Solution
from slamlib.studies.simulation import simulate, write_dataset

SOLVE = """from slamlib.notebook import *
from slamlib.solve import PROBLEMS, find
for drive in start():
    for problem in PROBLEMS:
        with attempt(drive, problem):
            write_results(drive, problem, find(problem, drive.dataset))"""


def drive_of(name="mine", first=40):
    """The first poses of a simulated drive, whose first sighting is at a later pose, no truth."""
    dataset = simulate("short", seed=3)[0].first(first)
    later = dataset.aruco.select(dataset.aruco.pose >= 10)
    return replace(dataset, name=name, aruco=later)


@pytest.fixture(scope="module")
def handed(tmp_path_factory):
    """A hand-in of a recorded dataset beside a simulated one, and what the run said."""
    folder = tmp_path_factory.mktemp("hand in")
    simulated, truth = simulate("short", seed=4)
    write_dataset(folder / "data" / "mine", drive_of())
    write_dataset(folder / "data" / "stand_in", simulated.first(30),
                  replace(truth, poses=truth.poses[:30]))
    write(folder / "notebooks", "A_more", "# A. More\n\nOnly if asked for.")
    write(folder / "notebooks", "1_all", "# 1. All", (SOLVE,), "## 1.1 Middle\n\nRead this.")
    (folder / "report.toml").write_text('author = "Ada"\nproblem2 = "fused"\n')
    (folder / "report").mkdir()
    (folder / "report" / "index.html").write_text("the pages of the usual build")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["hand-in", "--jobs", "1"]) == 0
    return folder, ZipFile(folder / "hand-in.zip")


@pytest.mark.slow
def test_the_names_are_the_assignment_s_and_the_files_are_the_results(handed):
    folder, archive = handed
    files = ["problem1/vehiclePose.mat", "problem2/ArucoMap.mat", "problem2/vehiclePose.mat",
             "problem3/ArucoMap.mat", "problem3/vehiclePose.mat", "problem4/ArucoMap.mat",
             "problem4/UwbMap.mat", "problem4/vehiclePose.mat"]
    assert archive.namelist() == [
        "README.txt", *(f"mine/{name}" for name in files), "report.pdf"]
    for name in files:
        result = name.replace("problem2/vehicle", "problem2_fused/vehicle")
        assert archive.read(f"mine/{name}") == (folder / "results/mine" / result).read_bytes()


@pytest.mark.slow
def test_the_pdf_is_without_what_is_for_screens_and_the_usual_pages_stay(handed):
    folder, archive = handed
    text = re.sub(r"\s+", " ", text_of(archive.read("report.pdf"), folder))
    assert "1.1 Middle" in text and "Read this." in text and "Ada" in text
    assert not re.search("is handed in|asked for|stand_in", text)
    assert [file.name for file in (folder / "report").iterdir()] == ["index.html"]


@pytest.mark.slow
def test_the_readme_is_true_of_the_files(handed):
    text = " ".join(handed[1].read("README.txt").decode().split())
    for part in ("Ada", "mine/problem2: vehiclePose.mat and ArucoMap.mat odometry + ArUco; 40 of "
                 "40 poses have an estimate", "mine/problem4: vehiclePose.mat, ArucoMap.mat and "
                 "UwbMap.mat SLAM: odometry + ArUco + UWB; 40 of 40", "fused with odometry",
                 "problem2/ArucoMap.mat is the map by the ArUco measurements alone, because "
                 "the fusion has no map of its own. Its world frame is the frame of pose 11.",
                 "Simulated and left out: stand_in.", "gtsam 4.3", "are NaN",
                 "problem2_fused of the report is problem2 here"):
        assert part in text


@pytest.mark.slow
def test_equal_input_gives_equal_bytes_and_the_date_is_fixed(handed, monkeypatch, capsys):
    folder, archive = handed
    monkeypatch.chdir(folder)
    assert main(["hand-in", "--out", "new/second.zip"]) == 0
    second = folder / "new" / "second.zip"
    assert second.read_bytes() == (folder / "hand-in.zip").read_bytes()
    assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    told = capsys.readouterr().err
    assert "left out, because simulated: stand_in" in told
    assert f"hand-in: {second.resolve()}\n" in told


def test_appendices_are_left_out_unless_report_toml_names_its_chapters():
    assert handin.hand_in_options(Options()).chapters == ("[0-9]*",)
    assert handin.hand_in_options(Options(chapters=("1*", "B*"))).chapters == ("1*", "B*")


def solved_drive(*problems, **others):
    """A SolvedDrive of two poses, the first of which has no estimate by markers alone."""
    dataset = drive_of("d", 2)
    poses = np.zeros((2, 3))
    solutions = [Solution(problem, problem, poses, np.zeros((2, 3, 3)),
                          world=int(problem == "problem2")) for problem in problems]
    return SolvedDrive("d", dataset, None, solutions=tuple(solutions), **others)


@pytest.mark.parametrize("problem2, folder, aruco_map", [
    ("aruco", "problem2", "problem2"), ("fused", "problem2_fused", "problem2"),
    ("hint", "problem2_hint", "problem2_hint")])
def test_the_map_of_problem_2_is_that_of_its_estimate_if_it_has_one(problem2, folder, aruco_map):
    files = ("notes.mat", "problem1/other.mat", "problem2/ArucoMap.mat", "problem2/vehiclePose.mat",
             "problem2_fused/vehiclePose.mat", "problem2_hint/ArucoMap.mat",
             "problem2_hint/vehiclePose.mat")
    drive = solved_drive("problem2", "problem2_fused", "problem2_hint", files=files)
    assert handin.handed_in(drive, problem2) == {
        "problem2/vehiclePose.mat": f"{folder}/vehiclePose.mat",
        "problem2/ArucoMap.mat": f"{aruco_map}/ArucoMap.mat"}
    text = handin.readme([drive], Options(problem2=problem2))
    assert ("no map of its own" in text) == (problem2 == "fused")
    assert ("In d/problem2 it is the frame of the vehicle at pose 2" in text) == (
        problem2 == "aruco")


def test_without_poses_of_the_chosen_estimate_the_map_alone_is_not_handed_in():
    drive = solved_drive("problem2", files=("problem2/ArucoMap.mat", "problem2/vehiclePose.mat"))
    assert handin.handed_in(drive, "fused") == {}


def test_doubts_failures_and_notes_are_in_the_readme():
    drive = solved_drive(
        "problem1", files=("problem1/vehiclePose.mat",),
        doubts=(Doubt("units", "Lengths may be in millimetres."),),
        failures=(Failure("problem3", "SLAM", "no landmark"),
                  Failure("problem2_hint", "hint", "not told")))
    drive = replace(drive, dataset=replace(drive.dataset.without("uwb"), notes=("A header.",)))
    text = " ".join(handin.readme([drive], Options(), ["x", "y"]).split())
    for part in ("d: Lengths may be in millimetres.", "d: A header.",
                 "d/problem2 (ArUco): no result.",
                 "d/problem3 (SLAM: odometry + ArUco): could not be solved: no landmark.",
                 "/problem4 (SLAM: odometry + ArUco + UWB): left out: no UWB ranges.",
                 "Simulated and left out: x and y."):
        assert part in text
    assert "not told" not in text


def test_without_doubts_and_notes_their_headings_are_absent():
    text = handin.readme([solved_drive("problem1")], Options())
    assert "Doubts" not in text and "Notes" not in text


def test_results_of_a_run_that_was_killed_are_not_handed_in(tmp_path):
    drive = solved_drive("problem1", files=("problem1/vehiclePose.mat",))
    report = SimpleNamespace(files=[tmp_path / "report.pdf"], drives=[drive], omitted=[])
    for name in ("report.pdf", "d/problem1/vehiclePose.mat"):
        write_file(tmp_path / name, b"half")
    with pytest.raises(DatasetError, match="summary.json: .* solve the dataset again"):
        handin.write_zip(tmp_path / "hand-in.zip", report, tmp_path, Options())
