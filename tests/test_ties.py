import numpy as np
import pytest

from numeric import central_differences
from slamlib import se2
from slamlib.dataset import ArucoReadings
from slamlib.evaluation import nees, nees_band
from slamlib.ties import common_sightings, estimate_ties, merge_repeated, plausible_ties

DELTA = np.array([0.12, -0.03, 0.2])
MARKERS = np.array([[1.2, 0.4, 0.3], [-0.7, 1.1, -2.9], [0.2, -1.3, 3.1], [-1.0, -0.8, 1.0]])
C = np.array([[4e-4, 5e-5, 1e-5], [5e-5, 2e-4, -4e-5], [1e-5, -4e-5, 1e-4]])


def sightings(delta=DELTA, markers=MARKERS, covariance=C, rng=None):
    """All markers seen from the origin, then all from delta, in one array; one tie of them."""
    z = np.concatenate([markers, se2.between(delta, markers)])
    covariances = np.broadcast_to(covariance, (len(z), 3, 3)).copy()
    if rng is not None:
        z = z + rng.multivariate_normal(np.zeros(3), covariance, len(z))
    m = len(markers)
    return z, covariances, np.zeros(m, int), np.arange(m), np.arange(m, 2 * m)


def test_exact_sightings_give_the_exact_increment():
    for delta in (DELTA, np.zeros(3), np.array([0.5, 0.4, np.pi]), np.array([-1, 2, -3.1])):
        for count in (1, 2, 4):
            ties = estimate_ties(*sightings(delta, MARKERS[:count]), 1)
            np.testing.assert_allclose(se2.wrap(ties.increment[0] - delta), 0, atol=1e-11)
            assert ties.kept.all() and ties.usable.all()


def test_covariance_by_hand():
    """Two markers at (+-d, 0), no motion, C = diag(s^2, s^2, t^2) everywhere, so W = 2 C.

    J = d(Delta Z')/d Delta is [[1, 0, 0], [0, 1, +-d], [0, 0, 1]]: the information of x and of y is
    2 / (2 s^2), that of the heading 2 d^2 / (2 s^2) + 2 / (2 t^2), all else cancels.
    """
    d, s, t = 0.8, 0.01, 0.02
    z = np.array([[d, 0, 0.5], [-d, 0, -1.5]])
    args = sightings(np.zeros(3), z, np.diag([s**2, s**2, t**2]))
    expected = np.diag([s**2, s**2, 1 / (d**2 / s**2 + 1 / t**2)])
    np.testing.assert_allclose(estimate_ties(*args, 1).covariance[0], expected, atol=1e-18)


def test_derivatives_by_the_sightings_against_central_differences():
    rng = np.random.default_rng(4)
    z, covariances, link, first, second = sightings(rng=rng)
    ties = estimate_ties(z, covariances, link, first, second, 1)

    def moved(change, k):
        y = z.copy()
        y[k] += change
        return estimate_ties(y, covariances, link, first, second, 1).increment[0]

    for p in range(len(first)):
        for k, analytic in ((first[p], ties.by_first[p]), (second[p], ties.by_second[p])):
            numeric = central_differences(lambda change: moved(change, k), np.zeros(3), 1e-5)
            np.testing.assert_allclose(analytic, numeric, atol=0.03 * np.abs(numeric).max())


def test_many_increments_are_consistent():
    """NEES of 400 increments in its 95 % band; the covariance is the gains' image of the noise."""
    rng = np.random.default_rng(5)
    errors, covariances = [], []
    for _ in range(400):
        args = sightings(rng=rng)
        ties = estimate_ties(*args, 1)
        image = sum(D @ C @ D.T for D in np.concatenate([ties.by_first, ties.by_second]))
        np.testing.assert_allclose(image, ties.covariance[0], atol=1e-9)
        errors.append(ties.increment[0] - DELTA)
        covariances.append(ties.covariance[0])
    low, high = nees_band(400)
    assert low < nees(np.array(errors), np.array(covariances), np.zeros((400, 3))).mean() < high


@pytest.mark.parametrize("count, wrong, oriented", [
    (3, 1, True), (4, 1, True), (4, 2, True), (3, 1, False), (4, 1, False)])
def test_wrong_labels_are_outvoted(count, wrong, oriented):
    rng = np.random.default_rng(6)
    covariance = C if oriented else np.diag([4e-4, 4e-4, 1e4])
    for _ in range(30):
        noise = np.diag([1e-4, 1e-4, 1e-4 if oriented else 9.0])
        z, covariances, link, first, second = sightings(markers=MARKERS[:count])
        z += rng.multivariate_normal(np.zeros(3), noise, len(z))
        covariances[:] = covariance
        z[second[:wrong], :2] += rng.choice([-1, 1], (wrong, 2)) * rng.uniform(0.8, 2, (wrong, 2))
        z[second[:wrong], 2] = rng.uniform(-np.pi, np.pi, wrong)
        ties = estimate_ties(z, covariances, link, first, second, 1)
        np.testing.assert_array_equal(ties.kept, np.arange(count) >= wrong)
        np.testing.assert_allclose(ties.increment[0], DELTA, atol=0.1)


