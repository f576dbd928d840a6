"""Figures, tables and equations have numbers without gaps and links; wrong captions are refused."""

import re
from pathlib import Path

import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib.report.execution import NotebookError
from slamlib.report.numbering import numbered

FIRST, SECOND = Path("1_first.ipynb"), Path("2_second.ipynb")
TABLE = "| a | b |\n| --- | --- |\n| 1 | 2 |\n\n"


def figure(*captions):
    """A cell that shows a picture, and then these texts."""
    return new_code_cell("draw()", outputs=[
        new_output("display_data", {"image/svg+xml": "<svg/>", "text/plain": "<Figure>"}),
        *(new_output("display_data", {"text/markdown": text, "text/plain": "<M>"})
          for text in captions)])


def texts(book):
    """All Markdown of a book, in order."""
    return [text for cell in book.cells for text in (
        [cell.source] if cell.cell_type == "markdown" else
        [o.data["text/markdown"] for o in cell.outputs if "text/markdown" in o.data])]


def after(*cells):
    """The texts of the first chapter with these cells, numbered."""
    return texts(numbered({FIRST: new_notebook(cells=list(cells))})[FIRST])


def test_gaps_are_closed_and_references_follow():
    first = new_markdown_cell("Figure 1.2. One; compare figure 1.5.\n\nSee figures 1.2 and 1.5.")
    last = new_markdown_cell(TABLE + "Table 1.4. A table.\n\nIn table 1.4 is it.")
    assert after(figure(), first, figure("Figure 1.5. Two."), last) == [
        "Figure 1.1. One; compare figure [1.2](#figure-1.2).\n\n"
        "See figures [1.1](#figure-1.1) and [1.2](#figure-1.2).",
        "Figure 1.2. Two.", TABLE + "Table 1.1. A table.\n\nIn table [1.1](#table-1.1) is it."]


def test_numbers_that_swap_their_meaning_are_not_replaced_twice():
    assert after(figure("Figure 1.2. A."), figure("Figure 1.1. B, not figure 1.2.")) == [
        "Figure 1.1. A.", "Figure 1.2. B, not figure [1.1](#figure-1.1)."]


@pytest.mark.parametrize("text, becomes", [
    ("figures 1.2–1.3", "figures [1.1](#figure-1.1)–[1.2](#figure-1.2)"),
    ("Figures 1.2, and 1.3.", "Figures [1.1](#figure-1.1), and [1.2](#figure-1.2)."),
    ("in figure\n1.3", "in figure\n[1.2](#figure-1.2)"),
    ("figure\u00a01.3", "figure\u00a0[1.2](#figure-1.2)"),
    ("equations 1, 2 and 3", "equations 1, [2](#eq-2) and [3](#eq-3)"),
    ("FIGURE 1.2 AND 1.3", "FIGURE [1.1](#figure-1.1) AND [1.2](#figure-1.2)"),
    ("`x` figure 1.2\n\n# A figure 1.2\n\n## Figure 1.3 on\ntwo lines\n \nfigure 1.3, equation 2",
     "`x` figure [1.1](#figure-1.1)\n\n# A figure 1.2\n\n## Figure 1.3 on\ntwo lines\n \n"
     "figure [1.2](#figure-1.2), equation [2](#eq-2)"),
    ("figure 7.1 of a chapter that is not here", "figure 7.1 of a chapter that is not here"),
])
def test_references_in_every_spelling(text, becomes):
    equations = "$$ a \\tag{2} $$ $$ b \\tag{3} $$"
    *_, last = after(figure("Figure 1.2. A."), figure("Figure 1.3. B."),
                     new_markdown_cell(equations), new_markdown_cell(text))
    assert last == becomes


def test_another_chapter_is_linked_by_its_file():
    books = {FIRST: new_notebook(cells=[figure("**Figure 1.3.** A."),
                                        new_markdown_cell("$$ x \\tag{2} $$")]),
             SECOND: new_notebook(cells=[new_markdown_cell(
                 "$$ y \\tag{2.1} $$\n\n"
                 "By figure 1.3, equation 2.1 and equation 2. Equation 2's, equation 4.")])}
    done = numbered(books)
    assert texts(done[SECOND])[0].endswith(
        "By figure [1.1](1_first.ipynb#figure-1.1), equation [2.1](#eq-2.1) and equation "
        "[2](1_first.ipynb#eq-2). Equation [2](1_first.ipynb#eq-2)'s, equation 4.")
    assert texts(done[FIRST])[0] == "**Figure 1.1.** A."
    assert texts(books[FIRST])[0] == "**Figure 1.3.** A."  # the books are unchanged


