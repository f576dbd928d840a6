"""Increments from markers that two frames share: exact, robust, consistent, and their inputs."""

from dataclasses import replace

import numpy as np
import pytest
from numeric import assert_consistent, short
from numeric import sightings as readings
from numpy.testing import assert_allclose, assert_array_equal

from slamlib.core import se2
from slamlib.core.evaluation import nees
from slamlib.core.marker_increments import (
    consecutive_increments,
    distance_and_turn,
    distance_and_turn_sigmas,
    robust_increments,
)
from slamlib.core.sightings import (
    consensus,
    merge_repeated,
    regularized,
    sightings_by_frame,
)
from slamlib.report.returns import find_returns

DELTA = np.array([0.12, -0.03, 0.2])
MARKERS = np.array([[1.2, 0.4, 0.3], [-0.7, 1.1, -2.9], [0.2, -1.3, 3.1], [-1.0, -0.8, 1.0]])
C = np.array([[4e-4, 5e-5, 1e-5], [5e-5, 2e-4, -4e-5], [1e-5, -4e-5, 1e-4]])
POINT = np.diag([1e-4, 1e-4, 1e4])


def sightings(delta=DELTA, markers=MARKERS, covariance=C):
    """Arguments of robust_increments for one pair: the origin and delta both see all markers."""
    z = np.concatenate([markers, se2.between(delta, markers)])
    m = len(markers)
    rows = np.arange(m)
    return z, np.tile(covariance, (2 * m, 1, 1)), np.zeros(m, int), rows, m + rows


@pytest.mark.parametrize("delta", [
    DELTA, np.zeros(3), [0.5, 0.4, np.pi], [-1, 2, -3.1], [2.0, -1.0, 2.5]])
@pytest.mark.parametrize("count, covariance", [(1, C), (2, C), (4, C), (2, POINT), (3, POINT)])
def test_exact_sightings_give_the_exact_increment(delta, count, covariance):
    """One marker determines it, or two without heading."""
    found = robust_increments(*sightings(delta, MARKERS[:count], covariance), 1)
    assert_allclose(se2.difference(found.increment[0], delta), 0, atol=1e-8)
    assert found.accepted.all() and found.usable.all() and found.covariance[0, 2, 2] < 0.02**2


def test_distance_and_turn_by_hand():
    assert_allclose(distance_and_turn(np.array([[3.0, -4.0, 2 * np.pi - 0.1]])), [[5, 0.1]])
    assert_allclose(distance_and_turn_sigmas(np.diag([9.0, 16.0, 4.0])[None]), [[5, 2]])


def test_many_increments_are_consistent():
    """NEES of 400 increments is in its band; C_Delta = sum_j D_j C_j D_j^T + D'_j C'_j D'_j^T."""
    rng = np.random.default_rng(5)
    count = 400
    m = len(MARKERS)
    z = np.tile(sightings()[0], (count, 1))
    z += rng.multivariate_normal(np.zeros(3), C, len(z))
    pair = np.repeat(np.arange(count), m)
    first = 2 * m * pair + np.tile(np.arange(m), count)
    found = robust_increments(
        z, np.tile(C, (len(z), 1, 1)), pair, first, first + m, count)
    image = sum(D @ C @ D.mT for D in (found.J_first, found.J_second))
    assert_allclose(image.reshape(count, m, 3, 3).sum(1), found.covariance, atol=1e-9)
    errors = found.increment - DELTA
    assert_consistent(nees(errors, found.covariance, 0 * errors))


@pytest.mark.parametrize("count, wrong, covariance, heading_noise", [
    (3, 1, C, 0.01), (4, 2, C, 0.01), (3, 1, 4 * POINT, 3.0), (4, 1, 4 * POINT, 3.0),
    (12, 5, np.diag([4e-4, 4e-4, 0.16]), 0.4)])
def test_wrong_labels_are_rejected(count, wrong, covariance, heading_noise):
    """Also where the vehicle has turned by more than a right angle."""
    rng = np.random.default_rng(6)
    delta = np.array([0.5, 0.4, 1.7])
    ring = [se2.compose([0, 0, turn], MARKERS) for turn in range(3)]
    for _ in range(30):
        z, covariances, pair, first, second = sightings(
            delta, np.concatenate(ring)[:count], covariance)
        z += rng.normal(0, [0.01, 0.01, heading_noise], z.shape)
        z[second[:wrong], :2] += rng.choice([-1, 1], (wrong, 2)) * rng.uniform(0.8, 2, (wrong, 2))
        z[second[:wrong], 2] = rng.uniform(-np.pi, np.pi, wrong)
        found = robust_increments(z, covariances, pair, first, second, 1)
        assert_array_equal(found.accepted, np.arange(count) >= wrong)
        assert_allclose(found.increment[0], delta, atol=0.1)


def test_what_determines_no_increment_is_not_usable():
    """One point or uncertain heading; no common marker; two sightings seven sigmas apart."""
    apart = sightings(np.zeros(3), np.array([[1.0, 0, 0], [-1.0, 0, 0]]), 1e-4 * np.eye(3))
    apart[0][2:] *= 1.07
    for arguments in (sightings(markers=MARKERS[:1], covariance=POINT),
                      sightings(markers=MARKERS[:1], covariance=np.diag([1e-4, 1e-4, 0.16])),
                      sightings(markers=MARKERS[:0]), apart):
        found = robust_increments(*arguments, 1)
        assert not found.usable.any() and not found.accepted.any()
        assert np.isnan(found.increment).all()


