"""Runs that meet, are killed, or find a full disk: results are those of one run, or say so."""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from nbformat.v4 import new_notebook
from test_report import build, make_data, write

from slamlib import locks, results, swap
from slamlib.__main__ import main
from slamlib.report import NotebookError, cache, execution
from slamlib.simulation import simulate, write_dataset
from slamlib.solve import RESULT_NAMES
from slamlib.summary import solve_to_folder

ROOT = Path(__file__).parents[1]
RESULT = """import os, time
from pathlib import Path
import numpy as np
from slamlib.results import write_vehicle_poses
poses = np.zeros((2, 3)), np.zeros((2, 3, 3))
write_vehicle_poses(Path(os.environ["SLAMLIB_RESULTS"], "short", "problem1"), *poses)
"""


def start(folder, *arguments, **options):
    """The command in a process of its own, which heeds SIGHUP also where these tests ignore it."""
    return subprocess.Popen([sys.executable, "-m", "slamlib", *map(str, arguments)], cwd=folder,
                            text=True, **({"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
                                          | options),
                            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
                            env=os.environ | {"PYTHONPATH": str(ROOT)})


def wait_for(found, process, seconds=300):
    """Wait until a function returns something true, which is returned, while a process runs."""
    until = time.monotonic() + seconds
    while not (value := found()):
        assert process.poll() is None and time.monotonic() < until, process.communicate()
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
def test_a_second_build_waits_and_names_the_first_and_neither_loses_results(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_slow", "# Slow", (RESULT,), (
        f"while not Path({str(tmp_path / 'go')!r}).exists(): time.sleep(0.1)",))
    first = start(tmp_path, "report", "short")
    wait_for(lambda: [*(tmp_path / "results").rglob("vehiclePose.mat")], first)
    with open(tmp_path / "told", "w+") as told:
        second = start(tmp_path, "report", "short", stderr=told)
        wait_for(lambda: "waits for" in (tmp_path / "told").read_text(), second)
        (tmp_path / "go").touch()
        assert "waits for" not in first.communicate(timeout=300)[1] and first.returncode == 0
        second.communicate(timeout=300)
        assert second.returncode == 0
    found, _, told = (tmp_path / "told").read_text().partition("slamlib: waits")
    assert found.splitlines()[0].startswith("short: encoders: ")
    line, *lines = ("slamlib: waits" + told).splitlines()
    assert line.startswith(f"slamlib: waits for process {first.pid}, which has written to ")
    assert " since 20" in line and "nothing changed, not executed again" in lines[0]
    assert "short/problem1/vehiclePose.mat" in (tmp_path / "report" / "index.html").read_text()
    assert hidden(tmp_path) == []


