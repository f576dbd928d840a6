"""The notebooks as they are written, and what they show and do not check themselves."""

import re
import symtable
from dataclasses import replace

import nbformat
import numpy as np
import pytest
from conftest import ROOT
from scipy.linalg import block_diag

from slamlib import fuse
from slamlib.core import increments, se2
from slamlib.core.sightings import sightings_by_frame
from slamlib.studies.simulation import simulate

CHAPTERS = sorted((ROOT / "notebooks").glob("[0-9]*.ipynb"))


def cells_of(source, kind="code"):
    return [cell for cell in nbformat.read(source, as_version=4).cells if cell.cell_type == kind]


def has(cell, tag):
    return tag in cell.metadata.get("tags", ())


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda path: path.stem)
def test_sections_figures_and_tables_are_numbered_in_order_and_try_it_is_last(source):
    cells = nbformat.read(source, as_version=4).cells
    text = "\n".join(cell.source for cell in cells)
    headings = re.findall("(?m)^## (.+)$", text)
    assert headings[-1] == "Try it"
    sections = [heading.split()[0] for heading in headings
                if heading not in ("References", "Try it")]
    for kind, found in (("Section", sections), ("Figure", numbers_of("Figure", text)),
                        ("Table", numbers_of("Table", text))):
        assert found == [f"{source.name[0]}.{n}" for n in range(1, len(found) + 1)], kind
    first = next(i for i, cell in enumerate(cells) if cell.source.startswith("## Try it"))
    assert [has(cell, "lab-only") for cell in cells] == [i >= first for i in range(len(cells))]


def numbers_of(kind, text):
    """Numbers of the captions of figures or tables, each of which the text refers to."""
    numbers = re.findall(rf'^(?:.*")?{kind} (\d+\.\d+)\. ', text, re.MULTILINE)
    for number in numbers:
        assert re.search(rf"(?i){kind}s? (\S+ and )?{re.escape(number)}(?!\. \S)", text), number
    return numbers


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda path: path.stem)
def test_code_is_short_and_what_pages_fold_is_collapsed_in_jupyterlab(source):
    for cell in cells_of(source):
        assert len(cell.source.splitlines()) <= 20
        collapsed = cell.metadata.get("jupyter", {}).get("source_hidden", False)
        assert collapsed == has(cell, "hide-input")


@pytest.mark.parametrize("source", CHAPTERS[2:4], ids=lambda path: path.stem)
def test_gtsam_solves_the_drives_within_the_first_600_words(source):
    words = 0
    for cell in nbformat.read(source, as_version=4).cells:
        if "solve_graph(" in cell.source:
            break
        if cell.cell_type == "markdown":
            words += len(cell.source.split())
    assert words <= 600


def names_of(source):
    """Global names that code binds and uses, in its functions too: two sets."""
    whole = symtable.symtable(source, "cell", "exec")
    bound = {each.get_name() for each in whole.get_symbols()
             if each.is_assigned() or each.is_imported()}
    used = {each.get_name() for each in whole.get_symbols() if each.is_referenced()}
    tables = whole.get_children()
    while tables:
        table = tables.pop()
        used |= {each.get_name() for each in table.get_symbols() if each.is_global()}
        tables += table.get_children()
    return bound, used


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda path: path.stem)
def test_what_is_shown_runs_without_what_is_hidden(source):
    hidden = set()
    shown = set()
    for cell in cells_of(source):
        bound, used = names_of(cell.source)
        if has(cell, "hide-input"):
            hidden |= bound - shown
        elif not has(cell, "lab-only"):
            shown |= bound
            assert not (used - shown) & hidden


def test_two_steps_of_the_filter_of_chapter_2_are_those_of_fuse():
    """Between two frames, linearised at the stated wheels."""
    dataset, slip = simulate("short", seed=3)[0], 1e-3
    g, v = sightings_by_frame(dataset.aruco), dataset.vehicle
    begin, end = g.frame[7], g.frame[8]
    earlier, later = (np.flatnonzero(g.row == row) for row in (7, 8))
    _, first, second = np.intersect1d(g.marker[earlier], g.marker[later], return_indices=True)
    first, second = earlier[first], later[second]
    ticks = dataset.ticks[begin:end + 1] * (np.arange(end - begin + 1) > 0)[:, None]
    start, ends, known = [0], [end - begin], {"np": np, "se2": se2}
    cell, = (each for each in cells_of(CHAPTERS[1]) if "def filter_step(" in each.source)
    known = {"np": np, "se2": se2}
    exec(cell.source, known)
    delta, by_w = increments.between_poses(ticks, v, start, ends, "arc")
    rounding, slipping = increments.noise_in_drive(ticks, v, start, ends)
    P = block_diag(np.diag([0, 0, v.sigma_heading, *v.sigma_wheel])**2, *g.C[first])
    X, w, _, P = known["filter_step"](
        np.zeros(3), np.zeros(3), g.z[first], P, delta[0], by_w[0],
        rounding[0] + slip**2 * slipping[0], g.z[second], g.C[second])
    seen = dataset.aruco.select(np.isin(np.arange(len(dataset.aruco.pose)),
                                        g.index[np.r_[first, second]]))
    found = fuse(replace(
        dataset, ticks=ticks, aruco=replace(seen, pose=seen.pose - begin)), slip)
    assert found.rejected == 0 and len(first) > 1
    np.testing.assert_allclose(X, found.poses[-1], atol=1e-9)
    np.testing.assert_allclose(P[:3, :3], found.covariances[-1], rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(v.wheel + w, found.wheel, atol=1e-12)
