import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from slamlib.core import se2
from slamlib.core.evaluation import nees, nees_band
from slamlib.core.marker_increments import (
    _best_hypothesis,
    _Common,
    common_sightings,
    consecutive_increments,
    distance_and_turn,
    distance_and_turn_sigmas,
    returns,
    robust_increments,
)
from slamlib.core.records import ArucoReadings
from slamlib.core.sightings import Sightings, consensus, merge_repeated, regular
from slamlib.studies.simulation import simulate

DELTA = np.array([0.12, -0.03, 0.2])
MARKERS = np.array([[1.2, 0.4, 0.3], [-0.7, 1.1, -2.9], [0.2, -1.3, 3.1], [-1.0, -0.8, 1.0]])
C = np.array([[4e-4, 5e-5, 1e-5], [5e-5, 2e-4, -4e-5], [1e-5, -4e-5, 1e-4]])
POINT = np.diag([1e-4, 1e-4, 1e4])


def sightings(delta=DELTA, markers=MARKERS, covariance=C, rng=None):
    """Arguments of robust_increments for one pair: the origin and delta both see all markers."""
    z = np.concatenate([markers, se2.between(delta, markers)])
    covariances = np.broadcast_to(covariance, (len(z), 3, 3)).copy()
    if rng is not None:
        z = z + rng.multivariate_normal(np.zeros(3), covariance, len(z))
    m = len(markers)
    return z, covariances, np.zeros(m, int), np.arange(m), np.arange(m, 2 * m)


@pytest.mark.parametrize("delta", [
    DELTA, np.zeros(3), [0.5, 0.4, np.pi], [-1, 2, -3.1], [2.0, -1.0, 2.5]])
@pytest.mark.parametrize("count, covariance", [(1, C), (2, C), (4, C), (2, POINT), (3, POINT)])
def test_exact_sightings_give_the_exact_increment(delta, count, covariance):
    """One marker determines it, or two without heading."""
    found = robust_increments(*sightings(delta, MARKERS[:count], covariance), 1)
    assert_allclose(se2.difference(found.increment[0], delta), 0, atol=1e-8)
    assert found.accepted.all() and found.usable.all() and found.covariance[0, 2, 2] < 0.02**2


def test_covariance_by_hand():
    """Two markers at (+-d, 0), no motion, C = diag(s^2, s^2, t^2) everywhere, so W = 2 C.

    J = d(Delta Z')/d Delta is [[1, 0, 0], [0, 1, +-d], [0, 0, 1]]: the information of x and of y is
    2 / (2 s^2), that of the heading 2 d^2 / (2 s^2) + 2 / (2 t^2), all else cancels.
    """
    d, s, t = 0.8, 0.01, 0.02
    z = np.array([[d, 0, 0.5], [-d, 0, -1.5]])
    args = sightings(np.zeros(3), z, np.diag([s**2, s**2, t**2]))
    expected = np.diag([s**2, s**2, 1 / (d**2 / s**2 + 1 / t**2)])
    assert_allclose(robust_increments(*args, 1).covariance[0], expected, atol=1e-18)


@pytest.mark.parametrize("count, wrong, sigma", [
    (1, 0, 0.01), (2, 0, 0.4), (4, 1, 0.4), (4, 1, 0.01), (12, 5, 100)])
def test_the_best_hypothesis_is_the_increment_itself(count, wrong, sigma):
    """Of three pairs, the second without markers; headings are wrong if their sigma says so."""
    rng, deltas = np.random.default_rng(count), np.array([[0.5, 0.4, 2.9], [0, 0, 0], DELTA])
    markers = np.c_[rng.uniform(-1, 1, (count, 2)), rng.uniform(-3, 3, count)]
    z1, z2 = np.tile(markers, (2, 1)), se2.between(deltas[::2, None], markers).reshape(-1, 3)
    z2[count:count + wrong] += rng.uniform(1, 2, (wrong, 3))
    if sigma > 0.1:
        z1[:, 2] = rng.uniform(-3, 3, 2 * count)
    covariance = np.tile(np.diag([1e-4, 1e-4, sigma**2]), (2 * count, 1, 1))
    pair = np.repeat([0, 2], count)
    found = _best_hypothesis(_Common(pair, z1, covariance, z2, covariance, 3))
    assert_allclose(se2.difference(found, deltas), 0, atol=1e-12)


def test_distance_and_turn_by_hand():
    motion, C = np.array([[3.0, -4.0, 2 * np.pi - 0.1]]), np.diag([9.0, 16.0, 4.0])
    assert_allclose(distance_and_turn(motion), [[5, 0.1]])
    assert_allclose(distance_and_turn_sigmas(C[None]), [[5, 2]])


