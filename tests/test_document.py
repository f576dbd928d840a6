"""From executed notebooks to pages and a PDF: captions, links, formulas, tables, code."""

import html
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output

from slamlib.notebook.drives import plain
from slamlib.report.document import render
from slamlib.report.notebooks import NotebookError, Options

ONE = Path("1_one.ipynb")
TWO = Path("2_two.ipynb")
MORE = Path("A_more.ipynb")
SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="20" height="9"><path d="M0 0L9 9"/></svg>'
TABLE = "| a | b |\n| --- | ---: |\n| 1 | 2 |\n\n"
HIDDEN = {"tags": ["hide-input"]}


def titled(title, *cells):
    """A notebook with a title; cells may be texts in Markdown."""
    return new_notebook(cells=[new_markdown_cell(cell) if isinstance(cell, str) else cell
                               for cell in (f"# {title}", *cells)])


def shown(**data):
    """An output of these kinds, whose `_` stands for "/"."""
    return new_output("display_data", {kind.replace("_", "/"): text for kind, text in data.items()})


def figure(*captions, code="draw()", **metadata):
    """A cell that shows a picture, and then these texts."""
    picture = shown(**{"image_svg+xml": SVG, "text_plain": "<Figure>"})
    texts = [shown(text_markdown=text, text_plain="<M>") for text in captions]
    return new_code_cell(code, metadata=metadata, outputs=[picture] + texts)


def text_of(content, folder):
    """What a reader of the PDF finds in it, by poppler."""
    if shutil.which("pdftotext") is None:
        pytest.skip("no pdftotext here (poppler-utils)")
    (folder / "text.pdf").write_bytes(content)
    return subprocess.run(["pdftotext", "-layout", folder / "text.pdf", "-"], check=True,
                          capture_output=True, text=True).stdout


def pages(books, **options):
    """The main part of each page by the number of its notebook, and the PDF."""
    files = render(books, Options(**options))
    return {name[0]: re.search("<main>.*</main>", content.decode(), re.DOTALL)[0]
            for name, content in files.items() if name.endswith("html")}, files["report.pdf"]


def page(*cells, **options):
    """The main part of the page of a chapter 1 of these cells, and the PDF."""
    found, content = pages({ONE: titled("1. One", *cells)}, **options)
    return found["1"], content


def words(text):
    """HTML without tags and spaces in a row."""
    return " ".join(re.sub("<[^>]*>", "", text).split())


def links(text):
    return re.findall(r'<a\s+href="((?!#cb|index)[^"]*)"[^>]*>([^<]*)', text)


def test_figures_and_tables_have_their_captions_and_a_figure_may_have_two_pictures(tmp_path):
    found, content = page(
        figure(), figure(), "Figure 1.1. One, not figure 1.2.", figure("Figure 1.2. Two."),
        f"{TABLE}Table 1.1. A table.", "Figure 1.3. Not drawn.")
    assert re.findall(r'<figure id="([^"]*)"', found) == ["figure-1.1", "figure-1.2", "table-1.1"]
    assert [part.count("<img") for part in found.split("<figcaption")] == [2, 1, 0, 0]
    assert links(found) == [("#figure-1.2", "1.2")] and 'id="figure-1.3"' in found
    text = text_of(content, tmp_path)
    for line in ("Figure 1.1. One", "Figure 1.2. Two.", "Table 1.1. A table.",
                 "Figure 1.3. Not drawn."):
        assert line in text


REFERENCES = [
    ("figures 1.1–1.2", "figures [1.1]–[1.2]"), ("(figure 1.2)", "(figure [1.2])"),
    ("Figures 1.1, and 1.2.", "Figures [1.1], and [1.2]."), ("in figure\n1.2", "in figure [1.2]"),
    ("equations 1, 2 and 3.", "equations 1, [2] and [3]."),
    ("Equation 2's, equation 4", "Equation [2]'s, equation 4"), ("table 7.1", "table 7.1"),
    ("`figure 1.1`", "figure 1.1"),
    ("table 2 of the assignment, 1.1 m", "table 2 of the assignment, 1.1 m"),
    ("appendix A, appendices A and C; A figure", "appendix [A], appendices [A] and C; A figure")]


def test_references_are_links_in_every_spelling_and_plain_where_nothing_is():
    said = [f"Now: {text}" for text, _ in REFERENCES]
    books = {ONE: titled("1. One", figure("Figure 1.1. A."), figure("Figure 1.2. B."),
                         "$$ a \\tag{2} $$\n\n$$ b \\tag{3} $$", *said), MORE: titled("A. More")}
    _, *found = pages(books)[0]["1"].split("Now: ")
    for each, (_, expected) in zip(found, REFERENCES, strict=True):
        linked = re.sub(r"<a\s[^>]*>(.*?)</a>", r"[\1]", each.split("</p>")[0])
        assert words(linked) == expected


