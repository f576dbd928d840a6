"""A notebook is executed again when something changed that it depends on, and only then."""

import nbformat
import pytest
from nbformat.v4 import new_code_cell
from test_report import make_data, write

from slamlib.report import cache, document, execution
from slamlib.report.build import build_report


def execute_without_kernel(books, data, datasets, results, finish):
    """Count an execution of each notebook and write its output and its result, as kernels would."""
    for source in results:
        book = books[source]
        with open(source.parents[1] / f"count_{source.stem}", "a") as count:
            count.write("x")
        (results[source] / "short").mkdir()
        (results[source] / "short" / f"{source.stem}.mat").write_text("result")
        for cell in book.cells:
            if cell.cell_type == "code":
                cell.outputs = [nbformat.v4.new_output("stream", text="executed")]
        finish(source, book, 0.0)


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with two notebooks a and b, whose executions are counted; pages take no time."""
    monkeypatch.setattr(execution, "execute", execute_without_kernel)
    monkeypatch.setattr(document, "render", lambda books, *_: {
        f"{source.stem}.html": nbformat.writes(book).encode() for source, book in books.items()})
    make_data(tmp_path)
    for name in "ab":
        write(tmp_path / "notebooks", name, f"# {name}", ("1 + 1",), ("3 + 3",))
    return tmp_path


def executions(folder):
    """Build the report on `short`; return how often each notebook has been executed so far."""
    build_report(folder / "notebooks", folder / "data", folder / "report", folder / "results",
                 datasets=["short"], kept=folder / "kept")
    return tuple(len((folder / f"count_{name}").read_text()) for name in "ab")


def test_without_a_change_nothing_is_executed_and_lost_results_are_written_again(project, capsys):
    executions(project)
    page = (project / "report" / "a.html").read_bytes()
    a = project / "results" / "short" / "a.mat"
    b = project / "results" / "short" / "b.mat"
    a.write_text("changed")
    b.unlink()
    assert executions(project) == (1, 1)
    assert "2 of 2: b, nothing changed" in capsys.readouterr().err
    assert (project / "report" / "a.html").read_bytes() == page
    assert a.read_text() == b.read_text() == "result"


@pytest.mark.parametrize("change, is_set", [
    (lambda folder: None, False),
    (lambda folder: (folder / "report" / "a.html").unlink(), True),
    (lambda folder: add(folder, "notebooks/picture.svg"), True)])
def test_pages_are_set_again_only_where_one_is_lost_or_shows_something_else(
        project, capsys, change, is_set):
    executions(project)
    change(project)
    capsys.readouterr()
    executions(project)
    assert ("setting the pages" in capsys.readouterr().err) == is_set
    assert (project / "report" / "a.html").is_file()


def add(folder, name):
    """A file of this name in a folder that is made for it."""
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("value = 1")


def cells_changed(change):
    """What changes the list of cells of notebook a: its text and two code cells."""
    def changed(folder):
        book = nbformat.read(folder / "notebooks" / "a.ipynb", as_version=4)
        change(book.cells)
        nbformat.write(book, folder / "notebooks" / "a.ipynb")
    return changed


@pytest.mark.parametrize("change, counts", [
    (cells_changed(lambda cells: cells[1].update(source="1 + 2")), (2, 1)),
    (cells_changed(lambda cells: cells.append(new_code_cell("2 + 2"))), (2, 1)),
    (cells_changed(lambda cells: cells[1].metadata.update(tags=["lab-only"])), (2, 1)),
    (cells_changed(lambda cells: cells[0].update(source="# a, changed")), (1, 1)),
    (cells_changed(lambda cells: cells[1].update(execution_count=7)), (1, 1)),
    (lambda folder: add(folder, "data/short/new.txt"), (2, 2)),
    (lambda folder: add(folder, "data/long/new.txt"), (1, 1)),
    (lambda folder: add(folder, "notebooks/studies/rows.csv"), (2, 2)),
    (lambda folder: add(folder, "notebooks/.ipynb_checkpoints/a.ipynb"), (1, 1))])
def test_what_a_notebook_depends_on_counts_and_nothing_else(project, change, counts):
    assert executions(project) == (1, 1)
    change(project)
    assert executions(project) == executions(project) == counts


def test_changed_prose_is_shown_with_the_outputs_that_were_kept(project):
    executions(project)
    write(project / "notebooks", "a", "New prose.", "# a", ("1 + 1",), "More.", ("3 + 3",))
    executions(project)
    page = (project / "report" / "a.html").read_text()
    order = [page.index(text) for text in ("New prose.", "executed", "More.")]
    assert order == sorted(order)


@pytest.mark.parametrize("change, is_seen", [
    (lambda patch, folder: add(folder, "core/a.py"), True),
    (lambda patch, folder: add(folder, "notebook/a.mplstyle"), True),
    (lambda patch, folder: add(folder, "report/a.py"), False),
    (lambda patch, folder: patch.setattr(cache, "version", lambda package: "99"), True)])
def test_slamlib_s_code_but_for_the_report_and_the_packages_count(
        monkeypatch, tmp_path, change, is_seen):
    books = {tmp_path / "notebooks" / "a.ipynb": nbformat.v4.new_notebook()}
    monkeypatch.setattr(cache, "SLAMLIB", tmp_path / "slamlib")
    before = cache.keys(books, [])
    change(monkeypatch, tmp_path / "slamlib")
    assert (cache.keys(books, []) != before) == is_seen
