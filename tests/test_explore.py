"""The Explore sections: a picture on the page, sliders in JupyterLab, and the numbers they draw."""

import re
import threading
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pytest
from conftest import copied
from test_plotting import require_contours

from slamlib import localization, odometry, slam
from slamlib.dataset import DatasetError
from slamlib.evaluation import REACH_95, nees_band
from slamlib.notebook import Drive, controls, explore, parts, plotting
from slamlib.report.execution import execute, kernel_environment
from slamlib.simulation import manoeuvre, simulate
from slamlib.studies.starts import LANDMARKS

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.usefixtures("look")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("[0-9]*.ipynb"))        # appendices have no Explore


@pytest.fixture(scope="module")
def sections(tmp_path_factory):
    """Code cells of each Explore section, executed after the notebook's first code cell alone.

    They show one figure; test_pages looks at those that sliders move.
    """
    folder = tmp_path_factory.mktemp("explore")
    copied(folder / "notebooks", "[0-9]*.ipynb")
    books = {source: nbformat.read(source, as_version=4)
             for source in sorted((folder / "notebooks").iterdir())}
    for book in books.values():
        begin = next(i for i, cell in enumerate(book.cells) if cell.source.startswith("## Explore"))
        first = next(cell for cell in book.cells if cell.cell_type == "code")
        book.cells = [first] + [cell for cell in book.cells[begin:] if cell.cell_type == "code"]
    environment = kernel_environment(folder, ROOT / "data", ["short"], folder / "studies")
    execute(books, environment, folder / "results", 2, lambda *_: None,
            (folder / "seconds.json", folder / "others.json", "at least"))
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


@pytest.fixture
def seconds(monkeypatch):
    """A clock for the panel: a list to which a drawing adds how long it takes."""
    spent = []
    monkeypatch.setattr(controls, "perf_counter", lambda: sum(spent))
    return spent


def drawing(drawn, raises=None):
    """A function of values, noted in `drawn`, that makes a figure or raises by the value of a."""
    raises = raises or {}

    def draw(**values):
        drawn.append(values)
        if values["a"] in raises:
            raise raises[values["a"]]
        fig = plt.figure()
        fig.said = f"a is {values['a']} < 10."
        return fig
    return draw


def parts_of(panel):
    """The sliders and lists of a panel as they are now, the button Reset, and the sentence."""
    row, reset, said, _ = panel.children
    return row.children, reset, said


def test_a_moved_slider_redraws_the_figure_with_all_values(monkeypatch):
    monkeypatch.delenv("SLAMLIB_RESULTS", raising=False)
    shown, drawn = [], []
    monkeypatch.setattr(controls, "display", shown.append)
    explore.show_with_controls(drawing(drawn), a=explore.slider("a", 1, 0, 9),
                 b=explore.slider("b", 0.5, 0.0, 1.0, 0.25))
    (a, b), _, said = parts_of(shown[-1])
    assert (a.min, a.max, b.step, b.description) == (0, 9, 0.25, "b")
    a.value = 4
    assert drawn == [{"a": 1, "b": 0.5}, {"a": 4, "b": 0.5}]
    assert isinstance(a.value, int) and said.value == "a is 4 &lt; 10." and not plt.get_fignums()


def test_reset_brings_all_first_values_back_and_draws_once():
    drawn = []
    panel = controls.panel(drawing(drawn), {"a": explore.slider("a", 1, 0, 9),
                                            "name": explore.choice("name", ["one", "two"], "two")})
    (a, name), reset, said = parts_of(panel)
    a.value, name.value = 5, "one"
    del drawn[:]
    reset.click()
    assert drawn == [{"a": 1, "name": "two"}] and said.value == "a is 1 &lt; 10."
    (new, name), _, _ = parts_of(panel)
    assert (new.value, name.value, a.comm) == (1, "two", None)  # the old one hears nothing
    new.value = 2
    assert drawn[1:] == [{"a": 2, "name": "two"}]
    reset.click()
    reset.click()                                              # there is nothing to return from
    assert drawn[2:] == [{"a": 1, "name": "two"}]


