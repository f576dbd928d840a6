"""Reports characters that the PDF's fonts lack, with the words around them."""

import re

from slamlib.report.execution import NotebookError
from slamlib.report.sanitize import place_of
from slamlib.report.setting import missing_glyphs


def require_glyphs(book, definitions):
    """Raise NotebookError, which quotes the notebook, if the fonts lack a character.

    Parameters
    ----------
    book : pdf.Book
    definitions : list of str, its formulas in Typst.
    """
    for name, text, notebook in book.texts:
        if missing := missing_glyphs(text):
            section, context = _where(missing[0], notebook, text)
            raise NotebookError(
                f"{place_of(name, section)}: {_no_glyph(missing[0])}: ...{context}...")
    if missing := missing_glyphs("".join(definitions)):
        formula = next(formula for formula, definition in zip(book.formulas, definitions)
                       if missing[0] in definition)
        raise formula.error(f"{_no_glyph(missing[0])} in this formula")


def _no_glyph(character):
    return f"the PDF's fonts have no glyph for {character} (U+{ord(character):04X})"


def _where(character, notebook, text):
    """Return the section (str) of a character, and the words around it as the notebook has them.

    What cannot be found in the cells of `notebook` (NotebookNode) is quoted from `text`, the Typst.
    """
    section = ""
    for cell in notebook.cells:
        shown = [cell.source]
        for output in cell.get("outputs", ()):
            data = output.get("data", {"text/plain": output.get("text", "")})
            shown += [text for text in data.values() if isinstance(text, str)]
        for line in "\n".join(shown).split("\n"):
            heading = cell.cell_type == "markdown" and re.match(r"##+\s+(.*)", line)
            section = heading[1] if heading else section
            if character in line:
                return section, _around(character, line)
    return "", _around(character, text)


def _around(character, text):
    return re.search(f".{{0,30}}{re.escape(character)}.{{0,30}}", text)[0]
