"""What moves in the pages, looked at in a browser without a network."""

import html
import json
import re
from functools import partial

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from slamlib.notebook import Drive, explore, inline, plotting
from slamlib.notebook.live import live_figure
from slamlib.report import build_report
from slamlib.report.sanitize import sanitized
from slamlib.simulation import simulate, write_dataset

MOST = 300_000                 # bytes of a figure that can be moved
CODE = """from functools import partial
from slamlib.notebook import captioned, write_results, explore, maps, solved, start
drives, found = solved(start(), ["problem1", "problem4"])
list(write_results(drives, found))
captioned(maps.whole_map(drives[0], found["problem4"][drives[0].name]), "Figure 1.1. Map.")"""
EXPLORE = """explore.show_with_controls(
    partial(explore.draw_wheels, drives[0]), grid={"base": [-40.0, 0.0, 40.0], "right": [0.0, 2.0]},
    right=explore.slider("error of R_R (σ)", 2.0, -4.0, 4.0, 0.25),
    left=explore.slider("error of R_L (σ)", 0.0, -4.0, 4.0, 0.25),
    base=explore.slider("error of b (σ)", 0.0, -40.0, 40.0, 1.0),
    sigma_radii=explore.slider("σ of R_R, R_L times", 1.0, 0.1, 5.0, 0.1),
    sigma_base=explore.slider("σ of b times", 1.0, 0.1, 5.0, 0.1),
    probability=explore.slider("probability (%)", 95, 10, 99),
    count=explore.slider("number of ellipses", 14, 1, 40))"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The folder of a report of one small chapter with a map and a figure that can be moved."""
    folder = tmp_path_factory.mktemp("live")
    write_dataset(folder / "data" / "short", *simulate("short", seed=6))
    (folder / "notebooks").mkdir()
    book = new_notebook(cells=[
        new_markdown_cell("# 1. Chapter\n\nIt moves."), new_code_cell(CODE),
        new_markdown_cell("## Explore"),
        new_code_cell(EXPLORE, metadata={"tags": ["hide-input", "html-only"]})])
    nbformat.write(book, folder / "notebooks" / "1_chapter.ipynb")
    build_report(folder / "notebooks", folder / "data", folder / "report", folder / "results",
                 kept=folder / "kept")
    return folder / "report"


@pytest.fixture
def offline(report, chromium):
    """A function that opens a page of the report without a network; it asks for nothing else.

    Nothing that the page holds is against its policy, which the console would tell.
    """
    asked, said = [], []

    def opened(name, **options):
        page = chromium.new_context(offline=True, **options).new_page()
        page.on("request", lambda request: asked.append(request.url))
        page.on("console", lambda message: said.append(message.text))
        page.on("pageerror", lambda error: pytest.fail(str(error)))
        page.goto((report / name).as_uri())
        return page

    yield opened
    assert not [url for url in asked if not url.startswith(("file:", "data:"))] and not said


@pytest.mark.slow
def test_a_moved_slider_changes_the_picture_without_a_network(offline):
    page = offline("1_chapter.html")
    figure = page.locator("figure.live")
    sliders, panels = figure.get_by_role("slider"), figure.locator("svg.panel")
    assert sliders.count() == 2 and panels.count() == 2
    before, said = figure.screenshot(), figure.locator(".says").inner_text()
    drawn = panels.first.inner_html()
    sliders.first.press("ArrowRight")                       # the wheelbase 40 sigmas too long
    assert "heelbase 1\u00a0% too long" in figure.locator(".says").inner_text()
    assert sliders.first.get_attribute("aria-valuetext") == "40"
    assert figure.screenshot() != before and panels.first.inner_html() != drawn
    sliders.first.press("ArrowLeft")
    assert panels.first.inner_html() == drawn and figure.locator(".says").inner_text() == said


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"color_scheme": "dark"},
                                     {"viewport": {"width": 390, "height": 800}}], ids=str)
def test_reset_is_reached_by_keys_and_brings_the_first_figure_back(offline, options):
    page = offline("1_chapter.html", **options)
    figure = page.locator("figure.live")
    sliders, reset = figure.get_by_role("slider"), figure.get_by_role("button", name="Reset")
    seen = [panel.inner_html() for panel in figure.locator("svg.panel").all()]
    said, value = figure.locator(".says").inner_text(), figure.locator("output").first.inner_text()
    for slider in sliders.all():
        slider.press("ArrowLeft")
    assert figure.locator(".says").inner_text() != said
    assert figure.locator("output").first.inner_text() != value
    page.keyboard.press("Tab")
    assert reset.evaluate("button => button === document.activeElement")
    page.keyboard.press("Enter")
    page.wait_for_function("said => document.querySelector('.says').textContent === said",
                           arg=said)
    assert [panel.inner_html() for panel in figure.locator("svg.panel").all()] == seen
    assert figure.locator("output").first.inner_text() == value
    box = reset.bounding_box()
    assert box["x"] >= 0 and box["x"] + box["width"] <= page.viewport_size["width"]


@pytest.mark.slow
def test_without_script_the_still_picture_stands_and_no_control_does_nothing(offline):
    page = offline("1_chapter.html", java_script_enabled=False)
    panel = page.locator("figure.live svg.panel").first
    assert panel.is_visible() and panel.locator("path").count() > 10
    assert not page.locator("figure.live form").is_visible()


