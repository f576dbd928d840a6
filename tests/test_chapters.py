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
        assert len(cell.source.splitlines()) <= 25
        collapsed = cell.metadata.get("jupyter", {}).get("source_hidden", False)
        assert collapsed == has(cell, "hide-input")


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
    """Between two frames, linearised at the nominal wheels and then at the wheels found."""
    dataset, _ = simulate("short", seed=3)
    slip = 1e-3
    v = dataset.vehicle
    g = sightings_by_frame(dataset.aruco)
    begin, end = g.frame[7], g.frame[8]
    _, first, second = np.intersect1d(
        g.marker[g.row == 7], g.marker[g.row == 8], return_indices=True)
    first = np.flatnonzero(g.row == 7)[first]
    second = np.flatnonzero(g.row == 8)[second]
    ticks = dataset.ticks[begin:end + 1].copy()
    ticks[0] = 0
    cell, = (each for each in cells_of(CHAPTERS[1]) if "def filter_step(" in each.source)
    known = {"np": np, "se2": se2}
    exec(cell.source, known)
    P = block_diag(np.diag([0, 0, v.sigma_heading, *v.sigma_wheel])**2, *g.C[first])
    wheel = v.wheel
    for _ in range(2):
        drive = ticks, v.with_wheel(wheel), [0], [end - begin]
        delta, by_w = increments.between_poses(*drive, "arc")
        rounding, slipping = increments.noise_in_drive(*drive)
        X, w, found_P = known["filter_step"](
            np.zeros(3), v.wheel - wheel, g.z[first], P, delta[0], by_w[0],
            rounding[0] + slip**2 * slipping[0], g.z[second], g.C[second])
        wheel = wheel + w
    seen = dataset.aruco.select(np.sort(g.index[np.append(first, second)]))
    found = fuse(replace(
        dataset, ticks=ticks, aruco=replace(seen, pose=seen.pose - begin)), slip)
    assert found.rejected == 0 and len(first) > 1
    np.testing.assert_allclose(X, found.poses[-1], atol=1e-9)
    np.testing.assert_allclose(found_P[:3, :3], found.covariances[-1], rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(wheel, found.wheel, atol=1e-12)
