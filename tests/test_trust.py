"""What comes from data and cells reaches the report as text; pages load and run nothing."""

import html
import re
from pathlib import Path

import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib.report.document import render
from slamlib.report.notebooks import Options
from slamlib.report.overview import plain

RUN = "document.title='ran'"
ELSEWHERE = "https://elsewhere.example/"
PAYLOADS = [
    f"<script>{RUN}</script>", f'<img src="data:image/png;base64,AA" onerror="{RUN}">',
    f'<iframe srcdoc="<script>parent.{RUN}</script>"></iframe>', f'<img src="{ELSEWHERE}">',
    f'<p style="background:url({ELSEWHERE})">x</p>', f"<style>@import url({ELSEWHERE});</style>",
    f'<link rel="stylesheet" href="{ELSEWHERE}">', f'<video poster="{ELSEWHERE}"></video>',
    f'<base href="{ELSEWHERE}">']
NAMES = (f'<svg onload="{RUN}">', f'<img src=x onerror="{RUN}">', f"[link](javascript:{RUN})",
         "`<b>` | __b__ ![](x) &lt;b&gt; $x", "1. *a* #b @c ~d~ ^e^ \\f 'g' \"h\" -- ...")


def page_of(*cells):
    return render({Path("1_x.ipynb"): new_notebook(cells=list(cells))}, Options())[
        "1_x.html"].decode()


@pytest.mark.parametrize("name", NAMES)
def test_a_name_stays_the_same_text_in_markdown(name):
    table = f"| a |\n|--|\n| x {plain(name)} |"
    page = page_of(new_markdown_cell(f"x {plain(name)}\n\n{table}"))
    main = page[page.index("<h1>"):page.index("<nav class=\"turn\"")]
    shown = [html.unescape(re.sub("</?code>|\n", lambda tag: " " * (tag[0] == "\n"), text))
             for text in re.findall(r"<(?:p|td)[^>]*>(x .*?)</(?:p|td)>", main, re.DOTALL)]
    assert [" ".join(each.split()) for each in shown] == [" ".join(f"x {name}".split())] * 2


def test_characters_that_are_not_seen_are_spaces():
    assert plain("a\nb\u202ec\ue0000\ue001") == "a b c 0 "
    assert plain("1\u00a0m") == "1\u00a0m"


def test_titles_and_outputs_that_are_no_html_are_text():
    page = page_of(new_markdown_cell(f"# `{NAMES[0]}`"), new_code_cell("'<b>'", outputs=[
        new_output("display_data", {"text/plain": "<script>"}),
        new_output("stream", text="<script>")]))
    assert "<script" not in page and "<svg onload" not in page
    assert page.count("&lt;script&gt;") == 2 and page.count("&lt;svg onload=") >= 3


@pytest.mark.slow
def test_what_a_cell_brings_neither_runs_nor_loads(chromium, tmp_path):
    """Each payload would, without the page's policy."""
    page = page_of(*(new_code_cell(outputs=[new_output("display_data", {"text/html": text})])
                     for text in PAYLOADS))
    policy = re.search('<meta http-equiv="Content-Security-Policy".*?>', page)[0]

    def happened(text):
        (tmp_path / "page.html").write_text(text, encoding="utf-8")
        tab, failed = chromium.new_page(), []  # there is no such host
        tab.on("requestfailed", lambda request: failed.append(request.failure))
        tab.goto((tmp_path / "page.html").as_uri(), wait_until="load")
        tab.wait_for_timeout(500)
        found = {"ran"} if tab.title() == "ran" else set()
        tab.close()
        return found | ({"asked"} if set(failed) - {"csp"} else set())

    assert happened(page) == set()
    assert happened(page.replace(policy, "")) == {"ran", "asked"}
