import numpy as np
import pytest
from conftest import ROOT
from kills import contents
from numeric import short
from numpy.testing import assert_allclose, assert_array_equal

from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import read_dataset, read_truth
from slamlib.studies.simulation import confuse_labels, simulate, write_dataset

DATA = ROOT / "data"
RECIPES = {"short": dict(path="short", seed=1),
           "long": dict(path="long", seed=2, late_ranges=0.05, mislabelled=0.005)}


@pytest.mark.parametrize("name", RECIPES)
def test_committed_stand_ins_are_regenerated_to_the_byte(name, tmp_path):
    if not (DATA / name / "truth").exists():
        pytest.skip(f"data/{name} has no truth: it has been replaced by a real log")
    write_dataset(tmp_path / name, *simulate(**RECIPES[name]))
    made = contents(tmp_path / name)
    committed = contents(DATA / name)
    assert made.keys() == committed.keys()
    assert [file for file in made if made[file] != committed[file]] == []


def test_files_round_trip_through_the_reader(tmp_path):
    vehicle = Vehicle(right_radius=0.12, ticks_per_revolution=4096.0)
    dataset, truth = short(9, vehicle=vehicle)
    write_dataset(tmp_path / "drive", dataset, truth)
    again, true_again = read_dataset(tmp_path / "drive"), read_truth(tmp_path / "drive")
    assert again.vehicle == vehicle and true_again.vehicle == truth.vehicle
    assert_array_equal(again.ticks, dataset.ticks)
    for sensor in ("aruco", "uwb", "antenna_guess"):
        found = vars(getattr(again, sensor))
        for name, written in vars(getattr(dataset, sensor)).items():
            assert_allclose(found[name], written, rtol=1e-4, atol=6e-4)
    for name in ("poses", "marker", "marker_in_world", "antenna", "antenna_in_world"):
        assert_allclose(getattr(true_again, name), getattr(truth, name), atol=6e-7)


@pytest.mark.parametrize("kind, low, high", [
    ("none", 0.0, 0.0), ("random", 0.12, 0.18), ("in frame", 0.07, 0.13), ("twins", 0.08, 0.16)])
def test_confused_labels_are_as_many_as_stated_and_those_in_a_frame_are_exchanged(kind, low, high):
    dataset, _ = short(1)
    pose, marker = dataset.aruco.pose, dataset.aruco.marker
    label = confuse_labels(dataset, kind, seed=3).aruco.marker
    assert low <= np.mean(label != marker) <= high
    assert np.isin(label, marker).all()
    same = [{*label[pose == each]} == {*marker[pose == each]} for each in np.unique(pose)]
    assert all(same) == (kind in ("none", "in frame"))
