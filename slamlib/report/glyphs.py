"""Characters that the PDF's fonts lack, told with the words around them."""

import re

from slamlib.report.execution import NotebookError
from slamlib.report.setting import missing_glyphs


def require_glyphs(book, kinds, formulas):
    """Raise NotebookError, which quotes the notebook, if the fonts lack a character.

    Parameters
    ----------
    book : pdf._Book
    kinds : kinds of outputs that are shown (tuple of str), of which the PDF takes the first.
    formulas : list of str, the definitions of its formulas in Typst.
    """
    for name, text, notebook in book.texts:
        if missing := missing_glyphs(text):
            section, context = _where(missing[0], notebook, text, kinds)
            raise NotebookError(name + (f", section '{section}'" if section else "")
                                + f": {_no_glyph(missing[0])}: ...{context}...")
    if missing := missing_glyphs("".join(formulas)):
        number = next(n for n, formula in enumerate(formulas) if missing[0] in formula)
        raise book.error(number, f"{_no_glyph(missing[0])} in this formula")


def _no_glyph(character):
    return f"the PDF's fonts have no glyph for {character} (U+{ord(character):04X})"


def _where(character, notebook, text, kinds):
    """Return the section (str) of a character, and the words around it as the notebook has them.

    What cannot be found in the cells of `notebook` (NotebookNode) is quoted from `text`, the Typst.
    """
    section = ""
    for cell in notebook.cells:
        data = [output.get("data", {"text/plain": output.get("text", "")})
                for output in cell.get("outputs", ())]
        outputs = [each[kind] for each in data for kind in kinds if kind in each]
        for shown in (cell.source, *outputs):
            for line in shown.split("\n"):
                heading = cell.cell_type == "markdown" and re.match(r"##+\s+(.*)", line)
                section = heading[1] if heading else section
                if character in line:
                    return section, _around(character, line)
    return "", _around(character, text)


def _around(character, text):
    return re.search(f".{{0,30}}{re.escape(character)}.{{0,30}}", text)[0]
