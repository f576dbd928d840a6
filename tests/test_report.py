"""The report: pages that need no script and no network, and nothing changed when a cell fails."""

import html
import json
import re
import sys

import nbformat
import pytest
from conftest import ROOT, file_names
from kills import contents
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from slamlib.__main__ import main
from slamlib.io.files import write_file
from slamlib.report.build import build_report
from slamlib.report.notebooks import NotebookError, Options, read_options

ENVIRONMENT = """import os, sys
print("stderr is shown", file=sys.stderr)
for name in "DATA", "DATASETS":
    print(os.environ["SLAMLIB_" + name])
for dataset in "short", "long":
    folder = os.path.join(os.environ["SLAMLIB_RESULTS"], dataset, "own")
    os.makedirs(folder)
    open(os.path.join(folder, "ArucoMap.mat"), "w").close()
sys.executable"""

# ipykernel sends what is printed every 0.2 s.
PRINTING = """import time
for word in "one", "two":
    print(word)
    time.sleep(0.3)
print("three", file=sys.stderr)
display("a picture", "and another")
print("four")"""


def write(folder, name, *cells, **needs):
    """A notebook of Markdown cells (str) and code cells (1-tuples of str), and what it needs."""
    made = [new_markdown_cell(cell, id=f"m{number}") if isinstance(cell, str)
            else new_code_cell(cell[0], id=f"c{number}") for number, cell in enumerate(cells)]
    folder.mkdir(exist_ok=True)
    book = new_notebook(cells=made, metadata={"slamlib": needs})
    nbformat.write(book, folder / f"{name}.ipynb")


