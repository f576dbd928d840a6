from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, L, W, X

from numeric import central_differences
from slamlib import factors as factors_of
from slamlib import initial, montecarlo, slam
from slamlib.dataset import ArucoReadings, Dataset, Vehicle
from slamlib.evaluation import anees, ate, nees_band
from slamlib.graph import State
from slamlib.simulation import simulate

SEEDS = range(300, 350)


def as_rows(poses):
    return np.array([[p.x(), p.y(), p.theta()] for p in poses])


def example(seed=0):
    """Odometry factors of a drive, with graph poses and wheels off the nominal ones."""
    rng = np.random.default_rng(seed)
    dataset, truth = simulate("short", seed=3)
    frame = np.arange(0, 2000, 40)
    factors = factors_of.odometry_factors(dataset.ticks, dataset.vehicle, frame)
    poses = truth.poses[frame] + rng.normal(0, 0.05, (len(frame), 3))
    return factors, poses, rng.normal(0, 1, 3)


def test_odometry_derivatives_against_central_differences():
    factors, poses, w = example()
    e, by_first, by_second, by_w = factors_of.linearize(factors, poses, w)

    def error(xi, moved):
        """Errors when every second pose, the even or the odd ones, is retracted by xi."""
        changed = poses.copy()
        changed[moved::2] = as_rows(gtsam.Pose2(*p).retract(xi) for p in poses[moved::2])
        return factors_of.linearize(factors, changed, w)[0]

    for moved, (even, odd) in ((0, (by_first, by_second)), (1, (by_second, by_first))):
        numeric = central_differences(lambda xi: error(xi, moved), np.zeros(3))
        np.testing.assert_allclose(even[::2], numeric[::2], atol=1e-7)
        np.testing.assert_allclose(odd[1::2], numeric[1::2], atol=1e-7)
    numeric = central_differences(lambda v: factors_of.linearize(factors, poses, v)[0], w)
    np.testing.assert_allclose(by_w, numeric, atol=1e-8)


def test_odometry_factor_is_gtsams_between_factor_when_the_wheels_are_known():
    """Equal derivatives and right-hand side, far from the optimum too, and equal error."""
    factors, poses, _ = example()
    U, _ = factors.whitening(1e-3)
    e, by_first, by_second, _ = factors_of.linearize(factors, poses, np.zeros(3))
    assert np.abs(e).max() > 0.05
    for i in range(len(e)):
        # Unit noise on both sides: GTSAM may whiten by another root of the same information.
        native = gtsam.BetweenFactorPose2(0, 1, gtsam.Pose2(*factors.increment[i]),
                                          gtsam.noiseModel.Unit.Create(3))
        values = gtsam.Values()
        for k in range(2):
            values.insert(k, gtsam.Pose2(*poses[i + k]))
        A, b = native.linearize(values).jacobian()
        np.testing.assert_allclose(A, np.concatenate([by_first[i], by_second[i]], axis=1), atol=1e-9)
        np.testing.assert_allclose(b, -e[i], atol=1e-12)
        noise = factors.rounding[i] + 1e-6 * factors.slipping[i]
        native = gtsam.BetweenFactorPose2(0, 1, gtsam.Pose2(*factors.increment[i]),
                                          gtsam.noiseModel.Gaussian.Covariance(noise))
        assert np.isclose(native.error(values), np.sum((U[i] @ e[i])**2) / 2, rtol=1e-6)


def test_rounding_telescopes():
    """However many factors a drive is cut into, it is that of one difference of counts."""
    vehicle, ticks = Vehicle(), np.full((2001, 2), 127)
    count = 2 * np.pi * vehicle.right_radius / vehicle.ticks_per_revolution
    along, turned = count**2 / 6 * np.array([1 / 2, 2 / vehicle.wheelbase**2])
    for every in (1, 10, 500, 2000):
        noise = factors_of.odometry_factors(ticks, vehicle, np.arange(0, 2001, every)).rounding.sum(axis=0)
        floor = 2000 / every * factors_of.LEAST**2
        np.testing.assert_allclose([noise[0, 0] - floor, noise[2, 2]], [along, turned], rtol=1e-6)


def test_without_slip_none_is_learned():
    """20 seeds: covariances as honest as poses are accurate, compared with the slip known."""
    runs = montecarlo.run(montecarlo.learned_slips, range(3000, 3020), slip=0.0)
    low, high = nees_band(20)
    assert low < runs["nees"].mean() < high
    assert np.mean(runs["aligned"]**2) < 1.1**2 * np.mean(runs["known aligned"]**2)
    assert np.median(runs["slip"]) < 3e-5                    # m: by far less than rounding


