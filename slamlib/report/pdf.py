"""Makes the report's PDF: pandoc writes Typst, the typst wheel sets it; neither needs a network.

The pages' renderer converts cells and outputs to HTML, with marks (private characters) for formulas
and for commands of Typst. pandoc converts the HTML to Typst, where formulas and calls of
`report.typ` replace the marks. A query checks that no formula is lost.
"""

import base64
import hashlib
import html
import json
import re
import tempfile
import textwrap
from dataclasses import replace
from itertools import count
from pathlib import Path
from urllib.parse import unquote

import pypandoc
from nbconvert.filters import strip_ansi

from slamlib.report.chapters import shows_input
from slamlib.report.formulas import set_formulas
from slamlib.report.glyphs import require_glyphs
from slamlib.report.pages import ANSWER, INTERNAL, MARK, Renderer, markdown_html, new_page
from slamlib.report.sanitize import sanitized
from slamlib.report.setting import PLACES, UNKNOWN, compiled, typst_string
from slamlib.report.svg import compressed

TEMPLATE, TITLE_PAGE = (Path(__file__).with_name(name) for name in ("report.typ", "title_page.typ"))
PICTURES = {"image/svg+xml": "svg", "image/png": "png", "image/jpeg": "jpg"}  # endings of files
OUTPUT_KINDS = (*PICTURES, "text/markdown", "text/latex", "text/html", "text/plain")  # best first
CODE_COLUMNS = 96  # width of the page in characters of code
COMMAND_MARK = re.compile("\ue002(\\d+)\ue003")  # stands for a command until pandoc is done
# What pandoc and the commands write: figures and tables with their captions, table rows that hold
# a group's name only, references that end a chapter, what is placed below a heading or announced.
CAPTIONED = r"\s*#caption\[.*?\] <at-\w+>"
FIGURE = re.compile(rf'#picture\(("[\w.-]+", "(?:[^"\\]|\\.)*")\);({CAPTIONED})', re.DOTALL)
TABLE = re.compile(
    rf"#figure\(\n(?:(?!#figure\().)*?, kind: table\n  \){CAPTIONED}", re.DOTALL)
NAME_ONLY = re.compile(
    r"^    \[((?:(?!\], ).)+)\](?:, (?:table\.cell\([^)]*\))?\[\])+,$", re.MULTILINE)
REFERENCES = re.compile(r"^(== References\n<[\w-]+>\n)((?:(?!== ).*\n)+)\Z", re.MULTILINE)
NEXT_NUMBER = "\ue004"  # stands for the number of a figure, a table or a section, by their order
STAYS = re.compile(rf"(?:^=+ .*\n<[\w-]+>\n|#announcing\[.*\n(?:.+\n)*)\s*#placed\({NEXT_NUMBER}, ",
                   re.MULTILINE)
SCALED = re.compile(r"#scale\(x: (\d+)%, y: \d+%\)\[(\\?[^\\]|\\\])\]")  # pandoc's \big, \Big, ...
REPLACED = [(re.compile(pattern), replacement) for pattern, replacement in (
    # TeX that pandoc sets wrongly
    (r"\\!", ""), (r"\\;", r"\\:"),
    (r"\\([bB]igg?[lrm]?|left|right)\s*(?=\\[lr]?[vV]ert(?![a-zA-Z])|\\\|)", ""),
    (r"\\lvert(?![a-zA-Z])", r"\\left\\lvert"), (r"\\rvert(?![a-zA-Z])", r"\\right\\rvert"))]


def typeset(chapters, opening=None, code="method", picture=None, **cover):
    """Return the PDF of chapters, title page and contents as bytes; equal input gives equal bytes.

    NotebookError if a formula is lost or cannot be set, or if the fonts lack a character.

    Parameters
    ----------
    chapters : list of (Path, NotebookNode), executed; links name chapters by their file names.
    opening : NotebookNode, an unnumbered chapter before them, or None.
    code : one of chapters.CODE_SHOWN; "none" leaves out printed text, too.
    picture : str, an SVG for the title page, or None.
    cover : title, author, student_number, course (str), the lines of the title page.
    """
    files, book = typst_files(chapters, opening, code, picture, **cover)
    require_glyphs(book, files["formulas.typ"].decode().split("\n")[1:])  # below an import
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            Path(folder, name).write_bytes(content)
        return compiled(Path(folder), book)