def test_markers_without_orientation_tie_only_in_pairs():
    covariance = np.diag([1e-4, 1e-4, 1e4])
    two = estimate_ties(*sightings(markers=MARKERS[:2], covariance=covariance), 1)
    assert two.usable[0] and np.sqrt(two.covariance[0, 2, 2]) < 0.02
    np.testing.assert_allclose(two.increment[0], DELTA, atol=1e-8)
    far = estimate_ties(*sightings(np.array([2.0, -1.0, 2.5]), MARKERS[:3], covariance), 1)
    np.testing.assert_allclose(far.increment[0], [2.0, -1.0, 2.5], atol=1e-8)
    one = estimate_ties(*sightings(markers=MARKERS[:1], covariance=covariance), 1)
    assert not one.usable[0] and np.isnan(one.increment).all() and not one.kept.any()


def test_no_common_marker_is_no_tie():
    z, covariances, _, _, _ = sightings()
    none = np.zeros(0, int)
    ties = estimate_ties(z, covariances, none, none, none, 2)
    assert not ties.usable.any() and np.isnan(ties.increment).all()


def test_a_sudden_motion_is_none():
    """Frames 0 to 5 in steps of DELTA see two markers each; the last tie has one, wrongly labelled."""
    poses = [np.zeros(3)]
    for _ in range(5):
        poses.append(se2.compose(poses[-1], DELTA))
    z = se2.between(np.array(poses)[:, None], MARKERS[:2]).reshape(-1, 3)
    row, marker = np.repeat(np.arange(6), 2), np.tile([5, 9], 6)
    keep = np.arange(12) != 11
    z[10] = se2.between(poses[5], MARKERS[2])               # marker 5 is said to be where 2 is
    args = common_sightings(row[keep], marker[keep], np.arange(5), np.arange(1, 6))
    covariances = np.broadcast_to(C, (11, 3, 3))
    ties = plausible_ties(z[keep], covariances, *args, np.full(5, 10))
    np.testing.assert_array_equal(ties.usable, [True, True, True, True, False])
    np.testing.assert_array_equal(ties.kept, args[0] < 4)
    assert estimate_ties(z[keep], covariances, *args, 5).usable.all()            # the gate did it


def test_common_sightings_by_hand():
    row = np.array([0, 0, 0, 1, 1, 2, 2])
    marker = np.array([3, 5, 9, 5, 8, 3, 9])
    link, first, second = common_sightings(row, marker, [0, 1, 0], [1, 2, 2])
    np.testing.assert_array_equal(link, [0, 2, 2])
    np.testing.assert_array_equal(first, [1, 0, 2])
    np.testing.assert_array_equal(second, [3, 5, 6])


def test_repeated_sightings_are_averaged_or_dropped():
    readings = ArucoReadings(
        pose=np.array([0, 0, 0, 4, 4]), marker=np.array([7, 2, 7, 2, 2]),
        marker_in_vehicle=np.array([[1, 1, np.pi - 0.01], [0, 2, 0], [1.04, 1, -np.pi + 0.03],
                                    [1, 1, 0], [3, 1, 0]]),
        covariance=np.array([np.diag([1e-2, 1e-2, 1e-2])] * 2 + [np.diag([1e-2, 1e-2, 3e-2])]
                            + [np.diag([1e-2, 1e-2, 1e-2])] * 2))
    before = readings.marker_in_vehicle.copy()
    index, z, covariance = merge_repeated(readings)
    np.testing.assert_array_equal(index, [1, 0])                # the two of pose 4 disagree
    np.testing.assert_allclose(z, [[0, 2, 0], [1.02, 1, np.pi]], atol=1e-12)
    np.testing.assert_allclose(covariance[1], np.diag([5e-3, 5e-3, 7.5e-3]))
    np.testing.assert_array_equal(readings.marker_in_vehicle, before)


def test_starting_off_is_no_sudden_motion():
    """200 frames at rest with two markers in view, then 15 in motion, each pair with one in common."""
    poses = [np.zeros(3)] * 200
    for _ in range(15):
        poses.append(se2.compose(poses[-1], DELTA))
    row = np.concatenate([np.repeat(np.arange(200), 2), np.repeat(np.arange(200, 215), 2)])
    marker = np.concatenate([np.tile([5, 9], 200), np.repeat(np.arange(9, 24), 2) + np.tile([0, 1], 15)])
    rng = np.random.default_rng(2)
    rng_map = {m: np.append(rng.uniform(-1, 1, 2), rng.uniform(-3, 3)) for m in np.unique(marker)}
    z = se2.between(np.array(poses)[row], np.array([rng_map[m] for m in marker]))
    z += rng.normal(0, 1e-3, z.shape)
    order = np.lexsort((marker, row))
    args = common_sightings(row[order], marker[order], np.arange(214), np.arange(1, 215))
    ties = plausible_ties(z[order], np.tile(1e-6 * np.eye(3), (len(z), 1, 1)), *args, np.full(214, 10))
    common = np.bincount(args[0], minlength=214)
    assert (common[199:] == 1).all() and ties.usable.all() and ties.kept.all()


def test_two_sightings_too_far_apart_to_agree_and_too_near_for_one_to_win_make_no_tie():
    """Seven sigmas apart each is beyond the gate of their mean: none is left, and nothing is raised."""
    z = np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.07, 0, 0], [-1.07, 0, 0]])
    args = z, np.broadcast_to(1e-4 * np.eye(3), (4, 3, 3)), np.zeros(2, int), np.arange(2), np.arange(2, 4)
    ties = estimate_ties(*args, 1)
    assert not ties.usable.any() and not ties.kept.any() and np.isnan(ties.increment).all()
