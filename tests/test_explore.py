"""The Explore sections: a picture on the page, sliders in JupyterLab, and the numbers they draw."""

import re
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from conftest import copied

from slamlib.dataset import DatasetError
from slamlib.evaluation import nees_band
from slamlib.notebook import explore, plotting
from slamlib.report.execution import execute, kernel_environment
from slamlib.studies.starts import LANDMARKS

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.usefixtures("look")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("[0-9]*.ipynb"))        # appendices have no Explore


@pytest.fixture(scope="module")
def sections(tmp_path_factory):
    """Code cells of each Explore section, executed after the notebook's first code cell alone.

    They show one figure; test_pages looks at those between which buttons choose.
    """
    folder = tmp_path_factory.mktemp("explore")
    copied(folder / "notebooks", "[0-9]*.ipynb")
    books = {source: nbformat.read(source, as_version=4)
             for source in sorted((folder / "notebooks").iterdir())}
    for book in books.values():
        begin = next(i for i, cell in enumerate(book.cells) if cell.source.startswith("## Explore"))
        first = next(cell for cell in book.cells if cell.cell_type == "code")
        book.cells = [first] + [cell for cell in book.cells[begin:] if cell.cell_type == "code"
                                and "lab-only" not in cell.metadata.get("tags", [])]
    environment = kernel_environment(folder, ROOT / "data", ["short"], folder / "studies")
    execute(books, environment, folder / "results", 2, lambda *_: None)
    return {source.stem: book.cells[1:] for source, book in books.items()}


@pytest.mark.slow
@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_section_needs_only_the_first_code_cell_and_puts_one_picture_on_the_page(
        source, sections):
    """The kernel is the report's; test_lab runs the sections in JupyterLab."""
    shown = [set(output.get("data", {output.output_type: ""})) - {"text/plain"}
             for cell in sections[source.stem] for output in cell.outputs]
    assert shown == [{"text/html"}]


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_chapter_ends_with_explore_and_try_it_and_figures_and_tables_are_in_order(source):
    cells = nbformat.read(source, as_version=4).cells
    begins = {}
    for i, cell in enumerate(cells):
        for heading in re.findall(r"^## (.+)$", cell.source * (cell.cell_type == "markdown"), re.M):
            begins[heading] = i
    assert [*begins][-2:] == ["Explore", "Try it"]
    for begin, end, tags, code in ((begins["Explore"], begins["Try it"], {"html-only"},
                                    {"hide-input"}), (begins["Try it"], None, {"lab-only"}, set())):
        for cell in cells[begin:end]:
            assert tags <= set(cell.metadata.tags) <= tags | (
                code if cell.cell_type == "code" else set())
    text = "\n".join(cell.source for cell in cells)
    for kind in ("Figure", "Table"):
        numbers = re.findall(rf'^(?:.*")?{kind} (\d+\.\d+)(?:{{.*}})?\. ', text, re.MULTILINE)
        assert numbers == [f"{source.name[0]}.{n}" for n in range(1, len(numbers) + 1)]
        assert len(numbers) >= 2


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_code_is_short_and_what_pages_fold_is_collapsed_in_jupyterlab(source):
    code = [cell for cell in nbformat.read(source, as_version=4).cells
            if cell.cell_type == "code"]
    assert max(len(cell.source.splitlines()) for cell in code) <= 25
    assert sum(bool(line.strip()) for cell in code for line in cell.source.splitlines()) <= 260
    for cell in code:
        hidden = "hide-input" in cell.metadata.get("tags", ())
        assert cell.metadata.get("jupyter", {}).get("source_hidden", False) == hidden


def test_the_page_shows_one_figure_for_each_value_and_the_first_one_first():
    def draw(**values):
        drawn.append(values)
        return plotting.panels(1)[0]

    drawn = []
    text = explore.states(draw, {"a": explore.slider("a (%)", 1, 0, 9), "b": explore.slider(
        "b", 2, 0, 9), "c": explore.choice("c", ["x", "<y"], "<y")}, {"a": [0, 1], "c": ["x"]})
    assert drawn == [{"a": 1, "b": 2, "c": "<y"}, {"a": 0, "b": 2, "c": "<y"},
                     {"a": 1, "b": 2, "c": "x"}]
    assert re.findall("<label[^>]*>(.*?)<", text) == ["first values", "a (%) 0", "c x"]
    assert text.count(" checked>") == 1 and text.index(" checked>") < text.index("first values")
    assert text.count('src="data:image/png;base64,') == 3 and not plt.get_fignums()


