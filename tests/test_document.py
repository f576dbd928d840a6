"""From executed notebooks to pages and a PDF: numbers, links, formulas, what is left out."""

import html
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output, new_raw_cell

from slamlib.report import NotebookError
from slamlib.report.document import render
from slamlib.report.notebooks import Options
from slamlib.report.overview import plain

ONE, TWO, MORE = Path("1_one.ipynb"), Path("2_two.ipynb"), Path("A_more.ipynb")
SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="20" height="9"><path d="M0 0L9 9"/></svg>'
TABLE = "| a | b |\n| --- | ---: |\n| 1 | 2 |\n\n"
HIDDEN, ON_SCREEN = ({"tags": [tag]} for tag in ("hide-input", "html-only"))
TRUTH = {"slamlib": {"needs": "truth"}}
ALL = ("truth", "aruco", "uwb")


def titled(title, *cells):
    """A notebook with a title; cells may be texts in Markdown."""
    return new_notebook(cells=[new_markdown_cell(cell) if isinstance(cell, str) else cell
                               for cell in (f"# {title}", *cells)])


def shown(**data):
    """An output of these kinds, whose `_` stands for "/"."""
    return new_output("display_data", {kind.replace("_", "/"): text for kind, text in data.items()})


def figure(*captions, code="draw()", **metadata):
    """A cell that shows a picture, and then these texts."""
    return new_code_cell(code, metadata=metadata, outputs=[
        shown(**{"image_svg+xml": SVG, "text_plain": "<Figure>"}),
        *(shown(text_markdown=text, text_plain="<M>") for text in captions)])


def text_of(content, folder):
    """What a reader of the PDF finds in it, by poppler."""
    if shutil.which("pdftotext") is None:
        pytest.skip("no pdftotext here (poppler-utils)")
    (folder / "text.pdf").write_bytes(content)
    return subprocess.run(["pdftotext", "-layout", folder / "text.pdf", "-"], check=True,
                          capture_output=True, text=True).stdout


def pages(books, has=ALL, **options):
    """The main part of each page by the number of its notebook, and the PDF."""
    files = render(books, Options(**options), has)
    return {name[0]: re.search("<main>.*</main>", content.decode(), re.DOTALL)[0]
            for name, content in files.items() if name.endswith("html")}, files["report.pdf"]


def page(*cells, **options):
    """The main part of the page of a chapter 1 of these cells."""
    return pages({ONE: titled("1. One", *cells)}, **options)[0]["1"]


def words(text):
    """HTML without tags and spaces in a row."""
    return " ".join(re.sub("<[^>]*>", "", text).split())


def links(text):
    return re.findall(r'<a\s+href="((?!#cb)[^"]*)"[^>]*>([^<]*)', text)


# Figures, tables and references.


def test_gaps_are_closed_references_follow_and_a_figure_may_have_two_pictures(tmp_path):
    books = {ONE: titled(
        "1. One", figure(), figure(), "Figure 1.2. One, not figure 1.5.",
        figure("Figure 1.5. Two."),
        f"{TABLE}Table 1.4. A table.\n\nSee figures 1.2 and 1.5, table 1.4, `figure 1.9`.")}
    found, content = pages(books)
    assert re.findall(r'id="((?:figure|table)[^"]*)"', found["1"]) == [
        "figure-1.1", "figure-1.2", "table-1.1"]
    assert [part.count("<img") for part in found["1"].split("<figcaption")] == [2, 1, 0, 0]
    assert links(found["1"])[:4] == [("#figure-1.2", "1.2"), ("#figure-1.1", "1.1"),
                                     ("#figure-1.2", "1.2"), ("#table-1.1", "1.1")]
    assert "Figure 1.1. One, not figure 1.2." in words(found["1"]) and "figure 1.9" in found["1"]
    text = text_of(content, tmp_path)
    for line in ("Figure 1.1. One", "Figure 1.2. Two.", "Table 1.1. A table.",
                 "See figures 1.1 and 1.2, table 1.1"):
        assert line in text