def test_widgets_that_the_kernel_serves_at_once_draw_one_after_the_other():
    """JupyterLab gives every widget a thread of the kernel: a second one moves while one draws."""
    drawing_now, never, drawn = threading.Lock(), threading.Event(), []

    def draw(**values):
        assert drawing_now.acquire(blocking=False)
        drawn.append(values)
        if values["a"] == 2:
            threads[1].start()
            never.wait(0.2)                                     # the other one waits for the lock
        drawing_now.release()
        return plt.figure()

    panel = controls.panel(draw, {name: explore.slider(name, 1, 0, 9) for name in "ab"})
    (a, b), reset, _ = parts_of(panel)
    threads = [threading.Thread(target=setattr, args=(a, "value", 2)),
               threading.Thread(target=reset.click)]
    threads[0].start()
    threads[0].join()
    threads[1].join()
    a.value = b.value = 5                    # widgets that Reset replaced change nothing any more
    assert drawn == [{"a": 1, "b": 1}, {"a": 2, "b": 1}, {"a": 1, "b": 1}]


def test_a_slider_follows_the_mouse_while_its_drawings_take_less_than_0_3_s(seconds):
    takes = [5.0]

    def draw(**values):
        seconds.append(takes[-1])
        return plt.figure()

    panel = controls.panel(draw, {"a": explore.slider("a", 1, 0, 9),
                                  "b": explore.slider("b", 1, 0, 9),
                                  "name": explore.choice("name", ["one", "two"], "one")})
    (a, b, name), reset, _ = parts_of(panel)
    assert a.continuous_update and b.continuous_update     # the first drawing does not count
    for value, time, follows in ((2, 0.31, False), (3, 0.29, True), (4, 0.31, False)):
        takes.append(time)
        a.value = value
        assert a.continuous_update == follows and b.continuous_update
    for value, time, follows in (("two", 0.29, True), ("one", 0.31, False)):
        takes.append(time)
        name.value = value
        assert a.continuous_update == b.continuous_update == follows
    takes.append(5.0)
    reset.click()
    assert all(slider.continuous_update for slider in parts_of(panel)[0][:2])


def test_values_without_a_solution_leave_a_sentence_and_no_picture():
    panel = controls.panel(drawing([], {4: DatasetError("x: expected < 3"),
                                        5: np.linalg.LinAlgError("Singular matrix")}),
                           {"a": explore.slider("a", 1, 0, 9)})
    (a,), _, said = parts_of(panel)
    for value, reason in ((4, "x: expected &lt; 3"), (5, "Singular matrix")):
        a.value = value
        assert said.value == f"There is no solution with these values: {reason}."
    a.value = 6
    assert said.value == "a is 6 &lt; 10."


def test_a_control_of_the_simulation_is_disabled_while_a_dataset_is_drawn():
    drives = [Drive("one", None, None), Drive("one", None, None, made_up=True),
              Drive("simulated", None, None)]
    panel = controls.panel(drawing([]), {"drive": explore.drive_choice(drives),
                                         "a": explore.slider("a", 1, 0, 9)}, ["a"])
    (drive, a), reset, _ = parts_of(panel)
    assert [name for name, _ in drive.options] == ["simulated", "one", "simulated"]
    assert drive.value is explore.SIMULATED and not a.disabled
    drive.value = drives[2]
    assert a.disabled
    reset.click()
    (drive, a), _, _ = parts_of(panel)
    assert not a.disabled and drive.value is explore.SIMULATED


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
        title = explore.draw_wheels(drive, **WHEELS | values).axes[0].get_title(loc="left")
        return float(re.search(r"ATE ([\d.]+) m", title)[1])

    assert error(right=right, left=left, base=base) < 0.1 * error()


def test_ellipses_scale_with_the_probability_and_the_sigmas():
    drive = Drive("short", *simulate("short", seed=3))

    def longest(**values):
        band = explore.draw_wheels(drive, **WHEELS | values).axes[1].collections[0]
        return band.get_paths()[0].vertices[:, 1].max()

    assert longest(probability=99) == pytest.approx(
        longest() * np.sqrt(np.log(1 - 0.99) / np.log(1 - 0.95)))
    assert longest(sigma_radii=3.0) > 2 * longest()


def test_ellipses_are_contours_of_the_covariances_that_they_show():
    """Of equation 2 at 95 % in chapter 1, and of the fused poses, enlarged, in chapter 2."""
    drive = Drive("short", *simulate("short", seed=3))
    poses, covariances = odometry.equation2(drive.dataset.ticks, drive.dataset.vehicle)
    fused = localization.fuse(drive.dataset)
    plan = explore.draw_cameras({"short": fused}, drive, 1, 1, 9.0, 1.0).axes[0]
    enlarged = int(re.search(r"ellipses × (\d+)", plan.get_title("left"))[1])
    for ax, means, spread, factor in (
            (explore.draw_wheels(drive, **WHEELS).axes[0], poses, covariances, 1),
            (plan, fused.poses, fused.covariances, enlarged)):
        patches, = ax.collections
        rows = [int(np.argmin(np.hypot(*(means[:, :2] - place).T)))
                for place in patches.get_offsets()]
        require_contours(patches, means[rows], spread[rows], factor * REACH_95)


