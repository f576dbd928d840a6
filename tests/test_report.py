"""The report: pages that need no script and no network, and nothing changed when a cell fails."""

import html
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from dataclasses import replace
from html.parser import HTMLParser

import nbformat
import pytest
from conftest import contradicted
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from slamlib import swap
from slamlib.__main__ import main
from slamlib.dataset import DatasetError
from slamlib.report import NotebookError, build_report
from slamlib.se2 import compose
from slamlib.simulation import simulate, write_dataset

TEXT = r"""# Problem 1: *odometry*

Counts become a pose $x_k$ and a covariance $\mathbf{C}_{X_k}$, as [equation 1](#eq-1) says.

## The estimate $\hat\theta$

$$ \begin{aligned} x_{k+1} &= x_k + \pi\,\frac{n_R R_R}{n_0}\cos\delta_k \\
y_{k+1} &= y_k \end{aligned} \tag{1} $$

| symbol | meaning |
| :-- | --: |
| $a < b$ | $\lVert r \rVert^2$ |

\begin{equation} I_k = \underbrace{\sum_{j=1}^{k-1} J_j S_j}_{\text{drift}} \tag{3b} \end{equation}

See [the other chapter](2_other.ipynb#Sums), [a paper](https://example.org/paper) and `$code$`.
"""
TEXT_FORMULAS = 7
OUTPUT = r"""from IPython.display import Markdown, Math, display
import matplotlib.pyplot as plt
display(Markdown(r'''
| $\sigma_x$ | 2 |
| -- | -- |
| **mean** | $$ \bar e = \frac1n \sum_i e_i \tag{7} $$ |
'''))
Math(r"\sqrt{2}")"""
OUTPUT_FORMULAS = 3
FIGURE = """%config InlineBackend.figure_formats = ['{}']
plt.plot([0, 1], [0, 1]);"""
ENVIRONMENT = """import os, sys
print("stderr is shown", file=sys.stderr)
for name in "DATA", "RESULTS", "DATASETS":
    print(os.environ["SLAMLIB_" + name])
folder = os.path.join(os.environ["SLAMLIB_RESULTS"], "short")
os.makedirs(folder, exist_ok=True)
open(os.path.join(folder, "vehiclePose.mat"), "w").close()
sys.executable"""

# ipykernel sends what is printed every 0.2 s.
PRINTING = """import time
for word in "one", "two":
    print(word)
    time.sleep(0.3)
print("three", file=sys.stderr)
display("a picture", "and another")
print("four")"""


class Page(HTMLParser):
    """Counts the elements of a page, and keeps what it loads, names and links to."""

    def __init__(self, path):
        super().__init__()
        self.text = path.read_text(encoding="utf-8")
        self.count, self.loads, self.links, self.alts, self.ids = {}, [], [], [], []
        self.feed(self.text)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        self.count[tag] = self.count.get(tag, 0) + 1
        self.loads += [attributes[name] for name in ("src", "srcset", "data") if name in attributes]
        self.links += [attributes["href"]] if tag == "a" else []
        self.alts += [attributes.get("alt")] if tag == "img" else []
        self.ids += [attributes["id"]] if "id" in attributes else []


