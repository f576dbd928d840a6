"""The files of results: as MATLAB, spreadsheets and evo read them."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from slamlib.__main__ import main
from slamlib.io import results
from slamlib.studies.simulation import simulate, write_dataset

ABSENT = [np.nan] * 3


def run_octave(script, folder):
    """Run a script in this folder, or skip the test where there is no Octave."""
    octave = shutil.which("octave-cli")
    if octave is None:
        assert not os.environ.get("CI"), "CI must have octave-cli"
        pytest.skip("octave-cli is not installed")
    subprocess.run([octave, "--quiet", "--no-init-file", "--eval", script], cwd=folder, check=True,
                   timeout=300)


@pytest.mark.parametrize("count", [0, 1, 2, 107])
@pytest.mark.parametrize("name, fields, d", [
    ("vehiclePose", ("pose", "covari"), 3), ("ArucoMap", ("pose", "covari", "id"), 3),
    ("UwbMap", ("position", "covariance", "id"), 2)])
def test_structs_have_the_bytes_that_scipy_writes_and_octave_reads(
        tmp_path, count, name, fields, d):
    """Any numbers, NaN and infinity among them, and large ids."""
    rng = np.random.default_rng(0)
    poses, covariances = rng.standard_normal((count, d)), rng.standard_normal((count, d, d))
    poses[3:4], covariances[5:, 0, 1] = np.nan, np.inf
    ids = np.arange(1, count + 1) + (10**12 if "id" in fields else 0)
    results.write_structs(tmp_path, name, ids, poses, covariances)
    structs = np.empty((1, count), dtype=[(field, object) for field in fields])
    for k, numbers in enumerate(zip(poses[:, None], covariances, ids.astype(float))):
        structs[0, k] = numbers[:len(fields)]
    buffer = BytesIO()
    savemat(buffer, {name: structs})
    assert (tmp_path / f"{name}.mat").read_bytes()[116:] == buffer.getvalue()[116:]    # no date
    for got, expected in zip(results.read_structs(tmp_path, name), (ids, poses, covariances)):
        np.testing.assert_array_equal(got, expected)
    if count == 107:
        own_ids = f"[{name}.id]" if "id" in fields else f"(1:{count})"
        run_octave(f"load('{name}.mat'); i = {own_ids}; p = vertcat({name}.{fields[0]});"
                   f"c = {name}(2).{fields[1]}; save('-v7', 'again.mat', 'i', 'p', 'c');", tmp_path)
        again = loadmat(tmp_path / "again.mat")
        for key, expected in (("i", [ids]), ("p", poses), ("c", covariances[1])):
            np.testing.assert_array_equal(again[key], expected)


def test_text_keeps_every_digit_of_the_poses_that_are_known(tmp_path):
    """CSV names its columns; TUM has pose ids and unit quaternions."""
    poses = np.array([[1.0, 2.0, 0.1], ABSENT, [1 / 3, -1e-9, 7.0]])
    results.write_tum(tmp_path / "a" / "b.tum", poses)
    rows = np.loadtxt(tmp_path / "a" / "b.tum")
    np.testing.assert_array_equal(rows[:, :6], [[1, 1, 2, 0, 0, 0], [3, 1 / 3, -1e-9, 0, 0, 0]])
    np.testing.assert_allclose(np.hypot(rows[:, 6], rows[:, 7]), 1, atol=1e-15)
    np.testing.assert_allclose(2 * np.arctan2(rows[:, 6], rows[:, 7]) - poses[[0, 2], 2],
                               [0, -4 * np.pi], atol=1e-12)
    C = np.array([[[1 / 7, 2, 3], [2, 4, 5], [3, 5, 6]]] * 3)
    for d, header, row in (
            (3, "id,x,y,theta,s_xx,s_xy,s_xtheta,s_yy,s_ytheta,s_thetatheta",
             [9, 1 / 3, -1e-9, 7, 1 / 7, 2, 3, 4, 5, 6]),
            (2, "id,x,y,s_xx,s_xy,s_yy", [9, 1 / 3, -1e-9, 1 / 7, 2, 4])):
        results.write_csv(tmp_path / "a.csv", np.array([7, 8, 9]), poses[:, :d], C[:, :d, :d])
        first, *_, last = (tmp_path / "a.csv").read_text().splitlines()
        assert first == header and [*map(float, last.split(","))] == row


def test_evo_finds_the_errors_of_the_summary_in_what_solve_writes_as_text(tmp_path):
    """By evo's own command line, as it is and aligned; problem 2 has a tenth of the poses."""
    dataset, truth = simulate("short", 3)
    write_dataset(tmp_path / "drive", dataset.first(300), replace(truth, poses=truth.poses[:300]))
    out = tmp_path / "out"
    assert main(["solve", str(tmp_path / "drive"), "--out", str(out), "--csv"]) == 0
    rows = json.loads((out / "summary.json").read_text())["problems"]
    for problem in ("problem2", "problem4"):
        for options, key in (([], "ate_m"), (["--align"], "ate_aligned_m")):
            told = subprocess.run(
                [Path(sys.executable).with_name("evo_ape"), "tum", "truth.tum", f"{problem}.tum",
                 *options], cwd=out, text=True, capture_output=True, timeout=300,
                env={"HOME": str(tmp_path), "PATH": "", "MPLBACKEND": "agg"})
            assert told.returncode == 0, told.stderr
            found, = (float(line.split()[1]) for line in told.stdout.splitlines()
                      if line.split()[:1] == ["rmse"])
            assert np.isclose(found, rows[problem][key], rtol=0, atol=1e-6)  # evo: six digits
