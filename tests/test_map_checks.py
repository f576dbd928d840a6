from dataclasses import replace

import numpy as np
import pytest

from slamlib import evaluation, se2
from slamlib.checks import map_checks
from slamlib.simulation import simulate
from slamlib.slam.measurements import measure
from slamlib.slam.pipeline import fit_from_odometry

SEEDS = range(20)


def fit_of(dataset):
    return fit_from_odometry(measure(dataset))


def test_degrees_of_freedom_are_those_of_the_dense_matrices():
    dataset, _ = simulate("short", 2, late_ranges=0.1)
    fit = fit_of(dataset.first(400))
    markers, antennas = map_checks.residuals_by_landmark(fit)
    m, equations = fit.problem.measurements, fit.equations
    H, border, *_ = equations.sums(fit.problem.noise)
    H, n = m.structure.matrix(H).toarray(), len(m.structure.diagonal)
    C = np.linalg.inv(np.block([[H, border[:n, :-1]], [border[:n, :-1].T, border[n:, :-1]]]))
    poses, _, ranges = equations.linearized
    for f, (_, rows), found in ((poses, m.factor_places[1], markers),
                                (ranges, m.factor_places[3], antennas)):
        J, rows = f.J, rows[f.index]
        taken = np.array([np.trace(j @ C[np.ix_(r, r)] @ j.T) for j, r in zip(J, rows)])
        label = f.landmark - f.landmark.min()
        expected = 3 if f is poses else \
            map_checks.consistency_factor(fit.problem.accepted.range_kernel)
        dof = np.bincount(label, expected * f.weight - taken)
        np.testing.assert_allclose(found.dof, dof, rtol=1e-5)
        np.testing.assert_allclose(found.chi2, np.bincount(label, np.sum(f.e**2, axis=1)))
    assert 0 < antennas.dof.sum() < np.sum(ranges.weight) < (dataset.uwb.pose < 400).sum()


@pytest.mark.slow
def test_residuals_of_right_drives_are_within_their_bands():
    chi2, dof, outside, count = np.zeros(4)
    for seed in SEEDS:
        dataset, _ = simulate("short", seed)
        for each in map_checks.residuals_by_landmark(fit_of(dataset)):
            band = np.array([evaluation.nees_band(1, nu, 0.99) for nu in each.dof])
            outside += np.sum((each.chi2 < band[:, 0]) | (each.chi2 > band[:, 1]))
            chi2, dof, count = chi2 + each.chi2.sum(), dof + each.dof.sum(), count + len(band)
    assert 0.98 < chi2 / dof < 1.02
    assert outside / count < 0.03


def test_a_marker_with_larger_errors_than_stated_stands_out():
    dataset, _ = simulate("short", 4)
    aruco = dataset.aruco
    marker = np.bincount(aruco.marker).argmax()
    smaller = np.where(aruco.marker == marker, 4.0, 1.0)[:, None, None]
    fit = fit_of(replace(dataset, aruco=replace(aruco, covariance=aruco.covariance / smaller)))
    found, _ = map_checks.residuals_by_landmark(fit)
    above = found.chi2 > [evaluation.nees_band(1, nu, 0.9999)[1] for nu in found.dof]
    assert fit.problem.measurements.marker[above].tolist() == [marker]


def maps_of(dataset, truth):
    return [map_checks.estimated_map(each) for each in map_checks.halves(dataset, truth.poses)]


def test_halves_are_the_drive_in_two_frames():
    dataset, truth = simulate("short", 1)
    first, second = map_checks.halves(dataset, truth.poses)
    assert len(first.ticks) + len(second.ticks) == len(dataset.ticks)
    assert not second.ticks[0].any() and (second.ticks[1:] == dataset.ticks[1001:]).all()
    for whole, *parts in zip((dataset.aruco, dataset.uwb), (first.aruco, first.uwb),
                             (second.aruco, second.uwb)):
        np.testing.assert_array_equal(whole.pose, np.concatenate(
            [parts[0].pose, parts[1].pose + 1000]))
    back = se2.compose(truth.poses[1000], np.pad(second.antenna_guess.position, ((0, 0), (0, 1))))
    np.testing.assert_allclose(back[:, :2], dataset.antenna_guess.position, atol=1e-12)
    assert map_checks.halves(replace(dataset, aruco=dataset.first(900).aruco, uwb=None,
                                     antenna_guess=None), truth.poses)[1].aruco is None


