"""HTML pages of executed notebooks, which need no script and no network.

nbconvert, `report_page.html` and `report_style.css` make the page; pandoc sets its formulas from
TeX to MathML.
"""

import html
import re
import sys
import xml.etree.ElementTree as ElementTree
from functools import cache, partial
from pathlib import Path
from urllib.parse import quote, unquote

from jinja2 import pass_context
from nbconvert import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath

from slamlib.execution import NotebookError
from slamlib.formulas import set_formulas
from slamlib.numbering import CAPTION, TAG

PAGE = Path(__file__).with_name("report_page.html").read_text(encoding="utf-8")
STYLE = Path(__file__).with_name("report_style.css").read_text(encoding="utf-8")
MARK = re.compile("\ue000(\\d+)\ue001([.,;:!?)]*)")  # a formula, until pandoc has set it
INSIDE = re.compile(r"([^:/#]+\.ipynb)?(?:#(.+))?")  # a link from one notebook to another, or to a place
ACCENTS = {"\u0302": "^", "\u0303": "~", "\u0307": "\u02d9", "\u0308": "\u00a8"}
UPRIGHT = {bold: bold - 104 for bold in range(0x1D468, 0x1D49C)}  # bold italic letters to bold
LOADED = re.compile(r"<(?:script|link|iframe|object|embed|base)\b[^>]*"
                    r"|<[^>]*\s(?:src|srcset|poster|data)\s*=(?![\"']?data:)[^>]*"
                    r"|@import\b.*|url\((?![\"']?(?:data:|#)).*", re.IGNORECASE)


def chapter_of(source, book):
    """A dict for contents and links: file, title, its number, and first paragraph in Markdown."""
    text = "\n\n".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    title = re.search(r"^#\s+(.+)", text, re.MULTILINE)
    lead = re.search(r"^(?!\s|[#|<>`]|\$\$|[-*+]\s).+(?:\n.+)*", text, re.MULTILINE)
    title = re.sub("[*_`]", "", title[1]).strip() if title else source.stem
    number = re.match(r"(\d+)\.", title)
    return {"file": quote(f"{source.stem}.html"), "notebook": source.name, "title": title,
            "lead": lead[0] if lead else "", "number": number[1] if number else None}


def html_pages(books, chapters, code=True):
    """The HTML pages of executed books and the index, as text, in a dict by their file names.

    Raises NotebookError for what a page would lose, load or link to in vain; parameters as `html_page`.
    """
    anchors, links, pages = {}, [], {}
    for source, book in books.items():
        pages[f"{source.stem}.html"], page = html_page(source, book, chapters, code)
        anchors[source.name] = {"", *page["anchors"]}
        links += [(source.name, *link) for link in page["links"]]
    for name, text, target, anchor in links:
        if target not in anchors:
            _tell_once(f"{name}: there is no {target}: '{text}' is no link")
        elif anchor not in anchors[target]:
            raise NotebookError(f"{name}: there is no #{anchor} in {target}, where '{text}' leads")
    return pages


@cache
def _tell_once(sentence):
    print(sentence, file=sys.stderr)


def html_page(source, book, chapters, code=True):
    """The HTML page of one executed book, or of the index, as text; and what was found on the way.

    Parameters
    ----------
    source, book : Path and NotebookNode.
    chapters : list of dicts by `chapter_of`, for the contents.
    code : False leaves out code cells and printed text.
    """
    page = {"formulas": [], "sections": [], "section": "", "headings": [], "anchors": {}, "links": [],
            "figures": [], "chapters": chapters, "code": code, "file": quote(f"{source.stem}.html"),
            "notebook": source.name, "style": STYLE}
    exporter = HTMLExporter(template_name="basic", raw_template=PAGE,
                            filters={"markdown2html": _markdown_to_html})
    text, resources = exporter.from_notebook_node(
        book, {"metadata": {"path": str(source.parent)}, "page": page})
    page = resources["page"]
    formulas = [_mend(tex, mathml) for (tex, _), mathml in zip(page["formulas"], set_formulas(
        page["formulas"], "html", ["--mathml"], partial(refusal, source.name, page)))]
    keep = '<span class="keep">{}{}</span>'.format
    text = MARK.sub(lambda mark: keep(formulas[int(mark[1])], mark[2]), text)
    if loaded := LOADED.search(text):
        raise NotebookError(f"{source.name}: the page would load something: {loaded[0][:100]}")
    return text, page


