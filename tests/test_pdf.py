"""The PDF: every formula arrives, captions stay with figures, and equal input gives equal bytes."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import typst
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output
from test_report import TEXT, TEXT_FORMULAS

from slamlib.report import pdf
from slamlib.report.execution import NotebookError
from slamlib.report.setting import missing_glyphs

SVG = '<svg xmlns="http://www.w3.org/2000/svg" width="20" height="9"><path d="M0 0L9 9"/></svg>'
TABLE = "| $\\sigma_x$ | b |\n| --- | ---: |\n| one | $$ \\sqrt{2} \\tag{7} $$ |\n\nTable 1. Roots."
OTHER = ("# 2. Second\n\n## Sums\n\n[Back](1_first.ipynb#eq-1), [back too](1_first.ipynb), "
         "[nowhere](1_first.ipynb#eq-99) and [a file](data.txt).")


def shown(*kinds):
    """An output with these kinds of data, given as pairs."""
    return new_output("display_data", dict(kinds))


def first():
    return Path("1_first.ipynb"), new_notebook(cells=[
        new_markdown_cell(TEXT.replace("# Problem 1", "# 1. Problem", 1)
                          .replace("2_other.ipynb", "2_second.ipynb")),
        new_code_cell("print('shown')",
                      outputs=[new_output("stream", name="stdout", text="shown\n")]),
        new_code_cell("plot()",
                      outputs=[shown(("text/plain", "<Figure>"), ("image/svg+xml", SVG))]),
        new_markdown_cell("**Figure 1.** What is seen, $x^2$."),
        new_code_cell("table()", outputs=[shown(("text/markdown", TABLE), ("text/plain", "<M>"))])])


def second():
    return Path("2_second.ipynb"), new_notebook(cells=[new_markdown_cell(OTHER)])


def text_of(content, tmp_path):
    """What a reader of the PDF finds in it, by poppler."""
    if shutil.which("pdftotext") is None:
        pytest.skip("no pdftotext here (poppler-utils)")
    (tmp_path / "report.pdf").write_bytes(content)
    return subprocess.run(["pdftotext", "-layout", tmp_path / "report.pdf", "-"], check=True,
                          capture_output=True, text=True).stdout


def query(files, folder, selector):
    """The elements of this kind in the document that Typst makes."""
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return json.loads(typst.query(folder / "main.typ", selector, root=folder,
                                  ignore_system_fonts=True))


def test_every_formula_is_in_the_document_once(tmp_path):
    files, book = pdf.typst_files([first(), second()])
    formulas = book.formulas
    assert len(formulas) == TEXT_FORMULAS + 3
    # A set, since a heading's formula is in the contents, too.
    labels = {element["label"] for element in query(files, tmp_path, "math.equation")}
    assert labels == {f"<{label}>" for label in book.labels} and len(labels) == len(formulas)


def test_equation_numbers_norms_and_references_can_be_read(tmp_path):
    text = text_of(pdf.typeset([first(), second()], title="The title", author="A. Author",
                               student_number="4711", course="Perception"), tmp_path)
    for number in ("(1)", "(3b)", "(7)"):
        assert re.search(rf"\s{re.escape(number)}\s*\n", text), number
    for line in ("The title", "A. Author", "4711", "Perception", "Contents", "1. Problem: odometry",
                 "1.1 The estimate", "2. Second", "2.1 Sums", "Figure 1. What is seen, 𝑥2",
                 "Table 1. Roots."):
        assert re.search(re.escape(line).replace(r"\ ", r"\s+"), text), line
    assert "$" not in text.replace("$code$", "") and "\\" not in text


def test_figures_stand_where_the_text_has_them_or_float_to_the_next_page(tmp_path):
    """Their order is kept, what fits stays in its place, and the text fills the page before."""
    tall = SVG.replace('height="9"', 'height="300"').replace('width="20"', 'width="500"')
    cells = [new_markdown_cell("# 1. Many")]
    for number in range(1, 8):
        cells += [new_markdown_cell(f"## Section {number}\n\n" + f"Before {number}. " * 150),
                  new_code_cell(outputs=[shown(("image/svg+xml", tall))]),
                  new_markdown_cell(f"Figure 1.{number}. Tall."),
                  new_markdown_cell(f"After {number}. " * 150)]
    text = text_of(pdf.typeset([(Path("1.ipynb"), new_notebook(cells=cells))]), tmp_path)
    assert re.findall(r"Figure 1\.(\d)\. Tall", text) == list("1234567")
    pages = text.split("\f")[2:-1]
    at = [next(n for n, page in enumerate(pages) if f"Figure 1.{number}." in page)
          for number in range(1, 8)]
    before = [max(n for n, page in enumerate(pages) if f"Before {number}." in page)
              for number in range(1, 8)]
    assert all(0 <= here - last <= 1 for here, last in zip(at, before, strict=True))
    assert any(here == last for here, last in zip(at, before, strict=True))
    assert all(page.count("\n") > 20 for page in pages[:-1])


@pytest.mark.slow
def test_long_code_may_break_but_leaves_no_line_alone(tmp_path):
    code = "\n".join(f"line_{number:02} = {number}" for number in range(40))
    for lines in range(30, 60, 3):  # at every distance from the end of the page
        book = new_notebook(cells=[new_markdown_cell("Before.\n\n" * lines), new_code_cell(code)])
        pages = text_of(pdf.typeset([(Path("1.ipynb"), book)]), tmp_path).split("\f")
        counts = [page.count("line_") for page in pages if "line_" in page]
        assert sum(counts) == 40 and min(counts) >= 5 and len(counts) <= 2


def test_rows_of_a_group_are_divided_from_the_next_group():
    rows = "| a | 1 |\n| | 2 |\n| b | 3 |\n| | 4 |"
    book = new_notebook(cells=[new_markdown_cell(
        f"| x | y |\n| --- | --- |\n{rows}\n\nTable 1.1. Groups.")])
    text = pdf.typst_files([(Path("1.ipynb"), book)])[0]["main.typ"].decode()
    assert text.count("table.hline(stroke: 0.3pt)") == 1
    assert text.index("table.hline(stroke: 0.3pt)") < text.index("[b], [3]")
    pdf.typeset([(Path("1.ipynb"), book)])


@pytest.mark.parametrize("after, small", [("", 1), ("\n\n## More\n\nText.", 0)])
def test_references_that_end_a_chapter_are_set_smaller(after, small):
    book = new_notebook(cells=[new_markdown_cell(
        f"# 1. T\n\nText.\n\n## References\n\n[1] A. Author, *Title*.\n\n[2] B.{after}")])
    text = pdf.typst_files([(Path("1.ipynb"), book)])[0]["main.typ"].decode()
    assert text.count("#references[") == small
    if small:
        assert "Author" in text.split("#references[")[1]
    pdf.typeset([(Path("1.ipynb"), book)])


def test_the_name_of_a_group_has_a_row_of_its_own():
    rows = "| *first, $x$* | | |\n| a | 1 | |\n| | | 2 |\n| **second** | | |\n| b | 3 | 4 |"
    book = new_notebook(cells=[new_markdown_cell(
        f"| x | y | z |\n| --- | ---: | --- |\n{rows}\n\nTable 1.1. Groups.")])
    text = pdf.typst_files([(Path("1.ipynb"), book)])[0]["main.typ"].decode()
    assert re.findall(r"table.cell\(colspan: 3\)\[(.*)\],", text) == [
        "#emph[first, #formula-0;]", "#strong[second]"]
    pdf.typeset([(Path("1.ipynb"), book)])


def test_the_box_answer_is_framed_and_other_quotes_are_not():
    box = "> **Answer**\n>\n> **Question.** Why $x$?\n>\n> **Method.** So."
    book = new_notebook(cells=[new_markdown_cell(box), new_markdown_cell("> A quote.")])
    text = pdf.typst_files([(Path("1.ipynb"), book)])[0]["main.typ"].decode()
    assert len(re.findall(r"#answer\[\s*#strong\[Answer\].*?Why.*?So\.\s*\]", text, re.DOTALL)) == 1
    assert "#quote(block: true)[\nA quote" in text
    pdf.typeset([(Path("1.ipynb"), book)])


def test_links_lead_to_places_in_the_document(tmp_path):
    files, book = pdf.typst_files([first(), second()])
    targets = [element["dest"] for element in query(files, tmp_path, "link")]
    numbered = {formula.number: f"<{label}>"
                for formula, label in zip(book.formulas, book.labels, strict=True)}
    assert targets.count(numbered["1"]) == 2  # from either chapter
    headings = {element.get("label") for element in query(files, tmp_path, "heading")}
    assert len(headings & set(targets)) == 2  # the first chapter, and a section of the second
    assert "https://example.org/paper" in targets
    assert not any("txt" in str(target) or "ipynb" in str(target) for target in targets)


def test_a_link_to_a_notebook_whose_name_has_a_space_leads_there():
    first, last = (new_notebook(cells=[new_markdown_cell(text)])
                   for text in ("# 1. T\n\n[There](2%20x.ipynb)", "# 2. X"))
    files, _ = pdf.typst_files([(Path("1.ipynb"), first), (Path("2 x.ipynb"), last)])
    text = files["main.typ"].decode()
    label = re.search(r"#link\(<([\w-]+)>\)\[There\]", text)[1]
    assert f"= 2. X\n<{label}>" in text


def test_what_describes_a_figure_may_have_any_characters():
    alt = 'a "b"); #c[\\] <at-d>'
    book = new_notebook(cells=[
        new_code_cell(outputs=[shown(("image/svg+xml", SVG))], metadata={"alt": alt}),
        new_markdown_cell("Figure 1. Seen.")])
    text = pdf.typst_files([(Path("1.ipynb"), book)])[0]["main.typ"].decode()
    assert f"[#picture(\"picture-0.svg\", {json.dumps(alt)}, shrink: size)" in text
    pdf.typeset([(Path("1.ipynb"), book)])


def test_without_code_there_are_prose_formulas_figures_and_tables_only(tmp_path):
    files, book = pdf.typst_files([first()], code="none")
    text = files["main.typ"].decode()
    assert "print" not in text and "shown" not in text and "plot()" not in text
    assert len(book.formulas) == TEXT_FORMULAS + 3
    assert "#picture(" in text and '#placed(2, "table", _ => [#figure(' in text
    assert text.count("#caption[") == 2
    assert "print" in pdf.typst_files([first()])[0]["main.typ"].decode()


def test_equal_input_gives_equal_bytes():
    once, again = (pdf.typeset([first(), second()], title="T", author="A") for _ in range(2))
    assert once == again and once.startswith(b"%PDF")


@pytest.mark.parametrize("tex, expected, lost", [
    (r"\left\lVert r \right\rVert^2", "lr(bar.v.double r bar.v.double)^2", "∥"),
    (r"\bigl\lVert r \bigr\rVert", "lr(bar.v.double r bar.v.double)", "parallel"),
    (r"a\!b", "a b", "h("),
    (r"\ln \lvert Q \rvert", "lr(|Q|)", r"\|"),
    (r"\Big( a \Big)^2", r"stretch(\(, size: #1.8em) a stretch(\), size: #1.8em)^2", "scale"),
    (r"a\;b", "a med b", "0em"),
    (r"\|x\|_2", "bar.v.double x bar.v.double_2", "parallel"),
    (r"a \parallel b", "a parallel b", "bar"),
    (r"\dfrac{a}{b}", "#show math.frac: math.display; $a / b$", "inline"),
    (r"\tfrac{a}{b}", "#show math.frac: math.inline; $a / b$", "display"),
])
def test_what_pandoc_sets_wrongly_is_mended(tex, expected, lost):
    book = new_notebook(cells=[new_markdown_cell(f"${tex}$")])
    formula = pdf.typst_files([(Path("1.ipynb"), book)])[0]["formulas.typ"].decode().split("\n")[1]
    assert expected in formula and lost not in formula
    pdf.typeset([(Path("1.ipynb"), book)])


@pytest.mark.parametrize("tex, reason", [
    (r"\nonsense{x}", "7_bad.ipynb, section 'Place': pandoc cannot set this formula, "
     "unexpected control sequence \\nonsense:\n    \\nonsense{x}"),
    (r"\begin{vmatrix} a & b \end{vmatrix}", r"\begin{vmatrix}"),
    (r"\begin{array}{c|c} a & b \end{array}", "pandoc would lose"),
])
def test_a_formula_that_cannot_be_set_is_named(tex, reason):
    book = new_notebook(cells=[
        new_markdown_cell(f"## Place\n\nFine: $x$.\n\n$$ {tex} $$\n\nFine: $y$.")])
    with pytest.raises(NotebookError, match=re.escape(reason)):
        pdf.typeset([(Path("7_bad.ipynb"), book)])


def test_a_formula_that_gets_lost_on_the_way_is_named(monkeypatch, tmp_path):
    book = Path("7_bad.ipynb"), new_notebook(cells=[new_markdown_cell("$x$ and $$ y = 2 $$")])
    template = tmp_path / pdf.TEMPLATE.name
    template.write_text(pdf.TEMPLATE.read_text().replace("\n  body\n})", "\n})"))
    with monkeypatch.context() as patch:
        patch.setattr(pdf, "TEMPLATE", template)
        with pytest.raises(NotebookError, match=r"7_bad.ipynb: the PDF lost this formula:\s+y = 2"):
            pdf.typeset([book])
    convert = pdf.pypandoc.convert_text
    monkeypatch.setattr(pdf.pypandoc, "convert_text", lambda text, to, kind, options: convert(
        text.replace("\ue0000\ue001", ""), to, kind, options))
    with pytest.raises(NotebookError, match=r"7_bad.ipynb: the PDF would lose this formula:\s+x"):
        pdf.typeset([book])


@pytest.mark.parametrize("data, expected", [
    ({"image/png": "iVBORw0KGgo=", "image/svg+xml": SVG, "text/plain": "no"}, "picture-0.svg"),
    ({"application/vnd.jupyter.widget-view+json": {}, "text/plain": "a slider"}, "a slider"),
    ({"text/html": "<table><tr><td>cell</td></tr></table>", "text/plain": "no"}, "cell"),
    ({"application/json": {}}, "#show: report.with()\n\n"),
])
def test_outputs_are_shown_by_the_best_kind_there_is(data, expected):
    book = new_notebook(cells=[new_code_cell(outputs=[new_output("display_data", data)])])
    text = pdf.typst_files([(Path("1.ipynb"), book)])[0]["main.typ"].decode()
    assert expected in text and "no" not in text.split("report.with()")[1].replace("#not", "")


def test_a_long_table_breaks_and_a_wide_formula_shrinks(tmp_path):
    rows = "\n".join(f"| {row} | {row**2} |" for row in range(200))
    wide = " + ".join(f"x_{{{number}}}" for number in range(36))
    book = new_notebook(cells=[new_markdown_cell(
        f"| a | b |\n| --- | --- |\n{rows}\n\nTable 1. Squares.\n\n$$ {wide} \\tag{{1}} $$")])
    text = text_of(pdf.typeset([(Path("1.ipynb"), book)]), tmp_path)
    assert all(re.search(rf"\b{row}\s+{row**2}\b", text) for row in range(200))
    line = next(line for line in text.splitlines() if line.endswith("(1)"))
    assert line.count("+") == 35


def test_a_tall_figure_leaves_room_for_its_caption(tmp_path):
    tall = SVG.replace('height="9"', 'height="4000"').replace('width="20"', 'width="800"')
    book = new_notebook(cells=[
        new_markdown_cell("Before. " * 200),
        new_code_cell(outputs=[shown(("image/svg+xml", tall))]),
        new_markdown_cell("Figure 1. Tall.")])
    pages = text_of(pdf.typeset([(Path("1.ipynb"), book)]), tmp_path).split("\f")
    before = next(number for number, page in enumerate(pages) if "Before." in page)
    assert "Figure 1. Tall." not in pages[before] and "Figure 1. Tall." in pages[before + 1]


@pytest.mark.slow
def test_a_paragraph_that_announces_stays_with_what_it_announces(tmp_path):
    lines = "\n\n".join(f"Line {number}." for number in range(36))
    formula = r"\begin{bmatrix} 1 \\ 2 \\ 3 \\ 4 \\ 5 \\ 6 \\ 7 \end{bmatrix}"
    for more in range(6):  # at every distance from the end of the page
        book = new_notebook(cells=[new_markdown_cell(
            f"{lines}\n\n" + "More.\n\n" * more + f"Announced, $x$:\n\n$$ {formula} $$")])
        pages = text_of(pdf.typeset([(Path("1.ipynb"), book)]), tmp_path).split("\f")
        page = next(page for page in pages if "Announced" in page)
        assert re.search(r"Announced.*7", page, re.DOTALL), more


def test_wide_lines_are_folded_and_nothing_of_them_is_lost(tmp_path):
    wide = "".join(f"<{number:03}>" for number in range(60))
    book = new_notebook(cells=[new_code_cell(
        f"x = '{wide}'", outputs=[new_output("stream", name="stdout", text=f"{wide}\nnarrow\n")])])
    text = text_of(pdf.typeset([(Path("1.ipynb"), book)]), tmp_path)
    assert re.sub(r"[\s↪]", "", text).count(wide) == 2
    lines = [line.strip() for line in text.splitlines() if "<" in line]
    assert max(map(len, lines)) <= pdf.CODE_COLUMNS + 2 and len(lines) >= 8


def test_a_character_that_no_font_has_is_named():
    assert missing_glyphs("Ångström, Σ σ² ≤ ½ → “Ω” Жук") == []
    assert missing_glyphs("a 陳 b 😀") == ["陳", "😀"]
    book = new_notebook(cells=[new_markdown_cell("So the name 陳 of.")])
    with pytest.raises(NotebookError,
                       match=r"^1.ipynb: .* no glyph for 陳 \(U\+9673\): .*the name 陳 of"):
        pdf.typeset([(Path("1.ipynb"), book)])


@pytest.mark.parametrize("text, said", [
    (r"A $x$, $\text{the 陳} \cdot \dfrac{1}{2}$.",
     "no glyph for 陳 (U+9673) in this formula:\n    \\text{the 陳} \\cdot \\dfrac{1}{2}"),
    ("$$ 陳_k \\tag{1.1} $$", "no glyph for 陳 (U+9673) in this formula:\n    陳_k"),
    ("By $x_k$ the #陳_ of *it*.",
     "no glyph for 陳 (U+9673): ...By $x_k$ the #陳_ of *it*....")])
def test_a_character_that_no_font_has_is_quoted_as_the_notebook_has_it(text, said):
    book = new_notebook(cells=[new_markdown_cell("# 1. T\n\n## A\n\n$y$"),
                               new_markdown_cell(f"## The *section*\n\n{text}")])
    with pytest.raises(NotebookError) as told:
        pdf.typeset([(Path("1.ipynb"), book)])
    name, _, message = str(told.value).partition("': the PDF's fonts have ")
    assert name.replace("*", "") == "1.ipynb, section 'The section" and message == said


def test_a_character_of_an_output_is_quoted_from_it():
    book = new_notebook(cells=[new_markdown_cell("## Told"), new_code_cell(
        "x", outputs=[new_output("stream", name="stdout", text="one\nin #陳_ it\n")])])
    with pytest.raises(NotebookError, match=r"^1.ipynb, section 'Told': .*: \.{3}in #陳_ it\.{3}$"):
        pdf.typeset([(Path("1.ipynb"), book)])
