"""The summary that opens the report: its numbers are those of the files, and it names every gap."""

import re
from base64 import b64decode
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numeric import seen_from, short

from slamlib.core import evaluation, se2
from slamlib.notebook import Drive, plotting
from slamlib.report import overview
from slamlib.solve import PROBLEMS, Failure, Solution, solve_to_folder, summarize


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    """Three drives, two of which lack something, with results; the solutions of the first drive."""
    folder = tmp_path_factory.mktemp("overview")
    dataset, truth = short(5, 1000)
    dataset = replace(dataset, name="all")
    bare = replace(dataset.without("uwb").without("aruco"), name="wheels_only")
    given = [Drive("all", dataset, truth), Drive("no_truth", dataset, None),
             Drive("wheels_only", bare, None)]
    for drive in given:
        solve_to_folder(drive.dataset, drive.truth, folder / drive.name)
    drives = [overview.solved_drive(drive, folder / drive.name) for drive in given]
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
    found = re.search(r"\(data:image/svg\+xml;base64,(.*)\)", summary.cells[0].source)
    return b64decode(found[1]).decode()


def test_titles_and_numbers_of_the_table_are_those_of_the_solver(project):
    rows, _ = result_rows(project.summary)
    drive = project.drives[0]
    for solution in project.solved:
        known = np.isfinite(solution.poses[:, 0])
        C = solution.covariances[known]
        true = se2.between(drive.truth.poses[known][0], drive.truth.poses)
        ate, aligned, position, heading, poses = rows["all", PROBLEMS[solution.problem].title]
        assert int(poses.replace(",", "")) == known.sum()
        for shown, wanted in ((position, np.median(evaluation.position_sigmas(C))),
                              (heading, np.median(np.sqrt(C[:, 2, 2]))),
                              (ate, evaluation.ate(solution.poses, true)),
                              (aligned, evaluation.ate(solution.poses, true, aligned=True))):
            assert 1e-3 * float(shown.replace(",", "")) == pytest.approx(wanted, rel=6e-3)


def test_sensors_that_a_drive_lacks_are_named_and_their_problems_have_no_rows(project):
    rows, text = result_rows(project.summary)
    assert rows["no_truth", "odometry"][:2] == ["–", "–"]
    assert "A dash stands where no truth is known." in text
    assert [name for drive, name in rows if drive == "wheels_only"] == ["odometry"]
    assert "| --- | --- | ---: | ---: | ---: | ---: | ---: |" in text
    assert rows["wheels_only", "odometry"][-1] == "1,000"
    assert "There are no markers in wheels_only" in text
    assert "There are no UWB ranges to antennas with a guess in wheels_only" in text
    known = [drive for drive in project.drives if drive.truth is not None]
    assert "A dash stands" not in result_rows(overview.opening(known))[1]


def test_conclusions_are_about_the_problems_that_a_drive_allows(project):
    for drive, chapters in zip(project.drives, ("1234", "1234", "1")):
        text = result_rows(overview.opening([drive]))[1]
        conclusions = text.split("## Conclusions")[1].split("![")[0]
        assert re.findall(r"\(chapter (\d)\)", conclusions) == list(chapters)


def test_with_encoders_alone_nothing_else_is_spoken_of_and_no_doubt_or_note_where_none_is(project):
    _, text = result_rows(overview.opening([project.drives[2]]))
    assert not re.search("ArUco|UWB antennas|fusion|filter|its map|landmarks", text)
    assert not re.search("Doubts|not be solved|Notes on", text)
    assert "and from ranges" in result_rows(project.summary)[1]


def test_doubts_failures_and_notes_stand_on_the_first_page(project):
    drive = project.drives[1]
    failed = summarize(Failure("problem3", "expected | more"), None)
    summary = {"doubts": [{"what": "units", "sentence": "Lengths are *mm*."}],
               "notes": ["X*.txt is not read.", "Y holds no rows."],
               "problems": drive.summary["problems"] | {"problem3": failed}}
    opened = overview.opening([replace(drive, summary=summary)])
    rows, text = result_rows(opened)
    assert rows["no_truth", failed["title"]] == ["*could not be solved*", "–", "–"]
    doubts, notes = text[text.index("## Doubts"):].split("Notes on")
    assert doubts.split("\n") == [
        "## Doubts about the data", "", "no_truth:", "",
        "- The problem “SLAM: odometry + ArUco” could not be solved: expected &#124; more.",
        "- Lengths are &#42;mm&#42;.", "", ""]
    assert ": X&#42;.txt is not read. Y holds no rows." in notes


def test_recorded_drives_are_the_subject_beside_longer_simulated_ones(project):
    simulated, recorded = project.drives[:2]
    mine = replace(recorded, name="mine", dataset=recorded.dataset.first(999))
    assert "Figure 1. *mine*. Left" in overview.opening(
        [mine, simulated]).cells[0].source


def test_errors_are_those_in_the_frame_of_the_first_pose_with_an_estimate():
    truth = short(6)[1]
    poses = np.full_like(truth.poses, np.nan)
    poses[40:] = se2.between(truth.poses[40], truth.poses[40:])
    covariances = np.tile(np.eye(3), (len(poses), 1, 1))
    row = summarize(Solution("problem2", poses, covariances), truth)
    assert row["ate_m"] == pytest.approx(0, abs=1e-9)


def test_the_pictures_are_the_same_every_time_and_need_no_display(project):
    text = picture_of(overview.opening(project.drives[:2]))
    assert text == picture_of(overview.opening(project.drives[:2]))
    assert not re.search(r"<dc:date|/tmp/|http://(?!www.w3.org|purl.org|creativecommons)", text)
    for role in ("slam_uwb", "fused", "hint"):
        assert plotting.ROLES[role]["color"].lower() in text
    last = project.solved[-1]
    assert text.count("<use ") >= sum(len(ids) for ids, _, _ in last.maps.values())


def test_without_truth_there_are_no_errors(project):
    rows, text = result_rows(overview.opening(project.drives[1:]))
    results, conclusions = text.split("![")[0].split("## Conclusions")
    assert not re.search("[Ss]imulated|ATE|known|(?<!_)truth", results)
    assert not re.search("ATE|known|(?<!_)truth", conclusions)
    assert all(len(row) == 3 for row in rows.values())


@pytest.mark.slow
def test_at_returns_slam_is_compared_by_the_camera_that_it_estimated(tmp_path):
    """A camera 10 cm ahead, of which vehicle.toml says nothing, and the noise of sightings."""
    dataset, truth = short(5)
    dataset = seen_from(dataset, (0.1, 0.0, 0.0))
    solve_to_folder(dataset, None, tmp_path, ("problem1", "problem2", "problem3"))
    drive = overview.solved_drive(Drive("x", dataset, None), tmp_path)
    rows, text = result_rows(overview.opening([drive]))
    odometry, slam, noise = (float(rows["x", name][0]) for name in (
        "odometry", "SLAM: odometry + ArUco", "noise of the sightings alone"))
    assert slam < 1.5 * noise < odometry
    assert "*At returns* is" in text
