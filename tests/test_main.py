"""The command line: its exit codes, and one sentence for what a user must change."""

import json
import os
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import contradicted

import slamlib
from slamlib import se2, slam, solve
from slamlib.__main__ import main
from slamlib.dataset import read_dataset
from slamlib.doubt import Doubt
from slamlib.odometry import equation2
from slamlib.results import read_vehicle_poses
from slamlib.simulation import simulate, write_dataset
from slamlib.summary import solve_to_folder
from slamlib.swap import file_names

ROOT = Path(__file__).parents[1]


def run(*arguments, cwd=ROOT):
    return subprocess.run([sys.executable, "-m", "slamlib", *map(str, arguments)], cwd=cwd,
                          text=True, capture_output=True, timeout=300)


@pytest.mark.slow
def test_simulate_then_solve(tmp_path):
    made = run("simulate", "drive", "--path", "short", "--seed", 21, "--nlos", 0.15, cwd=tmp_path)
    assert (made.returncode, made.stdout, made.stderr) == (0, "", "")
    solved = run("solve", "drive", "--out", "out", cwd=tmp_path)
    assert solved.returncode == 0
    assert [line.split(":")[1] for line in solved.stderr.splitlines()] == [
        " encoders", " markers", " ranges", " vehicle.toml", " truth"]
    lines = solved.stdout.splitlines()
    assert lines[0] == "drive: 2000 poses" and lines[2].startswith("problem1 ")
    assert max(map(len, lines)) <= 100
    dataset = read_dataset(tmp_path / "drive")
    for got, expected in zip(read_vehicle_poses(tmp_path / "out" / "problem1"),
                             equation2(dataset.ticks, dataset.vehicle), strict=True):
        np.testing.assert_array_equal(got, expected)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["dataset"] == "drive" and 0 < summary["problems"]["problem1"]["ate_m"] < 1


@pytest.mark.slow
def test_what_vehicle_toml_gives_of_the_noise_is_taken_and_the_summary_says_so(tmp_path, capsys):
    """By each problem that has such noise; the rest is learned. Without entries nothing is said."""
    write_dataset(tmp_path / "drive", simulate("short", seed=3)[0].first(300))
    given = {"slip = 2e-3": ["slip_sqrt_m"], "marker_noise_factor = 1.25": ["marker_noise_factor"],
             "range_noise_factor = 0.5": ["range_noise_factor"], "": []}
    for entry, names in given.items():
        (tmp_path / "drive" / "vehicle.toml").write_text(entry + "\n")
        assert main(["solve", str(tmp_path / "drive"), "--out", str(tmp_path / "out")]) == 0
        rows = json.loads((tmp_path / "out" / "summary.json").read_text())["problems"]
        for problem, row in rows.items():
            has = [name for name in names if problem == "problem4" or problem == "problem3"
                   and "range" not in name or problem == "problem2_fused" and "range" not in name]
            assert row.get("given", []) == has
            for name in has:
                assert row[name] == float(entry.split()[-1])
                sigma = name.replace("factor", "relative_sigma").replace("sqrt_m", "relative_sigma")
                assert row.get(sigma, 0) == 0
        for problem in ("problem3", "problem4"):
            assert (rows[problem]["slip_relative_sigma"] == 0) == ("slip" in entry)
    assert "scatter" not in capsys.readouterr().out


def test_simulated_paths_are_driven_several_times(tmp_path):
    assert main(["simulate", str(tmp_path / "drive"), "--rounds", "3", "--seed", "5"]) == 0
    found, (expected, _) = read_dataset(tmp_path / "drive"), simulate("short", 5, rounds=3)
    assert len(found.ticks) == 6000
    np.testing.assert_array_equal(found.ticks, expected.ticks)


def test_solve_without_truth_and_with_a_single_pose(tmp_path, capsys):
    (tmp_path / "encoderReading.txt").write_text("1 0 0\n")
    assert main(["solve", str(tmp_path), "--out", str(tmp_path / "out")]) == 0
    assert "ATE" not in capsys.readouterr().out
    assert len(read_vehicle_poses(tmp_path / "out" / "problem1")[0]) == 1


