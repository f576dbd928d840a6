from dataclasses import replace

import numpy as np
import pytest

from slamlib import odometry, se2, slam
from slamlib.dataset import ArucoReadings, Dataset
from slamlib.evaluation import anees, ate, nees_band
from slamlib.localization import fuse, fuse_increments, fused, localize
from slamlib.sightings import GATE
from slamlib.simulation import TABLE_2, simulate
from slamlib.slam import result


def test_sections_of_a_drive_have_no_seams(monkeypatch):
    dataset, _ = simulate("short", seed=3)
    dataset = only(dataset.first(600), dataset.first(600).aruco.pose < 500)    # odometry at the end
    whole = slam.estimate(dataset, slip=1e-3, model="arc")
    monkeypatch.setattr(result, "FRAMES_AT_ONCE", 7)
    sections = slam.estimate(dataset, slip=1e-3, model="arc")
    np.testing.assert_allclose(sections.poses, whole.poses, atol=1e-10)
    np.testing.assert_allclose(sections.covariances, whole.covariances, rtol=1e-7, atol=1e-14)


def only(dataset, keep):
    return replace(dataset, aruco=dataset.aruco.select(keep))


def test_without_odometry_it_is_the_localization_from_markers():
    """Slip of 1 m after 1 m, so that encoders are uninformative; one marker, while it is in view.

    The noise is a hundredth of the usual, so that second-order terms are ten thousandths.
    """
    noisy, exact = simulate("short", seed=5)[0], simulate("short", seed=5, noise=False)[0]
    difference = se2.difference(noisy.aruco.marker_in_vehicle, exact.aruco.marker_in_vehicle)
    quiet = replace(exact, vehicle=replace(exact.vehicle, sigma_heading=1e-9), aruco=replace(
        exact.aruco, marker_in_vehicle=exact.aruco.marker_in_vehicle + 0.01 * difference,
        covariance=1e-4 * exact.aruco.covariance))
    first = quiet.aruco.marker[0]
    quiet = only(quiet, (quiet.aruco.marker == first) & (quiet.aruco.pose < 700))
    alone, fused = localize(quiet.aruco), fuse(quiet, slip=1.0)
    assert len(alone.frame) > 8 and not alone.rejected.any()
    difference = se2.difference(fused.poses[alone.frame], alone.poses)
    np.testing.assert_allclose(difference, 0, atol=1e-6)
    np.testing.assert_allclose(fused.covariances[alone.frame], alone.covariances,
                               atol=1e-3 * alone.covariances.max())


def test_without_markers_it_is_the_first_order_propagation():
    """Useless sightings and counts too fine to round."""
    dataset, _ = simulate("short", seed=5)
    vehicle = replace(dataset.vehicle, ticks_per_revolution=8e9)
    useless = replace(dataset.aruco, covariance=dataset.aruco.covariance * 1e12)
    dataset = replace(dataset, vehicle=vehicle, ticks=dataset.ticks * 10**6, aruco=useless)
    poses, covariances = odometry.first_order(dataset.ticks, vehicle, model="arc")
    fused = fuse(dataset, slip=0.0)
    np.testing.assert_allclose(fused.poses, poses, atol=1e-6)
    np.testing.assert_allclose(fused.covariances, covariances, atol=1e-5 * covariances[-1].max())


@pytest.mark.slow
def test_slip_is_learned_although_the_encoder_is_coarse():
    """500 counts a revolution, a frame every 10 cm: rounding is as large as slip between frames.

    Rounding as a random walk would explain the slip: a quarter of it would be learned.
    """
    vehicle = replace(TABLE_2, ticks_per_revolution=500)
    slips = [fuse(simulate("short", seed, slip=1e-3, vehicle=vehicle)[0]).slip for seed in range(4)]
    assert 0.7e-3 < np.exp(np.mean(np.log(slips))) < 1.5e-3


def test_sightings_that_are_not_used_are_counted():
    """Five sightings moved by a metre, one that repeats another, two of a marker that contradict.

    The hint uses no sighting of a marker that no adjacent frame sees, on the clean drive either.
    """
    dataset, _ = simulate("short", seed=1, noise=False)
    a = dataset.aruco
    seen_before = {pose: next(row for row in np.flatnonzero(a.pose == pose) if a.marker[row] in
                              a.marker[a.pose == pose - 10]) for pose in range(200, 900, 100)}
    *moved, again, other = seen_before.values()
    spoilt = a.select(np.sort(np.r_[:len(a.pose), again, other]))
    spoilt.marker_in_vehicle[[*moved, other + 1], 0] += 1.0            # `again` comes before
    spoilt = replace(dataset, aruco=spoilt)
    assert fuse(dataset, slip=1e-3).rejected == 0
    assert fuse(spoilt, slip=1e-3).rejected == 5 + 1 + 2
    assert fuse_increments(spoilt).rejected == fuse_increments(dataset).rejected + 5 + 1 + 2


