"""The command line: its exit codes, and one sentence for what a user must change."""

import json
import re
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT, contradicted

from slamlib import estimate, solve
from slamlib.__main__ import main
from slamlib.core import se2
from slamlib.core.odometry import equation2
from slamlib.io.dataset import read_dataset
from slamlib.io.files import file_names
from slamlib.io.results import read_structs
from slamlib.studies.simulation import simulate, write_dataset


@pytest.fixture
def drive():
    """A simulated drive of 100 poses, and its truth."""
    dataset, truth = simulate("short", seed=3)
    return dataset.first(100), replace(truth, poses=truth.poses[:100])


def run(*arguments, cwd=ROOT):
    return subprocess.run([sys.executable, "-m", "slamlib", *map(str, arguments)], cwd=cwd,
                          text=True, capture_output=True, timeout=300)


def solved(folder, *options, code=0):
    """The summary of `solve` on folder/drive into folder/out."""
    assert main(["solve", str(folder / "drive"), "--out", str(folder / "out"),
                 *map(str, options)]) == code
    return json.loads((folder / "out" / "summary.json").read_text())


@pytest.mark.slow
def test_simulate_then_solve(tmp_path):
    """In processes of their own; a path is driven twice."""
    made = run("simulate", "drive", "--path", "short", "--seed", 21, "--nlos", 0.15, "--rounds", 2,
               cwd=tmp_path)
    assert (made.returncode, made.stdout, made.stderr) == (0, "", "")
    done = run("solve", "drive", "--out", "out", "--problem", 1, cwd=tmp_path)
    assert done.returncode == 0
    *found, last = done.stderr.splitlines()
    assert [line.split(":")[1] for line in found] == [
        " encoders", " markers", " ranges", " vehicle.toml", " truth"]
    assert last == f"results: {tmp_path / 'out'}"
    lines = done.stdout.splitlines()
    assert lines[0] == "drive: 4000 poses" and lines[2].startswith("problem1 ")
    assert max(map(len, lines)) <= 100
    dataset, expected = read_dataset(tmp_path / "drive"), simulate("short", 21, rounds=2)[0]
    np.testing.assert_array_equal(dataset.ticks, expected.ticks)
    _, *found = read_structs(tmp_path / "out" / "problem1", "vehiclePose")
    for got, expected in zip(found, equation2(dataset.ticks, dataset.vehicle), strict=True):
        np.testing.assert_array_equal(got, expected)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["dataset"] == "drive" and 0 < summary["problems"]["problem1"]["ate_m"] < 1


def test_options_of_solve_are_heeded_and_said(tmp_path, capsys, drive):
    """Problem 4 alone with a known slip and another kernel, beside odometry, as CSV and picture."""
    write_dataset(tmp_path / "drive", drive[0])
    (tmp_path / "drive" / "vehicle.toml").write_text('kernel = "Cauchy"\n')
    out, picture = tmp_path / "out", tmp_path / "new" / "map.PNG"
    summary = solved(tmp_path, "--problem", 4, "--slip", 2e-3, "--problem", 1, "--kernel", "Huber",
                     "--csv", "--plot", picture)
    assert summary["kernel"] == "Huber" and [*summary["problems"]] == ["problem1", "problem4"]
    assert summary["problems"]["problem4"]["slip_sqrt_m"] == 2e-3
    expected = estimate(read_dataset(tmp_path / "drive"), slip=2e-3, kernel="Huber")
    np.testing.assert_array_equal(read_structs(out / "problem4", "vehiclePose")[1], expected.poses)
    assert {path.with_suffix(".csv") for path in out.rglob("*.mat")} == {*out.rglob("*.csv")}
    assert {path.name for path in out.rglob("*.tum")} == {"problem1.tum", "problem4.tum"}
    assert picture.read_bytes().startswith(b"\x89PNG")
    table, told = capsys.readouterr()
    assert "slip = 0.002" in told and 'kernel = "Huber"' in told and "Cauchy" not in told
    assert told.splitlines()[-2:] == [f"results: {out}", f"picture: {picture}"]
    assert [line[-2:] for line in table.splitlines()[1:4]] == ["TE", " -", " -"]       # no truth
    solved(tmp_path, "--problem", "problem1")
    assert file_names(out) == ["problem1/vehiclePose.mat", "summary.json"]


