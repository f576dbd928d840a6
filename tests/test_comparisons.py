"""What the studies compare: wrong labels known by the truth, starts on a dataset."""

from dataclasses import replace

import numpy as np
import pytest

from slamlib import slam
from slamlib.simulation import simulate
from slamlib.slam.measurements import measure
from slamlib.studies import kernels, starts


@pytest.fixture(scope="module")
def drive():
    """A drive with wrong labels, its truth, and the same drive without."""
    dataset, truth = simulate("short", seed=6, mislabelled=0.03)
    return dataset.without("uwb"), truth, simulate("short", seed=6)[0]


def test_wrong_labels_are_those_that_differ_from_the_same_drive_without(drive):
    dataset, truth, clean = drive
    differ = dataset.aruco.marker != clean.aruco.marker
    label_is_wrong = dict(zip(map(tuple, dataset.aruco.marker_in_vehicle), differ))
    m = measure(dataset)
    expected = [label_is_wrong[tuple(z)] for z in m.sightings.z]
    np.testing.assert_array_equal(kernels.mislabelled(m, truth), expected)
    some = replace(truth, marker=truth.marker[:9], marker_in_world=truth.marker_in_world[:9])
    known = np.isin(m.marker[m.marker_row], some.marker)
    np.testing.assert_array_equal(kernels.mislabelled(m, some), expected & known)
    assert sum(expected) > 10


def test_the_gate_rejects_wrong_labels_and_hardly_any_others():
    numbers = kernels.compare(6, "sightings", ("quadratic", "gate"), mislabelled=0.03)
    assert numbers["gate wrong rejected"] == 1 and numbers["gate good lost"] < 0.005
    assert numbers["quadratic wrong rejected"] == numbers["quadratic good lost"] == 0


def test_starts_on_a_dataset_are_right_or_wrong_without_truth(drive):
    dataset, _, _ = drive
    numbers = starts.landmarks_of_drive(dataset, slam.estimate(dataset))
    assert numbers["consensus right"] == 1 and numbers["first sighting right"] == 0
    assert numbers["consensus initial error"] < 0.5 < numbers["first sighting initial error"]
