"""The report as one PDF: pandoc writes Typst, the typst wheel sets it; neither needs a network.

Cells and outputs become HTML by the renderer of the pages, with marks (private characters) where
Typst is to set a formula, a figure or a caption; pandoc turns the HTML into Typst, where the marks
are replaced. Typst is then asked which formulas the document holds that it made: all must be there.
"""

import base64
import hashlib
import html
import json
import re
import tempfile
import textwrap
from pathlib import Path

import pypandoc
import typst
from nbconvert.filters import strip_ansi
from nbconvert.filters.markdown_mistune import MarkdownWithMath

from slamlib.execution import NotebookError
from slamlib.formulas import set_formulas
from slamlib.numbering import CAPTION, TAG
from slamlib.pages import MARK, Renderer, refusal

TEMPLATE = Path(__file__).with_name("report_pdf.typ")
PICTURES = {"image/svg+xml": "svg", "image/png": "png", "image/jpeg": "jpg"}
TEXTS = ("text/markdown", "text/latex", "text/html", "text/plain")
COLUMNS = 96                                          # of code, that the page is wide
LONG = 36                                             # lines of a table that may be broken
PICTURE = re.compile("\ue002(\\d+)\ue003")
TABLE = re.compile("#figure\\(\n(?:(?!#figure\\().)*?, kind: table\n  \\)(?=\\s*\ue004)", re.DOTALL)
CAPTIONED = re.compile("\ue002(\\d+)\ue003\\s*\ue004(.*?)\ue006(.*?)\ue005", re.DOTALL)  # with its picture
CAPTIONS = re.compile("\ue004(.*?)\ue006(.*?)\ue005", re.DOTALL)
SCALED = re.compile(r"#scale\(x: (\d+)%, y: \d+%\)\[(\\?[^\\]|\\\])\]")  # pandoc's \big, \Big, ...
REWRITTEN = [(re.compile(pattern), becomes) for pattern, becomes in (  # pandoc would set it wrongly
    (r"\\!", ""), (r"\\;", r"\\:"),
    (r"\\([bB]igg?[lrm]?|left|right)\s*(?=\\[lr]?[vV]ert(?![a-zA-Z])|\\\|)", ""),
    (r"\\lvert(?![a-zA-Z])", r"\\left\\lvert"), (r"\\rvert(?![a-zA-Z])", r"\\right\\rvert"))]


def typeset(chapters, opening=None, code=True, **cover):
    """The PDF of chapters, with title page and contents, as bytes; equal input gives equal bytes.

    Parameters
    ----------
    chapters : list of (Path, NotebookNode), executed; links name chapters by their file names.
    opening : NotebookNode, what stands before them without numbers, if anything.
    code : False leaves out code cells and printed text.
    cover : title, author, student_number, course: str; what the title page says.

    Raises
    ------
    NotebookError : a formula is lost or cannot be set, or Typst refuses the document.
    """
    files, book = typst_files(chapters, opening, code, **cover)
    for name, text in book.texts:
        if missing := without_glyph(text):
            raise NotebookError(f"{name}: the PDF's fonts have no glyph for {missing[0]} "
                                f"(U+{ord(missing[0]):04X}): ..." + re.search(
                                    f".{{0,30}}{missing[0]}.{{0,30}}", text)[0] + "...")
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            Path(folder, name).write_bytes(content)
        return _compile(Path(folder), book)


def typst_files(chapters, opening=None, code=True, **cover):
    """What Typst makes the PDF from, as `typeset`: {file name: bytes}; and the book it is of."""
    book = _Book(code)
    parts = [book.chapter(*chapter) for chapter in chapters]
    if opening is not None:
        parts.insert(0, f"#unnumbered[\n{book.chapter(Path('index'), opening)}\n]")
    text = "\n#chapter-ends()\n".join(parts)
    formulas = book.set_formulas()
    if lost := set(range(len(formulas))) - {int(mark[1]) for mark in MARK.finditer(text)}:
        raise book.refusal(min(lost), "the PDF would lose this formula")
    text = TABLE.sub(lambda table: f"#kept[{table[0]}]" if table[0].count("\n") < LONG else table[0], text)
    text = MARK.sub(r"#formula-\1;\2", text)
    text = CAPTIONED.sub("#floating[\ue002\\1\ue003 \ue004\\2\ue006\\3\ue005]", text)
    text = PICTURE.sub(lambda mark: "#picture({}, {});".format(*book.pictures[int(mark[1])]), text)
    text = CAPTIONS.sub(r"#caption[\2] <\1>", text)
    text = text.replace("\ue007", "#announcing[").replace("\ue008", "]")
    cover = ", ".join(f"{name}: {_quoted(value)}" for name, value in cover.items())
    text = (f'#import "{TEMPLATE.name}": *\n#import "formulas.typ": *\n'
            f"#show: report.with({cover})\n{text}\n")
    formulas = [f'#import "{TEMPLATE.name}": display', *formulas]  # the others have a line each
    return {TEMPLATE.name: TEMPLATE.read_bytes(), "main.typ": text.encode(),
            "formulas.typ": "\n".join(formulas).encode(), **book.files}, book


