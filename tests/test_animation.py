"""The drive that moves on the first page."""

import re
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from slamlib import solve
from slamlib.evaluation import REACH_95
from slamlib.report.animation import _ellipses, animated, moving
from slamlib.report.chapters import printed
from slamlib.report.drives import SolvedDrive
from slamlib.report.overview import index, opening
from slamlib.report.pages import STYLE
from slamlib.se2 import rotation
from slamlib.simulation import simulate

MOST = 1_000_000               # bytes


@pytest.fixture(scope="module")
def drive():
    """A SolvedDrive on a simulated short path, with odometry and problem 4."""
    dataset, truth = simulate("short", seed=2)
    solutions = tuple(solve.solutions(dataset, problems=("problem1", "problem4")))
    return SolvedDrive("short", dataset, truth, solutions)


def test_the_animation_is_small_loads_nothing_and_moves_both_paths_in_time(drive):
    html = animated(drive)
    assert len(html.encode()) < MOST / 5
    assert not re.search(r"<script|\s(?:src|href)=|url\(|@import", html)
    svg = ElementTree.fromstring(re.search("<svg.*</svg>", html, re.DOTALL)[0])
    names = re.findall(r"animation:(\w+)", html)
    assert len(names) == len(set(names)) and len(names) > 20
    assert set(names) == set(re.findall(r"@keyframes (\w+)", html))
    assert len(list(svg.iter("circle"))) == 2 and len(list(svg.iter("ellipse"))) > 16
    for frames in re.findall(r"@keyframes \w+(?:line|dot)\{(.*?\})\}", html):
        times = [float(time) for time in re.findall(r"([\d.]+)%\{", frames)]
        assert times == sorted(times) and times[0] == 0 and times[-1] == 100


def test_ellipses_lie_on_the_page_as_in_the_world(drive):
    """Semi-axes of 4 : 1 whose major one points 30 degrees to the left: on the page y goes down."""
    R, a, b = rotation(np.radians(30)), 0.08, 0.02
    C = np.zeros((len(drive.dataset.ticks), 3, 3))
    C[:, :2, :2] = R @ np.diag([a**2, b**2]) @ R.T
    html = animated(replace(drive, solutions=tuple(
        replace(solution, covariances=C) for solution in drive.solutions)))
    drawn = re.findall(r'<ellipse rx="(.*?)" ry="(.*?)" transform="translate\(\S+ \S+\) '
                       r'rotate\((.*?)\)"', html)
    major, minor, angle = np.array(drawn, float).T
    assert len(drawn) > 16
    np.testing.assert_allclose(np.mod(angle, 180), 150, atol=0.5)
    np.testing.assert_allclose(major / minor, a / b, rtol=0.05)
    attributes, = _ellipses(np.zeros((1, 2)), C[:1], 100.0)
    assert attributes.startswith(f'rx="{100 * REACH_95 * a:.1f}" ry="{100 * REACH_95 * b:.1f}"')


def test_it_pauses_without_script_and_stands_still_where_no_motion_is_wanted(drive):
    html = animated(drive)
    box = re.search(r'<input class="pause" type="checkbox" id="(\w+)">', html)[1]
    assert f'for="{box}"' in html and "<script" not in html
    still = re.search(r"@media \(prefers-reduced-motion: reduce\) \{(.*?)\}\s*@media", STYLE,
                      re.DOTALL)[1]
    assert ".drive svg * { animation: none" in still


def test_what_cannot_move_has_no_animation(drive):
    still = tuple(SimpleNamespace(problem=problem, title="x", poses=np.zeros((3, 3)),
                                  covariances=np.zeros((3, 3, 3)))
                  for problem in ("problem1", "problem4"))
    for solutions in (drive.solutions[:1], still, ()):
        assert animated(replace(drive, solutions=solutions)) == ""
        assert moving(replace(drive, solutions=solutions)) == []


def test_the_first_page_moves_and_the_pdf_does_not(drive):
    book = opening([drive])
    assert "@keyframes" in str(index("Report", book, []).cells)
    assert "@keyframes" in str(book.cells) and "@keyframes" not in str(printed(book).cells)


def test_a_drive_without_truth_moves_too(drive):
    html = animated(replace(drive, truth=None))
    assert "truth" not in re.sub("<style>.*?</style>", "", html, flags=re.DOTALL)
