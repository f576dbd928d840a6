"""The factor graph in GTSAM: its factors, its solution, and factors of one's own."""

from dataclasses import replace
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import A, W, X
from numeric import (
    aruco,
    as_points,
    assert_consistent,
    known_noise,
    short,
    true_markers,
    uwb,
    vehicle,
)
from numpy.testing import assert_allclose, assert_array_equal
from test_normal_equations import dense_information

from slamlib import (
    build_graph,
    count_everything,
    estimate,
    initial_values,
    solve_graph,
)
from slamlib.core import graph as core_graph
from slamlib.core.batch import Batch
from slamlib.core.errors import DatasetError
from slamlib.core.evaluation import anees, ate
from slamlib.core.graph_solution import gauss_newton
from slamlib.core.kernels import KERNELS
from slamlib.core.records import AntennaGuess
from slamlib.robust import result, solution
from slamlib.robust.calibration import ENTRIES, WHEEL_SCALE, WHEELS
from slamlib.robust.factors import preintegrate_odometry
from slamlib.robust.fit import accepted_measurements
from slamlib.robust.initialization import odometry_state
from slamlib.robust.linear import NormalEquations, build_problem
from slamlib.robust.measurements import AcceptedMeasurements, Noise, measure
from slamlib.robust.solution_doubts import solution_doubts

SIGMA = gtsam.noiseModel.Isotropic.Sigma


@pytest.fixture(scope="module")
def drive():
    return short(3, 700)


@pytest.fixture
def small(drive):
    """300 poses of a drive of known noise."""
    return known_noise(drive[0].first(300), 1e-3)


def values_of(places):
    """GTSAM's Values of a dict of keys and Pose2 or arrays."""
    values = gtsam.Values()
    for key, place in places.items():
        values.insert(key, place)
    return values


def plain(dataset, **options):
    decisions = count_everything(dataset, **options)
    return build_graph(decisions), initial_values(dataset, decisions)


# Factors.


def test_factors_of_a_batch_are_linearised_at_once_and_anew_where_a_value_changed():
    """A variable that is not there yet is NaN."""
    calls = []

    def squared(points):
        calls.append(points)
        return points**2, [2 * points[:, :, None] * np.eye(2)]

    batch = Batch([[A(1), A(2)]], squared)
    first, second = (batch.factor(k, SIGMA(2, 1.0)) for k in range(2))
    values = values_of({A(1): np.array([1.0, 0])})
    assert first.error(values) == 0.5 and np.isnan(calls[0][1]).all()
    values.insert(A(2), np.array([2.0, 0]))
    J, b = second.linearize(values).jacobian()
    assert (J.tolist(), b.tolist()) == ([[4, 0], [0, 0]], [-4, 0])
    assert (first.error(values), second.error(values), len(calls)) == (0.5, 8, 2)
    values.update(A(2), np.zeros(2))
    assert second.error(values) == 0


@pytest.mark.parametrize("share", [1.0, 0.25])
@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_residual_of_one_sigma_costs_its_share_of_the_loss(kernel, share, sign):
    """One half without a kernel. The kernel sees the residual in the stated sigma."""
    model = core_graph.noise_model(np.array([[0.3**2]]), kernel, share)
    factor = gtsam.RangeFactor2D(X(0), A(0), 2.0 + sign * 0.3, model)
    values = values_of({X(0): gtsam.Pose2(), A(0): np.array([2.0, 0.0])})
    loss = 0.5 if KERNELS[kernel] is None else KERNELS[kernel].loss(float(sign))
    assert np.isclose(factor.error(values), share * loss, rtol=1e-9)


GROUPS = [(), ("camera-offset", WHEEL_SCALE), ("marker-size", "time-offset"),
          ("range-offset", "tag-offset"),
          tuple({entry.group for entry in ENTRIES} | {"antenna-offsets"})]


