"""The zip to hand in: the assignment's files and names, and a README.txt that is true of them."""

import re
from types import SimpleNamespace
from zipfile import ZipFile

import numpy as np
import pytest
from conftest import ROOT
from numeric import only, short
from test_document import text_of
from test_report import write

from slamlib.__main__ import main
from slamlib.core.errors import DatasetError
from slamlib.report import handin
from slamlib.report.notebooks import Options, read_books
from slamlib.solve import Solution, summarize
from slamlib.studies.simulation import write_dataset

SOLVE = """from slamlib.notebook import *
from slamlib.solve import PROBLEMS, find
for drive in start():
    for problem in PROBLEMS:
        with attempt(drive, problem):
            write_results(drive, problem, find(problem, drive.dataset))"""


@pytest.fixture(scope="module")
def handed(tmp_path_factory):
    """A hand-in of a recorded dataset, first seen markers at pose 11, beside a simulated one."""
    folder = tmp_path_factory.mktemp("hand in")
    dataset, _ = short(3, 40)
    write_dataset(folder / "data" / "mine", only(dataset, dataset.aruco.pose >= 10))
    write_dataset(folder / "data" / "stand_in", *short(4, 30))
    write(folder / "notebooks", "B_more", "# B. More\n\nOnly if asked for.")
    write(folder / "notebooks", "1_all", "# 1. All", (SOLVE,), "## 1.1 Middle\n\nRead this.")
    (folder / "report.toml").write_text('author = "Ada"\n')
    (folder / "report").mkdir()
    (folder / "report" / "index.html").write_text("the pages of the usual build")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["hand-in"]) == 0
    return folder, ZipFile(folder / "hand-in.zip")


@pytest.mark.slow
def test_the_names_are_the_assignment_s_and_the_files_are_the_results(handed):
    folder, archive = handed
    files = ["problem1/vehiclePose.mat", "problem2_hint/vehiclePose.mat",
             "problem2_fused/vehiclePose.mat", "problem4/UwbMap.mat",
             *(f"problem{n}/{name}.mat" for n in (2, 3, 4) for name in ("ArucoMap", "vehiclePose"))]
    assert archive.namelist() == sorted(
        ["README.txt", "report.pdf", *(f"mine/{name}" for name in files)])
    for name in files:
        assert archive.read(f"mine/{name}") == (folder / "results/mine" / name).read_bytes()


@pytest.mark.slow
def test_the_pdf_is_without_what_is_for_screens_and_the_usual_pages_stay(handed):
    folder, archive = handed
    text = re.sub(r"\s+", " ", text_of(archive.read("report.pdf"), folder))
    assert "1.1 Middle" in text and "Read this." in text and "Ada" in text
    assert not re.search("is handed in|asked for|stand_in", text)
    assert [file.name for file in (folder / "report").iterdir()] == ["index.html"]


@pytest.mark.slow
def test_the_readme_is_true_of_the_files(handed):
    text = handed[1].read("README.txt").decode()
    one_line = re.sub(r"\s+", " ", text)
    for part in ("Ada", "mine/problem2_fused: odometry + ArUco 40 of 40 poses have an estimate",
                 "mine/problem2_hint: odometry + ArUco, hint 40 of 40", "are far too small",
                 "mine/problem4: SLAM with UWB ranges 40 of 40", "fusion with the odometry",
                 "In mine/problem2 this is pose 11", "are NaN"):
        assert part in one_line
    assert max(map(len, text.split("\n"))) <= 100 and text.endswith("\n")


@pytest.mark.slow
def test_equal_input_gives_equal_bytes_and_the_date_is_fixed(handed, monkeypatch, capsys):
    folder, archive = handed
    before = (folder / "hand-in.zip").read_bytes()
    monkeypatch.chdir(folder)
    assert main(["hand-in"]) == 0
    assert (folder / "hand-in.zip").read_bytes() == before
    assert {entry.date_time for entry in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
    told = capsys.readouterr().err
    assert "1 of 1: 1_all, nothing changed" in told
    assert "left out, because simulated: stand_in" in told
    assert f"hand-in: {(folder / 'hand-in.zip').resolve()}\n" in told


def test_the_recorded_log_is_left_out_unless_report_toml_names_its_chapters():
    chosen = read_books(ROOT / "notebooks", handin.hand_in_options(Options()).chapters)
    left_out = {*(ROOT / "notebooks").glob("*.ipynb")} - {*chosen}
    assert [path.stem for path in left_out] == ["B_real_log"]
    assert handin.hand_in_options(Options(chapters=("1*", "B*"))).chapters == ("1*", "B*")


def summary_of(*problems, **others):
    """A summary of two poses, the first of which has no estimate by markers alone."""
    covariances = np.tile(np.eye(3), (2, 1, 1))
    rows = {}
    for problem in problems:
        poses = np.zeros((2, 3))
        poses[0] = np.nan if problem == "problem2" else 0
        rows[problem] = summarize(Solution(problem, poses, covariances), None)
    return {"dataset": "d", "poses": 2, "doubts": [], "notes": [], "problems": rows} | others


def test_the_readme_explains_nothing_that_is_not_there():
    text = handin.readme([summary_of("problem1")], Options())
    assert not re.search("Map|except in problem2|Doubts|Notes|problem2_fused is|problem2_hint does",
                         text)


def test_doubts_notes_and_failures_are_in_the_readme():
    summary = summary_of("problem1", notes=["A header was left out."],
                         doubts=[{"what": "units", "sentence": "Lengths are in mm."}])
    for problem, reason in (("problem3", "no landmark"), ("problem2_hint", "not told")):
        summary["problems"][problem] = {"title": problem, "failed": reason}
    text = " ".join(handin.readme([summary], Options(author="A", course="C")).split())
    for part in ("d: Lengths are in mm.", "d: A header was left out.",
                 "d/problem2 (ArUco) is not here: it needs markers, and its chapter in the report.",
                 "d/problem3 (problem3) could not be solved: no landmark.",
                 "d/problem2_hint (problem2_hint) could not be solved: not told.",
                 "/problem4 (SLAM with UWB ranges) is not here: it needs UWB ranges to antennas"):
        assert part in text
    assert text.startswith(f"{Options().title} A C ")


def test_results_of_a_run_that_was_killed_are_not_handed_in(tmp_path):
    pdf = tmp_path / "report.pdf"
    pdf.write_bytes(b"")
    report = SimpleNamespace(files=[pdf], summaries=[summary_of("problem1")])
    (tmp_path / "d" / "problem1").mkdir(parents=True)
    (tmp_path / "d" / "problem1" / "vehiclePose.mat").write_bytes(b"half")
    with pytest.raises(DatasetError, match="summary.json: .* solve the dataset again"):
        handin.write_zip(tmp_path / "hand-in.zip", report, tmp_path, Options())