def write(folder, name, *cells):
    """A notebook of Markdown cells (str) and code cells (1-tuples of str)."""
    made = [new_markdown_cell(cell, id=f"m{number}") if isinstance(cell, str)
            else new_code_cell(cell[0], id=f"c{number}") for number, cell in enumerate(cells)]
    folder.mkdir(exist_ok=True)
    nbformat.write(new_notebook(cells=made), folder / f"{name}.ipynb")


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
    write(root / "notebooks", "1_odometry", TEXT, (OUTPUT,), (FIGURE.format("svg"),),
          "**Figure 1.** A line.", (FIGURE.format("png"),))
    write(root / "notebooks", "2_other", "# 2. Second\n\n## Sums\n\nNo formula.", (ENVIRONMENT,),
          ("",), (PRINTING,))
    spec = root / "kernels" / "python3" / "kernel.json"  # a kernel of the user that cannot run
    spec.parent.mkdir(parents=True)
    spec.write_text(json.dumps({"argv": ["false"], "display_name": "", "language": "python"}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JUPYTER_PATH", str(root))
        patch.setenv("MPLBACKEND", "agg")
        return root, build(root, datasets=["short"])


def build(root, **options):
    return build_report(root / "notebooks", root / "data", root / "report", root / "results",
                        **options).files


def test_files_are_index_chapters_in_order_and_the_pdf(built):
    root, pages = built
    assert [page.name for page in pages] == ["index.html", "1_odometry.html", "2_other.html",
                                             "report.pdf"]
    assert sorted((root / "report").iterdir()) == sorted(
        [*pages, root / "report" / swap.FILE_LIST])


def test_every_formula_arrives_once(built):
    text = built[1][1].read_text(encoding="utf-8")
    main = text[text.index("<main>"):text.index("</main>")]
    assert main.count("<math") == main.count("</math>") == TEXT_FORMULAS + OUTPUT_FORMULAS
    assert "\ue000" not in text
    assert "<code>$code$</code>" in main
    # Outside of MathML, whose annotations keep the TeX, and of code no TeX is left.
    left = re.sub(r"(?s)<math.*?</math>|<pre.*?</pre>|<code>.*?</code>", "", main)
    assert "$" not in left and "\\" not in left


def test_equation_numbers_stand_beside_their_formula(built):
    page = Page(built[1][1])
    assert re.findall(r'<span class="number">\((\w+)\)</span>', page.text) == ["1", "3b", "7"]
    assert {"eq-1", "eq-3b", "eq-7"} <= set(page.ids)
    assert len(page.ids) == len(set(page.ids))


def test_formulas_are_mended(built):
    text = built[1][1].read_text(encoding="utf-8")
    assert "\U0001d402" in text and "\U0001d46a" not in text  # bold C, not bold italic C
    assert 'class="brace"' in text and "\u23df" not in text
    assert "<munderover>" in text and 'class="of"' in text


def test_pages_load_nothing(built):
    for path in built[1][:-1]:
        page = Page(path)
        assert not {"script", "link", "iframe", "object", "embed"} & set(page.count)
        assert all(source.startswith("data:image/") for source in page.loads)
        assert "url(" not in page.text and "@import" not in page.text
    assert "https://example.org/paper" in Page(built[1][1]).links


def test_figures_are_embedded_and_described(built):
    page = Page(built[1][1])
    assert [source.split(";")[0] for source in page.loads] == ["data:image/svg+xml",
                                                               "data:image/png"]
    assert all(page.alts)
    assert '<p class="caption" id="figure-1"><strong>Figure 1.</strong> A line.</p>' in page.text


def test_contents_titles_and_links(built):
    index, first, second = (Page(path) for path in built[1][:-1])
    assert "<title>Problem 1: odometry</title>" in first.text
    assert {"index.html", "2_other.html", "2_other.html#Sums", "#The-estimate"} <= set(first.links)
    assert {"The-estimate"} <= set(first.ids) and {"Sums"} <= set(second.ids)
    assert {"1_odometry.html", "2_other.html", "1_odometry.html#eq-1",
            "../results/short/vehiclePose.mat", "report.pdf"} <= set(index.links)
    assert index.count["math"] == 2  # of the first paragraph
    assert ">short</td>" in index.text and ">long</td>" not in index.text


def test_sections_of_a_numbered_chapter_are_numbered(built):
    first, second = (path.read_text(encoding="utf-8") for path in built[1][1:3])
    assert '<body class="numbered" style="--chapter: \'2.\'">' in second
    assert "<body>" in first  # whose title has no number


def test_kernels_see_the_folders_and_run_this_interpreter(built):
    root, pages = built
    text = pages[2].read_text(encoding="utf-8")
    for value in (root / "data", root / "results", sys.executable):
        assert str(value) in text
    assert '<pre class="output stderr">stderr is shown' in text
    assert re.search(r"\nshort\n?</pre>", text)
    assert "SLAMLIB_DATA" not in os.environ


def test_what_is_printed_in_a_row_is_one_output_however_long_it_takes(built):
    text = built[1][2].read_text(encoding="utf-8")
    assert '<pre class="output">one\ntwo\n</pre>' in text
    outputs = re.findall(r'<pre class="output[^>]*>(.*?)\s*</pre>', text, re.DOTALL)
    assert [html.unescape(part).strip("'") for part in outputs[-5:]] == [
        "one\ntwo", "three", "a picture", "and another", "four"]


def test_kernels_listen_at_sockets_not_at_ports(tmp_path, monkeypatch):
    """Another program can take a port between its choice and the kernel; nobody takes a socket."""
    long = tmp_path / ("x" * 60)  # a folder with too long a name for sockets
    long.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long))
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_kernel", "# Kernel", (
        "from ipykernel.connect import get_connection_info\n"
        "print(get_connection_info(unpack=True)['transport'])",))
    page = build(tmp_path)[1].read_text(encoding="utf-8")
    assert re.search(r'<pre class="output[^>]*>\s*ipc\s*</pre>', page)