@pytest.mark.parametrize("groups", GROUPS)
@pytest.mark.parametrize("kernel", ["asymmetric Tukey", "Cauchy"])
def test_the_graph_is_the_one_by_which_the_engine_decides(groups, kernel):
    """Error, information and gradient, for kernels, shares, noise, jumps and any calibration."""
    dataset = vehicle(kernel=kernel, gate=False)(short(4, 500, late_ranges=0.2)[0])
    rng = np.random.default_rng(1)
    m = measure(dataset)
    state = odometry_state(m, "arc")
    prior = m.calibration.prior(groups)
    off = 2e-3 * rng.normal(size=state.poses.shape)
    off[0] = 0                            # the engine's prior of pose 1 has the derivative 1
    c = state.c + 0.05 * prior.root @ rng.normal(size=len(state.c))
    state = replace(state, poses=state.poses + off, c=c)

    problem = replace(
        build_problem(m, "arc", Noise(2e-3, 1.5, 0.7)), prior=prior,
        odometry=preintegrate_odometry(m, "arc", state.c[WHEELS]))
    accepted = AcceptedMeasurements(*(
        replace(each, weight=1.0 * (rng.uniform(size=len(each.weight)) < 0.9),
                share=rng.uniform(0.2, 1, len(each.weight)))
        for each in accepted_measurements(problem, state)))
    problem = replace(problem, accepted=accepted)
    equations = NormalEquations(problem, state)
    graph = solution.graph_of(problem)
    values = solution.values_of(problem, state, graph)
    assert np.isclose(graph.error(values), equations.error, rtol=1e-9)
    sums = equations.sums(problem.noise)
    whole = dense_information(m.structure, sums)
    n = len(m.structure.diagonal)
    rows = m.structure.rows[np.arange(3) < 2 + m.structure.is_pose[:, None]]
    rows = np.append(rows, np.arange(n, len(whole)))
    ordering = gtsam.Ordering()
    calibration = [key for key, _ in solution.CALIBRATION_KEYS if values.exists(key)]
    for key in solution.variable_keys(problem) + calibration:
        ordering.push_back(key)
    information, gradient = graph.linearize(values).hessian(ordering)
    expected = whole[np.ix_(rows, rows)]
    unit = 1 / np.sqrt(np.diag(expected))
    scale = np.outer(unit, unit)          # of small angles GTSAM's logarithm is rounded
    assert_allclose(scale * information, scale * expected, atol=5e-6)
    assert_allclose(
        -gradient * unit, sums.border[rows, -1] * unit, atol=1e-6 * np.abs(gradient * unit).max())


# The plain solver.


def test_without_noise_the_plain_solver_finds_the_truth_of_all_ids():
    """Negative ones, too."""
    dataset, truth = short(3, 700, noise=False)
    dataset = aruco(uwb(dataset, antenna=-dataset.uwb.antenna), marker=-dataset.aruco.marker)
    guess = AntennaGuess(-truth.antenna[::-1], truth.antenna_in_world[::-1])  # its prior is exact
    found = solve_graph(*plain(replace(dataset, antenna_guess=guess)))
    assert found.converged and found.error < 1e-9
    assert_array_equal(found.antenna, guess.antenna)
    for places, expected in (
            (found.poses, truth.poses[found.pose]), (found.antenna_in_world, guess.position),
            (found.marker_in_world, true_markers(truth, -found.marker))):
        assert_allclose(places[:, :2], expected[:, :2], atol=1e-9)


def test_the_plain_solver_is_consistent():
    """Right slip, no wrong label: mean NEES of eight drives in the band fixed beforehand."""
    values = []
    for seed in range(8):
        dataset, truth = short(seed, 1000)
        found = solve_graph(*plain(dataset))
        assert found.converged
        values.append(anees(found.poses, found.covariances, truth.poses[found.pose]))
    assert_consistent(values)


def test_points_are_mapped_as_positions(drive):
    seen = drive[0].aruco
    points = as_points(seen, seen.marker % 2 == 0, 0.3)
    found = solve_graph(*plain(replace(drive[0], aruco=points)))
    assert_array_equal(np.isnan(found.marker_in_world[:, 2]), found.marker % 2 == 0)
    expected = true_markers(drive[1], found.marker)
    assert_allclose(found.marker_in_world[:, :2], expected[:, :2], atol=0.05)


