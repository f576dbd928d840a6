"""Figures: what is in them, and that nothing exceeds them."""

from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from numpy.testing import assert_allclose

from slamlib.core.evaluation import REACH_95
from slamlib.core.se2 import rotate_covariance
from slamlib.notebook import Drive, plotting

pytestmark = pytest.mark.usefixtures("look")


LABELS = ("truth", "odometry and markers", "SLAM", "hint", "fused")


def drawn(count, rows, columns):
    for _, axes in plotting.each_drive("abc"[:count], rows, 4.0, columns=columns):
        for ax in np.atleast_1d(axes):
            for label in LABELS:
                plotting.curve(ax, np.arange(9.0), "slam", np.arange(9), label)
    return plt.gcf()


def boxes(fig):
    """The extents of axes with all that belongs to them, in inches, and that of the legend."""
    fig.draw_without_rendering()
    return [thing.get_tightbbox().transformed(fig.dpi_scale_trans.inverted())
            for thing in (*fig.axes, fig.legends[0])]


@pytest.mark.parametrize("count, rows, columns", [(1, 1, 2), (2, 3, 2), (3, 3, 3)])
def test_panels_are_side_by_side_under_their_titles_and_within_the_figure(count, rows, columns):
    fig = drawn(count, rows, columns)
    titles = [title for name in "abc"[:count] for title in [name] + (rows - 1) * [""]]
    assert [ax.get_title("left") for ax in fig.axes] == titles
    assert [text.get_text() for text in fig.legends[0].get_texts()] == list(LABELS)
    *wide, legend = boxes(fig)
    if count > 1:
        assert wide[rows].x0 > wide[0].x1
    for box in (*wide, legend):
        assert -0.01 <= box.x0 and box.x1 <= fig.get_figwidth() + 0.01
        assert -0.01 <= box.y0 and box.y1 <= fig.get_figheight() + 0.01
    assert legend.y1 < min(box.y0 for box in wide) + 0.01


def require_contours(patches, means, covariances, k):
    """(p - m)^T C^-1 (p - m) = k^2 on the boundaries of ellipses drawn at means (m, 2), of C."""
    for path, m, C in zip(patches.get_paths(), means, covariances, strict=True):
        offset = path.vertices - m[:2]
        squared = np.sum(offset * np.linalg.solve(C[:2, :2], offset.T).T, axis=1)
        assert_allclose(squared, k**2, rtol=0.01)


def elongated(count, major, minor):
    """Covariances (count, 3, 3) whose ellipses point into every quadrant; heading sigma 0.1 rad."""
    C = np.tile(np.diag([major**2, minor**2, 0.1**2]), (count, 1, 1))
    return rotate_covariance(C, 0.4 + 0.7 * np.arange(count))


@pytest.mark.parametrize("enlarged", [1, 4])
def test_ellipses_are_lines_of_equal_mahalanobis_distance(enlarged):
    """(p - m)^T C^-1 (p - m) = k^2 holds on the boundary, with k^2 = -2 ln(1 - 0.95)."""
    means = np.arange(12.0).reshape(4, 3)
    covariances = elongated(4, 2.0, 0.5)
    _, ax = plt.subplots()                                           # scales of x and y differ
    plotting.ellipses(ax, means, covariances, "#0072B2", enlarged=enlarged)
    require_contours(ax.collections[0], means, covariances * enlarged**2,
                     np.sqrt(-2 * np.log(0.05)))
    half = 2.44 * enlarged * np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)[:, :2])
    low, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
    assert (low < means[:, :2] - half).all() and (means[:, :2] + half < high).all()


def drive_with(truth=True):
    """Results as solvers give them, and their Drive: 50 poses on a circle, errors of 1 cm."""
    turn = np.linspace(0, 5, 50)
    poses = np.column_stack([np.cos(turn) - 1, np.sin(turn), turn])
    result = SimpleNamespace(
        poses=poses + [0.01, 0, 0.002], covariances=elongated(50, 0.02, 0.01))
    return result, Drive("a", None, SimpleNamespace(poses=poses) if truth else None)


@pytest.mark.parametrize("truth, rows", [(True, 2), (False, 2), (True, 1)])
def test_without_truth_the_bands_of_errors_stand_alone(truth, rows):
    """Those of the position only where there is one of axes."""
    result, drive = drive_with(truth)
    (_, axes), = plotting.each_drive([drive], rows=2)
    plotting.errors(axes[:rows], result, drive)
    assert axes[0].get_title("left") == drive.name
    for ax, error, reach in zip(axes[:rows], (0.01, 0.002), (0.02 * REACH_95, 0.2)):
        assert [line.get_ydata() for line in ax.lines] == ([pytest.approx(error)] if truth else [])
        assert ax.collections[0].get_paths()[0].vertices[:, 1].max() == pytest.approx(reach)


def test_a_needle_becomes_an_ellipse_on_axes_of_its_own():
    ax = plotting.own_axes(plt.figure().subplots(), np.diag([0.01, 1])**2, np.array([[0.02, 3]]))
    assert np.abs(ax.lines[0].get_xydata()) == pytest.approx(np.array([[3, 0.02]]))
    assert ax.collections[0].get_paths()[0].vertices.max(axis=0) == pytest.approx(
        [REACH_95, 0.01 * REACH_95])
