"""The report: runs the notebooks headless and writes pages that need no script and no network.

Notebooks are executed, each in a kernel of its own; each becomes one HTML page through nbconvert,
`report_page.html` and `report_style.css`, its formulas set from TeX to MathML by pandoc.
"""

import asyncio
import html
import json
import os
import re
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from urllib.parse import quote

import nbformat
import pypandoc
from jinja2 import pass_context
from jupyter_client import AsyncKernelManager
from jupyter_client.kernelspec import KernelSpecManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError
from nbconvert import HTMLExporter
from nbconvert.filters import strip_ansi
from nbconvert.filters.markdown_mistune import IPythonRenderer, MarkdownWithMath
from tqdm import tqdm

from slamlib.dataset import DatasetError, dataset_names, read_dataset, read_truth

SECONDS_PER_CELL = 1800
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


class NotebookError(RuntimeError):
    """A notebook that failed; the message names the notebook, the place in it and the reason."""


def build_report(notebooks, data, report, results, datasets=None, jobs=2):
    """Execute the notebooks of a folder; write a page for each, and `index.html`.

    Kernels find the absolute paths of data and results, and the selection, in the environment
    variables SLAMLIB_DATA, SLAMLIB_RESULTS and SLAMLIB_DATASETS (names, one a line).

    Parameters
    ----------
    notebooks, data : folder of the `*.ipynb` files, and of the datasets, a sub-folder each.
    report, results : folder of the pages, and of what notebooks write; made if they do not exist.
    datasets, jobs : names, or None for all; number of notebooks executed at a time.

    Returns
    -------
    list of Path, the pages, the index first.

    Raises
    ------
    DatasetError : no notebook, no dataset of a selected name, or one that is not as it must be.
    NotebookError : a cell failed, or a page cannot be set; an earlier report stays as it was.
    """
    notebooks, data, report, results = (
        Path(folder).resolve() for folder in (notebooks, data, report, results))
    sources = sorted(notebooks.glob("*.ipynb"))
    if not sources:
        raise DatasetError(f"{notebooks}: there are no notebooks (*.ipynb) in this folder")
    selected = dataset_names(data, datasets)
    for name in selected:  # bad data is to be told as such, and not as a failing notebook
        read_dataset(data / name), read_truth(data / name)
    books = {source: _read(source) for source in sources}
    chapters = [_chapter(source, book) for source, book in books.items()]
    for source, book in books.items():  # a formula that fails shall fail before the long part
        text = [cell for cell in book.cells if cell.cell_type == "markdown"]
        _page(source, nbformat.v4.new_notebook(cells=text), chapters)

    results.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as settings:
        environment = _environment(Path(settings), data, results, datasets, jobs)
        try:
            with asyncio.Runner(loop_factory=_Loop) as runner:
                runner.run(_execute_all(books, environment, max(1, jobs)))
        except ExceptionGroup as group:
            raise group.exceptions[0] from None
    files = [(quote(os.path.relpath(file, report)), file.relative_to(results).as_posix())
             for name in selected for file in sorted((results / name).rglob("*.mat"))]
    index = nbformat.v4.new_notebook()
    pages = {"index.html": _page(Path("index"), index, chapters, datasets=selected, files=files)}
    pages |= {f"{source.stem}.html": _page(source, books[source], chapters) for source in sources}
    report.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".", dir=report) as beside:
        for name, text in pages.items():
            Path(beside, name).write_text(text, encoding="utf-8")
        for name in pages:
            os.replace(Path(beside, name), report / name)
    return [report / name for name in pages]


def _read(source):
    try:
        return nbformat.read(source, as_version=4)
    except (nbformat.reader.NotJSONError, nbformat.ValidationError) as error:
        reason = str(error).partition("\n")[0]
        raise NotebookError(f"{source.name} is not a notebook: {reason}") from None


class _Loop(asyncio.SelectorEventLoop):
    """Leaves Ctrl-C to asyncio, which stops all kernels; nbclient would go on without its own."""

    def add_signal_handler(self, *_):
        raise RuntimeError("signals are not for single notebooks")


def _environment(settings, data, results, datasets, jobs):
    """What kernels see: our variables, and no settings of the user that would change a page."""
    (settings / "matplotlibrc").write_text("svg.hashsalt: slamlib\n")
    threads = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS") if jobs > 1 else ()
    environment = {"SOURCE_DATE_EPOCH": "0", "PYTHONHASHSEED": "0"} | dict.fromkeys(threads, "1")
    environment |= os.environ
    environment |= {"SLAMLIB_DATA": str(data), "SLAMLIB_RESULTS": str(results),
                    "IPYTHONDIR": str(settings), "MATPLOTLIBRC": str(settings / "matplotlibrc"),
                    "MPLBACKEND": "module://matplotlib_inline.backend_inline"}
    environment.pop("SLAMLIB_DATASETS", None)
    return environment | ({"SLAMLIB_DATASETS": "\n".join(datasets)} if datasets else {})


