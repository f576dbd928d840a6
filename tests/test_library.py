"""As a library: what is of another type is told, and one setting of kernel and gate."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numeric import known_noise

from slamlib import estimate, fuse, fuse_increments, localize
from slamlib.core.errors import DatasetError
from slamlib.core.kernels import KERNELS
from slamlib.io.dataset import read_dataset
from slamlib.studies.simulation import simulate, write_dataset

SIGMA, COVARIANCE = gtsam.noiseModel.Isotropic.Sigma, gtsam.noiseModel.Gaussian.Covariance


@pytest.fixture(scope="module")
def drive():
    return simulate("short", seed=3)


@pytest.mark.parametrize("function", [
    fuse, fuse_increments, localize])
def test_what_is_of_another_type_is_told(function):
    """`estimate`'s arguments are in test_slam."""
    with pytest.raises(DatasetError, match=f"{function.__name__}: expected a.*, found 'drive'"):
        function("drive")


def test_a_result_is_shown_in_five_lines(drive):
    found = estimate(known_noise(drive[0].first(100), 1e-3))
    lines = repr(found).splitlines()
    assert len(lines) == 5 and max(map(len, lines)) < 100
    assert lines[0].startswith("SlamResult of 100 poses, mean sigma ")
    assert lines[2] == f"  4 antennas, {len(found.doubts)} in doubt, 20 ranges"
    assert lines[4] == "  released from vehicle.toml: nothing"


# Kernel and gate.


def test_the_library_heeds_kernel_and_gate_of_vehicle_toml(tmp_path):
    """As it heeds the options of `estimate`."""
    dataset, truth = simulate("short", seed=4, late_ranges=0.05)
    write_dataset(tmp_path / "drive", known_noise(dataset.first(400), 1e-3),
                  replace(truth, poses=truth.poses[:400]))
    plain = read_dataset(tmp_path / "drive")
    with open(tmp_path / "drive" / "vehicle.toml", "a") as file:
        file.write('kernel = "Huber"\ngate = false\n')
    stated = read_dataset(tmp_path / "drive")
    found, same, default, again = (estimate(data, **options) for data, options in (
        (stated, {}), (plain, {"kernel": "Huber", "gate": False}), (plain, {}),
        (stated, {"kernel": "asymmetric Tukey", "gate": True})))
    np.testing.assert_array_equal(found.poses, same.poses)
    np.testing.assert_array_equal(again.poses, default.poses)
    assert (found.range_weight > 0).all() and not (default.range_weight > 0).all()
    assert found.fit.problem.accepted.sightings.kernel is KERNELS["Huber"]
