"""Problem 4: ranges to antennas in the graph."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, X

from numeric import central_differences
from slamlib import factors, initial, montecarlo, plaza, slam
from slamlib.dataset import AntennaGuess, Dataset, UwbReadings, Vehicle
from slamlib.evaluation import align, ate, nees_band
from slamlib.graph import State
from slamlib.odometry import dead_reckoning
from slamlib.se2 import compose
from slamlib.simulation import manoeuvre, simulate
from slamlib.solve import problem4

# A vehicle that knows its own motion: what is left is the geometry of the ranges.
SURE = Vehicle(sigma_right_radius=1e-9, sigma_left_radius=1e-9, sigma_wheelbase=1e-9, sigma_heading=1e-9,
               ticks_per_revolution=1e9)


def drive(legs, place, guess, every=10, sigma=0.05, antenna=7):
    """Exact ranges to one antenna from every `every`-th pose of a drive whose path is known."""
    ticks = np.rint(manoeuvre(legs, SURE)).astype(int)
    poses = dead_reckoning(ticks, SURE, model="arc")
    at = np.arange(0, len(poses), every)
    r = np.hypot(*(poses[at, :2] - place).T)
    uwb = UwbReadings(at, np.full(len(at), antenna), r, np.full(len(at), sigma))
    return Dataset("drive", SURE, ticks, None, uwb, AntennaGuess(np.array([antenna]), np.array([guess]))), poses


def test_derivatives_against_central_differences():
    rng = np.random.default_rng(0)
    pose, place = rng.normal(0, 2, (50, 3)), rng.normal(0, 5, (50, 2))

    def moved(xi):
        rows = [gtsam.Pose2(*p).retract(xi) for p in pose]
        return np.array([[p.x(), p.y(), p.theta()] for p in rows])

    for error, z in ((factors.range_error, rng.uniform(1, 9, 50)), (factors.point_error, rng.normal(size=(50, 2)))):
        e, by_pose, by_place = error(z, pose, place)
        shape = by_pose.shape[:2]
        numeric = central_differences(lambda xi: error(z, moved(xi), place)[0], np.zeros(3))
        np.testing.assert_allclose(by_pose, numeric.reshape(*shape, 3), atol=1e-7)
        numeric = central_differences(lambda step: error(z, pose, place + step)[0], np.zeros(2))
        np.testing.assert_allclose(by_place, numeric.reshape(*shape, 2), atol=1e-7)


def test_range_error_is_gtsams_range_factor():
    rng = np.random.default_rng(1)
    pose, place, r = rng.normal(0, 2, (20, 3)), rng.normal(0, 5, (20, 2)), rng.uniform(1, 9, 20)
    e, by_pose, by_place = factors.range_error(r, pose, place)
    for i in range(20):
        native = gtsam.RangeFactor2D(X(0), A(0), r[i], gtsam.noiseModel.Unit.Create(1))
        values = gtsam.Values()
        values.insert(X(0), gtsam.Pose2(*pose[i]))
        values.insert(A(0), gtsam.Point2(*place[i]))
        J, b = native.linearize(values).jacobian()
        np.testing.assert_allclose(J, np.concatenate([by_pose[i], by_place[i]], axis=1), atol=1e-12)
        np.testing.assert_allclose(b, [-e[i]], atol=1e-12)


def test_one_sigma_costs_one_half():
    dataset, poses = drive([(2.0, 1.0)], np.array([3.0, 4.0]), (3.0, 4.0))
    graph = slam.Graph(dataset, "arc")
    state = State(poses[graph.frame], np.zeros((0, 3)), np.array([[3.0, 4.0]]), np.zeros(3))
    off = graph.native().graph.error(graph.values(state))
    graph.range = graph.range + graph.sigma
    assert off < 1e-12
    assert np.isclose(graph.native().graph.error(graph.values(state)), len(graph.range) / 2)


@pytest.mark.parametrize("name", ["asymmetric Cauchy", "asymmetric Tukey"])
def test_one_sided_kernels_forgive_late_ranges_only(name):
    """GTSAM takes the sign of measured minus expected, if components are weighed."""
    kernel = slam.RANGES[name][0]
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose2(0, 0, 0))
    values.insert(A(0), gtsam.Point2(8, 0))
    noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(1, 0.1))
    early, late = (gtsam.RangeFactor2D(X(0), A(0), r, noise) for r in (7.5, 8.5))
    assert np.isclose(early.error(values), 12.5) and late.error(values) < 5
    assert np.isclose(early.linearize(values).jacobian()[1][0]**2, 25)
    assert late.linearize(values).jacobian()[1][0]**2 < 5


def test_antenna_from_known_poses_by_hand():
    """Poses known: information sum of u u^T / sigma^2 over the directions u, and the guess's."""
    place = np.array([2.0, 5.0])
    dataset, poses = drive([(4.0, 2.0), (3.0, -1.0)], place, (2.5, 4.0))
    found = slam.solve(dataset, 1e-5, "arc")
    u = place - poses[dataset.uwb.pose, :2]
    u /= np.hypot(*u.T)[:, None]
    expected = np.linalg.inv(u.T @ u / 0.05**2 + np.eye(2) / 5.0**2)
    np.testing.assert_allclose(found.antenna_in_world[0], place, atol=2e-5)    # pulled by the guess
    np.testing.assert_allclose(found.antenna_covariance[0], expected, rtol=1e-2, atol=1e-2 * expected.max())
    assert not found.doubts and (found.range_weight > 0.999).all()