def make_data(folder):
    for name in ("short", "long"):
        (folder / "data" / name).mkdir(parents=True)
        (folder / "data" / name / "encoderReading.txt").write_text("1 0 0\n2 10 9\n")
    (folder / "data" / "notes").mkdir()


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """One build of two notebooks, shared by all tests that only look at its pages."""
    root = tmp_path_factory.mktemp("built")
    make_data(root)
    write(root / "notebooks", "1_odometry", "# 1. *Odometry*\n\nPoses $x_k$.")
    write(root / "notebooks", "2_other", "# 2. Second\n\nText.", (ENVIRONMENT,), ("",), (PRINTING,))
    write(root / "notebooks", "3_ranges", "# 3. Ranges", ("1 / 0",), needs="uwb")
    spec = root / "kernels" / "python3" / "kernel.json"  # a kernel of the user that cannot run
    spec.parent.mkdir(parents=True)
    spec.write_text(json.dumps({"argv": ["false"], "display_name": "", "language": "python"}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JUPYTER_PATH", str(root))
        patch.setenv("MPLBACKEND", "agg")
        write_file(root / "results" / "short" / "old.mat", b"of an earlier run")
        return root, build(root, datasets=["short"])


def build(root, **options):
    return build_report(root / "notebooks", root / "data", root / "report", root / "results",
                        **{"kept": root / "kept"} | options).files


def test_files_are_index_chapters_that_a_dataset_allows_in_order_and_the_pdf(built):
    root, pages = built
    assert [page.name for page in pages] == ["index.html", "1_odometry.html", "2_other.html",
                                             "report.pdf"]
    assert sorted((root / "report").iterdir()) == sorted(
        [*pages, root / "report" / ".pages"])
    index = pages[0].read_text()
    assert {"1_odometry.html", "2_other.html", "report.pdf"} <= {
        *re.findall(r'<a\s[^>]*href="([^"]*)"', index)}
    assert "<title>1. Odometry</title>" in pages[1].read_text()
    assert file_names(root / "results") == [
        "short/old.mat", "short/own/ArucoMap.mat", "short/summary.json"]


def test_kernels_see_the_folders_and_what_is_printed_in_a_row_is_one_output(built):
    """However long it takes. Kernels run this interpreter."""
    root, pages = built
    text = pages[2].read_text()
    assert str(root / "data") in text and sys.executable in text
    assert '<pre class="stderr"><code>stderr is shown' in text
    assert re.search(r"\nshort\n?</code></pre>", text)
    outputs = re.findall(r'<pre class="std[^>]*><code>(.*?)\s*</code>', text, re.DOTALL)
    assert [html.unescape(part).strip("'") for part in outputs[-5:]] == [
        "one\ntwo", "three", "a picture", "and another", "four"]


@pytest.mark.parametrize("good, bad, results, told", [
    ("import time\ntime.sleep(60)", ["# Bad", ("x = 0",), ("y = 1\nz = y / x",)], [],
     r"2_bad\.ipynb: (?s:.*)\nCell In\[2\], line 2\n(?s:.*)\n----> 2 z = y / x\n\n"
     "ZeroDivisionError: division by zero"),
    ("1", ["# 2. Bad\n\n$$ \\nonsense $$", ("1",)], ["long/summary.json", "short/summary.json"],
     r"2_bad\.ipynb: pandoc cannot convert this formula:\n    \\nonsense")])
def test_a_notebook_that_fails_is_named_and_leaves_the_old_report(
        tmp_path, good, bad, results, told):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_good", "# Good", (good,))
    write(tmp_path / "notebooks", "2_bad", *bad)
    write_file(tmp_path / "report" / "1_good.html", b"old")
    with pytest.raises(NotebookError) as caught:
        build(tmp_path)
    assert re.fullmatch(told, str(caught.value))
    assert contents(tmp_path / "report") == {"1_good.html": b"old"}
    assert file_names(tmp_path / "results") == results


@pytest.mark.parametrize("content, reason", [
    (b"not json", "Notebook does not appear to be JSON"),
    (b'{"nbformat": 99}', "Unsupported nbformat version 99"), (b"[]", "'list' object "),
    (b'{"nbformat": 4,\n"caf\xe9": 1}', "expected UTF-8 text")])
def test_what_is_no_notebook_is_told_before_a_kernel_starts(tmp_path, content, reason):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_text", "# Text", ("raise SystemExit('never reached')",))
    write_file(tmp_path / "notebooks" / "2_broken.ipynb", content)
    with pytest.raises(NotebookError, match=f"^2_broken.ipynb is not a notebook: {reason}"):
        build(tmp_path)
    assert not (tmp_path / "report").exists()


FAILING = """from slamlib.notebook import *
from slamlib.solve import find
for drive in start():
    with attempt(drive, "problem2"):
        write_results(drive, "problem2", find("problem2", drive.dataset))"""


def test_a_problem_that_fails_is_said_with_exit_code_3(tmp_path, monkeypatch, capsys):
    """Of a drive without markers; also where the notebook is not executed again."""
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_solve", "# 1. Solve", (FAILING,))
    monkeypatch.chdir(tmp_path)
    for progress in "executed in", "nothing changed":
        assert main(["report"]) == 3
        told = "".join(capsys.readouterr())
        assert f"1 of 1: 1_solve, {progress}" in told
        assert "short: problem2 could not be solved: localize: expected " in told
    text = html.unescape((tmp_path / "report" / "index.html").read_text())
    assert "The problem “ArUco” could not be solved: localize: expected " in text


# report.toml


@pytest.mark.parametrize("text, expected", [
    ('author = "A"\nautor = "B"', "expected entries such as 'author'"),
    ("\nauthor = Ada", "Invalid value (at line 2, column 10)"),
    ('author = """a\nb"""', "expected a line of UTF-8 text in quotes for author"),
    ("title = true", "expected a line of UTF-8 text in quotes for title, found 'True'"),
    ('chapters = "B"', "expected a list of notebooks in quotes, such as ["),
    ("chapters = [3]", "for chapters, found '[3]'"),
    ('author = "Löwe"', "expected a line of UTF-8 text")])
def test_a_mistake_is_told_and_nothing_is_written(tmp_path, monkeypatch, capsys, text, expected):
    (tmp_path / "report.toml").write_bytes(text.encode("latin-1"))
    monkeypatch.chdir(tmp_path)
    assert main(["report"]) == 2
    told = capsys.readouterr().err
    assert "report.toml" in told and expected in told and told.count("\n") == 1
    assert file_names(tmp_path) == ["report.toml"]


@pytest.mark.parametrize("name, chapters, told", [
    *((name, "[]", f"data/{name}: expected letters from a to z, digits")
      for name in ("日本", "a*b", "<b>", "$x")),
    ("short", '["1*", "7*"]', "report.toml: expected chapters among 1_text, found '7*'")])
def test_what_no_report_can_show_is_told_before_a_kernel_starts(
        tmp_path, monkeypatch, capsys, name, chapters, told):
    make_data(tmp_path)
    (tmp_path / "data" / "short").rename(tmp_path / "data" / name)
    write(tmp_path / "notebooks", "1_text", "# 1. Text", ("1 / 0",))
    (tmp_path / "report.toml").write_text(f"# mine\nchapters = {chapters}\n")
    monkeypatch.chdir(tmp_path)
    assert main(["report"]) == 2
    assert told in capsys.readouterr().err.splitlines()[-1]


def test_every_entry_is_read(tmp_path):
    path = tmp_path / "report.toml"
    assert read_options(path) == Options() and Options().title and not Options().author
    path.write_text('author = "Ada Löwe"\nstudent_number = 123456\n'
                    'chapters = ["1*", "B_real_log"]\n', "utf-8")
    assert read_options(path) == Options(
        author="Ada Löwe", student_number="123456", chapters=("1*", "B_real_log"))


def test_the_committed_file_has_the_defaults_also_where_its_examples_are_read(tmp_path):
    text = (ROOT / "report.toml").read_text()
    assert read_options(ROOT / "report.toml") == Options(course="Robotic Perception and Action")
    examples = re.sub(r"^# (?=\w+ = )", "", text, flags=re.MULTILINE)
    (tmp_path / "report.toml").write_text(examples)
    read = read_options(tmp_path / "report.toml")
    assert read.chapters == ("1_odometry", "2_aruco_localization", "3*", "4*")