@pytest.mark.slow
def test_on_a_phone_panels_stand_below_each_other_and_the_map_is_the_narrow_one(offline):
    page = offline("1_chapter.html", viewport={"width": 390, "height": 800})
    upper, lower = (panel.bounding_box() for panel in page.locator("figure.live svg.panel").all())
    assert lower["y"] >= upper["y"] + upper["height"] - 1
    assert upper["width"] > 300 and upper["x"] + upper["width"] <= 390
    assert page.locator(".inline svg.narrow").is_visible()
    assert not page.locator(".inline svg.wide").is_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.slow
def test_points_of_the_map_tell_id_position_and_sigma(offline):
    page = offline("1_chapter.html", viewport={"width": 1300, "height": 1000})
    points = page.locator(".inline svg.wide circle")
    told = [re.fullmatch(r"(marker|antenna) \d+: x \S+ m, y \S+ m.*σ .* mm.*", text)
            for text in points.locator("title").all_text_contents()]
    assert len(told) > 10 and all(told)
    assert {found[1] for found in told} == {"marker", "antenna"}
    first = points.first.bounding_box()
    hit = page.evaluate("([x, y]) => document.elementFromPoint(x, y).tagName", [
        first["x"] + first["width"] / 2, first["y"] + first["height"] / 2])
    assert first["y"] > 1000 or hit == "circle"


@pytest.mark.slow
@pytest.mark.parametrize("motion, moves", [("no-preference", True), ("reduce", False)])
def test_the_drive_on_the_first_page_moves_or_stands_still(offline, report, motion, moves):
    page = offline("index.html", reduced_motion=motion)
    figure = page.locator("figure.drive")
    assert len(figure.inner_html().encode()) < 1_000_000
    running = "() => document.getAnimations().filter(a => a.playState === 'running').length"
    where = "document.querySelector('.drive circle').getBoundingClientRect().x"
    assert (page.evaluate(running) > 10) == moves
    first = page.evaluate(where)
    page.wait_for_timeout(1000)
    assert (page.evaluate(where) != first) == moves
    assert figure.locator("label").is_visible() == moves
    if moves:
        figure.get_by_label("Pause").check()
        assert page.evaluate(running) == 0
        figure.get_by_label("Pause").uncheck()
        assert page.evaluate(running) > 10


def draw(height, name="one"):
    fig, ((ax,),) = plotting.panels(1)
    plotting.curve(ax, np.array([0.0, height, 0.0]), "slam", label="height")
    plotting.curve(ax, np.array([0.0, 1.0, 2.0]), "truth")
    ax.set_title(f"height {height}, {name}")
    plotting.legend_below(fig)
    fig.said = f"The height is {height} < {name}."
    return fig


@pytest.mark.usefixtures("look")
def test_a_grid_of_figures_shares_what_they_have_in_common(capsys):
    controls = {"height": explore.slider("height", 2, 0, 9),
                "name": explore.choice("name", ["one", "two"], "two")}
    fig = live_figure(draw, controls, {"height": [1, 2, 3], "name": ["one", "two"]})
    assert plt.get_fignums() == [fig.number] and fig.axes[0].get_title("left") == "height 2, two"
    states, said = json.loads(html.unescape(re.search('data-live="(.*?)"', fig.moving)[1])).values()
    assert said == [f"The height is {h} < {name}." for h in (1, 2, 3) for name in ("one", "two")]
    panels = [set(state[0]) for state in states]
    shared = set.intersection(*panels)
    assert len(shared) > 4 and all(len(panel - shared) == 2 for panel in panels)    # curve, title
    shown = sanitized(fig.moving, "1.ipynb")
    assert "&lt; two" in fig.moving and "&lt; two" in shown and capsys.readouterr().err == ""
    ids = re.findall(r' id="([^"]*)"', fig.moving)
    used = {name for pair in re.findall(r'href="#([^"]*)"|url\(#([^)]*)\)', fig.moving)
            for name in pair if name}
    assert len(ids) == len(set(ids)) and used <= set(ids)
    assert set(inline.outputs(fig, plotting.svg_pictures(fig))) == {
        plotting.WIDE, plotting.NARROW, "text/html"}


@pytest.mark.usefixtures("look")
def test_a_plan_keeps_equal_axes_for_all_values():
    def plan(size):
        fig, ((ax,),) = plotting.panels(1)
        plotting.trajectory(ax, np.array([[0.0, 0], [size, 3 * size]]), "truth")
        plotting.legend_below(fig)
        figures.append(fig)
        return fig

    figures = []
    live_figure(plan, {"size": explore.slider("size", 1, 1, 9)}, {"size": [1, 4]})
    for fig in figures[:2]:
        ax, = fig.axes
        metres = np.array([np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())])
        np.testing.assert_allclose(*metres / [ax.bbox.width, ax.bbox.height], rtol=1e-6)
        assert ax.get_ylim()[1] >= 12


@pytest.mark.slow
@pytest.mark.usefixtures("look")
def test_the_figure_of_a_chapter_is_small():
    drive = Drive("short", *simulate("short", seed=3))
    values = dict(right=2.0, left=0.0, base=0.0, sigma_radii=1.0, sigma_base=1.0, probability=95,
                  count=14)
    controls = {name: explore.slider(name, value, -99, 99) for name, value in values.items()}
    fig = live_figure(partial(explore.draw_wheels, drive), controls, {
        "base": [-40.0, -20.0, 0.0, 20.0, 40.0], "right": [-2.0, 0.0, 2.0]})
    assert len(fig.moving.encode()) < MOST
