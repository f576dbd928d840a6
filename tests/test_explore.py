"""The Explore sections: what they draw, and that a page gets a picture and JupyterLab the sliders."""

import re
from dataclasses import replace
from pathlib import Path

import nbformat
import numpy as np
import pytest

from slamlib import explore, initial, plotting
from slamlib.execution import execute, kernel_environment
from slamlib.notebook import Log
from slamlib.simulation import manoeuvre, simulate

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.usefixtures("look")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.fixture(scope="module")
def sections(tmp_path_factory):
    """The sections' code cells, executed as for the report, each after the first code cell alone."""
    folder = tmp_path_factory.mktemp("explore")
    books = {folder / source.name: nbformat.read(source, as_version=4) for source in NOTEBOOKS}
    for book in books.values():
        begin = next(i for i, cell in enumerate(book.cells) if cell.source.startswith("## Explore"))
        first = next(cell for cell in book.cells if cell.cell_type == "code")
        book.cells = [first] + [cell for cell in book.cells[begin:] if cell.cell_type == "code"]
    execute(books, kernel_environment(folder, ROOT / "data", ["short"], 2), folder / "results", 2,
            lambda *_: None)
    return {source.stem: book.cells[1:] for source, book in books.items()}


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_section_runs_after_the_first_code_cell_alone_and_gives_a_page_one_picture(source, sections):
    """In a kernel of its own, as for the report; JupyterLab is tried in a browser (test_lab)."""
    shown = [set(output.get("data", {output.output_type: ""})) - {"text/plain"}
             for cell in sections[source.stem] for output in cell.outputs]
    assert shown == [{plotting.WIDE, plotting.NARROW}]


@pytest.mark.parametrize("source", NOTEBOOKS, ids=lambda path: path.stem)
def test_explore_is_the_last_section_and_figures_and_tables_are_numbered_in_order(source):
    cells = nbformat.read(source, as_version=4).cells
    headings = [heading for cell in cells if cell.cell_type == "markdown"
                for heading in re.findall(r"^## (.+)$", cell.source, re.MULTILINE)]
    assert headings[-1] == "Explore"
    for kind in ("Figure", "Table"):
        numbers = re.findall(rf'^(?:.*")?{kind} (\d+\.\d+)\. ', "\n".join(cell.source for cell in cells),
                             re.MULTILINE)
        assert numbers == [f"{source.name[0]}.{n}" for n in range(1, len(numbers) + 1)] and len(numbers) > 3
        if kind == "Figure":
            assert cells[-1].source.startswith(f"Figure {numbers[-1]}.")


def test_a_moved_slider_draws_anew_with_all_values(monkeypatch):
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
    return {line.get_label(): line.get_ydata() for line in ax.lines}


WHEELS = dict(right=0.0, left=0.0, base=0.0, sigma_radii=1.0, sigma_base=1.0, probability=95, count=9)


def test_wheels_of_the_true_vehicle_come_nearer_to_the_truth():
    log = Log("short", *simulate("short", seed=3, slip=0.0))
    v, t = log.dataset.vehicle, log.truth.vehicle
    right, left, base = (t.wheel - v.wheel) / v.sigma_wheel

    def off(**values):
        title = explore.wheels(log, **WHEELS | values).axes[0].get_title(loc="left")
        return float(re.search(r"([\d.]+) m off the truth", title)[1])

    assert off(right=right, left=left, base=base) < 0.1 * off()


def test_ellipses_grow_with_the_probability_and_the_sigmas():
    log = Log("short", *simulate("short", seed=3))

    def longest(**values):
        band = explore.wheels(log, **WHEELS | values).axes[1].collections[0]
        return band.get_paths()[0].vertices[:, 1].max()

    assert longest(probability=99) == pytest.approx(
        longest() * np.sqrt(np.log(1 - 0.99) / np.log(1 - 0.95)))
    assert longest(sigma_radii=3.0) > 2 * longest()


def test_a_camera_that_sees_little_breaks_the_chain_but_not_the_picture():
    for seed in (1, 2):
        full = curves(explore.cameras(seed, 1, 1.8, 1.0).axes[1])
        short = curves(explore.cameras(seed, 5, 0.6, 1.0).axes[1])
        assert np.isfinite(full["markers alone"]).all() and np.isnan(short["markers alone"]).any()
        assert len(short["markers alone"]) < len(full["markers alone"])
        assert np.isfinite(short["fused"]).all()


def test_a_camera_that_sees_nothing_leaves_the_odometry():
    assert curves(explore.cameras(1, 20, 0.0, 1.0).axes[1]).keys() == {"odometry"}


def test_the_single_kernel_misplaces_markers_that_start_at_a_wrong_label():
    def worst(start, kernel):
        left, _ = explore.graphs(1, 1.0, 1.0, 5, kernel, start).axes
        lines = [line for line in left.lines if len(line.get_xydata()) == 2]      # marker by marker
        return [max(np.hypot(*np.diff(line.get_xydata(), axis=0)[0]) for line in lines
                    if line.get_color() == plotting.ROLES[role]["color"])
                for role in ("alternative", "slam")]

    single, rounds = worst("first sighting", "3 σ")
    assert single > 1.0 and rounds < 0.1
    single, rounds = worst("consensus", "3 σ")
    assert single < 0.1 and rounds < 0.1
    single, rounds = worst("consensus", "none")
    assert single > 1.0 and rounds < 0.1


@pytest.mark.parametrize("slip, assumed", [(0.0, 0.0), (5.0, 0.0), (0.0, 5.0)])
def test_the_ends_of_the_slip_sliders_can_be_drawn(slip, assumed):
    explore.graphs(2, slip, assumed, 30, "none", "first sighting")


def test_every_choice_of_where_markers_start_can_be_drawn():
    for start in initial.LANDMARKS:
        explore.graphs(2, 1.0, 1.0, 5, "1 σ", start)


def test_the_drive_to_explore_is_the_first_that_goes_anywhere():
    dataset, truth = simulate("short", seed=5)
    still, far = (Log(name, replace(dataset, name=name, ticks=ticks), None) for name, ticks in (
        ("still", np.zeros((5, 2), int)), ("far", manoeuvre([(3, 0.5)]))))
    assert explore.drive([still, far]).name == "far"
    made_up = explore.drive([still])
    assert made_up.made_up and made_up.truth is not None
