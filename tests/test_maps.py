"""The whole map of a drive, whose names can be read, and the tables of notebooks."""

from dataclasses import replace
from itertools import combinations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from numeric import short, vehicle
from test_plotting import elongated, require_contours

from slamlib import estimate, localize
from slamlib.core import odometry, se2
from slamlib.core.evaluation import REACH_95, ate
from slamlib.notebook import (
    Drive,
    accuracy,
    antenna_rows,
    calibration_rows,
    map_accuracy,
    maps,
    table,
)
from slamlib.notebook.tabular import cell
from slamlib.solve import problem_solution

pytestmark = pytest.mark.usefixtures("look")


@pytest.fixture(scope="module")
def solved():
    """A simulated Drive and its SlamResult with markers and antennas."""
    drive = Drive("short", *short(4))
    return drive, estimate(drive.dataset)


@pytest.fixture
def drive(solved):
    return solved[0]


def labels(legend):
    return {text.get_text() for text in legend.get_texts()}


def test_maps_show_path_markers_antennas_guess_state_the_enlargement_and_share_a_legend(solved):
    drive, result = solved
    maps.whole_maps({drive: result})
    *_, fig, legend = map(plt.figure, plt.get_fignums())
    assert labels(legend.axes[0].legend_) == {
        "vehicle", "markers", "antennas: guess", "antennas: estimate"}
    ax, = fig.axes
    assert ax.get_title("left") == "short"
    assert ax.get_title("right").startswith("95 % ellipses × ")
    low, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
    for points in (result.poses, result.marker_in_world, result.antenna_in_world):
        assert (low < points[:, :2]).all() and (points[:, :2] < high).all()


def test_a_map_can_be_asked_how_often_each_landmark_was_measured(solved):
    drive, result = solved
    ax, = maps.whole_map(drive, result).axes
    told = [int(line.get_gid().split()[-2]) for line in ax.lines if line.get_gid()]
    assert sum(told) == len(drive.dataset.uwb.range) + np.sum(~result.rejected)
    assert len(told) == len(result.antenna) + len(result.marker)


def test_ellipses_of_poses_markers_and_antennas_are_contours_of_their_own_covariances(solved):
    drive, result = solved
    result = replace(result, covariances=elongated(len(result.poses), 0.02, 0.005),
                     marker_covariance=elongated(len(result.marker), 0.03, 0.006),
                     antenna_covariance=elongated(len(result.antenna), 0.025, 0.005)[:, :2, :2])
    ax, = maps.whole_map(drive, result).axes
    k = REACH_95 * int(ax.get_title("right").split("× ")[1])
    of_poses, of_markers, of_antennas = (
        each for each in ax.collections if isinstance(each, PolyCollection))
    rows = [np.argmin(np.linalg.norm(result.poses[:, :2] - path.vertices[:-1].mean(axis=0), axis=1))
            for path in of_poses.get_paths()]
    require_contours(of_poses, result.poses[rows], result.covariances[rows], k)
    require_contours(of_markers, result.marker_in_world, result.marker_covariance, k)
    require_contours(of_antennas, result.antenna_in_world, result.antenna_covariance, k)


def test_what_a_drive_lacks_is_absent_from_map_and_tables(solved):
    drive, result = solved
    drive = replace(drive, dataset=drive.dataset.without("uwb"))
    nothing = {name: getattr(result, name)[:0] for name in vars(result)
               if name.startswith(("marker", "antenna"))}
    result = replace(result, **nothing)
    fig = maps.whole_map(drive, result)
    assert labels(fig.legends[0]) == {"vehicle"}
    assert [*antenna_rows(result, drive)] == []


@pytest.mark.parametrize("scale", [1, 0.4])
def test_names_cover_no_other_and_no_landmark_nor_what_is_around_axes_of_equal_scales(
        solved, scale):
    """Where markers are crowded, some have no name."""
    drive, result = solved
    places = result.marker_in_world * [scale, scale, 1]
    fig = maps.whole_map(drive, replace(result, marker_in_world=places))
    fig.draw_without_rendering()
    ax, = fig.axes
    assert (len(ax.texts) == len(places) + len(result.antenna)) == (scale == 1)
    signs = ax.transData.transform(places[:, :2])
    assert not any(text.get_window_extent().count_contains(signs) for text in ax.texts)
    boxes = [text.get_window_extent().padded(-0.18 * text.get_fontsize()) for text in ax.texts]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    assert all(ax.bbox.x0 <= box.x0 and box.x1 <= ax.bbox.x1 for box in boxes)
    across, up = ax.transData.transform([1, 1]) - ax.transData.transform([0, 0])
    assert across == pytest.approx(up, rel=1e-3)


def test_of_many_markers_only_those_in_doubt_have_names(solved, monkeypatch):
    drive, result = solved
    monkeypatch.setattr(maps, "MOST_NAMES", len(result.marker) - 1)
    ax, = maps.whole_map(drive, result).axes
    assert {text.get_text() for text in ax.texts} == {f"A{k}" for k in result.antenna}


