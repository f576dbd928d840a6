"""HTML pages of executed notebooks, which need no script and no network.

nbconvert, `report_page.html` and `report_style.css` make the page; pandoc sets its formulas from
TeX to MathML.
"""

import html
import json
import re
import xml.etree.ElementTree as ElementTree
from functools import cache
from pathlib import Path
from urllib.parse import quote

import pypandoc
from jinja2 import pass_context
from nbconvert import HTMLExporter
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath

from slamlib.execution import NotebookError

PAGE = Path(__file__).with_name("report_page.html").read_text(encoding="utf-8")
STYLE = Path(__file__).with_name("report_style.css").read_text(encoding="utf-8")
MARK = re.compile("\ue000(\\d+)\ue001([.,;:!?)]*)")  # a formula, until pandoc has set it
TAG = re.compile(r"\\tag\*?\s*\{([^{}]*)\}")
LOST = re.compile(r"\\(hline|cline|boxed|cancel|color|textcolor)\b|\{array\}\s*\{[^}]*\|")
CAPTION = re.compile(r"\W*(Figure|Table)\s+\d+\W")
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
    return {"file": quote(f"{source.stem}.html"), "title": title, "lead": lead[0] if lead else "",
            "number": number[1] if number else None}


def html_page(source, book, chapters, code=True):
    """The HTML page of one executed book, or of the index, as text.

    Parameters
    ----------
    source, book : Path and NotebookNode.
    chapters : list of dicts by `chapter_of`, for the contents.
    code : False leaves out code cells and printed text.
    """
    page = {"formulas": [], "headings": [], "anchors": {}, "figures": [], "chapters": chapters,
            "code": code, "file": quote(f"{source.stem}.html"), "style": STYLE}
    exporter = HTMLExporter(template_name="basic", raw_template=PAGE,
                            filters={"markdown2html": _markdown_to_html})
    text, resources = exporter.from_notebook_node(
        book, {"metadata": {"path": str(source.parent)}, "page": page})
    formulas = _set_formulas(source.name, resources["page"]["formulas"])
    keep = '<span class="keep">{}{}</span>'.format
    text = MARK.sub(lambda mark: keep(formulas[int(mark[1])], mark[2]), text)
    if loaded := LOADED.search(text):
        raise NotebookError(f"{source.name}: the page would load something: {loaded[0][:100]}")
    return text


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
        plain = html.unescape(re.sub("<[^>]*>", "", MARK.sub("", text))).strip()
        anchor = html.escape(self.anchor(plain.replace(" ", "-")))  # as Jupyter names it
        if level in (2, 3):
            self.page["headings"].append((level, anchor, re.sub("</?a[^>]*>", "", text)))
        return f'<h{level} id="{anchor}">{text}</h{level}>\n'

    def anchor(self, name):
        count = self.page["anchors"][name] = self.page["anchors"].get(name, 0) + 1
        return name if count == 1 else f"{name}-{count}"

    def paragraph(self, text):
        caption = ' class="caption"' if CAPTION.match(re.sub("<[^>]*>", "", text)) else ""
        return f"<p{caption}>{text}</p>\n"

    def link(self, text, url, title=None):
        return super().link(text, re.sub(r"^([^:/]+)\.ipynb(?=#|$)", r"\1.html", url), title)


def _set_formulas(name, formulas):
    """MathML of (TeX, display) pairs: all in one call of pandoc, which takes 0.1 s or more."""
    blocks = []
    for tex, display in formulas:
        if lost := LOST.search(tex):
            raise NotebookError(f"{name}: {lost[0]} would be lost in this formula:\n    {tex}")
        kind = {"t": "DisplayMath" if display else "InlineMath"}
        blocks += [{"t": "Plain", "c": [{"t": "Math", "c": [kind, tex]}]},
                   {"t": "RawBlock", "c": ["html", "\ue000"]}]
    document = json.dumps({"pandoc-api-version": pandoc_api_version(), "meta": {},
                           "blocks": blocks})
    try:
        text = pypandoc.convert_text(document, "html", "json",
                                     ["--mathml", "--wrap=none", "--fail-if-warnings"])
    except RuntimeError as error:
        raise NotebookError(f"{name}: pandoc cannot set a formula:\n{str(error).strip()}") from None
    if text.count("<math") != len(formulas):
        raise NotebookError(f"{name}: of {len(formulas)} formulas pandoc lost some")
    return [_mend(tex, mathml) for (tex, _), mathml in zip(formulas, text.split("\ue000"))]


@cache
def pandoc_api_version():
    """The version that pandoc wants in a document in JSON."""
    return json.loads(pypandoc.convert_text("", "json", "markdown"))["pandoc-api-version"]


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