REFERENCES = [
    ("figures 1.1–1.2", "figures [1.1]–[1.2]"), ("(figure 1.2)", "(figure [1.2])"),
    ("Figures 1.1, and 1.2.", "Figures [1.1], and [1.2]."), ("in figure\n1.2", "in figure [1.2]"),
    ("figure\u00a01.2", "figure\u00a0[1.2]"),
    ("equations 1, 2 and 3.", "equations 1, [2] and [3]."),
    ("Equation 2's, equation 4", "Equation [2]'s, equation 4"), ("table 7.1", "table 7.1"),
    ("table 2 of the assignment, 1.1 m", "table 2 of the assignment, 1.1 m"),
    ("appendix A, appendices A and C; A figure", "appendix [A], appendices [A] and C; A figure")]


def test_references_in_every_spelling():
    books = {ONE: titled("1. One", figure("Figure 1.1. A."), figure("Figure 1.2. B."),
                         "$$ a \\tag{2} $$\n\n$$ b \\tag{3} $$", *(
                             f"Now: {text}" for text, _ in REFERENCES)), MORE: titled("A. More")}
    _, *said = pages(books)[0]["1"].split("Now: ")
    for each, (_, expected) in zip(said, REFERENCES, strict=True):
        linked = re.sub(r"<a\s[^>]*>(.*?)</a>", r"[\1]", each.split("</p>")[0])
        assert " ".join(linked.replace("\n", " ").split(" ")) == expected


def test_links_lead_to_other_chapters_by_their_file_and_anchor(capsys):
    books = {ONE: titled("1. One", "## A *section*\n\n$$ x \\tag{1} $$"), TWO: titled(
        "2. Two", "By equation 1, [there](1_one.ipynb#A-section), [one](1_one.ipynb), "
        "[no](3_x.ipynb), [data](notes.txt) and [paper](https://example.org/p).")}
    found, content = pages(books)
    assert [each for each in links(found["2"]) if "index" not in each[0]][:5] == [
        ("1_one.html#eq-1", "1"), ("1_one.html#A-section", "there"), ("1_one.html", "one"),
        ("notes.txt", "data"), ("https://example.org/p", "paper")]
    assert "this report has no 3_x.ipynb, so 'no' is not a link" in capsys.readouterr().err
    assert b"https://example.org/p" in content and b"notes.txt" not in content


def test_a_name_of_a_file_in_the_overview_is_no_reference():
    overview = titled("Overview", "Not read: 'figure 1.9.png'.")
    assert "figure 1.9.png" in pages({Path("index"): overview, ONE: titled("1. One")})[0]["i"]


@pytest.mark.parametrize("cells, reason", [
    ([figure("Figure 1.1. A."), "See figure 1.2."],
     "the text refers to figure 1.2, which does not exist"),
    ([figure("Figure 1.1. A."), figure("Figure 1.1. B.")], "figure 1.1 occurs twice"),
    (["$$ a \\tag{3} $$ and $$ b \\tag{3} $$"], "equation 3 occurs twice"),
    ([figure(), "Text.\n\nFigure 1.1. Late."], "caption of figure 1.1 is not directly below a"),
    ([figure("Table 1.1. No table.")], "the caption of table 1.1 is not directly below a table"),
    (["[text](#Nowhere)"], "the link 'text' leads to #Nowhere, which does not exist in 1_o"),
    (["![](https://example.org/p.png)"], "expected a picture of the notebook or a file beside it"),
    (["## Place\n\nSo $x$ and $\\nonsense{x}$"],
     r", section 'Place': pandoc cannot convert this formula:\n    \\nonsense{x}"),
    (["$$ a \\tag{1} \\tag{2} $$"], r"pandoc would lose \\tag in this formula"),
    (["$\\begin{array}{c|c} a & b \\end{array}$"], "pandoc would lose {array}{c| in this formula"),
    (["\\begin{equation} x \\end{equation}"], "a formula stands outside of \\$\\$")])
def test_what_would_be_lost_or_does_not_fit_is_refused(cells, reason):
    with pytest.raises(NotebookError, match=f"^1_one.ipynb.*{reason.replace('{', '[{]')}"):
        page(*cells)