@pytest.mark.parametrize("text, without", [
    ("Wheels matter (table A.1).", "Wheels matter."),
    ("One. Table A.1 has 1.5 m\nof it. Two.", "One. Two."),
    ("Appendix A compares ways, and table A.1\ntests them. Two.\n\nThree.", "Two.\n\nThree."),
    ("One (appendix A).\n\nTable A.1 compares.", "One.\n\n"),
])
def test_what_only_points_to_an_appendix_goes_with_it(text, without):
    chapter = new_notebook(cells=[new_markdown_cell(f"# 1. One\n\n{text}")])
    appendix = new_notebook(cells=[new_markdown_cell("# A. Studies"),
                                   new_markdown_cell(TABLE + "Table A.1. Ways.")])
    for whole in (None, {FIRST: chapter, Path("A.ipynb"): appendix}):
        assert texts(numbered({FIRST: chapter}, whole)[FIRST]) == [f"# 1. One\n\n{without}"]
    linked, = texts(numbered({FIRST: chapter, Path("A.ipynb"): appendix})[FIRST])
    assert re.sub(r"\[(.*?)\]\(A.ipynb.*?\)", r"\1", linked) == f"# 1. One\n\n{text}" != linked


@pytest.mark.parametrize("text", [
    "See (figure 7.1). Figure 7.1 is of a chapter. Appendix C of [3] has it. By table A.1.",
    "`figure 1.9`, $figure 1.9$ and\n\n```\nfigure 1.9\n\nFigure 1.8. No caption.\n```",
    "Figure 1. By hand, figure 7.",
    "the assignment's table 2, 2.5 m, a [table](x.html#table 1.9)", "$$ figure 1.9 $$",
    "## What figure 1.9 says"])
def test_what_is_no_reference_is_left_alone(text):
    assert after(new_markdown_cell(text)) == [text]


@pytest.mark.parametrize("cells, reason", [
    ([figure("Figure 1.1. A."), new_markdown_cell("See figure 1.2.")],
     "the text refers to figure 1.2, which does not exist"),
    ([figure("Figure 1.1. A."), new_markdown_cell("By equation 1.2.")],
     "the text refers to equation 1.2, which does not exist"),
    ([figure("Figure 1.1. A."), figure("Figure 1.1. B.")], "figure 1.1 occurs twice"),
    ([new_markdown_cell("$$ a \\tag{3} $$ and $$ b \\tag{3} $$")], "equation 3 occurs twice"),
    ([figure(), new_markdown_cell("Text.\n\nFigure 1.1. Late.")],
     "the caption of figure 1.1 is not directly below a figure"),
    ([figure(), new_code_cell("x"), new_markdown_cell("Figure 1.1. Late.")],
     "the caption of figure 1.1 is not"),
    ([figure("Figure 1.1. A.", "Figure 1.2. Another of the same.")],
     "the caption of figure 1.2 is not"),
    ([figure("Table 1.1. No table.")], "the caption of table 1.1 is not directly below a table"),
])
def test_what_does_not_fit_together_is_refused(cells, reason):
    with pytest.raises(NotebookError, match=rf"1_first.ipynb: {reason}"):
        after(*cells)


@pytest.mark.parametrize("source, label", [(SECOND, "2.9"), (FIRST, "2.1"), (SECOND, "1.9")])
def test_what_does_not_exist_is_refused_in_a_chapter_without_captions_too(source, label):
    said = {FIRST: "Figure 3.1.", SECOND: "Table 7.1."}  # of chapters that are not here
    books = {path: new_notebook(cells=[figure("Figure 1.1. A.")] * (path == FIRST) + [
        new_markdown_cell(f"# {path.stem[0]}. Title\n\nBy {text}")])
        for path, text in said.items()}
    assert texts(numbered(books)[SECOND]) == ["# 2. Title\n\nBy Table 7.1."]
    books[source].cells[-1].source += f" See figure {label}."
    for part in (books, {source: books[source]}):  # the other chapter is left out
        with pytest.raises(NotebookError, match=f"^{source.name}: .* figure {label}, which does"):
            numbered(part, books)