def test_two_processes_write_what_one_does(tmp_path):
    """In another thread than the main one there is one process."""
    dataset, truth = simulate("short", 8)
    both = dataset.first(400), replace(truth, poses=truth.poses[:400])
    two, one = solve_to_folder(*both, tmp_path / "2"), {}
    thread = threading.Thread(target=lambda: one.update(solve_to_folder(*both, tmp_path / "1")))
    thread.start()
    thread.join()
    assert list(one["problems"]) == list(two["problems"]) == list(solve.PROBLEMS)
    for summary in (one, two):
        assert all(row.pop("seconds") > 0 for row in summary["problems"].values())
    assert one == two
    for file in sorted((tmp_path / "1").rglob("*.mat")):
        other = tmp_path / "2" / file.relative_to(tmp_path / "1")
        assert file.read_bytes() == other.read_bytes()


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux forks safely")
def test_a_second_process_that_is_killed_costs_time_only(tmp_path, monkeypatch):
    dataset, _ = simulate("short", 8)
    here = os.getpid()

    def killed(*arguments, **options):
        if os.getpid() != here:
            os.kill(os.getpid(), 9)
        return find(*arguments, **options)

    find = solve.find
    monkeypatch.setattr(solve, "find", killed)
    rows = solve_to_folder(dataset.first(300), None, tmp_path)["problems"]
    assert list(rows) == list(solve.PROBLEMS)
    assert not any("failed" in row for row in rows.values())


def test_options_of_solve_are_heeded_and_said(tmp_path, capsys):
    """Problem 4 alone with a known slip and another kernel, beside odometry, as CSV and picture."""
    write_dataset(tmp_path / "drive", simulate("short", seed=3)[0].first(200))
    out, picture = tmp_path / "out", tmp_path / "new" / "map.PNG"
    assert main(["solve", str(tmp_path / "drive"), "--out", str(out), "--problem", "4", "--slip",
                 "2e-3", "--problem", "1", "--kernel", "Huber", "--csv", "--plot",
                 str(picture)]) == 0
    summary = json.loads((out / "summary.json").read_text())
    row = summary["problems"]["problem4"]
    assert summary["kernel"] == "Huber" and [*summary["problems"]] == ["problem1", "problem4"]
    assert row["slip_sqrt_m"] == 2e-3 and row["given"] == ["slip_sqrt_m"]
    expected = slam.estimate(read_dataset(tmp_path / "drive"), slip=2e-3, kernel="Huber")
    np.testing.assert_array_equal(read_vehicle_poses(out / "problem4")[0], expected.poses)
    assert {path.with_suffix(".csv") for path in out.rglob("*.mat")} == {*out.rglob("*.csv")}
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "vehicle.toml: slip = 0.002" in capsys.readouterr().err
    assert main(["solve", str(tmp_path / "drive"), "--out", str(out), "--problem", "problem1"]) == 0
    assert file_names(out) == [".slamlib.json", "problem1/vehiclePose.mat", "summary.json"]


def test_results_never_replace_the_dataset_or_the_current_folder(tmp_path, monkeypatch, capsys):
    write_dataset(tmp_path / "drive", simulate("short", seed=3)[0].first(40))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for command in (["solve", "../drive", "--out"], ["report", "--data", "..", "--report"],
                    ["report", "--data", "..", "--results"]):
        for out in ("..", ".", tmp_path, "../drive")[:4 if command[0] == "solve" else 3]:
            assert main([*command, str(out)]) == 2
            told = capsys.readouterr().err
            assert told.startswith(f"slamlib: {out}: expected another folder") \
                and told.count("\n") == 1
    assert sorted(file_names(tmp_path)) == sorted(
        f"drive/{each}" for each in file_names(tmp_path / "drive"))
    assert main(["solve", "../drive", "--out", "../drive/out", "--problem", "1"]) == 0


def test_version_and_a_missing_jupyterlab(monkeypatch, capsys):
    with pytest.raises(SystemExit, match="^0$"):
        main(["--version"])
    assert capsys.readouterr().out == f"slamlib {slamlib.__version__}\n"
    monkeypatch.setattr("slamlib.report.lab.find_spec", lambda _: None)
    assert main(["lab"]) == 2
    assert capsys.readouterr().err.startswith("slamlib: expected JupyterLab beside ")


