"""Runs that meet, are killed, or find a full disk: results are those of one run, or say so."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import psutil
import pytest
from conftest import ROOT, is_running
from test_report import build, make_data, write

from slamlib import solve
from slamlib.__main__ import END_SIGNALS, main
from slamlib.io import results, swap
from slamlib.report import NotebookError
from slamlib.solve import problem_solution, solve_to_folder
from slamlib.studies.simulation import simulate, write_dataset

RESULT = """import os, time
from pathlib import Path
import numpy as np
from slamlib.io.results import write_structs
poses = None, np.zeros((2, 3)), np.zeros((2, 3, 3))
write_structs(Path(os.environ["SLAMLIB_RESULTS"], "short", "problem1"), "vehiclePose", *poses)
"""


PROCESSES = 1 + (sys.platform == "linux")        # of solve


def start(folder, *arguments, code=None, **options):
    """The command in a process of its own, which heeds SIGHUP also where these tests ignore it."""
    return subprocess.Popen([sys.executable, *(["-c", code] if code else ["-m", "slamlib"]),
                             *map(str, arguments)], cwd=folder,
                            text=True, **({"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
                                          | options),
                            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
                            env=os.environ | {"PYTHONPATH": str(ROOT)})


def wait_for(found, process, seconds=300):
    """Wait until a function returns something true, which is returned, while a process runs."""
    until = time.monotonic() + seconds
    while not (value := found()):
        if process.poll() is not None or time.monotonic() > until:
            process.kill()
            raise AssertionError(process.communicate())
        time.sleep(0.02)
    return value


def hidden(folder):
    """Names in a folder that begin with a dot, but for the list of a set's files."""
    return [str(path) for path in folder.rglob(".*") if path.name != swap.FILE_LIST]


@pytest.fixture
def drive():
    """A simulated drive of 40 poses with all sensors."""
    return simulate("short", seed=3)[0].first(40)


@pytest.mark.slow
def test_a_second_build_waits_and_says_so_and_neither_loses_results(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_slow", "# Slow", (RESULT,), (
        f"while not Path({str(tmp_path / 'go')!r}).exists(): time.sleep(0.1)",))
    first = start(tmp_path, "report", "short")
    wait_for(lambda: [*tmp_path.rglob("vehiclePose.mat")], first)
    with open(tmp_path / "told", "w+") as told:
        second = start(tmp_path, "report", "short", stderr=told)
        wait_for(lambda: "waits for" in (tmp_path / "told").read_text(), second)
        (tmp_path / "go").touch()
        assert "waits for" not in first.communicate(timeout=300)[1] and first.returncode == 0
        second.communicate(timeout=300)
        assert second.returncode == 0
    found, told = (tmp_path / "told").read_text().split("slamlib: waits for another run, which ")
    assert found.startswith("short: encoders: ")
    assert "nothing changed, not executed again" in told.splitlines()[1]
    assert (tmp_path / "results" / "short" / "problem1" / "vehiclePose.mat").is_file()
    assert (tmp_path / "report" / "index.html").is_file()
    assert hidden(tmp_path) == []


def test_a_lock_has_one_holder_at_a_time_although_its_file_is_removed(tmp_path):
    held, most = [], []

    def work(_):
        with swap.locked(tmp_path / "out"):
            held.append(1)
            most.append(len(held))
            time.sleep(0)
            held.pop()

    with ThreadPoolExecutor(4) as threads:
        assert [*threads.map(work, range(200))] == [None] * 200
    assert len(most) == 200 and max(most) == 1 and hidden(tmp_path) == []


