"""A camera that something moves, or wheels that slip, in a part of a drive cost little else."""

from dataclasses import replace

import numpy as np
import pytest
from numeric import (
    aligned_ate,
    aruco,
    counts,
    mean_nees,
    only,
    seen_from,
    short,
    without_headings,
)
from numpy.testing import assert_allclose, assert_array_equal

from slamlib import estimate, fuse
from slamlib.core import se2
from slamlib.core.vehicle import Vehicle
from slamlib.robust.jumps import find_jumps, frozen_rows
from slamlib.robust.part_faults import (
    camera_bump,
    constant_delay,
    moving_increments,
    slipping_rows,
)
from slamlib.robust.solution_doubts import fusion_doubts, solution_doubts

BUMP = np.array([0.05, -0.03, 0.06])
MOUNTED = Vehicle(camera_x=0.1, camera_y=0.05, camera_turn=0.4, marker_size=1.1)


def with_moved_camera(dataset, pose, stated=None):
    """The sightings of a camera that is as stated until a pose, then elsewhere by BUMP."""
    stated = stated or Vehicle()
    camera = np.array([stated.camera_x, stated.camera_y, stated.camera_turn])
    later = dataset.aruco.pose >= pose
    place = np.where(later[:, None], se2.compose(BUMP, camera), camera)
    return replace(seen_from(dataset, place, stated.marker_size), vehicle=stated)


@pytest.mark.parametrize("stated", [Vehicle(), MOUNTED])
@pytest.mark.parametrize("pose", [600, 1500])
def test_a_camera_that_was_moved_is_found_and_its_sightings_are_mended(pose, stated):
    clean, _ = short(2)
    bump = camera_bump(with_moved_camera(clean, pose, stated))
    assert bump.pose == pose
    assert_allclose(bump.motion, BUMP, atol=0.035)
    known = bump._replace(motion=BUMP)
    mended = known.mended(with_moved_camera(clean, pose, stated)).aruco
    expected = with_moved_camera(clean, 10**6, stated).aruco
    assert_allclose(mended.marker_in_vehicle, expected.marker_in_vehicle, atol=1e-12)
    assert_allclose(mended.covariance, expected.covariance, atol=1e-12)


@pytest.mark.parametrize("spoil", [
    lambda d: d, lambda d: replace(d, aruco=None), lambda d: d.first(60),
    lambda d: replace(d, aruco=without_headings(d.aruco, d.aruco.marker > 0)),
    lambda d: with_moved_camera(d, 0)])
def test_a_camera_that_nothing_moved_is_left(spoil):
    for slip in (1e-3, 1e-2):
        assert camera_bump(spoil(short(3, slip=slip)[0])) is None


def test_a_moved_camera_is_told_and_costs_problems_2_and_3_nothing():
    clean, truth = short(4)
    clean = clean.without("uwb")
    spoilt = with_moved_camera(clean, 900)
    found = estimate(spoilt)
    doubt, = solution_doubts(found)
    assert doubt.what == "camera-bump"
    assert doubt.sentence.startswith("From pose 901 on the camera is elsewhere.")
    bump = found.calibration.of_group("camera-bump")
    off = se2.difference(found.c[bump], BUMP)
    assert off @ np.linalg.solve(found.c_covariance[np.ix_(bump, bump)], off) < 16.3
    for solution, alone in ((found, estimate(clean)), (fuse(spoilt), fuse(clean))):
        assert aligned_ate(solution, truth) < 1.5 * aligned_ate(alone, truth) + 2e-3


@pytest.mark.slow
def test_a_motion_of_the_camera_that_counts_explain_is_not_believed():
    """Counts that are all doubled look like one at first, and once led metres away with it."""
    dataset, truth = short(102, 1300)
    spoilt = replace(dataset, uwb=None, ticks=2 * dataset.ticks)
    assert camera_bump(spoilt) is not None
    found = estimate(spoilt)
    assert found.released == {"wheel-scale"} and found.jumps.bump == np.inf
    assert aligned_ate(found, truth) < 0.02


def test_counts_of_a_patch_on_which_wheels_slip_are_not_used():
    clean, truth = short(21)
    clean = clean.without("uwb")
    spoilt = counts(slice(900, 1200), lambda ticks: np.rint(1.06 * ticks))(clean)
    rows = np.flatnonzero(slipping_rows(spoilt))
    assert 700 < rows[0] <= 900 and 1199 <= rows[-1] < 1400
    found = estimate(spoilt)
    assert [doubt.what for doubt in solution_doubts(found)] == ["encoder"]
    assert aligned_ate(fuse(spoilt), truth) < 0.02
    assert aligned_ate(found, truth) < min(0.02, 2 * aligned_ate(estimate(clean), truth) + 2e-3)