async def _execute_all(books, environment, jobs):
    """Execute books in place, at most `jobs` at a time; the first failure stops the others."""
    slots = asyncio.Semaphore(jobs)
    with tqdm(total=0, unit="cell", leave=False, disable=not sys.stderr.isatty()) as bar:
        async with asyncio.TaskGroup() as group:
            for source, book in books.items():
                group.create_task(_execute(source, book, environment, slots, bar))


async def _execute(source, book, environment, slots, bar):
    """Execute one book in place, by the interpreter that runs this."""
    count = sum(cell.cell_type == "code" and cell.source.strip() != "" for cell in book.cells)
    bar.total += count
    started = []

    def begin(cell, cell_index):
        started.append(cell)
        bar.set_description(f"{source.stem}: cell {len(started)} of {count}")

    manager = AsyncKernelManager(  # with no folder to search only this very interpreter remains
        kernel_name="python3", kernel_spec_manager=KernelSpecManager(kernel_dirs=[]))
    client = NotebookClient(
        book, km=manager, resources={"metadata": {"path": str(source.parent)}},
        timeout=SECONDS_PER_CELL, iopub_timeout=60, raise_on_iopub_timeout=True,
        record_timing=False, store_widget_state=False, shutdown_kernel="immediate",
        extra_arguments=["--IPKernelApp.log_level=ERROR"],
        on_cell_execute=begin, on_cell_executed=lambda **_: bar.update())
    async with slots:
        start = time.monotonic()
        tqdm.write(f"{source.stem}: {count} cells", file=sys.stderr)
        try:
            await client.async_execute(env=environment, cleanup_kc=True)
        except (CellExecutionError, TimeoutError, RuntimeError) as error:
            if asyncio.current_task().cancelling():  # which nbclient takes for a dead kernel
                raise asyncio.CancelledError from None
            raise NotebookError(_failure(source, started, error)) from None
        finally:
            if manager.has_kernel:
                await manager.shutdown_kernel(now=True)
        tqdm.write(f"{source.stem}: done in {time.monotonic() - start:.1f} s", file=sys.stderr)


def _failure(source, started, error):
    """Notebook, cell, line and reason of a failure, without colours."""
    place, lines, reason = source.name, [], f"{type(error).__name__}: {error}".splitlines()[0]
    if started:
        place, lines = f"{place}, cell {len(started)}", started[-1].source.splitlines()
    if isinstance(error, CellExecutionError):
        reason = f"{error.ename}: {error.evalue}"
        frame = re.search(r"Cell In\s?\[\d+\], line (\d+)", strip_ansi(error.traceback))
        if frame and int(frame[1]) <= len(lines):
            place, lines = f"{place}, line {frame[1]}", [lines[int(frame[1]) - 1].strip()]
    return strip_ansi("\n    ".join([f"{place}:", *lines[:5]]) + f"\n{reason}")


def _chapter(source, book):
    """File, title and first paragraph of a book, the last in Markdown."""
    text = "\n\n".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    title = re.search(r"^#\s+(.+)", text, re.MULTILINE)
    lead = re.search(r"^(?!\s|[#|<>`]|\$\$|[-*+]\s).+(?:\n.+)*", text, re.MULTILINE)
    title = re.sub("[*_`]", "", title[1]).strip() if title else source.stem
    return {"file": quote(f"{source.stem}.html"), "title": title, "lead": lead[0] if lead else ""}


def _page(source, book, chapters, **index):
    """The HTML page of one book, or of the index."""
    page = {"formulas": [], "headings": [], "anchors": {}, "figures": [], "chapters": chapters,
            "index": index, "file": quote(f"{source.stem}.html"), "style": STYLE}
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
    renderer = _Renderer(escape=False, embed_images=True,
                         path=context["resources"]["metadata"]["path"],
                         attachments=context.get("cell", {}).get("attachments", {}))
    renderer.page = context["resources"]["page"]
    return MarkdownWithMath(renderer=renderer).render(source)


class _Renderer(IPythonRenderer):
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
    version = json.loads(pypandoc.convert_text("", "json", "markdown"))["pandoc-api-version"]
    document = json.dumps({"pandoc-api-version": version, "meta": {}, "blocks": blocks})
    try:
        text = pypandoc.convert_text(document, "html", "json",
                                     ["--mathml", "--wrap=none", "--fail-if-warnings"])
    except RuntimeError as error:
        raise NotebookError(f"{name}: pandoc cannot set a formula:\n{str(error).strip()}") from None
    if text.count("<math") != len(formulas):
        raise NotebookError(f"{name}: of {len(formulas)} formulas pandoc lost some")
    return [_mend(tex, mathml) for (tex, _), mathml in zip(formulas, text.split("\ue000"))]


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
