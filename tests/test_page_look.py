"""A page in a browser: dark, on a phone, folded code, the box Answer, groups of rows."""

import re
from pathlib import Path

import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib.notebook import table_text
from slamlib.report.pages import html_page

SVG = ('<svg xmlns="http://www.w3.org/2000/svg" width="400" height="200">'
       '<rect width="400" height="200" fill="#fff"/></svg>')
LONG = "variable = " + " + ".join(f"another_name_{number}" for number in range(20))
ROWS = [["one", *10 * ["1234.5"]], ["one", *10 * ["2.5"]], ["two", *10 * ["3.5"]]]
BOX = "> **Answer**\n>\n> **Question.** Where is it?\n>\n> **Result.** Here."


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """The address of a page with all that may be too wide."""
    figure = new_output("display_data", {"image/svg+xml": SVG})
    book = new_notebook(cells=[
        new_markdown_cell(f"# 1. Look\n\nLead.\n\n{BOX}\n\n> A quote."),
        new_code_cell(LONG), new_code_cell(LONG, metadata={"tags": ["hide-input"]}),
        new_code_cell(outputs=[figure]),
        new_markdown_cell(table_text(["name", *"abcdefghij"], ROWS))])
    page, _ = html_page(Path("1_look.ipynb"), book, [])
    assert page.count('<blockquote class="answer">') == page.count("<blockquote>") == 1
    path = tmp_path_factory.mktemp("look") / "1_look.html"
    path.write_text(page, encoding="utf-8")
    return path


@pytest.fixture(params=[("light", 1200), ("dark", 1200), ("dark", 390)])
def page(request, path, chromium):
    scheme, width = request.param
    context = chromium.new_context(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page, said = context.new_page(), []
    page.on("console", lambda message: said.append(message.text))
    page.goto(path.as_uri())
    page.scheme = scheme
    yield page
    context.close()
    assert said == []  # such as what the page's policy refuses


def brightness(page, selector, name):
    colour = page.eval_on_selector(selector, f"e => getComputedStyle(e).{name}")
    return sum(map(int, re.findall(r"\d+", colour)[:3])) / 765


@pytest.mark.slow
def test_a_dark_page_has_light_text_and_readable_code(page):
    dark = page.scheme == "dark"
    assert (brightness(page, "body", "backgroundColor") < 0.2) == dark
    for selector in ("p", ".caption, td", "div.code", ".highlight .n", ".answer p", "summary"):
        assert (brightness(page, selector, "color") > 0.5) == dark, selector
    inverted = page.eval_on_selector("figure img", "e => getComputedStyle(e).filter")
    assert ("invert" in inverted) == dark


@pytest.mark.slow
def test_what_is_wide_scrolls_in_its_own_box(page):
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    for selector in ("div.code pre", "table"):
        assert page.eval_on_selector(
            selector, "e => ['auto', 'scroll'].includes(getComputedStyle(e).overflowX)"), selector


@pytest.mark.slow
def test_folded_code_opens_by_its_summary(page):
    shown = "() => document.querySelector('details pre').checkVisibility()"
    assert not page.evaluate(shown)
    page.click("summary")
    assert page.evaluate(shown)


@pytest.mark.slow
def test_the_answer_is_framed_and_groups_of_rows_are_divided(page):
    for selector, framed in ((".answer", True), ("blockquote:not(.answer)", False)):
        width = page.eval_on_selector(selector, "e => getComputedStyle(e).borderTopWidth")
        assert (width != "0px") == framed
    lines = page.eval_on_selector_all(
        "tbody tr", "all => all.map(r => getComputedStyle(r.lastElementChild).borderTopWidth)")
    assert lines == ["0px", "0px", "1px"]
