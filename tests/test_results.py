"""The files of results: as MATLAB, spreadsheets and evo read them."""

import errno
import os
import re
import shutil
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from joblib import parallel_config
from numeric import seen_from, short, vehicle
from numpy.testing import assert_allclose, assert_array_equal
from scipy.io import loadmat, savemat

from slamlib import estimate, read_dataset, solve
from slamlib.__main__ import main
from slamlib.core import evaluation
from slamlib.core.errors import DatasetError
from slamlib.io import results
from slamlib.notebook import Drive
from slamlib.report import build
from slamlib.studies.simulation import write_dataset


def run_octave(script, folder):
    """Run a script in this folder, or skip the test where there is no Octave."""
    octave = shutil.which("octave-cli")
    if octave is None:
        assert not os.environ.get("CI"), "CI must have octave-cli"
        pytest.skip("octave-cli is not installed")
    subprocess.run([octave, "--quiet", "--no-init-file", "--eval", script], cwd=folder, check=True,
                   timeout=300)


@pytest.mark.parametrize("name, fields, d", [
    ("vehiclePose", ("pose", "covari"), 3), ("ArucoMap", ("pose", "covari", "id"), 3),
    ("UwbMap", ("position", "covariance", "id"), 2)])
@pytest.mark.parametrize("count", [1, 107])
def test_structs_have_the_bytes_that_scipy_writes_and_octave_reads(
        tmp_path, count, name, fields, d):
    """Any numbers, NaN and infinity among them, and large ids."""
    rng = np.random.default_rng(0)
    poses = rng.standard_normal((count, d))
    covariances = rng.standard_normal((count, d, d))
    poses[3:4] = np.nan
    covariances[5:, 0, 1] = np.inf
    ids = np.arange(1, count + 1) + (10**12 if "id" in fields else 0)
    results.write_structs(tmp_path, name, ids, poses, covariances)
    structs = np.empty((1, count), dtype=[(field, object) for field in fields])
    for k, numbers in enumerate(zip(poses[:, None], covariances, ids.astype(float))):
        structs[0, k] = numbers[:len(fields)]
    buffer = BytesIO()
    savemat(buffer, {name: structs})
    assert (tmp_path / f"{name}.mat").read_bytes()[116:] == buffer.getvalue()[116:]    # no date
    for got, expected in zip(results.read_structs(tmp_path, name), (ids, poses, covariances)):
        assert_array_equal(got, expected)
    if count == 107:
        run_octave(f"load('{name}.mat'); p = vertcat({name}.{fields[0]});"
                   f"c = {name}(2).{fields[1]}; save('-v7', 'again.mat', 'p', 'c');", tmp_path)
        again = loadmat(tmp_path / "again.mat")
        assert_array_equal(again["p"], poses)
        assert_array_equal(again["c"], covariances[1])


POSES = np.array([[1.0, 2.0, 0.1], [np.nan] * 3, [1 / 3, -1e-9, 7.0]])


def test_tum_files_keep_every_digit_of_the_poses_that_are_known(tmp_path):
    """With pose ids and unit quaternions."""
    results.write_tum(tmp_path / "a" / "b.tum", POSES)
    rows = np.loadtxt(tmp_path / "a" / "b.tum")
    assert_array_equal(rows[:, :6], [[1, 1, 2, 0, 0, 0], [3, 1 / 3, -1e-9, 0, 0, 0]])
    half = POSES[[0, 2], 2] / 2
    assert_allclose(rows[:, 6], np.sin(half), atol=1e-15)
    assert_allclose(rows[:, 7], np.cos(half), atol=1e-15)


@pytest.mark.parametrize("problem, options, key", [
    ("problem4", [], "ate_m"), ("problem2", ["--align"], "ate_aligned_m")])