def test_the_likelihood_of_the_innovations_by_hand():
    """A vehicle that stands and sees one marker twice: v = z' - z is normal with C + C'.

    Beyond the gate a sighting has the density at the gate.
    """
    C = np.array([[[4e-4, 1e-4, 0], [1e-4, 9e-4, 0], [0, 0, 1e-4]],
                  [[1e-4, 0, 0], [0, 4e-4, 1e-4], [0, 1e-4, 4e-4]]])
    S = C.sum(axis=0)
    for off in ([0.02, -0.03, 0.01], [0.3, 0.0, 0.0], [0.0, 0.0, 2 * np.pi + 0.01]):
        z = np.array([[1.0, 0.5, 3.0], [1.0, 0.5, 3.0]])
        z[1] += off
        aruco = ArucoReadings(np.array([0, 5]), np.array([7, 7]), z, C)
        dataset = Dataset("still", TABLE_2, np.zeros((6, 2), int), aruco, None, None)
        state = fused._filter(fused._filter_input(dataset, TABLE_2), 1e-3)[2]
        v = np.array([*off[:2], se2.wrap(off[2])])
        squared = min(v @ np.linalg.solve(S, v), GATE)
        assert np.isclose(state.log_likelihood, -(squared + np.linalg.slogdet(S)[1]) / 2)
        assert state.rejected == (squared == GATE)


@pytest.mark.parametrize("slip", [2e-4, 5e-3])
def test_the_slip_that_is_learned_has_the_greatest_density(slip):
    """Likelihood times prior are less for slips that are 20 % larger or smaller."""
    dataset, _ = simulate("short", seed=3, slip=slip)
    given = fused._filter_input(dataset, dataset.vehicle)
    found = fused._likeliest_slip(given)
    log_density = [fused._filter(given, each)[2].log_likelihood
                   - (np.log(each / 1e-3) / np.log(3))**2 / 2
                   for each in (0.8 * found, found, 1.2 * found)]
    assert np.argmax(log_density) == 1


@pytest.mark.parametrize("propagation", [odometry.equation2, odometry.first_order])
def test_the_hint_fuses_by_information(propagation):
    """One interval: C = (C_o^-1 + C_m^-1)^-1 and Delta = C (C_o^-1 Delta_o + C_m^-1 Delta_m)."""
    dataset, _ = simulate("short", seed=6)
    sure = replace(dataset.vehicle, sigma_heading=1e-9)
    dataset = replace(only(dataset, dataset.aruco.pose <= 10), vehicle=sure)
    fused, marker = fuse_increments(dataset, propagation), localize(dataset.aruco)
    poses, covariances = propagation(dataset.ticks[:11], sure, initial_covariance=np.zeros((3, 3)))
    information = [np.linalg.inv(covariances[-1]), np.linalg.inv(marker.covariances[1])]
    C = np.linalg.inv(sum(information))
    delta = C @ (information[0] @ poses[-1] + information[1] @ marker.poses[1])
    np.testing.assert_allclose(fused.poses[10], delta, atol=1e-9)
    np.testing.assert_allclose(fused.covariances[10], C, atol=1e-6 * np.abs(C).max())
    # From there on odometry goes on alone, restarted.
    expected, expected_covariances = propagation(
        dataset.ticks[10:], sure, fused.poses[10], fused.covariances[10])
    np.testing.assert_allclose(fused.poses[10:], expected, atol=1e-12)
    np.testing.assert_allclose(fused.covariances[10:], expected_covariances, atol=1e-15)


@pytest.mark.parametrize("keep", [
    lambda a: a.pose % 200 == 0, lambda a: np.arange(len(a.pose)) == 0])
def test_without_information_on_the_slip_the_prior_decides(keep):
    """Few frames or a single sighting: NEES of the last heading over 20 drives is in its band.

    The heading only: the distribution of position and heading is not Gaussian (notebook 1).
    """
    last = []
    for seed in range(20):
        dataset, truth = simulate("short", seed=seed)
        fused = fuse(only(dataset, keep(dataset.aruco)))
        assert 1e-4 < fused.slip < 1e-2
        last.append((fused.poses[-1, 2] - truth.poses[-1, 2])**2 / fused.covariances[-1, 2, 2])
    low, high = nees_band(len(last), dof=1, probability=0.999)
    assert low < np.mean(last) < high


@pytest.mark.slow
def test_wheels_far_from_nominal_are_learned():
    """Radii wrong by 3 % with a sigma of 5 %: increments are linearised again at the estimate."""
    ratios = []
    for seed in range(6):
        dataset, truth = simulate("short", seed=seed)
        vehicle = replace(dataset.vehicle, right_radius=0.103, left_radius=0.097,
                          sigma_right_radius=5e-3, sigma_left_radius=5e-3)
        fused = fuse(replace(dataset, vehicle=vehicle))
        ratios.append(anees(fused.poses, fused.covariances, truth.poses))
        assert abs(fused.wheel[0] - truth.vehicle.right_radius) < 5e-4
        assert ate(fused.poses, truth.poses) < 0.08
    assert np.mean(ratios) < 6


def test_the_slip_and_the_factor_that_a_vehicle_gives_are_taken():
    """The slip as by the option; twice the sigmas at a factor of one half change nothing."""
    dataset = simulate("short", seed=5)[0].first(600)
    known, plain = replace(dataset, vehicle=replace(TABLE_2, slip=3e-3)), fuse(dataset)
    given, option = fuse(known), fuse(dataset, slip=3e-3)
    assert given.slip == option.slip == 3e-3 and fuse(known, slip=1e-3).slip == 1e-3
    np.testing.assert_array_equal(given.poses, option.poses)
    assert np.abs(given.poses - plain.poses).max() > 1e-6
    halved = replace(
        dataset, vehicle=replace(TABLE_2, marker_noise_factor=0.5),
        aruco=replace(dataset.aruco, covariance=4 * dataset.aruco.covariance))
    np.testing.assert_allclose(fuse(halved).poses, plain.poses, rtol=0, atol=1e-12)
    assert np.abs(fuse(replace(halved, vehicle=TABLE_2)).poses - plain.poses).max() > 1e-6
