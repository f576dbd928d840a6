"""Sections that need what no dataset has, or that report.toml names, are executed and not shown."""

import json
import re
from copy import deepcopy
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output
from test_chapters import titled, typst_of
from test_numbering import TABLE, figure, texts
from test_report import Page, build, make_data

from slamlib.dataset import DatasetError
from slamlib.report.chapters import with_data
from slamlib.report.execution import NotebookError
from slamlib.report.numbering import numbered
from slamlib.report.options import Options
from slamlib.report.sections import Section, sections_of, shown, to_execute

ONE, TWO, MORE = Path("1_one.ipynb"), Path("2_two.ipynb"), Path("A_more.ipynb")
TRUTH = {"slamlib": {"needs": "truth"}}
ALL = {"truth", "aruco", "uwb"}


def book():
    """Sections 1.1 to 1.4; the second needs truth and has two below it, the third is in outputs."""
    said = new_output("display_data", {"text/markdown": "Before.\n\n## Said\n\nIt.",
                                       "text/plain": ""})
    return titled(
        "1. One", new_markdown_cell("The lead.\n\n```\n## no heading\n```\n\n## First\n\nText."),
        new_code_cell("first()"),
        new_markdown_cell("## *Errors*\n\nBy truth.\n\n### Deep\n\nMore.", metadata=TRUTH),
        new_code_cell("errors()", outputs=[new_output("stream", text="printed")]),
        new_markdown_cell("### Deeper\n\nEven more."),
        new_code_cell("said()", outputs=[said, new_output("stream", text="below")]),
        new_markdown_cell("## Last\n\nText.\n\n## Really last\n\nEnd."))


def content(book):
    """All that is shown of a book: code, texts and what is printed."""
    return " ".join(" ".join([cell.source, *(output.get("text") or output.data["text/markdown"]
                                             for output in cell.get("outputs", ()))])
                    for cell in book.cells)


def test_sections_have_the_numbers_of_the_pages():
    assert sections_of(ONE, book()) == [
        Section(1, "1", "1. One"), Section(2, "1.1", "First"),
        Section(2, "1.2", "Errors", "truth"), Section(3, "1.2.1", "Deep"),
        Section(3, "1.2.2", "Deeper"), Section(2, "1.3", "Said"), Section(2, "1.4", "Last"),
        Section(2, "1.5", "Really last")]
    untitled = titled("Untitled", new_markdown_cell("## A"))
    assert sections_of(ONE, untitled)[1] == Section(2, None, "A")


def test_nothing_is_changed_where_nothing_is_left_out():
    books = {ONE: book()}
    assert shown(books, ALL, {})[ONE] is books[ONE]


def test_a_section_ends_at_the_next_heading_of_its_level_wherever_this_is(capsys):
    path, whole = Path("1_told_once.ipynb"), book()
    before = deepcopy(whole)
    left = content(shown({path: whole}, ALL - {"truth"}, {})[path])
    assert not re.search("Errors|truth|Deep|more|errors|printed|said|Before", left)
    for kept in ("The lead.", "## no heading", "first()", "## Said\n\nIt.", "below", "End."):
        assert kept in left
    assert whole == before
    told = capsys.readouterr().err
    assert told == "1_told_once: section 'Errors' left out (no dataset has truth)\n"


@pytest.mark.parametrize("entry, gone, kept", [
    ("1.2", "Errors|Deep|errors|Before", "Said"),
    ("1.2.1", "### Deep\n|More|errors", "Deeper|truth"),
    ("errors", "Errors|Deep|errors|Before", "Said"), ("1.3", "Said|It|below", "Before|said|Last"),
    ("really last", "End", "Last"), ("1.4", "## Last", "Really last"), ("1", "", "")])
def test_what_is_named_is_left_out(entry, gone, kept):
    books = shown({ONE: book(), TWO: titled("2. Two")}, ALL, {entry: "here"})
    assert TWO in books and (ONE in books) == (entry != "1")
    left = content(books[ONE]) if ONE in books else ""
    assert not (gone and re.search(gone, left)) and all(
        part in left for part in filter(None, kept.split("|")))


def test_a_number_names_the_same_section_whatever_the_datasets_have():
    for has in ({"uwb"}, {"uwb", "truth"}):
        left = content(shown({ONE: book()}, has, {"1.3": "here"})[ONE])
        assert "Said" not in left and "Last" in left and ("Errors" in left) == ("truth" in has)


@pytest.mark.parametrize("cell, found", [
    (new_code_cell("x", metadata=TRUTH), "found 'x'"),
    (new_markdown_cell("Text.\n\n## Late", metadata=TRUTH), "begins with a heading ## or ###"),
    (new_markdown_cell("## A", metadata={"slamlib": {"needs": "lidar"}}),
     "expected needs among aruco, uwb, truth in the metadata, found 'lidar'")])
def test_needs_that_would_be_ignored_are_refused(cell, found):
    with pytest.raises(NotebookError, match=f"^1_one.ipynb: .*{found}"):
        sections_of(ONE, titled("1. One", cell))


