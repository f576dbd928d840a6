"""Makes HTML pages of executed notebooks, which need no network.

nbconvert makes a page by `page.html` and `page.css`; pandoc converts its formulas to MathML. A page
with an element of class `live` has the script `page.js`, the only one. What comes
from cells is sanitized; besides, each page has a Content-Security-Policy, which allows this script
and the build's own styles only.
"""

import base64
import html
import re
import xml.etree.ElementTree as ElementTree
from hashlib import sha256
from pathlib import Path
from urllib.parse import quote, unquote

from jinja2 import pass_context
from markupsafe import Markup
from nbconvert import HTMLExporter
from nbconvert.filters import Highlight2HTML
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from traitlets.config import Config

from slamlib.report.chapters import shows_input, texts
from slamlib.report.execution import NotebookError
from slamlib.report.formulas import Formula, set_formulas
from slamlib.report.numbering import CAPTION, TAG
from slamlib.report.sanitize import cleaned, print_once, sanitized
from slamlib.report.svg import DRAWN, FAMILY, compressed

PAGE = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
STYLE = Path(__file__).with_name("page.css").read_text(encoding="utf-8")
SCRIPT = Path(__file__).with_name("page.js")  # of moving figures, which stand still without it
SHOWN = ["text/html", "text/markdown", "image/svg+xml", "text/latex", "image/png", "image/jpeg",
         "text/plain"]  # kinds of outputs, the first is preferred
ANSWER = re.compile(r"<p><strong>Answer</strong></p>\n?")  # begins the block quote of an answer
LIVE = re.compile(r'<[^>]*\sclass="(?:[^">]*\s)?live[\s"]')
MARK = re.compile("\ue000(\\d+)\ue001([.,;:!?)]*)")  # stands for a formula until pandoc converts it
INTERNAL = re.compile(r"([^:/#]+\.ipynb)?(?:#(.+))?")  # a link to a notebook or an anchor
IMG = re.compile(r"<img\b", re.IGNORECASE)
ACCENTS = {"\u0302": "^", "\u0303": "~", "\u0307": "\u02d9", "\u0308": "\u00a8"}
UPRIGHT = {letter: letter - 104 for letter in range(0x1D468, 0x1D49C)}  # bold italic to bold
OWN_STYLE = re.compile("<style>(.*?)</style>", re.DOTALL)
CHARSET = '<meta charset="utf-8">'  # the page's first line, which the policy follows
POLICY = ("default-src 'none'; img-src data:; script-src {}; style-src 'unsafe-inline'; "
          "style-src-elem {}; base-uri 'none'; form-action 'none'")  # unsafe-inline: attributes


def html_pages(books, chapters, code="method", whole=None):
    """Return the HTML pages of books (dict from Path to NotebookNode) as {file name: str}.

    `whole` is the same with the sections that `books` leaves out: a link to one is plain text. The
    other parameters are those of `html_page`. NotebookError if a page would lose a formula or load
    something, or if a link has no target.
    """
    absent = {(source.name, anchor) for source, book in (whole or {}).items()
              if source in books for anchor in _anchors(source, book) - _anchors(
                  source, books[source])}
    anchors, links, pages = {}, [], {}
    for source, book in books.items():
        pages[f"{source.stem}.html"], page = html_page(source, book, chapters, code, absent)
        anchors[source.name] = {"", *page["anchors"]}
        links += [(source.name, *link) for link in page["links"]]
    for name, text, target, anchor in links:
        if target not in anchors:
            print_once(f"{name}: there is no {target}, so '{text}' is not a link")
        elif anchor not in anchors[target]:
            raise NotebookError(f"{name}: the link '{text}' leads to #{anchor}, "
                                f"which does not exist in {target}")
    return pages


def html_page(source, book, chapters, code="method", absent=()):
    """Return the HTML page (str) of an executed book, and a dict of what the renderer collected.

    NotebookError if a formula cannot be converted, or if a cell holds what pages cannot show.

    Parameters
    ----------
    source, book : Path and NotebookNode.
    chapters : list of dict by `chapter_of`, for the contents.
    code : one of chapters.CODE_SHOWN; "none" leaves out printed text, too.
    absent : set of (notebook's name, anchor), to which no link is made.
    """
    page = new_page(source, chapters) | {"code": code, "absent": absent}
    text, resources = EXPORTER.from_notebook_node(book, {"page": page})
    page = resources["page"]
    converted = [*zip(page["formulas"], set_formulas(page["formulas"], "html", "--mathml"),
                      strict=True)]
    text = MARK.sub(lambda mark: _with_number(*converted[int(mark[1])], mark[2]), text)
    return _with_policy(text.replace(f"'{DRAWN}'", FAMILY), page["styles"]), page


