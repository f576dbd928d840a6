"""Appendices come last with letters as numbers; tags say what is folded and what is not printed."""

import re
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output
from test_numbering import TABLE, figure, texts
from test_pdf import text_of
from test_report import Page, make_data

from slamlib.__main__ import main
from slamlib.report import chapters, pages, pdf
from slamlib.report.execution import NotebookError
from slamlib.report.numbering import numbered

HIDDEN, HTML_ONLY = ({"tags": [tag]} for tag in ("hide-input", "html-only"))


def titled(title, *cells):
    return new_notebook(cells=[new_markdown_cell(f"# {title}"), *cells])


def folder_with_appendices(folder):
    """A project of one chapter and two appendices, which run without datasets."""
    make_data(folder)
    (folder / "notebooks").mkdir()
    books = {
        "1_text": titled("1. Text", new_markdown_cell(
            "## Sums\n\nBy table A.3, [there](A_more.ipynb#Second), appendix A and appendix B."),
            new_code_cell("print('shown' * 2)"),
            new_code_cell("print('folded' * 2)", metadata=HIDDEN),
            new_markdown_cell("## Explore\n\nOnly on a screen.", metadata=HTML_ONLY)),
        "A_more": titled("A. More", new_markdown_cell(
            f"## First\n\nOne.\n\n## Second\n\n{TABLE}Table A.3. Two.\n\n$$ x \\tag{{A.1}} $$\n\n"
            "By equation A.1.")),
        "B_last": titled("B. Last", new_markdown_cell("The lead of the last.\n\n## Third"))}
    for name, book in books.items():
        nbformat.write(book, folder / "notebooks" / f"{name}.ipynb")


@pytest.mark.parametrize("title, number, appendix", [
    ("# 2. Two", "2", False), ("# B. Two", "B", True), ("# Two", None, False),
    ("# Ab. Two", None, False), ("# *C.* Two", "C", True)])
def test_the_title_says_what_is_an_appendix(title, number, appendix):
    chapter = chapters.chapter_of(Path("x.ipynb"), new_notebook(cells=[new_markdown_cell(title)]))
    assert chapter["number"] == number and chapters.is_appendix(chapter) == appendix


def test_appendices_come_last_and_can_be_left_out():
    books = {Path(f"{name}.ipynb"): titled(title) for name, title in (
        ("b_x", "A. One"), ("z", "Untitled"), ("1_x", "1. First"), ("0_x", "B. Two"))}
    order = [path.stem for path in chapters.in_order(books)]
    assert order == ["1_x", "z", "b_x", "0_x"]
    assert [path.stem for path in chapters.in_order(books, appendix=False)] == order[:2]


@pytest.mark.parametrize("code, tags, shown", [
    ("method", [], "open"), ("method", ["hide-input"], "folded"), ("all", ["hide-input"], "open"),
    ("none", [], ""), ("method", ["html-only"], "open")])
def test_tags_say_how_a_cell_is_shown(code, tags, shown):
    assert chapters.shows_input(new_code_cell("x", metadata={"tags": tags}), code) == shown
    assert chapters.shows_input(new_code_cell(" \n", metadata={"tags": tags}), code) == ""


def test_labels_with_letters_are_numbered_and_linked():
    first, appendix = Path("1_first.ipynb"), Path("A_more.ipynb")
    books = {first: titled("1. First", new_markdown_cell(
        "See tables A.2 and A.4, figure A.3, equation A.1, appendix A, appendices A and C, "
        "table C.1.")),
        appendix: titled("A. More", figure("Figure A.3. F."), new_markdown_cell(
            f"{TABLE}Table A.2. One.\n\n{TABLE}Table A.4. Two.\n\n$$ x \\tag{{A.1}} $$"))}
    done = numbered(books)
    name = appendix.name
    assert texts(done[first])[1] == (
        f"See tables [A.1]({name}#table-A.1) and [A.2]({name}#table-A.2), figure "
        f"[A.1]({name}#figure-A.1), equation [A.1]({name}#eq-A.1), appendix [A]({name}), "
        f"appendices [A]({name}) and C, table C.1.")
    assert "Figure A.1. F." in texts(done[appendix])
    assert "Table A.2. Two." in texts(done[appendix])[2]
    assert texts(numbered({first: books[first]})[first]) == texts(books[first])
    books[first].cells[1].source = "By table A.9."
    with pytest.raises(NotebookError, match="refers to table A.9, which does not exist"):
        numbered(books)


def test_a_reference_to_what_is_not_printed_becomes_plain_text():
    book = titled("1. Text", figure("Figure 1.4. A."), figure("Figure 1.7. B."),
                  new_markdown_cell("See figures 1.4 and 1.7, [there](#Explore)."))
    book.cells[2].metadata = HTML_ONLY
    path = Path("1_text.ipynb")
    on_paper = numbered({path: chapters.printed(book)}, whole={path: book})
    assert texts(on_paper[path])[-1] == (
        "See figures [1.1](#figure-1.1) and 1.2, [there](#Explore).")
    assert texts(numbered({path: book})[path])[-1].count("](#figure") == 2
    content = pdf.typst_files(list(on_paper.items()))[0]["main.typ"].decode()
    assert content.count("#picture(") == 1
    pdf.typeset(list(on_paper.items()))


