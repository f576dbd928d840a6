"""What a build tells meanwhile: first numbers, how far the notebooks are, and the time left."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from multiprocessing import active_children

import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from test_main import ROOT, running
from test_report import build, make_data, write

from slamlib import summary
from slamlib.report import build as building
from slamlib.report import progress
from slamlib.report.progress import Progress
from slamlib.studies import memory

CELLS = [new_markdown_cell("# 1. One\n\nText."), new_code_cell("1"), new_code_cell(" "),
         new_markdown_cell("Text.\n\n## Two"), new_code_cell("2"), new_code_cell("3")]


@pytest.fixture
def now(monkeypatch):
    """The time, a list of one number."""
    time_now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: time_now[0])
    return time_now


@pytest.fixture
def started(tmp_path, now):
    """A function that begins a build of notebooks a and b, of which each is executed alone."""
    def start(jobs=1):
        books = {tmp_path / f"{name}.ipynb": new_notebook(cells=CELLS) for name in "ab"}
        return Progress(books, jobs, tmp_path, tmp_path / "seconds.json", tmp_path / "none.json",
                        "at least")
    return start


def do(told, name, now, *seconds):
    """Do cells of a notebook."""
    for each in seconds:
        told.begin(name)
        now[0] += each
        told.end(name)


def test_without_a_terminal_a_line_says_at_times_how_far_each_notebook_is(
        started, now, tmp_path, capsys):
    told = started()
    told.show()
    do(told, "a", now, 5.0)
    told.begin("a")
    told.show()
    assert capsys.readouterr().err == ""
    now[0] = progress.LINE_INTERVAL
    (tmp_path / "a").write_text("late_ranges 3 of 8")
    told.show()
    now[0] += progress.LINE_INTERVAL / 2
    told.show()
    assert capsys.readouterr().err == "1 of 6 cells; a: cell 2 of 3, Two, late_ranges 3 of 8\n"
    told.begin("b")
    now[0] += progress.LINE_INTERVAL / 2
    (tmp_path / "a").unlink()
    told.show()
    assert capsys.readouterr().err == (
        "1 of 6 cells; a: cell 2 of 3, Two; b: cell 1 of 3, 1. One\n")


def test_the_time_left_is_what_cells_took_before(started, now, capsys):
    first = started()
    do(first, "a", now, 1.0, 20.0, 3.0)
    first.keep("a")
    do(first, "b", now, 100.0, 200.0, 100.0)
    first.keep("b")

    def left(told):
        now[0] += progress.LINE_INTERVAL
        told.show()
        return capsys.readouterr().err.partition(";")[0].strip()

    assert left(started()) == "0 of 6 cells, about 7 min left"
    assert left(started(jobs=2)) == "0 of 6 cells, about 7 min left"      # b cannot be divided
    told = started()
    do(told, "b", now, 100.0, 200.0, 100.0)
    assert left(told) == "3 of 6 cells, about 24 s left"
    told.begin("a")
    assert left(told) == "3 of 6 cells, about 23 s left"
    told.end("a")
    told.begin("a")
    assert left(told) == "4 of 6 cells, about 8 s left"
    told.end("a")
    told.begin("a")
    assert left(told) == "5 of 6 cells"                               # longer than it took before


def test_cells_that_are_new_make_the_time_left_a_bound(started, now, capsys):
    first = started()
    do(first, "a", now, 1.0, 20.0, 3.0)
    first.keep("a")
    told = started()
    now[0] += progress.LINE_INTERVAL
    told.show()
    assert capsys.readouterr().err == "0 of 6 cells, at least 24 s left\n"


def test_what_cells_took_with_other_studies_is_a_bound(started, now, tmp_path, capsys):
    first = started()
    for name in "ab":
        do(first, name, now, 1.0, 20.0, 3.0)
        first.keep(name)
    books = {tmp_path / f"{name}.ipynb": new_notebook(cells=CELLS) for name in "ab"}
    told = Progress(books, 1, tmp_path, tmp_path / "new.json", tmp_path / "seconds.json", "at most")

    def line():
        now[0] += progress.LINE_INTERVAL
        told.show()
        return capsys.readouterr().err

    assert line() == "0 of 6 cells, at most 48 s left\n"
    do(told, "a", now, 1.0, 2.0, 1.0)
    told.keep("a")
    assert line() == "3 of 6 cells, at most 24 s left\n"
    do(told, "b", now, 1.0, 2.0, 1.0)
    told.keep("b")
    told = Progress(books, 1, tmp_path, tmp_path / "new.json", tmp_path / "seconds.json", "at most")
    assert line() == "0 of 6 cells, about 8 s left\n"


@pytest.mark.parametrize("content", [None, b"not JSON", b"[1]", b'{"a": 5}', b'{"a": {"b": "c"}}',
                                     b"\xff", b'{"a": {"b": null}}'])
def test_without_a_memory_there_is_the_count_alone(started, now, tmp_path, capsys, content):
    if content is not None:
        (tmp_path / "seconds.json").write_bytes(content)
    told = started()
    now[0] = progress.LINE_INTERVAL
    told.show()
    assert capsys.readouterr().err == "0 of 6 cells\n"


def test_on_a_terminal_a_bar_says_the_same(started, now, capsys, monkeypatch):
    first = started()
    do(first, "a", now, 1.0, 20.0, 3.0)
    first.keep("a")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    told = started()
    do(told, "a", now, 1.0)
    told.begin("a")
    told.show()
    told.bar.refresh()
    told.bar.close()
    shown = capsys.readouterr().err
    assert "a: cell 2 of 3, Two" in shown and "1/6" in shown and "at least 23 s left" in shown


@pytest.mark.slow
def test_the_first_numbers_come_before_the_notebooks_the_shortest_drive_first(
        tmp_path, monkeypatch, capsys):
    """And not where a notebook is recalled."""
    make_data(tmp_path)
    (tmp_path / "data" / "long" / "encoderReading.txt").write_text("1 0 0\n2 9 9\n3 9 9\n")
    write(tmp_path / "notebooks", "1_one", "# One", ("1 + 1",))
    monkeypatch.setattr(building, "TABLES_WAIT", 300.0)
    build(tmp_path, kept=tmp_path / "kept")
    told = capsys.readouterr().err
    found = re.findall("^(short|long|problem1|1_one):? +([0-9]+)", told, re.MULTILINE)
    assert found == [("short", "2"), ("problem1", "2"), ("long", "3"), ("problem1", "3"),
                     ("1_one", "1")]
    build(tmp_path, kept=tmp_path / "kept")
    assert "problem1" not in capsys.readouterr().err
    build(tmp_path, kept=tmp_path / "kept", fresh=True)
    assert "short: 2 poses" in capsys.readouterr().err
    cells = json.loads((tmp_path / "kept" / "seconds_computed.json").read_text())["1_one"]
    assert len(cells) == 1 and next(iter(cells.values())) > 0


def test_builds_that_compute_studies_and_those_that_recall_them_have_their_own_times(tmp_path):
    assert building._seconds(tmp_path)[0].name == "seconds_computed.json"
    (tmp_path / "studies" / ("0" * 64)).mkdir(parents=True)               # of other code
    assert building._seconds(tmp_path)[0].name == "seconds_computed.json"
    (tmp_path / "studies" / memory.CODE_DIGEST).mkdir()
    assert building._seconds(tmp_path)[0].name == "seconds_recalled.json"


@pytest.fixture
def folders(tmp_path):
    """The folders of two datasets."""
    make_data(tmp_path)
    return [tmp_path / "data" / "short", tmp_path / "data" / "long"]


def test_a_drive_that_takes_long_is_not_waited_for_and_its_process_ends(folders, monkeypatch):
    monkeypatch.setattr(summary, "_summary", lambda *_: time.sleep(1000))
    with summary.tables(folders, print) as wait:
        wait(0.01)
        assert len(active_children()) == 1
    assert active_children() == []


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the process is no fork")
@pytest.mark.parametrize("end, expected", [
    (lambda *_: 1 / 0, ["short: not solved before the notebooks: "
                        "ZeroDivisionError('division by zero')"]),
    (lambda *_: os.kill(os.getpid(), signal.SIGKILL), [])])
def test_first_numbers_that_fail_end_no_build(folders, monkeypatch, capfd, end, expected):
    monkeypatch.setattr(summary, "_summary", end)
    told = []
    with summary.tables(folders[:1], told.append) as wait:
        wait(60)
    assert told == expected and capfd.readouterr().err == ""


@pytest.mark.skipif(sys.platform != "linux", reason="only there it ends with this process")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_no_process_survives_a_build_that_is_killed(folders, number):
    code = f"""import time
from multiprocessing import active_children
from pathlib import Path
from slamlib import summary
summary._summary = lambda *_: time.sleep(1000)
with summary.tables([Path({str(folders[0])!r})], print) as wait:
    print(active_children()[0].pid, flush=True)
    wait(1000)"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True,
                               env=os.environ | {"PYTHONPATH": str(ROOT)})
    child = process.stdout.readline().strip()
    assert running(child)
    process.send_signal(number)
    process.communicate()
    until = time.monotonic() + 60
    while running(child) and time.monotonic() < until:
        time.sleep(0.02)
    assert not running(child)
