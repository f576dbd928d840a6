"""Makes the report's PDF: pandoc writes Typst, the typst wheel sets it; neither needs a network.

The pages' renderer converts cells and outputs to HTML, with marks (private characters) for
formulas, pictures, captions, answers and paragraphs that end with a colon. pandoc converts the HTML
to Typst, where calls of `report.typ` replace the marks. A query checks that no formula is lost.
"""

import base64
import hashlib
import html
import json
import re
import tempfile
import textwrap
from functools import partial
from itertools import count
from pathlib import Path

import pypandoc
from nbconvert.filters import strip_ansi
from nbconvert.filters.markdown_mistune import MarkdownWithMath

from slamlib.report.chapters import shows_input
from slamlib.report.formulas import set_formulas
from slamlib.report.glyphs import require_glyphs
from slamlib.report.numbering import CAPTION, TAG
from slamlib.report.pages import ANSWER, MARK, Renderer, formula_error
from slamlib.report.sanitize import sanitized
from slamlib.report.setting import PLACES, UNKNOWN, compiled, quoted
from slamlib.report.svg import compact

TEMPLATE = Path(__file__).with_name("report.typ")
PICTURES = {"image/svg+xml": "svg", "image/png": "png", "image/jpeg": "jpg"}
KINDS = (*PICTURES, "text/markdown", "text/latex", "text/html", "text/plain")  # best first
COLUMNS = 96  # width of the page in characters of code
TABLE = re.compile("#figure\\(\n(?:(?!#figure\\().)*?, kind: table\n  \\)"
                   "\\s*\ue004(.*?)\ue006(.*?)\ue005", re.DOTALL)
NAME_ONLY = re.compile(
    r"^    \[((?:(?!\], ).)+)\](?:, (?:table\.cell\([^)]*\))?\[\])+,$", re.MULTILINE)
PICTURE = re.compile("\ue002(\\d+)\ue003")
CAPTIONED = re.compile("\ue002(\\d+)\ue003\\s*\ue004(.*?)\ue006(.*?)\ue005", re.DOTALL)
CAPTIONS = re.compile("\ue004(.*?)\ue006(.*?)\ue005", re.DOTALL)
REFERENCES = re.compile(r"^(== References\n<[\w-]+>\n)((?:(?!== ).*\n)+)\Z", re.MULTILINE)
STAYS = re.compile(r"(?:^=+ .*\n<[\w-]+>|\ue008)\s*\n#placed\(\ue009, \"\w+\",", re.MULTILINE)
SCALED = re.compile(r"#scale\(x: (\d+)%, y: \d+%\)\[(\\?[^\\]|\\\])\]")  # pandoc's \big, \Big, ...
REPLACED = [(re.compile(pattern), replacement) for pattern, replacement in (
    # TeX that pandoc sets wrongly
    (r"\\!", ""), (r"\\;", r"\\:"),
    (r"\\([bB]igg?[lrm]?|left|right)\s*(?=\\[lr]?[vV]ert(?![a-zA-Z])|\\\|)", ""),
    (r"\\lvert(?![a-zA-Z])", r"\\left\\lvert"), (r"\\rvert(?![a-zA-Z])", r"\\right\\rvert"))]
COMMANDS = {"\ue007": "#announcing[", "\ue008": "]", "\ue00a": "#answer[", "\ue00b": "]"}


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
    require_glyphs(book, KINDS, files["formulas.typ"].decode().split("\n")[1:])  # below an import
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            Path(folder, name).write_bytes(content)
        return compiled(Path(folder), book)


