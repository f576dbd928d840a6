"""Drives that are spoilt where and as it is said, and nowhere else."""

import numpy as np
from numeric import short
from numpy.testing import assert_allclose, assert_array_equal

from slamlib.core import se2
from slamlib.studies.simulation import distances
from slamlib.studies.spoilt import BUMP, SPOILED, with_camera_at, with_counts, with_ids_twice


def test_the_camera_is_elsewhere_from_a_pose_on():
    dataset, _ = short(1)
    before = dataset.aruco
    after = with_camera_at(dataset, BUMP, first=900).aruco
    later = before.pose >= 900
    assert later.any() and not later.all()
    assert_array_equal(after.marker_in_vehicle[~later], before.marker_in_vehicle[~later])
    assert_allclose(se2.compose(BUMP, after.marker_in_vehicle[later]),
                    before.marker_in_vehicle[later], atol=1e-12)
    assert_allclose(se2.rotate_covariance(after.covariance[later], np.full(later.sum(), BUMP[2])),
                    before.covariance[later], atol=1e-15)


def test_counts_change_in_their_rows_alone():
    dataset, _ = short(1)
    spoilt = with_counts(dataset, slice(800, 1200), lambda n: n[:, ::-1]).ticks
    assert_array_equal(spoilt[800:1200], dataset.ticks[800:1200, ::-1])
    assert_array_equal(np.delete(spoilt, slice(800, 1200), 0),
                       np.delete(dataset.ticks, slice(800, 1200), 0))
    assert spoilt.dtype == dataset.ticks.dtype


def test_every_id_is_that_of_two_markers_that_are_far_apart():
    dataset, truth = short(1)
    shared = with_ids_twice(dataset, truth.marker, truth.marker_in_world).aruco.marker
    place = dict(zip(truth.marker, truth.marker_in_world))
    pairs = np.unique(np.column_stack([shared, dataset.aruco.marker]), axis=0)
    renamed = pairs[pairs[:, 0] != pairs[:, 1]]
    assert len(renamed) == len(truth.marker) // 2
    assert len(np.unique(shared)) == len(truth.marker) - len(renamed)
    apart = [distances(place[new], place[old]) for new, old in renamed]
    assert np.median(apart) > 3.0


def test_what_is_called_as_stated_is():
    dataset, truth = short(1)
    assert SPOILED["as stated"](dataset, truth) is dataset
