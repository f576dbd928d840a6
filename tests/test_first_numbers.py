"""The first numbers, which a build tells before it executes the notebooks."""

import os
import re
import signal
import sys
import time
from multiprocessing import active_children

import pytest
from test_report import build, make_data, write

from slamlib import summary
from slamlib.report import build as building


@pytest.mark.slow
def test_the_first_numbers_come_before_the_notebooks_the_shortest_drive_first(
        tmp_path, monkeypatch, capfd):
    """And not where a notebook is recalled."""
    make_data(tmp_path)
    (tmp_path / "data" / "long" / "encoderReading.txt").write_text("1 0 0\n2 9 9\n3 9 9\n")
    write(tmp_path / "notebooks", "1_one", "# One", ("1 + 1",))
    monkeypatch.setattr(building, "TABLES_WAIT", 300.0)
    build(tmp_path, kept=tmp_path / "kept")
    told = capfd.readouterr().err
    found = re.findall(r"^(short|long|problem1|1_one):? +([0-9]+|executed)", told, re.MULTILINE)
    assert found == [("short", "2"), ("problem1", "2"), ("long", "3"), ("problem1", "3"),
                     ("1_one", "executed")]
    build(tmp_path, kept=tmp_path / "kept")
    assert "problem1" not in capfd.readouterr().err


@pytest.fixture
def folders(tmp_path):
    """The folders of two datasets."""
    make_data(tmp_path)
    return [tmp_path / "data" / "short", tmp_path / "data" / "long"]


def test_a_drive_that_takes_long_is_not_waited_for_and_its_process_ends(folders, monkeypatch):
    monkeypatch.setattr(summary, "_solved", lambda *_: time.sleep(1000))
    with summary.process(summary.print_tables, folders) as first:
        first.join(0.01)
        assert first in active_children()
    assert first not in active_children()


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the process is no fork")
@pytest.mark.parametrize("end, expected", [
    (lambda *_: 1 / 0, "short: not solved before the notebooks: "
                       "ZeroDivisionError('division by zero')\n"),
    (lambda *_: os.kill(os.getpid(), signal.SIGKILL), "")])
def test_first_numbers_that_fail_end_no_build(folders, monkeypatch, capfd, end, expected):
    monkeypatch.setattr(summary, "_solved", end)
    with summary.process(summary.print_tables, folders[:1]) as first:
        first.join(300)
    assert capfd.readouterr().err == expected