def test_bad_data_is_one_sentence_and_exit_code_2_and_writes_nothing(tmp_path):
    (tmp_path / "drive").mkdir()
    (tmp_path / "drive" / "encoderReading.txt").write_text("1 0 0\n2 ten 9\n")
    failed = run("solve", "drive", "--out", "out", cwd=tmp_path)
    assert failed.returncode == 2 and failed.stdout == ""
    assert failed.stderr.startswith("slamlib: drive/encoderReading.txt, line 2: expected ")
    assert failed.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("arguments, word", [
    (["solve", "nowhere", "--out", "out"], "nowhere"),
    (["simulate", "drive", "--nlos", "1.5"], "from 0 to 1"),
    (["simulate", "drive", "--slip", "nan"], "from 0 to 1"),
    (["simulate", "drive", "--nlos", "some"], "from 0 to 1, found 'some'"),
    (["simulate", "drive", "--seed", "x"], "a whole number from 0 on, found 'x'"),
    (["simulate", "drive", "--seed", "9" * 5000], "from 0 on, found '999"),
    (["simulate", "drive", "--rounds", "0"], "from 1 on"),
    (["simulate", "drive", "--path", "round"], "invalid choice: 'round'"),
    (["simulate"], "FOLDER"),
    (["solve", "drive"], "--out"),
    (["solve", "drive", "--out", "out", "--problem", "5"], "problem4, found 'problem5'"),
    (["solve", "drive", "--out", "out", "--kernel", "L2"], "asymmetric Tukey, found 'L2'"),
    (["solve", "drive", "--out", "out", "--slip", "1"], "from 0 to 0.1 sqrt(m), found '1'"),
    (["solve", "drive", "--out", "out", "--plot", "a.gif"], ".svg, found '.gif'"),
    (["solve", "drive", "--out", "out", "more\nthan one"], "more than one"),
    (["report", "--no-code", "--all-code"], "not allowed with argument --no-code"),
    (["simulate", ".", "--seed", "1"], "new or empty folder"),
    (["report", "--notebooks", ROOT / "notebooks", "--data", "nowhere"], "nowhere"),
    (["report", "--jobs", "0"], "jobs"),
    (["hand-in", "--out", "."], "expected the name of a file to write, found a folder"),
    ([], "required"),
])
def test_bad_arguments_give_exit_code_2_and_one_sentence(tmp_path, monkeypatch, capsys, arguments,
                                                         word):
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    try:
        code = main(list(map(str, arguments)))
    except SystemExit as stop:  # argparse's; any other exception would be a traceback
        code = stop.code
    told = capsys.readouterr().err
    assert code == 2 and word in told
    assert told.startswith("slamlib: ") and told.count("\n") == 1 and len(told) < 250
    assert sorted(f.name for f in tmp_path.iterdir()) == ["file"]