@pytest.mark.parametrize("code, folded, shown", [
    ("method", 1, "open()"), ("all", 0, "open()folded()"), ("none", 0, "")])
def test_code_is_folded_on_the_page_and_left_out_of_the_pdf(code, folded, shown):
    printed = [new_output("stream", name="stdout", text="told\n")]
    book = titled("1. Text", new_code_cell("open()", outputs=printed),
                  new_code_cell("folded()", outputs=printed, metadata=HIDDEN))
    page, _ = pages.html_page(Path("1.ipynb"), book, [], code)
    assert page.count('<details class="code"><summary>Code</summary>') == folded
    assert page.count("</details>") == folded
    assert page.count(">told\n</pre>") == (0 if code == "none" else 2)
    files, _ = pdf.typst_files([(Path("1.ipynb"), book)], code=code)
    content = files["main.typ"].decode()
    assert "".join(re.findall(r"(?:open|folded)\(\)", content)) == shown
    assert content.count("told") == (0 if code == "none" else 2)


def test_punctuation_stands_behind_a_display_formula_and_beside_one_in_the_line():
    page, _ = pages.html_page(Path("1.ipynb"), titled("1. T", new_markdown_cell(
        "So $a$, and $$ b \\tag{1.1} $$.")), [])
    assert re.search(r'<span class="keep"><math.*?</math>,</span> and', page, re.DOTALL)
    assert re.search(r'<span class="equation" id="eq-1.1"><span class="keep"><math.*?</math></span>'
                     r'<span class="number">\(1.1\)</span></span>\.', page, re.DOTALL)


def test_only_a_page_with_something_live_has_the_build_s_script(tmp_path, monkeypatch):
    (tmp_path / "page.js").write_text("moved();\n")
    monkeypatch.setattr(pages, "SCRIPT", tmp_path / "page.js")
    for shown, expected in (('<div class="live">', 1), ('<svg id="x" class="big live">', 1),
                            ('<div class="alive">', 0), ("class=live", 0)):
        output = new_output("display_data", {"text/html": f"{shown}</div>"})
        page, _ = pages.html_page(Path("1.ipynb"), titled("1. T", new_code_cell(
            outputs=[output, output])), [])
        assert page.count("<script>\nmoved();\n</script>\n</body>") == expected
        assert page.count("<script") == expected
    book = titled("1. T", new_markdown_cell('<div class="live"><script>1</script></div>'))
    with pytest.raises(NotebookError, match="cannot show <script>"):
        pages.html_page(Path("1.ipynb"), book, [])
    monkeypatch.setattr(pages, "SCRIPT", tmp_path / "none.js")
    assert "<script" not in pages.html_page(Path("1.ipynb"), titled(
        "1. T", new_markdown_cell('<div class="live"></div>')), [])[0]


@pytest.mark.slow
def test_the_report_with_appendices_and_without(tmp_path, monkeypatch, capsys):
    folder_with_appendices(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["report", "--jobs", "1"]) == 0
    index, text, more = (Page(tmp_path / "report" / f"{name}.html")
                         for name in ("index", "1_text", "A_more"))
    assert re.findall(r'<h3[^>]*><a href="(\w+).html"', index.text) == [
        "1_text", "A_more", "B_last"]
    assert {"A_more.html", "A_more.html#table-A.1", "A_more.html#Second", "B_last.html"} <= set(
        text.links)
    assert "--chapter: 'A.'" in more.text and {"table-A.1", "eq-A.1"} <= set(more.ids)
    assert text.text.count("<details") == 1 and "Only on a screen" in text.text
    content = typst_of(tmp_path)
    assert "Only on a screen" not in content and "folded" not in content.replace("foldedfolded", "")
    assert "A.2 Second" in content and "B.1 Third" in content and "1.1 Sums" in content

    assert main(["report", "--no-appendix", "--all-code"]) == 0
    index, text = (Page(tmp_path / "report" / f"{name}.html") for name in ("index", "1_text"))
    assert not any("A_more" in link for link in index.links + text.links)
    assert "By table A.3, there, appendix A and appendix B." in text.text
    assert "<details" not in text.text
    told = capsys.readouterr().err
    assert "1_text: nothing changed" in told and "A_more: nothing changed" not in told
    content = typst_of(tmp_path)
    assert "Second" not in content and "print('folded' * 2)" in content


def typst_of(folder):
    """The text of the PDF, by poppler."""
    content = (folder / "report" / "report.pdf").read_bytes()
    return re.sub(r"[ \u2002]+", " ", text_of(content, folder))
