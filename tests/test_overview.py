"""The summary that opens the report: its numbers are those of the files, and it names every gap."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_document import text_of

from slamlib.core import evaluation, se2
from slamlib.io.results import write_structs
from slamlib.notebook import Drive, plotting
from slamlib.report import overview
from slamlib.report.document import render
from slamlib.report.execution import NotebookError
from slamlib.report.notebooks import Options
from slamlib.report.overview import title_picture
from slamlib.robust.file_doubts import Doubt
from slamlib.solve import Failure, Solution, solve_to_folder, summarize, title
from slamlib.studies.simulation import simulate

NAMES = ("all", "no_truth", "wheels_only")


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """Three drives, two of which lack something, with results; the solutions of the first drive."""
    folder = tmp_path_factory.mktemp("overview")
    dataset, truth = simulate("short", seed=5)
    dataset = dataset.first(1000)
    truth = replace(truth, poses=truth.poses[:1000])
    wheels = dataset.without("uwb").without("aruco")
    drives = []
    for name, each, known in zip(NAMES, (dataset, dataset, wheels), (truth, None, None)):
        drive = Drive(name, replace(each, name=name), known)
        solve_to_folder(drive.dataset, known, folder / name)
        drives.append(overview.solved_drive(drive, folder / name))
    return SimpleNamespace(drives=drives, solved=drives[0].solutions,
                           summary=overview.opening(drives))


def result_rows(summary):
    """The rows of the table of results, {(dataset, title): cells}, and the whole text."""
    text = "\n\n".join(cell.source for cell in summary.cells)
    table = text[text.index("| dataset | problem"):].split("\n\n")[0]
    rows, dataset = {}, None
    for line in table.split("\n")[2:]:
        first, *cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert first != dataset  # named once
        dataset = first or dataset
        rows[dataset, re.sub(r"^\d\. ", "", cells[0])] = cells[1:]
    return rows, text


def picture_of(summary):
    cell, = (cell for cell in summary.cells if cell.id == "picture")
    return cell.outputs[0].data["image/svg+xml"]


def metres(text):
    value, unit = text.split("\u00a0")
    return float(value) * {"m": 1, "mm": 1e-3, "rad": 1, "mrad": 1e-3}[unit]


def test_titles_and_numbers_of_the_table_are_those_of_the_solver(project):
    rows, _ = result_rows(project.summary)
    drive = project.drives[0]
    for solution in project.solved:
        assert title(solution.problem, drive.dataset) == solution.title
        expected = summarize(solution, drive.truth)
        *shown, poses = [cell.replace(",", "") for cell in rows["all", solution.title]]
        assert int(poses) == expected["estimated_poses"]
        C = solution.covariances[np.isfinite(solution.poses[:, 0])]
        wanted = (expected["ate_m"], expected["ate_aligned_m"],
                  np.median(evaluation.position_sigmas(C)), np.median(np.sqrt(C[:, 2, 2])))
        assert [1e-3 * float(cell) for cell in shown] == pytest.approx(wanted, rel=6e-3)


def test_the_abstract_of_a_simulated_drive_has_the_errors_of_odometry_and_slam(project):
    text = overview.opening(project.drives[:1]).cells[0].source
    odometry, slam = re.search(
        r"by SLAM is (\S+) and (\S+) on \*all", text.replace("\u00a0mm", "")).groups()
    for found, solution in ((odometry, project.solved[0]), (slam, project.solved[-1])):
        ate = summarize(solution, project.drives[0].truth)["ate_m"]
        assert 1e-3 * float(found) == pytest.approx(ate, rel=5e-3)
    assert f"{len(project.solved[-1].aruco_map[0])} markers and 4 antennas on *all*" in text
    assert "*all* is a simulated stand-in" in text


def test_what_is_left_out_is_told_with_its_reason(project):
    rows, text = result_rows(project.summary)
    assert rows["no_truth", "odometry"][:2] == ["–", "–"]
    assert "A dash stands where no truth is known." in text
    assert rows["wheels_only", "ArUco"][2] == "*left out: no markers*"
    assert rows["wheels_only", "SLAM: odometry + UWB"][2] == "*left out: no UWB ranges*"
    assert "There are no markers in wheels_only" in text


def test_nothing_is_said_of_doubts_failures_and_notes_where_there_are_none(project):
    assert not re.search("Doubts|not be solved|Notes on", result_rows(project.summary)[1])


def test_doubts_failures_and_notes_stand_on_the_first_page(project):
    drive = project.drives[1]
    failed = Failure("problem3", "SLAM: odometry + ArUco", "expected | more")
    dataset = replace(drive.dataset, notes=("X*.txt is not read.", "Y holds no rows."))
    opened = overview.opening([replace(
        drive, dataset=dataset, failures=(failed,), doubts=(Doubt("units", "Lengths are *mm*."),),
        solutions=drive.solutions[:4])])
    assert result_rows(opened)[0]["no_truth", failed.title] == ["*could not be solved*", "–", "–"]
    cells = {cell.id: cell.source for cell in opened.cells}
    assert cells["doubts"].splitlines()[2:] == [
        "no_truth:", "",
        "- The problem &#8220;SLAM: odometry + ArUco&#8221; could not be solved: "
        "expected &#124; more.",
        "- Lengths are &#42;mm&#42;."]
    assert cells["notes"].endswith(": X&#42;.txt is not read. Y holds no rows.")


def test_recorded_drives_are_the_subject_beside_longer_simulated_ones(project):
    simulated, recorded = project.drives[:2]
    short = replace(recorded, name="mine", dataset=recorded.dataset.first(999))
    assert overview.longest([short, simulated]) is short
    abstract = overview.opening([short, simulated]).cells[0].source
    assert "markers and 4 antennas on *mine*." in abstract


def test_the_world_is_the_first_pose_with_an_estimate():
    dataset, truth = simulate("short", seed=6)
    poses = np.full_like(truth.poses, np.nan)
    poses[40:] = se2.between(truth.poses[40], truth.poses[40:])
    solution = Solution("problem2", "ArUco", poses, np.zeros((len(poses), 3, 3)), 40)
    solved = overview.SolvedDrive("x", dataset, truth, solutions=(solution,))
    assert overview.result_row(solved, "problem2")["ATE (mm)"] == pytest.approx(0, abs=1e-6)


def test_the_pictures_are_the_same_every_time_and_show_roles_and_map(project):
    text = picture_of(project.summary)
    assert text == picture_of(overview.opening(project.drives))
    for role in ("slam_uwb", "fused", "hint"):
        assert plotting.ROLES[role]["color"].lower() in text
    picture = title_picture(project.drives[:1])
    assert picture == title_picture(project.drives[:1])
    last = project.solved[-1]
    assert picture.count("<use ") >= len(last.aruco_map[0]) + len(last.uwb_map[0])


def test_without_truth_the_abstract_has_no_errors(project):
    recorded = overview.opening(project.drives[1:])
    rows, text = result_rows(recorded)
    assert not re.search("simulated|ATE|(?<!_)truth", text.split("Figure 1.")[0])
    assert all(len(row) == 3 for row in rows.values())


@pytest.mark.slow
def test_at_returns_slam_is_compared_by_the_camera_that_it_estimated(tmp_path):
    """A camera 10 cm ahead, of which vehicle.toml says nothing, and the noise of sightings."""
    dataset, _ = simulate("short", seed=5)
    moved = replace(dataset.vehicle, camera_x=-0.1)
    dataset = replace(dataset, aruco=replace(dataset, vehicle=moved).sightings)
    solve_to_folder(dataset, None, tmp_path, ("problem1", "problem3"))
    drive = overview.solved_drive(Drive("x", dataset, None), tmp_path)
    abstract = overview.opening([drive]).cells[0].source
    found = re.search(r"these sightings, (\S+\s\w+) and (\S+\s\w+) on \*x\*, where the noise of "
                      r"the sightings alone gives (\S+\s\w+)\. ", abstract)
    odometry, slam, noise = map(metres, found.groups())
    assert slam < 1.5 * noise < odometry


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1, 2], ids=NAMES)
def test_the_opening_of_any_one_drive_fits_on_a_page(project, tmp_path, number):
    drives = project.drives[number:number + 1]
    files = render({Path("index"): overview.opening(drives)}, Options(title="T"),
                   title_picture(drives))
    text = text_of(files["report.pdf"], tmp_path)
    _, page = text.rstrip("\f\n").split("\f")                     # after the cover
    assert "Figure 1." in page and "The datasets" not in text
    assert ("ATE" in text) == ("stand-in" in text) == (number == 0)


@pytest.mark.parametrize("poses, reason", [
    (np.zeros((7, 3)), "must hold .* found [(]7, 3[)]"), (np.full((1000, 3), np.nan), "must hold")])
def test_a_result_that_is_no_solution_is_told(project, tmp_path, poses, reason):
    broken = tmp_path / "all" / "problem2"
    write_structs(broken, "vehiclePose", None, poses, np.zeros((len(poses), 3, 3)))
    with pytest.raises(NotebookError, match=f"all/problem2, which a notebook wrote, {reason}"):
        overview.read_solution(broken, project.drives[0].dataset)


def test_a_result_whose_file_is_missing_is_told(project, tmp_path):
    with pytest.raises(NotebookError, match="problem2, which a notebook wrote, cannot be read"):
        overview.read_solution(tmp_path / "problem2", project.drives[0].dataset)
