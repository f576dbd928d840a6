"""Saved notebooks go back to the committed bytes, by `make strip` and by git's filter."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

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


@pytest.mark.skipif(not all(map(shutil.which, ("git", "make"))), reason="no git or no make here")
def test_git_finds_no_difference_in_a_notebook_that_was_executed(tmp_path):
    """After `make setup` alone, also in a folder of a repository, and where .venv is gone."""
    folder = tmp_path / "a folder" / "project"
    (folder / "notebooks").mkdir(parents=True)
    for name in (".gitattributes", "Makefile", "check_python.py", "pyproject.toml",
                 "requirements.txt", STRIP.name):
        shutil.copy(ROOT / name, folder)
    notebook = folder / "notebooks" / "1_odometry.ipynb"
    notebook.write_bytes(strip(content=NOTEBOOKS[0].read_bytes()).stdout)
    (tmp_path / ".gitignore").write_text(".venv\n")

    alone = {name: value for name, value in os.environ.items()
             if not name.startswith(("MAKE", "MFLAGS"))}        # of the make that runs the tests

    def run(*command):
        done = subprocess.run(command, cwd=folder, text=True, capture_output=True, timeout=300,
                              env=alone)
        assert done.returncode == 0, done.stderr
        return done.stdout

    def git(*arguments):
        return run("git", "-c", "user.name=a", "-c", "user.email=a@b", *arguments)

    (folder / ".venv" / "bin").mkdir(parents=True)              # an environment that is ready
    (folder / ".venv" / "bin" / "python").symlink_to(sys.executable)
    ready = run("make", "--eval=ready:;@echo $(READY)", "ready").strip()
    (folder / ready).touch()
    run("make", "setup")                                        # no repository yet
    git("init", "--quiet", str(tmp_path))
    git("add", "--all", str(tmp_path))
    git("commit", "--quiet", "--message=first")
    save_as_lab(notebook)
    assert "of JupyterLab" in git("diff")                       # what the filter is for
    git("checkout", ".")
    run("make", "setup")
    notebook.touch()
    assert git("status", "--porcelain") == ""
    save_as_lab(notebook)
    assert git("diff") == ""
    git("add", "--all")                                         # status goes by the size until then
    assert git("status", "--porcelain") == git("diff", "--cached") == ""
    notebook.write_text(notebook.read_text(encoding="utf-8").replace('"# 1. O', '"# 1. o'),
                        encoding="utf-8")
    assert [line for line in git("diff").splitlines() if line[:1] in "+-"][2:] == [
        '-    "# 1. Odometry from wheel counts\\n",', '+    "# 1. odometry from wheel counts\\n",']
    shutil.rmtree(folder / ".venv")
    notebook.touch()
    assert "of JupyterLab" in git("diff")
