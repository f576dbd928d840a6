"""A notebook is executed again when something changed that it depends on, and only then."""

import shutil

import joblib
import nbformat
import pytest
from nbformat.v4 import new_code_cell
from test_report import make_data, write
from test_strip import save_as_lab

from slamlib.report import build, build_report, cache
from slamlib.studies import memory


def execute_without_kernel(books, environment, results, jobs, finish):
    """Count an execution of each notebook and write its output and its result, as kernels would."""
    for source, book in books.items():
        with open(source.parents[1] / f"count_{source.stem}", "a") as count:
            count.write("x")
        (results / "short").mkdir(parents=True, exist_ok=True)
        (results / "short" / f"{source.stem}.mat").write_text("result")
        cell, = (cell for cell in book.cells if cell.cell_type == "code")
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


def test_a_changed_notebook_is_executed_again_and_only_that_one(project, capsys):
    assert executions(project) == (1, 1)
    before = pages(project)
    capsys.readouterr()
    assert executions(project) == (1, 1)
    told = capsys.readouterr().err
    assert told.count("nothing changed, not executed again") == 2 and "built in" in told
    assert pages(project) == before
    write(project / "notebooks", "b", "# b", ("1 + 2",))
    assert executions(project) == (1, 2)


def test_results_that_are_gone_or_changed_are_written_again_without_an_execution(project):
    assert executions(project) == (1, 1)
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


@pytest.fixture
def kept(tmp_path):
    """A notebook that is kept with one result; returns a function that recalls it, or None."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "ticks.txt").write_text("1 0 0")
    write(tmp_path / "notebooks", "a", "# a", ("1 + 1",))
    source = tmp_path / "notebooks" / "a.ipynb"
    book = nbformat.read(source, as_version=4)
    results = tmp_path / "results"
    results.mkdir()
    (results / "a.mat").write_text("result")

    def key(variables):
        common = cache.fingerprint([tmp_path / "data"], source.parent, variables)
        return cache.key_of(source, book, common)

    def recall(**variables):
        now = nbformat.read(source, as_version=4)
        names = cache.recall(tmp_path / "kept", source, key(variables), now, results)
        return names if names is None else (now, names)

    book.cells[1].outputs = [nbformat.v4.new_output("stream", text="2")]
    cache.keep(tmp_path / "kept", source, key({}), book, results, ["a.mat"])
    return recall


def test_what_is_kept_is_recalled_with_its_results(kept, tmp_path):
    result = tmp_path / "results" / "a.mat"
    result.unlink()
    book, names = kept()
    assert book.cells[1].outputs[0].text == "2" and names == ["a.mat"]
    assert result.read_text() == "result"
    assert kept(HOME="/elsewhere", PYTHON="python3", SLAMLIB_STUDIES="/x") is not None
    assert kept(SLAMLIB_DATASETS="x") is None


def executed(folder):
    """The only executed notebook that is kept in this folder."""
    file, = (folder / "kept").glob("*.executed")
    return file


def write_helper(folder, name):
    """A module that notebooks in this folder may import."""
    file = folder / "notebooks" / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("value = 1")


@pytest.mark.parametrize("change", [
    lambda folder: executed(folder).unlink(),
    lambda folder: executed(folder).write_bytes(b"\xff\x00 not this"),
    lambda folder: executed(folder).write_bytes(executed(folder).read_bytes()[:-9]),
    lambda folder: joblib.dump([1, 2], executed(folder)),
    lambda folder: joblib.dump(["another key", [], {}], executed(folder)),
    lambda folder: (folder / "data" / "new.txt").write_text("new"),
    lambda folder: write_helper(folder, "helper.py"),
    lambda folder: write_helper(folder, "a/b/c.py"),
])
def test_a_change_or_a_damaged_file_is_as_if_nothing_were_kept(kept, tmp_path, change):
    assert kept() is not None
    change(tmp_path)
    assert kept() is None


@pytest.mark.parametrize("name", [
    "helpers/__pycache__/c.pyc", ".ipynb_checkpoints/a.ipynb", "b.ipynb", "results/a/b.mat",
    "helpers/d.ipynb"])
def test_what_kernels_editors_and_builds_write_beside_a_notebook_does_not_matter(
        kept, tmp_path, name):
    write_helper(tmp_path, name)
    assert kept() is not None


def test_slamlib_and_the_packages_are_among_what_matters(monkeypatch, tmp_path):
    found = [cache.fingerprint([], tmp_path, {})]
    (tmp_path / "site" / "package-1.0.dist-info").mkdir(parents=True)
    monkeypatch.syspath_prepend(tmp_path / "site")
    found.append(cache.fingerprint([], tmp_path, {}))
    (tmp_path / "site" / "package-1.0.dist-info").rename(tmp_path / "site/package-1.1.dist-info")
    found.append(cache.fingerprint([], tmp_path, {}))
    (tmp_path / "site" / "other.egg-info").mkdir()          # beside the sources, and of no version
    (tmp_path / "site" / "slamlib-9.dist-info").mkdir()
    assert cache.fingerprint([], tmp_path, {}) == found[-1]
    before = cache.fingerprint([], tmp_path / "site", {})
    copied = shutil.copytree(memory.SLAMLIB, tmp_path / "elsewhere")
    monkeypatch.setattr(memory, "SLAMLIB", copied)                            # as by pip install
    assert cache.fingerprint([], tmp_path / "site", {}) == before
    monkeypatch.setattr(memory, "SLAMLIB", tmp_path)
    assert len({*found, cache.fingerprint([], tmp_path, {})}) == 4


@pytest.fixture
def read(tmp_path):
    """A notebook with two code cells, and a function that returns its key."""
    book = nbformat.v4.new_notebook(cells=[
        nbformat.v4.new_markdown_cell("# a"), new_code_cell("1 + 1"), new_code_cell("2 + 2")])
    return book, lambda: cache.key_of(tmp_path / "a.ipynb", book, "")


@pytest.mark.parametrize("change", [
    lambda cells: cells[1].update(source="1 + 2"), lambda cells: cells.append(cells[1]),
    lambda cells: cells.pop(), lambda cells: cells.insert(0, cells.pop()),
    lambda cells: cells[2].metadata.update(tags=["lab-only"]),
    lambda cells: cells[2].metadata.update(tags=["raises-exception"])])
def test_code_cells_their_order_and_the_tags_that_nbclient_heeds_matter(read, change):
    book, key = read
    before = key()
    change(book.cells)
    assert key() != before


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