def test_a_notebook_may_need_truth():
    books = {ONE: titled("1. One"), TWO: new_notebook(metadata=TRUTH)}
    assert [*with_data(books, {"aruco"})] == [ONE] and [*with_data(books, {"truth"})] == [ONE, TWO]


@pytest.mark.parametrize("entry", ["3", "A.3", "Explore", ""])
def test_what_is_unknown_is_told_with_what_there_is(entry):
    books = {ONE: book(), MORE: titled("A. More", new_code_cell("say('## Computed\\n\\nText')"))}
    assert to_execute(books, dict.fromkeys(["A.1", "Computed", "1", "1.2.2"], "here")) == books
    assert to_execute(books, {"unknown": ""}) == books
    with pytest.raises(DatasetError) as told:
        to_execute(books, {entry: "report.toml, line 3"})
    said = str(told.value)
    assert said.startswith("report.toml, line 3: expected to leave out a chapter (1, A) or a ")
    assert said.endswith(f"A.1 Computed), found '{entry}'") and "\n" not in said
    assert ("1.2 Errors" in said) == (entry != "A.3")


def test_an_appendix_that_is_left_out_is_not_executed_and_a_chapter_is():
    books = {ONE: titled("1. One"), MORE: titled("A. More")}
    assert [*to_execute(books, {"A": "here", "1": "here"})] == [ONE]


def test_references_to_what_is_left_out_are_plain_text():
    books = {ONE: titled(
        "1. One", new_markdown_cell("See figures 1.1, 1.2 and 1.3, table 1.1 and equation 1.1.\n\n"
                                    "## Errors", metadata={}),
        figure("Figure 1.1. A."),
        new_markdown_cell(f"## Gone\n\n{TABLE}Table 1.1. T.\n\n$$ x \\tag{{1.1}} $$"),
        figure("Figure 1.2. B."), new_markdown_cell("## Last"), figure("Figure 1.3. C."))}
    left = shown(books, ALL, {"Errors": "here"})
    assert texts(numbered(left, books)[ONE])[1] == (
        "See figures 1.1 (left out), [1.1](#figure-1.1) and [1.2](#figure-1.2), table "
        "[1.1](#table-1.1) and equation [1.1](#eq-1.1).\n\n")
    left = shown(books, ALL, {"Gone": "here"})
    assert texts(numbered(left, books)[ONE])[1].startswith(
        "See figures [1.1](#figure-1.1), 1.2 (left out) and [1.2](#figure-1.2), table 1.1 and "
        "equation 1.1.")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A project whose data have no truth, and its report without section 1.2 and chapter 2."""
    root = tmp_path_factory.mktemp("sections")
    make_data(root)
    (root / "notebooks").mkdir()
    writes = ("import os, pathlib\nfolder = pathlib.Path(os.environ['SLAMLIB_RESULTS'], 'short')\n"
              "folder.mkdir(exist_ok=True)\n(folder / '{}.txt').write_text('executed')")
    for path, cells in {
            ONE: [new_markdown_cell("See [errors](#Errors), [two](2_two.ipynb), equation 1.1 and "
                                    "[the last](#Last).\n\n## First"),
                  new_markdown_cell("## Errors\n\nNobody knows.\n\n$$ x \\tag{1.1} $$",
                                    metadata=TRUTH),
                  new_code_cell(writes.format("errors")),
                  new_markdown_cell("## Skipped\n\nNot asked for."),
                  new_markdown_cell("## Last\n\nText.")],
            TWO: [new_markdown_cell("See [errors](1_one.ipynb#Errors)."),
                  new_code_cell(writes.format("two"))],
            MORE: [new_markdown_cell("By [errors](1_one.ipynb#Errors), [it](1_one.ipynb#Last)."),
                   new_code_cell(writes.format("more"))]}.items():
        number, name = path.stem.split("_")
        nbformat.write(titled(f"{number}. {name.title()}", *cells), root / "notebooks" / path)
    build(root, datasets=["short"], options=Options(leave_out={"1.3": "here", "2": "here"}))
    return root


@pytest.mark.slow
def test_the_report_closes_the_gaps(built):
    page, more = (Page(built / "report" / f"{name}.html") for name in ("1_one", "A_more"))
    assert "See errors, two, equation 1.1 and" in page.text and "#Last" in page.links
    assert not re.search("Nobody|Skipped|Not asked", page.text)
    assert re.findall(r'<li class="h2"><a href="#([^"]*)', page.text) == ["First", "Last"]
    assert "By errors," in more.text and "1_one.html#Last" in more.links
    printed = typst_of(built)
    assert "1.2 Last" in printed and not re.search("Errors|Skipped|Nobody|2. Two", printed)


@pytest.mark.slow
def test_what_is_not_shown_is_executed(built):
    assert not (built / "report" / "2_two.html").exists()
    written = json.loads((built / "results" / "short" / ".slamlib.json").read_text())
    assert written == ["errors.txt", "more.txt", "two.txt"]
