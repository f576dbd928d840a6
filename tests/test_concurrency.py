"""Runs that meet, are killed, or find a full disk: results are those of one run, or say so."""

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import psutil
import pytest
from conftest import ROOT, file_names
from numeric import short
from test_report import build, make_data, write

from slamlib import solve
from slamlib.__main__ import main
from slamlib.core.errors import DatasetError
from slamlib.io import files, results
from slamlib.solve import solve_to_folder
from slamlib.studies.simulation import write_dataset

RESULT = """import os, time
from pathlib import Path
from slamlib.notebook import start, write_results
from slamlib.solve import find
for drive in start():
    write_results(drive, "problem1", find("problem1", drive.dataset))
"""


def start(folder, *arguments):
    """The command in a process of its own."""
    return subprocess.Popen([sys.executable, "-m", "slamlib", *arguments], cwd=folder, text=True,
                            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                            env=os.environ | {"PYTHONPATH": str(ROOT)})


def wait_for(file, process):
    """Wait until a file is there, while a process runs."""
    until = time.monotonic() + 300
    while not file.exists():
        if process.poll() is not None or time.monotonic() > until:
            process.kill()
            raise AssertionError(process.communicate())
        time.sleep(0.02)


def hidden(folder):
    """Names in a folder that begin with a dot, but for the list of a report's pages."""
    return [str(path) for path in folder.rglob(".*") if path.name != ".pages"]


@pytest.fixture
def drive():
    """A simulated drive of 40 poses with all sensors."""
    return short(3, 40)[0]


@pytest.mark.slow
def test_of_two_builds_at_once_the_second_waits_and_neither_loses_results(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_slow", "# Slow", (RESULT,))
    builds = [start(tmp_path, "report", "short") for _ in range(2)]
    told = [process.communicate(timeout=300)[1] for process in builds]
    assert [process.returncode for process in builds] == [0, 0], told
    assert sum("1_slow, nothing changed" in each for each in told) == 1
    assert results.read_summary(tmp_path / "results" / "short")["problems"].keys() == {"problem1"}
    assert (tmp_path / "report" / "index.html").is_file()
    assert hidden(tmp_path) == []


def test_a_lock_has_one_holder_at_a_time_although_its_file_is_removed(tmp_path):
    held = []

    def work(_):
        with files.locked(tmp_path / "out"):
            held.append(1)
            time.sleep(0)
            count = len(held)
            held.pop()
        return count

    with ThreadPoolExecutor(4) as threads:
        assert [*threads.map(work, range(200))] == [1] * 200
    assert hidden(tmp_path) == []


def test_a_lock_that_another_run_keeps_is_told_after_a_while(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "LOCK_TIME", 0.1)
    with files.locked(tmp_path), pytest.raises(DatasetError, match="try again when it has ended"):
        with files.locked(tmp_path):
            pass


def test_a_run_with_fewer_sensors_removes_files_of_other_problems_and_no_other_file(
        tmp_path, drive):
    mine = ["mine/problem2.mat", "problem2/notes.txt", "problem4/mine/a.mat"]
    solve_to_folder(drive, None, tmp_path)
    for name in mine:
        files.write_file(tmp_path / name, b"mine")
    (tmp_path / "empty").mkdir()
    (tmp_path / "problem1").chmod(0o700)
    solve_to_folder(drive.without("uwb").without("aruco"), None, tmp_path)
    assert file_names(tmp_path) == [
        *mine[:1], "problem1/vehiclePose.mat", *mine[1:], "summary.json"]
    assert all((tmp_path / name).read_bytes() == b"mine" for name in mine)
    assert (tmp_path / "empty").is_dir()
    assert (tmp_path / "problem1").stat().st_mode & 0o777 == 0o700


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="runs are forks")
def test_a_kill_at_any_moment_leaves_the_results_of_one_run_or_no_summary(tmp_path):
    done = subprocess.run([sys.executable, ROOT / "tests" / "kills.py", tmp_path],
                          text=True, capture_output=True, timeout=300,
                          env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr
    counts, last = json.loads(done.stdout)
    assert last == "A" and counts.keys() <= {"A", "B", "unfinished"}
    assert counts["unfinished"] > 5 and counts["A"] + counts.get("B", 0) > 5
    assert (tmp_path / "problem4" / "notes.txt").read_bytes() == b"of the user"
    assert hidden(tmp_path) == []


def test_where_nothing_can_be_written_is_told_before_anything_is_solved(
        tmp_path, drive, monkeypatch, capsys):
    write_dataset(tmp_path / "drive", drive)
    (tmp_path / "file").write_text("mine")
    os.mkfifo(tmp_path / "fifo")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(solve, "find", None)
    for out in ("file", "fifo", "file/x", "/proc/x"):
        assert main(["solve", "drive", "--out", out]) == 2
        told = capsys.readouterr().err.splitlines()[-1]
        assert "expected a folder to write to" in told and out in told
    assert (tmp_path / "file").read_text() == "mine"


def test_what_stands_in_the_place_of_a_result_is_told_and_stays(tmp_path, drive, capsys):
    write_dataset(tmp_path / "drive", drive.without("uwb").without("aruco"))
    out = tmp_path / "out"
    files.write_file(out / "problem1" / "vehiclePose.mat" / "mine", b"mine")
    assert main(["solve", str(tmp_path / "drive"), "--out", str(out)]) == 2
    assert "problem1/vehiclePose.mat" in capsys.readouterr().err.splitlines()[-1]
    assert file_names(out) == ["problem1/vehiclePose.mat/mine"]      # and no summary


@pytest.mark.slow
def test_a_build_removes_what_is_no_longer_made_and_no_file_of_the_user(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_stays", "# Stays", (RESULT,))
    other = RESULT.replace("problem1", "problem2_hint")
    write(tmp_path / "notebooks", "2_goes", "# Goes", (other,))
    again = partial(build, tmp_path, datasets=["short"], kept=tmp_path / "kept")
    again()
    for name in ("report/notes.html", "results/short/notes.txt", "results/mine/vehiclePose.mat"):
        files.write_file(tmp_path / name, b"mine")
    (tmp_path / "notebooks" / "2_goes.ipynb").unlink()
    again()
    assert file_names(tmp_path / "report") == [
        ".pages", "1_stays.html", "index.html", "notes.html", "report.pdf"]
    assert file_names(tmp_path / "results") == [
        "mine/vehiclePose.mat", "short/notes.txt", "short/problem1/vehiclePose.mat",
        "short/summary.json"]


@pytest.mark.slow
def test_a_signal_ends_a_build_in_order(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_slow", "# Slow", (RESULT + """
Path("part").write_text(str(os.getpid()))
Path("part").rename("kernel")
time.sleep(1000)""",))
    process, kernel = start(tmp_path, "report", "short"), tmp_path / "notebooks" / "kernel"
    wait_for(kernel, process)
    process.send_signal(signal.SIGTERM)
    told = process.communicate(timeout=300)[1]
    assert process.returncode == 130
    assert told.splitlines()[-1] == "slamlib: ended by a signal" and "Traceback" not in told
    assert file_names(tmp_path / "results") == [] and hidden(tmp_path) == []
    assert not psutil.pid_exists(int(kernel.read_text()))
