"""Titles, order and tags of the notebooks: chapters, then appendices, whose numbers are letters.

A title `# 2. Name` makes a chapter, `# A. Name` an appendix. Two tags of a cell change where it is
shown: the code of a cell tagged `hide-input` is folded on the page and not in the PDF; a cell
tagged `html-only` is not in the PDF.
"""

import re
from urllib.parse import quote

from nbformat import NotebookNode

from slamlib.report.execution import NotebookError
from slamlib.solve import SENSORS
from slamlib.textfile import quoted

HIDDEN, HTML_ONLY = "hide-input", "html-only"
NEEDS = (*SENSORS, "truth")  # what a notebook or a section may need
CODE_SHOWN = ("none", "method", "all")  # what code is shown: none, all that is not hidden, or all


def chapter_of(source, book):
    """Return file, notebook, title, number (or None) and lead of a chapter (Path, NotebookNode).

    These are the keys of a dict of str; the number of an appendix is a letter, and the lead is the
    chapter's first paragraph in Markdown.
    """
    text = "\n\n".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    title = re.search(r"^#\s+(.+)", text, re.MULTILINE)
    lead = re.search(r"^(?!\s|[#|<>`]|\$\$|[-*+]\s).+(?:\n.+)*", text, re.MULTILINE)
    title = re.sub("[*_`]", "", title[1]).strip() if title else source.stem
    number = re.match(r"(\d+|[A-Z])\.", title)
    return {"file": quote(f"{source.stem}.html"), "notebook": source.name, "title": title,
            "lead": lead[0] if lead else "", "number": number[1] if number else None}


def is_appendix(chapter):
    """Return True if a chapter, a dict by `chapter_of`, is an appendix."""
    return (chapter["number"] or "").isalpha()


def in_order(books, appendix=True):
    """Return the books (dict from Path to NotebookNode) sorted by name, the appendices last.

    `appendix` False leaves these out.
    """
    def key(source):
        chapter = chapter_of(source, books[source])
        last = is_appendix(chapter)
        return last, chapter["number"] if last else "", source.name

    keys = {source: key(source) for source in books}
    return {source: books[source] for source in sorted(books, key=keys.get)
            if appendix or not keys[source][0]}


def available(drives):
    """Return what the drives (list of (Dataset, Truth or None)) have, a set among NEEDS."""
    return {name for name in SENSORS
            if any(getattr(dataset, name) is not None for dataset, _ in drives)} | {
        "truth" for _, truth in drives if truth is not None}


def needs(source, node):
    """Return the data (str) that a notebook or a cell (NotebookNode) requires, or None.

    The metadata say so, as {"slamlib": {"needs": "uwb"}}. NotebookError, which names the file
    `source` (Path), if it is not among NEEDS.
    """
    need = node.metadata.get("slamlib", {}).get("needs")
    if need is not None and need not in NEEDS:
        raise NotebookError(f"{source.name}: expected needs among {', '.join(NEEDS)} in the "
                            f"metadata, found {quoted(need)}")
    return need


def with_data(books, has):
    """Return the books (dict from Path to NotebookNode) that need nothing but what is in `has`.

    All books are returned if no dataset serves any.
    """
    return {source: book for source, book in books.items()
            if needs(source, book) in {None, *has}} or books


def texts(cells):
    """Yield (dict, key) for each text in Markdown, in cells (list of NotebookNode) and outputs."""
    for cell in cells:
        if cell.cell_type == "markdown":
            yield cell, "source"
        for output in cell.get("outputs", ()):
            if "text/markdown" in output.get("data", {}):
                yield output.data, "text/markdown"


def has_tag(cell, tag):
    """Return True if a cell (NotebookNode) has a tag (str)."""
    return tag in cell.metadata.get("tags", ())


def shows_input(cell, code):
    """Return "open", "folded" or "" (not at all): how a page shows the input of a code cell.

    `code` is one of CODE_SHOWN. The PDF shows what is "open".
    """
    if code == "none" or not cell.source.strip():
        return ""
    return "folded" if code == "method" and has_tag(cell, HIDDEN) else "open"


def printed(book):
    """Return a book (NotebookNode) of the same cells but those that the PDF leaves out."""
    return NotebookNode(book | {"cells": [
        cell for cell in book.cells if not has_tag(cell, HTML_ONLY)]})