def test_marginals_are_blocks_of_the_inverse_information(drive):
    found = solve_graph(*plain(drive[0].first(60)))
    chosen = [X(10), X(20), W(0)]
    frames = [X(int(row)) for row in found.pose]
    ordering = gtsam.Ordering()
    for key in [*chosen, *sorted({*found.values.keys()} - {*chosen})]:
        ordering.push_back(key)
    information, _ = found.graph.linearize(found.values).hessian(ordering)
    covariance = np.linalg.inv(information)
    scale = np.sqrt(np.diag(covariance))
    for part, block in ((found.marginals.covariance(X(10)), np.s_[:3, :3]),
                        (found.marginals.pair(X(10), X(20)), np.s_[:6, :6]),
                        (found.marginals.pair(X(20), W(0)), np.s_[3:9, 3:9])):
        off = (part - covariance[block]) / (scale[:, None] * scale)[block]
        assert np.abs(off).max() < 1e-5
    pairs = [found.marginals.pair(*both) for both in pairwise(frames)]
    assert_allclose(found.marginals.neighbours(frames), pairs, rtol=1e-6, atol=1e-12)


def test_where_cholesky_fails_qr_gives_the_same_solution_and_marginals(drive, monkeypatch):
    graph, values = plain(drive[0].first(200))
    expected = solve_graph(graph, values)
    eliminate = gtsam.GaussianFactorGraph.eliminateMultifrontal

    def fails(graph, *arguments):
        if gtsam.EliminateQR in arguments:
            return eliminate(graph, *arguments)
        raise RuntimeError("Indeterminate linear system")

    monkeypatch.setattr(gtsam.GaussianFactorGraph, "eliminateMultifrontal", fails)
    for name in ("marginalCovariance", "jointMarginalCovariance"):
        monkeypatch.setattr(gtsam.GaussianBayesTree, name, fails)
    found = solve_graph(graph, values)
    assert_allclose(found.poses, expected.poses, atol=1e-7)
    assert_allclose(found.covariances, expected.covariances, rtol=1e-6, atol=1e-9)
    joint, by_cholesky = (each.marginals.pair(X(190), W(0)) for each in (found, expected))
    assert_allclose(joint, by_cholesky, rtol=1e-6, atol=1e-6 * np.abs(by_cholesky).max())
    keys = [X(int(row)) for row in found.pose]
    pairs, by_cholesky = (each.marginals.neighbours(keys) for each in (found, expected))
    assert_allclose(pairs, by_cholesky, rtol=1e-5, atol=1e-10)


def one_range(graph, values):
    values.insert(A(9), np.ones(2))
    graph.add(gtsam.RangeFactor2D(X(30), A(9), 1.0, SIGMA(1, 1.0)))


@pytest.mark.parametrize("change, told", [
    (lambda graph, values: graph.resize(0), "expected factors, found none"),
    (lambda graph, values: values.erase(X(0)), "an initial value of .*, found none of x0"),
    (lambda graph, values: values.insert(X(33), gtsam.Pose2()),
     "a factor of every variable, found none of x33"),
    (lambda graph, values: graph.add(gtsam.PriorFactorPoint2(X(0), np.zeros(2), SIGMA(2, 1.0))),
     "finite numbers, and values of the types"),
    (one_range, "determine every pose and landmark.*near a9$")])
def test_graphs_and_values_that_do_not_fit_are_told_in_a_sentence(drive, change, told):
    graph, values = plain(drive[0].first(100))
    change(graph, values)
    with pytest.raises(DatasetError, match=told) as failure:
        solve_graph(graph, values)
    assert "\n" not in str(failure.value)


def test_a_removed_factor_is_none(drive):
    graph, values = plain(drive[0].first(100))
    graph.remove(20)
    assert solve_graph(graph, values).converged
    assert gauss_newton(graph, values, 1).error < graph.error(values)


