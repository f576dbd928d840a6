"""The Explore sections: a picture on the page, sliders in JupyterLab, and the numbers they draw."""

import re
from dataclasses import replace
from pathlib import Path

import nbformat
import numpy as np
import pytest

from slamlib.evaluation import nees_band
from slamlib.notebook import Drive, explore, plotting
from slamlib.report.execution import execute, kernel_environment
from slamlib.simulation import manoeuvre, simulate
from slamlib.studies.starts import LANDMARKS

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.usefixtures("look")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("[0-9]*.ipynb"))        # appendices have no Explore


@pytest.fixture(scope="module")
def sections(tmp_path_factory):
    """Code cells of each Explore section, executed after the notebook's first code cell alone."""
    folder = tmp_path_factory.mktemp("explore")
    books = {folder / source.name: nbformat.read(source, as_version=4) for source in NOTEBOOKS}
    for book in books.values():
        begin = next(i for i, cell in enumerate(book.cells) if cell.source.startswith("## Explore"))
        first = next(cell for cell in book.cells if cell.cell_type == "code")
        book.cells = [first] + [cell for cell in book.cells[begin:] if cell.cell_type == "code"]
    execute(books, kernel_environment(folder, ROOT / "data", ["short"]), folder / "results", 2,
            lambda *_: None)
    return {source.stem: book.cells[1:] for source, book in books.items()}


@pytest.mark.slow
@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_section_needs_only_the_first_code_cell_and_puts_one_picture_on_the_page(
        source, sections):
    """The kernel is the report's; test_lab runs the sections in JupyterLab."""
    shown = [set(output.get("data", {output.output_type: ""})) - {"text/plain"}
             for cell in sections[source.stem] for output in cell.outputs]
    assert shown == [{plotting.WIDE, plotting.NARROW, "text/html"}]


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_explore_is_the_last_section_and_figures_and_tables_are_in_order(source):
    cells = nbformat.read(source, as_version=4).cells
    text = "\n".join(cell.source for cell in cells)
    headings = [heading for cell in cells if cell.cell_type == "markdown"
                for heading in re.findall(r"^## (.+)$", cell.source, re.MULTILINE)]
    assert headings[-1] == "Explore"
    for kind in ("Figure", "Table"):
        numbers = re.findall(rf'^(?:.*")?{kind} (\d+\.\d+)\. ', text, re.MULTILINE)
        assert numbers == [f"{source.name[0]}.{n}" for n in range(1, len(numbers) + 1)]
        assert len(numbers) >= 2
        if kind == "Figure":
            assert cells[-1].source.startswith(f"Figure {numbers[-1]}.")


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_section_is_left_out_of_the_pdf_and_its_code_is_folded(source):
    cells = nbformat.read(source, as_version=4).cells
    begin = next(i for i, cell in enumerate(cells) if cell.source.startswith("## Explore"))
    for cell in cells[begin:]:
        expected = {"html-only"} | ({"hide-input"} if cell.cell_type == "code" else set())
        assert set(cell.metadata.tags) == expected


def test_a_moved_slider_redraws_the_figure_with_all_values(monkeypatch):
    monkeypatch.delenv("SLAMLIB_RESULTS", raising=False)
    shown, drawn = [], []
    monkeypatch.setattr(explore, "display", shown.append)
    a, b = explore.slider("a", 1, 0, 9), explore.slider("b", 0.5, 0.0, 1.0, 0.25)
    explore.show(lambda **values: drawn.append(values), a=a, b=b)
    controls, _ = shown[0].children
    assert controls.children == (a, b)
    a.value = 4
    assert drawn == [{"a": 1, "b": 0.5}, {"a": 4, "b": 0.5}]
    assert isinstance(a.value, int) and not a.continuous_update


def curves(ax):
    """The y values of the curves of an axes, by their labels."""
    return {line.get_label(): line.get_ydata() for line in ax.lines}


WHEELS = dict(right=0.0, left=0.0, base=0.0, sigma_radii=1.0, sigma_base=1.0, probability=95,
              count=9)


def test_the_true_wheels_have_a_smaller_error_than_the_nominal_ones():
    drive = Drive("short", *simulate("short", seed=3, slip=0.0))
    v, t = drive.dataset.vehicle, drive.truth.vehicle
    right, left, base = (t.wheel - v.wheel) / v.sigma_wheel

    def error(**values):
        title = explore.wheels(drive, **WHEELS | values).axes[0].get_title(loc="left")
        return float(re.search(r"ATE ([\d.]+) m", title)[1])

    assert error(right=right, left=left, base=base) < 0.1 * error()


def test_ellipses_scale_with_the_probability_and_the_sigmas():
    drive = Drive("short", *simulate("short", seed=3))

    def longest(**values):
        band = explore.wheels(drive, **WHEELS | values).axes[1].collections[0]
        return band.get_paths()[0].vertices[:, 1].max()

    assert longest(probability=99) == pytest.approx(
        longest() * np.sqrt(np.log(1 - 0.99) / np.log(1 - 0.95)))
    assert longest(sigma_radii=3.0) > 2 * longest()


def test_localization_from_markers_alone_ends_where_the_camera_sees_too_few():
    for seed in (1, 2):
        full = curves(explore.cameras(seed, 1, 1.8, 1.0).axes[1])
        short = curves(explore.cameras(seed, 5, 0.6, 1.0).axes[1])
        assert np.isfinite(full["markers alone"]).all() and np.isnan(short["markers alone"]).any()
        assert len(short["markers alone"]) < len(full["markers alone"])
        assert np.isfinite(short["fused"]).all()


def test_without_sightings_only_odometry_is_drawn():
    assert curves(explore.cameras(1, 20, 0.0, 1.0).axes[1]).keys() == {"odometry"}


def largest_marker_errors(kernel, start):
    """Largest error of a marker in m, 5 % wrong labels: of the single kernel, and of the rounds."""
    plan, _ = explore.graphs(1, 1.0, 1.0, 5, kernel, start).axes
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
        title = explore.graphs(seed, 5.0, assumed, 0, "none", "consensus").axes[1].get_title("left")
        return float(re.search(r"NEES ([\d.]+)", title)[1])

    low, high = nees_band(3)
    assert low < np.mean([nees(seed, 5.0) for seed in range(3)]) < high
    assert min(nees(seed, 0.0) for seed in range(3)) > 1000


def test_the_drive_to_explore_is_the_first_that_moves_or_a_simulated_one():
    dataset, truth = simulate("short", seed=5)
    still, far = (Drive(name, replace(dataset, name=name, ticks=ticks), None) for name, ticks in (
        ("still", np.zeros((5, 2), int)), ("far", manoeuvre([(3, 0.5)]))))
    assert explore.moving_drive([still, far]).name == "far"
    made_up = explore.moving_drive([still])
    assert made_up.made_up and made_up.truth is not None