def test_before_the_execution_only_the_text_is_checked():
    book = titled("1. One", "By figure 1.1, [it](#Later).", new_code_cell("say('## Later')"),
                  "Figure 1.1. Of an output.")
    render({ONE: book}, Options(leave_out={"later": "report.toml, line 2"}), check=True)
    book.cells.append(new_markdown_cell("$\\nonsense$"))
    with pytest.raises(NotebookError, match="nonsense"):
        render({ONE: book}, Options(), check=True)


# Formulas, tables and other parts.


FORMULAS = [  # what authors write, and a part of what can be set
    (r"\bigl\lVert r \bigr\rVert", "‖𝑟‖"), (r"a\!b", "𝑎𝑏"), (r"\|x\|", "‖𝑥‖"),
    (r"\lvert Q \rvert", "|𝑄|"), (r"\big( a \big)^2", "𝑎"), (r"\tfrac12 \dfrac{a}{b}", "𝑎"),
    (r"\underbrace{x}_{\text{d}}", "d"), (r"\arg\min_x f", "min"),
    (r"\begin{bmatrix}3\end{bmatrix}", "3")]


def test_every_formula_arrives_with_its_number(tmp_path):
    cells = [r"Norms $\lVert r \rVert^2$ and $$ \begin{aligned} x &= \frac{a}{b}\,\cos\delta_k \\ "
             r"y &= \left\lVert r \right\rVert \end{aligned} \tag{1.1} $$.",
             "| $a < b$ | 2 |\n| --- | --- |\n| $$ \\sqrt2 \\tag{7} $$ | `$code$` |",
             new_code_cell(outputs=[shown(text_latex="$\\hat\\theta$", text_plain="no")]),
             *(f"Now: $$ {tex} $$" for tex, _ in FORMULAS)]
    found, content = pages({ONE: titled("1. Of $x$", "## And $y$", *cells)})
    assert found["1"].count("<math") == 7 + len(FORMULAS) and "<code>$code$</code>" in found["1"]
    assert re.findall(r'class="number">\(([\d.]+)\)', found["1"]) == ["1.1", "7"]
    assert {"eq-1.1", "eq-7"} <= set(re.findall(r'id="([^"]+)"', found["1"]))
    left = re.sub(r"(?s)<math.*?</math>|<code>.*?</code>", "", found["1"])
    assert "$" not in left and "\\" not in left
    text = text_of(content, tmp_path)
    assert re.search(r"\s\(1\.1\)\s", text) and re.search(r"\s\(7\)\s", text)
    assert "‖𝑟‖" in text and "∥" not in text and "parallel" not in text
    _, *said = text.replace(" ", "").split("Now:")
    for each, (_, expected) in zip(said, FORMULAS, strict=True):
        assert expected in each


def test_wide_formulas_shrink_long_tables_break_and_rows_have_groups_and_headings(tmp_path):
    rows = "\n".join(f"| {row} | {row**2} |" for row in range(150))
    wide = " + ".join(f"x_{{{number}}}" for number in range(36))
    found, content = pages({ONE: titled(
        "1. One", f"| a | b |\n| - | - |\n{rows}\n\nTable 1.1. Squares.",
        f"$$ {wide} \\tag{{1}} $$", "> **Answer**\n>\n> **Question.** Why $x$?", "> A quote.",
        "| n | x |\n| --- | --- |\n| a | 1. *one* |\n| | 2 |\n| b | 3 |\n",
        "| n | x |\n| --- | --- |\n| **all** | |\n| c | 4 |")})
    found, text = found["1"], text_of(content, tmp_path)
    assert all(re.search(rf"\b{row}\s+{row**2}\b", text) for row in range(150))
    assert next(line for line in text.splitlines() if line.endswith("(1)")).count("+") == 35
    assert re.findall(r'<td[^>]*rowspan="2"[^>]*>(.*?)<', found) == ["a"] and "1. one" in text
    assert found.count('<tr class="group">') == 1
    assert re.search(r'<td colspan="2"[^>]*><strong>all', found)
    assert found.count('<div class="answer">') == found.count("<blockquote>") == 1