def test_steps_that_no_halving_lets_descend_are_no_convergence(drive):
    """A derivative with the wrong sign."""
    graph, values = plain(drive[0].first(100))

    def error(factor, values, jacobians):
        pose = values.atPose2(factor.keys()[0])
        if jacobians is not None:
            jacobians[0] = np.array([[-1.0, 0, 0]])
        return np.array([pose.x() - 0.3])

    graph.add(gtsam.CustomFactor(SIGMA(1, 1e-3), [X(0)], error))
    assert not solve_graph(graph, values).converged


@pytest.mark.parametrize("options, told", [
    ({"kernel": "nonsense"}, "one of asymmetric Tukey, .* for kernel"),
    ({"slip": np.nan}, "a slip above 0"), ({"extra": [999]}, "rows from 0 to 99 for poses"),
    ({"extra": [2.5]}, "rows from 0 to 99 for poses"), ({"extra": [True]}, "rows from 0 to 99")])
def test_wrong_options_of_the_plain_graph_are_told(drive, options, told):
    with pytest.raises(DatasetError, match=f"count_everything: expected {told}"):
        count_everything(drive[0].first(100), **options)


def test_the_plain_graph_heeds_stated_offset_and_scale_of_the_ranges(drive):
    given = drive[0].uwb
    measured = uwb(drive[0], range=2 * given.range + 0.5, sigma=2 * given.sigma)
    expected = solve_graph(*plain(drive[0]))
    found = solve_graph(*plain(vehicle(range_offset=0.5, range_scale=2.0)(measured)))
    assert_allclose(found.antenna_in_world, expected.antenna_in_world, atol=1e-6)


# What is handed in.


def test_poses_maps_and_covariances_are_those_of_gtsam(small, monkeypatch):
    """From odometry; and elsewhere, with covariances four times as large, what is handed in."""
    expected = estimate(small)
    assert expected.gtsam.start == solution.FROM_ODOMETRY and 2 <= expected.gtsam.steps <= 10
    assert expected.converged
    solve = result.solve_by_gtsam

    def elsewhere(fit):
        found = solve(fit)
        state = replace(found.state, poses=found.state.poses + [1, 0, 0],
                        markers=found.state.markers + [2, 0, 0],
                        antennas=found.state.antennas + [3, 0])
        return replace(found, state=state, frames=4 * found.frames, c=4 * found.c,
                       landmarks=4 * found.landmarks)

    monkeypatch.setattr(result, "solve_by_gtsam", elsewhere)
    found = estimate(small)
    for name, distance in (("poses", 1), ("marker_in_world", 2), ("antenna_in_world", 3)):
        off = getattr(found, name)[:, 0] - getattr(expected, name)[:, 0]
        assert_allclose(off, distance, atol=1e-6)
    frames = found.sightings.frame
    assert_allclose(found.covariances[frames], 4 * expected.covariances[frames])
    for name in ("marker_covariance", "wheel_covariance"):
        assert_allclose(getattr(found, name), 4 * getattr(expected, name))
    assert found.disagreement > 10


def test_from_odometry_alone_a_wrong_minimum_is_left_for_the_engines_solution(drive, monkeypatch):
    """Of two minima the one of smaller error is handed in."""
    dataset = known_noise(drive[0], 1e-3)
    expected = estimate(dataset)
    start = solution.odometry_state

    def astray(measurements, model):
        state = start(measurements, model)
        return replace(state, antennas=state.antennas + [40.0, -30.0])

    monkeypatch.setattr(solution, "odometry_state", astray)
    found = estimate(dataset)
    assert found.gtsam.start == solution.FROM_ENGINE
    assert_allclose(found.antenna_in_world, expected.antenna_in_world, atol=1e-3)


@pytest.mark.parametrize("change, is_native", [
    ({}, (True, True, True)),
    ({"camera_x": 0.1, "sigma_camera_x": 0.05, "sigma_camera_turn": 0.02}, (False, False, True)),
    ({"sighting_lag": 2.0}, (False, False, True)),
    ({"tag_x": 0.1, "sigma_range_scale": 0.01}, (True, True, False)),
    ({"antenna_height": 1.0}, (True, True, False)),
    ({"antenna_height": 1.0, "sigma_antenna_height": 0.2, "range_offset": 0.05},
     (True, True, False))])