def markdown_html(text, page, attachments=(), renderer=None):
    """Return Markdown (str) as sanitized HTML with marks.

    Parameters
    ----------
    page : dict in which the renderer collects what it finds, as by `new_page`.
    attachments : dict of a cell.
    renderer : subclass of Renderer, or None for that of pages.
    """
    section = page["section"]
    converter = (renderer or Renderer)(escape=False, embed_images=True, path=page["path"],
                                       attachments=dict(attachments))
    converter.page = page
    return sanitized(MarkdownWithMath(renderer=converter).render(text), page["notebook"], section)


def own_pages(folder):
    """Return the names (set of str) of all pages in a folder (Path) that a build wrote there.

    Each page lists itself, by the name of its file, as the one that is shown; a copy by another
    name does not.
    """
    return {file.name for file in folder.glob("*.html") if file.is_file() and not file.is_symlink()
            and re.search(rf'<nav class="contents" .*<li class="here"><a href="'
                          rf'{re.escape(quote(file.name, errors="replace"))}">',
                          file.read_text(encoding="utf-8", errors="replace"), re.DOTALL)}


def new_page(source, chapters=()):
    """Return the state (dict) of the renderer for a notebook (Path)."""
    return {"formulas": [], "section": "", "headings": [], "anchors": {}, "links": [],
            "figures": [], "chapters": chapters, "absent": (), "styles": [STYLE],
            "path": str(source.parent), "file": quote(f"{source.stem}.html"),
            "notebook": source.name}


def _anchors(source, book):
    """Return the anchors (set of str) of a book's headings, captions and equations."""
    renderer = Renderer(escape=False)
    renderer.page = new_page(source)
    for node, key in texts(book.cells):
        MarkdownWithMath(renderer=renderer).render(node[key])
    return {*renderer.page["anchors"]}


def _with_policy(text, styles):
    """Return a page (str) with its policy, and with the own script if it has an element to move.

    `styles` are the texts (list of str) of its style elements that the build made.
    """
    scripts = []
    if LIVE.search(text) and SCRIPT.exists():
        scripts = [f"\n{SCRIPT.read_text(encoding='utf-8')}"]
        body, end, rest = text.rpartition("</body>")
        text = f"{body}<script>{scripts[0]}</script>\n{end}{rest}"
    policy = POLICY.format(*map(_sources, (scripts, styles)))
    return text.replace(CHARSET, f'{CHARSET}\n<meta http-equiv="Content-Security-Policy" '
                                 f'content="{policy}">', 1)


def _sources(texts):
    """Return the sources (str) of a policy that allow scripts or styles of these texts only."""
    return " ".join(f"'sha256-{base64.b64encode(sha256(text.encode()).digest()).decode()}'"
                    for text in texts) or "'none'"


class Renderer(IPythonRenderer):
    """Converts Markdown to HTML (str) with marks for formulas; collects what it finds in `page`."""

    def inline_math(self, body, display=False, number=""):
        """Return the mark for a formula (TeX, str); `number` is that of a display formula."""
        self.page["formulas"].append(Formula(
            tex=body.strip(), display=display, number=number,
            anchor=self.anchor(f"eq-{number}") if number else "",
            notebook=self.page["notebook"], section=self.page["section"]))
        return f"\ue000{len(self.page['formulas']) - 1}\ue001"

    def block_math(self, body):
        """Return the mark for a display formula, whose tag has its number."""
        tag = TAG.search(body)
        return self.inline_math(TAG.sub("", body, count=1), True, tag[1].strip() if tag else "")

    def latex_environment(self, name, body):
        """Return a LaTeX environment as a display formula."""
        return self.block_math(f"\\begin{{{name}}}{body}\\end{{{name}}}")

    def heading(self, text, level, **_):
        """Return a heading with its anchor; levels 2 and 3 are listed in the contents."""
        anchor = html.escape(self.begin_section(text))
        if level in (2, 3):
            listed = cleaned(re.sub("</?a[^>]*>", "", text))  # a link in a link
            self.page["headings"].append((level, anchor, listed))
        return f'<h{level} id="{anchor}">{text}</h{level}>\n'

    def begin_section(self, text):
        """Return a heading's anchor, as Jupyter names it, and begin its section."""
        self.page["section"] = html.unescape(re.sub("<[^>]*>", "", MARK.sub("", text))).strip()
        return self.anchor(self.page["section"].replace(" ", "-"))

    def anchor(self, name):
        """Return the anchor for a name (str), numbered if the page has it already."""
        count = self.page["anchors"][name] = self.page["anchors"].get(name, 0) + 1
        return name if count == 1 else f"{name}-{count}"

    def paragraph(self, text):
        """Return a paragraph; a caption has an anchor."""
        anchor = self.caption_anchor(text)
        return f'<p class="caption" id="{anchor}">{text}</p>\n' if anchor else f"<p>{text}</p>\n"

    def caption_anchor(self, text):
        """Return the anchor of a paragraph (HTML) that is a caption, or None."""
        caption = CAPTION.match(re.sub("<[^>]*>", "", text))
        return caption and self.anchor(f"{caption[1].lower()}-{caption[2]}")

    def block_html(self, text):
        """Return HTML unchanged; nbconvert parses it to embed pictures, and would close tags."""
        return super().block_html(text) if IMG.search(text) else f"{text.strip()}\n"

    def inline_html(self, text):
        """Return a tag unchanged, but an image as `block_html` does."""
        return super().inline_html(text) if IMG.search(text) else text

    def block_quote(self, text):
        """Return a block quote; the box *Answer* of a chapter has a class."""
        kind = ' class="answer"' if ANSWER.match(text) else ""
        return f"<blockquote{kind}>\n{text}</blockquote>\n"

    def link(self, text, url, title=None):
        """Return a link; a notebook's name becomes its page's, or plain text if there is none."""
        if inside := INTERNAL.fullmatch(url):
            own = self.page["notebook"]
            target = unquote(inside[1] or own)
            if (target, anchor := unquote(inside[2] or "")) in self.page["absent"]:
                return text
            self.page["links"].append((text, target, anchor))
            if target not in (own, *(chapter["notebook"] for chapter in self.page["chapters"])):
                return text
        return super().link(text, re.sub(r"^([^:/]+)\.ipynb(?=#|$)", r"\1.html", url), title)


