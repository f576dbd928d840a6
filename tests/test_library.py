"""As a library: one setting of kernel and gate, and GTSAM factors of one's own."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, C, L, X
from numeric import known_noise

from slamlib import as_gtsam, estimate, fuse, fuse_increments, localize
from slamlib.core import se2
from slamlib.core.errors import DatasetError
from slamlib.core.evaluation import anees, ate
from slamlib.core.kernels import KERNELS
from slamlib.io.dataset import read_dataset
from slamlib.robust.measurements import measure
from slamlib.robust.pipeline import fit_from_odometry
from slamlib.robust.result import slam_result
from slamlib.robust.solution_doubts import solution_doubts
from slamlib.studies.simulation import simulate, write_dataset

SIGMA, COVARIANCE = gtsam.noiseModel.Isotropic.Sigma, gtsam.noiseModel.Gaussian.Covariance


@pytest.fixture(scope="module")
def drive():
    return simulate("short", seed=3)


@pytest.mark.parametrize("function", [
    as_gtsam, fuse, fuse_increments, localize])
def test_what_is_of_another_type_is_told(function):
    """`estimate`'s arguments are in test_slam."""
    with pytest.raises(DatasetError, match=f"{function.__name__}: expected a.*, found 'drive'"):
        function("drive")


def test_a_result_is_shown_in_five_lines(drive):
    found = estimate(known_noise(drive[0].first(100), 1e-3))
    lines = repr(found).splitlines()
    assert len(lines) == 5 and max(map(len, lines)) < 100
    assert lines[0].startswith("SlamResult of 100 poses, mean sigma ")
    assert lines[2] == f"  4 antennas, {len(found.doubts)} in doubt, 20 ranges"
    assert lines[4] == "  released from vehicle.toml: nothing"


# Kernel and gate.


def test_the_library_heeds_kernel_and_gate_of_vehicle_toml(tmp_path):
    """As it heeds the options of `estimate`."""
    dataset, truth = simulate("short", seed=4, late_ranges=0.05)
    write_dataset(tmp_path / "drive", known_noise(dataset.first(400), 1e-3),
                  replace(truth, poses=truth.poses[:400]))
    plain = read_dataset(tmp_path / "drive")
    with open(tmp_path / "drive" / "vehicle.toml", "a") as file:
        file.write('kernel = "Huber"\ngate = false\n')
    stated = read_dataset(tmp_path / "drive")
    found, same, default, again = (estimate(data, **options) for data, options in (
        (stated, {}), (plain, {"kernel": "Huber", "gate": False}), (plain, {}),
        (stated, {"kernel": "asymmetric Tukey", "gate": True})))
    np.testing.assert_array_equal(found.poses, same.poses)
    np.testing.assert_array_equal(again.poses, default.poses)
    assert (found.range_weight > 0).all() and not (default.range_weight > 0).all()
    assert found.fit.problem.accepted.sightings.kernel is KERNELS["Huber"]


# Factors of one's own.


def compass(truth, sigma, every, seed=0):
    """Headings of the poses, every so many, with Gaussian errors, as factors."""
    graph, rng = gtsam.NonlinearFactorGraph(), np.random.default_rng(seed)
    for i in range(every, len(truth.poses), every):
        graph.add(gtsam.PoseRotationPrior2D(
            X(i), gtsam.Rot2(truth.poses[i, 2] + sigma * rng.normal()), SIGMA(1, sigma)))
    return graph


def test_measurements_as_factors_of_ones_own_are_those_of_the_files(drive):
    """Without a kernel, every third range and sighting as a factor is the one that it was."""
    vehicle = replace(drive[0].vehicle, kernel="quadratic", gate=False)
    whole = known_noise(replace(drive[0].first(600), vehicle=vehicle), 1e-3)
    own, uwb, aruco = gtsam.NonlinearFactorGraph(), whole.uwb, whole.aruco
    ranges, seen = (np.arange(len(each.pose)) % 3 == 1 for each in (uwb, aruco))
    for i, k, distance, sigma in zip(*(each[ranges].tolist() for each in vars(uwb).values())):
        own.add(gtsam.RangeFactor2D(X(i), A(k), distance, SIGMA(1, sigma)))
    for i, j, z, C_vehicle in zip(*(each[seen] for each in vars(aruco).values())):
        own.add(gtsam.BetweenFactorPose2(X(i), L(j), gtsam.Pose2(*z), COVARIANCE(
            se2.rotate_covariance(C_vehicle, -z[2]))))
    part = replace(whole, uwb=uwb.select(~ranges), aruco=aruco.select(~seen))
    expected, found, without = (slam_result(fit_from_odometry(measure(data, own=graph)))
                                for data, graph in ((whole, None), (part, own), (part, None)))
    for place in ("poses", "marker_in_world", "antenna_in_world"):
        np.testing.assert_allclose(getattr(found, place), getattr(expected, place), atol=1e-5)
    assert np.abs(without.poses - expected.poses).max() > 1e-4             # as they do count
    sure = ~np.isin(expected.antenna, [*expected.doubts])      # in doubt by the ranges of the file
    assert np.count_nonzero(sure) == 3
    for name, rows in (("covariances", ...), ("marker_covariance", ...), (
            "antenna_covariance", sure)):
        C_world = getattr(expected, name)[rows]
        np.testing.assert_allclose(
            getattr(found, name)[rows], C_world, rtol=1e-3, atol=1e-3 * C_world.max())


