"""Makes pages and a PDF of executed notebooks, without a network; equal input gives equal bytes.

Each notebook becomes Markdown by the template notebook.md, for the screen and for paper. By
report.lua, which joins captions with figures and makes links, pandoc makes a page of the one by
page.html, and of the other a part of the document for Typst, which begins with report.typ.
"""

import json
import re
import subprocess
import tempfile
from base64 import b64encode
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from functools import partial
from pathlib import Path
from urllib.parse import quote

import pypandoc
import typst
from nbconvert.filters import strip_ansi

from slamlib.report.notebooks import Books, NotebookError, Options, rendered, title_of

HERE = Path(__file__).parent
DIALECT = "gfm-alerts-autolink_bare_uris-emoji-yaml_metadata_block+raw_attribute"
CAPTION = re.compile(r"^(Figure|Table) ([\dA-Z]+\.?\d*)\.\s", re.MULTILINE)
NUMBERED = re.compile(r"\\tag\*?\s*{([^{}]*)}")
APPENDIX = re.compile(r"([A-Z])\.")  # begins the title of an appendix


def render(books: Books, options: Options) -> dict[str, bytes]:
    """Return the files of a report by their names: a page for each book, and report.pdf.

    NotebookError if a formula or a picture would be lost.

    Parameters
    ----------
    books : executed notebooks; links name them by their file names.
    options : of the title page.
    """
    screen = {source: markdown(book) for source, book in books.items()}
    paper = [markdown(book, on_paper=True) for book in books.values()]
    targets = _targets(books, screen)
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor() as pool:
        folder = Path(temporary)
        settings = [_settings(books, source, targets, folder) for source in books]
        parts = pool.map(partial(_pandoc, "typst"), paper, settings)
        pages = pool.map(partial(_pandoc, "html"), screen.values(), settings)
        names = [f"{source.stem}.html" for source in books]
        return dict(zip(names, pages)) | {"report.pdf": _pdf(parts, options, folder)}


def markdown(book, on_paper: bool = False) -> str:
    """Return a notebook with its outputs and pictures as Markdown."""
    return rendered("notebook.md", book=book, on_paper=on_paper, address=address,
                    strip_ansi=strip_ansi)


def address(kind: str, data: str) -> str:
    """Return the address of a picture of a kind such as "image/png", which holds its data."""
    if kind == "image/svg+xml":
        data = b64encode(data.encode()).decode()
    content = "".join(data.split())
    return f"data:{kind};base64,{content}"


def _targets(books, texts):
    """Return the chapters (dict of str) that have a figure, a table, an equation or a letter.

    Their keys are as "figure-2.3" or "appendix-A".
    """
    found = {}
    for source, book in books.items():
        ids = [f"{kind.lower()}-{number}" for kind, number in CAPTION.findall(texts[source])]
        ids += [f"equation-{number}" for number in NUMBERED.findall(texts[source])]
        letter = APPENDIX.match(title_of(source, book))
        if letter:
            ids.append(f"appendix-{letter[1]}")
        for each in ids:
            if each in found:
                raise NotebookError(f"{source.name}: {each.replace('-', ' ')} occurs twice")
            found[each] = source.stem
    return found


def _settings(books, here, targets, folder):
    """Return what report.lua and page.html need to know of a chapter, a dict."""
    entries = [{"file": quote(f"{source.stem}.html"), "title": title_of(source, book),
                "here": source == here} for source, book in books.items()]
    files = {source.stem: entry["file"] for source, entry in zip(books, entries)}
    around = [{}, *entries, {}]
    position = list(books).index(here)
    page = {"chapters": entries, "previous": around[position], "next": around[position + 2]}
    return {"here": here.stem, "beside": str(here.parent), "folder": str(folder), "files": files,
            "targets": targets, "page": page}


def _pandoc(kind, text, settings):
    """Return what pandoc makes of Markdown (bytes): a page, or a part of a document for Typst."""
    command = [
        pypandoc.get_pandoc_path(), f"--from={DIALECT}", f"--to={kind}", "--mathml", "--toc",
        "--wrap=none", f"--lua-filter={HERE / 'report.lua'}",
        f"--resource-path={settings['beside']}",
        f"--metadata=options={json.dumps(settings)}"]
    if kind == "html":
        command.append(f"--template={HERE / 'page.html'}")
    done = subprocess.run(command, input=text.encode(), capture_output=True)
    if done.returncode:
        told, refused, reason = done.stderr.decode(errors="replace").partition("refused: ")
        if not refused:
            reason = f"pandoc cannot make the report: {told}"
        raise NotebookError(reason.strip())
    return done.stdout


def _pdf(parts, options, folder):
    """Return the PDF of the parts of a document for Typst, whose pictures are in a folder."""
    scopes = b"\n".join(b"#[\n" + part + b"\n]" for part in parts)
    main = folder / "main.typ"
    main.write_bytes((HERE / "report.typ").read_bytes() + scopes)
    shown = {name: str(value) for name, value in asdict(options).items()}
    try:
        return typst.compile(main, root=folder, ignore_system_fonts=True, timestamp=0,
                             sys_inputs=shown)
    except typst.TypstError as error:
        raise NotebookError(f"Typst cannot set the PDF: {error.message}") from None