def test_the_accuracy_of_a_map_is_that_of_its_places(solved):
    drive, result = solved
    at = 1e-3 * np.array([3.0, 4.0])
    places = drive.truth.marker_in_world[np.isin(drive.truth.marker, result.marker)].copy()
    places[:, :2] += at
    C = np.tile(1e-6 * np.diag([4.0, 16.0, 1.0]), (len(places), 1, 1))
    moved = replace(result, marker_in_world=places, marker_covariance=C)
    row = map_accuracy(moved, drive, "marker")
    assert row == pytest.approx({"markers": len(places), "their σ (mm)": 4.0, "error (mm)": 5.0,
                                 "their NEES": 9 / 4 + 16 / 16})
    without = map_accuracy(moved, replace(drive, truth=None), "marker")
    assert list(without) == ["markers", "their σ (mm)"]
    assert map_accuracy(replace(result, antenna=result.antenna[:0]), drive, "antenna") == {}


def test_rows_hold_every_antenna_and_its_errors(solved):
    drive, result = solved
    rows = [*antenna_rows(result, drive)]
    assert [row["antenna"] for row in rows] == [str(antenna) for antenna in result.antenna]
    for key, places in (("from the guess (mm)", drive.dataset.antenna_guess.position),
                        ("error (mm)", drive.truth.antenna_in_world)):
        off = result.antenna_in_world - places
        assert [row[key] for row in rows] == pytest.approx(1e3 * np.linalg.norm(off, axis=1))
    assert [row["d²"] for row in rows] == pytest.approx(
        se2.squared_norms(off, result.antenna_covariance))


def test_an_antenna_in_doubt_is_called_so_and_has_no_ellipse(solved):
    """Which may be as large as the map."""
    drive, result = solved
    first = int(result.antenna[0])
    doubted = replace(result, doubts={first: "It may be elsewhere."})
    ax, = maps.whole_map(drive, doubted).axes
    first_ellipse, other = ax.collections[-1].get_paths()[:2]
    assert np.ptp(first_ellipse.vertices, axis=0).max() == 0 < np.ptp(other.vertices)
    assert f"A{first}?" in {text.get_text() for text in ax.texts}
    assert next(antenna_rows(doubted, drive))["antenna"] == f"{first}?"


def test_a_marker_that_nothing_confirms_has_a_question_mark(solved):
    drive, result = solved
    of_marker = np.flatnonzero(result.sightings.marker == result.marker[0])
    rejected = result.rejected.copy()
    rejected[of_marker[1:]] = True
    ax, = maps.whole_map(drive, replace(result, rejected=rejected)).axes
    assert f"{result.marker[0]}?" in {text.get_text() for text in ax.texts}


# Tables.

THREE = np.array([1.0, 2.0, 6.0])      # mean 3, median 2, standard error 1.53


@pytest.mark.parametrize("value, text", [
    (12345.6, "12,346"), (12.345, "12.3"), (0.1234, "0.123"), (-12.34, "−12.3"), (0.0, "0.00"),
    (12345, "12,345"), (None, "–"), (np.nan, "–"),
    ("a-1", "a-1"), (THREE, "3.0 ± 1.5 (2.0)"), (1e3 * THREE, "3,000 ± 1,528 (2,000)"),
    (THREE[:1], "1.00 (1.00)")])
def test_a_cell_has_three_digits_or_those_that_its_standard_error_leaves(value, text):
    assert cell(value) == text


def test_what_is_missing_is_a_dash_and_a_column_of_it_is_absent():
    lines = table([{"name": "a", "x": 1, "none": None, "y": 2.0},
                   {"name": "a", "x": np.nan, "none": np.nan},
                   {"name": "b", "z": "−3 m"}]).data.split("\n")
    assert lines == ["| name | x | y | z |", "| --- | ---: | ---: | ---: |", "| a | 1 | 2.00 | – |",
                     "|  | – | – | – |", "| b | – | – | −3 m |"]
    assert table([]).data == "–"


def test_accuracy_is_that_of_every_kind_of_result_and_without_truth_sigmas_only(drive):
    """The same poses with their frames, or in all rows; markers alone in their first frame."""
    alone = localize(drive.dataset.aruco)
    row = accuracy(alone, drive)
    assert accuracy(problem_solution("problem2", drive.dataset, alone), drive) == row
    found = odometry.equation2(drive.dataset.ticks, drive.dataset.vehicle)
    assert accuracy(found, drive)["ATE (mm)"] == 1e3 * ate(found[0], drive.truth.poses)
    late = drive.dataset.aruco.select(drive.dataset.aruco.pose > 500)     # another world
    assert accuracy(localize(late), drive)["ATE (mm)"] < 200
    without_truth = accuracy(alone, replace(drive, truth=None))
    assert [*without_truth] == ["dataset", "σ (mm)", "σ of δ (mrad)"]


def test_calibration_rows_state_and_estimate(drive):
    stated = vehicle(sigma_range_scale=0.01)(drive.dataset)
    result = estimate(stated.without("uwb").first(400))
    rows = {row["entry"]: row for row in calibration_rows(result, drive)}
    assert not any("range" in entry for entry in rows)
    wheel = rows["`right_radius`"]
    assert wheel["stated"] == "0.1 ± 0.0001" and wheel["used"] == "both"
    value, sigma = map(float, wheel["estimated"].split(" ± "))
    assert abs(value - drive.truth.vehicle.right_radius) < 5 * sigma
    assert "`camera_x`" not in rows