def test_the_whole_graph_in_gtsam_has_the_solution_and_its_covariances(drive):
    """Odometry and calibration included, and factors of one's own, of poses between frames too."""
    dataset, truth = drive[0].first(300), replace(drive[1], poses=drive[1].poses[:300])
    own = compass(truth, 0.003, 33)
    own.add(gtsam.BetweenFactorPose2(X(30), X(33), gtsam.Pose2(
        *se2.between(truth.poses[30], truth.poses[33])), SIGMA(3, 1e-3)))
    found = estimate(known_noise(dataset, 1e-3), factors=own)
    graph, values = as_gtsam(found)
    assert values.exists(C(0)) and values.exists(X(33)) and not values.exists(X(34))
    moved, marginals = gtsam.GaussNewtonOptimizer(graph, values).optimize(), gtsam.Marginals(
        graph, values)
    pose = moved.atPose2(X(299))
    np.testing.assert_allclose([pose.x(), pose.y()], found.poses[-1, :2], atol=1e-6)
    for key, C_world, heading in (
            (X(299), found.covariances[-1], found.poses[-1, 2]),
            (L(int(found.marker[0])), found.marker_covariance[0], found.marker_in_world[0, 2]),
            (A(int(found.antenna[0])), found.antenna_covariance[0], None)):
        expected = marginals.marginalCovariance(key)
        expected = expected if heading is None else se2.rotate_covariance(expected, heading)
        np.testing.assert_allclose(C_world, expected, rtol=1e-3, atol=1e-3 * expected.max())


@pytest.mark.parametrize("factor, told", [
    (gtsam.BetweenFactorPose2(X(3), X(40), gtsam.Pose2(), SIGMA(3, 0.1)), "one.* 0.* x3, x40"),
    *((gtsam.PriorFactorPose2(key, gtsam.Pose2(), SIGMA(3, 0.1)), f"one variable.*, found {name}")
      for key, name in ((L(10**6), "l1000000"), (X(5000), "x5000"), (C(0), "c0"), (7, "7"))),
    (gtsam.GPSFactor(X(3), np.zeros(3), SIGMA(3, 0.1)), "one of gtsam.Pose2 .*, found GPSFactor"),
    (gtsam.PoseTranslationPrior2D(X(3), [np.nan, 0], SIGMA(2, 0.1)), "finite numbers in factor 0")])
def test_factors_that_the_graph_cannot_have_are_refused(drive, factor, told):
    own = gtsam.NonlinearFactorGraph()
    own.add(factor)
    with pytest.raises(DatasetError, match=f"^factors: expected (in factor 0 )?{told}$"):
        estimate(known_noise(drive[0].first(100), 1e-3), factors=own)


def test_odometry_and_a_compass_alone_are_a_problem(drive):
    """Neither markers nor ranges; the covariances are right in a wide band."""
    dataset, truth = drive
    alone = known_noise(replace(dataset, aruco=None, uwb=None), 1e-3)
    before, after = (estimate(alone, factors=own) for own in (None, compass(truth, 0.01, 20)))
    assert ate(after.poses, truth.poses) < ate(before.poses, truth.poses) / 2
    assert 0.3 < anees(after.poses, after.covariances, truth.poses) < 10


def gps(truth, every, moved, model=None, seed=0):
    """Places of the poses, every so many, with errors of 5 cm, `moved`, as factors."""
    graph, rng = gtsam.NonlinearFactorGraph(), np.random.default_rng(seed)
    for i in range(every, len(truth.poses), every):
        place = truth.poses[i, :2] + 0.05 * rng.normal(size=2)
        graph.add(gtsam.PoseTranslationPrior2D(X(i), moved(place), model or SIGMA(2, 0.05)))
    return graph


def test_a_factor_that_contradicts_the_rest_is_named(drive):
    """A place one metre off: the solution bends to it, unless its noise model is robust."""
    dataset, truth = known_noise(drive[0].first(600), 1e-3), drive[1]
    truth, far = replace(truth, poses=truth.poses[:600]), truth.poses[300, :2]
    robust = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), SIGMA(2, 0.05))
    for wrong, model, named in ((0, None, []), (1, None, ["own-factors"]), (1, robust, [])):
        own = gps(truth, 150, lambda place, wrong=wrong: place + wrong * np.array(
            [np.hypot(*(place - far)) < 0.3, 0]), model)
        doubts = solution_doubts(estimate(dataset, factors=own))
        assert [each.what for each in doubts if each.what == "own-factors"] == named
        assert all("1 of 3 factors" in each.sentence and "factor 1 by " in each.sentence
                   for each in doubts if each.what in named)


@pytest.mark.parametrize("turn, shift", [(np.pi / 2, 3.0), (0.1, 0.0)])
def test_factors_in_another_frame_are_the_first_doubt(drive, turn, shift):
    """GPS of 5 cm by its own axes and origin: what it does to wheels and slip comes later."""
    dataset, truth = drive[0].without("uwb"), drive[1]
    own = gps(truth, 100, lambda place: se2.rotation(turn) @ place + [shift, 0])
    first, *_ = solution_doubts(estimate(dataset, factors=own))
    assert first.what == "own-factors" and "frame of pose 1" in first.sentence
    if turn > 1:
        assert first.sentence.startswith("19 of 19 factors of your own contradict the rest")