def test_verbose_prints_decisions_of_both_processes_and_leaves_stdout(tmp_path, drive):
    write_dataset(tmp_path / "drive", drive[0])
    plain = run("solve", "drive", "--out", "out", cwd=tmp_path)
    told = run("solve", "drive", "--out", "out", "-v", cwd=tmp_path)
    assert (told.returncode, told.stdout) == (0, plain.stdout) and "GTSAM" not in plain.stderr
    slip = json.loads((tmp_path / "out" / "summary.json").read_text())[
        "problems"]["problem3"]["slip_sqrt_m"]
    assert f"round 1: slip {1e3 * slip:.3g} mm after 1 m, factors " in told.stderr
    for pattern in (r"Cauchy kernel of 3 sigmas: error [\d.]+ after \d+ steps",
                    r"accepted \d+ of \d+ sightings, \d+ of \d+ ranges, \d+ changed",
                    r"GTSAM: \d+ factors, \d+ variables, \d+ steps from odometry, differs by up to",
                    r"estimate of drive: 100 poses", r"estimate of drive: \d+\.\d s"):
        assert re.search(f"^.*{pattern}", told.stderr, re.MULTILINE), pattern
    for problem in solve.PROBLEMS:
        assert f"drive: {problem} solved in " in told.stderr


def test_a_problem_that_takes_its_time_is_told_once(tmp_path, monkeypatch, caplog, drive):
    write_dataset(tmp_path / "drive", drive[0])
    find = solve.find

    def slow(*arguments):
        time.sleep(0.2)
        return find(*arguments)

    monkeypatch.setattr(solve, "find", slow)
    for seconds, count in ((0.05, 1), (60, 0)):
        monkeypatch.setattr(solve, "SLOW", seconds)
        caplog.clear()
        solved(tmp_path, "--problem", 3)
        told = [message.split(" in ")[0] for message in caplog.messages]
        assert told == count * ["drive: problem3 solved"]


def test_results_are_not_written_into_a_dataset(tmp_path, capsys):
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "encoderReading.txt").write_text("1 0 0\n")
    for command in (["solve", "drive", "--out", "drive"],
                    ["solve", "drive", "--out", "drive/truth"],
                    ["solve", "drive", "nowhere", "--out", "."],
                    ["report", "--data", ".", "--results", "."]):
        done = run(*command, cwd=tmp_path)
        assert done.returncode == 2 and "expected another folder for the results" in done.stderr
    assert file_names(tmp_path / "drive") == ["encoderReading.txt"]
    assert main(["solve", str(tmp_path / "drive"), "--out", str(tmp_path), "--problem", "1"]) == 0


SOLVE = ["solve", "good", "--out", "out"]