def test_outputs_are_shown_by_the_best_kind_and_html_tables_are_tables(tmp_path):
    table = ("<div><style scoped>.dataframe td {}</style><table class='dataframe'><tr><th>h</th>"
             "</tr><tr><td>cell</td></tr></table></div>")
    book = titled(
        "1. One", new_code_cell(outputs=[
            shown(image_png="iVBORw0KGgo=", text_plain="no", **{"image_svg+xml": SVG}),
            shown(text_html=table, text_plain="no"), shown(text_markdown="Table 1.1. Frames."),
            shown(text_plain="last"), new_output("stream", name="stderr", text="\x1b[31mtold\n")]),
        new_raw_cell("raw"))
    found, content = pages({ONE: book})
    found = found["1"]
    assert found.count("<img") == 1 and 'src="data:image/svg+xml;base64' in found
    assert 'id="table-1.1"' in found and "<style" not in found
    assert "last" in found and re.search('<pre class="output stderr"><code>told', found)
    text = text_of(content, tmp_path)
    assert "cell" in text and "last" in text and "told" in text
    assert not re.search(r"\bno\b", text)


def test_pictures_beside_the_notebook_and_attachments_are_embedded(tmp_path):
    (tmp_path / "p.svg").write_text(SVG)
    cell = new_markdown_cell("![beside](p.svg) ![attached](attachment:a.svg)")
    cell.attachments = {"a.svg": {"image/svg+xml": SVG}}
    files = render({tmp_path / "1_one.ipynb": titled("1. One", cell)}, Options(), ALL)
    assert files["1_one.html"].count(b'src="data:image/svg+xml;base64') == 2


@pytest.mark.parametrize("code, folded, printed", [
    ("method", 1, "open()"), ("all", 0, "open()folded()"), ("none", 0, "")])
def test_code_is_folded_on_the_page_and_left_out_of_the_pdf(tmp_path, code, folded, printed):
    told = [new_output("stream", text="told\n")]
    book = titled("1. One", new_code_cell("open()", outputs=told),
                  figure("Figure 1.1. F.", code="folded()", **HIDDEN))
    found, content = pages({ONE: book}, code=code)
    assert found["1"].count("<details>") == found["1"].count("</details>") == folded
    assert found["1"].count("told") == (code != "none") and found["1"].count("<figcaption>") == 1
    text = text_of(content, tmp_path)
    assert "".join(re.findall(r"(?:open|folded)\(\)", text)) == printed
    assert text.count("told") == (code != "none")


@pytest.mark.parametrize("name", [
    '<svg onload="run()">', "<script>run()</script>", "[link](javascript:run())",
    "`<b>` | __b__ ![](x) &lt;b&gt; $x", "1. *a* #b @c ~d~ ^e^ \\f 'g' \"h\" -- ..."])
def test_a_name_stays_the_same_text_in_markdown(name):
    found = page(f"x {plain(name)}\n\n| a |\n|--|\n| x {plain(name)} |")
    assert "<script" not in found and "<svg onload" not in found
    said = [words(html.unescape(re.sub("<[^>]*>", "", each)).replace("<", "&lt;"))
            for each in re.findall(r"<(?:p|td)[^>]*>(x .*?)</(?:p|td)>", found, re.DOTALL)]
    assert said == 2 * [words(f"x {name}".replace("<", "&lt;"))]


# Sections, chapters and appendices.


def book():
    """Sections 1.1 to 1.4; the second needs truth and has one below it, the third is an output."""
    return titled(
        "1. One", "## First\n\nText.", new_markdown_cell("## Errors\n\nBy truth.", metadata=TRUTH),
        new_code_cell("errors()", outputs=[new_output("stream", text="printed")]),
        "### Deep\n\nMore $$ x \\tag{1.1} $$", figure("Figure 1.1. Gone."),
        new_code_cell("said()", outputs=[shown(text_markdown="Before.\n\n## Said\n\nIt.")]),
        figure("Figure 1.2. Stays."),
        "## Last\n\nSee [it](#Deep), equation 1.1, figures 1.1 and 1.2.")