def _compile(folder, book):
    compiler = typst.Compiler(folder / "main.typ", root=folder, ignore_system_fonts=True)
    try:
        content = compiler.compile(format="pdf", timestamp=0)
        found = set(json.loads(compiler.query("math.equation", field="label")))
    except typst.TypstError as error:
        line = re.search(r"formulas\.typ:(\d+):", error.diagnostic)
        if line:
            raise book.refusal(int(line[1]) - 2, f"Typst cannot set this formula, {error.message}") from None
        raise NotebookError(f"Typst cannot set the PDF: {error.message}: {error.diagnostic.strip()}") from None
    for number, label in enumerate(book.labels):
        if f"<{label}>" not in found:
            raise book.refusal(number, "the PDF lost this formula")
    return content


def without_glyph(text):
    """The characters of a text that no font of the PDF has: Typst would set an empty box for them."""
    def any_boxes(characters):  # drawn like U+10FFFD, which is no character
        source = "\n".join(f'#box({_quoted(c)})' for c in ["\U0010fffd", *characters])
        pages = typst.compile(source.encode(), format="svg", ignore_system_fonts=True)
        box, *glyphs = re.findall(r'<use [^>]*href="#(\w+)"', b"".join(
            [pages] if isinstance(pages, bytes) else pages).decode())
        return box in glyphs

    characters = sorted({c for c in text if not c.isascii()})
    return [c for c in characters if any_boxes([c])] if any_boxes(characters) else []


def _rewritten(tex):
    for pattern, becomes in REWRITTEN:
        tex = pattern.sub(becomes, tex)
    return tex


def _folded(text):
    """Text of which lines that are wider than the page go on in the next line."""
    fold = textwrap.TextWrapper(COLUMNS, drop_whitespace=False, replace_whitespace=False, expand_tabs=False,
                                break_on_hyphens=False)
    return "\n".join("\n↪ ".join(fold.wrap(line)) for line in text.split("\n"))


def _quoted(text):
    return json.dumps(text, ensure_ascii=False)


def _label(file, anchor=""):
    """A label for Typst; all letters that an anchor of Jupyter may have would be too many."""
    return "at-" + hashlib.sha1(f"{file}#{anchor}".encode()).hexdigest()[:12]