@pytest.mark.parametrize("arguments, word", [
    (["solve", "nowhere", "--out", "out"], "nowhere"),
    (["solve", "bad", "--out", "out"], "bad/encoderReading.txt, line 2: expected "),
    (["solve", "good", "--out", "good/encoderReading.txt"], "to write to (File exists)"),
    (["solve", ".", "--out", "out"], "encoderReading.txt: expected this file, found none. Not"),
    (["simulate", "drive", "--slip", "nan"], "from 0 to 1"),
    (["simulate", "drive", "--nlos", "some"], "invalid float value: 'some'"),
    (["simulate", "drive", "--seed", "-1"], "a seed from 0 on"),
    (["simulate", "drive", "--rounds", "0"], "rounds from 1 on"),
    (["solve", "good"], "--out"),
    ([*SOLVE, "--problem", "5"], "invalid choice: '5'"),
    ([*SOLVE, "--problem", "3"], "expected the measurements of problem3"),
    ([*SOLVE, "--kernel", "L2"], "for kernel, found 'L2'"),
    ([*SOLVE, "--slip", "1"], "from 0 to 0.1 sqrt(m) for slip, found '1.0'"),
    ([*SOLVE, "--plot", "a.gif"], ".svg file, of one dataset, found 'a.gif'"),
    ([*SOLVE, "more"], "unrecognized arguments: more"),
    (["simulate", ".", "--seed", "1"], "new or empty folder"),
    (["report", "--notebooks", ROOT / "notebooks", "--data", "nowhere"], "nowhere"),
    (["report", "--notebooks", ".", "--data", "."], "found no notebooks"),
    (["report", "medium", "good", "--notebooks", ROOT / "notebooks", "--data", "."],
     ": expected one of bad, good, found 'medium'"),
    (["hand-in", "--out", "."], "expected a file to write, found a folder"),
    ([], "required"),
])
def test_bad_arguments_give_exit_code_2_and_one_sentence(tmp_path, monkeypatch, capsys, arguments,
                                                         word):
    for name, text in (("good", "1 0 0\n"), ("bad", "1 0 0\n2 ten 9\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "encoderReading.txt").write_text(text)
    (tmp_path / "encoder.txt").write_text("1 0 0\n")
    monkeypatch.chdir(tmp_path)
    before = file_names(tmp_path)
    try:
        code = main(list(map(str, arguments)))
    except SystemExit as stop:  # argparse's; any other exception would be a traceback
        code = stop.code
    told = [line for line in capsys.readouterr().err.splitlines()
            if not line.startswith(("good: ", "usage: ", "  "))]      # what was found, what can be
    assert code == 2 and len(told) == 1 and word in told[0]
    assert told[0].startswith("slamlib") and len(told[0]) < 250
    assert file_names(tmp_path) == before


def test_notes_and_doubts_are_said_and_in_the_summary(tmp_path, capsys, drive):
    """An antenna of two ranges; truth in another frame."""
    dataset, truth = drive
    first = dataset.uwb.antenna[0]
    two = np.flatnonzero(dataset.uwb.antenna == first)[:2]
    dataset = replace(dataset, uwb=dataset.uwb.select(two))
    truth = replace(truth, poses=se2.compose([1, 2, 0.5], truth.poses), **{
        name: getattr(truth, name)[:0]
        for name in ("marker", "marker_in_world", "antenna", "antenna_in_world")})
    folder = tmp_path / "drive"
    write_dataset(folder, dataset, truth)
    (folder / "ArucoReading.txt").rename(folder / "ArucoReading.txt.txt")
    (folder / "truth" / "ArucoMap.txt").rename(folder / "truth" / "ArucoMap.csv")
    summary = solved(tmp_path)
    antenna, = summary["doubts"]
    assert set(antenna) == {"what", "sentence"} and antenna["what"] == "antenna"
    assert antenna["sentence"].startswith(f"Antenna {first} is in doubt: only 2 of its 2 ranges")
    assert list(summary["problems"]["problem4"]["antennas_in_doubt"]) == [str(first)]
    assert summary["problems"]["problem3"]["ate_m"] < 0.05          # in the frame of the estimate
    told = capsys.readouterr()
    assert told.out.splitlines()[-1] == f"doubt (antenna): {antenna['sentence']}"
    *notes, frame = summary["notes"]
    assert notes == ["ArucoReading.txt.txt was read as ArucoReading.txt.",
                     "In truth: ArucoMap.csv was read as ArucoMap.txt."]
    assert frame.startswith("In truth: vehiclePose.txt begins at (1.000 m, 2.000 m, 0.5000 rad):")
    assert told.err.splitlines()[-4:-1] == [f"drive: note: {note}" for note in summary["notes"]]


def test_without_guesses_problems_1_to_3_are_solved_and_it_is_said(tmp_path, capsys, drive):
    write_dataset(tmp_path / "drive", drive[0])
    (tmp_path / "drive" / "UwbAntennaGuess.txt").unlink()
    note = "UwbAntennaGuess.txt is missing: problem 4 is left out."
    summary = solved(tmp_path)
    assert [*summary["problems"]] == [*solve.PROBLEMS][:-1] and summary["notes"] == [note]
    assert f"drive: note: {note}\n" in capsys.readouterr().err
    assert main(["solve", str(tmp_path / "drive"), "--out", str(tmp_path / "out"),
                 "--problem", "4"]) == 2
    *_, told, reason = capsys.readouterr().err.splitlines()
    assert told == f"drive: note: {note}" and "expected the measurements of problem4" in reason


def test_a_problem_that_fails_costs_the_others_nothing(tmp_path, capsys, drive):
    """Every marker is seen twice at a pose, at two places, and neither is confirmed."""
    write_dataset(tmp_path / "drive", replace(drive[0], aruco=contradicted(drive[0].aruco)))
    problems = solved(tmp_path, code=3)["problems"]
    failed, = (name for name, row in problems.items() if "failed" in row)
    assert failed == "problem2" and [*problems] == list(solve.PROBLEMS)
    assert {path.name for path in tmp_path.glob("out/problem*")} == problems.keys() - {failed}
    assert problems[failed]["failed"].startswith("expected sightings")
    assert f"problem2       could not be solved: {problems[failed]['failed']}\n" \
        in capsys.readouterr().out