def test_links_lead_to_other_chapters_by_their_file_and_anchor():
    books = {ONE: titled("1. One", "## 1.1 A *section*\n\n$$ x \\tag{1} $$"), TWO: titled(
        "2. Two", "By equation 1, [there](1_one.ipynb#1.1-A-section), [one](1_one.ipynb), "
        "[no](3_x.ipynb), [data](notes.txt) and [paper](https://example.org/p).")}
    found, content = pages(books)
    assert links(found["2"])[:5] == [
        ("1_one.html#equation-1", "1"), ("1_one.html#1.1-A-section", "there"),
        ("1_one.html", "one"), ("notes.txt", "data"), ("https://example.org/p", "paper")]
    assert b"https://example.org/p" in content and b"notes.txt" not in content


def test_a_remark_in_a_link_is_in_the_report_if_its_chapter_is(tmp_path):
    text = "Enough. [(See chapter 2.)](2_two.ipynb) [(See 3.)](3_x.ipynb)"
    found, content = page(text)
    assert "See" not in words(found) and "See" not in text_of(content, tmp_path)
    found, content = pages({ONE: titled("1. One", text), TWO: titled("2. Two")})
    assert "(See chapter 2.)" in words(found["1"]) and "See 3" not in words(found["1"])
    assert "(See chapter 2.)" in text_of(content, tmp_path)


@pytest.mark.parametrize("cells, reason", [
    ([figure("Figure 1.1. A."), figure("Figure 1.1. B.")], "figure 1.1 occurs twice"),
    (["$$ a \\tag{3} $$ and $$ b \\tag{3} $$"], "equation 3 occurs twice"),
    (["![](https://example.org/p.png)"], "expected a picture of the notebook or a file beside it"),
    (["![](absent.png)"], "expected a picture of the notebook or a file beside it"),
    (["![](attachment:a.png)"], "expected a picture of the notebook or a file beside it"),
    (["$$ a \\tag{1} \\tag{2} $$"], r"pandoc would lose \\tag in this formula"),
    (["$\\begin{array}{c|c} a & b \\end{array}$"], r"pandoc would lose \{array}\{c\| in this"),
    (["\\begin{equation} x \\end{equation}"], r"a formula stands outside of \$\$"),
    (["For $5: $\\frac{1}{2$."], r"a formula has braces that do not match.*: \$.frac\{1\}\{2\$"),
    (["Let $ x $ be."], r"or a blank beside its \$: \$"),
    (["[text](#Nowhere)"], "Typst cannot set the PDF: label .*Nowhere")])
def test_what_would_be_lost_or_leads_nowhere_is_refused(cells, reason):
    with pytest.raises(NotebookError, match=reason):
        page(*cells)


FORMULAS = [  # what authors write, and a part of what can be set
    (r"\bigl\lVert r \bigr\rVert", "‖𝑟‖"), (r"a\!b", "𝑎𝑏"), (r"\lvert Q \rvert", "|𝑄|"),
    (r"\big( a \big)^2", "𝑎"), (r"\tfrac12 \dfrac{a}{b}", "𝑎"), (r"\underbrace{x}_{\text{d}}", "d"),
    (r"\arg\min_x f", "min"), (r"\begin{bmatrix}3\end{bmatrix}", "3")]


@pytest.mark.parametrize("tex, part", FORMULAS)
def test_what_authors_write_in_formulas_can_be_set(tmp_path, tex, part):
    found, content = page(f"$$ {tex} $$")
    assert found.count("<math") == 1
    assert part in text_of(content, tmp_path).replace(" ", "")


def test_every_formula_arrives_with_its_number(tmp_path):
    cells = [r"Norms $\lVert r \rVert^2$ and $$ \begin{aligned} x &= \frac{a}{b}\,\cos\delta_k \\ "
             r"y &= \left\lVert r \right\rVert \end{aligned} \tag{1.1} $$.",
             "| $a < b$ | 2 |\n| --- | --- |\n| $$ \\sqrt2 \\tag{7} $$ | `$code$` |",
             new_code_cell(outputs=[shown(text_latex="$\\hat\\theta$", text_plain="no")])]
    found, content = pages({ONE: titled("1. Of $x$", "## And $y$", *cells)})
    assert found["1"].count("<math") == 7 and "<code>$code$</code>" in found["1"]
    assert re.findall(r'class="number">\(([\d.]+)\)', found["1"]) == ["1.1", "7"]
    assert 'id="equation-1.1"' in found["1"] and 'id="equation-7"' in found["1"]
    left = re.sub(r"(?s)<math.*?</math>|<code>.*?</code>", "", found["1"])
    assert "$" not in left and "\\" not in left
    text = text_of(content, tmp_path)
    assert re.search(r"\s\(1\.1\)\s", text) and re.search(r"\s\(7\)\s", text)


def test_parts_of_a_formula_may_break_on_pages():
    found, _ = page(r"$$ a = \begin{cases} 1 & \quad x \\ 2 & \quad y \end{cases}, \qquad b, "
                    r"\qquad c \tag{1.1} $$")
    assert found.count('class="keep"') == found.count("<math") == 3
    assert found.count('class="number"') == 1