def test_much_slip_is_learned_as_if_it_were_known():
    runs = montecarlo.run(montecarlo.learned_slips, range(3000, 3004), slip=3e-3)
    np.testing.assert_allclose(runs["slip"], 3e-3, rtol=0.3)
    np.testing.assert_allclose(runs["nees"], runs["known nees"], rtol=0.3)
    np.testing.assert_allclose(runs["aligned"], runs["known aligned"], rtol=0.05)


@pytest.mark.parametrize("slip", [3e-3, 1e-2])
def test_more_slip_than_typical_costs_no_good_sighting(slip):
    """Clean drives: hardly a sighting is left out, and the slip is learned whatever it was first."""
    runs = montecarlo.run(montecarlo.problem3, range(500, 508), slip=slip)
    assert runs["left out"].mean() < 6                       # one in a thousand of about 900 sightings
    assert 0.85 < np.exp(np.mean(np.log(runs["slip"]))) / slip < 1.15
    low, high = nees_band(8, probability=0.999)
    assert low < runs["nees"].mean() < high and runs["arc"].mean() > 0.8


def test_wheels_far_from_nominal_are_learned_honestly():
    """Radii 3 % off in opposite directions, known to 5 %, markers only from pose 300 on."""
    ratios = []
    for seed in range(6):
        vehicle = Vehicle(sigma_right_radius=5e-3, sigma_left_radius=5e-3)
        dataset, truth = simulate("short", seed=seed)
        names = ("pose", "marker", "marker_in_vehicle", "covariance")
        late = dataset.aruco.pose >= 300
        dataset = replace(dataset, vehicle=replace(vehicle, right_radius=0.103, left_radius=0.097),
                          aruco=replace(dataset.aruco, **{
                              name: getattr(dataset.aruco, name)[late] for name in names}))
        found = slam.solve(dataset.without("uwb"), 1e-3, "arc")
        error = found.wheel - truth.vehicle.wheel
        ratios.append((anees(found.poses, found.covariances, truth.poses),
                       error @ np.linalg.solve(found.wheel_covariance, error)))
    low, high = nees_band(len(ratios), probability=0.999)
    assert (np.mean(ratios, axis=0) < high).all(), (low, high, np.mean(ratios, axis=0))


def test_marginals_are_gtsams():
    dataset, _ = simulate("short", seed=4, mislabelled=0.02, late_ranges=0.2)
    found = slam.solve_graph(slam.Graph(dataset, "arc"), 1e-3)
    graph, values, late = found.graph, found.values, found.late
    U, _ = graph.factors.whitening(found.slip)
    native = graph.native(late=late, weight=found.weight)
    tree = graph.linear(values, native, U).eliminateMultifrontal()
    joint, blocks = graph.marginals(graph.state(values), U, native)
    for i in range(0, len(joint), 13):
        expected = tree.jointMarginalCovariance([X(i), X(i + 1), W(0)]).fullMatrix()
        sigma = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(joint[i] / np.outer(sigma, sigma), expected / np.outer(sigma, sigma),
                                   atol=1e-6)
    for j in range(len(graph.marker)):
        np.testing.assert_allclose(blocks[j], tree.marginalCovariance(L(j)), rtol=1e-5,
                                   atol=1e-6 * blocks[j].max())
    for k in range(len(graph.antenna)):
        np.testing.assert_allclose(blocks[len(graph.marker) + k], tree.marginalCovariance(A(k)), rtol=1e-5,
                                   atol=1e-9)
    np.testing.assert_allclose(blocks[-1], tree.marginalCovariance(W(0)), rtol=1e-5, atol=1e-7)