@pytest.mark.parametrize("markers", [True, False])
def test_perfect_data_gives_the_exact_answer(markers):
    dataset, truth = simulate("short", seed=1, noise=False)
    dataset = dataset if markers else dataset.without("aruco")
    found = slam.solve(dataset, 1e-3, "arc")
    np.testing.assert_allclose(found.poses, truth.poses, atol=1e-9)
    np.testing.assert_allclose(found.antenna_in_world, truth.antenna_in_world, atol=1e-9)


def test_after_problem_3_is_the_same_as_from_odometry():
    dataset, _ = simulate("short", seed=5, late_ranges=0.15)
    before = slam.solve(dataset.without("uwb"))
    after, alone = slam.solve(dataset, after=before), slam.solve(dataset)
    sigma = np.sqrt(np.diagonal(alone.covariances, axis1=1, axis2=2))
    assert (np.abs(after.poses - alone.poses) < 0.05 * sigma + 1e-6).all()
    np.testing.assert_allclose(after.antenna_in_world, alone.antenna_in_world, atol=1e-3)


def consistent(runs, names, count):
    """The means lie in their bands, all together with 95 % (Bonferroni)."""
    for name in names:
        low, high = nees_band(count, 2 if name == "antenna nees" else 3, 1 - 0.05 / len(names))
        assert low < runs[name].mean() < high, (name, runs[name].mean(), low, high)


@pytest.mark.parametrize("options", [dict(), dict(late_ranges=0.15)])
def test_monte_carlo_is_consistent(options):
    """50 seeds each: NEES of poses, poses between, map, antennas and wheels in their bands."""
    runs = montecarlo.run(montecarlo.problem4, range(700, 750), **options)
    consistent(runs, ("nees", "nees between", "map nees", "antenna nees", "wheel nees"), 50)
    assert runs["ate"].max() < 0.05 and runs["antenna error"].max() < 0.15 and runs["doubts"].sum() == 0


def test_ranges_alone_are_consistent_though_they_say_little_of_the_slip():
    runs = montecarlo.run(montecarlo.problem4, range(800, 850), markers=False, late_ranges=0.15)
    consistent(runs, ("nees", "last nees", "antenna nees", "wheel nees"), 50)
    assert np.sqrt(np.mean(runs["ate"]**2)) < 0.06


def test_the_kernel_is_the_one_of_least_antenna_error_where_antennas_are_known_best(as_in_a_notebook):
    """30 % late, with markers: less than any symmetric way, and not more than the one-sided gate."""
    runs = montecarlo.run(montecarlo.kernels, range(8), late_ranges=0.3)
    rms = {way: np.sqrt(np.mean(runs[f"{way} antenna error"]**2)) for way in slam.RANGES}
    default = rms["asymmetric Tukey"]
    assert all(default < rms[way] for way in ("quadratic", "Huber", "Cauchy", "gate", "GNC"))
    assert default < 1.05 * rms["asymmetric gate"]
    low, high = nees_band(8, 2, 0.999)
    assert low < runs["asymmetric Tukey antenna nees"].mean() < high < runs["Huber antenna nees"].mean()