def test_an_output_that_cannot_be_written_is_one_sentence(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    (tmp_path / "encoderReading.txt").write_text("1 0 0\n2 10 9\n")
    assert main(["solve", str(tmp_path), "--out", str(tmp_path / "file")]) == 2
    *found, told = capsys.readouterr().err.splitlines()
    assert told.startswith("slamlib: ") and "file" in told
    assert not any(line.startswith("slamlib: ") for line in found)


def test_wrong_python_or_platform_is_one_sentence():
    check = """
import platform, sys
sys.path.insert(0, {root!r})
import check_python
check_python.installed = lambda: None
{change}
print(check_python.problem())
"""
    conda = "platform.system = lambda: 'Windows'; check_python.installed = lambda: ['4', '{}']"
    cases = {"pass": "None", conda.format(3): "None", conda.format(2): "WSL2",
             conda.format(3) + "; sys.version_info = (3, 10, 9)": "WSL2",
             "sys.version_info = (3, 10, 9)": "Python 3.11 to 3.14",
             "sys.version_info = (3, 15, 0)": "Python 3.11 to 3.14",
             "platform.system = lambda: 'Windows'": "environment.yml",
             "platform.machine = lambda: 'riscv64'": "riscv64",
             "platform.system = lambda: 'Linux'; platform.libc_ver = lambda: ('', '')": "glibc"}
    for change, word in cases.items():
        code = check.format(root=str(ROOT), change=change)
        said = subprocess.run([sys.executable, "-c", code], text=True, capture_output=True,
                              check=True, env={**os.environ}).stdout
        assert word in said and said.count("\n") == 1, change


def test_doubts_are_in_the_summary_and_below_the_table(tmp_path, capsys):
    """About the drive first, then by problem; an antenna of two ranges; truth in another frame."""
    dataset, truth = simulate("short", seed=3)
    dataset, poses = dataset.first(100), truth.poses[:100]
    first = dataset.uwb.antenna[0]
    two = np.flatnonzero(dataset.uwb.antenna == first)[:2]
    dataset = replace(dataset, uwb=dataset.uwb.select(two))
    truth = replace(truth, poses=se2.compose([1, 2, 0.5], poses), **{
        name: getattr(truth, name)[:0]
        for name in ("marker", "marker_in_world", "antenna", "antenna_in_world")})
    write_dataset(tmp_path / "drive", dataset, truth)
    assert main(["solve", str(tmp_path / "drive"), "--out", str(tmp_path / "out")]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    frame, antenna = summary["doubts"]
    assert set(frame) == set(antenna) == {"what", "sentence"}
    assert frame["what"] == "truth-frame" and "(1.000 m, 2.000 m, 0.5000 rad)" in frame["sentence"]
    assert antenna["what"] == "antenna"
    assert antenna["sentence"].startswith(f"Antenna {first} is in doubt: only 2 of its 2 ranges")
    assert list(summary["problems"]["problem4"]["antennas_in_doubt"]) == [str(first)]
    assert summary["problems"]["problem3"]["ate_m"] < 0.05          # in the frame of the estimate
    told = capsys.readouterr().out.splitlines()
    assert told[-2:] == [f"doubt ({doubt['what']}): {doubt['sentence']}" for doubt in (
        frame, antenna)]


def test_a_clean_drive_has_no_doubts_and_each_doubt_is_told_once(tmp_path, monkeypatch):
    dataset, truth = simulate("short", seed=3)
    dataset = replace(dataset.first(100), uwb=None)
    assert solve_to_folder(dataset, None, tmp_path)["doubts"] == []
    told = Doubt("camera-mirrored", "It is.")
    monkeypatch.setattr("slamlib.summary.doubts_before_solving", lambda *_: (told, told))
    monkeypatch.setattr("slamlib.summary.solutions", lambda dataset, problems: [
        replace(solve.problem_solution(problem, dataset),
                doubts=(Doubt("units", "Miles."), told)) for problem in problems])
    assert [doubt["what"] for doubt in solve_to_folder(
        dataset, None, tmp_path, problems=("problem1", "problem3"))["doubts"]] == [
            "camera-mirrored", "units"]


def test_a_problem_that_fails_costs_the_others_nothing(tmp_path, capsys):
    """Every marker is seen twice at a pose, at two places, and neither is confirmed."""
    dataset, out = simulate("short", seed=3)[0].first(100), tmp_path / "out"
    write_dataset(tmp_path / "drive", replace(dataset, aruco=contradicted(dataset.aruco)))
    assert main(["solve", str(tmp_path / "drive"), "--out", str(out)]) == 3
    problems = json.loads((out / "summary.json").read_text())["problems"]
    failed, = (name for name, row in problems.items() if "failed" in row)
    assert failed == "problem2" and [*problems] == list(solve.PROBLEMS)
    assert {path.name for path in out.glob("problem*")} == problems.keys() - {failed}
    told = capsys.readouterr()
    assert told.err.splitlines()[-1] == (
        f"slamlib: drive: problem2 could not be solved: {problems[failed]['failed']}")
    assert problems[failed]["failed"].startswith("expected sightings")
    assert "problem2       could not be solved" in told.out


def test_what_was_found_and_mended_is_said_first_and_kept_in_the_summary(tmp_path, capsys):
    drive = tmp_path / "drive"
    write_dataset(drive, *simulate("short", 3))
    (drive / "ArucoReading.txt").rename(drive / "ArucoReading.txt.txt")
    (drive / "UwbReading.txt").unlink()
    (drive / "truth" / "ArucoMap.txt").rename(drive / "truth" / "ArucoMap.csv")
    assert main(["solve", str(drive), "--out", str(tmp_path / "out")]) == 0
    *found, first, second = capsys.readouterr().err.splitlines()
    assert found[1].startswith("drive: markers: ") and "sightings of 33 markers" in found[1]
    assert found[2] == "drive: ranges: none, no UwbReading.txt with rows"
    notes = ["ArucoReading.txt.txt was read as ArucoReading.txt.",
             "In truth: ArucoMap.csv was read as ArucoMap.txt."]
    assert [first, second] == [f"drive: note: {note}" for note in notes]
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["notes"] == notes


def test_files_that_are_refused_end_in_one_sentence(tmp_path, capsys):
    (tmp_path / "encoder.txt").write_text("1 0 0\n")
    assert main(["solve", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == (
        f"slamlib: {tmp_path / 'encoderReading.txt'}: expected this file, found none (Not read: "
        "encoder.txt.)\n")