@pytest.mark.parametrize("has, left_out, sections", [
    (ALL, [], ["1.1 First", "1.2 Errors", "1.2.1 Deep", "1.3 Said", "1.4 Last"]),
    (("uwb",), [], ["1.1 First", "1.2 Said", "1.3 Last"]),
    (ALL, ["1.2"], ["1.1 First", "1.2 Said", "1.3 Last"]),
    (ALL, ["deep"], ["1.1 First", "1.2 Errors", "1.3 Said", "1.4 Last"]),
    (("uwb",), ["1.3"], ["1.1 First", "1.2 Last"])])
def test_sections_are_numbered_without_gaps_and_may_be_left_out(capsys, has, left_out, sections):
    leave_out = dict.fromkeys(left_out, "here")
    found = pages({ONE: book()}, has, leave_out=leave_out)[0]["1"]
    assert [words(each) for each in re.findall(r"<h[23].*?</h[23]>", found, re.DOTALL)] == sections
    whole = "1.2.1 Deep" in sections
    assert ("By truth" in found) == ("1.2 Errors" in sections) == ("printed" in found)
    assert ("Gone." in found) == whole == ('href="#Deep"' in found)
    assert "Figure 1.2. Stays." in words(found) or not whole
    assert ("no dataset has truth" in capsys.readouterr().err) == ("truth" not in has)


@pytest.mark.parametrize("text, without", [
    ("Wheels matter (table A.1).", "Wheels matter."),
    ("One. Table A.1 has 1.5 m\nof it. Two.", "One. Two."),
    ("Appendix A compares ways, and table A.1\ntests them. Two.", "Two.")])
def test_what_only_points_to_an_appendix_goes_with_it(text, without):
    chapter = titled("1. One", f"Now: x. {text}")
    assert f"Now: x. {without} Overview" in words(pages({ONE: chapter})[0]["1"])
    found = pages({ONE: chapter, MORE: titled("A. More", f"{TABLE}Table A.1. Ways.")})[0]["1"]
    assert 'href="A_more.html' in found and "A.1" in words(found)


def test_sections_for_screens_are_not_printed_and_references_to_them_are_plain(tmp_path):
    cells = ["## First\n\nSee figures 1.1 and 1.2, [there](#Explore).",
             new_markdown_cell("## Explore", metadata=ON_SCREEN), figure(**ON_SCREEN),
             new_markdown_cell("Figure 1.1. Moves.", metadata=ON_SCREEN), "## Second",
             figure("Figure 1.2. Stands.")]
    found, content = pages({ONE: titled("1. One", *cells)})
    text = text_of(content, tmp_path)
    assert "1.3 Second" in words(found["1"]) and "Moves" in found["1"]
    assert "1.2 Second" in text.replace("\u2002", " ") and "Explore" not in text
    assert "See figures 1.1 and 1.1, there." in text and "Figure 1.1. Stands." in text


def test_a_report_has_contents_a_title_page_and_equal_bytes(tmp_path):
    books = {ONE: titled("1. One", "## First"), TWO: titled('2. <b> "Two" #x', "## Second")}
    options = Options(title='A "title" *and* #x', author="A. Author", student_number="4711")
    files = render(books, options, ALL, picture=SVG)
    assert files == render(books, options, ALL, picture=SVG)
    assert [*files] == ["1_one.html", "2_two.html", "report.pdf"]
    text = text_of(files["report.pdf"], tmp_path)
    for line in ('A "title" *and* #x', "A. Author", "4711", "1.1 First", "2. “Two” #x"):
        assert line.replace("“", '"').replace("”", '"') in text.replace("“", '"').replace("”", '"')
    page = files["2_two.html"].decode()
    assert '<a href="1_one.html">1. One</a>' in page and 'href="#Second"' in page
    assert "<script" not in page and "default-src 'none'" in page