def test_many_increments_are_consistent():
    """NEES of 400 increments is in its band; C_Delta = sum_j D_j C_j D_j^T + D'_j C'_j D'_j^T."""
    rng, count, m = np.random.default_rng(5), 400, len(MARKERS)
    z, covariances = (np.concatenate(each) for each in zip(
        *(sightings(rng=rng)[:2] for _ in range(count)), strict=True))
    first = (2 * m * np.arange(count)[:, None] + np.arange(m)).ravel()
    pair = np.repeat(np.arange(count), m)
    found = robust_increments(z, covariances, pair, first, first + m, count)
    image = sum(D @ C @ np.swapaxes(D, 1, 2) for D in (found.J_first, found.J_second))
    assert_allclose(image.reshape(count, m, 3, 3).sum(1), found.covariance, atol=1e-9)
    low, high = nees_band(count)
    errors = found.increment - DELTA
    assert low < nees(errors, found.covariance, np.zeros_like(errors)).mean() < high


@pytest.mark.parametrize("count, wrong, oriented", [
    (3, 1, True), (4, 1, True), (4, 2, True), (3, 1, False), (4, 1, False)])
def test_wrong_labels_are_rejected(count, wrong, oriented):
    rng = np.random.default_rng(6)
    covariance = C if oriented else np.diag([4e-4, 4e-4, 1e4])
    for _ in range(30):
        noise = np.diag([1e-4, 1e-4, 1e-4 if oriented else 9.0])
        z, covariances, pair, first, second = sightings(markers=MARKERS[:count])
        z += rng.multivariate_normal(np.zeros(3), noise, len(z))
        covariances[:] = covariance
        z[second[:wrong], :2] += rng.choice([-1, 1], (wrong, 2)) * rng.uniform(0.8, 2, (wrong, 2))
        z[second[:wrong], 2] = rng.uniform(-np.pi, np.pi, wrong)
        found = robust_increments(z, covariances, pair, first, second, 1)
        assert_array_equal(found.accepted, np.arange(count) >= wrong)
        assert_allclose(found.increment[0], DELTA, atol=0.1)


def test_what_determines_no_increment_is_not_usable():
    """One point or uncertain heading; no common marker; two sightings seven sigmas apart."""
    apart = np.array([[1.0, 0, 0], [-1.0, 0, 0], [1.07, 0, 0], [-1.07, 0, 0]])
    pairs, none = (np.zeros(2, int), np.arange(2), np.arange(2, 4)), 3 * [np.zeros(0, int)]
    for arguments in (sightings(markers=MARKERS[:1], covariance=POINT),
                      sightings(markers=MARKERS[:1], covariance=np.diag([1e-4, 1e-4, 0.16])),
                      (*sightings()[:2], *none),
                      (apart, np.broadcast_to(1e-4 * np.eye(3), (4, 3, 3)), *pairs)):
        found = robust_increments(*arguments, 1)
        assert not found.usable.any() and not found.accepted.any()
        assert np.isnan(found.increment).all()


def consecutive(z, covariances, row, marker, steps=10):
    """consecutive_increments of these sightings, frames being `steps` encoder steps apart."""
    order = np.lexsort((marker, row))
    return consecutive_increments(Sightings(
        index=order, row=row[order], marker=marker[order], z=z[order], C=covariances[order],
        frame=steps * np.arange(row.max() + 1)))


@pytest.mark.parametrize("way, turn", [(1, 0), (0, 1)])
@pytest.mark.parametrize("start", [0, 60])
def test_an_implausible_speed_makes_an_increment_unusable(way, turn, start):
    """0.1 m or rad in most increments, by two markers, so that up to 0.3 is plausible.

    Or at rest until a late start, and then by one marker. Of those by one marker, with other
    motions, three are too fast and alone: the first, one beside one three times as fast, and the
    last. Two are like each other, and one is within three sigmas.
    """
    fast = {0: 1.0, 20: 1.0, 21: 1.2, 40: 0.8, 41: 3.0, 60: 0.303, 79: 0.32}
    motion = np.where(np.arange(80) < start, 0.0, 0.1)
    motion[[*fast]] = [*fast.values()]
    single = {*fast, *range(start, 80 * (start > 0))}
    z, row, marker = [], [], []
    for k, each in enumerate(motion):              # the markers of an increment have its own ids
        for j, place in enumerate(MARKERS[:1 if k in single else 2] * [0.1, 0.1, 1]):
            z += [place, se2.between([each if way else 0.1, 0, turn * each], place)]
            row, marker = [*row, k, k + 1], [*marker, 2 * k + j, 2 * k + j]
    z, row, marker = map(np.array, (z, row, marker))
    covariances = np.tile(1e-6 * np.eye(3), (len(z), 1, 1))
    alone = robust_increments(z, covariances, *common_sightings(
        row[order := np.lexsort((marker, row))], marker[order]), 80)
    found = consecutive(z, covariances, row, marker)
    assert alone.usable.all()                               # the test of the speed rejects them
    assert_array_equal(np.flatnonzero(~found.usable), [0, 40, 41, 79])
    assert_array_equal(found.accepted, found.usable[found.pair])


