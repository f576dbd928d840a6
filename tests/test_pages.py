"""The report on all notebooks, the stand-ins and what a user may bring; then in a real browser.

One file, so that pytest-xdist builds the report in one process only.
"""

import html
import re
from functools import partial
from pathlib import Path
from urllib.parse import unquote, urlparse

import numpy as np
import pytest
from conftest import ROOT, built_elsewhere, contradicted, copied, run_cells
from numeric import short, vehicle

import slamlib
from slamlib.core.odometry import equation2
from slamlib.io.dataset import read_dataset
from slamlib.io.results import read_structs, read_summary
from slamlib.solve import PROBLEMS
from slamlib.studies.simulation import write_dataset

pytestmark = pytest.mark.slow
# Elements that reach beyond the column, unless what holds them can be scrolled sideways.
STICKING_OUT = """() => {
    const column = document.querySelector("main").getBoundingClientRect();
    const scrolls = e => e.tagName != "MAIN" && (
        ["auto", "scroll"].includes(getComputedStyle(e).overflowX) || scrolls(e.parentElement));
    return [...document.querySelectorAll("main *")].filter(e => {
        const box = e.getBoundingClientRect();
        return box.width > 0 && (box.right > column.right + 1 || box.left < column.left - 1)
            && !scrolls(e.parentElement) && !e.ownerSVGElement;  // a picture cuts off its parts
    }).map(e => `${e.tagName}: ${e.textContent.slice(0, 60)}`);
}"""


@pytest.fixture(scope="module")
def built(report_on_all):
    """The folder of the shared report, and the text of its pages by name."""
    return report_on_all, {page.stem: page.read_text()
                           for page in (report_on_all / "report").glob("*.html")}


def test_results_are_those_of_the_library_and_of_problem_2_where_there_are_markers(built):
    folder, _ = built
    for data in filter(Path.is_dir, (folder / "data").iterdir()):
        dataset = read_dataset(data)
        results = folder / "results" / data.name
        expected, _ = equation2(dataset.ticks, dataset.vehicle)
        found = read_structs(results / "problem1", "vehiclePose")[1]
        np.testing.assert_array_equal(found, expected)
        assert (results / "problem2").exists() == (dataset.aruco is not None)
        if dataset.aruco is not None:
            fused = read_structs(results / "problem2_fused", "vehiclePose")[1]
            assert np.isfinite(fused).all() and len(fused) == len(expected)


def text_of(page):
    """The text of a page that a reader sees."""
    return html.unescape(re.sub(r"<(style|script|pre).*?</\1>|<[^>]+>", "", page, flags=re.DOTALL))


def test_chapters_name_the_datasets_that_have_what_they_need_and_show_no_warning_or_nan(built):
    folder, pages = built
    assert pages.keys() == {path.stem for path in (ROOT / "notebooks").glob("*.ipynb")} | {"index"}
    text = text_of(pages["1_odometry"])
    for data in filter(Path.is_dir, (folder / "data").iterdir()):
        assert data.name in text and data.name in pages["index"]
    markers = text_of(pages["2_aruco_localization"])
    assert pages["3_odometry_aruco_slam"].count("data:image/gif;base64") == 1
    assert "sparse" in markers and not re.search("wheels_only|one_pose", markers)
    for name, page in pages.items():                              # no defects of the notebooks
        assert 'class="stderr"' not in page, name
        assert not re.search(r"\bnan\b| at 0x[0-9a-f]{6}", text_of(page)), name


