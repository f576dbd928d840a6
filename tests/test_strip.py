"""Saved notebooks go back to the committed bytes, by `make strip` and by git's filter."""

import json
import subprocess
import sys
from pathlib import Path

import nbformat

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))
from strip_notebooks import main, restored  # noqa: E402

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
STRIP = ROOT / "strip_notebooks.py"


def save_as_lab(file):
    """Save a notebook as JupyterLab does after a run: with outputs, counts and its metadata."""
    book = nbformat.read(file, as_version=4)
    for number, cell in enumerate(book.cells):
        cell.metadata |= {"editable": True, "slideshow": {"slide_type": ""},
                          "tags": cell.metadata.get("tags", [])}
        if cell.cell_type == "code":
            cell.metadata |= {"execution": {"iopub.execute_input": "2026-01-01T00:00:00.0Z"},
                              "jupyter": {"source_hidden": True}, "collapsed": True,
                              "scrolled": True, "trusted": True}
            cell.outputs = [nbformat.v4.new_output("stream", text="of JupyterLab: \u00e9")]
            cell.execution_count = number
        else:
            cell.attachments = {}
    book.metadata |= {
        "kernelspec": {"display_name": ".venv (3.99)", "language": "python", "name": "python3"},
        "language_info": {"name": "python", "version": "3.99", "pygments_lexer": "ipython3",
                          "codemirror_mode": {"name": "ipython", "version": 3}},
        "widgets": {"application/vnd.jupyter.widget-state+json": {"state": {}}}}
    nbformat.write(book, file)


def strip(*files, content=b""):
    return subprocess.run([sys.executable, STRIP, *files], input=content, capture_output=True,
                          timeout=300)


def test_what_jupyterlab_saves_is_restored_to_the_byte(tmp_path):
    saved, committed = [], [restored(source.read_bytes()) for source in NOTEBOOKS]
    for source, content in zip(NOTEBOOKS, committed):      # the files may hold outputs here
        saved += [tmp_path / source.name, tmp_path / f"other {source.name}"]
        saved[-2].write_bytes(content)
        save_as_lab(saved[-2])
        saved[-1].write_text(json.dumps(json.loads(content), indent=4), encoding="utf-8")
        assert content not in (file.read_bytes() for file in saved[-2:])
    assert strip(content=saved[0].read_bytes()).stdout == committed[0]
    assert strip(*saved).returncode == 0
    for number, file in enumerate(saved):
        assert file.read_bytes() == committed[number // 2]
        nbformat.validate(nbformat.read(file, as_version=4))


def test_what_the_report_reads_stays():
    cell = nbformat.v4.new_code_cell("1", id="a", metadata={"tags": ["html-only"], "alt": "A dot"})
    text = nbformat.v4.new_markdown_cell("![](attachment:a.png)", id="b", attachments={
        "a.png": {"image/png": "AA=="}})
    book = nbformat.v4.new_notebook(cells=[cell, text], metadata={"slamlib": {"needs": "uwb"}})
    found = nbformat.reads(restored(nbformat.writes(book).encode()).decode(), 4)
    assert found.metadata.slamlib == {"needs": "uwb"}
    assert found.cells == book.cells


def test_what_is_no_notebook_is_told_and_left_as_it_is(tmp_path):
    file = tmp_path / "a.ipynb"
    for content in (b"not JSON", b"[]", b"{}", b'{"cells": [5], "metadata": {}}', b"\xff",
                    b'{"cells": [{}], "metadata": {}}'):
        file.write_bytes(content)
        assert "a.ipynb is not a notebook: " in main([str(file)])
        assert file.read_bytes() == content
    done = strip(content=b"[]")
    assert done.returncode == 1 and done.stdout == b"" and done.stderr.count(b"\n") == 1