def test_late_ranges_alone_are_survived_by_the_kernel(as_in_a_notebook):
    """15 % late, without markers: better than kernels that never let go, and honest."""
    runs = montecarlo.run(montecarlo.kernels, range(8), markers=False, late_ranges=0.15)
    rms = {way: np.sqrt(np.mean(runs[f"{way} antenna error"]**2)) for way in slam.RANGES}
    default = rms["asymmetric Tukey"]
    assert default < rms["Cauchy"] and 1.05 * default < rms["Huber"] and 3 * default < rms["quadratic"]
    assert runs["asymmetric Tukey nees"].mean() < 6 < runs["quadratic nees"].mean()


def test_late_ranges_are_the_ones_down_weighted():
    dataset, truth = simulate("short", seed=9, late_ranges=0.15)
    found = slam.solve(dataset)
    antenna = np.searchsorted(truth.antenna, dataset.uwb.antenna)
    true_range = np.hypot(*(truth.poses[dataset.uwb.pose, :2] - truth.antenna_in_world[antenna]).T)
    off = (dataset.uwb.range - true_range) / dataset.uwb.sigma
    assert (found.range_weight[off > 6] < 0.1).all() and (off > 6).sum() > 20
    assert found.range_weight[np.abs(off) < 1.5].min() > 0.5


def test_bad_guesses_are_recovered_or_doubted():
    runs = montecarlo.run(montecarlo.guesses, range(8), error=10.0)
    assert runs["right"].mean() > 0.95 and runs["silently wrong"].sum() == 0


def test_a_guess_on_the_wrong_side_of_a_bent_path_is_recovered():
    place = np.array([3.0, 4.0])
    dataset, _ = drive([(3.0, 0.0), (2.0, 1.0), (3.0, 0.0)], place, (3.0, -4.0))
    found = slam.solve(dataset, 1e-5, "arc")
    np.testing.assert_allclose(found.antenna_in_world[0], place, atol=1e-3)
    assert not found.doubts


def test_on_a_straight_path_the_other_side_is_as_good_and_that_is_said():
    place = np.array([3.0, 4.0])
    for guess in (1.0, -1.0):
        dataset, _ = drive([(6.0, 0.0)], place, (2.5, 3.0 * guess))
        found = slam.solve(dataset, 1e-5, "arc")
        np.testing.assert_allclose(found.antenna_in_world[0], [3.0, guess * 4.0], atol=1e-2)
        assert "as well at" in found.doubts[7] and f"{-guess * 4.0:.1f}" in found.doubts[7]


@pytest.mark.parametrize("count, reason", [(1, "only 1 of"), (2, "only 2 of"), (4, "only 4 of")])
def test_few_ranges_leave_a_wide_covariance_and_a_sentence(count, reason):
    dataset, _ = drive([(4.0, 2.0), (3.0, -1.0)], np.array([2.0, 5.0]), (2.5, 4.5))
    few = np.linspace(0, len(dataset.uwb.pose) - 1, count).astype(int)
    dataset = replace(dataset, uwb=UwbReadings(*(values[few] for values in vars(dataset.uwb).values())))
    found = slam.solve(dataset, 1e-5, "arc")
    assert reason in found.doubts[7]
    largest = np.sqrt(np.linalg.eigvalsh(found.antenna_covariance[0])[-1])
    assert largest > (2 if count == 1 else 0.15)
    error = found.antenna_in_world[0] - np.array([2.0, 5.0])
    assert error @ np.linalg.solve(found.antenna_covariance[0], error) < 9.2      # 99 %


def test_ranges_from_one_place_say_so():
    """A vehicle that stands still: a circle of places."""
    uwb = UwbReadings(np.zeros(50, int), np.full(50, 7), np.full(50, 5.0), np.full(50, 0.05))
    dataset = Dataset("still", SURE, np.zeros((1, 2), int), None, uwb,
                      AntennaGuess(np.array([7]), np.array([[3.0, 4.0]])))
    found = slam.solve(dataset, 1e-5, "arc")
    assert 7 in found.doubts and np.linalg.eigvalsh(found.antenna_covariance[0])[-1] > 4