def test_localization_from_markers_alone_ends_where_the_camera_sees_too_few():
    for seed in (1, 2):
        full = curves(explore.draw_cameras({}, explore.SIMULATED, seed, 1, 1.8, 1.0).axes[1])
        short = curves(explore.draw_cameras({}, explore.SIMULATED, seed, 5, 0.6, 1.0).axes[1])
        assert np.isfinite(full["markers alone"]).all() and np.isnan(short["markers alone"]).any()
        assert len(short["markers alone"]) < len(full["markers alone"])
        assert np.isfinite(short["fused"]).all()


def test_without_sightings_only_odometry_is_drawn():
    fig = explore.draw_cameras({}, explore.SIMULATED, 1, 20, 0.0, 1.0)
    assert curves(fig.axes[1]).keys() == {"odometry"} and "only the odometry" in fig.said


def largest_marker_errors(kernel, start):
    """Largest error of a marker in m, 5 % wrong labels: of the single kernel, and of the rounds."""
    plan, _ = explore.draw_graphs({}, explore.SIMULATED, 1, 1.0, 1.0, 5, kernel, start).axes
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
        fig = explore.draw_graphs({}, explore.SIMULATED, seed, 5.0, assumed, 0, "none", "consensus")
        title = fig.axes[1].get_title("left")
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


@pytest.fixture(scope="module")
def recorded():
    """A Drive with its truth, one of the same data without it, and their solutions by problem."""
    dataset, truth = simulate("short", seed=77)
    with_truth, without = Drive("a", dataset, truth), Drive("b", replace(dataset, name="b"), None)
    found3 = slam.estimate(dataset.without("uwb"), 1e-3, "arc")
    full = {2: localization.fuse(dataset, slip=1e-3), 3: found3,
            4: slam.estimate(dataset, 1e-3, "arc", found3)}
    return with_truth, without, {chapter: {"a": found, "b": found}
                                 for chapter, found in full.items()}


def drawn_on(drive, full, **changed):
    """The figures of chapters 2 to 4 on a recorded Drive, by chapter."""
    values = {"seed": 1, "every": 1, "reach": 9.0, "claimed": 1.0, "slip": 1.0, "assumed": 1.0,
              "wrong": 0, "kernel": "none", "start": "consensus", "late": 0, "off": 0.0,
              "part": 100, "range_kernel": "quadratic"} | changed
    names = {2: ("seed", "every", "reach", "claimed"),
             3: ("seed", "slip", "assumed", "wrong", "kernel", "start"),
             4: ("seed", "late", "off", "part", "range_kernel")}
    draw = {2: explore.draw_cameras, 3: explore.draw_graphs, 4: explore.draw_ranges}
    return {chapter: draw[chapter](full[chapter], drive, **{name: values[name] for name in each})
            for chapter, each in names.items()}


@pytest.mark.slow
def test_with_truth_the_figures_of_a_dataset_show_errors(recorded):
    drive, _, full = recorded
    for fig in drawn_on(drive, full).values():
        plan, side = fig.axes
        assert side.get_ylabel() == "position error (mm)" and "NEES" in side.get_title("left")
        assert "truth" in curves(plan) and "No truth" not in fig.said and "Only" not in fig.said


@pytest.mark.slow
def test_without_truth_a_dataset_is_compared_with_its_solution_and_nothing_says_error(recorded):
    _, drive, full = recorded
    names = {2: "this chapter's fusion", 3: "problem 3's solution", 4: "problem 4's solution"}
    for chapter, fig in drawn_on(drive, full).items():
        plan, side = fig.axes
        assert side.get_ylabel() == f"distance from {names[chapter]} (mm)"
        assert f"No truth comes with b: distances are from {names[chapter]}" in fig.said
        texts = [fig.said, plan.get_title("left"), side.get_title("left"), side.get_ylabel(),
                 *curves(plan), *curves(side)]
        assert not [text for text in texts if re.search("NEES|error|true|^truth", text)]
        path = np.array(next(line.get_xydata() for line in plan.lines
                             if line.get_label() == names[chapter]))
        np.testing.assert_array_equal(path, full[chapter]["b"].poses[:, :2])
    same = curves(drawn_on(drive, full)[2].axes[1])["fused"]
    np.testing.assert_allclose(same, 0, atol=1e-6)      # of the same sightings, with the same slip


