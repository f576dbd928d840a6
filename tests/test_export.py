"""Trajectories for other programs: what evo reads is what was estimated."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slamlib.__main__ import main
from slamlib.export import write_csv, write_tum
from slamlib.results import read_structs, write_vehicle_poses
from slamlib.simulation import simulate, write_dataset

ABSENT = [np.nan] * 3


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """A folder with a dataset `drive` with its truth, and its results in `out`."""
    folder = tmp_path_factory.mktemp("solved")
    dataset, truth = simulate("short", 3)
    write_dataset(folder / "drive", dataset.first(300), replace(truth, poses=truth.poses[:300]))
    assert main(["solve", str(folder / "drive"), "--out", str(folder / "out")]) == 0
    return folder


def test_a_tum_file_has_pose_numbers_and_unit_quaternions_of_the_poses_that_are_known(tmp_path):
    poses = np.array([[1.0, 2.0, 0.1], ABSENT, [1 / 3, -1e-9, 7.0]])
    write_tum(tmp_path / "a" / "b.tum", poses)
    rows = np.loadtxt(tmp_path / "a" / "b.tum")
    np.testing.assert_array_equal(rows[:, 0], [1, 3])
    np.testing.assert_array_equal(rows[:, 1:3], poses[[0, 2], :2])
    np.testing.assert_array_equal(rows[:, 3:6], 0)
    np.testing.assert_allclose(np.hypot(rows[:, 6], rows[:, 7]), 1, atol=1e-15)
    np.testing.assert_allclose(2 * np.arctan2(rows[:, 6], rows[:, 7]) - poses[[0, 2], 2],
                               [0, -4 * np.pi], atol=1e-12)


def test_comma_separated_values_name_their_columns_and_keep_every_digit(tmp_path):
    poses = np.array([[1 / 3, 2.0, 0.1], ABSENT])
    C = np.array([[[1 / 7, 2, 3], [2, 4, 5], [3, 5, 6]], np.full((3, 3), np.nan)])
    write_csv(tmp_path / "a.csv", np.array([7, 8]), poses, C)
    header, row = (tmp_path / "a.csv").read_text().splitlines()
    assert header == "id,x,y,theta,s_xx,s_xy,s_xtheta,s_yy,s_ytheta,s_thetatheta"
    assert [*map(float, row.split(","))] == [7, 1 / 3, 2, 0.1, 1 / 7, 2, 3, 4, 5, 6]
    write_csv(tmp_path / "a.csv", np.array([7, 8]), poses[:, :2], C[:, :2, :2])
    assert (tmp_path / "a.csv").read_text() == \
        f"id,x,y,s_xx,s_xy,s_yy\n7,{1 / 3:.17g},2,{1 / 7:.17g},2,4\n"


def test_every_problem_of_a_folder_is_exported_one_alone_and_the_truth(solved, tmp_path, capsys):
    for kind in ("tum", "csv"):
        for source in (solved / "out", solved / "out" / "problem3", solved / "drive" / "truth"):
            assert main(["export", str(source), "--format", kind, "--out", str(tmp_path)]) == 0
    told = {Path(line).relative_to(tmp_path).as_posix()
            for line in capsys.readouterr().out.splitlines()}
    assert told == {path.relative_to(tmp_path).as_posix()
                    for path in tmp_path.rglob("*") if path.is_file()}
    files = [path.relative_to(solved / "out").with_suffix("").as_posix()
             for path in (solved / "out").rglob("*.mat")]
    names = {"truth", *(name.split("/")[0] for name in files)}
    assert len(names) == 7 and told == {f"{name}.tum" for name in names} | {
        f"{name}.csv" for name in (*files, "truth/vehiclePose", "truth/ArucoMap", "truth/UwbMap")}
    for name in ("problem2/vehiclePose", "problem2/ArucoMap", "problem4/UwbMap"):
        ids, places, covariances = read_structs((solved / "out" / name).parent, Path(name).name)
        known = np.isfinite(places[:, 0])
        rows = np.loadtxt(tmp_path / f"{name}.csv", delimiter=",", skiprows=1)
        d = places.shape[1]
        np.testing.assert_array_equal(rows[:, 0], ids[known])
        np.testing.assert_array_equal(rows[:, 1:1 + d], places[known])
        np.testing.assert_array_equal(rows[:, 1 + d:], covariances[known][:, *np.triu_indices(d)])


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["problem2", "problem4"])
def test_evo_finds_the_errors_of_the_summary(solved, tmp_path, problem):
    """By evo's own command line, as it is and aligned; problem 2 has a tenth of the poses."""
    for source in (solved / "out" / problem, solved / "drive" / "truth"):
        assert main(["export", str(source), "--out", str(tmp_path)]) == 0
    row = json.loads((solved / "out" / "summary.json").read_text())["problems"][problem]
    assert row["world_is_pose"] == 1
    for options, key in (([], "ate_m"), (["--align"], "ate_aligned_m")):
        told = subprocess.run(
            [Path(sys.executable).with_name("evo_ape"), "tum", "truth.tum", f"{problem}.tum",
             *options], cwd=tmp_path, text=True, capture_output=True, timeout=300,
            env={"HOME": str(tmp_path), "PATH": "", "MPLBACKEND": "agg"})
        assert told.returncode == 0, told.stderr
        found, = (float(line.split()[1]) for line in told.stdout.splitlines()
                  if line.split()[:1] == ["rmse"])
        assert np.isclose(found, row[key], rtol=0, atol=1e-6)      # evo prints six digits


@pytest.mark.parametrize("make, said", [
    (lambda folder: None, "expected a folder with vehiclePose.mat"),
    (lambda folder: folder.mkdir(), "expected a folder with vehiclePose.mat"),
    (lambda folder: (folder / "problem3").mkdir(parents=True), "with sub-folders that have one"),
    (lambda folder: (write_vehicle_poses(folder, np.zeros((2, 3)), np.zeros((2, 3, 3))),
                     (folder / "vehiclePose.mat").write_bytes(b"no MATLAB file")),
     "expected .mat files as slamlib writes them")])
def test_a_folder_without_poses_that_can_be_read_is_one_sentence(tmp_path, capsys, make, said):
    make(tmp_path / "results")
    assert main(["export", str(tmp_path / "results"), "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"slamlib: {tmp_path / 'results'}") and told.count("\n") == 1
    assert said in told and not (tmp_path / "out").exists()
    (tmp_path / "truth").mkdir()
    assert main(["export", str(tmp_path / "truth"), "--out", str(tmp_path / "out")]) == 2
    assert "encoderReading.txt: expected this file, found none" in capsys.readouterr().err