def test_the_lock_of_a_process_that_is_killed_is_free(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", f"""
from pathlib import Path
from slamlib.locks import locked
with locked(Path({str(tmp_path / "lock")!r})):
    print("held", flush=True)
    input()"""], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert holder.stdout.readline() == "held\n"
    with open(tmp_path / "lock", "a+") as file:
        assert not locks.try_lock(file)
    holder.kill()
    holder.communicate()
    with locks.locked(tmp_path / "lock"):
        assert str(os.getpid()) in (tmp_path / "lock").read_text()
    assert not (tmp_path / "lock").exists()


def test_a_lock_has_one_holder_at_a_time_although_its_file_is_removed(tmp_path):
    held, most = [], []

    def work():
        for _ in range(50):
            with locks.locked(tmp_path / "lock"):
                held.append(1)
                most.append(len(held))
                time.sleep(0)
                held.pop()

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(most) == 200 and max(most) == 1 and not (tmp_path / "lock").exists()


def test_processes_have_their_own_staging_folders_and_those_of_dead_ones_are_removed(tmp_path):
    dead = tmp_path / f"{swap.STAGE}1"
    (dead / "files").mkdir(parents=True)
    (dead / swap.LOCK).touch()
    with swap.staging(tmp_path) as first, swap.staging(tmp_path) as second:
        assert first.parent == dead and first != second and [*first.iterdir()] == []
    assert [*tmp_path.iterdir()] == []


def test_a_dataset_with_fewer_sensors_leaves_no_problem_of_another(tmp_path, drive):
    """What the user put there stays, also in a folder of a problem; so without a list of files."""
    mine = ["notes.txt", "mine/problem2.mat", "problem2/notes.txt", "problem4/mine/a.mat"]
    for listed in (True, False):
        solve_to_folder(drive, None, tmp_path)
        assert (tmp_path / "problem4" / "UwbMap.mat").exists()
        for name in mine:
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(name)
        (tmp_path / "problem3" / ".vehiclePose.mat.99999999").write_text("of a killed run")
        if not listed:  # written by an earlier version
            (tmp_path / swap.FILE_LIST).unlink()
        solve_to_folder(drive.without("uwb").without("aruco"), None, tmp_path)
        assert swap.file_names(tmp_path) == sorted([
            swap.FILE_LIST, *mine, "problem1/vehiclePose.mat", "summary.json"])
        assert all((tmp_path / name).read_text() == name for name in mine)
        assert not (tmp_path / "problem3").exists() and (tmp_path / "problem2").exists()


def test_a_problem_written_by_itself_removes_the_summary_of_other_files(tmp_path, drive):
    from slamlib.solve import problem_solution, write_solution
    solve_to_folder(drive, None, tmp_path)
    write_solution(tmp_path, problem_solution("problem1", drive.first(9)))
    assert not (tmp_path / "summary.json").exists()


def test_unfinished_results_are_not_read(tmp_path):
    poses = np.zeros((2, 3)), np.zeros((2, 3, 3))
    results.write_vehicle_poses(tmp_path / "problem1", *poses)
    (tmp_path / swap.UNFINISHED).write_text("")
    with pytest.raises(swap.UnfinishedError, match="UNFINISHED.txt says that it did not"):
        results.read_vehicle_poses(tmp_path / "problem1")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks safely")
def test_a_kill_before_any_step_of_solve_mixes_nothing_and_the_next_run_cleans_up():
    """Exhaustive, in both directions between two drives; kills.py does more, and by chance."""
    done = subprocess.run([sys.executable, ROOT / "tests" / "kills.py", "steps"], text=True,
                          capture_output=True, timeout=600,
                          env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert done.returncode == 0, done.stdout + done.stderr
    for line in done.stdout.splitlines():
        counts = {what: int(number) for number, _, what in (
            part.strip().partition(" ") for part in line[30:].split(","))}
        assert counts["killed"] == counts["runs after"] > 50 and counts["unfinished"] > 10
        assert counts["A"] > 0 < counts["B"] and not {"MIXED", "LEFT"} & counts.keys()
    assert done.stdout.count("\n") == 2


@pytest.mark.slow
def test_a_full_disk_names_the_path_and_leaves_the_old_results(tmp_path, drive):
    """A limit on the size of files fails like a full disk: the error names no file."""
    write_dataset(tmp_path / "drive", drive)
    out = tmp_path / "out"
    solve_to_folder(drive, None, out)
    before = {name: (out / name).read_bytes() for name in swap.file_names(out)}
    limit = len(before["problem3/vehiclePose.mat"]) - 1
    code = (f"import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}));"
            "from slamlib.__main__ import main; sys.exit(main())")
    done = subprocess.run([sys.executable, "-c", code, "solve", "drive", "--out", "out"],
                          cwd=tmp_path, text=True, capture_output=True, timeout=120,
                          env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert done.returncode == 2 and done.stderr.count("slamlib: ") == 1
    assert "/vehiclePose.mat: " + os.strerror(errno.EFBIG) in done.stderr
    assert {name: (out / name).read_bytes() for name in swap.file_names(out)} == before


@pytest.mark.parametrize("spoil, reason", [
    (lambda folder: (folder / "problem1").write_text("a file of the user"), "problem1"),
    (lambda folder: (folder / "problem1" / "vehiclePose.mat").mkdir(parents=True),
     "problem1/vehiclePose.mat: " + os.strerror(errno.EISDIR)),
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
    assert not (tmp_path / "out" / swap.UNFINISHED).exists()


def test_a_staging_folder_that_somebody_removes_ends_the_run(tmp_path, drive, monkeypatch, capsys):
    write_dataset(tmp_path / "drive", drive.without("uwb"))

    def removed(*_):
        shutil.rmtree(tmp_path / "out" / f"{swap.STAGE}1", ignore_errors=True)
        return {}

    monkeypatch.setattr("slamlib.summary.summarize", removed)
    assert main(["solve", str(tmp_path / "drive"), "--out", str(tmp_path / "out")]) == 2
    assert "was removed while a run wrote to it" in capsys.readouterr().err
    assert swap.file_names(tmp_path / "out") == []


def test_names_in_a_list_that_lead_out_of_the_folder_are_ignored(tmp_path):
    (tmp_path / "out").mkdir()
    for name in ("above.txt", "out/ours.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "out" / swap.FILE_LIST).write_text(
        json.dumps(["../above.txt", str(tmp_path / "above.txt"), "ours.txt"]))
    swap.publish([swap.FileSet(tmp_path / "out", {})])
    assert swap.file_names(tmp_path) == ["above.txt", "out/.slamlib.json"]
    (tmp_path / "out" / swap.FILE_LIST).write_text("not JSON")
    swap.publish([swap.FileSet(tmp_path / "out", {}, ours=RESULT_NAMES)])
    assert swap.file_names(tmp_path) == ["above.txt", "out/.slamlib.json"]


@pytest.mark.slow
def test_pages_and_results_that_a_build_no_longer_makes_are_removed(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_stays", "# Stays", (RESULT,))
    write(tmp_path / "notebooks", "2_goes", "# Goes", (RESULT.replace("problem1", "other"),))
    build(tmp_path, datasets=["short"])
    mine = [tmp_path / "report" / "notes.html", tmp_path / "results" / "short" / "notes.txt",
            tmp_path / "results" / "mine" / "vehiclePose.mat"]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("mine")
    assert (tmp_path / "results" / "short" / "other" / "vehiclePose.mat").exists()
    (tmp_path / "notebooks" / "2_goes.ipynb").unlink()
    build(tmp_path, datasets=["short"])
    assert sorted(file.name for file in (tmp_path / "report").iterdir()) == [
        swap.FILE_LIST, "1_stays.html", "index.html", "notes.html", "report.pdf"]
    assert swap.file_names(tmp_path / "results") == [
        "mine/vehiclePose.mat", "short/.slamlib.json", "short/notes.txt",
        "short/problem1/vehiclePose.mat"]


@pytest.mark.slow
def test_a_notebook_that_fails_leaves_old_results_and_what_was_executed_is_kept(tmp_path, capsys):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_bad", "# Bad", ("1 / 0",))  # one at a time, the last first
    write(tmp_path / "notebooks", "2_good", "# Good", (RESULT,))
    old = tmp_path / "results" / "short" / "problem1" / "vehiclePose.mat"
    old.parent.mkdir(parents=True)
    old.write_text("old")
    with pytest.raises(NotebookError):
        build(tmp_path, datasets=["short"], kept=tmp_path / "kept", jobs=1)
    assert old.read_text() == "old" and hidden(tmp_path) == []
    write(tmp_path / "notebooks", "1_bad", "# Good now")
    capsys.readouterr()
    index = build(tmp_path, datasets=["short"], kept=tmp_path / "kept", jobs=1)[0].read_text()
    assert "2_good: nothing changed" in capsys.readouterr().err
    assert "short/problem1/vehiclePose.mat" in index
    assert len(results.read_vehicle_poses(old.parent)[0]) == 2


def test_a_notebook_whose_results_were_removed_is_not_kept(tmp_path):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_lost", "# Lost", (RESULT,), (
        'import shutil; shutil.rmtree(Path(os.environ["SLAMLIB_RESULTS"]).parents[1])',))
    with pytest.raises(FileNotFoundError, match="was removed while a run wrote to it"):
        build(tmp_path, datasets=["short"], kept=tmp_path / "kept")
    assert [*(tmp_path / "kept").glob("*.executed")] == []


def test_a_file_that_cannot_be_kept_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError):
        cache.keep(tmp_path / "kept", tmp_path / "a.ipynb", "0", new_notebook(), tmp_path, ["a"])
    assert not (tmp_path / "kept").exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", swap.END_SIGNALS)
def test_a_signal_ends_a_build_in_order(tmp_path, number):
    make_data(tmp_path)
    write(tmp_path / "notebooks", "1_slow", "# Slow", (RESULT + """
Path("kernel").write_text(str(os.getpid()))
time.sleep(100)""",))
    process = start(tmp_path, "report", "short")
    kernel = int(wait_for(lambda: (tmp_path / "notebooks" / "kernel").is_file() and (
        tmp_path / "notebooks" / "kernel").read_text(), process))
    process.send_signal(number)
    told = process.communicate(timeout=60)[1]
    assert process.returncode == 128 + number
    assert told.splitlines()[-1] == f"slamlib: ended by {number.name}" and "Traceback" not in told
    assert swap.file_names(tmp_path / "results") == [] and hidden(tmp_path) == []
    assert not locks.process_exists(kernel)


def test_a_signal_while_files_are_replaced_waits_until_they_are(tmp_path, drive, monkeypatch,
                                                                capsys):
    write_dataset(tmp_path / "drive", drive.without("uwb"))
    mark = swap._mark
    monkeypatch.setattr(swap, "_mark", lambda *arguments: (
        signal.raise_signal(signal.SIGTERM), mark(*arguments)))
    out = tmp_path / "out"
    assert main(["solve", str(tmp_path / "drive"), "--out", str(out)]) == 128 + signal.SIGTERM
    *found, told = capsys.readouterr().err.splitlines()
    assert told == "slamlib: ended by SIGTERM" and all(
        line.startswith("drive: ") for line in found)
    assert (out / "summary.json").exists() and (out / "problem3" / "ArucoMap.mat").exists()
    assert not (out / swap.UNFINISHED).exists() and hidden(out) == []


def test_a_folder_that_is_protected_is_told_before_anything_changes(tmp_path, drive, monkeypatch):
    solve_to_folder(drive.without("uwb"), None, tmp_path)
    before = {name: (tmp_path / name).read_bytes() for name in swap.file_names(tmp_path)}
    protected = tmp_path / "problem3"
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != protected)
    with pytest.raises(PermissionError, match="problem3"):
        solve_to_folder(drive.without("uwb").without("aruco"), None, tmp_path)
    assert before == {name: (tmp_path / name).read_bytes() for name in swap.file_names(tmp_path)}


@pytest.mark.parametrize("content", ["5", "null", "[1, null, [], \"a\\u0000\"]", "{\"a\": 1}",
                                     "[" * 100_000, None])
def test_a_list_of_files_that_is_none_names_no_file(tmp_path, content):
    """Not those of the user; None is a pipe, on which reading would wait."""
    (tmp_path / "mine.txt").write_text("mine")
    if content is None:
        os.mkfifo(tmp_path / swap.FILE_LIST)
    else:
        (tmp_path / swap.FILE_LIST).write_text(content)
    with swap.staging(tmp_path) as stage:
        swap.write_atomically(stage / "new.txt", b"new")
        swap.publish([swap.FileSet(tmp_path, {"new.txt": stage / "new.txt"})])
    assert swap.file_names(tmp_path) == [swap.FILE_LIST, "mine.txt", "new.txt"]
    assert json.loads((tmp_path / swap.FILE_LIST).read_text()) == ["new.txt"]


def test_temporary_folders_of_builds_that_are_gone_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(execution, "LONGEST_FOLDER", len(str(tmp_path)))
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    names = [f"slamlib-{gone.pid}-x", f"slamlib-{os.getppid()}-x", "slamlib-mine", "other"]
    for name in names:
        (tmp_path / name).mkdir()
    with execution.temporary_folder() as folder:
        assert folder.parent == tmp_path and folder.name.startswith(f"slamlib-{os.getpid()}-")
        assert {path.name for path in tmp_path.iterdir()} == {folder.name, *names[1:]}
    assert not folder.exists()


@pytest.mark.slow
@pytest.mark.parametrize("number", swap.END_SIGNALS)
def test_a_signal_ends_a_solve_in_order(tmp_path, number):
    write_dataset(tmp_path / "drive", simulate("long", 3)[0])
    process = start(tmp_path, "solve", "drive", "--out", "out")
    wait_for(lambda: [*tmp_path.glob(f"out/{swap.STAGE}1/files/*/*.mat")], process)
    process.send_signal(number)
    out, told = process.communicate(timeout=60)
    *found, last = told.splitlines()
    assert out == "" and last == f"slamlib: ended by {number.name}"
    assert all(line.startswith("drive: ") for line in found)
    assert process.returncode == 128 + number and [*(tmp_path / "out").iterdir()] == []


def test_a_signal_that_is_ignored_stays_so_and_handlers_are_as_before(tmp_path, drive, monkeypatch):
    """As under nohup; and a run from a thread installs no handlers."""
    write_dataset(tmp_path / "drive", drive.without("uwb").without("aruco"))
    seen = []
    monkeypatch.setattr("slamlib.summary.merged", lambda _: seen.append(
        [signal.getsignal(each) for each in swap.END_SIGNALS]) or [])
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        arguments = ["solve", str(tmp_path / "drive"), "--out", str(tmp_path / "out")]
        assert main(arguments) == 0
        thread = threading.Thread(target=main, args=(arguments,))
        thread.start()
        thread.join()
    finally:
        signal.signal(signal.SIGHUP, before)
    assert callable(seen[0][0]) and seen[0][1] == signal.SIG_IGN
    assert seen[1] == [signal.getsignal(signal.SIGTERM), signal.SIG_IGN]