def refusal(name, page, number, reason):
    """The error for a formula that was gathered in `page`: notebook, section, reason and TeX."""
    section = page["sections"][number]
    return NotebookError(name + (f", section '{section}'" if section else "")
                         + f": {reason}:\n    {page['formulas'][number][0]}")


@pass_context
def _markdown_to_html(context, source):
    """The filter of this name in the template, by our renderer."""
    renderer = Renderer(escape=False, embed_images=True,
                         path=context["resources"]["metadata"]["path"],
                         attachments=context.get("cell", {}).get("attachments", {}))
    renderer.page = context["resources"]["page"]
    return MarkdownWithMath(renderer=renderer).render(source)


class Renderer(IPythonRenderer):
    """Markdown to HTML; formulas become marks, and are gathered in `page` with the headings."""

    def inline_math(self, body, display=False):
        self.page["formulas"].append((body.strip(), display))
        self.page["sections"].append(self.page["section"])
        return f"\ue000{len(self.page['formulas']) - 1}\ue001"

    def block_math(self, body):
        formula = self.inline_math(TAG.sub("", body, count=1), display=True)
        if not (tag := TAG.search(body)):
            return f'<span class="equation">{formula}</span>'
        tag = html.escape(tag[1].strip())
        return (f'<span class="equation" id="{self.anchor("eq-" + tag)}">{formula}'
                f'<span class="number">({tag})</span></span>')

    def latex_environment(self, name, body):
        return self.block_math(f"\\begin{{{name}}}{body}\\end{{{name}}}")

    def heading(self, text, level, **_):
        anchor = html.escape(self.named(text))
        if level in (2, 3):
            self.page["headings"].append((level, anchor, re.sub("</?a[^>]*>", "", text)))
        return f'<h{level} id="{anchor}">{text}</h{level}>\n'

    def named(self, text):
        """The anchor of a heading, as Jupyter names it; what follows is in this section."""
        self.page["section"] = html.unescape(re.sub("<[^>]*>", "", MARK.sub("", text))).strip()
        return self.anchor(self.page["section"].replace(" ", "-"))

    def anchor(self, name):
        count = self.page["anchors"][name] = self.page["anchors"].get(name, 0) + 1
        return name if count == 1 else f"{name}-{count}"

    def paragraph(self, text):
        if not (caption := CAPTION.match(re.sub("<[^>]*>", "", text))):
            return f"<p>{text}</p>\n"
        anchor = self.anchor(f"{caption[1].lower()}-{caption[2]}")
        return f'<p class="caption" id="{anchor}">{text}</p>\n'

    def link(self, text, url, title=None):
        if inside := INSIDE.fullmatch(url):
            own = self.page["notebook"]
            target = unquote(inside[1] or own)
            self.page["links"].append((text, target, unquote(inside[2] or "")))
            if target not in (own, *(chapter["notebook"] for chapter in self.page["chapters"])):
                return text
        return super().link(text, re.sub(r"^([^:/]+)\.ipynb(?=#|$)", r"\1.html", url), title)


def _mend(tex, mathml):
    """Mend what pandoc sets unlike TeX, or so that browsers misplace it."""
    math = ElementTree.fromstring(re.sub(r'\sxmlns="[^"]*"', "", mathml).strip())
    for element in list(math.iter()):
        last = element[-1] if len(element) else element
        if element.tag == "mo" and element.text == "\u2061":  # applies a function: cos, log
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