FAILING = """import numpy as np
import slamlib
usual = slamlib.estimate

def failing(dataset, *arguments, **options):
    if dataset.name == "bad" and dataset.uwb is None:
        raise np.linalg.LinAlgError("Singular matrix")
    return usual(dataset, *arguments, **options)

slamlib.estimate = failing"""


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Chapters on three drives, one of which fails and one of which states its noise.

    Problems 2 and 3 cannot be solved on `bad`; problem 4 can, without problem 3. No truth is known.
    The folder, and the Report.
    """
    folder = tmp_path_factory.mktemp("mixed")
    dataset, _ = short(3, 300)
    whole, _ = short(3, step=3)                                     # which returns to its start
    write_dataset(folder / "data" / "good", whole)
    write_dataset(folder / "data" / "bad", contradicted(dataset))
    write_dataset(folder / "data" / "told", vehicle(
        slip=2e-3, marker_noise_factor=1.25, range_noise_factor=0.75)(dataset))
    copied(folder / "notebooks", "[234]*.ipynb", first=FAILING)
    return folder, built_elsewhere(folder / "notebooks", folder / "data", folder / "report",
                                   folder / "results", folder / "kept")


def test_a_drive_that_fails_is_left_out_of_its_chapter_and_costs_the_others_nothing(mixed):
    folder, report = mixed
    failed = {each["dataset"]: [problem for problem, row in each["problems"].items()
                                if "failed" in row] for each in report.summaries}
    assert failed == {"bad": ["problem2", "problem3"], "good": [], "told": []}
    for name, problems in failed.items():
        written = {each.name for each in (folder / "results" / name).glob("problem*")}
        assert written == {*PROBLEMS} - {"problem1", *problems}        # no chapter 1 here
    for number, title in ((1, "ArUco"), (2, "SLAM: odometry + ArUco")):
        text = text_of(report.files[number].read_text())
        assert f"bad: The problem “{title}” could not be solved: expected" in text
    assert ">bad</td>" in report.files[3].read_text()


def lost(solver, drive, *arguments, **options):
    """What a solver returns, which fails on drives of few sightings; simulated examples have more.
    """
    if len(getattr(drive, "aruco", drive).pose) < 100:
        raise np.linalg.LinAlgError("Singular matrix")
    return solver(drive, *arguments, **options)


@pytest.mark.usefixtures("look")
def test_chapters_all_of_whose_drives_fail_go_on_and_record_the_failures(tmp_path, monkeypatch):
    """They run here, without a kernel. Captions without a figure are in test_document."""
    write_dataset(tmp_path / "data" / "bad", short(3, 60)[0])
    for name in ("localize", "fuse", "fuse_increments", "estimate"):
        monkeypatch.setattr(slamlib, name, partial(lost, getattr(slamlib, name)))
    for notebook in sorted((ROOT / "notebooks").glob("[234]*.ipynb")):
        run_cells(notebook, tmp_path, monkeypatch)
    rows = read_summary(tmp_path / "results" / "bad")["problems"]
    assert [name for name, row in rows.items() if "failed" in row] == [*PROBLEMS][1:]


# In the browser.


@pytest.fixture(scope="module")
def pages(report_on_all):
    return sorted((report_on_all / "report").glob("*.html"))


@pytest.fixture(scope="module", params=[1300, 390])
def visited(request, pages, chromium):
    """Every page in a window of this width, with what it asked for and complained of."""
    visits, context = [], chromium.new_context(viewport={"width": request.param, "height": 900})
    for path in pages:
        page = context.new_page()
        page.asked, page.said = [], []
        page.on("request", lambda asked, page=page: page.asked.append(asked.url))
        page.on("console", lambda said, page=page: page.said.append(said.text))
        page.on("pageerror", lambda error, page=page: page.said.append(str(error)))
        page.goto(path.as_uri(), wait_until="load")
        visits.append((path, page))
    yield visits
    context.close()


def test_nothing_is_loaded_no_error_is_told_and_every_formula_takes_room(visited):
    for path, page in visited:
        assert [url for url in page.asked if not url.startswith("data:")] == [path.as_uri()]
        assert page.said == []
        wide = page.eval_on_selector_all("main math", "all => all.map("
                                         "m => m.getBoundingClientRect().width)")
        assert (wide or path.stem == "index") and all(width > 1 for width in wide)


def test_figures_can_be_read_equations_have_numbers_tables_scroll_and_nothing_sticks_out(visited):
    for path, page in visited:
        figures = page.eval_on_selector_all("figure > p > img", "all => all.map("
                                            "image => Math.min(image.naturalWidth, image.width))")
        assert figures or path.stem == "A_studies"
        assert all(width >= 330 for width in figures), path.name
        outside = page.eval_on_selector_all(".equation > .number", """all => all.filter(
            number => number.getBoundingClientRect().right > innerWidth)
            .map(number => number.textContent)""")
        assert outside == [], path.name
        assert page.evaluate(STICKING_OUT) == [], path.name
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), path.name


def test_a_dark_page_has_light_text(chromium, pages):
    page = chromium.new_context(color_scheme="dark").new_page()
    page.goto(pages[0].as_uri())
    for selector in ("p", "td", "figcaption", ".sourceCode code", ".answer p", "summary"):
        colour = page.eval_on_selector(selector, "e => getComputedStyle(e).color")
        assert sum(map(int, re.findall(r"\d+", colour)[:3])) > 383, selector
    assert "invert" in page.eval_on_selector("figure img", "e => getComputedStyle(e).filter")


def test_links_inside_the_report_lead_somewhere(visited):
    ids = {path.name: set(page.eval_on_selector_all("[id]", "all => all.map(e => e.id)"))
           for path, page in visited}
    for path, page in visited:
        for link in page.eval_on_selector_all("a[href]", "all => all.map(a => a.href)"):
            address = urlparse(link)
            if address.scheme != "file":
                continue
            target = Path(unquote(address.path))
            assert target.exists(), f"{path.name}: {link}"
            if address.fragment:
                assert unquote(address.fragment) in ids[target.name], f"{path.name}: {link}"


def test_a_map_is_enlarged_in_a_box_that_scrolls(visited):
    _, page = next(each for each in visited if each[0].stem[0] == "3")
    page.check(".zoom input")
    assert page.eval_on_selector(".map", "e => e.scrollWidth > 2.9 * e.clientWidth")