@pytest.mark.slow
def test_a_second_build_gives_the_same_bytes(built):
    root, pages = built
    before = [page.read_bytes() for page in pages]
    assert [page.read_bytes() for page in build(root, datasets=["short"])] == before


def test_a_failing_cell_is_named_and_leaves_the_old_report(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_good", "# Good", ("import time\ntime.sleep(60)",))
    write(tmp_path / "notebooks", "2_bad", "# Bad", ("x = 0",), ("y = 1\nz = y / x",))
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "1_good.html").write_text("old")
    with pytest.raises(NotebookError) as caught:
        build(tmp_path)
    assert str(caught.value) == ("2_bad.ipynb, cell 2, line 2:\n    z = y / x\n"
                                 "ZeroDivisionError: division by zero")
    assert [path.name for path in (tmp_path / "report").iterdir()] == ["1_good.html"]
    assert (tmp_path / "report" / "1_good.html").read_text() == "old"


@pytest.mark.parametrize("text, reason", [
    (r"Before $\nonsense{x}$ after", r"\nonsense"),
    (r"$$ a \tag{1} \tag{2} $$", r"\tag{2}"),
    (r"$\begin{array}{c|c} a & b \end{array}$", "pandoc would lose"),
    ("[text](#Nowhere)", "the link 'text' leads to #Nowhere, which does not exist in 1_text.ipynb"),
    ("![](https://example.org/picture.png)",
     '1_text.ipynb: the report cannot show <img src="https://example.org/picture.png">'),
    ("## Two\n\nA <script>alert(1)</script>\n\n## Three",
     "1_text.ipynb, section 'Two': the report cannot show <script>: it holds text, tables,"),
])
def test_what_cannot_be_set_is_refused_before_a_kernel_starts(tmp_path, text, reason):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_text", text, ("raise SystemExit",))
    with pytest.raises(NotebookError, match=re.escape(reason)) as caught:
        build(tmp_path)
    assert str(caught.value).startswith("1_text.ipynb")
    assert not (tmp_path / "report").exists() and not (tmp_path / "results").exists()


@pytest.mark.slow
def test_what_is_shown_must_fit_together_in_the_executed_notebooks(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_text",
          "# 1. Text\n\nIn figure 1.4 is it; so says [the next](2_b.ipynb).",
          ("import matplotlib.pyplot as plt\nfrom slamlib.notebook import captioned\n"
           "%config InlineBackend.figure_formats = ['svg']\n"
           "captioned(plt.plot(1)[0].figure, 'Figure 1.4. Nothing.')",))
    page = Page(build(tmp_path)[1])
    assert re.search(r'</figure>\s*<div class="output">'
                     r'<p class="caption" id="figure-1.1">Figure 1.1. No', page.text)
    assert page.links.count("#figure-1.1") == 1 and page.count["img"] == 1
    assert "2_b" not in page.text and "so says the next." in page.text  # a page that does not exist
    write(tmp_path / "notebooks", "1_text",
          "# 1. Text\n\n$$ x \\tag{1.1} $$\n\nIn figure 1.5 is nothing.")
    with pytest.raises(NotebookError,
                       match="1_text.ipynb: the text refers to figure 1.5, which does not exist"):
        build(tmp_path)
    assert "Figure 1.1." in Page(tmp_path / "report" / "1_text.html").text  # the old report is left


