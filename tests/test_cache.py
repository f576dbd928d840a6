"""A notebook is executed again when something changed that it depends on, and only then."""

import os
import shutil

import joblib
import nbformat
import pytest
from nbformat.v4 import new_code_cell
from test_project import save_as_lab
from test_report import make_data, write

from slamlib.report import build, build_report, cache


def execute_without_kernel(books, environment, results, jobs, finish):
    """Count an execution of each notebook and write its output and its result, as kernels would."""
    for source, book in books.items():
        with open(source.parents[1] / f"count_{source.stem}", "a") as count:
            count.write("x")
        (results / "short").mkdir(parents=True, exist_ok=True)
        (results / "short" / f"{source.stem}.mat").write_text("result")
        for cell in book.cells:
            if cell.cell_type == "code":
                cell.outputs = [nbformat.v4.new_output("stream", text="executed")]
        finish(source, book, [f"short/{source.stem}.mat"])


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with two notebooks a and b, whose executions are counted; pages take no time."""
    monkeypatch.setattr(build, "execute", execute_without_kernel)
    monkeypatch.setattr(build, "render", lambda books, *_, **__: {
        f"{source.stem}.html": nbformat.writes(book).encode() for source, book in books.items()})
    make_data(tmp_path)
    for name in "ab":
        write(tmp_path / "notebooks", name, f"# {name}", ("1 + 1",))
    return tmp_path


def executions(folder, **options):
    """Build the report; return how often each notebook has been executed so far."""
    build_report(folder / "notebooks", folder / "data", folder / "report", folder / "results",
                 kept=folder / "kept", **options)
    return tuple(len((folder / f"count_{name}").read_text()) for name in "ab")


def pages(folder):
    return [(folder / "report" / f"{name}.html").read_bytes() for name in "ab"]


def test_without_a_change_nothing_is_executed_and_results_that_are_gone_are_written_again(
        project, capsys):
    assert executions(project) == (1, 1)
    before = pages(project)
    capsys.readouterr()
    assert executions(project) == (1, 1)
    told = capsys.readouterr().err
    assert told.count("nothing changed, not executed again") == 2 and "built in" in told
    assert pages(project) == before
    a, b = (project / "results" / "short" / name for name in ("a.mat", "b.mat"))
    a.write_text("changed")
    b.unlink()
    assert executions(project) == (1, 1)
    assert a.read_text() == b.read_text() == "result"


def test_a_changed_dataset_executes_all_and_fresh_does_so_without_a_change(project):
    """Another selection and back executes each notebook once for each."""
    assert executions(project, datasets=["short"]) == (1, 1)
    (project / "data" / "long" / "encoderReading.txt").write_text("1 0 0\n2 3 3\n")
    assert executions(project, datasets=["short"]) == (1, 1)  # not selected
    assert executions(project) == (2, 2)
    assert executions(project, datasets=["short"]) == executions(project) == (2, 2)
    (project / "data" / "short" / "encoderReading.txt").write_text("1 0 0\n2 3 3\n")
    assert executions(project, datasets=["short"]) == (3, 3)
    assert executions(project, datasets=["short"], fresh=True) == (4, 4)
    assert executions(project, datasets=["short"]) == (4, 4)


def test_the_versions_used_last_are_kept_and_other_notebooks_are_left_alone(tmp_path):
    kept, book = tmp_path / "kept", nbformat.v4.new_notebook()
    sources = [tmp_path / name for name in ("a.ipynb", "a.b.ipynb", "[a].ipynb")]
    for source in sources:
        cache.keep(kept, source, "0", book, tmp_path, [])

    def is_kept(source, key):
        return cache.recall(kept, source, key, book, tmp_path) is not None

    for key in "1234":
        assert is_kept(sources[0], "0")  # used, so it stays
        cache.keep(kept, sources[0], key, book, tmp_path, [])
    assert [key for key in "01234" if is_kept(sources[0], key)] == list("0234")
    assert all(is_kept(source, "0") for source in sources[1:])
    assert len(list(kept.iterdir())) == cache.VERSIONS + 2


def executed(folder):
    """The executed notebook a that is kept."""
    file, = (folder / "kept").glob("a.*.executed")
    return file


def add(folder, name):
    """A file of this name in a folder that is made for it."""
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("value = 1")


def cells_changed(change):
    """What changes the list of cells of notebook a: its text and a code cell, and another one."""
    def changed(folder):
        book = nbformat.read(folder / "notebooks" / "a.ipynb", as_version=4)
        change(book.cells)
        nbformat.write(book, folder / "notebooks" / "a.ipynb")
    return changed


@pytest.mark.parametrize("change, counts", [
    (lambda folder: executed(folder).unlink(), (2, 1)),
    (lambda folder: executed(folder).write_bytes(executed(folder).read_bytes()[:-9]), (2, 1)),
    (lambda folder: joblib.dump([1, 2, 3], executed(folder)), (2, 1)),
    (cells_changed(lambda cells: cells[1].update(source="1 + 2")), (2, 1)),
    (cells_changed(lambda cells: cells.append(new_code_cell("2 + 2"))), (2, 1)),
    (cells_changed(lambda cells: cells.pop()), (2, 1)),
    (cells_changed(lambda cells: cells.insert(0, cells.pop())), (2, 1)),
    (cells_changed(lambda cells: cells[1].metadata.update(tags=["lab-only"])), (2, 1)),
    (cells_changed(lambda cells: cells[1].metadata.update(tags=["raises-exception"])), (2, 1)),
    (cells_changed(lambda cells: cells[1].metadata.update(tags=["hide-input"])), (1, 1)),
    (lambda folder: add(folder, "data/short/new.txt"), (2, 2)),
    (lambda folder: add(folder, "notebooks/helper.py"), (2, 2)),
    (lambda folder: add(folder, "notebooks/a/report/c.py"), (2, 2)),
    (lambda folder: add(folder, "notebooks/helpers/__pycache__/c.pyc"), (1, 1)),
    (lambda folder: add(folder, "notebooks/.ipynb_checkpoints/a.ipynb"), (1, 1)),
    (lambda folder: add(folder, "notebooks/results/a/b.mat"), (1, 1)),
    (lambda folder: add(folder, "notebooks/helpers/d.ipynb"), (1, 1)),
    (lambda folder: os.environ.update(SLAMLIB_OWN="x"), (2, 2)),
    (lambda folder: os.environ.update(OWN="x", PYTHON="python3"), (1, 1))])
def test_what_a_notebook_depends_on_and_damage_count_and_nothing_else(
        project, monkeypatch, change, counts):
    for name in ("SLAMLIB_OWN", "OWN", "PYTHON"):
        monkeypatch.setenv(name, "")                     # undone at the end
    cells_changed(lambda cells: cells.append(new_code_cell("3 + 3")))(project)
    assert executions(project) == executions(project) == (1, 1)
    change(project)
    assert executions(project) == executions(project) == counts


def test_slamlib_and_the_packages_are_among_what_matters(monkeypatch, tmp_path):
    def key():
        source = tmp_path / "notebooks" / "a.ipynb"
        return cache.keys({source: nbformat.v4.new_notebook()}, [], {})[source]

    found = [key()]
    (tmp_path / "site" / "package-1.0.dist-info").mkdir(parents=True)
    monkeypatch.syspath_prepend(tmp_path / "site")
    found.append(key())
    (tmp_path / "site" / "package-1.0.dist-info").rename(tmp_path / "site/package-1.1.dist-info")
    found.append(key())
    (tmp_path / "site" / "other.egg-info").mkdir()          # beside the sources, and of no version
    (tmp_path / "site" / "slamlib-9.dist-info").mkdir()
    copied = shutil.copytree(cache.SLAMLIB, tmp_path / "elsewhere")
    monkeypatch.setattr(cache, "SLAMLIB", copied)                            # as by pip install
    assert key() == found[-1]
    monkeypatch.setattr(cache, "SLAMLIB", tmp_path)
    assert len({*found, key()}) == 4


def test_saved_outputs_and_changed_prose_cost_no_execution(project, capsys):
    executions(project)
    before = pages(project)
    for name in "ab":
        save_as_lab(project / "notebooks" / f"{name}.ipynb")
    assert executions(project) == (1, 1)
    assert capsys.readouterr().err.count("nothing changed, not executed again") == 2
    outputs = [[cell.get("outputs") for cell in nbformat.reads(page.decode(), 4).cells]
               for page in (*before, *pages(project))]
    assert outputs[:2] == outputs[2:] and "executed" in str(outputs)
    write(project / "notebooks", "a", "New prose.", "# a, changed", "More.", ("1 + 1",), "An end.")
    assert executions(project) == (1, 1)
    page = pages(project)[0].decode()
    order = [page.index(text) for text in ("New prose.", "More.", "executed", "An end.")]
    assert order == sorted(order)
