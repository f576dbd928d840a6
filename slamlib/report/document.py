"""Makes pages and a PDF of executed notebooks, without a network; equal input gives equal bytes.

pandoc reads one notebook of all chapters, in which all text is in Markdown cells. By report.lua,
which numbers and links, it writes pages by page.html and a document for Typst by report.typ.
"""

import json
import re
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import pypandoc
import typst
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell, new_raw_cell

from slamlib.core.errors import DatasetError
from slamlib.report.execution import LAB_ONLY, NotebookError
from slamlib.report.notebooks import chapter_of

HERE = Path(__file__).parent
TEMPLATES = {"html": "page.html", "typst": "report.typ"}
SHOWN = ("image/svg+xml", "image/png", "image/jpeg", "text/markdown", "text/latex", "text/html",
         "text/plain")  # kinds of outputs, the first is preferred


def render(books, options, has=(), picture="", check=False):
    """Return the files of a report, {name: bytes}: a page for each book, and report.pdf.

    NotebookError if something would be lost: a formula, or what a caption, a reference, a link or a
    picture points to; DatasetError if no section has a number or title that is to be left out.

    Parameters
    ----------
    books : dict from Path to NotebookNode, executed; links name them by their file names.
    options : Options of the title page, and of what is shown of the books.
    has : set of str, what the datasets have; sections that need other data are left out.
    picture : str, an SVG for the title page, or "".
    check : True where the books have no outputs yet: nothing is said of what these may hold.
    """
    settings = asdict(options) | {"has": " ".join(has), "check": check, "beside": str(
        [*books][-1].parent), "picture": "title.svg" if picture else ""}
    text = json.dumps(_merged(books)).encode()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as pool:
        pages = pool.submit(_pandoc, text, "html", folder, settings)
        Path(folder, "title.svg").write_text(picture, encoding="utf-8")
        main = Path(folder, "main.typ")
        main.write_bytes(_pandoc(text, "typst", folder, settings))
        try:
            pdf = typst.compile(main, root=folder, ignore_system_fonts=True, timestamp=0)
        except typst.TypstError as error:
            raise NotebookError(f"Typst cannot set the PDF: {error.message}: "
                                f"{error.diagnostic.strip()}") from None
        pages.result()
        return {f"{source.stem}.html": Path(folder, f"{source.stem}.html").read_bytes()
                for source in books} | {"report.pdf": pdf}


def _pandoc(text, kind, folder, settings):
    """Return what pandoc writes of a notebook (bytes); prints what the filter says."""
    done = subprocess.run(
        [pypandoc.get_pandoc_path(), "--from=ipynb-autolink_bare_uris", "--ipynb-output=all",
         f"--to={kind}", f"--template={HERE / TEMPLATES[kind]}",
         f"--lua-filter={HERE / 'report.lua'}", "--mathml", "--toc", "--wrap=none",
         f"--resource-path={settings['beside']}",
         f"--metadata=options={json.dumps(settings | {'folder': folder})}"],
        input=text, capture_output=True)
    told, refused, reason = done.stderr.decode(errors="replace").partition("refused: ")
    if done.returncode:
        asked = any(place and reason.startswith(place) for place in settings["leave_out"].values())
        raise (DatasetError if asked else NotebookError)(
            reason.strip() if refused else f"pandoc cannot make the report: {told}")
    print(told, file=sys.stderr, end="")
    return done.stdout


def _merged(books):
    """Return one notebook of all books; a cell with the name of each precedes its own."""
    letters = "".join(chapter_of(*each)["letter"] for each in books.items())
    cells = []
    for source, book in books.items():
        cells.append(new_markdown_cell(metadata={"chapter": source.stem}))
        cells += [NotebookNode(part | {"source": _without_absent(part.source, letters)})
                  if part.cell_type == "markdown" else part for cell in book.cells
                  if LAB_ONLY not in cell.metadata.get("tags", ()) for part in _parts(cell)]
    return {"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}


def _parts(cell):
    """Return the code and each output of a cell as cells; code that is folded comes last."""
    if cell.cell_type != "code":
        return [cell]
    code = new_code_cell(cell.source, metadata=cell.metadata)
    outputs = [_shown(output, cell.metadata) for output in cell.outputs]
    return [*outputs, code] if "hide-input" in cell.metadata.get("tags", ()) else [code, *outputs]


def _shown(output, metadata):
    """Return a cell that shows an output by the best kind that it has."""
    data = output.get("data", {})
    kind = next((kind for kind in SHOWN if kind in data), None)
    if kind in ("text/markdown", "text/latex"):
        return new_markdown_cell(data[kind], metadata=metadata)
    if kind == "text/html":
        return new_raw_cell(data[kind], metadata=metadata | {"raw_mimetype": kind})
    if kind:
        output = NotebookNode(output | {"data": {kind: data[kind]}})
    return new_code_cell(metadata=metadata, outputs=[output])


def _without_absent(text, letters):
    """Return Markdown without "(table A.3)" and sentences that begin so, but for these letters."""
    absent = f"(?![{letters} ])[A-Z]"
    label = rf"(?:(?i:figure|table)s?\s+{absent}\.\d+|(?i:appendix)\s+{absent}\b(?!\s+of\b))"
    sentence = rf"(?=[A-Z]){label}(?:(?!\n\n).)*?[.?!]"
    return re.sub(rf"\s*\({label}\)|(?:\A|(?<=\n\n)){sentence}(?:[^\S\n]+|(?=\n|\Z))"
                  rf"|(?<=[.?!])(?:[^\S\n]+|\n(?=\S)){sentence}(?=\s|\Z)", "", text,
                  flags=re.DOTALL)