@pytest.mark.slow
def test_a_page_of_a_notebook_that_is_gone_goes_and_the_user_s_stay(tmp_path):
    """Also those of builds that kept no list of their files."""
    make_data(tmp_path)
    for name in ("1_text", "2_gone", "3_now gone"):
        write(tmp_path / "notebooks", name, f"# {name[0]}. Text")
    build(tmp_path)
    report = tmp_path / "report"
    shutil.copy(report / "2_gone.html", report / "my copy.html")
    (report / "notes.html").write_text('<a href="notes.html">mine</a>')
    (report / "latin.html").write_bytes(b"\xff")
    (report / "here.html").symlink_to("2_gone.html")
    (report / "folder.html").mkdir()
    for name in ("2_gone", "3_now gone"):
        (tmp_path / "notebooks" / f"{name}.ipynb").unlink()
    (report / swap.FILE_LIST).unlink()
    build(tmp_path)
    assert sorted(file.name for file in report.iterdir()) == sorted([
        swap.FILE_LIST, "1_text.html", "folder.html", "here.html", "index.html", "latin.html",
        "my copy.html", "notes.html", "report.pdf"])


def test_missing_folders_and_names_are_told_in_one_sentence(tmp_path):
    with pytest.raises(DatasetError, match="no notebooks"):
        build(tmp_path)
    write(tmp_path / "notebooks", "1_text", "# Text")
    with pytest.raises(DatasetError, match="encoderReading.txt"):
        build(tmp_path)
    make_data(tmp_path)
    with pytest.raises(DatasetError, match="expected one of long, short, found 'medium'"):
        build(tmp_path, datasets=["medium", "short"])


def test_bad_data_and_bad_notebooks_are_told_before_a_kernel_starts(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_text", "# Text", ("raise SystemExit('never reached')",))
    (tmp_path / "data" / "long" / "encoderReading.txt").write_text("1 0 0\n2 1\n")
    with pytest.raises(DatasetError, match="encoderReading.txt, line 2: expected 3 columns"):
        build(tmp_path)
    broken = tmp_path / "notebooks" / "2_broken.ipynb"
    for content, reason in (
            (b"not json", "Notebook does not appear to be JSON"),
            (b'{"nbformat": 99}', "Unsupported nbformat version 99"),
            (b"[]", "expected JSON with cells and metadata"),
            (b'{"nbformat": 4,\n"caf\xe9": 1}',
             "expected UTF-8 text, found the byte 0xe9 in line 2")):
        broken.write_bytes(content)
        with pytest.raises(NotebookError, match=f"^2_broken.ipynb is not a notebook: {reason}"):
            build(tmp_path, datasets=["short"])
    broken.unlink()
    os.mkfifo(broken)
    with pytest.raises(DatasetError, match="2_broken.ipynb: expected a file that can be read, fo"):
        build(tmp_path, datasets=["short"])
    assert not (tmp_path / "report").exists()


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("unshare") is None
                    or subprocess.run(["unshare", "-rn", "true"], capture_output=True).returncode,
                    reason="no namespace without a network can be made here")
def test_a_loopback_that_is_down_is_not_needed(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_text", "# Text", ("print(6 * 7)",))
    built = subprocess.run(
        ["unshare", "-rn", sys.executable, "-m", "slamlib", "report", "short"],
        cwd=tmp_path, text=True, capture_output=True, timeout=300,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)})
    assert built.returncode == 0, built.stderr
    assert "42" in (tmp_path / "report" / "1_text.html").read_text()


def test_index_lists_results_of_this_build_and_the_selected_datasets_only(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_text", "# Text", (ENVIRONMENT.replace('"short"', '"long"'),),
          (ENVIRONMENT,))
    for name in ("short", "gone"):
        (tmp_path / "results" / name).mkdir(parents=True)
        (tmp_path / "results" / name / "old.mat").touch()
    index = build(tmp_path, datasets=["short"])[0].read_text()
    assert "short/vehiclePose.mat" in index and (tmp_path / "results/long/vehiclePose.mat").exists()
    assert "long/vehiclePose.mat" not in index and "old.mat" not in index


