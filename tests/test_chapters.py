"""Functions that chapters show are those of the library, where the chapter does not check it."""

from dataclasses import replace
from pathlib import Path

import nbformat
import numpy as np
from scipy.linalg import block_diag

from slamlib import increments, localization, se2
from slamlib.sightings import sightings_by_frame
from slamlib.simulation import simulate

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def shown(chapter, name):
    """The function `name` as a cell of the notebook `chapter` defines it."""
    source, = NOTEBOOKS.glob(f"{chapter}_*.ipynb")
    cell, = (cell.source for cell in nbformat.read(source, as_version=4).cells
             if cell.cell_type == "code" and f"def {name}(" in cell.source)
    names = {"np": np, "se2": se2}
    exec(cell, names)
    return names[name]


def test_two_steps_of_the_filter_of_chapter_2_are_those_of_fuse():
    """Between two frames, linearised at the nominal wheels and then at the wheels found."""
    dataset, slip = simulate("short", seed=3)[0], 1e-3
    g, v = sightings_by_frame(dataset.aruco), dataset.vehicle
    begin, end = g.frame[7], g.frame[8]
    earlier, later = (np.flatnonzero(g.row == row) for row in (7, 8))
    _, first, second = np.intersect1d(g.marker[earlier], g.marker[later], return_indices=True)
    first, second = earlier[first], later[second]
    ticks = dataset.ticks[begin:end + 1] * (np.arange(end - begin + 1) > 0)[:, None]
    start, ends, wheel = [0], [end - begin], v.wheel
    for _ in range(2):
        at = v.with_wheel(wheel)
        delta, by_w = increments.between_poses(ticks, at, start, ends, "arc")
        rounding, slipping = increments.noise_in_drive(ticks, at, start, ends)
        P = block_diag(np.diag([0, 0, v.sigma_heading, *v.sigma_wheel])**2, *g.C[first])
        X, w, P = shown(2, "filter_step")(
            np.zeros(3), v.wheel - wheel, g.z[first], P, delta[0], by_w[0],
            rounding[0] + slip**2 * slipping[0], g.z[second], g.C[second])
        wheel = wheel + w
    seen = dataset.aruco.select(np.isin(np.arange(len(dataset.aruco.pose)),
                                        g.index[np.r_[first, second]]))
    found = localization.fuse(replace(
        dataset, ticks=ticks, aruco=replace(seen, pose=seen.pose - begin)), slip)
    assert found.rejected == 0 and len(first) > 1
    np.testing.assert_allclose(X, found.poses[-1], atol=1e-9)
    np.testing.assert_allclose(P[:3, :3], found.covariances[-1], rtol=1e-6, atol=1e-14)
    np.testing.assert_allclose(wheel, found.wheel, atol=1e-12)
