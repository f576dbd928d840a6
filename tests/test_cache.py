"""A notebook is executed again when something changed that it depends on, and only then."""

from importlib.metadata import distributions

import nbformat
import pytest
from test_report import make_data, write

from slamlib.report import build, build_report, cache
from slamlib.studies import memory


def execute_without_kernel(books, environment, results, jobs, finish):
    """Count an execution of each notebook and write its output and its result, as kernels would."""
    for source, book in books.items():
        with open(source.parents[1] / f"count_{source.stem}", "a") as count:
            count.write("x")
        (results / "short").mkdir(parents=True, exist_ok=True)
        (results / "short" / f"{source.stem}.mat").write_text("")
        book.cells[1].outputs = [nbformat.v4.new_output("stream", text="executed")]
        finish(source, book, [f"short/{source.stem}.mat"])


@pytest.fixture(autouse=True)
def no_packages(monkeypatch):
    """Reading what is installed takes 0.1 s; one test does so."""
    monkeypatch.setattr(cache, "distributions", lambda: [])


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A folder with two notebooks a and b, whose executions are counted."""
    monkeypatch.setattr(build, "execute", execute_without_kernel)
    make_data(tmp_path)
    for name in "ab":
        write(tmp_path / "notebooks", name, f"# {name}", ("1 + 1",))
    return tmp_path


def executions(folder, **options):
    """Build the report; return how often each notebook has been executed so far."""
    build_report(folder / "notebooks", folder / "data", folder / "report", folder / "results",
                 kept=folder / "kept", **options)
    return tuple(len((folder / f"count_{name}").read_text()) for name in "ab")


def test_a_changed_notebook_is_executed_again_and_only_that_one(project, capsys):
    assert executions(project) == (1, 1)
    pages = [file.read_bytes() for file in sorted((project / "report").iterdir())]
    capsys.readouterr()
    assert executions(project) == (1, 1)
    told = capsys.readouterr().err
    assert told.count("nothing changed, not executed again") == 2
    assert "built in" in told and "MB" in told
    assert [file.read_bytes() for file in sorted((project / "report").iterdir())] == pages
    write(project / "notebooks", "b", "# b, changed", ("1 + 1",))
    assert executions(project) == (1, 2)
    (project / "results" / "short" / "a.mat").write_text("changed")
    assert executions(project) == (2, 2)
    (project / "results" / "short" / "b.mat").unlink()
    assert executions(project) == (2, 3)
    assert (project / "results" / "short" / "b.mat").read_text() == ""


def test_a_changed_dataset_executes_all_and_fresh_does_so_without_a_change(project):
    assert executions(project, datasets=["short"]) == (1, 1)
    (project / "data" / "long" / "encoderReading.txt").write_text("1 0 0\n2 3 3\n")
    assert executions(project, datasets=["short"]) == (1, 1)  # not selected
    (project / "data" / "short" / "encoderReading.txt").write_text("1 0 0\n2 3 3\n")
    assert executions(project, datasets=["short"]) == (2, 2)
    assert executions(project, datasets=["short"], fresh=True) == (3, 3)
    assert executions(project, datasets=["short"]) == (3, 3)


def test_another_selection_and_back_executes_each_notebook_once_for_each(project):
    assert executions(project, datasets=["short"]) == (1, 1)
    first = [file.read_bytes() for file in sorted((project / "report").iterdir())]
    assert executions(project) == (2, 2)
    assert executions(project, datasets=["short"]) == executions(project) == (2, 2)
    executions(project, datasets=["short"])
    assert [file.read_bytes() for file in sorted((project / "report").iterdir())] == first
    (project / "results" / "short" / "a.mat").write_text("changed")  # of neither selection now
    assert executions(project, datasets=["short"]) == (3, 2)
    assert executions(project) == (3, 2)


def test_the_versions_used_last_are_kept_and_other_notebooks_are_left_alone(tmp_path):
    kept, book = tmp_path / "kept", nbformat.v4.new_notebook()
    sources = [tmp_path / name for name in ("a.ipynb", "a.b.ipynb", "[a].ipynb")]
    for source in sources:
        cache.keep(kept, source, "0", book, tmp_path, [])
    for key in "1234":
        assert cache.recall(kept, sources[0], "0", tmp_path)  # used, so it stays
        cache.keep(kept, sources[0], key, book, tmp_path, [])
    assert [key for key in "01234" if cache.recall(kept, sources[0], key, tmp_path)] == list("0234")
    assert all(cache.recall(kept, source, "0", tmp_path) for source in sources[1:])
    assert len(list(kept.iterdir())) == cache.VERSIONS + 2


@pytest.fixture
def kept(tmp_path):
    """A notebook that is kept with one result; returns a function that recalls it."""
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "ticks.txt").write_text("1 0 0")
    write(tmp_path, "a", "# a", ("1 + 1",))
    source, book = tmp_path / "a.ipynb", nbformat.read(tmp_path / "a.ipynb", as_version=4)
    (tmp_path / "a.mat").write_text("result")

    def key(variables):
        common = cache.fingerprint([tmp_path / "data"], tmp_path, variables)
        return cache.key_of(source, book, common)

    cache.keep(tmp_path / "kept", source, key({}), book, tmp_path, ["a.mat"])
    return lambda **variables: cache.recall(tmp_path / "kept", source, key(variables), tmp_path)


def test_what_is_kept_is_recalled_with_its_results(kept):
    book, names = kept()
    assert book.cells[1].source == "1 + 1" and names == ["a.mat"]
    assert kept(HOME="/elsewhere") is not None  # of no matter to a notebook


@pytest.mark.parametrize("variable", ["SLAMLIB_DATASETS", "PYTHONPATH", "OMP_NUM_THREADS", "TZ"])
def test_variables_that_matter_are_seen(kept, variable):
    assert kept(**{variable: "x"}) is None


def executed(folder):
    """The only executed notebook that is kept in this folder."""
    file, = (folder / "kept").glob("*.executed")
    return file


@pytest.mark.parametrize("change", [
    lambda folder: executed(folder).unlink(),
    lambda folder: executed(folder).write_bytes(b"\xff\x00 not this"),
    lambda folder: executed(folder).write_bytes(executed(folder).read_bytes()[:-9]),
    lambda folder: executed(folder).write_bytes(
        executed(folder).read_bytes().replace(b"1 + 1", b"1 + 2")),
    lambda folder: (folder / "a.mat").write_text("another"),
    lambda folder: (folder / "data" / "new.txt").write_text("new"),
    lambda folder: (folder / "helper.py").write_text("read by a notebook"),
])
def test_a_change_or_a_damaged_file_is_as_if_nothing_were_kept(kept, tmp_path, change):
    assert kept() is not None
    change(tmp_path)
    assert kept() is None


def test_slamlib_and_the_packages_are_among_what_matters(monkeypatch, tmp_path):
    without_packages = cache.fingerprint([], tmp_path, {})
    monkeypatch.setattr(cache, "distributions", distributions)
    before = cache.fingerprint([], tmp_path, {})
    monkeypatch.setattr(memory, "SLAMLIB", tmp_path)
    assert len({before, without_packages, cache.fingerprint([], tmp_path, {})}) == 3


def test_saved_outputs_do_not_matter(tmp_path):
    write(tmp_path, "a", "# a", ("1 + 1",))
    book = nbformat.read(tmp_path / "a.ipynb", as_version=4)
    key = cache.key_of(tmp_path / "a.ipynb", book, "")
    book.cells[1].execution_count = 3
    book.cells[1].outputs = [nbformat.v4.new_output("stream", text="2")]
    assert cache.key_of(tmp_path / "a.ipynb", book, "") == key
    assert book.cells[1].outputs  # and it is left as it is
    book.cells[1].source = "1 + 2"
    assert cache.key_of(tmp_path / "a.ipynb", book, "") != key
