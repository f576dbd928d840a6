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
MAX_NAMES = 12               # imported before the first result


def cells_of(source, kind="code"):
    return [cell for cell in nbformat.read(source, as_version=4).cells if cell.cell_type == kind]


def has(cell, tag):
    return tag in cell.metadata.get("tags", ())


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda path: path.stem)
def test_captions_are_in_order_and_a_chapter_ends_with_what_was_learned_and_try_it(source):
    cells = cells_of(source, "markdown")
    headings = re.findall("(?m)^## (.+)$", "\n".join(cell.source for cell in cells))
    numbered = [heading for heading in headings if heading not in ("References", "Try it")]
    numbers = [heading.split()[0] for heading in numbered]
    assert numbers == [f"{source.name[0]}.{n}" for n in range(1, len(numbers) + 1)]
    assert headings[-1] == "Try it" and numbered[-1].endswith(" What was learned")
    assert all(has(cell, "lab-only") == (i >= next(
        i for i, cell in enumerate(cells) if cell.source.startswith("## Try it")))
        for i, cell in enumerate(cells))
    text = "\n".join(cell.source for cell in nbformat.read(source, as_version=4).cells)
    for kind in ("Figure", "Table"):
        numbers = re.findall(rf'^(?:.*")?{kind} (\d+\.\d+)\. ', text, re.MULTILINE)
        assert numbers == [f"{source.name[0]}.{n}" for n in range(1, len(numbers) + 1)]
        for number in numbers:
            assert re.search(rf"(?i){kind}s? (\S+ and )?{re.escape(number)}(?!\. \S)", text), number


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda path: path.stem)
def test_code_is_short_and_mostly_shown_and_what_pages_fold_is_collapsed_in_jupyterlab(source):
    code = cells_of(source)
    assert max(len(cell.source.splitlines()) for cell in code) <= 25
    lines = {tag: sum(bool(line.strip()) for cell in code if has(cell, tag) or tag == "all"
                      for line in cell.source.splitlines())
             for tag in ("all", "hide-input", "lab-only")}
    assert lines["all"] <= 260
    assert lines["hide-input"] < (lines["all"] - lines["lab-only"]) / 2
    for cell in code:
        assert cell.metadata.get("jupyter", {}).get("source_hidden", False) == has(
            cell, "hide-input")


def names_of(source):
    """Global names that code defines, imports and uses, in its functions too: three sets."""
    whole = symtable.symtable(source, "cell", "exec")
    tables, used = [whole], set()
    while tables:
        table = tables.pop()
        used |= {each.get_name() for each in table.get_symbols()
                 if each.is_global() or table is whole and each.is_referenced()}
        tables += table.get_children()
    return ({each.get_name() for each in whole.get_symbols() if each.is_assigned()},
            {each.get_name() for each in whole.get_symbols() if each.is_imported()}, used)


@pytest.mark.parametrize("source", CHAPTERS, ids=lambda path: path.stem)
def test_what_is_shown_runs_without_what_is_hidden_and_imports_few_names(source):
    hidden, shown, needed, first, solved = set(), set(), set(), set(), False
    for cell in cells_of(source):
        assigned, imported, used = names_of(cell.source)
        solved = solved or "write_results(" in cell.source
        first |= set() if solved else imported
        if has(cell, "hide-input"):
            hidden |= assigned | imported
        elif not has(cell, "lab-only"):
            shown |= assigned | imported
            needed |= used - shown
    assert needed & hidden == set() and len(first) <= MAX_NAMES


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
    exec(cell.source, known)
    delta, by_w = increments.between_poses(ticks, v, start, ends, "arc")
    rounding, slipping = increments.noise_in_drive(ticks, v, start, ends)
    P = block_diag(np.diag([0, 0, v.sigma_heading, *v.sigma_wheel])**2, *g.C[first])
    X, w, P = known["filter_step"](
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