def test_one_sigma_costs_one_half():
    """A sighting off by d^2 = e^T C^-1 e, in the vehicle's axes as the file has it, costs d^2 / 2."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        root = rng.normal(0, 0.01, (3, 3))
        C, z = root @ root.T + 1e-6 * np.eye(3), np.array([1.0, -0.5, rng.uniform(-3, 3)])
        direction = np.linalg.cholesky(C) @ (lambda u: u / np.linalg.norm(u))(rng.normal(size=3))
        direction[2] = 0                                      # without a turn the axes stay the same
        expected = direction @ np.linalg.solve(C, direction) / 2
        readings = ArucoReadings(np.array([0]), np.array([4]), z[None], C[None])
        dataset = Dataset("one", Vehicle(), np.zeros((1, 2), int), readings, None, None)
        graph = slam.Graph(dataset, "arc")
        values = graph.values(State(np.zeros((1, 3)), [z + direction], np.zeros((0, 2)), np.zeros(3)))
        assert np.isclose(graph.native().graph.error(values), expected, rtol=1e-9)


def test_two_poses_and_one_marker_by_hand():
    """On a line with headings known: odometry says 1 m with variance q, the marker is seen from both.

    With pose 1 fixed, unknowns (x_2, m): information [[1/q + 1/r, -1/r], [-1/r, 1/r + 1/r]] with the
    variance r of a sighting, hence var x_2 = 2 r q / (2 r + q), var m = r (r + q) / (2 r + q), and with
    odometry's x_2 = o and sightings s_1, s_2: x_2 = (2 r o + q (s_1 - s_2)) / (2 r + q).
    The wheels are known too well to matter, and q is the noise of rounding and slip.
    """
    r, slip, s_1, s_2 = 4e-4, 2e-2, 2.02, 0.99
    tiny = 1e-7
    vehicle = Vehicle(sigma_right_radius=tiny, sigma_left_radius=tiny, sigma_wheelbase=tiny,
                      sigma_heading=tiny)
    ticks = np.zeros((101, 2), int)
    ticks[1:] = 127
    o = 100 * 127 * 2 * np.pi * 0.1 / 8000
    C = np.diag([r, 1e-10, 1e-12])
    readings = ArucoReadings(np.array([0, 100]), np.array([9, 9]),
                             np.array([[s_1, 0, 0], [s_2, 0, 0]]), np.array([C, C]))
    found = slam.solve(Dataset("line", vehicle, ticks, readings, None, None), slip, "arc")
    q = slip**2 * o / 2
    expected = (2 * r * o + q * (s_1 - s_2)) / (2 * r + q)
    np.testing.assert_allclose(found.poses[100, 0], expected, atol=1e-5)
    np.testing.assert_allclose(found.covariances[100, 0, 0], 2 * r * q / (2 * r + q), rtol=1e-3)
    np.testing.assert_allclose(found.marker_covariance[0, 0, 0], r * (r + q) / (2 * r + q), rtol=1e-3)


def test_perfect_data_gives_the_exact_answer():
    dataset, truth = simulate("short", seed=1, noise=False)
    found = slam.solve(dataset.without("uwb"), 1e-3, "arc")
    np.testing.assert_allclose(found.poses, truth.poses, atol=1e-9)
    seen = np.searchsorted(truth.marker, found.marker)
    np.testing.assert_allclose(found.marker_in_world, truth.marker_in_world[seen], atol=1e-9)
    np.testing.assert_allclose(found.wheel, [0.1, 0.1, 0.4], atol=1e-10)
    assert found.chi2_per_dof < 1e-9 and not found.outlier.any()


@pytest.mark.parametrize("every, sigma", [(10, 1e-4), (100, 3e-3)])
def test_poses_between_graph_poses_are_those_of_a_graph_with_all_poses(every, sigma):
    """Frames close together, and frames a metre apart with wheels that matter in between."""
    dataset, _ = simulate("short", seed=2)
    vehicle = replace(dataset.vehicle, sigma_right_radius=sigma, sigma_left_radius=sigma)
    dataset = replace(dataset, uwb=None, vehicle=vehicle, ticks=dataset.ticks[:106])
    keep = (dataset.aruco.pose <= 100) & (dataset.aruco.pose % every == 0)
    names = ("pose", "marker", "marker_in_vehicle", "covariance")
    dataset = replace(dataset, aruco=replace(
        dataset.aruco, **{name: getattr(dataset.aruco, name)[keep] for name in names}))
    sparse = slam.solve(dataset, 3e-3, "arc")
    dense = slam.result(slam.solve_graph(slam.Graph(dataset, "arc", also=range(106)), 3e-3))
    sigma, expected = (np.sqrt(np.diagonal(c, axis1=1, axis2=2))
                       for c in (sparse.covariances, dense.covariances))
    assert (np.abs(sparse.poses - dense.poses) < 0.01 * expected + 2e-5).all()      # second order
    np.testing.assert_allclose(sigma, expected, rtol=0.02, atol=2e-5)


@pytest.mark.parametrize("options", [dict(), dict(mislabelled=0.03)])
def test_monte_carlo_is_consistent(options):
    """50 seeds: NEES of graph poses, of those between, of markers and wheels in their bands.

    Four means under two options are in their bands together with 95 % (Bonferroni).
    """
    runs = montecarlo.run(montecarlo.problem3, SEEDS, **options)
    low, high = nees_band(len(SEEDS), probability=1 - 0.05 / 8)
    for name in ("nees", "nees between", "map nees", "wheel nees"):
        assert low < runs[name].mean() < high, name
    assert np.sqrt(np.mean(runs["ate"]**2)) < 0.015 and runs["ate"].max() < 0.05
    assert 0.8 < np.exp(np.mean(np.log(runs["slip"]))) / 1e-3 < 1.25
    assert 0.9 < runs["chi2"].mean() < 1.05
    assert runs["arc"].mean() > 0.9                                     # the arc is recognized
    assert runs["map worst"].max() < 0.2                                # no marker is stranded


def test_the_wheels_belong_into_the_graph():
    """Without slip only the wheels' errors are left, which repeat: 10 seeds, given the true slip."""
    runs = montecarlo.run(montecarlo.graphs, range(400, 410), slip=0.0)
    rms = {wheels: np.sqrt(np.mean(runs[f"{wheels} arc ate"]**2)) for wheels in slam.WHEELS}
    assert 2 * rms["variable"] < rms["independent"] < rms["fixed"]
    assert runs["variable arc nees"].mean() < 4 and runs["fixed arc nees"].mean() > 50
    others = [runs[f"{wheels} {model} evidence"] for wheels in slam.WHEELS
              for model in ("arc", "euler") if (wheels, model) != ("variable", "arc")]
    assert (runs["variable arc evidence"] > np.array(others)).all()


