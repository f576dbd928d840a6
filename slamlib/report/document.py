"""Makes pages and a PDF of executed notebooks, without a network; equal input gives equal bytes.

pandoc reads one notebook of all chapters, in which all text is in Markdown cells. By report.lua,
which numbers and links, it writes pages by page.html and a document for Typst by report.typ.
"""

import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path

import pypandoc
import typst
from nbformat import NotebookNode
from nbformat.v4 import new_code_cell, new_markdown_cell, new_raw_cell

from slamlib.core.errors import DatasetError
from slamlib.report.execution import LAB_ONLY, Books, NotebookError
from slamlib.report.notebooks import Options, chapter_of, tags_of

HERE = Path(__file__).parent
TEMPLATES = {"html": "page.html", "typst": "report.typ"}
SHOWN = ("image/svg+xml", "image/png", "image/jpeg", "text/markdown", "text/latex", "text/html",
         "text/plain")  # kinds of outputs, the first is preferred


def render(books: Books, options: Options, has: Iterable[str] = (), picture: str = "",
           check: bool = False) -> dict[str, bytes]:
    """Return the files of a report by their names: a page for each book, and report.pdf.

    NotebookError if something would be lost: a formula, or what a caption, a reference, a link or a
    picture points to; DatasetError if no section has a number or title that is to be left out.

    Parameters
    ----------
    books : executed notebooks; links name them by their file names.
    options : of the title page, and of what is shown of the books.
    has : what the datasets have; sections that need other data are left out.
    picture : an SVG for the title page, or "".
    check : True where the books have no outputs yet: nothing is said of what these may hold.
    """
    settings = asdict(options) | {
        "has": " ".join(has), "check": check, "beside": str(list(books)[-1].parent),
        "picture": "title.svg" if picture else ""}
    text = json.dumps(_merged(books)).encode()
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as pool:
        pages = pool.submit(_pandoc, text, "html", folder, settings)
        Path(folder, "title.svg").write_text(picture, encoding="utf-8")
        pdf = _pdf(_pandoc(text, "typst", folder, settings), folder)
        pages.result()
        names = [f"{source.stem}.html" for source in books]
        return {name: Path(folder, name).read_bytes() for name in names} | {"report.pdf": pdf}


def _pdf(document, folder):
    """Return the PDF of a document for Typst (bytes), whose pictures are in a folder."""
    main = Path(folder, "main.typ")
    main.write_bytes(document)
    try:
        return typst.compile(main, root=folder, ignore_system_fonts=True, timestamp=0)
    except typst.TypstError as error:
        raise NotebookError(f"Typst cannot set the PDF: {error.message}: "
                            f"{error.diagnostic.strip()}") from None


def _pandoc(text, kind, folder, settings):
    """Return what pandoc writes of a notebook (bytes); prints what the filter says."""
    options = json.dumps(settings | {"folder": folder})
    command = [
        pypandoc.get_pandoc_path(), "--from=ipynb-autolink_bare_uris", "--ipynb-output=all",
        f"--to={kind}", f"--template={HERE / TEMPLATES[kind]}",
        f"--lua-filter={HERE / 'report.lua'}", "--mathml", "--toc", "--wrap=none",
        f"--resource-path={settings['beside']}", f"--metadata=options={options}"]
    done = subprocess.run(command, input=text, capture_output=True)
    told, refused, reason = done.stderr.decode(errors="replace").partition("refused: ")
    if done.returncode:
        if not refused:
            raise NotebookError(f"pandoc cannot make the report: {told}")
        places = filter(None, settings["leave_out"].values())
        error = DatasetError if reason.startswith(tuple(places)) else NotebookError
        raise error(reason.strip())
    print(told, file=sys.stderr, end="")
    return done.stdout


def _merged(books):
    """Return one notebook of all books; a cell with the name of each precedes its own."""
    numbers = "".join(chapter_of(source, book).number for source, book in books.items())
    cells = []
    for source, book in books.items():
        cells.append(new_markdown_cell(metadata={"chapter": source.stem}))
        for cell in book.cells:
            if LAB_ONLY not in tags_of(cell):
                cells += [_without_absent(part, numbers) for part in _parts(cell)]
    return {"cells": cells, "metadata": {}, "nbformat": 4, "nbformat_minor": 5}


def _parts(cell):
    """Return the code and each output of a cell as cells; code that is folded comes last."""
    if cell.cell_type != "code":
        return [cell]
    code = [new_code_cell(cell.source, metadata=cell.metadata)]
    outputs = [_shown(output, cell.metadata) for output in cell.outputs]
    return outputs + code if "hide-input" in tags_of(cell) else code + outputs


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


def _without_absent(cell, numbers):
    """Return a cell without "(table A.3)" and sentences that begin so, unless A is in `numbers`."""
    if cell.cell_type != "markdown":
        return cell
    absent = f"(?![{numbers} ])[A-Z]"
    label = rf"(?:(?i:figure|table)s?\s+{absent}\.\d+|(?i:appendix)\s+{absent}\b(?!\s+of\b))"
    sentence = rf"(?=[A-Z]){label}(?:(?!\n\n).)*?[.?!]"
    in_brackets = rf"\s*\({label}\)"
    first = rf"(?:\A|(?<=\n\n)){sentence}(?:[^\S\n]+|(?=\n|\Z))"  # of a paragraph
    later = rf"(?<=[.?!])(?:[^\S\n]+|\n(?=\S)){sentence}(?=\s|\Z)"
    text = re.sub(f"{in_brackets}|{first}|{later}", "", cell.source, flags=re.DOTALL)
    return NotebookNode(cell | {"source": text})