@pytest.mark.slow
def test_the_command_line_sets_the_title_page_and_leaves_out_code(tmp_path, monkeypatch, capsys):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_text", "# Text\n\nProse.",
          ("print('pri' + 'nted')\n'la' + 'st'",),
          ("from IPython.display import SVG\nSVG('<svg xmlns=\"http://www.w3.org/2000/svg\"/>')",))
    (tmp_path / "report.toml").write_text('author = "Of the file"\nstudent_number = 4711\n')
    monkeypatch.chdir(tmp_path)
    assert main(["report", "short", "--author", "Given", "--no-code"]) == 0
    page = Page(tmp_path / "report" / "1_text.html")
    assert "<p>Prose.</p>" in page.text and page.count["img"] == 1
    main_part = page.text[page.text.index("<main>"):]
    assert "print" not in main_part and "last" not in main_part and "<pre" not in main_part
    content = (tmp_path / "report" / "report.pdf").read_bytes()
    assert b"Given" in content and b"Of the file" not in content
    cached = (tmp_path / "build" / "executed").glob("1_text.*")
    assert [file.suffix for file in cached] == [".executed"]
    assert "report/index.html and report/report.pdf" in capsys.readouterr().err.replace(
        str(tmp_path.resolve()) + os.sep, "")
    assert main(["report", "short"]) == 0
    page = Page(tmp_path / "report" / "1_text.html")
    assert "printed" in page.text and "nothing changed" in capsys.readouterr().err
    assert b"Of the file" in (tmp_path / "report" / "report.pdf").read_bytes()


@pytest.mark.slow
def test_a_problem_that_fails_costs_one_problem_and_exit_code_3(tmp_path, monkeypatch, capsys):
    """One of two drives contradicts itself, and its truth begins in another frame."""
    dataset, truth = simulate("short", seed=3)
    dataset, poses = dataset.first(50).without("uwb"), truth.poses[:50]
    write_dataset(tmp_path / "data" / "good", dataset, replace(truth, poses=poses))
    write_dataset(tmp_path / "data" / "bad", replace(dataset, aruco=contradicted(dataset.aruco)),
                  replace(truth, poses=compose([7, 0, 0], poses)))
    write(tmp_path / "notebooks", "1_solve", "# 1. Solve", ("""from slamlib.notebook import *
drives = start()
left, found = solved(drives, ["problem2", "problem2_hint"])
for drive, solution, files in write_results(drives, found):
    say(f"{drive.name}: {files}")""",))
    monkeypatch.chdir(tmp_path)
    reasons = []
    for _ in range(2):                                                 # executed, then recalled
        assert main(["report", "--jobs", "1"]) == 3
        told = capsys.readouterr().err.splitlines()
        reasons += [line for line in told if line.startswith("slamlib: ")]
        assert [line for line in told if line.startswith("bad: doubt (truth-frame): In truth/")]
    assert len(reasons) == 2 and "nothing changed" in " ".join(told)
    assert reasons[1].startswith("slamlib: bad: problem2 could not be solved: expected sightings")
    page, index = (Page(tmp_path / "report" / f"{name}.html").text for name in ("1_solve", "index"))
    assert "could not be solved on bad: expected sightings" in page
    assert "This chapter leaves out bad." in page
    assert re.search(r"Doubts about the data.*bad:.*\(7\.000 m, 0\.000 m, 0\.0000 rad\)", index,
                     re.DOTALL)
    assert "The problem “ArUco” could not be solved: expected sightings" in html.unescape(index)
    assert "good:</p>" not in index
    files = [file.relative_to(tmp_path / "results").as_posix()
             for file in sorted((tmp_path / "results").rglob("*")) if file.is_file()]
    assert files == ["bad/.slamlib.json", "bad/problem2_hint/vehiclePose.mat", "good/.slamlib.json",
                     "good/problem2/ArucoMap.mat", "good/problem2/vehiclePose.mat",
                     "good/problem2_hint/vehiclePose.mat"]
