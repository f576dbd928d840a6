"""Before numpy is imported: matrices are small, and more threads only wait for each other."""

import os
import shutil
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import pytest
from hypothesis import settings

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):  # as notebooks have it
    os.environ.setdefault(name, "1")

settings.register_profile("short", derandomize=True, deadline=None, database=None, max_examples=40)
settings.register_profile("long", deadline=None, database=None, max_examples=1000,
                          print_blob=True)
settings.load_profile("short")           # another one by `pytest --hypothesis-profile=NAME`

ROOT = Path(__file__).parents[1]
# By the seconds of processors that they take: several processes take one file after the other.
FIRST = ("test_pages test_studies test_slam test_localization test_calibration test_jumps test_uwb "
         "test_concurrency test_part_faults test_results test_numbers test_properties test_memory ")
BROWSERS = "chromium chromium-browser google-chrome".split()


def pytest_collection_modifyitems(items):
    """The files that take longest come first, so that both processes end at about the same time."""
    items.sort(key=lambda item: (FIRST + item.path.stem).index(item.path.stem))


def pytest_terminal_summary(terminalreporter):
    """Tells which studies were computed by older code, or other packages, than are here."""
    from slamlib.studies.runs import made_by
    old = [file.stem for file in sorted((ROOT / "notebooks" / "studies").glob("*.csv"))
           if not file.read_text().startswith(made_by())]
    if old:
        terminalreporter.write_line(
            f"Studies of other code or packages, which 'make studies' renews: {', '.join(old)}.")


@pytest.fixture(scope="module")
def chromium():
    """A headless Chromium that finds no host but this one (a playwright Browser).

    While it runs, asyncio counts as running in this thread, and no report can be built. So it runs
    for a module at a time, after the pages that it looks at were built.
    """
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip(f"no browser here: none of {', '.join(BROWSERS)}")
    from playwright.sync_api import sync_playwright
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=[
            "--no-sandbox", "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"])
        yield browser
        browser.close()


@pytest.fixture
def look():
    """The look of the notebooks' figures; they are closed, and the look is undone."""
    import matplotlib.pyplot as plt

    from slamlib.notebook import plotting
    plt.close("all")                                 # the README's example leaves one open
    with plt.rc_context():
        plt.style.use(plotting.STYLE)
        yield
        plt.close("all")


def copied(target, chapters, first=None):
    """Write notebooks to a folder, by a pattern of their names.

    A code cell `first` (str) stands before all others. What stands beside them comes along.
    """
    import nbformat
    shutil.copytree(ROOT / "notebooks" / "studies", target / "studies")
    shutil.copy(ROOT / "notebooks" / "graph.svg", target)
    for source in sorted((ROOT / "notebooks").glob(chapters)):
        book = nbformat.read(source, as_version=4)
        if first:
            book.cells.insert(1, nbformat.v4.new_code_cell(first, id="first"))
        nbformat.write(book, target / source.name)


def run_cells(notebook, folder, monkeypatch):
    """Run the cells of a notebook on folder/data, but for those that JupyterLab has alone.

    They run in this process, and draw no figure to show it.
    """
    import nbformat
    monkeypatch.chdir(notebook.parent)
    monkeypatch.setenv("SLAMLIB_DATA", str(folder / "data"))
    monkeypatch.setenv("SLAMLIB_RESULTS", str(folder / "results"))
    names = {}
    for cell in nbformat.read(notebook, as_version=4).cells:
        if cell.cell_type == "code" and "lab-only" not in cell.metadata.get("tags", ()):
            exec(cell.source, names)


def contradicted(dataset):
    """The Dataset with a second place for every sighting: problem 2 cannot be solved."""
    import numpy as np
    twice = dataset.aruco.select(np.repeat(np.arange(len(dataset.aruco.pose)), 2))
    twice.marker_in_vehicle[1::2] += [5.0, 3.0, 1.0]
    return replace(dataset, aruco=twice)


def file_names(folder):
    """Sorted names of all files in a folder, relative to it."""
    paths = [path for path in folder.rglob("*") if not path.is_dir()]
    return sorted(path.relative_to(folder).as_posix() for path in paths)


def built_elsewhere(*arguments, **options):
    """The Report of `build_report`, built in a process of its own.

    A large PDF leaves a fragmented heap, in which all numerics take a third longer.
    """
    from slamlib.report.build import build_report
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
        return process.submit(build_report, *arguments, **options).result()


@pytest.fixture(scope="session")
def report_on_all(tmp_path_factory):
    """A folder with data, report and results: drives of data/, and what else a user may bring.

    All but `short` are cut to 300 or 900 poses: no assertion on the pages needs more. One waits for
    100 poses, and has wheels only.
    """
    import numpy as np
    from numeric import only

    from slamlib.studies.simulation import simulate, write_dataset
    folder = tmp_path_factory.mktemp("built")
    data = folder / "data"
    shutil.copytree(ROOT / "data", data, ignore=lambda *_: ["long"])
    write_dataset(data / "long", *simulate("long", 2, poses=900, late_ranges=0.05))
    new, truth = simulate("short", 77, poses=300, late_ranges=0.15)
    bare = new.without("aruco").without("uwb")
    for name, dataset, true in (
            ("no truth", new, None),
            ("wheels_only", replace(bare, ticks=np.r_[np.zeros((100, 2)), bare.ticks[:200]]), None),
            ("one_pose", bare.first(1), None),
            ("one_sighting", only(new, [0]), truth),
            ("sparse", only(new, new.aruco.pose % 150 == 0), truth)):
        write_dataset(data / name, dataset, true)
    copied(folder / "notebooks", "*.ipynb")
    built_elsewhere(folder / "notebooks", data, folder / "report", folder / "results",
                    folder / "kept", [each.name for each in data.iterdir() if each.is_dir()])
    return folder