class _Book:
    """Chapters on their way to Typst, and what is gathered from them.

    `files` are of pictures; `pictures` their names and descriptions, quoted; `texts` are the chapters by
    file name, without marks; `page` is what the renderer fills: formulas (TeX, display), and by their
    number the file, section, label and tag of each.
    """

    def __init__(self, code):
        self.code, self.files, self.pictures, self.texts = code, {}, [], []
        self.page = {"formulas": [], "labels": {}, "tags": {}, "headings": [], "links": [], "sources": [],
                     "sections": []}

    @property
    def labels(self):
        """The label of each formula in Typst: its anchor's, where it is numbered."""
        return [self.page["labels"].get(number, f"formula-{number}")
                for number in range(len(self.page["formulas"]))]

    def refusal(self, number, reason):
        """The error for a formula."""
        return refusal(self.page["sources"][number], self.page, number, reason)

    def chapter(self, source, book):
        """A chapter in Typst, with marks."""
        self.page |= {"file": source.stem, "anchors": {}, "path": source.parent, "section": "",
                      "titled": False}
        parts, pictures = [], len(self.pictures)
        for cell in book.cells:
            if cell.cell_type == "markdown":
                parts.append(self.markdown(cell.source, cell.get("attachments", {})))
            elif cell.cell_type == "code":
                if self.code and cell.source.strip():
                    parts.append(f'<pre class="python">{html.escape(_folded(cell.source))}</pre>')
                alt = cell.metadata.get("alt")
                parts += [self.output(output, alt, pictures) for output in cell.outputs]
        self.page["sources"] += [source.name] * (
            len(self.page["formulas"]) - len(self.page["sources"]))
        with tempfile.TemporaryDirectory() as media:  # of images inside Markdown
            text = pypandoc.convert_text("\n".join(parts), "typst", "html",
                                         ["--wrap=none", f"--extract-media={media}"])
            self.files |= {file.name: file.read_bytes() for file in Path(media).iterdir()}
        text = text.replace(f'"{media}/', '"')
        self.texts.append((source.name, re.sub("[\ue000-\ue008]", "", text)))
        text = re.sub(r"align: \([a-z,]*\)", lambda align: align[0].replace("auto", "left"), text)
        return re.sub(r"^= (\d+)\.", r"#counter(heading).update(\1 - 1)\n\g<0>", text, count=1)

    def markdown(self, text, attachments=()):
        """Markdown to HTML with marks."""
        renderer = _Renderer(escape=False, embed_images=True, path=str(self.page["path"]),
                             attachments=dict(attachments))
        renderer.page = self.page
        return MarkdownWithMath(renderer=renderer).render(text)

    def output(self, output, alt, before):
        """An output in HTML: the first kind there is of pictures, then of texts."""
        data = output.get("data", {"text/plain": output.get("text", "")})
        for kind, suffix in PICTURES.items():
            if kind in data:
                name = f"picture-{len(self.pictures)}.{suffix}"
                alt = alt or f"Figure {len(self.pictures) - before + 1} of this chapter"
                self.files[name] = (data[kind].encode() if suffix == "svg"
                                    else base64.b64decode(data[kind]))
                self.pictures.append((_quoted(name), _quoted(alt)))
                return f"<p>\ue002{len(self.pictures) - 1}\ue003</p>"
        kind = next((kind for kind in TEXTS if kind in data), None)
        if kind in ("text/markdown", "text/latex"):
            return self.markdown(data[kind])
        if kind == "text/html":
            return data[kind]
        return f"<pre>{html.escape(_folded(strip_ansi(data[kind])))}</pre>" if kind and self.code else ""

    def set_formulas(self):
        """A line of Typst for each formula, which defines it: all in one call of pandoc."""
        formulas = [(_rewritten(tex), display) for tex, display in self.page["formulas"]]
        return [self._line(*numbered)
                for numbered in enumerate(set_formulas(formulas, "typst", [], self.refusal))]

    def _line(self, number, formula):
        """A formula's definition, mended, on one line."""
        tex, display = self.page["formulas"][number]
        formula = SCALED.sub(lambda big: f"stretch({big[2]}, size: #{int(big[1]) / 100}em)",
                             " ".join(formula.split()))
        if "\\parallel" not in tex:  # but \| or \Vert, which are no relations
            formula = formula.replace("parallel", "bar.v.double")
        formula = f"{formula}<{self.labels[number]}>"
        if "\\dfrac" in tex:
            formula = f"#show math.frac: math.display; {formula}"
        elif "\\tfrac" in tex and "\\frac" not in tex:
            formula = f"#show math.frac: math.inline; {formula}"
        if display:
            formula = f"#display({_quoted(self.page['tags'].get(number, ''))})[{formula}]"
        return f"#let formula-{number} = [{formula}]"


class _Renderer(Renderer):
    """Markdown to HTML for pandoc, with our labels, and with marks for formulas, for captions and for
    paragraphs that end with a colon."""

    def block_math(self, body):
        mark = self.inline_math(TAG.sub("", body, count=1), display=True)
        if tag := TAG.search(body):
            number, tag = len(self.page["formulas"]) - 1, tag[1].strip()
            self.page["tags"][number] = f"({tag})"
            self.page["labels"][number] = _label(self.page["file"], self.anchor(f"eq-{tag}"))
        return mark

    def heading(self, text, level, **_):
        anchor = self.named(text)
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

    def link(self, text, url, title=None):
        if re.match(r"(https?|mailto):", url):
            return super().link(text, url, title)
        inside = re.fullmatch(r"(?:([^:/#]+)\.ipynb)?(?:#(.+))?", url)
        if not inside:  # a file, which does not come with the PDF
            return text
        return f'<a href="#{_label(inside[1] or self.page["file"], inside[2] or "")}">{text}</a>'