def typst_files(chapters, opening=None, code="method", picture=None, **cover):
    """Return the files for Typst as {name: bytes}, and their _Book; parameters as `typeset`."""
    book = _Book(code)
    parts = [book.chapter(*chapter) for chapter in chapters]
    if opening is not None:
        parts.insert(0, f"#unnumbered[\n{book.chapter(Path('index'), opening)}\n]")
    text = "\n#chapter-ends()\n".join(parts)
    formulas = book.formula_definitions()
    if lost := set(range(len(formulas))) - {int(mark[1]) for mark in MARK.finditer(text)}:
        raise book.error(min(lost), "the PDF would lose this formula")
    text = TABLE.sub(_table, text)
    text = MARK.sub(r"#formula-\1;\2", text)
    text = CAPTIONED.sub(
        lambda figure: "#placed(\ue009, \"figure\", size => [#picture({}, {}, shrink: size)".format(
            *book.pictures[int(figure[1])])
        + f" \ue004{figure[2]}\ue006{figure[3]}\ue005])", text)
    text = STAYS.sub(r"\g<0> stays: true,", text)
    text = re.sub("^(?=== )", "#section(\ue009)\n", text, flags=re.MULTILINE)
    number = count()
    text = re.sub("\ue009", lambda _: str(next(number)), text)
    text = PICTURE.sub(lambda mark: "#picture({}, {});".format(*book.pictures[int(mark[1])]), text)
    text = CAPTIONS.sub(r"#caption[\2] <\1>", text)
    for mark, command in COMMANDS.items():
        text = text.replace(mark, command)
    if picture:
        book.files["title.svg"] = compact(picture).encode()
        cover["picture"] = "title.svg"
    lines = ", ".join(f"{name}: {quoted(value)}" for name, value in cover.items())
    text = (f'#import "{TEMPLATE.name}": *\n#import "formulas.typ": *\n'
            f"#show: report.with({lines})\n{text}\n")
    definitions = "\n".join([f'#import "{TEMPLATE.name}": display', *formulas])
    return {TEMPLATE.name: TEMPLATE.read_bytes(), "main.typ": text.encode(),
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
    return f"#placed(\ue009, \"table\", _ => [{head}{rule}{rows}])"


def _folded(text):
    """Return text whose lines are folded at the width of the page."""
    fold = textwrap.TextWrapper(COLUMNS, drop_whitespace=False, replace_whitespace=False,
                                expand_tabs=False, break_on_hyphens=False)
    return "\n".join("\n↪ ".join(fold.wrap(line)) for line in text.split("\n"))


def _label(file, anchor=""):
    """Return a Typst label for an anchor, which may have characters that labels must not have."""
    return "at-" + hashlib.sha1(f"{file}#{anchor}".encode()).hexdigest()[:12]


class _Book:
    """Chapters in Typst, and what they refer to.

    `files` are the pictures as {name: bytes}; `pictures` their quoted names and descriptions;
    `texts` the chapters: file name, text without marks and NotebookNode. The renderer collects in
    `page` the formulas (TeX, display), and the notebook, section, label and tag of each.
    """

    def __init__(self, code):
        self.code, self.files, self.pictures, self.texts = code, {}, [], []
        self.page = {"formulas": [], "sections": [], "labels": {}, "tags": {}}
        self.error = partial(formula_error, self.page)

    @property
    def labels(self):
        """The Typst label of each formula: that of its anchor if it has a number."""
        return [self.page["labels"].get(number, f"formula-{number}")
                for number in range(len(self.page["formulas"]))]

    def chapter(self, source, book):
        """Return a chapter (Path, NotebookNode) in Typst, with marks."""
        self.page |= {"notebook": source.name, "file": source.stem, "path": source.parent,
                      "anchors": {}, "section": "", "titled": False}
        parts, first = [], len(self.pictures)
        for cell in book.cells:
            if cell.cell_type == "markdown":
                parts.append(self.markdown(cell.source, cell.get("attachments", {})))
            elif cell.cell_type == "code":
                if shows_input(cell, self.code) == "open":
                    parts.append(f'<pre class="python">{html.escape(_folded(cell.source))}</pre>')
                alt = cell.metadata.get("alt")
                parts += [self.output(output, alt, first) for output in cell.outputs]
        with tempfile.TemporaryDirectory() as media:  # images inside Markdown
            text = pypandoc.convert_text("\n".join(parts), "typst", "html",
                                         ["--wrap=none", f"--extract-media={media}"])
            self.files |= {file.name: file.read_bytes() for file in Path(media).iterdir()}
        text = text.replace(f'"{media}/', '"')
        self.texts.append((source.name, re.sub("[\ue000-\ue00b]", "", text), book))
        text = re.sub(r"align: \([a-z,]*\)", lambda align: align[0].replace("auto", "left"), text)
        text = REFERENCES.sub(r"\1#references[\n\2\n]\n", text)
        return re.sub(r"^= (\d+|[A-Z])\.", self._numbered, text, count=1)

    @staticmethod
    def _numbered(title):
        """Return the beginning of a chapter's title (Match) with the number of its sections."""
        if title[1].isdigit():
            return f"#counter(heading).update({title[1]} - 1)\n{title[0]}"
        return (f"#counter(heading).update({ord(title[1]) - ord('A')})\n"
                f"#set heading(numbering: lettered)\n{title[0]}")

    def markdown(self, text, attachments=()):
        """Return Markdown (str) as HTML with marks."""
        renderer = _Renderer(escape=False, embed_images=True, path=str(self.page["path"]),
                             attachments=dict(attachments))
        renderer.page, section = self.page, self.page["section"]
        return self.sanitized(MarkdownWithMath(renderer=renderer).render(text), section)

    def sanitized(self, text, section):
        """Return HTML (str) of a cell as pages show it: pandoc would load what it names."""
        return sanitized(text, self.page["notebook"], section)

    def output(self, output, alt, first):
        """Return an output in HTML by the best of KINDS that it has.

        `alt` describes a picture (str or None); `first` is the index of the chapter's first one.
        """
        data = output.get("data", {"text/plain": output.get("text", "")})
        kind = next((kind for kind in KINDS if kind in data), None)
        if kind in PICTURES:
            number = len(self.pictures)
            name = f"picture-{number}.{PICTURES[kind]}"
            alt = alt or f"Figure {number - first + 1} of this chapter"
            self.files[name] = (compact(data[kind]).encode() if "svg" in kind
                                else base64.b64decode(data[kind]))
            self.pictures.append((quoted(name), quoted(alt)))
            return f"<p>\ue002{number}\ue003</p>"
        if kind in ("text/markdown", "text/latex"):
            return self.markdown(data[kind])
        if kind == "text/plain":
            text = html.escape(_folded(strip_ansi(data[kind])))
            return f"<pre>{text}</pre>" if self.code != "none" else ""
        return self.sanitized(data.get(kind, ""), self.page["section"])

    def formula_definitions(self):
        """Return for each formula a line of Typst (str) that defines it."""
        formulas = []
        for tex, display in self.page["formulas"]:
            for pattern, replacement in REPLACED:
                tex = pattern.sub(replacement, tex)
            formulas.append((tex, display))
        return [self._definition(*numbered)
                for numbered in enumerate(set_formulas(formulas, "typst", [], self.error))]

    def _definition(self, number, formula):
        """Return a formula's definition on one line, with what pandoc sets unlike TeX corrected."""
        tex, display = self.page["formulas"][number]
        formula = SCALED.sub(lambda big: f"stretch({big[2]}, size: #{int(big[1]) / 100}em)",
                             " ".join(formula.split()))
        if "\\parallel" not in tex:  # pandoc sets \| and \Vert as this relation, too
            formula = formula.replace("parallel", "bar.v.double")
        formula = f"{formula}<{self.labels[number]}>"
        if "\\dfrac" in tex:
            formula = f"#show math.frac: math.display; {formula}"
        elif "\\tfrac" in tex and "\\frac" not in tex:
            formula = f"#show math.frac: math.inline; {formula}"
        if display:
            formula = f"#display({quoted(self.page['tags'].get(number, ''))})[{formula}]"
        return f"#let formula-{number} = [{formula}]"


class _Renderer(Renderer):
    """Converts Markdown to HTML for pandoc, with Typst labels and with all marks of this module."""

    def block_math(self, body):
        mark = self.inline_math(TAG.sub("", body, count=1), display=True)
        if tag := TAG.search(body):
            number, tag = len(self.page["formulas"]) - 1, tag[1].strip()
            self.page["tags"][number] = f"({tag})"
            self.page["labels"][number] = _label(self.page["file"], self.anchor(f"eq-{tag}"))
        return mark

    def heading(self, text, level, **_):
        anchor = self.begin_section(text)
        if level == 1 and not self.page["titled"]:
            self.page["titled"], anchor = True, ""
        return f'<h{level} id="{_label(self.page["file"], anchor)}">{text}</h{level}>\n'

    def paragraph(self, text):
        if caption := CAPTION.match(re.sub("<[^>]*>", "", text)):
            label = _label(self.page["file"], self.anchor(f"{caption[1].lower()}-{caption[2]}"))
            return f"<p>\ue004{label}\ue006{text}\ue005</p>\n"
        if text.rstrip().endswith(":"):
            return f"<p>\ue007{text}\ue008</p>\n"
        return super().paragraph(text)

    def block_quote(self, text):
        return f"<p>\ue00a</p>\n{text}<p>\ue00b</p>\n" if ANSWER.match(text) else (
            super().block_quote(text))

    def link(self, text, url, title=None):
        if re.match(r"(https?|mailto):", url):
            return super().link(text, url, title)
        internal = re.fullmatch(r"(?:([^:/#]+)\.ipynb)?(?:#(.+))?", url)
        if not internal:  # a file that does not come with the PDF
            return text
        label = _label(internal[1] or self.page["file"], internal[2] or "")
        return f'<a href="#{label}">{text}</a>'
