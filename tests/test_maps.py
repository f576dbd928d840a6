"""The whole map of a drive: its figure, names that can be read, and the tables of its landmarks."""

from dataclasses import replace
from itertools import combinations

import matplotlib.pyplot as plt
import numpy as np
import pytest
from test_plotting import elongated, require_contours

from slamlib import slam
from slamlib.evaluation import REACH_95
from slamlib.notebook import Drive, antenna_rows, maps
from slamlib.simulation import simulate

pytestmark = pytest.mark.usefixtures("look")


@pytest.fixture(scope="module")
def solved():
    """A simulated Drive and its SlamResult with markers and antennas."""
    drive = Drive("short", *simulate("short", seed=4))
    return drive, slam.estimate(drive.dataset)


def parts(result, markers=True, antennas=True):
    """A result without its markers or antennas."""
    k, a = len(result.marker) * markers, len(result.antenna) * antennas
    return replace(
        result, marker=result.marker[:k], marker_in_world=result.marker_in_world[:k],
        marker_covariance=result.marker_covariance[:k], antenna=result.antenna[:a],
        antenna_in_world=result.antenna_in_world[:a],
        antenna_covariance=result.antenna_covariance[:a])


def labels(fig):
    return {text.get_text() for text in fig.legends[0].get_texts()}


def test_a_map_shows_path_markers_antennas_guess_truth_and_states_the_enlargement(solved):
    drive, result = solved
    fig = maps.whole_map(drive, result)
    assert fig.get_figwidth() == 7.4
    assert labels(fig) == {"vehicle", "its ellipses", "truth", "ellipses of markers",
                           "markers, headings", "markers: truth",
                           "antennas: guess", "antennas: estimate", "antennas: truth"}
    title = fig.axes[0].get_title("left")
    assert title.startswith("short (95 % ellipses × ")
    widest = max(max(ellipses.get_widths().max(), ellipses.get_heights().max())
                 for ellipses in fig.axes[0].collections)
    factor = int(title.split("× ")[1].rstrip(")"))
    covariances = np.concatenate([result.marker_covariance[:, :2, :2], result.antenna_covariance])
    assert widest == pytest.approx(
        2 * factor * 2.4477 * np.sqrt(np.linalg.eigvalsh(covariances).max()), rel=1e-3)
    of_vehicle = fig.axes[0].collections[0]
    places = of_vehicle.get_offsets()
    assert len(places) == maps.ELLIPSE_COUNT and np.isin(places, result.poses[:, :2]).all()
    own = result.covariances[np.isin(result.poses[:, 0], places[:, 0]), :2, :2]
    assert of_vehicle.get_widths() == pytest.approx(
        2 * factor * 2.4477 * np.sqrt(np.linalg.eigvalsh(own)[:, 1]), rel=1e-3)
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
    assert not maps.in_doubt(result).any()
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


def test_a_name_with_dollar_signs_is_no_formula(solved):
    drive, result = solved
    fig = maps.whole_map(replace(drive, name=r"$\foo$ of $x$"), result)
    fig.draw_without_rendering()                  # an unknown command of TeX would be refused
    assert r"\$\foo\$ of \$x\$ (95" in fig.axes[0].get_title("left")
    plt.close(fig)


@pytest.mark.parametrize("markers, antennas", [(True, False), (False, True), (False, False)])
def test_what_a_drive_lacks_is_absent_from_map_and_tables(solved, markers, antennas):
    drive, result = solved
    drive, result = replace(drive, truth=None), parts(result, markers, antennas)
    if not antennas:
        drive = replace(drive, dataset=drive.dataset.without("uwb"))
    fig = maps.whole_map(drive, result)
    expected = {"vehicle", "its ellipses"}
    expected |= {"ellipses of markers", "markers, headings"} if markers else set()
    expected |= {"antennas: guess", "antennas: estimate"} if antennas else set()
    assert labels(fig) == expected
    fig.draw_without_rendering()
    rows = list(antenna_rows(result, drive))
    assert bool(rows) == antennas and all(np.isnan(row["error (mm)"]) for row in rows)