def typst_files(chapters, opening=None, code="method", picture=None, **cover):
    """Return the files for Typst as {name: bytes}, and their Book; parameters as `typeset`."""
    book = Book(code)
    parts = [book.chapter(*chapter) for chapter in chapters]
    if opening is not None:
        parts.insert(0, f"#unnumbered[\n{book.chapter(Path('index'), opening)}\n]")
    text = "\n#chapter-ends()\n".join(parts)
    for number, formula in enumerate(book.formulas):
        if f"\ue000{number}\ue001" not in text:
            raise formula.error("the PDF would lose this formula")
    text = COMMAND_MARK.sub(lambda mark: book.commands[int(mark[1])], text)
    text = MARK.sub(r"#formula-\1;\2", text)
    text = TABLE.sub(_table, text)
    text = FIGURE.sub(
        rf'#placed({NEXT_NUMBER}, "figure", size => [#picture(\1, shrink: size)\2])', text)
    text = STAYS.sub(r"\g<0>stays: true, ", text)
    text = re.sub("^(?=== )", f"#section({NEXT_NUMBER})\n", text, flags=re.MULTILINE)
    number = count()
    text = re.sub(NEXT_NUMBER, lambda _: str(next(number)), text)
    if picture:
        book.files["title.svg"] = compressed(picture).encode()
        cover["picture"] = "title.svg"
    lines = ", ".join(f"{name}: {typst_string(value)}" for name, value in cover.items())
    text = (f'#import "{TEMPLATE.name}": *\n#import "formulas.typ": *\n'
            f"#show: report.with({lines})\n{text}\n")
    definitions = "\n".join([f'#import "{TEMPLATE.name}": display', *_definitions(book)])
    return {TEMPLATE.name: TEMPLATE.read_bytes(), TITLE_PAGE.name: TITLE_PAGE.read_bytes(),
            "main.typ": text.encode(),
            "formulas.typ": definitions.encode(), PLACES: json.dumps(UNKNOWN).encode(),
            **book.files}, book


def _table(found):
    """Return a table and its caption (Match) to be placed, with lines between its groups.

    The rows of a group but the first begin with an empty cell, or a row with a name only precedes
    them.
    """
    head, rule, rows = found[0].partition("    table.hline(),\n")
    columns = re.search(r"columns: (\d+)", head)
    rows = NAME_ONLY.sub(rf"    table.cell(colspan: {columns[1] if columns else 1})[\1],", rows)
    if "\n    [], " in rows:  # a row that continues a group
        rows = rows[:5] + re.sub(r"^    \[(?!\], )", r"    table.hline(stroke: 0.3pt),\n\g<0>",
                                 rows[5:], flags=re.MULTILINE)
    return f'#placed({NEXT_NUMBER}, "table", _ => [{head}{rule}{rows}])'


def _folded(text):
    """Return text whose lines are folded at the width of the page."""
    fold = textwrap.TextWrapper(CODE_COLUMNS, drop_whitespace=False, replace_whitespace=False,
                                expand_tabs=False, break_on_hyphens=False)
    return "\n".join("\n↪ ".join(fold.wrap(line)) for line in text.split("\n"))


def _definitions(book):
    """Return for each formula of a Book a line of Typst (str) that defines it."""
    changed = []
    for formula in book.formulas:
        tex = formula.tex
        for pattern, replacement in REPLACED:
            tex = pattern.sub(replacement, tex)
        changed.append(replace(formula, tex=tex))
    return [f"#let formula-{number} = [{_mended_typst(formula, typst, label)}]"
            for number, (formula, typst, label) in enumerate(zip(
                book.formulas, set_formulas(changed, "typst"), book.labels, strict=True))]


def _mended_typst(formula, typst, label):
    """Return a Formula with its label in Typst on one line, corrected where pandoc and TeX differ.

    `typst` (str) is the formula by pandoc.
    """
    typst = SCALED.sub(lambda big: f"stretch({big[2]}, size: #{int(big[1]) / 100}em)",
                       " ".join(typst.split()))
    if "\\parallel" not in formula.tex:  # pandoc sets \| and \Vert as this relation, too
        typst = typst.replace("parallel", "bar.v.double")
    typst = f"{typst}<{label}>"
    if "\\dfrac" in formula.tex:
        typst = f"#show math.frac: math.display; {typst}"
    elif "\\tfrac" in formula.tex and "\\frac" not in formula.tex:
        typst = f"#show math.frac: math.inline; {typst}"
    if formula.display:
        typst = f"#display({typst_string(formula.number and f'({formula.number})')})[{typst}]"
    return typst


def _label(notebook, anchor=""):
    """Return a Typst label for an anchor, which may have characters that labels must not have."""
    return "at-" + hashlib.sha1(f"{notebook}#{anchor}".encode()).hexdigest()[:12]


