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
                   timeout=300)


@pytest.mark.parametrize("name, fields, d", [
    ("vehiclePose", ("pose", "covari"), 3), ("ArucoMap", ("pose", "covari", "id"), 3),
    ("UwbMap", ("position", "covariance", "id"), 2)])
def test_structs_through_scipy_and_octave(tmp_path, name, fields, d):
    """A pose without an estimate is NaN, and an id may be large."""
    poses, covariances = example(4)
    poses[2], covariances[2] = np.nan, np.nan
    content = np.array([4, 17, 18, 10**12]), poses[:, :d], covariances[:, :d, :d]
    folder = tmp_path / "new" / "folder"
    if name == "vehiclePose":
        content = np.arange(1, 5), poses, covariances
        results.write_vehicle_poses(folder, poses, covariances)
        np.testing.assert_array_equal(results.read_vehicle_poses(folder)[0], poses)
    else:
        results.write_map(folder, name, *content)
    structs = loadmat(folder / f"{name}.mat")[name]
    assert structs.shape == (1, 4) and structs.dtype.names == fields
    shapes = [structs[0, 1][field].shape for field in fields]
    assert shapes == [(1, d), (d, d), (1, 1)][:len(fields)]
    for got, expected in zip(results.read_structs(folder, name), content, strict=True):
        np.testing.assert_array_equal(got, expected)
    ids = f"[{name}.id]" if "id" in fields else "1:4"
    run_octave(f"load('{name}.mat'); i = {ids}; p = vertcat({name}.{fields[0]});"
               f"c = {name}(2).{fields[1]}; save('-v7', 'again.mat', 'i', 'p', 'c');", folder)
    again = loadmat(folder / "again.mat")
    for key, expected in (("i", [content[0]]), ("p", content[1]), ("c", content[2][1])):
        np.testing.assert_array_equal(again[key], expected)


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
