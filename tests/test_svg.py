"""SVG is made smaller: paths keep their shape, marks their place, and texts stay as they are."""

import re
import xml.etree.ElementTree as ElementTree

import matplotlib.pyplot as plt
import numpy as np
import pytest
from IPython.core.pylabtools import print_figure

from slamlib.report import svg


def points_of(data):
    """The points (n, 2) of a path of straight lines in absolute or relative steps."""
    at, points = np.zeros(2), []
    start = at
    for command, text in re.findall("([mlMLz])([^mlMLz]*)", data):
        steps = np.array(re.findall(r"-?(?:\d+\.?\d*|\.\d+)", text), float).reshape(-1, 2)
        for step in steps:
            at = at + step if command.islower() else step
            points.append(at)
            start = at if command in "mM" else start
        at = start if command == "z" else at
    return np.array(points)


def distances(points, line):
    """Distances (n,) of points (n, 2) from a line of points (m, 2)."""
    start, chord = line[:-1], np.diff(line, axis=0)
    share = np.clip(np.sum((points[:, None] - start) * chord, axis=-1)
                    / np.maximum(np.sum(chord**2, axis=-1), 1e-12), 0, 1)
    return np.linalg.norm(points[:, None] - start - share[..., None] * chord, axis=-1).min(axis=1)


@pytest.mark.parametrize("ending", ["", " z"])
def test_a_path_of_many_points_keeps_its_shape(ending):
    x = np.linspace(0, 400, 3000)
    line = np.column_stack([x, 100 + 80 * np.sin(x / 20) + 20 * (x > 200)])
    data = "M " + " \nL ".join(f"{x:.6f} {y:.6f}" for x, y in line) + ending
    small = svg.compressed(f'<svg><path d="{data}" style="fill: none"/></svg>')
    path, = re.findall(r' d="([^"]*)"', small)
    assert len(path) < len(data) / 20 and path.endswith("z") == bool(ending)
    assert distances(line, points_of(path)).max() < 0.2
    assert distances(points_of(path), line).max() < 0.02


def test_several_parts_follow_each_other():
    data = "M 1.234567 2 \nL 3 4 \nL 5 0.001 \nz \nM 10 20 \nL 9.5 20.25 \nM 0 0 \nL 0.5 -0.5"
    path, = re.findall(r' d="([^"]*)"', svg.compressed(f'<svg><path d="{data}"/></svg>'))
    np.testing.assert_allclose(points_of(path), [
        (1.23, 2), (3, 4), (5, 0), (10, 20), (9.5, 20.25), (0, 0), (0.5, -0.5)], atol=1e-9)
    assert path == "m1.23 2l1.77 2 2-4zm8.77 18l-.5 .25m-9.5-20.25l.5-.5"


def test_curves_are_rounded_only():
    small = svg.compressed('<svg><path d="M 0 1.23456 \nC 2 3.14159 4 5 6 7 \nz"/></svg>')
    assert ' d="M 0 1.23 C 2 3.14 4 5 6 7 z"' in small


@pytest.mark.parametrize("data", ["M 0 0 1 1.25 2 0", "M 0 0 H 5.25", "M 0 0 L 1 1 z L 2 0"])
def test_paths_that_are_written_otherwise_stay(data):
    """Such as by other programs: a bare pair continues a line, a line may begin at the start."""
    assert f' d="{data}"' in svg.compressed(f'<svg><path d="{data}"/></svg>')


def test_marks_in_a_row_share_their_style():
    use = '<use xlink:href="#m" x="{}.123456" y="2" style="stroke: #000"/>\n'
    small = svg.compressed("<svg>" + use.format(1) + use.format(2) + "</svg>")
    assert small == ('<svg><g style="stroke: #000"><use xlink:href="#m" x="1.12" y="2"/>'
                     '<use xlink:href="#m" x="2.12" y="2"/></g></svg>')
    other = use.format(1) + use.format(2).replace("#000", "#fff")
    assert "<g" not in svg.compressed(f"<svg>{other}</svg>")


def test_a_figure_stays_an_svg_with_the_typefaces_of_the_report(look):
    fig, ax = plt.subplots()
    t = np.linspace(0, 50, 5000)
    ax.plot(t, np.sin(t))
    ax.fill_between(t, np.sin(t) - 1, np.sin(t) + 1)
    ax.scatter(t[::50], np.cos(t[::50]))
    ax.set(xlabel="σ of 1.23456 m", ylabel=r"$\sigma_x$ (m)", title="A & B")
    whole = print_figure(fig, "svg", metadata={"Date": None})
    small = svg.compressed(whole)
    assert len(small) < len(whole) / 3
    texts = [text for text in ElementTree.fromstring(small).itertext() if text.strip()]
    assert {"σ of 1.23456 m", "A & B"} <= set(texts)
    assert "Libertinus Serif" in small and "font-family: 'STIXGeneral'" not in small
    assert svg.compressed(small) == small