@pytest.mark.parametrize("options", [dict(mislabelled=0.05), dict(mislabelled=0.01, drift=5.0)])
def test_consensus_is_the_initialisation_that_survives_wrong_labels(options):
    """From a first sighting the kernel of the last round alone never gets home, from consensus always."""
    runs = montecarlo.run(montecarlo.landmarks, range(10), kernel="last", **options)
    assert runs["consensus right"].all() and not runs["first sighting right"].any()
    assert runs["consensus initial error"].mean() < 0.5 * runs["first sighting initial error"].mean()
    graduated = montecarlo.run(montecarlo.landmarks, range(3), **options)
    assert graduated["consensus right"].all()


def test_a_drive_of_many_rounds_is_grown_part_by_part():
    """Odometry has lost the heading long before the end: from there no start would find home."""
    dataset, truth = simulate("long", seed=3, rounds=3)
    dataset = dataset.without("uwb")
    assert len(initial.parts(dataset)) > 2 and initial.parts(dataset)[-1] == len(dataset.ticks)
    found = slam.solve(dataset, 1e-3, "arc")
    assert found.outlier.mean() < 0.005 and ate(found.poses, truth.poses) < 0.1


def test_markers_without_orientation_are_points():
    """Headings of the sightings are noise, and their variances say so."""
    dataset, truth = simulate("short", seed=4)
    rng, seen = np.random.default_rng(0), dataset.aruco
    z, C = seen.marker_in_vehicle.copy(), seen.covariance.copy()
    z[:, 2] = rng.uniform(-np.pi, np.pi, len(z))
    C[:, 2, :2] = C[:, :2, 2] = 0
    C[:, 2, 2] = 1e4
    dataset = replace(dataset, uwb=None, aruco=replace(seen, marker_in_vehicle=z, covariance=C))
    found = slam.solve(dataset)
    assert ate(found.poses, truth.poses) < 0.03 and found.outlier.mean() < 0.01
    assert anees(found.poses, found.covariances, truth.poses) < nees_band(1, probability=0.999)[1]
    np.testing.assert_allclose(found.marker_covariance[:, 2, 2], 1e4)
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, found.marker)]
    assert np.abs(found.marker_in_world - true_map)[:, :2].max() < 0.05
    assert (found.marker_covariance[:, [0, 1], [0, 1]] < 0.05**2).all()


def test_wrong_labels_are_best_left_out(as_in_a_notebook):
    runs = montecarlo.run(montecarlo.wrong_labels, range(8), mislabelled=0.03)
    error = {way: runs[f"{way} ate"].mean() for way in slam.SIGHTINGS}
    assert error["gate"] < 1.02 * min(error.values()) and 1.5 * error["gate"] < error["Huber"]