def test_a_long_stand_still_is_solved():
    """2,000 rows of zeros, noisy ranges to four antennas: nothing but distances is learned."""
    rng = np.random.default_rng(0)
    place = np.array([[5.0, 1.0], [-3.0, 4.0], [-1.0, -5.0], [2.0, 6.0]])
    pose, antenna = np.repeat(np.arange(0, 2000, 20), 4), np.tile(np.arange(4), 100)
    ranges = np.hypot(*place[antenna].T) + rng.normal(0, 0.05, 400)
    dataset = Dataset("still", Vehicle(), np.zeros((2000, 2), int), None,
                      UwbReadings(pose, antenna, ranges, np.full(400, 0.05)),
                      AntennaGuess(np.arange(4), place + 0.3))
    found = slam.solve(dataset)
    assert np.abs(found.poses).max() < 0.01 and set(found.doubts) == {0, 1, 2, 3}
    np.testing.assert_allclose(np.hypot(*found.antenna_in_world.T), np.hypot(*place.T), atol=0.05)


def test_antennas_of_short_bends_are_not_silently_wrong():
    """The first 400 poses, late ranges, bad guesses: who is wrong is in doubt or within the ellipse."""
    for options in (dict(late_ranges=0.15, error=2.0, poses=400, markers=False),
                    dict(late_ranges=0.3, error=5.0, poses=800)):
        runs = montecarlo.run(montecarlo.guesses, range(3000, 3010), **options)
        assert runs["silently wrong"].sum() == 0


def test_a_covariance_covers_what_few_ranges_leave_open():
    """First few ranges to one antenna, over many seeds: the error is within the reported covariance."""
    squared = []
    for seed in range(8):
        dataset, truth = simulate("short", seed, late_ranges=0.15)
        uwb, last = dataset.uwb, truth.antenna[-1]
        of_last = np.cumsum(uwb.antenna == last)
        keep = (uwb.antenna != last) | (of_last <= 5)
        dataset = replace(dataset, uwb=UwbReadings(*(values[keep] for values in vars(uwb).values())))
        found = slam.solve(dataset, 1e-3, "arc")
        error = found.antenna_in_world[-1] - truth.antenna_in_world[-1]
        assert int(last) in found.doubts
        squared.append(error @ np.linalg.solve(found.antenna_covariance[-1], error))
    assert np.mean(squared) < nees_band(8, 2, 0.999)[1]


def test_places_finds_both_sides():
    path = np.column_stack([np.linspace(0, 6, 30), np.zeros(30)])
    r = np.hypot(*(path - [3.0, 4.0]).T)
    place, cost = initial.places(path, r, np.full(30, 0.05), np.array([2.0, 3.0]))
    np.testing.assert_allclose(place[:2], [[3, 4], [3, -4]], atol=1e-3)
    assert cost[0] == 0 and 0 < cost[1] < initial.UNDECIDED


def test_problem_4_says_what_was_down_weighted():
    dataset, _ = simulate("short", seed=9, late_ranges=0.15)
    solution = problem4(dataset)
    weak = solution.facts["ranges_down_weighted_by_antenna"]
    assert weak.keys() == set(dataset.antenna_guess.antenna.tolist())
    assert 0.08 < sum(weak.values()) / solution.facts["ranges"] < 0.2
    assert solution.title == "SLAM: odometry + ArUco + UWB" and solution.uwb_map[1].shape == (4, 2)
    assert problem4(dataset.without("aruco")).aruco_map is None


def test_plaza_2():
    dataset, truth = plaza.read_plaza2()
    found = slam.solve(dataset)
    motion = align(found.poses, truth.poses)
    beacons = compose(motion, np.column_stack([found.antenna_in_world, np.zeros(4)]))[:, :2]
    assert ate(found.poses, truth.poses, aligned=True) < 0.35
    assert np.hypot(*(beacons - truth.antenna_in_world).T).max() < 0.15
    assert not found.doubts and dataset.ticks.shape == (4091, 2)