def test_wide_formulas_shrink_and_long_tables_break(tmp_path):
    rows = "\n".join(f"| {row} | {row**2} |" for row in range(150))
    wide = " + ".join(f"x_{{{number}}}" for number in range(36))
    text = text_of(page(f"| a | b |\n| - | - |\n{rows}\n\nTable 1.1. Squares.",
                        f"$$ {wide} \\tag{{1}} $$")[1], tmp_path)
    assert all(re.search(rf"\b{row}\s+{row**2}\b", text) for row in range(150))
    assert next(line for line in text.splitlines() if line.endswith("(1)")).count("+") == 35


def test_rows_of_tables_have_groups_and_headings_and_the_answer_has_a_box(tmp_path):
    found, content = page(
        "| n | x |\n| --- | --- |\n| a | 1. *one* |\n| | 2 |\n| b | 3 |\n",
        "| n | x |\n| --- | --- |\n| **all** | |\n| c | 4 |",
        "> **Answer**\n>\n> **Question.** Why $x$?", "> A quote.")
    assert re.findall(r'<td[^>]*rowspan="2"[^>]*>(.*?)<', found) == ["a"]
    assert "1. one" in text_of(content, tmp_path)
    assert found.count('<tr class="group">') == 1
    assert re.search(r'<td colspan="2"[^>]*><strong>all', found)
    assert found.count('<div class="answer">') == found.count("<blockquote>") == 1


def test_outputs_are_shown_by_the_best_kind_and_html_tables_are_tables(tmp_path):
    table = ("<div>\n<style scoped>\n\n.dataframe td {}\n</style><table class='dataframe'><tr><th>h"
             "</th></tr><tr><td>cell</td></tr></table></div>")
    found, content = page(new_code_cell(outputs=[
        shown(image_png="iVBORw0KGgo=", text_plain="no", **{"image_svg+xml": SVG}),
        shown(text_html=table, text_plain="no"), shown(text_markdown="Table 1.1. Frames."),
        new_output("stream", name="stderr", text="\x1b[31mtold\n")]))
    assert found.count("<img") == 1 and 'src="data:image/svg+xml;base64' in found
    assert 'id="table-1.1"' in found and "<style" not in found
    assert re.search('<pre class="stderr"><code>told', found)
    text = text_of(content, tmp_path)
    assert "cell" in text and "told" in text
    assert not re.search(r"\bno\b", text)


def test_a_picture_beside_the_notebook_is_embedded(tmp_path):
    (tmp_path / "p.svg").write_text(SVG)
    files = render({tmp_path / "1_one.ipynb": titled("1. One", "![beside](p.svg)")}, Options())
    assert files["1_one.html"].count(b'src="data:image/svg+xml;base64') == 1


def test_code_is_folded_on_the_page_and_left_out_of_the_pdf(tmp_path):
    told = [new_output("stream", text="told\n")]
    found, content = page(new_code_cell("open()", outputs=told),
                          figure("Figure 1.1. F.", code="folded()", **HIDDEN))
    assert found.count("<details>") == found.count("<figcaption>") == 1
    text = text_of(content, tmp_path)
    assert re.findall(r"(?:open|folded)\(\)", text) == ["open()"]
    assert "told" in found and "told" in text


def test_exercises_are_on_the_page_and_not_in_the_pdf(tmp_path):
    exercises = new_markdown_cell("Answer this.", metadata={"tags": ["screen-only"]})
    found, content = page("Read this.", exercises)
    assert "Answer this." in found and "Read this." in found
    text = text_of(content, tmp_path)
    assert "Read this." in text and "Answer this." not in text


@pytest.mark.parametrize("name", [
    '<svg onload="run()">', "<script>run()</script>", "[link](javascript:run())",
    "`<b>` | __b__ ![](x) &lt;b&gt; $x", "1. *a* #b @c ~d~ ^e^ \\f 'g' \"h\" -- ..."])
def test_a_name_stays_the_same_text_in_markdown(name):
    found, _ = page(f"x {plain(name)}\n\n| a |\n|--|\n| x {plain(name)} |")
    assert "<script" not in found and "<svg onload" not in found
    said = re.findall(r"<(?:p|td)[^>]*>(x .*?)</(?:p|td)>", found, re.DOTALL)
    assert [html.unescape(" ".join(each.split())) for each in said] == 2 * [f"x {name}"]


def test_a_report_has_contents_a_title_page_and_equal_bytes(tmp_path):
    books = {ONE: titled("1. One", "## 1.1 First"), TWO: titled('2. <b> "Two" #x', "## Second")}
    options = Options(title='A "title" *and* #x', author="A. Author", student_number="4711")
    files = render(books, options)
    assert files == render(books, options)
    assert [*files] == ["1_one.html", "2_two.html", "report.pdf"]
    text = text_of(files["report.pdf"], tmp_path).replace("“", '"').replace("”", '"')
    for line in ('A "title" *and* #x', "A. Author", "4711", "1.1 First", '2. "Two" #x'):
        assert line in text
    found = files["2_two.html"].decode()
    assert '<a href="1_one.html">1. One</a>' in found and 'href="#Second"' in found
    assert "<script" not in found and "default-src 'none'" in found