class Book:
    """Chapters in Typst, and the files and marks that they refer to.

    `files` are the pictures as {name: bytes}; `texts` the chapters: file name, text without marks
    and NotebookNode; mark i stands for `formulas[i]` (list of Formula) or
    `commands[i]` (list of str). `page` is the dict of the renderer.
    """

    def __init__(self, code):
        self.code, self.files, self.texts, self.formulas, self.commands = code, {}, [], [], []
        self.page = None

    @property
    def labels(self):
        """The Typst label of each formula: that of its anchor if it has a number."""
        return [_label(formula.notebook, formula.anchor) if formula.number else f"formula-{number}"
                for number, formula in enumerate(self.formulas)]

    def chapter(self, source, book):
        """Return a chapter (Path, NotebookNode) in Typst, with marks."""
        self.page = new_page(source) | {"formulas": self.formulas, "commands": self.commands}
        parts = []
        for cell in book.cells:
            if cell.cell_type == "markdown":
                parts.append(self.markdown(cell.source, cell.get("attachments", {})))
            elif cell.cell_type == "code":
                if shows_input(cell, self.code) == "open":
                    parts.append(f'<pre class="python">{html.escape(_folded(cell.source))}</pre>')
                parts += [self.output(output, cell.metadata.get("alt")) for output in cell.outputs]
        with tempfile.TemporaryDirectory() as media:  # images inside Markdown
            text = pypandoc.convert_text("\n".join(parts), "typst", "html",
                                         ["--wrap=none", f"--extract-media={media}"])
            self.files |= {file.name: file.read_bytes() for file in Path(media).iterdir()}
        text = text.replace(f'"{media}/', '"')
        self.texts.append((source.name, re.sub("[\ue000-\ue003]", "", text), book))
        text = re.sub(r"align: \([a-z,]*\)", lambda align: align[0].replace("auto", "left"), text)
        text = REFERENCES.sub(r"\1#references[\n\2\n]\n", text)
        return re.sub(r"^= (\d+|[A-Z])\.", r'#show: chapter.with("\1")\n\g<0>', text, count=1)

    def markdown(self, text, attachments=()):
        """Return Markdown (str) as HTML with marks."""
        return markdown_html(text, self.page, attachments, _Renderer)

    def output(self, output, alt):
        """Return an output in HTML, by the best kind that it has; `alt` describes a picture."""
        data = output.get("data", {"text/plain": output.get("text", "")})
        kind = next((kind for kind in OUTPUT_KINDS if kind in data), None)
        if kind in PICTURES:
            figures = self.page["figures"]
            figures.append(kind)
            name = f"picture-{len(self.commands)}.{PICTURES[kind]}"
            alt = alt or f"Figure {len(figures)} of this chapter"
            self.files[name] = (compressed(data[kind]).encode() if "svg" in kind
                                else base64.b64decode(data[kind]))
            command = f"#picture({typst_string(name)}, {typst_string(alt)});"
            return f"<p>{_command_mark(self.page, command)}</p>"
        if kind in ("text/markdown", "text/latex"):
            return self.markdown(data[kind])
        if kind == "text/plain":
            text = html.escape(_folded(strip_ansi(data[kind])))
            return f"<pre>{text}</pre>" if self.code != "none" else ""
        return sanitized(data.get(kind, ""), self.page["notebook"], self.page["section"])


def _command_mark(page, command):
    """Return the mark for a command of Typst (str), which is added to those of `page` (dict)."""
    page["commands"].append(command)
    return f"\ue002{len(page['commands']) - 1}\ue003"


class _Renderer(Renderer):
    """Converts Markdown to HTML for pandoc, with Typst labels and with marks for commands."""

    def heading(self, text, level, **_):
        is_title = level == 1 and not self.page["headings"]
        self.page["headings"].append(text)
        anchor = self.begin_section(text)
        label = _label(self.page["notebook"], "" if is_title else anchor)
        return f'<h{level} id="{label}">{text}</h{level}>\n'

    def paragraph(self, text):
        if anchor := self.caption_anchor(text):
            label = _label(self.page["notebook"], anchor)
            return f"<p>{self.command('#caption[')}{text}{self.command(f'] <{label}>')}</p>\n"
        if text.rstrip().endswith(":"):
            return f"<p>{self.command('#announcing[')}{text}{self.command(']')}</p>\n"
        return super().paragraph(text)

    def command(self, command):
        """Return the mark for a command of Typst (str)."""
        return _command_mark(self.page, command)

    def block_quote(self, text):
        if not ANSWER.match(text):
            return super().block_quote(text)
        return f"<p>{self.command('#answer[')}</p>\n{text}<p>{self.command(']')}</p>\n"

    def link(self, text, url, title=None):
        if re.match(r"(https?|mailto):", url):
            return super().link(text, url, title)
        if not (inside := INTERNAL.fullmatch(url)):  # a file that does not come with the PDF
            return text
        label = _label(unquote(inside[1] or self.page["notebook"]), unquote(inside[2] or ""))
        return f'<a href="#{label}">{text}</a>'
