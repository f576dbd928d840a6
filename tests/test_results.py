import errno
import os
import shutil
import subprocess
from io import BytesIO

import numpy as np
import pytest
from scipy.io import loadmat, savemat

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


@pytest.mark.parametrize("name, fields, d", [
    ("ArucoMap", ("pose", "covari", "id"), 3), ("UwbMap", ("position", "covariance", "id"), 2)])
def test_maps_through_scipy_and_octave(tmp_path, name, fields, d):
    poses, covariances = example(3)
    content = np.array([4, 17, 10**12]), poses[:, :d], covariances[:, :d, :d]
    results.write_map(tmp_path, name, *content)
    structs = loadmat(tmp_path / f"{name}.mat")[name]
    assert structs.shape == (1, 3) and structs.dtype.names == fields
    assert [structs[0, 1][field].shape for field in fields] == [(1, d), (d, d), (1, 1)]
    for got, expected in zip(results.read_structs(tmp_path, name), content, strict=True):
        np.testing.assert_array_equal(got, expected)
    run_octave(f"load('{name}.mat'); i = [{name}.id]; p = vertcat({name}.{fields[0]});"
               "save('-v7', 'again.mat', 'i', 'p');", tmp_path)
    again = loadmat(tmp_path / "again.mat")
    np.testing.assert_array_equal(again["i"], [content[0]])
    np.testing.assert_array_equal(again["p"], content[1])


def test_a_failing_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    results.write_vehicle_poses(tmp_path, *example())
    before = (tmp_path / "vehiclePose.mat").read_bytes()

    def fail(*_):
        raise OSError(errno.ENOSPC, "disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        results.write_vehicle_poses(tmp_path, *example(9))
    assert [f.name for f in tmp_path.iterdir()] == ["vehiclePose.mat"]
    assert (tmp_path / "vehiclePose.mat").read_bytes() == before


@pytest.mark.parametrize("count", [0, 1, 2, 107])
def test_structs_have_the_bytes_that_scipy_writes_and_are_read_again(tmp_path, count):
    """Any numbers, NaN and infinity among them, for vectors, matrices and scalars."""
    ids, (poses, covariances) = np.arange(count), example(count)
    poses[3:4], covariances[5:, 1, 2] = np.nan, np.inf
    results.write_map(tmp_path, "ArucoMap", ids, poses, covariances)
    structs = np.empty((1, count), dtype=[(name, object) for name in ("pose", "covari", "id")])
    for row, numbers in zip(structs[0], zip(poses[:, None], covariances, ids.astype(float))):
        row["pose"], row["covari"], row["id"] = numbers
    buffer = BytesIO()
    savemat(buffer, {"ArucoMap": structs})
    assert (tmp_path / "ArucoMap.mat").read_bytes()[116:] == buffer.getvalue()[116:]   # no date
    for got, expected in zip(results.read_structs(tmp_path, "ArucoMap"), (ids, poses, covariances)):
        np.testing.assert_array_equal(got, expected)