def test_repeated_sightings_are_averaged_or_dropped():
    readings = ArucoReadings(
        pose=np.array([0, 0, 0, 4, 4]), marker=np.array([7, 2, 7, 2, 2]),
        marker_in_vehicle=np.array([[1, 1, np.pi - 0.01], [0, 2, 0], [1.04, 1, -np.pi + 0.03],
                                    [1, 1, 0], [3, 1, 0]]),
        covariance=np.array([np.diag([1e-2, 1e-2, 1e-2])] * 2 + [np.diag([1e-2, 1e-2, 3e-2])]
                            + [np.diag([1e-2, 1e-2, 1e-2])] * 2))
    before = readings.marker_in_vehicle.copy()
    index, z, covariance, contradicting = merge_repeated(readings)
    assert_array_equal(index, [1, 0])                # the two of pose 4 disagree
    assert contradicting == 2
    assert_allclose(z, [[0, 2, 0], [1.02, 1, np.pi]], atol=1e-12)
    assert_allclose(covariance[1], np.diag([5e-3, 5e-3, 7.5e-3]))
    assert_array_equal(readings.marker_in_vehicle, before)


def test_covariances_that_are_nearly_singular_are_increased_by_hand():
    """Given y, the standard deviation of x is sigma sqrt(1 - rho^2): 1.4e-5, 1.4e-7 and 0.14 m."""
    rho, sigma = 1 - np.array([1e-6, 1e-10, 1e-10]), np.array([0.01, 0.01, 1e4])
    C = np.tile(np.diag([0.0, 0.0, 1e-4]), (3, 1, 1))
    C[:, [0, 1], [0, 1]], C[:, 0, 1] = sigma[:, None]**2, rho * sigma**2
    C[:, 1, 0] = C[:, 0, 1]
    added = np.array([0, 1e-12, 0])[:, None, None] * np.diag([1, 1, 0])
    assert_allclose(regular(C) - C, added, rtol=1e-3, atol=1e-18)
    far = np.array([np.diag([1e8, 1e-18, 1e-4]), np.diag([1e-18, 1e8, 1e-4])])   # a millionth
    assert_allclose(regular(far) - far, [np.diag([0, 1e-4, 0]), np.diag([1e-4, 0, 0])])


def test_consensus_takes_the_most_certain_sighting_among_the_supported():
    """Marker 4 has three sightings that agree and a more certain one 1 m off; marker 2 has one."""
    in_world = np.array([[0, 0, 3.1], [1, 0, 3.1], [0.01, 0, -3.13], [0, 0.01, 3.1], [5, 5, 0]])
    variance = np.array([4, 1, 3, 2, 9]) * 1e-4
    rows = consensus(np.array([4, 4, 4, 4, 2]), in_world, variance[:, None, None] * np.eye(3))
    assert_array_equal(rows, [4, 3])
    covariance = variance[[0, 1, 3, 2, 1], None, None] * np.eye(3)
    assert consensus(np.zeros(5, int), np.zeros((5, 3)), covariance, 2) == 3       # or 0, of two


@pytest.mark.parametrize("wrong", [0.0, 0.05])
def test_returns_measure_the_true_motion(wrong):
    """Without noise the markers give it exactly, also where some labels are wrong."""
    dataset, truth = simulate("short", 3, noise=False, mislabelled=wrong)
    found = returns(dataset)
    assert len(found.start) > 5 and (found.end - found.start > 450).all()          # poses, of 5 m
    assert np.diff(found.end).min() == 10                                  # every frame is asked
    assert_allclose(found.discrepancies(truth.poses), 0, atol=1e-8)


def test_a_drive_without_markers_or_that_goes_nowhere_again_has_no_returns():
    dataset, truth = simulate("short", 3)
    for each in (dataset.without("aruco"), dataset.first(700), dataset.first(1)):
        found = returns(each)
        assert found.discrepancies(truth.poses).shape == (0, 3)
        assert found.covariance.shape == (0, 3, 3)


def test_the_covariance_of_returns_is_consistent():
    """The last return of each of 30 drives, so that they are independent."""
    drives = [simulate("short", seed, slip=3e-3) for seed in range(30)]
    found = [(each.discrepancies(truth.poses), each.covariance)
             for each, truth in ((returns(dataset), truth) for dataset, truth in drives)]
    low, high = nees_band(len(found))
    assert low < np.mean([nees(off, C, 0 * off)[-1] for off, C in found]) < high
