"""The command line: its exit codes, and one sentence for what a user must change."""

import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from conftest import contradicted, file_names
from numeric import short, vehicle

from slamlib import estimate, solve
from slamlib.__main__ import main
from slamlib.io.dataset import read_dataset
from slamlib.io.results import read_structs, read_summary
from slamlib.studies.simulation import write_dataset


@pytest.fixture
def drive():
    """A simulated drive of 100 poses, and its truth."""
    return short(3, 100)


@pytest.fixture
def folder(tmp_path, drive):
    """A folder with the dataset of the drive, without truth, in `drive`."""
    write_dataset(tmp_path / "drive", drive[0])
    return tmp_path


def solved(folder, *options, code=0):
    """The summary of `solve` on folder/drive into folder/out."""
    out = folder / "out"
    assert main(["solve", str(folder / "drive"), "--out", str(out), *map(str, options)]) == code
    return read_summary(out)


@pytest.mark.slow
def test_solve_says_what_it_reads_and_prints_a_table(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_dataset(tmp_path / "drive", *short(21))
    main("solve drive --out out --problem 1".split())
    table, told = capsys.readouterr()
    assert told.startswith("drive: 2000 poses, ") and told.count("\n") == 2
    assert told.endswith(f"results: {tmp_path / 'out'}\n")
    header, row = table.splitlines()
    assert "ate_m" in header and row.split()[:3] == ["drive", "problem1", "2000"]


def test_options_of_solve_are_heeded_and_said(tmp_path, drive, capsys):
    """Problem 4 alone with a stated slip and another kernel, beside odometry."""
    write_dataset(tmp_path / "drive", vehicle(kernel="Huber", slip=2e-3)(drive[0]))
    out = tmp_path / "out"
    summary = solved(tmp_path, "--problem", 4, "--problem", 1)
    assert [*summary["problems"]] == ["problem1", "problem4"]
    expected = estimate(read_dataset(tmp_path / "drive"), slip=2e-3, kernel="Huber")
    np.testing.assert_array_equal(read_structs(out / "problem4", "vehiclePose")[1], expected.poses)
    table, told = capsys.readouterr()
    assert told.splitlines()[-1] == f"results: {out}"
    assert "ate_m" not in table                                             # without truth


def test_verbose_prints_decisions(folder):
    """In a process of its own."""
    command = [sys.executable, "-m", "slamlib", *"solve drive --out out --problem 3 -v".split()]
    told = subprocess.run(command, cwd=folder, text=True, capture_output=True, timeout=300).stderr
    slip = read_summary(folder / "out")["problems"]["problem3"]["slip_sqrt_m"]
    assert re.search(r"\nround 1: slip [\d.]+ mm after 1 m, factors ", told)
    mean = re.escape(f"slip {1e3 * slip:.3g} mm after 1 m")
    assert re.search(rf"\nGTSAM: {mean}, \d+ factors, \d+ variables, \d+ steps from ", told)


def test_the_process_beside_solves_and_one_that_ends_is_replaced():
    """In a process with a single thread."""
    code = """if True:
        import os
        from slamlib.solve import _meanwhile
        here = os.getpid()
        def pid(ends):
            if ends and os.getpid() != here:
                os._exit(1)
            return os.getpid()
        print(*[_meanwhile(pid, ends)() == here for ends in (False, True)])
        """
    told = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True)
    assert told.stdout == f"{sys.platform != 'linux'} True\n"


def test_results_are_not_written_into_a_dataset(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    before = file_names(folder)
    for command in (["solve", "drive", "--out", "drive"],
                    ["solve", "drive", "--out", "drive/truth"],
                    ["solve", "drive", "--out", "drive/new/results"],
                    ["solve", "drive", "nowhere", "--out", "."],
                    ["report", "--data", "results"]):
        assert main(command) == 2
        assert "expected another folder" in capsys.readouterr().err
    assert set(file_names(folder)) - {*before} <= {"drives.csv"}


@pytest.mark.parametrize("arguments, word", [
    (["solve", "nowhere", "--out", "out"], "nowhere"),
    (["solve", "bad", "--out", "out"], "bad/encoderReading.txt, line 2: expected "),
    (["solve", ".", "--out", "out"], "encoderReading.txt: expected this file, found none. Not"),
    (["solve", "good", "--out", "out", "--problem", "3"], "expected the measurements of problem3"),
    (["solve", "a/good", "good", "--out", "out"], "datasets in folders of different names"),
    (["report", "medium", "good", "--data", "."], ": expected one of bad, good, found 'medium'"),
])
def test_bad_arguments_give_exit_code_2_and_one_sentence(tmp_path, monkeypatch, capsys, arguments,
                                                         word):
    for name, text in (("good", "1 0 0\n"), ("bad", "1 0 0\n2 ten 9\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "encoderReading.txt").write_text(text)
    (tmp_path / "encoder.txt").write_text("1 0 0\n")
    monkeypatch.chdir(tmp_path)
    before = file_names(tmp_path)
    assert main(arguments) == 2
    told = [line for line in capsys.readouterr().err.splitlines()
            if not line.startswith("good: ")]                                 # what was found
    assert len(told) == 1 and word in told[0]
    assert told[0].startswith("slamlib") and len(told[0]) < 250
    assert file_names(tmp_path) == before


def test_a_folder_for_the_results_is_required():
    with pytest.raises(SystemExit, match="2"):
        main(["solve", "good"])


def test_notes_and_doubts_are_said_and_in_the_summary(tmp_path, drive, capsys):
    """An antenna of two ranges; a name that Windows made."""
    dataset, _ = drive
    first = dataset.uwb.antenna[0]
    two = np.flatnonzero(dataset.uwb.antenna == first)[:2]
    write_dataset(tmp_path / "drive", replace(dataset, uwb=dataset.uwb.select(two)))
    (tmp_path / "drive" / "ArucoReading.txt").rename(tmp_path / "drive" / "ArucoReading.txt.txt")
    summary = solved(tmp_path)
    doubt, = summary["doubts"]
    assert doubt["what"] == "antenna"
    told = capsys.readouterr()
    last = told.out.splitlines()[-1]
    assert last == f"drive: doubt (antenna): {doubt['sentence']} {doubt['advice']}"
    assert "Read ArucoReading.txt.txt as ArucoReading.txt." in summary["notes"]
    for note in summary["notes"]:
        assert f"drive: note: {note}\n" in told.err


def test_a_problem_that_fails_costs_the_others_nothing(tmp_path, capsys, drive):
    """Every marker is seen twice at a pose, at two places, and neither is confirmed."""
    write_dataset(tmp_path / "drive", contradicted(drive[0]))
    problems = solved(tmp_path, code=3)["problems"]
    assert [*problems] == list(solve.PROBLEMS)
    failed = [name for name, row in problems.items() if "failed" in row]
    assert failed == ["problem2"] and not (tmp_path / "out" / "problem2").exists()
    reason = problems["problem2"]["failed"]
    assert reason.startswith("expected sightings")
    assert f"drive: problem2 could not be solved: {reason}\n" in capsys.readouterr().out