def test_a_dataset_with_fewer_sensors_leaves_no_problem_of_another(tmp_path, drive):
    """What the user put there stays, also in a folder of a problem; so without a list of files."""
    mine = ["notes.txt", "movie.part", "mine/problem2.mat", "problem2/notes.txt",
            "problem4/mine/a.mat"]
    tmp_path /= "out"
    for listed in (True, False):
        solve_to_folder(drive, None, tmp_path)
        assert (tmp_path / "problem4" / "UwbMap.mat").exists()
        for name in mine:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(name)
        (tmp_path / "problem3" / ".vehiclePose.mat.part").write_text("of a killed run")
        if not listed:  # damaged, or written by an earlier version
            (tmp_path / swap.FILE_LIST).write_text("5")
            (old := swap.beside(tmp_path, "old")).mkdir()        # a run was killed
            shutil.move(tmp_path / "mine", old)
        solve_to_folder(drive.without("uwb").without("aruco"), None, tmp_path)
        assert swap.file_names(tmp_path) == sorted([
            swap.FILE_LIST, *mine, "problem1/vehiclePose.mat", "summary.json"])
        assert all((tmp_path / name).read_text() == name for name in mine)
        assert not (tmp_path / "problem3").exists() and (tmp_path / "problem2").exists()
    results.write_solution(tmp_path, problem_solution("problem1", drive.first(9)))
    assert not (tmp_path / "summary.json").exists()                 # which is of other files


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks safely")
def test_a_kill_before_any_step_mixes_nothing_and_the_next_run_cleans_up():
    """Exhaustive: of solve, and of two folders that are swapped as one."""
    done = subprocess.run([sys.executable, ROOT / "tests" / "kills.py"], text=True,
                          capture_output=True, timeout=900,
                          env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stderr
    lines = [*map(json.loads, done.stdout.splitlines())]
    assert len(lines) == 2
    for counts in lines:
        assert counts["MIXED"] == counts["LEFT"] == 0, done.stderr
        assert counts["killed"] == counts["A"] + counts["B"] + counts["unfinished"] - 1 > 25
        assert counts["A"] > 5 < counts["B"] and counts["unfinished"] and counts["runs after"] > 8


@pytest.mark.slow
def test_a_full_disk_is_told_and_leaves_the_old_results(tmp_path, drive):
    """A limit on the size of files fails like a full disk."""
    write_dataset(tmp_path / "drive", drive)
    out = tmp_path / "out"
    solve_to_folder(drive, None, out)
    before = {name: (out / name).read_bytes() for name in swap.file_names(out)}
    limit = len(before["problem3/vehiclePose.mat"]) - 1
    process = start(tmp_path, "solve", "drive", "--out", "out", code=(
        f"import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}));"
        "from slamlib.__main__ import main; sys.exit(main())"))
    told = process.communicate(timeout=300)[1]
    assert process.returncode == 2 and told.count("slamlib: ") == 1
    assert os.strerror(errno.EFBIG) in told
    assert {name: (out / name).read_bytes() for name in swap.file_names(out)} == before


@pytest.mark.parametrize("spoil, reason", [
    (lambda folder: (folder / "problem1").write_text("a file of the user"), "problem1"),
    (lambda folder: swap.write_atomically(folder / "problem1" / "vehiclePose.mat" / "mine", b""),
     "problem1/vehiclePose.mat"),
])
def test_what_cannot_be_put_in_its_place_is_told_before_anything_changes(
        tmp_path, drive, capsys, spoil, reason):
    write_dataset(tmp_path / "drive", drive.without("uwb").without("aruco"))
    (tmp_path / "out").mkdir()
    spoil(tmp_path / "out")
    (tmp_path / "out" / "summary.json").write_text("old")
    assert main(["solve", str(tmp_path / "drive"), "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert told.count("slamlib: ") == 1 and reason in told.splitlines()[-1]
    assert (tmp_path / "out" / "summary.json").read_text() == "old"
    assert hidden(tmp_path) == []


@pytest.mark.slow
def test_a_build_that_fails_changes_nothing_and_the_next_removes_what_is_no_longer_made(
        tmp_path, capsys):
    """What the user put there stays, and what was executed before the failure is kept."""
    make_data(tmp_path)
    options = {"datasets": ["short"], "kept": tmp_path / "kept", "jobs": 1}
    write(tmp_path / "notebooks", "1_goes", "# Goes", (RESULT.replace("problem1", "other"),))
    write(tmp_path / "notebooks", "2_stays", "# Stays", (RESULT,))
    build(tmp_path, **options)
    for name in ("report/notes.html", "results/short/notes.txt", "results/mine/vehiclePose.mat"):
        swap.write_atomically(tmp_path / name, b"mine")
    before = [swap.file_names(tmp_path / name) for name in ("report", "results")]
    assert "short/other/vehiclePose.mat" in before[1]
    write(tmp_path / "notebooks", "1_goes", "# Goes", ("1 / 0",))  # one at a time, the last first
    write(tmp_path / "notebooks", "2_stays", "# Stays", (RESULT + "1 + 1",))
    old = tmp_path / "results" / "short" / "problem1" / "vehiclePose.mat"
    old.write_text("old")
    with pytest.raises(NotebookError):
        build(tmp_path, **options)
    assert before == [swap.file_names(tmp_path / name) for name in ("report", "results")]
    assert old.read_text() == "old" and hidden(tmp_path) == []
    (tmp_path / "notebooks" / "1_goes.ipynb").unlink()
    capsys.readouterr()
    build(tmp_path, **options)
    assert "2_stays: nothing changed" in capsys.readouterr().err
    assert len(results.read_structs(old.parent, "vehiclePose")[0]) == 2
    assert [*map(swap.file_names, (tmp_path / "report", tmp_path / "results"))] == [
        [swap.FILE_LIST, "2_stays.html", "index.html", "notes.html", "report.pdf"],
        ["mine/vehiclePose.mat", "short/.slamlib.json", "short/notes.txt",
         "short/problem1/vehiclePose.mat"]]


@pytest.mark.slow
def test_a_signal_ends_a_build_in_order(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_slow", "# Slow", (RESULT + """
Path("part").write_text(str(os.getpid()))
Path("part").rename("kernel")
time.sleep(1000)""",))
    process, kernel = start(tmp_path, "report", "short"), tmp_path / "notebooks" / "kernel"
    wait_for(kernel.is_file, process)
    process.send_signal(signal.SIGTERM)
    told = process.communicate(timeout=300)[1]
    assert process.returncode == 130
    assert told.splitlines()[-1] == "slamlib: ended by a signal" and "Traceback" not in told
    assert swap.file_names(tmp_path / "results") == [] and hidden(tmp_path) == []
    assert not is_running(int(kernel.read_text()))


@pytest.mark.parametrize("number", END_SIGNALS)
def test_a_signal_ends_a_solve_in_order(tmp_path, drive, number):
    """Both of its processes, while each solves a problem."""
    write_dataset(tmp_path / "drive", drive)
    process = start(tmp_path, "solve", "drive", "--out", "out", code="""import os, sys, time
from pathlib import Path
from slamlib import solve
from slamlib.__main__ import main
def find(*_):
    Path(f"of {os.getpid()}").touch()
    time.sleep(1000)
solve.find = find
sys.exit(main())""")
    found = wait_for(lambda: len(of := [*tmp_path.glob("of *")]) == PROCESSES and of, process)
    process.send_signal(number)
    out, told = process.communicate(timeout=300)
    *lines, last = told.splitlines()
    assert out == "" and last == "slamlib: ended by a signal"
    assert all(line.startswith("drive: ") for line in lines)
    assert process.returncode == 130 and not (tmp_path / "out").exists()
    assert hidden(tmp_path) == []
    assert not any(is_running(int(file.name.split()[1])) for file in found)


@pytest.mark.skipif(PROCESSES < 2, reason="elsewhere one process solves all problems")
def test_a_killed_solve_leaves_no_process_behind(tmp_path):
    """Of the second one, whose results do not fit into the pipe to the first."""
    write_dataset(tmp_path / "drive", simulate("short", seed=3)[0])
    process = start(tmp_path, "solve", "drive", "--out", "out", code="""import os, sys, time
from slamlib import solve
from slamlib.__main__ import main
find, first = solve.find, os.getpid()
solve.find = lambda *given: time.sleep(1000) if os.getpid() == first else find(*given)
sys.exit(main())""")
    second = wait_for(psutil.Process(process.pid).children, process)
    process.kill()
    assert psutil.wait_procs(second, timeout=60)[1] == []
    process.communicate()


@pytest.mark.skipif(PROCESSES < 2, reason="elsewhere one process solves all problems")
@pytest.mark.parametrize("fails", [
    lambda *_: 1 / 0, lambda *_: os.kill(os.getpid(), signal.SIGKILL)])
def test_a_process_takes_over_the_problems_of_one_that_fails(
        tmp_path, drive, monkeypatch, capfd, fails):
    expected = solve_to_folder(drive, None, tmp_path / "expected")
    parent, find = os.getpid(), solve.find
    monkeypatch.setattr(solve, "find", lambda *arguments: (
        find if os.getpid() == parent else fails)(*arguments))
    found = solve_to_folder(drive, None, tmp_path / "found")
    for summary in (expected, found):
        assert all(row.pop("seconds") >= 0 for row in summary["problems"].values())
    assert found == expected and capfd.readouterr() == ("", "")
    for name in swap.file_names(tmp_path / "expected"):
        assert name.endswith(".json") or (tmp_path / "found" / name).read_bytes() \
            == (tmp_path / "expected" / name).read_bytes()