def test_maps_of_both_halves_coincide_without_noise():
    one, other = maps_of(*simulate("short", 1, noise=False))
    found = map_checks.compare_maps(one, other)
    assert len(found.marker) > 3 and len(found.antenna) == 4
    # The correction of the kernel is for Gaussian noise: 0.08 sigma, at the smallest noise factor.
    np.testing.assert_allclose(found.distance, 0, atol=1e-4)
    assert found.chi2 < 0.05


def test_two_antennas_compare_by_their_distance():
    """Each distance has the variance 2 s^2, so their difference, 0.3 m, has 4 s^2."""
    s = 0.1
    C = s**2 * np.eye(4).reshape(2, 2, 2, 2)
    one = map_checks.Map(np.zeros(0, int), np.array([4, 7]), np.array([[0.0, 0], [3, 4]]), C)
    other = replace(one, place=np.array([[1.0, 1], [6.3, 1]]))
    found = map_checks.compare_maps(one, other)
    assert found.dof == 1
    np.testing.assert_allclose(found.chi2, 0.3**2 / (4 * s**2))
    np.testing.assert_allclose(found.distance, 0.15)
    assert map_checks.compare_maps(one, replace(other, antenna=np.array([4, 8]))) is None


def test_chi_squared_of_a_landmark_is_what_it_adds_to_that_of_the_others():
    one, other = maps_of(*simulate("short", 5))
    found = map_checks.compare_maps(one, other)
    assert found.dof == 2 * (len(found.marker) + len(found.antenna)) - 3
    for kind, ids, each in (("marker", found.marker, found.squared),
                            ("antenna", found.antenna, found.squared[len(found.marker):])):
        other_ids = getattr(other, kind).copy()
        other_ids[np.searchsorted(other_ids, ids[-1]):] += 1000             # as if not common
        kept = map_checks.compare_maps(one, replace(other, **{kind: other_ids}))
        lost = [j for j in ids if j not in getattr(kept, kind)]
        assert lost == [ids[-1]]
        np.testing.assert_allclose(found.chi2 - kept.chi2, each[len(ids) - 1], rtol=0.05)


@pytest.mark.slow
def test_differences_of_both_halves_are_chi_squared():
    chi2, dof = 0.0, 0
    for seed in SEEDS:
        found = map_checks.compare_maps(*maps_of(*simulate("short", seed, slip=2e-3)))
        chi2, dof = chi2 + found.chi2, dof + found.dof
    low, high = evaluation.nees_band(1, dof, 0.99)
    assert low < chi2 < high


@pytest.mark.slow
def test_a_marker_that_was_moved_between_the_halves_stands_out():
    dataset, truth = simulate("short", 5)
    aruco = dataset.aruco
    marker = map_checks.compare_maps(*maps_of(dataset, truth)).marker[0]
    late = (aruco.marker == marker) & (aruco.pose >= 1000)
    z = aruco.marker_in_vehicle.copy()
    z[late, :2] += (se2.rotation(-truth.poses[aruco.pose[late], 2]) @ [0.05, 0])
    moved = replace(dataset, aruco=replace(aruco, marker_in_vehicle=z))
    found = map_checks.compare_maps(*maps_of(moved, truth))
    assert found.marker[found.squared.argmax()] == marker
    assert found.chi2 > 2 * evaluation.nees_band(1, found.dof, 0.9999)[1]


def test_a_wrong_label_alone_makes_no_landmark():
    """A marker that a half sees only under wrong labels is not compared."""
    dataset, truth = simulate("short", 7, mislabelled=0.02)
    found = map_checks.compare_maps(*maps_of(dataset, truth))
    assert found.distance[:len(found.marker)].max() < 0.3
    few = replace(dataset, aruco=dataset.aruco.select(np.arange(2)), uwb=None)
    assert len(map_checks.estimated_map(few).marker) == 0


def test_a_drive_without_landmarks_has_an_empty_map():
    dataset, truth = simulate("short", 1)
    one, other = maps_of(replace(dataset, aruco=None, uwb=None), truth)
    assert one.place.shape == (0, 2) and one.covariance.shape == (0, 2, 0, 2)
    assert map_checks.compare_maps(one, other) is None