@pytest.mark.parametrize("way, turn", [(1, 0), (0, 1)])
@pytest.mark.parametrize("start", [0, 60])
def test_an_implausible_speed_makes_an_increment_unusable(way, turn, start):
    """0.1 m or rad in most increments, by two markers, so that up to 0.3 is plausible.

    Or at rest until a late start, and then by one marker. Of those by one marker, with other
    motions, three are too fast and alone: the first, one beside one three times as fast, and the
    last. Two are like each other, and one is within three sigmas.
    """
    fast = [0, 20, 21, 40, 41, 60, 79]
    motion = np.where(np.arange(80) < start, 0.0, 0.1)
    motion[fast] = [1.0, 1.0, 1.2, 0.8, 3.0, 0.303, 0.32]
    moved = np.stack([motion if way else 0 * motion + 0.1, 0 * motion, turn * motion], axis=-1)
    single = np.isin(np.arange(80), fast) | (motion == 0.1) & (start > 0)
    k, j = np.nonzero(~single[:, None] | [True, False])
    marker = np.tile(2 * k + j, 2)                 # each increment has markers of its own
    row = np.append(k, k + 1)
    place = MARKERS[j] * [0.1, 0.1, 1]
    z = np.concatenate([place, se2.between(moved[k], place)])
    order = np.argsort(row, kind="stable")
    seen = readings(10 * row[order], marker[order], z[order], 1e-6 * np.eye(3))
    found = consecutive_increments(sightings_by_frame(seen))
    assert_array_equal(np.flatnonzero(~found.usable), [0, 40, 41, 79])
    assert_array_equal(found.accepted, found.usable[found.pair])


def test_repeated_sightings_are_averaged_or_dropped():
    z = [[1, 1, np.pi - 0.01], [0, 2, 0], [1.04, 1, -np.pi + 0.03], [1, 1, 0], [3, 1, 0]]
    covariance = np.tile(1e-2 * np.eye(3), (5, 1, 1))
    covariance[2, 2, 2] = 3e-2
    given = readings([0, 0, 0, 4, 4], [7, 2, 7, 2, 2], z, covariance)
    index, merged, C, contradicting = merge_repeated(given)
    assert_array_equal(index, [1, 0])                # the two of pose 4 disagree
    assert contradicting == 2
    assert_allclose(merged, [[0, 2, 0], [1.02, 1, np.pi]], atol=1e-12)
    assert_allclose(C[1], np.diag([5e-3, 5e-3, 7.5e-3]))
    assert_array_equal(given.marker_in_vehicle, z)


def test_covariances_that_are_nearly_singular_are_increased_by_hand():
    """Given y, the standard deviation of x is sigma sqrt(1 - rho^2): 8.9e-6, 1.4e-7 and 0.14 m."""
    for lack, sigma, added in ((4e-7, 0.01, 0), (1e-10, 0.01, 1e-12), (1e-10, 1e4, 0)):
        C = np.diag([sigma**2, sigma**2, 1e-4])
        C[0, 1] = C[1, 0] = (1 - lack) * sigma**2
        difference = regularized(C[None])[0] - C
        assert_allclose(difference, np.diag([added, added, 0]), rtol=1e-3, atol=1e-18)
    far = np.array([np.diag([1e8, 1e-18, 1e-4]), np.diag([1e-18, 1e8, 1e-4])])   # a millionth
    assert_allclose(regularized(far) - far, [np.diag([0, 1e-4, 0]), np.diag([1e-4, 0, 0])])


def test_consensus_is_the_most_certain_sighting_that_agrees_with_the_median():
    """Marker 4: two more certain sightings of five are 1 m off; marker 2 has one."""
    in_world = np.array([[0, 0, 3.1], [1, 0, 3.1], [0.01, 0, -3.13], [0, 0.01, 3.1], [1, 0, 3.1],
                         [5, 5, 0]])
    variance = np.array([4, 1, 3, 2, 1, 9]) * 1e-4
    C = variance[:, None, None] * np.eye(3)
    assert_array_equal(consensus(np.array([4, 4, 4, 4, 4, 2]), in_world, C), [5, 3])


@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_returns_measure_the_true_motion(wrong):
    """Without noise the markers give it exactly, also where some labels are wrong."""
    dataset, truth = short(3, noise=False, mislabelled=wrong)
    found = find_returns(dataset)
    assert len(found.start) > 25 and (found.end - found.start > 450).all()          # poses, of 5 m
    assert np.diff(found.end).min() == 10                                  # every frame is asked
    assert_allclose(found.discrepancies(truth.poses), 0, atol=1e-8)


def test_in_reverse_there_are_as_many_returns():
    dataset, _ = short(3)
    reverse = replace(dataset, ticks=-dataset.ticks)
    assert_array_equal(find_returns(reverse).end, find_returns(dataset).end)


def test_a_drive_without_markers_or_that_goes_nowhere_again_has_no_returns():
    dataset, truth = short(3)
    for each in (dataset.without("aruco"), dataset.first(700), dataset.first(1)):
        found = find_returns(each)
        assert found.discrepancies(truth.poses).shape == (0, 3)
        assert found.covariance.shape == (0, 3, 3)


def test_the_covariance_of_returns_is_consistent():
    """The last return of each of eight drives, so that they are independent."""
    values = []
    for seed in range(8):
        dataset, truth = short(seed, slip=3e-3)
        found = find_returns(dataset)
        off = found.discrepancies(truth.poses)
        values.append(nees(off, found.covariance, 0 * off)[-1])
    assert_consistent(values)
