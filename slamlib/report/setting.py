"""Sets documents with Typst, whose wheel needs no network and brings all fonts of the PDF."""

import json
import re
from functools import partial
from pathlib import Path

import typst

from slamlib.report.execution import NotebookError

ATTEMPTS = 6  # of setting the document, until all figures stay where they are
PLACES = "places.json"  # what the attempts came to
UNKNOWN = {"final": False, "sizes": {}}  # of each figure and table, by its number
typst_string = partial(json.dumps, ensure_ascii=False)  # a string of Typst


def compiled(folder, book):
    """Return the PDF as bytes. Typst is called again until figures and tables stay in place.

    `folder` (Path) has the files of a document with `main.typ`, and `book` (pdf.Book) the formulas
    that must be in it. NotebookError if one is not, or if Typst refuses the document.
    """
    places = UNKNOWN
    for attempt in range(ATTEMPTS):
        Path(folder, PLACES).write_text(json.dumps(places))
        compiler = typst.Compiler(folder / "main.typ", root=folder, ignore_system_fonts=True)
        try:
            content, warnings = compiler.compile_with_warnings(format="pdf", timestamp=0)
            found = set(json.loads(compiler.query("math.equation", field="label")))
            placed = json.loads(compiler.query("metadata", field="value"))
        except typst.TypstError as error:
            raise _typst_error(error, book) from None
        if not any("did not converge" in warning.message for warning in warnings):
            break
        sizes = {str(each["number"]): each["size"] for each in placed
                 if isinstance(each, dict)}
        places = {"final": sizes == places["sizes"] or attempt + 2 == ATTEMPTS, "sizes": sizes}
    for formula, label in zip(book.formulas, book.labels, strict=True):
        if f"<{label}>" not in found:
            raise formula.error("the PDF lost this formula")
    return content


def _typst_error(error, book):
    """Return the NotebookError for an error of Typst."""
    if line := re.search(r"formulas\.typ:(\d+):", error.diagnostic):  # formula 0 is on line 2
        return book.formulas[int(line[1]) - 2].error(
            f"Typst cannot set this formula, {error.message}")
    return NotebookError("Typst cannot set the PDF: "
                         f"{error.message}: {error.diagnostic.strip()}")


def missing_glyphs(text):
    """Return the characters (list of str) of a text (str) that no font of the PDF has."""
    def any_missing(characters):  # drawn like U+10FFFD, which is not a character
        source = "\n".join(f'#box({typst_string(c)})' for c in ["\U0010fffd", *characters])
        pages = typst.compile(source.encode(), format="svg", ignore_system_fonts=True)
        missing, *glyphs = re.findall(r'<use [^>]*href="#(\w+)"', b"".join(
            [pages] if isinstance(pages, bytes) else pages).decode())
        return missing in glyphs

    characters = sorted({c for c in text if not c.isascii()})
    return [c for c in characters if any_missing([c])] if any_missing(characters) else []