@pytest.mark.slow
def test_errors_of_the_controls_are_added_to_a_dataset(recorded):
    drive, _, full = recorded
    clean, spoilt = drawn_on(drive, full), drawn_on(drive, full, wrong=15, late=30, off=3.0)
    assert "0 of 32 markers more than 0.5 m from their true place" in clean[3].said
    assert re.search(r"15 % wrong labels added: .* maps [1-9]\d* of 32 .*, the rounds 0\.",
                     spoilt[3].said)
    away = {name: float(re.search(r"up to ([\d.]+) m from", figures[4].said)[1])
            for name, figures in (("clean", clean), ("spoilt", spoilt))}
    assert away["clean"] < 0.1 and away["spoilt"] > 2 * away["clean"]
    guess = {name: figures[4].axes[0].lines for name, figures in (("c", clean), ("s", spoilt))}
    guess = {name: next(line.get_xydata() for line in lines
                        if line.get_label() == "antennas: guess") for name, lines in guess.items()}
    np.testing.assert_array_equal(guess["c"], drive.dataset.antenna_guess.position)
    np.testing.assert_allclose(np.hypot(*(guess["s"] - guess["c"]).T), 3.0)


def test_truth_without_maps_says_nothing_of_landmarks(recorded):
    drive, _, full = recorded
    t = drive.truth
    bare = replace(t, marker=t.marker[:0], marker_in_world=t.marker_in_world[:0],
                   antenna=t.antenna[:0], antenna_in_world=t.antenna_in_world[:0])
    figures = drawn_on(Drive("a", drive.dataset, bare), full)
    assert figures[3].said == "0 % wrong labels added."
    assert figures[4].said == "0 % late ranges added."
    assert not {"true markers", "antennas: truth"} & {
        label for fig in figures.values() for label in curves(fig.axes[0])}


def test_of_a_long_dataset_the_first_part_is_drawn_and_said(recorded):
    _, drive, full = recorded
    often = replace(drive.dataset, name="b", ticks=np.concatenate([drive.dataset.ticks] * 11))
    rows = np.arange(0, 2000, 5)
    aruco = drive.dataset.aruco
    twice = aruco.select(np.r_[:len(aruco.pose), :len(aruco.pose)])
    twice = replace(twice, pose=np.r_[aruco.pose, 2000 + aruco.pose])
    part = parts.first_part(replace(often, aruco=twice), "aruco")
    assert len(part.ticks) == 2000 and len(np.unique(part.aruco.pose)) == parts.MAX_PART_FRAMES
    said = parts.data_sentences(Drive("b", replace(often, aruco=twice), None), part, "it")
    assert "Only the first 2,000 of the 22,000 poses of b are used." in said
    late = replace(often, aruco=replace(aruco, pose=20_000 + rows[aruco.pose % len(rows)] // 5))
    with pytest.raises(DatasetError, match="in the first 20,000 poses of b, found none"):
        parts.first_part(late, "aruco")
    assert len(parts.first_part(late).ticks) == parts.MAX_PART_POSES


@pytest.mark.slow
def test_a_million_poses_are_drawn_as_their_first_part(recorded):
    _, drive, full = recorded
    long = replace(drive.dataset, name="b", ticks=np.tile(drive.dataset.ticks, (500, 1)))
    poses = np.zeros((len(long.ticks), 3))
    full = {chapter: {"b": replace(found["b"], poses=poses)} for chapter, found in full.items()}
    figures = drawn_on(Drive("b", long, None), full) | {
        1: explore.draw_wheels(Drive("b", long, None), **WHEELS)}
    for fig in figures.values():
        assert "Only the first 20,000 of the 1,000,000 poses of b are used." in fig.said
        assert max(len(line.get_xdata()) for ax in fig.axes for line in ax.lines) == 20_000


def test_the_camera_can_be_seen_as_far_as_any_dataset_does(recorded):
    drive, _, _ = recorded
    a = drive.dataset.aruco
    near, far = (Drive("c", replace(drive.dataset, aruco=replace(
        a, marker_in_vehicle=a.marker_in_vehicle * [factor, factor, 1.0])), None)
        for factor in (0.5, 2.0))
    assert explore.camera_reach([near]) == 1.8                   # as far as the simulated one
    assert 3.5 < explore.camera_reach([drive, far, near]) < 3.8
    largest = np.hypot(*far.dataset.aruco.marker_in_vehicle[:, :2].T).max()
    assert 0 <= explore.camera_reach([far]) - largest < 0.1 + 1e-9
