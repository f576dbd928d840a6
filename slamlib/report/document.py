"""Makes pages and a PDF of executed notebooks, without a network; equal input gives equal bytes.

Each notebook becomes Markdown, for the screen and for paper. By report.lua, which joins captions
with figures and makes links, pandoc makes a page of the one by page.html, and of the other a part
of the document for Typst, which begins with report.typ.
"""

import base64
import json
import re
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from urllib.parse import quote

import pypandoc
import typst
from nbconvert.filters import strip_ansi

from slamlib.report.execution import LAB_ONLY, Books, NotebookError
from slamlib.report.notebooks import Options, chapter_of, tags_of

HERE = Path(__file__).parent
DIALECT = "gfm-alerts-autolink_bare_uris-emoji-yaml_metadata_block+raw_attribute"
PICTURES = ("image/svg+xml", "image/png", "image/jpeg")
SHOWN = (*PICTURES, "text/markdown", "text/latex", "text/html", "text/plain")  # the first is best
FENCE = "~~~~~~~~"
ALT = "Figure of this chapter, described in the text"
CAPTION = re.compile(r"^(Figure|Table) ([\dA-Z]+\.?\d*)\.\s", re.MULTILINE)
NUMBERED = re.compile(r"\\tag\*?\s*{([^{}]*)}")


def render(books: Books, options: Options, picture: str = "") -> dict[str, bytes]:
    """Return the files of a report by their names: a page for each book, and report.pdf.

    NotebookError if a formula or a picture would be lost.

    Parameters
    ----------
    books : executed notebooks; links name them by their file names.
    options : of the title page, and of the code that is shown.
    picture : an SVG for the title page, or "".
    """
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor() as pool:
        folder = Path(temporary)
        screen = {source: _markdown(book, options.code, on_paper=False)
                  for source, book in books.items()}
        paper = {source: _markdown(book, options.code, on_paper=True)
                 for source, book in books.items()}
        targets = _targets(books, screen)
        parts = [pool.submit(_pandoc, text, "typst", _settings(books, source, targets, folder))
                 for source, text in paper.items()]
        pages = {f"{source.stem}.html": pool.submit(
            _pandoc, text, "html", _settings(books, source, targets, folder))
            for source, text in screen.items()}
        (folder / "title.svg").write_text(picture, encoding="utf-8")
        pdf = _pdf([part.result() for part in parts], options, bool(picture), folder)
        return {name: page.result() for name, page in pages.items()} | {"report.pdf": pdf}


def _markdown(book, code, on_paper):
    """Return a notebook with its outputs and pictures as Markdown."""
    parts = []
    for cell in book.cells:
        tags = tags_of(cell)
        if LAB_ONLY in tags or on_paper and "html-only" in tags:
            continue
        if cell.cell_type == "markdown":
            parts.append(_with_attachments(cell))
        elif cell.cell_type == "code":
            is_folded = code == "method" and "hide-input" in tags
            if code != "none" and cell.source and not (is_folded and on_paper):
                parts.append(_code(cell.source, is_folded))
            for output in cell.outputs:
                if code != "none" or not _is_printed(output):
                    parts.append(_shown(output, cell.metadata.get("alt", ALT)))
    return "\n\n".join(parts)


def _code(text, is_folded):
    block = f"{FENCE}python\n{text}\n{FENCE}"
    if is_folded:
        return f"<details><summary>Code</summary>\n\n{block}\n\n</details>"
    return block


def _address(kind, data):
    """Return the address of a picture of a kind such as "image/png", which holds its data."""
    if kind == "image/svg+xml":
        data = base64.b64encode(data.encode()).decode()
    content = "".join(data.split())
    return f"data:{kind};base64,{content}"


def _with_attachments(cell):
    """Return the text of a Markdown cell, in which its attachments are pictures."""
    text = cell.source
    for name, data in cell.get("attachments", {}).items():
        for kind, content in data.items():
            text = text.replace(f"attachment:{name}", _address(kind, content))
    return text


def _best(output):
    """Return the best kind of an output that can be shown, or None."""
    return next((kind for kind in SHOWN if kind in output.get("data", {})), None)


def _is_printed(output):
    return _best(output) in (None, "text/plain")


def _shown(output, alt):
    """Return an output as Markdown, by the best kind that it has."""
    kind = _best(output)
    if kind is None:
        name = "stderr" if output.get("name") == "stderr" else "stdout"
        return f"{FENCE}{name}\n{strip_ansi(output.get('text', ''))}\n{FENCE}"
    data = output.data[kind]
    if kind in PICTURES:
        return f"![{alt}]({_address(kind, data)})"
    if kind == "text/html":
        return f"{FENCE}{{=html}}\n{data}\n{FENCE}"
    if kind == "text/plain":
        return f"{FENCE}stdout\n{data}\n{FENCE}"
    return data


def _targets(books, texts):
    """Return the chapters (dict of str) that have a figure, a table, an equation or a letter.

    Their keys are as "figure-2.3" or "appendix-A".
    """
    found = {}
    for source, book in books.items():
        ids = [f"{kind.lower()}-{number}" for kind, number in CAPTION.findall(texts[source])]
        ids += [f"equation-{number}" for number in NUMBERED.findall(texts[source])]
        ids.append(f"appendix-{chapter_of(source, book).number}")
        for each in ids:
            if each in found and each != "appendix-":
                raise NotebookError(f"{source.name}: {each.replace('-', ' ')} occurs twice")
            found[each] = source.stem
    return found


def _settings(books, here, targets, folder):
    """Return what report.lua and page.html need to know of a chapter, a dict."""
    files = {source.stem: quote(f"{source.stem}.html") for source in books}
    entries = [{"file": files[source.stem], "title": chapter_of(source, book).title,
                "here": source == here} for source, book in books.items()]
    page = {"chapters": entries}
    position = list(books).index(here)
    if position > 0:
        page["previous"] = entries[position - 1]
    if position + 1 < len(entries):
        page["next"] = entries[position + 1]
    return {"here": here.stem, "beside": str(here.parent), "folder": str(folder), "files": files,
            "targets": targets, "page": page}


def _pandoc(text, kind, settings):
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


def _pdf(parts, options, has_picture, folder):
    """Return the PDF of the parts of a document for Typst, whose pictures are in a folder."""
    scopes = b"\n".join(b"#[\n" + part + b"\n]" for part in parts)
    main = folder / "main.typ"
    main.write_bytes((HERE / "report.typ").read_bytes() + scopes)
    shown = {name: str(value) for name, value in asdict(options).items()}
    shown["picture"] = "title.svg" if has_picture else ""
    try:
        return typst.compile(main, root=folder, ignore_system_fonts=True, timestamp=0,
                             sys_inputs=shown)
    except typst.TypstError as error:
        raise NotebookError(f"Typst cannot set the PDF: {error.message}") from None