def test_with_a_calibration_that_is_stated_or_unknown_both_agree(drive, change, is_native):
    """Three markers are points. What needs no calibration has GTSAM's own factors."""
    points = np.isin(drive[0].aruco.marker, drive[0].aruco.marker[:3])
    dataset = replace(drive[0], aruco=as_points(drive[0].aruco, points))
    found = estimate(vehicle(slip=1e-3, **change)(dataset))
    assert found.disagreement < 0.03                           # native points are 0.01 sigma apart
    graph, _ = found.graph()
    kinds = {type(graph.at(k)) for k in range(graph.size())}
    native = (gtsam.BetweenFactorPose2, gtsam.BearingRangeFactor2D, gtsam.RangeFactor2D)
    assert tuple(kind in kinds for kind in native) == is_native


def test_a_disagreement_of_engine_and_gtsam_is_a_doubt(small):
    found = estimate(small)
    assert "agreement" not in {doubt.what for doubt in solution_doubts(found)}
    doubts = solution_doubts(replace(found, disagreement=0.3))
    sentence, = (doubt.sentence for doubt in doubts if doubt.what == "agreement")
    assert "0.3 standard deviations" in sentence


def test_a_previous_result_of_another_drive_is_told(small):
    """Shorter, or of equal length: by its counts."""
    other = known_noise(short(9, 300)[0], 1e-3)
    for before in (small.first(200), other):
        with pytest.raises(DatasetError, match="estimate: expected a result of the same drive"):
            estimate(small, previous=estimate(before.without("uwb")))


# Factors of one's own.


@pytest.fixture(scope="module")
def solved(drive):
    """A drive without ranges, with two poses that are no frames as variables."""
    return estimate(known_noise(drive[0].without("uwb"), 1e-3), poses=[33, 471])


def test_poses_between_measurements_are_variables_where_they_are_asked_for(drive, solved):
    graph, values = solved.graph()
    assert values.exists(X(33)) and not values.exists(X(34))
    again = solve_graph(graph, values)
    assert_allclose(again.poses[:, :2], solved.poses[again.pose, :2], atol=1e-5)
    for C, expected in ((again.covariances, solved.covariances[again.pose]),
                        (again.marker_covariance, solved.marker_covariance)):
        assert_allclose(C, expected, rtol=1e-3, atol=1e-3 * expected.max())
    for pose in (-1, 700, 2.5):
        with pytest.raises(DatasetError, match="estimate: expected rows from 0 to 699 for poses"):
            estimate(drive[0], poses=[pose])


def with_fixes(drive, solved, off, noise):
    """Solution of a graph with a GPS fix at each 100th pose, moved by off {pose: m}; its size."""
    graph, values = solved.graph()
    count = graph.size()
    rng = np.random.default_rng(0)
    for i in range(100, 700, 100):
        place = drive[1].poses[i, :2] + 0.05 * rng.normal(size=2) + [off.get(i, 0), 0]
        graph.add(gtsam.PoseTranslationPrior2D(X(i), place, noise))
    return solve_graph(graph, values), count


@pytest.mark.parametrize("far", [10.0, 500.0])
def test_a_gps_that_contradicts_is_told_and_not_converged(drive, solved, far, caplog):
    """One place is wrong, then all."""
    for off in ({300: far}, dict.fromkeys(range(700), far)):
        found, count = with_fixes(drive, solved, off, SIGMA(2, 0.05))
        assert not found.converged
        assert found.contradiction.startswith("factor ")
        assert found.contradiction in caplog.text
        if off == {300: 10}:
            assert found.contradiction.startswith(f"factor {count + 2},")       # the third fix


def test_a_robust_factor_may_be_wrong_by_far(drive, solved):
    robust = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Cauchy.Create(1.0), SIGMA(2, 0.05))
    found, _ = with_fixes(drive, solved, {300: 5e8}, robust)     # its loss exceeds ten sigmas
    assert found.converged and not found.contradiction
    assert ate(found.poses, drive[1].poses[found.pose]) < 0.03
