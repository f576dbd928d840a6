"""As a library: what is of another type is told, and one setting of kernel and gate."""

import numpy as np
import pytest
from numeric import known_noise

from slamlib import estimate, fuse, fuse_increments, localize
from slamlib.core.errors import DatasetError
from slamlib.io.dataset import read_dataset
from slamlib.studies.simulation import simulate, write_dataset


@pytest.fixture(scope="module")
def drive():
    return simulate("short", seed=3)


@pytest.mark.parametrize("function", [
    fuse, fuse_increments, localize])
def test_what_is_of_another_type_is_told(function):
    """`estimate`'s arguments are in test_slam."""
    with pytest.raises(DatasetError, match=f"{function.__name__}: expected a.*, found 'drive'"):
        function("drive")


def test_a_result_is_shown_in_few_lines(drive):
    found = estimate(known_noise(drive[0].first(100), 1e-3))
    lines = repr(found).splitlines()
    assert len(lines) == 5 and lines[0].startswith("SlamResult of 100 poses, mean sigma ")


# Kernel and gate.


def test_the_library_heeds_kernel_and_gate_of_vehicle_toml(tmp_path):
    """As it heeds the options of `estimate`."""
    dataset, _ = simulate("short", seed=4, late_ranges=0.05)
    write_dataset(tmp_path / "drive", known_noise(dataset.first(400), 1e-3))
    plain = read_dataset(tmp_path / "drive")
    with open(tmp_path / "drive" / "vehicle.toml", "a") as file:
        file.write('kernel = "Huber"\ngate = false\n')
    stated = read_dataset(tmp_path / "drive")
    found = estimate(stated)
    default = estimate(plain)
    np.testing.assert_array_equal(
        found.poses, estimate(plain, kernel="Huber", gate=False).poses)
    np.testing.assert_array_equal(
        default.poses, estimate(stated, kernel="asymmetric Tukey", gate=True).poses)
    assert (found.range_weight > 0).all() and not (default.range_weight > 0).all()