def test_evo_finds_the_errors_of_the_summary_in_tum_files(tmp_path, drive, problem, options, key):
    """By evo's own command line, as it is and aligned; problem 2 has a tenth of the poses."""
    solve.solve_to_folder(*drive, tmp_path, [problem])
    _, poses, _ = results.read_structs(tmp_path / problem, "vehiclePose")
    results.write_tum(tmp_path / f"{problem}.tum", poses)
    results.write_tum(tmp_path / "truth.tum", drive[1].poses)
    told = subprocess.run(
        [Path(sys.executable).with_name("evo_ape"), "tum", "truth.tum", f"{problem}.tum",
         *options], cwd=tmp_path, check=True, text=True, stdout=subprocess.PIPE, timeout=300,
        env={"HOME": str(tmp_path), "PATH": "", "MPLBACKEND": "agg"}).stdout
    found = re.search(r"rmse\s+(\S+)", told)[1]
    row = results.read_summary(tmp_path)["problems"][problem]
    assert float(found) == pytest.approx(row[key], abs=1e-6)                    # six digits


@pytest.fixture(scope="module")
def drive():
    """A simulated drive of 100 poses, and its truth."""
    return short(3, 100)


def test_problems_that_are_written_one_by_one_have_one_summary(tmp_path, drive):
    dataset, truth = drive
    lost = DatasetError(f"{dataset.name}: expected more")
    for problem, found in (("problem3", estimate(dataset.without("uwb"))), ("problem2", lost),
                           ("problem1", solve.find("problem1", dataset))):
        solve.write_results(tmp_path, problem, found, dataset, truth)
    problems = results.read_summary(tmp_path)["problems"]
    assert [*problems] == ["problem1", "problem2", "problem3"]
    assert problems["problem2"]["failed"] == "expected more"
    together = tmp_path / "all"
    expected = solve.solve_to_folder(dataset, truth, together)["problems"]["problem3"]
    expected.pop("seconds")
    assert problems["problem3"] == expected
    for name in ("problem3/vehiclePose.mat", "problem3/ArucoMap.mat"):
        assert (tmp_path / name).read_bytes() == (together / name).read_bytes()


def test_a_fusion_that_contradicts_problem_3_is_doubted_however_problems_are_written(tmp_path):
    """Both wheels are stated 10 % too small, which problem 3 finds, and the fusion does not."""
    dataset, _ = short(1, 1400)
    for ticks, expected in ((8000, 0), (8800, 1)):
        drive = vehicle(ticks_per_revolution=ticks)(dataset)
        problems = "problem2_fused", "problem3"
        solve.solve_to_folder(drive, None, tmp_path / "at once", problems)
        for problem in problems:                     # as chapters of a report do, each by itself
            found = solve.find(problem, drive)
            solve.write_results(tmp_path / "one by one", problem, found, drive)
            solve.write_results(tmp_path / problem / drive.name, problem, found, drive)
        shown = Drive(drive.name, drive, None)
        build._write_results(shown, [tmp_path / each for each in problems], tmp_path / "report")
        for folder in ("at once", "one by one", "report"):
            doubts = results.read_summary(tmp_path / folder)["doubts"]
            assert sum(doubt["what"] == "fusion" for doubt in doubts) == expected


def test_what_a_killed_run_left_is_removed_by_the_next_problem_that_is_written(tmp_path, drive):
    solve.solve_to_folder(drive[0], None, tmp_path)
    (tmp_path / "summary.json").unlink()
    with pytest.raises(DatasetError, match="summary.json: .* solve the dataset again"):
        results.read_summary(tmp_path)
    solve.write_results(tmp_path, "problem1", solve.find("problem1", drive[0]), drive[0])
    assert [path.parent.name for path in tmp_path.rglob("*.mat")] == ["problem1"]


def test_results_of_a_problem_are_not_written_among_the_files_of_a_drive(tmp_path, drive):
    """They would replace its vehicle.toml."""
    folder = tmp_path / "logs"
    write_dataset(folder, *drive)
    before = sorted(folder.rglob("*"))
    with pytest.raises(DatasetError, match="another folder for the results"):
        solve.write_results(folder, "problem1", solve.find("problem1", drive[0]), drive[0])
    assert sorted(folder.rglob("*")) == before


