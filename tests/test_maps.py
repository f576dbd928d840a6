"""The whole map of a drive, whose names can be read, and the tables of notebooks."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from test_plotting import elongated, require_contours

from slamlib import estimate, fuse, localize
from slamlib.core import odometry
from slamlib.core.evaluation import REACH_95, ate
from slamlib.notebook import Drive, accuracy, antenna_rows, calibration_rows, maps, table
from slamlib.notebook.tabular import cell
from slamlib.solve import problem_solution
from slamlib.studies.simulation import simulate

pytestmark = pytest.mark.usefixtures("look")


@pytest.fixture(scope="module")
def solved():
    """A simulated Drive and its SlamResult with markers and antennas."""
    drive = Drive("short", *simulate("short", seed=4))
    return drive, estimate(drive.dataset)


@pytest.fixture
def drive(solved):
    return solved[0]


def labels(fig):
    return {text.get_text() for text in fig.legends[0].get_texts()}


def test_a_map_shows_path_markers_antennas_guess_truth_and_states_the_enlargement(solved):
    drive, result = solved
    fig = maps.whole_map(drive, result)
    assert fig.get_figwidth() == 7.4
    assert labels(fig) == {"vehicle", "its ellipses", "truth", "markers", "markers: truth",
                           "antennas: guess", "antennas: estimate", "antennas: truth"}
    title = fig.axes[0].get_title("left")
    assert title.startswith("short (95 % ellipses × ")
    x, y = fig.axes[0].get_xlim(), fig.axes[0].get_ylim()
    for points in (result.poses, result.marker_in_world, result.antenna_in_world):
        assert x[0] < points[:, 0].min() and points[:, 0].max() < x[1]
        assert y[0] < points[:, 1].min() and points[:, 1].max() < y[1]


def test_ellipses_of_poses_markers_and_antennas_are_contours_of_their_own_covariances(solved):
    """Of poses, markers and antennas in this order."""
    drive, result = solved
    result = replace(result, covariances=elongated(len(result.poses), 0.02, 0.005),
                     marker_covariance=elongated(len(result.marker), 0.03, 0.006),
                     antenna_covariance=elongated(len(result.antenna), 0.025, 0.005)[:, :2, :2])
    ax, = maps.whole_map(drive, result).axes
    k = REACH_95 * int(ax.get_title("left").split("× ")[1].rstrip(")"))
    of_poses, of_markers, of_antennas = ax.collections
    rows = [int(np.argmin(np.hypot(*(result.poses[:, :2] - place).T)))
            for place in of_poses.get_offsets()]
    for patches, means, covariances in (
            (of_poses, result.poses[rows], result.covariances[rows]),
            (of_markers, result.marker_in_world, result.marker_covariance),
            (of_antennas, result.antenna_in_world, result.antenna_covariance)):
        require_contours(patches, means, covariances, k)


@pytest.mark.parametrize("markers, antennas", [(True, False), (False, True), (False, False)])
def test_what_a_drive_lacks_is_absent_from_map_and_tables(solved, markers, antennas):
    drive, result = solved
    drive = replace(drive, truth=None)
    for kind in ["marker"] * (not markers) + ["antenna"] * (not antennas):
        result = replace(result, **{name: getattr(result, name)[:0] for name in (
            kind, f"{kind}_in_world", f"{kind}_covariance")})
    if not antennas:
        drive = replace(drive, dataset=drive.dataset.without("uwb"))
    fig = maps.whole_map(drive, result)
    assert labels(fig) == {"vehicle", "its ellipses", *["markers"] * markers,
                           *["antennas: guess", "antennas: estimate"] * antennas}
    fig.draw_without_rendering()
    rows = list(antenna_rows(result, drive))
    assert bool(rows) == antennas and all(np.isnan(row["error (mm)"]) for row in rows)


def test_names_cover_neither_each_other_nor_what_is_around_axes_of_equal_scales(solved):
    drive, result = solved
    fig = maps.whole_map(drive, result)
    fig.draw_without_rendering()
    ax, renderer = fig.axes[0], fig.canvas.get_renderer()
    assert sorted(text.get_text() for text in ax.texts) == sorted(
        map(str, [*result.marker, *result.antenna]))
    boxes = [text.get_window_extent(renderer).padded(-0.18 * text.get_fontsize())
             for text in ax.texts]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    assert all(ax.bbox.x0 <= box.x0 and box.x1 <= ax.bbox.x1 for box in boxes)
    (across, up), = np.diff(ax.transData.transform([[0, 0], [1, 1]]), axis=0)
    assert across == pytest.approx(up, rel=1e-3)
    assert ax.bbox.width > 0.75 * fig.bbox.width


def test_rows_hold_every_antenna_and_its_errors(solved):
    drive, result = solved
    rows = list(antenna_rows(result, drive))
    assert [row["antenna"] for row in rows] == [str(antenna) for antenna in result.antenna]
    for key, places in (("from the guess (mm)", drive.dataset.antenna_guess.position),
                        ("error (mm)", drive.truth.antenna_in_world)):
        off = result.antenna_in_world - places
        assert [row[key] for row in rows] == pytest.approx(1e3 * np.hypot(*off.T))
    squared = [each @ np.linalg.solve(C, each)
               for each, C in zip(off, result.antenna_covariance, strict=True)]
    assert [row["d²"] for row in rows] == pytest.approx(squared)


def test_an_antenna_in_doubt_is_called_so_and_drawn_in_its_true_size(solved):
    drive, result = solved
    first = int(result.antenna[0])
    covariances = result.antenna_covariance.copy()
    covariances[0] = np.diag([9.0, 4.0])
    doubted = replace(result, doubts={first: "It may be elsewhere."},
                      antenna_covariance=covariances)
    before, after = (maps.whole_map(drive, each).axes[0] for each in (result, doubted))
    assert ", in doubt" not in before.get_title("left")
    assert after.get_title("left").endswith(", in doubt (?) × 1)")
    widest = max(ellipses.get_widths().max() for ellipses in after.collections)
    assert widest == pytest.approx(2 * 2.4477 * 3, rel=1e-3)
    assert next(antenna_rows(doubted, drive))["antenna"] == f"{first}?"


def test_a_marker_that_nothing_confirms_has_a_question_mark(solved):
    drive, result = solved
    rejected = result.rejected.copy()
    rejected[np.flatnonzero(result.sightings.marker == result.marker[0])[1:]] = True
    names = [{text.get_text() for text in maps.whole_map(drive, each).axes[0].texts}
             for each in (replace(result, rejected=rejected), result)]
    assert names[0] - names[1] == {f"{result.marker[0]}?"}


# Tables.

THREE = np.array([1.0, 2.0, 6.0])      # mean 3, median 2, standard error 1.53


@pytest.mark.parametrize("value, text", [
    (12345.6, "12,346"), (123.45, "123"), (12.345, "12.3"), (1.234, "1.23"), (0.1234, "0.123"),
    (-12.34, "−12.3"), (0.0, "0"), (2e6, "> 10⁶"), (12345, "12,345"), (-5, "−5"), (True, "yes"),
    (np.False_, "no"), (None, "–"), (np.nan, "–"), ("a-1", "a-1"), (THREE, "3.0 ± 1.5 (2.0)"),
    (1e3 * THREE, "3,000 ± 1,528 (2,000)"), (THREE[:1], "1.00 (1.00)")])
def test_a_cell_has_three_digits_or_those_that_its_standard_error_leaves(value, text):
    assert cell(value) == text


def test_what_is_missing_is_a_dash_and_a_column_of_it_is_absent():
    lines = table([{"name": "a", "x": 1, "none": None, "y": 2.0},
                   {"name": "a", "x": np.nan, "none": np.nan}, {"name": "b", "z": "-3 m"}],
                  "Table 1.1. Text.").data.split("\n")
    assert lines == ["| name | x | y | z |", "| --- | ---: | ---: | ---: |", "| a | 1 | 2.00 | – |",
                     "|  | – | – | – |", "| b | – | – | −3 m |", "", "Table 1.1. Text."]
    assert table([]).data == "| – |\n| ---: |\n| – |"


def test_accuracy_is_that_of_every_kind_of_result_and_without_truth_sigmas_only(drive):
    """The same poses with their frames, or in all rows; markers alone in their first frame."""
    alone = localize(drive.dataset.aruco)
    row = accuracy(alone, drive)
    assert accuracy(problem_solution("problem2", drive.dataset, alone), drive) == row
    assert row["ATE (mm)"] > 0 and row["dataset"] == "short"
    found = odometry.equation2(drive.dataset.ticks, drive.dataset.vehicle)
    assert accuracy(found, drive)["ATE (mm)"] == 1e3 * ate(found[0], drive.truth.poses)
    late = drive.dataset.aruco.select(drive.dataset.aruco.pose > 500)     # another world
    assert accuracy(localize(late), drive)["ATE (mm)"] < 200
    row = accuracy(fuse(drive.dataset), replace(drive, truth=None))
    assert [*row] == ["dataset", "σ (mm)", "σ of δ (mrad)"] and row["σ (mm)"] > 0


def test_calibration_rows_state_and_estimate_and_know_the_wheels_of_simulated_drives(drive):
    result = estimate(drive.dataset.without("uwb").first(400))
    rows = {row["entry"]: row for row in calibration_rows(result, drive)}
    assert not any("range" in entry or "tag" in entry for entry in rows)
    wheel = rows["`right_radius`"]
    assert wheel["stated"] == "0.1 ± 0.0001" and wheel["used"] == "both"
    assert float(wheel["true"]) == pytest.approx(drive.truth.vehicle.right_radius, abs=1e-6)
    value, sigma = map(float, wheel["estimated"].split(" ± "))
    assert abs(value - float(wheel["true"])) < 5 * sigma
    assert rows["`camera_x`"]["estimated"] is None and rows["`camera_x`"]["used"] == "statement"
    recorded = [*calibration_rows(result, replace(drive, truth=None))]
    assert {row["true"] for row in recorded} == {None}