def _with_number(formula, mathml, punctuation):
    """Return a Formula in HTML (str), with its number beside it and the punctuation behind it."""
    mathml = _mended_mathml(formula.tex, mathml)
    if not formula.display:  # no line break before punctuation
        return f'<span class="keep">{mathml}{punctuation}</span>'
    anchor, number = "", ""
    if formula.number:
        anchor = f' id="{html.escape(formula.anchor)}"'
        number = f'<span class="number">({html.escape(formula.number)})</span>'
    return (f'<span class="equation"{anchor}><span class="keep">{mathml}</span>{number}</span>'
            f"{punctuation}")


def _mended_mathml(tex, mathml):
    """Return pandoc's MathML, corrected where it differs from TeX or browsers misplace it."""
    math = ElementTree.fromstring(re.sub(r'\sxmlns="[^"]*"', "", mathml).strip())
    for element in list(math.iter()):
        last = element[-1] if len(element) else element
        if element.tag == "mo" and element.text == "\u2061":  # function application: cos, log
            element.set("class", "of")
        elif element.get("mathvariant") == "bold-italic" and "\\mathbf" in tex:
            element.text = element.text.translate(UPRIGHT)
        elif element.tag == "mover" and last.text in ACCENTS:
            last.text = ACCENTS[last.text]
            last.set("stretchy", "false" if element[0].tag == "mi" else "true")
        elif element.tag == "munder" and last.text == "\u23df":  # \underbrace, drawn by the style
            element.remove(last)
            element.tag, element.attrib = "mrow", {"class": "brace"}
    return ElementTree.tostring(math, encoding="unicode", short_empty_elements=False)


class _Exporter(HTMLExporter):
    """nbconvert's exporter of pages, without the last step, which parses and writes each again."""

    def from_notebook_node(self, nb, resources=None, **options):
        return super(HTMLExporter, self).from_notebook_node(nb, resources, **options)


@pass_context
def _markdown_to_html(context, text):
    """Convert Markdown with our Renderer; the template's filter `markdown2html`."""
    return markdown_html(text, context["resources"]["page"],
                         context.get("cell", {}).get("attachments", {}))


@pass_context
def _sanitized(context, text):
    """Return HTML of a cell, sanitized unless this build made it; the template's filter."""
    page = context["resources"]["page"]
    if isinstance(text, Markup):  # nothing in a notebook's file can be
        page["styles"] += OWN_STYLE.findall(text)
        return text
    return sanitized(text, page["notebook"], page["section"])


EXPORTER = _Exporter(
    template_name="basic", raw_template=PAGE,
    config=Config({"NbConvertBase": {"display_data_priority": SHOWN}}),
    filters={"markdown2html": _markdown_to_html, "sanitized": _sanitized, "compressed": compressed,
             "shows_input": shows_input,
             "highlight_code": Highlight2HTML(pygments_lexer="ipython3")})