def test_a_file_that_cannot_be_written_is_named_and_costs_no_earlier_file(
        tmp_path, drive, monkeypatch):
    """As on a full disk. Without summary.json the folder counts as unfinished."""
    solve.solve_to_folder(drive[0], None, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.mat")}

    def on_a_full_disk(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", on_a_full_disk)
    with pytest.raises(DatasetError, match="problem1/vehiclePose.mat: expected .*No space left"):
        solve.solve_to_folder(drive[0], None, tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.mat")} == before
    assert not [*tmp_path.rglob("*.part"), *tmp_path.rglob("summary.json")]


def test_the_vehicle_as_estimated_can_be_taken_over(tmp_path):
    """The camera is 10 cm ahead, and the file says 0."""
    dataset = seen_from(short(3)[0].without("uwb"), (0.1, 0.0, 0.0))
    write_dataset(tmp_path / "drive", dataset)
    dataset = read_dataset(tmp_path / "drive")
    solve.solve_to_folder(dataset, None, tmp_path, ["problem3"])
    (tmp_path / "vehicle.toml").rename(tmp_path / "drive" / "vehicle.toml")
    taken = read_dataset(tmp_path / "drive").vehicle
    row = results.read_summary(tmp_path)["problems"]["problem3"]
    camera, = (entry for entry in row["calibration"] if entry["name"] == "camera_x")
    assert 0 < abs(taken.camera_x - camera["estimate"]) < 0.01 * camera["sigma"]
    assert taken.sigma_camera_x == pytest.approx(camera["sigma"], rel=0.01)
    assert taken.slip == pytest.approx(row["slip_sqrt_m"], rel=1e-3)
    assert (taken.wheelbase, taken.range_noise_factor) == (0.4, None)


def test_several_drives_have_a_table_and_one_that_fails_does_not_stop_them(
        tmp_path, drive, capfd):
    for name, truth in (("with truth", drive[1]), ("without", None)):
        write_dataset(tmp_path / name, drive[0], truth)
    (tmp_path / "README.md").write_text("on the data")
    folders = [str(tmp_path / name) for name in ("README.md", "with truth", "nowhere", "without")]
    out = tmp_path / "out"
    results.write_summary(out / "nowhere", {"of": "earlier data"})
    assert main(["solve", *folders, "--out", str(out), "-j", "2", "--problem", "3"]) == 2
    told = capfd.readouterr()
    assert "nowhere: expected a folder that can be read" in told.err
    assert told.out.count("problem3") == 2 and "NA>" not in told.out
    table = pd.read_csv(out / "drives.csv").set_index("dataset")
    assert [*table.index] == ["with truth", "nowhere", "without"]
    row = results.read_summary(out / "with truth")["problems"]["problem3"]
    assert table.ate_m["with truth"] == row["ate_m"] and np.isnan(table.ate_m["without"])
    covariances = results.read_structs(out / "without" / "problem3", "vehiclePose")[2]
    assert table.last_sigma_m["without"] == evaluation.position_sigmas(covariances[-1:])
    assert table.failed.notna().tolist() == [False, True, False]
    assert not [*(out / "nowhere").iterdir()]


@pytest.mark.slow
def test_drives_are_solved_on_a_local_dask_cluster(tmp_path, drive):
    """As docs/use.md shows it; the table is that of one process."""
    distributed = pytest.importorskip("distributed")
    folders = [tmp_path / name for name in ("a", "b", "c")]
    for count, folder in enumerate(folders, start=1):
        write_dataset(folder, drive[0].first(30 * count), None)

    def table(out):
        solve.solve_folders(map(str, folders), out, problems=["problem3"])
        return pd.read_csv(out / "drives.csv").drop(columns="seconds")

    with (distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
          as cluster, distributed.Client(cluster), parallel_config(backend="dask")):
        found = table(tmp_path / "out")
    assert found.failed.isna().all()
    pd.testing.assert_frame_equal(found, table(tmp_path / "here"), check_exact=True)