def test_a_dataset_without_guesses_has_no_rows(solved):
    drive, result = solved
    nothing = replace(drive, dataset=replace(drive.dataset, uwb=None, antenna_guess=None))
    assert list(antenna_rows(parts(result, antennas=False), nothing)) == []


def test_names_cover_neither_each_other_nor_what_is_around_the_axes(solved):
    drive, result = solved
    fig = maps.whole_map(drive, result)
    fig.draw_without_rendering()
    names, = (artist for artist in fig.axes[0].artists if isinstance(artist, maps.Names))
    renderer = fig.canvas.get_renderer()
    texts = names.placed(renderer)
    assert sorted(text.get_text() for text in texts) == sorted(
        map(str, [*result.marker, *result.antenna]))
    boxes = [text.get_window_extent(renderer).padded(-0.18 * text.get_fontsize())
             for text in texts]
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    frame = fig.axes[0].bbox
    assert all(frame.x0 <= box.x0 and box.x1 <= frame.x1 for box in boxes)


def test_the_map_fills_its_width_at_equal_scales(solved):
    drive, result = solved
    fig = maps.whole_map(drive, result)
    ax, = fig.axes
    fig.draw_without_rendering()
    (across, up), = np.diff(ax.transData.transform([[0, 0], [1, 1]]), axis=0)
    assert across == pytest.approx(up, rel=1e-3)
    assert ax.bbox.width > 0.75 * fig.bbox.width
    shown = ax.transData.transform(np.concatenate([
        result.marker_in_world[:, :2], result.antenna_in_world, result.poses[:, :2]]))
    assert all(ax.bbox.contains(*place) for place in shown)
    plt.close(fig)


def test_rows_hold_every_antenna_and_its_errors(solved):
    drive, result = solved
    rows = list(antenna_rows(result, drive))
    assert [row["antenna"] for row in rows] == [str(antenna) for antenna in result.antenna]
    for key, places in (("from the guess (mm)", drive.dataset.antenna_guess.position),
                        ("error (mm)", drive.truth.antenna_in_world)):
        assert [row[key] for row in rows] == pytest.approx(
            1e3 * np.hypot(*(result.antenna_in_world - places).T))


def test_a_marker_without_orientation_has_no_heading(solved):
    drive, result = solved
    covariances = result.marker_covariance.copy()
    covariances[0, 2, 2] = 1e8
    point = replace(result, marker_covariance=covariances)
    assert maps._ticks(result, 1.0).shape[1] == len(result.marker)
    assert maps._ticks(point, 1.0).shape[1] == len(result.marker) - 1


def test_an_antenna_in_doubt_is_called_so_and_drawn_in_its_true_size(solved):
    drive, result = solved
    first = int(result.antenna[0])
    covariances = result.antenna_covariance.copy()
    covariances[0] = np.diag([9.0, 4.0])
    doubted = replace(result, doubts={first: "It may be elsewhere."},
                      antenna_covariance=covariances)
    before, after = (maps.whole_map(drive, each).axes[0] for each in (result, doubted))
    assert after.get_title("left") == before.get_title("left").replace(
        ")", ", in doubt (?) × 1)")
    widest = max(ellipses.get_widths().max() for ellipses in after.collections)
    assert widest == pytest.approx(2 * 2.4477 * 3, rel=1e-3)
    assert next(antenna_rows(doubted, drive))["antenna"] == f"{first}?"


def test_a_marker_that_nothing_confirms_is_hollow(solved):
    drive, result = solved
    rejected = result.rejected.copy()
    rejected[np.flatnonzero(result.sightings.marker == result.marker[0])[1:]] = True
    ax, = maps.whole_map(drive, replace(result, rejected=rejected)).axes
    once, = (line for line in ax.lines if line.get_label() == "unconfirmed")
    np.testing.assert_array_equal(once.get_xydata(), result.marker_in_world[:1, :2])
    assert once.get_markerfacecolor() == "none"
    assert "unconfirmed" not in [line.get_label() for line in maps.whole_map(
        drive, result).axes[0].lines]