def test_a_moved_slider_redraws_the_figure_and_values_without_a_solution_say_so(
        monkeypatch, capsys):
    monkeypatch.delenv("SLAMLIB_RESULTS", raising=False)
    shown, drawn = [], []
    monkeypatch.setattr(explore, "display", shown.append)

    def draw(**values):
        drawn.append(values)
        if values["a"] == 4:
            raise DatasetError("x: expected < 3")
        return plt.figure()

    explore.show_with_controls(draw, a=explore.slider("a", 1, 0, 9),
                               b=explore.slider("b", 0.5, 0.0, 1.0, 0.25))
    panel, = (each for each in shown if not isinstance(each, plt.Figure))
    a, b = panel.children[0].children
    assert (a.min, a.max, b.step, b.description) == (0, 9, 0.25, "b")
    a.value = 4
    b.value = 0.75
    a.value = 3
    assert drawn == [{"a": 1, "b": 0.5}, {"a": 4, "b": 0.5}, {"a": 4, "b": 0.75},
                     {"a": 3, "b": 0.75}]
    assert not plt.get_fignums()
    assert "There is no solution with these values: x: expected < 3" in capsys.readouterr().out


def largest_marker_errors(kernel, start):
    """Largest error of a marker in m, 5 % wrong labels: of the single kernel, and of the rounds."""
    plan, _ = explore.draw_graphs(1, 1.0, 1.0, 5, kernel, start).axes
    errors = [line for line in plan.lines if len(line.get_xydata()) == 2]  # from true to estimated
    return [max(np.hypot(*np.diff(line.get_xydata(), axis=0)[0]) for line in errors
                if line.get_color() == plotting.ROLES[role]["color"])
            for role in ("alternative", "slam")]


@pytest.mark.slow
@pytest.mark.parametrize("kernel, start, right", [
    ("3 σ", "first sighting", False), ("3 σ", "most certain sighting", False),
    ("3 σ", "mean by information", True), ("3 σ", "consensus", True),
    ("3 σ", "problem 2's map", True), ("none", "consensus", False)])
def test_the_single_kernel_needs_a_right_start_and_the_rounds_do_not(kernel, start, right):
    single, rounds = largest_marker_errors(kernel, start)
    assert single < 0.1 if right else single > 1.0
    assert rounds < 0.1


def test_every_start_of_the_markers_is_tested():
    test, = (mark for mark in
             test_the_single_kernel_needs_a_right_start_and_the_rounds_do_not.pytestmark
             if mark.name == "parametrize")
    assert {start for _, start, _ in test.args[1]} == set(LANDMARKS)


@pytest.mark.slow
def test_a_graph_that_assumes_no_slip_is_overconfident():
    """A slip of 5 mm after 1 m: the NEES is consistent if the graph assumes it, and huge if not."""
    def nees(seed, assumed):
        fig = explore.draw_graphs(seed, 5.0, assumed, 0, "none", "consensus")
        return float(re.search(r"NEES ([\d.]+)", fig.axes[1].get_title("left"))[1])

    low, high = nees_band(3)
    assert low < np.mean([nees(seed, 5.0) for seed in range(3)]) < high
    assert min(nees(seed, 0.0) for seed in range(3)) > 1000


@pytest.mark.slow
def test_late_ranges_move_antennas_by_a_quadratic_cost_and_not_by_the_solver():
    plan, side = explore.draw_ranges(1, 30, 2.0, 100, "quadratic").axes
    places, = (line.get_xydata() for line in plan.lines if line.get_label() == "antennas: truth")
    miss = {role: max(np.hypot(*(places - line.get_xydata()[1]).T).min() for line in plan.lines
                      if len(line.get_xydata()) == 2
                      and line.get_color() == plotting.ROLES[role]["color"])
            for role in ("alternative", "slam")}
    within = float(re.search(r"within ([\d.]+) m", plan.get_title("left"))[1])
    assert miss["slam"] == pytest.approx(within, abs=0.006) and within < 0.2 < miss["alternative"]
    assert "NEES" in side.get_title("left")
