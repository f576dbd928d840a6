"""The report in a real browser: nothing is loaded, all formulas are there, nothing sticks out."""

import re
from pathlib import Path
from urllib.parse import unquote, urlparse

import nbformat
import pytest

ROOT = Path(__file__).parents[1]
# Elements that reach beyond the column, unless what holds them can be scrolled sideways.
STICKING_OUT = """() => {
    const column = document.querySelector("main").getBoundingClientRect();
    const scrolls = e => e.tagName != "MAIN" && (
        ["auto", "scroll"].includes(getComputedStyle(e).overflowX) || scrolls(e.parentElement));
    return [...document.querySelectorAll("main *")].filter(e => {
        const box = e.getBoundingClientRect();
        return box.width > 0 && (box.right > column.right + 1 || box.left < column.left - 1)
            && !scrolls(e.parentElement);
    }).map(e => `${e.tagName}: ${e.textContent.slice(0, 60)}`);
}"""


@pytest.fixture(scope="module")
def pages(report_on_all):
    return sorted((report_on_all / "report").glob("*.html"))


@pytest.fixture(params=[1300, 768, 390])
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


def formulas(notebook):
    """TeX formulas in a notebook's text, by their dollars."""
    text = "\n\n".join(cell.source for cell in nbformat.read(notebook, as_version=4).cells
                       if cell.cell_type == "markdown")
    text = re.sub(r"(?s)```.*?```|`[^`]*`", "", text)
    return re.findall(r"(?s)\$\$.+?\$\$|\$[^$]+\$", text)


def test_nothing_is_loaded_and_no_error_is_told(visited):
    for path, page in visited:
        assert [url for url in page.asked if not url.startswith("data:")] == [path.as_uri()]
        assert page.said == []


def test_every_formula_of_a_notebook_is_on_its_page_and_takes_room(visited):
    for path, page in visited:
        if path.stem == "index":
            continue
        wide = page.eval_on_selector_all(
            "main math", "all => all.filter(m => !m.closest('.output'))"
                         ".map(m => m.getBoundingClientRect().width)")
        assert len(wide) == len(formulas(ROOT / "notebooks" / f"{path.stem}.ipynb")) > 0
        assert all(width > 1 for width in wide)


def test_every_figure_is_drawn_and_a_phone_gets_the_narrow_one(visited):
    for path, page in visited:
        phone = page.viewport_size["width"] < 640
        figures = page.eval_on_selector_all("figure img", """all => all.map(
            image => [image.naturalWidth, image.width, image.currentSrc != image.src])""")
        assert figures and all(
            natural > 0 and shown >= (300 if phone else 450) and narrow == phone
            for natural, shown, narrow in figures), (path.name, figures)


def test_numbers_of_equations_and_names_of_rows_stay_in_view(visited):
    for path, page in visited:
        assert page.eval_on_selector_all(".equation > .number", """all => all.filter(
            number => number.getBoundingClientRect().right > innerWidth).map(n => n.textContent)""") == []
        moved = page.eval_on_selector_all("table", """all => all.map(table => {
            table.scrollLeft = 1e4;
            const first = table.querySelector("tbody :is(th, td)").getBoundingClientRect();
            return table.getBoundingClientRect().left - first.left;})""")
        if page.viewport_size["width"] < 640:
            assert all(abs(off) < 2 for off in moved), path.name


def test_errors_of_all_problems_are_in_view(visited):
    page = next(page for path, page in visited if path.stem == "index")
    ends = page.eval_on_selector_all("th", """all => all.filter(th => th.textContent.startsWith("ATE"))
        .map(th => [th.getBoundingClientRect().right, th.closest("table").getBoundingClientRect().right])""")
    assert len(ends) == 2 and all(end <= edge + 1 for end, edge in ends)


def test_nothing_sticks_out_of_the_column(visited):
    for path, page in visited:
        assert page.evaluate(STICKING_OUT) == [], path.name
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), path.name


def test_links_inside_the_report_lead_somewhere(visited):
    ids = {path.name: set(page.eval_on_selector_all("[id]", "all => all.map(e => e.id)"))
           for path, page in visited}
    for path, page in visited:
        links = page.eval_on_selector_all("a[href]", "all => all.map(a => a.href)")
        for link in links:
            address = urlparse(link)
            if address.scheme != "file":
                continue
            target = Path(unquote(address.path))
            assert target.exists(), f"{path.name}: {link}"
            if address.fragment:
                assert unquote(address.fragment) in ids[target.name], f"{path.name}: {link}"
