import os
import shutil
import subprocess

import numpy as np
import pytest
from scipy.io import loadmat

from slamlib import results


def example(n=5):
    rng = np.random.default_rng(0)
    A = rng.standard_normal((n, 3, 3))
    return rng.standard_normal((n, 3)), A @ np.swapaxes(A, 1, 2)


def run_octave(script, folder):
    """Run a script in this folder, or skip the test where there is no Octave."""
    octave = shutil.which("octave-cli")
    if octave is None:
        assert not os.environ.get("CI"), "CI must have octave-cli"
        pytest.skip("octave-cli is not installed")
    subprocess.run([octave, "--quiet", "--no-init-file", "--eval", script], cwd=folder, check=True,
                   timeout=120)


def test_round_trip_through_scipy(tmp_path):
    poses, covariances = example()
    poses[2], covariances[2] = np.nan, np.nan                                  # no estimate
    results.write_vehicle_poses(tmp_path / "new" / "problem1", poses, covariances)
    structs = loadmat(tmp_path / "new" / "problem1" / "vehiclePose.mat")["vehiclePose"]
    assert structs.shape == (1, 5) and structs.dtype.names == ("pose", "covari")
    assert structs[0, 0]["pose"].shape == (1, 3) and structs[0, 0]["covari"].shape == (3, 3)
    np.testing.assert_array_equal(structs[0, 3]["pose"][0], poses[3])
    again = results.read_vehicle_poses(tmp_path / "new" / "problem1")
    np.testing.assert_array_equal(again[0], poses)
    np.testing.assert_array_equal(again[1], covariances)


def test_round_trip_through_octave(tmp_path):
    poses, covariances = example(400)
    results.write_vehicle_poses(tmp_path, poses, covariances)
    script = ("load('vehiclePose.mat'); p = vertcat(vehiclePose.pose); c = vehiclePose(7).covari;"
              "s = size(vehiclePose); save('-v7', 'again.mat', 'p', 'c', 's');")
    run_octave(script, tmp_path)
    again = loadmat(tmp_path / "again.mat")
    np.testing.assert_array_equal(again["s"], [[1, 400]])
    np.testing.assert_array_equal(again["p"], poses)
    np.testing.assert_array_equal(again["c"], covariances[6])


def test_aruco_map_through_scipy_and_octave(tmp_path):
    poses, covariances = example(3)
    ids = np.array([4, 17, 10**12])
    results.write_aruco_map(tmp_path, ids, poses, covariances)
    structs = loadmat(tmp_path / "ArucoMap.mat")["ArucoMap"]
    assert structs.shape == (1, 3) and structs.dtype.names == ("pose", "covari", "id")
    assert structs[0, 1]["pose"].shape == (1, 3) and structs[0, 1]["id"] == [[17]]
    again = results.read_aruco_map(tmp_path)
    for got, expected in zip(again, (ids, poses, covariances), strict=True):
        np.testing.assert_array_equal(got, expected)
    run_octave("load('ArucoMap.mat'); i = [ArucoMap.id]; save('-v7', 'again.mat', 'i');", tmp_path)
    np.testing.assert_array_equal(loadmat(tmp_path / "again.mat")["i"], [ids])


def test_uwb_map_through_scipy_and_octave(tmp_path):
    positions, covariances = example(3)[0][:, :2], example(3)[1][:, :2, :2]
    ids = np.array([4, 17, 51])
    results.write_uwb_map(tmp_path, ids, positions, covariances)
    structs = loadmat(tmp_path / "UwbMap.mat")["UwbMap"]
    assert structs.shape == (1, 3) and structs.dtype.names == ("position", "covariance", "id")
    assert structs[0, 1]["position"].shape == (1, 2)
    assert structs[0, 1]["covariance"].shape == (2, 2)
    again = results.read_uwb_map(tmp_path)
    for got, expected in zip(again, (ids, positions, covariances), strict=True):
        np.testing.assert_array_equal(got, expected)
    run_octave("load('UwbMap.mat'); p = vertcat(UwbMap.position); save('-v7', 'again.mat', 'p');",
               tmp_path)
    np.testing.assert_array_equal(loadmat(tmp_path / "again.mat")["p"], positions)


def test_an_empty_map(tmp_path):
    poses, covariances = example(1)
    results.write_aruco_map(tmp_path, np.zeros(0, int), poses[:0], covariances[:0])
    assert loadmat(tmp_path / "ArucoMap.mat")["ArucoMap"].size == 0
    ids, poses, covariances = results.read_aruco_map(tmp_path)
    assert (ids.shape, poses.shape, covariances.shape) == ((0,), (0, 3), (0, 3, 3))


def test_a_single_pose_and_equal_bytes(tmp_path):
    poses, covariances = example(1)
    for name in ("a", "b"):
        results.write_vehicle_poses(tmp_path / name, poses, covariances)
    first, second = ((tmp_path / name / "vehiclePose.mat").read_bytes() for name in ("a", "b"))
    assert first == second
    np.testing.assert_array_equal(results.read_vehicle_poses(tmp_path / "a")[1], covariances)


def test_a_failing_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    results.write_vehicle_poses(tmp_path, *example())
    before = (tmp_path / "vehiclePose.mat").read_bytes()

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        results.write_vehicle_poses(tmp_path, *example(9))
    assert [f.name for f in tmp_path.iterdir()] == ["vehiclePose.mat"]
    assert (tmp_path / "vehiclePose.mat").read_bytes() == before


def test_many_structs_have_the_bytes_that_scipy_writes():
    """Any numbers, NaN and infinity among them, for vectors, matrices and scalars."""
    rng = np.random.default_rng(0)
    n = results.MAX_STRUCTS_BY_SCIPY + 7
    rows = {"pose": rng.normal(size=(n, 1, 3)), "covari": rng.normal(size=(n, 3, 3)),
            "id": np.arange(n, dtype=float)[:, None, None]}
    rows["pose"][3], rows["covari"][5, 1, 2] = np.nan, np.inf
    expected, found = results._saved("ArucoMap", rows), results._tiled("ArucoMap", rows)
    assert found[116:] == expected[116:]                     # the first bytes contain the date