@pytest.mark.parametrize("seed, slip", [(1, 3e-4), (2, 3e-3), (3, 1e-2), (4, 3e-2)])
@pytest.mark.parametrize("mislabelled", [0.0, 0.03])
def test_wheels_that_slip_everywhere_alike_are_used(seed, slip, mislabelled):
    dataset, _ = short(seed, slip=slip, mislabelled=mislabelled)
    assert not slipping_rows(dataset).any()
    assert not slipping_rows(dataset.first(60)).any()


def test_a_camera_that_is_moved_and_put_back_is_no_two_jumps():
    """These would spare sightings, but contradict others: 0.03 m off."""
    dataset, truth = short(23)
    moved = np.isin(dataset.aruco.pose, range(700, 1300))[:, None] * [0.05, 0.03, 0.06]
    z = dataset.aruco.marker_in_vehicle
    found = estimate(aruco(dataset, marker_in_vehicle=se2.compose(moved, z)).without("uwb"))
    assert aligned_ate(found, truth) < 0.01 and not len(found.jumps.start)


def test_increments_over_a_long_time_without_sightings_are_not_compared():
    """Of markers at one place of four rounds: what odometry lost on a round is no other drive."""
    dataset, _ = short(4, rounds=4)
    poses = moving_increments(only(dataset, dataset.aruco.pose % 2000 < 200))[3]
    assert np.unique(poses[:, 1] - poses[:, 0]).tolist() == [100] and len(poses) == 20


@pytest.mark.parametrize("steps", [-25, 25])
def test_a_delay_of_all_sightings_is_known_before_anything_is_solved(steps):
    dataset, _ = short(4)
    late = replace(dataset.aruco, pose=dataset.aruco.pose + steps)
    inside = (late.pose >= 0) & (late.pose < len(dataset.ticks))
    assert constant_delay(replace(dataset, aruco=late.select(inside))) == steps


@pytest.mark.parametrize("poses, motion", [
    (range(800, 960), [0.1, 0.05, 0.1]),         # two jumps, which are no inverse motions
    (range(800, 920), [0.5, 0.3, 0.7])])         # jumps all the way
def test_frames_of_a_camera_that_hangs_elsewhere_are_left_out(poses, motion):
    dataset, truth = short(4)
    moved = np.isin(dataset.aruco.pose, poses)[:, None] * motion
    z = se2.compose(moved, dataset.aruco.marker_in_vehicle)
    found = estimate(aruco(dataset, marker_in_vehicle=z).without("uwb"))
    assert not len(found.jumps.start) and mean_nees(found, truth) < 6
    assert aligned_ate(found, truth) < 0.01
    assert [doubt.what for doubt in solution_doubts(found)] == ["sightings-rejected"]


def test_two_faults_of_a_wheel_are_no_motion_of_the_camera():
    """They would cancel as such, but markers seen before and after say that the vehicle moved."""
    dataset, _ = short(4)
    faulty = counts(slice(1001, 1004), lambda ticks: ticks + [330, 0])(dataset)
    faulty = counts(slice(1061, 1064), lambda ticks: ticks - [330, 0])(faulty)
    assert len(find_jumps(faulty).start) == 2


def test_a_jump_among_many_wrong_labels_is_found():
    """Most counts are lost beside 15 % wrong labels, which stay rejected: 0.018 m off without."""
    dataset, truth = short(31, mislabelled=0.15)
    fewer = counts(slice(1000, 1008), lambda ticks: ticks // 4)(dataset)
    found = estimate(fewer.without("uwb"))
    assert aligned_ate(found, truth) < 0.005 and len(found.jumps.start) == 1


def test_counts_that_freeze_are_told_and_cost_problems_2_and_3_little():
    """The last row of the counts comes again and again."""
    dataset, truth = short(2)
    frozen = counts(slice(1500, 1560), lambda ticks: 0 * ticks + ticks[0])(dataset)
    assert_array_equal(np.flatnonzero(frozen_rows(frozen.ticks)), np.arange(1500, 1560))
    assert not frozen_rows(dataset.ticks).any()
    found = estimate(frozen.without("uwb"))
    assert aligned_ate(found, truth) < 3e-3
    assert mean_nees(found, truth) < 6
    assert [doubt.what for doubt in solution_doubts(found)] == ["encoder"]
    fusion = fuse(frozen)
    assert aligned_ate(fusion, truth) < 2e-2
    assert [doubt.what for doubt in fusion_doubts(fusion, frozen.vehicle)] == ["encoder"]
