"""A notebook is executed again when something changed that it depends on, and only then."""

import json
import shutil
from importlib.metadata import distributions
from io import BytesIO
from zipfile import ZipFile

import nbformat
import pytest
from nbformat.v4 import new_markdown_cell
from test_report import make_data, write

from slamlib.report import build, build_report, cache
from slamlib.studies import memory


def execute_without_kernel(books, environment, results, jobs, finish):
    """Count an execution of each notebook and write its output and its result, as kernels would."""
    for source, book in books.items():
        with open(source.parents[1] / f"count_{source.stem}", "a") as count:
            count.write("x")
        (results / "short").mkdir(parents=True, exist_ok=True)
        (results / "short" / f"{source.stem}.mat").write_text("result")
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


def test_results_that_are_gone_or_changed_are_written_again_without_an_execution(project):
    assert executions(project) == (1, 1)
    a, b = (project / "results" / "short" / name for name in ("a.mat", "b.mat"))
    a.write_text("changed")
    b.unlink()
    assert executions(project) == (1, 1)
    assert a.read_text() == b.read_text() == "result"
    shutil.rmtree(project / "results")
    assert executions(project) == (1, 1)
    assert a.read_text() == b.read_text() == "result"


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
    assert executions(project) == (2, 2)


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
    results = tmp_path / "results"
    results.mkdir()
    (results / "a.mat").write_text("result")

    def key(variables):
        common = cache.fingerprint([tmp_path / "data"], tmp_path, variables)
        return cache.key_of(source, book, common)

    cache.keep(tmp_path / "kept", source, key({}), book, results, ["a.mat"])
    return lambda **variables: cache.recall(tmp_path / "kept", source, key(variables), results)


def test_what_is_kept_is_recalled_with_its_results(kept, tmp_path):
    result = tmp_path / "results" / "a.mat"
    result.unlink()
    book, names = kept()
    assert book.cells[1].source == "1 + 1" and names == ["a.mat"]
    assert result.read_text() == "result"
    assert kept(HOME="/elsewhere") is not None  # of no matter to a notebook


@pytest.mark.parametrize("variable", ["SLAMLIB_DATASETS", "PYTHONPATH", "OMP_NUM_THREADS", "TZ"])
def test_variables_that_matter_are_seen(kept, variable):
    assert kept(**{variable: "x"}) is None


def executed(folder):
    """The only executed notebook that is kept in this folder."""
    file, = (folder / "kept").glob("*.executed")
    return file


def with_digest(folder, content):
    """Content of an entry in the place of the only one, with the right digest."""
    key = executed(folder).name.split(".")[1]
    return cache._checksum(key, content) + b"\n" + content


def archive_of(text, names=(), held=()):
    """The archive of a kept notebook whose file holds this text, with results that it lists."""
    buffer = BytesIO()
    with ZipFile(buffer, "w") as archive:
        archive.writestr(cache.BOOK, text)
        archive.writestr(cache.NAMES, json.dumps(names))
        for name in held:
            archive.writestr(name, "content")
    return buffer.getvalue()


EMPTY = '{"nbformat": 4, "nbformat_minor": 5, "metadata": {}, "cells": []}'


@pytest.mark.parametrize("change", [
    lambda folder: executed(folder).unlink(),
    lambda folder: executed(folder).write_bytes(b"\xff\x00 not this"),
    lambda folder: executed(folder).write_bytes(executed(folder).read_bytes()[:-9]),
    lambda folder: executed(folder).write_bytes(
        executed(folder).read_bytes().replace(b"executed.ipynb", b"executed.ipync")),
    lambda folder: executed(folder).write_bytes(with_digest(folder, b"not an archive")),
    lambda folder: executed(folder).write_bytes(with_digest(folder, archive_of("not JSON"))),
    lambda folder: executed(folder).write_bytes(with_digest(folder, archive_of("[1]"))),
    lambda folder: executed(folder).write_bytes(with_digest(folder, archive_of(
        EMPTY.replace("[]", "[{}]")))),
    *(lambda folder, archive=archive: executed(folder).write_bytes(with_digest(folder, archive))
      for archive in (archive_of(EMPTY, ["a.mat"]), archive_of(EMPTY, [], ["results/a.mat"]),
                      archive_of(EMPTY, ["a.mat"], ["other/a.mat"]), archive_of(EMPTY, [1], ["1"]),
                      archive_of(EMPTY, ["../a.mat"], ["results/../a.mat"]),
                      archive_of(EMPTY, 5))),
    lambda folder: (folder / "data" / "new.txt").write_text("new"),
    lambda folder: (folder / "helper.py").write_text("read by a notebook"),
])
def test_a_change_or_a_damaged_file_is_as_if_nothing_were_kept(kept, tmp_path, change):
    assert kept() is not None
    change(tmp_path)
    assert kept() is None


def test_an_entry_whose_list_names_its_results_is_recalled(kept, tmp_path):
    """What the entries above differ from."""
    executed(tmp_path).write_bytes(with_digest(
        tmp_path, archive_of(EMPTY, ["a.mat"], ["results/a.mat"])))
    assert kept()[1] == ["a.mat"]


def test_an_entry_with_other_cells_is_executed_again(project, monkeypatch):
    assert executions(project) == (1, 1)
    recall = cache.recall

    def with_another_cell(folder, source, *arguments):
        book, names = recall(folder, source, *arguments)
        if source.stem == "b":
            book.cells.append(new_markdown_cell("Another."))
        return book, names

    monkeypatch.setattr(cache, "recall", with_another_cell)
    assert executions(project) == (1, 2)


def test_an_entry_of_another_key_is_not_recalled(kept, tmp_path):
    source, other = tmp_path / "a.ipynb", "0" * 64
    shutil.copy(executed(tmp_path), tmp_path / "kept" / f"a.{other}.executed")
    assert kept() is not None
    assert cache.recall(tmp_path / "kept", source, other, tmp_path) is None


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
