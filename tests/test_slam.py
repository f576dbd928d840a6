"""Problem 3: the factors, the posterior, and Monte Carlo consistency of the SLAM graph."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from numeric import as_points, central_differences, known_noise, slam_trial

from slamlib import estimate, studies
from slamlib.core import odometry, se2
from slamlib.core.errors import DatasetError
from slamlib.core.evaluation import anees, ate, nees_band
from slamlib.core.kernels import KERNELS, ONE_SIDED
from slamlib.core.records import AntennaGuess, ArucoReadings, Dataset, UwbReadings
from slamlib.core.vehicle import Vehicle
from slamlib.robust import factors
from slamlib.robust.choices import DECISIVE_LEAD, better_model, ids_of_places
from slamlib.robust.covariances import marginal_covariances, posterior_moments
from slamlib.robust.fit import accepted_measurements
from slamlib.robust.initialization import GROWTH, odometry_state, part_lengths
from slamlib.robust.linear import (
    NormalEquations,
    build_problem,
    laplace_approximation,
    state_from_arrays,
)
from slamlib.robust.measurements import NOISE_KEYS, Noise, measure, square_root_information
from slamlib.robust.noise import learn_noise
from slamlib.robust.pipeline import fit_from_odometry
from slamlib.robust.result import interpolate, slam_result
from slamlib.studies import kernels, simulation, starts
from slamlib.studies.simulation import simulate


@pytest.fixture(scope="module")
def example():
    """A Problem of odometry alone, with poses (f, 3) and wheels (3,) off its optimum."""
    rng = np.random.default_rng(0)
    dataset, truth = simulate("short", seed=3)
    bare = dataset.without("aruco").without("uwb")
    measurements = measure(bare, np.arange(0, 2000, 40))
    poses = truth.poses[measurements.frame] + rng.normal(0, 0.05, (len(measurements.frame), 3))
    wheel = dataset.vehicle.wheel + rng.normal(0, 1, 3) * dataset.vehicle.sigma_wheel
    return build_problem(measurements, "arc"), poses, wheel


@pytest.mark.parametrize("in_counts", [False, True])
def test_odometry_derivatives_against_central_differences(example, in_counts):
    problem, poses, wheel = example
    odometry = replace(problem.odometry, in_counts=in_counts)
    _, J, by_wheel = factors.odometry_error(odometry, poses, wheel)
    for moved in (0, 1):                       # every second pose, the even or the odd ones
        def error(xi, moved=moved):
            changed = poses.copy()
            changed[moved::2] = se2.compose(poses[moved::2], xi)
            return factors.odometry_error(odometry, changed, wheel)[0]

        numeric, own = central_differences(error, np.zeros(3)), np.arange(len(J)) % 2 == moved
        expected = np.where(own[:, None, None], J[:, :, :3], J[:, :, 3:])
        np.testing.assert_allclose(expected, numeric, atol=1e-7)
    numeric = central_differences(
        lambda v: factors.odometry_error(odometry, poses, v)[0], wheel)
    np.testing.assert_allclose(by_wheel, numeric, atol=1e-6)               # per m


def test_odometry_factor_equals_gtsams_between_factor_for_known_wheels(example):
    """Jacobian, right-hand side and error are equal, also far from the optimum."""
    problem, poses, _ = example
    odometry, unit = problem.odometry, gtsam.noiseModel.Unit.Create(3)
    U = square_root_information(odometry.covariance(problem.noise.slip))
    e, J, _ = factors.odometry_error(odometry, poses, odometry.stated)
    assert np.abs(e).max() > 0.05
    for i, Q in enumerate(odometry.covariance(1e-3)):
        values, increment = gtsam.Values(), gtsam.Pose2(*odometry.increment[i])
        for k in range(2):
            values.insert(k, gtsam.Pose2(*poses[i + k]))
        # Unit noise: GTSAM may whiten with another square root of the same information.
        A, b = gtsam.BetweenFactorPose2(0, 1, increment, unit).linearize(values).jacobian()
        np.testing.assert_allclose(np.c_[A, b], np.c_[J[i], -e[i]], atol=1e-9)
        native = gtsam.BetweenFactorPose2(0, 1, increment, gtsam.noiseModel.Gaussian.Covariance(Q))
        assert np.isclose(native.error(values), np.sum((U[i] @ e[i])**2) / 2, rtol=1e-6)


def learned_noise(seed, slip):
    """Problems 3 and 4 with the noise learned, and problem 3 where it is known, on one drive."""
    dataset, truth = simulate("short", seed, slip=slip)
    markers = dataset.without("uwb")
    learned = estimate(markers)
    found = {"": learned, "known ": estimate(known_noise(markers, slip), model="arc"),
             "problem 4 ": estimate(dataset, previous=learned)}
    return {"slip": learned.slip, "rejected": np.count_nonzero(learned.rejected),
            "arc": float(learned.model == "arc")} | {
        f"{name}{key}": value for name, r in found.items() for key, value in (
            ("nees", anees(r.poses, r.covariances, truth.poses)),
            ("aligned", ate(r.poses, truth.poses, aligned=True)))}


@pytest.mark.slow
@pytest.mark.parametrize("slip, drives", [(0.0, 8), (3e-3, 6), (1e-2, 8)])
def test_a_slip_that_is_not_known_widens_the_covariance(slip, drives):
    """No overconfidence, and nearly the accuracy of the graph that knows the slip.

    A usual slip is in `test_monte_carlo_is_consistent`. The mean NEES is at most 1.35 times that
    with the slip known or 3.6, whichever is larger, and no drive is above 16. With correct labels
    few sightings are rejected, and a large slip is learned from the typical one.
    """
    runs = studies.run(learned_noise, range(3000, 3000 + drives), slip=slip)
    most = max(1.35 * runs["known nees"].mean(), 3.6)
    assert runs["nees"].mean() < most and runs["problem 4 nees"].mean() < most
    assert max(runs["nees"].max(), runs["problem 4 nees"].max()) < 16
    rms, known = (np.sqrt(np.mean(runs[name]**2)) for name in ("aligned", "known aligned"))
    assert rms < (1.05 if slip == 3e-3 else 1.3) * known
    if slip:
        assert runs["rejected"].mean() < 6                       # gate: 0.1 % of about 900
        assert 0.85 < np.exp(np.mean(np.log(runs["slip"]))) / slip < 1.15
        low, high = nees_band(drives, probability=0.999)
        assert low < runs["nees"].mean() < high and runs["arc"].mean() > 0.8
    if slip == 3e-3:
        np.testing.assert_allclose(runs["slip"], slip, rtol=0.3)
        np.testing.assert_allclose(runs["nees"], runs["known nees"], rtol=0.3)


def test_wrong_covariances_of_sightings_are_scaled(scale=1 / 16):
    """The estimate is nearly the one from the right covariances, and its factor is known."""
    dataset = simulate("short", seed=61)[0].without("uwb")
    aruco = replace(dataset.aruco, covariance=scale * dataset.aruco.covariance)
    expected, found = estimate(dataset), estimate(replace(dataset, aruco=aruco))
    assert abs(np.log(found.noise.sightings * np.sqrt(scale))) < 4 * found.noise_sigma[1]
    assert 0.005 < found.noise_sigma[1] < 0.03               # about 2700 errors: 1 / sqrt(2 * 2700)
    sigma = np.sqrt(np.diagonal(expected.covariances, axis1=1, axis2=2))[1:]
    assert np.abs((found.poses - expected.poses)[1:] / sigma).max() < 0.5
    np.testing.assert_allclose(found.covariances[-1], expected.covariances[-1], rtol=0.2,
                               atol=0.1 * expected.covariances[-1].max())


@pytest.mark.parametrize("poses, slip", [(2000, 1e-3), (300, 0.0)])
def test_the_learned_noise_has_the_greatest_posterior(poses, slip):
    """Many and few measurements: derivatives at the mode, by small steps, are nearly zero."""
    dataset, _ = simulate("short", seed=6, slip=slip)
    fit = fit_from_odometry(measure(dataset.first(poses)))
    equations = NormalEquations(fit.problem, fit.state)
    found = learn_noise(equations)

    def log_posterior(logarithms):
        return laplace_approximation(equations, Noise(*np.exp(logarithms)))[1] \
            - np.sum(((logarithms - np.log([1e-3, 1, 1])) / np.log([3, 2, 2]))**2) / 2

    sigma = np.sqrt(np.diag(found.covariance))
    for direction in np.diag(sigma):
        mode = np.log(found.noise)
        up, down = (log_posterior(mode + 0.1 * sign * direction) for sign in (1, -1))
        assert abs(up - down) / 0.2 < 0.2                       # for a step of one sigma
        curvature = (up + down - 2 * log_posterior(mode)) / 0.01
        assert -2 < curvature < -0.5                            # -1 without correlations


def test_averages_over_the_noise_are_moments_of_a_mixture():
    """Mean and covariance over the points, by hand, of all variables.

    One marker is a point, and offset and scale of the ranges are hardly known.
    """
    dataset = simulate("short", seed=5, slip=0.0)[0].first(600)
    dataset = replace(
        dataset, aruco=as_points(dataset.aruco, dataset.aruco.marker == dataset.aruco.marker[0]),
        vehicle=replace(dataset.vehicle, sigma_range_offset=0.2, sigma_range_scale=0.05))
    fit = fit_from_odometry(measure(dataset))
    weights, noises = zip(*fit.posterior.points)
    assert len(weights) > 2 and np.isclose(sum(weights), 1, atol=1e-2)
    equations, m = NormalEquations(fit.problem, fit.state), fit.problem.measurements
    active = fit.problem.active
    assert active.sum() == 5 and not m.oriented.all()
    x = np.stack([laplace_approximation(equations, each)[0]
                  for each in (fit.problem.noise, *noises)])
    n, x, weights = len(equations.structure.diagonal), x[1:] - x[0], weights / np.sum(weights)
    x[:, n:] *= fit.problem.sigma[active]
    mean, (state, mixed, slip) = weights @ x, posterior_moments(fit)
    each, rows = [marginal_covariances(equations, noise) for noise in noises], \
        equations.structure.rows
    frames, landmarks = np.split(rows, [len(m.frame)])
    for at, block in (
            (np.r_[frames[20], frames[21], n:n + 3], lambda C: C.pairs[20]),
            (np.arange(n, n + 5), lambda C: C.c[np.ix_(active, active)]),
            *((at, lambda C, j=j: C.landmarks[j]) for j, at in enumerate(landmarks))):
        expected = sum(p * (block(C) + np.outer(d, d))
                       for p, C, d in zip(weights, each, (x - mean)[:, at]))
        np.testing.assert_allclose(block(mixed), expected, rtol=1e-9, atol=1e-15)
    assert not mixed.c[~active].any() and not mixed.c[:, ~active].any()
    poses, markers, antennas = np.split(mean[rows], np.cumsum([len(m.frame), len(m.marker)]))
    c = fit.state.c.copy()
    c[active] += mean[n:]
    for found, expected in (
            (state.poses, se2.compose(fit.state.poses, poses)), (state.c, c),
            (state.markers, se2.compose(fit.state.markers, markers)),
            (state.antennas, fit.state.antennas + antennas[:, :2])):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.isclose(slip**2, sum(p * noise.slip**2 for p, noise in zip(weights, noises)))


def test_two_poses_and_one_marker_by_hand():
    """Poses at 0 and x on a line, a marker at m seen from both, headings known.

    Odometry measures x as o with variance q; the sightings s_1 = m and s_2 = m - x have variance r.
    The information of (x, m) is [[1/q + 1/r, -1/r], [-1/r, 2/r]]. Hence

        x = (2 r o + q (s_1 - s_2)) / (2 r + q),
        var x = 2 r q / (2 r + q),  var m = r (r + q) / (2 r + q).

    Wheel errors are negligible, so q is the noise of rounding and slip.
    """
    r, slip, s_1, s_2 = 4e-4, 2e-2, 2.02, 0.99
    vehicle = Vehicle(**dict.fromkeys(
        ("sigma_right_radius", "sigma_left_radius", "sigma_wheelbase", "sigma_heading"), 1e-7))
    ticks = np.zeros((101, 2), int)
    ticks[1:] = 127
    o = 100 * 127 * 2 * np.pi * 0.1 / 8000
    C = np.diag([r, 1e-10, 1e-12])
    readings = ArucoReadings(np.array([0, 100]), np.array([9, 9]),
                             np.array([[s_1, 0, 0], [s_2, 0, 0]]), np.array([C, C]))
    dataset = Dataset("line", vehicle, ticks, readings, None, None)
    found = estimate(known_noise(dataset, slip), model="arc")
    q = slip**2 * o / 2
    expected = (2 * r * o + q * (s_1 - s_2)) / (2 * r + q)
    np.testing.assert_allclose(found.poses[100, 0], expected, atol=1e-5)
    np.testing.assert_allclose(
        [found.covariances[100, 0, 0], found.marker_covariance[0, 0, 0]],
        [2 * r * q / (2 * r + q), r * (r + q) / (2 * r + q)], rtol=1e-3)


@pytest.mark.parametrize("every, sigma", [(10, 1e-4), (100, 3e-3)])
def test_interpolated_poses_equal_those_of_a_graph_with_all_poses(every, sigma):
    """Frames 10 rows apart, and frames a metre apart with wheel errors that matter in between."""
    dataset, _ = simulate("short", seed=2)
    vehicle = replace(dataset.vehicle, sigma_right_radius=sigma, sigma_left_radius=sigma)
    dataset = replace(dataset, uwb=None, vehicle=vehicle, ticks=dataset.ticks[:106])
    keep = (dataset.aruco.pose <= 100) & (dataset.aruco.pose % every == 0)
    dataset = replace(dataset, aruco=dataset.aruco.select(keep))
    sparse = estimate(known_noise(dataset, 3e-3), model="arc")
    dense = slam_result(fit_from_odometry(measure(known_noise(dataset, 3e-3), range(106))))
    sigma, expected = (np.sqrt(np.diagonal(c, axis1=1, axis2=2))
                       for c in (sparse.covariances, dense.covariances))
    # The difference is of second order.
    assert (np.abs(sparse.poses - dense.poses) < 0.01 * expected + 2e-5).all()
    np.testing.assert_allclose(sigma, expected, rtol=0.02, atol=2e-5)


@pytest.mark.slow
def test_monte_carlo_is_consistent():
    """24 drives with wrong labels; drives without are in test_uwb.

    NEES of graph poses, interpolated poses, markers and wheels: all four means are in their bands
    with probability 95 % (Bonferroni).
    """
    runs = studies.run(slam_trial, range(300, 324), ranges=False, mislabelled=0.03)
    low, high = nees_band(24, probability=1 - 0.05 / 4)
    for name in ("nees", "nees between", "map nees", "wheel nees"):
        assert low < runs[name].mean() < high, name
    assert np.sqrt(np.mean(runs["ate"]**2)) < 0.015 and runs["ate"].max() < 0.05
    assert 0.8 < np.exp(np.mean(np.log(runs["slip"]))) / 1e-3 < 1.25
    assert 0.95 < runs["factor"].mean() < 1.03
    assert runs["arc"].mean() > 0.9                      # the evidence selects the true model
    assert runs["map worst"].max() < 0.2                 # m: no marker is in a wrong minimum


@pytest.mark.slow
@pytest.mark.parametrize("options", [
    dict(mislabelled=0.05), dict(mislabelled=0.01, vehicle=Vehicle(
        sigma_right_radius=5e-4, sigma_left_radius=5e-4, sigma_wheelbase=5e-4))])
def test_initialisation_by_consensus_finds_the_right_minimum_despite_wrong_labels(options):
    """With the last kernel alone, markers at their first sightings end in a wrong minimum."""
    runs = studies.run(starts.landmarks, range(10), kernel="last",
                       starts=("first sighting", "consensus"), **options)
    assert runs["consensus right"].all() and not runs["first sighting right"].any()
    assert runs["consensus initial error"].mean() < 0.5 * runs[
        "first sighting initial error"].mean()
    graduated = studies.run(starts.landmarks, range(3), starts=("consensus",), **options)
    assert graduated["consensus right"].all()


def test_markers_of_unknown_heading_are_mapped_as_points():
    """The headings of the sightings are uniform, and their variances are large."""
    dataset, truth = simulate("short", seed=4)
    rng, seen = np.random.default_rng(0), dataset.aruco
    z = seen.marker_in_vehicle.copy()
    z[:, 2] = rng.uniform(-np.pi, np.pi, len(z))
    dataset = replace(dataset, uwb=None, aruco=replace(
        as_points(seen, slice(None)), marker_in_vehicle=z))
    found = estimate(dataset)
    assert ate(found.poses, truth.poses) < 0.03 and found.rejected.mean() < 0.01
    assert anees(found.poses, found.covariances, truth.poses) < nees_band(1, probability=0.999)[1]
    np.testing.assert_allclose(found.marker_covariance[:, 2, 2], 1e4)
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, found.marker)]
    assert np.abs(found.marker_in_world - true_map)[:, :2].max() < 0.05
    assert (found.marker_covariance[:, [0, 1], [0, 1]] < 0.05**2).all()


def test_the_gate_rejects_wrong_labels_and_hardly_any_others():
    numbers = kernels.compare(6, "sightings", ("quadratic", "gate"), mislabelled=0.03)
    assert numbers["gate wrong rejected"] == 1 and numbers["gate good lost"] < 0.005
    assert numbers["quadratic wrong rejected"] == numbers["quadratic good lost"] == 0


@pytest.mark.parametrize("marker, place, expected", [
    ([12, 12, 12, 7, 7], [0, 1, 2, 0, 1], [12, 112, 212, 7, 107]),
    ([12, 999, 12], [0, 0, 1], [12, 999, 1012]),
    ([-7, 93, -7, 0, 0], [0, 0, 1, 0, 1], [-7, 93, -107, 0, 100]),      # 93 is -7 + 100
    ([-12, 2, 2], [0, 0, 1], [-12, 2, 102])])
def test_a_second_place_gets_a_readable_id_that_the_drive_does_not_have(marker, place, expected):
    found = ids_of_places(np.array(marker), np.array(place))
    np.testing.assert_array_equal(found, expected)
    assert len({*found}) == len({*zip(marker, place)})


OPEN_PATHS = {                                            # legs of (metres, radians)
    "straight": [(25, 0)],
    "building": [(9, 0), (0.8, np.pi / 2), (7, 0), (0.8, -np.pi / 2), (10, 0)],
    "spiral": [(2 + 0.8 * k, np.pi / 2) for k in range(6)]}


def open_path(legs, seed):
    """A drive along legs of a simulated building: Dataset with markers only, and Truth."""
    steps = np.array([max(1, int(length / 0.01)) for length, _ in legs])
    ds, dtheta = (np.repeat(values / steps, steps) for values in np.transpose(legs))
    short = simulation.PATHS["short"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "_driven_arcs", lambda layout, rounds: (ds, dtheta))
        patch.setitem(simulation.PATHS, "open", type(short)(**vars(short) | {"marker_spacing": 2}))
        dataset, truth = simulate("open", seed)
    return dataset.without("uwb"), truth


@pytest.mark.slow
@pytest.mark.parametrize("shape", OPEN_PATHS)
def test_open_paths_are_solved(shape):
    """A marker every 2 m, no loop closure: three drives each, against the graph of known noise.

    On a single drive a learned slip makes the error larger or smaller by chance; their
    rms is compared.
    """
    values, errors = [], []
    for seed in range(3):
        dataset, truth = open_path(OPEN_PATHS[shape], seed)
        found = estimate(dataset)
        known = estimate(known_noise(dataset, 1e-3), model="arc")
        errors.append([ate(r.poses, truth.poses, aligned=True) for r in (found, known)])
        assert found.rejected.mean() < 0.01
        values.append(anees(found.poses, found.covariances, truth.poses))
    learned, with_known_noise = np.sqrt(np.mean(np.square(errors), axis=0))
    assert learned < 1.1 * with_known_noise
    assert np.mean(values) < nees_band(3, probability=0.999)[1]


def test_parts_of_a_drive_grow_at_most_fourfold_from_where_the_heading_is_lost():
    """A turn of one rad a metre: a wheelbase known to 5 % loses 0.5 rad after ten metres."""
    ticks = np.tile(np.rint(simulation.manoeuvre([(1.0, 1.0)])[1:]), (300, 1))
    vehicle = Vehicle(sigma_wheelbase=0.02)
    drive = Dataset("turns", vehicle, np.vstack([[0, 0], ticks]), None, None, None)
    count, ends = len(drive.ticks), part_lengths(drive)
    lost = np.flatnonzero(odometry.first_order(drive.ticks, vehicle)[1][:, 2, 2] > 0.5**2)[0]
    assert abs(lost - count / 30) < count / 300
    assert ends[-1] == count and lost <= ends[0] <= 1.5 * lost and len(ends) == 4
    np.testing.assert_array_equal(ends[:-1], [max(lost, -(-end // GROWTH)) for end in ends[1:]])
    assert part_lengths(drive.first(lost + 10)) == [lost + 10]      # not worth a part of its own
    sure = Vehicle(sigma_wheelbase=1e-6, sigma_right_radius=1e-6, sigma_left_radius=1e-6)
    blind = replace(vehicle, sigma_heading=1.0)       # the same error at all poses loses no turn
    for other, expected in ((sure, [count]), (blind, ends)):
        assert part_lengths(replace(drive, vehicle=other)) == expected


def test_a_longer_part_goes_on_from_the_last_solved_pose_with_its_wheels():
    dataset, truth = simulate("short", seed=4, noise=False)
    dataset = dataset.without("uwb")
    part, whole = measure(dataset.first(500)), measure(dataset)
    wheel, rng = np.array([0.1003, 0.0998, 0.4001]), np.random.default_rng(0)
    c = np.r_[wheel, part.calibration.stated[3:] + rng.normal(0, 0.01, 11)]
    poses = truth.poses[part.frame] + rng.normal(0, 0.01, (len(part.frame), 3))
    solved = state_from_arrays(part, poses, np.zeros((len(part.marker), 3)), np.zeros((0, 2)), c)
    found = odometry_state(whole, "arc", part, solved)
    last = len(part.frame) - 1
    kept = np.searchsorted(whole.frame, part.frame[:-1])
    np.testing.assert_allclose(found.poses[kept], solved.poses[:-1], atol=1e-12)
    np.testing.assert_array_equal(found.c, c)
    expected = odometry.dead_reckoning(
        dataset.ticks[499:], dataset.vehicle.with_wheel(wheel), solved.poses[last], "arc")
    later = whole.frame > 499
    np.testing.assert_allclose(found.poses[later], expected[whole.frame[later] - 499], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("known", [
    {"slip": 2e-3}, {"marker_noise_factor": 1.3}, {"range_noise_factor": 0.8}])
def test_noise_that_is_known_is_not_learned_and_the_rest_is(known):
    """By an option and by the vehicle alike, from odometry and from a result; sigmas say which."""
    dataset = simulate("short", seed=4)[0].first(400)
    before = estimate(dataset.without("uwb"))
    found = estimate(dataset, **known)
    by_vehicle = estimate(replace(dataset, vehicle=replace(dataset.vehicle, **known)))
    again = estimate(dataset, previous=before, **known)
    np.testing.assert_array_equal(found.poses, by_vehicle.poses)
    for each in (found, again):
        given = np.array([name in known for name in NOISE_KEYS])
        np.testing.assert_array_equal(each.noise_sigma == 0, given)
        values = np.array([each.noise.slip, each.noise.sightings, each.noise.ranges])
        np.testing.assert_allclose(values[given], list(known.values()), rtol=1e-12)
        assert (values[~given] != np.array([1e-3, 1, 1])[~given]).all()
        np.testing.assert_allclose(values[1:][~given[1:]], 1, atol=0.2)
    assert np.abs(found.poses[-1] - estimate(dataset).poses[-1]).max() > 1e-6


@pytest.mark.parametrize("options, told", [
    ({"kernel": "huber"}, 'expected "asymmetric Tukey" or .* for kernel, found .huber'),
    ({"model": "line"}, "expected euler or arc for model, found 'line'"),
    ({"slip": -1e-3}, r"expected a number from 0 to 0.1 sqrt\(m\) for slip, found '-0.001'"),
    ({"slip": np.nan}, "for slip, found 'nan'"),
    ({"slip": "0.001"}, "for slip, found '0.001'"),
    ({"kernel": ["Huber"]}, '"Huber" or .* for kernel'),
    ({"gate": "no"}, "expected true or false for gate, found 'no'"),
    ({"range_noise_factor": True}, "for range_noise_factor, found 'True'"),
    ({"marker_noise_factor": 0.0}, "expected a number from 0.01 to 100 for marker_noise_factor"),
    ({"range_noise_factor": 1e3}, "for range_noise_factor, found '1000.0'"),
    ({"dataset": "data/short"}, "expected a Dataset, found .data/short.")])
def test_an_option_with_a_wrong_name_or_value_is_told_with_what_there_is(options, told):
    with pytest.raises(DatasetError, match=f"^estimate: {told}" if told[0] == "e" else told):
        estimate(**{"dataset": simulate("short", seed=4)[0].first(50)} | options)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_every_kernel_solves_a_drive_with_wrong_labels_and_late_ranges(kernel):
    """Without gates, too, but for quadratic errors, which follow the wrong labels.

    Kernels take part of the variance of good measurements, too, which the learned factors contain.
    """
    dataset, truth = simulate("short", seed=4, mislabelled=0.01, late_ranges=0.05)
    dataset, truth = dataset.first(800), truth.poses[:800]
    gated = estimate(dataset, kernel=kernel, model="arc")
    assert gated.rejected.any() and ate(gated.poses, truth) < 0.02
    np.testing.assert_allclose(gated.noise.sightings, 1, atol=0.05)
    assert (gated.range_weight < 1).any()
    if kernel not in ONE_SIDED:                     # those leave the errors of sightings quadratic
        found = estimate(dataset, kernel=kernel, model="arc", gate=False)
        assert not found.rejected.any()
        assert (ate(found.poses, truth) < 0.03) == (kernel != "quadratic")


def test_gates_of_poses_points_and_ranges():
    """Residuals just below and above the gates; a range may be too long by any number of sigmas."""
    C, z, place = np.tile(1e-4 * np.eye(3), (4, 1, 1)), np.tile([1.0, 0, 0], (4, 1)), [[3.0, 4.0]]
    C[2:, 2, 2] = 1e4
    off = 0.01 * np.sqrt([16.2, 16.3, 13.8, 13.9])
    none = np.zeros(3, int)
    m = measure(Dataset(
        "still", Vehicle(), np.zeros((1, 2), int),
        ArucoReadings(np.zeros(4, int), np.arange(4), z + off[:, None] * [1, 0, 0], C),
        UwbReadings(none, none, 5 + 0.1 * np.array([-3.2, -3.4, 50]), np.full(3, 0.1)),
        AntennaGuess(none[:1], np.array(place))))
    problem = build_problem(m, "arc")
    alone = interpolate(problem, odometry_state(m, "arc"), np.zeros((0, 9, 9)))
    np.testing.assert_allclose(alone[1], [np.diag(m.origin_sigma)**2])          # of the only pose
    state = state_from_arrays(m, np.zeros((1, 3)), z, place, m.calibration.stated)
    for noise, gates, weights in (
            (Noise(), (), [1, 0, 1, 0, 1, 0, 1]), (Noise(sightings=1.1, ranges=1.1), (), 7 * [1]),
            (Noise(), (("quadratic", True), ("Huber", True)), [1, 0, 1, 0, 1, 0, 0])):
        found = accepted_measurements(replace(problem, noise=noise), state, *gates)
        np.testing.assert_array_equal(np.r_[found.sightings.weight, found.ranges.weight], weights)


@pytest.mark.parametrize("true, other", [("arc", "euler"), ("euler", "arc")])
def test_the_evidence_chooses_the_steps_that_the_vehicle_drives(true, other):
    """Without slip; the measurements and their weights stay those of the fit."""
    dataset, truth = simulate("short", seed=3, noise=False)
    a, rng = dataset.aruco, np.random.default_rng(0)
    poses = odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model=true)
    z = se2.between(poses[a.pose],
                    truth.marker_in_world[np.searchsorted(truth.marker, a.marker)])
    z += (np.linalg.cholesky(a.covariance) @ rng.normal(size=(len(z), 3, 1)))[..., 0]
    drive = replace(dataset, uwb=None, aruco=replace(a, marker_in_vehicle=z))
    m = measure(known_noise(drive.first(1000), 1e-4))
    right, wrong = (fit_from_odometry(m, model) for model in (true, other))
    assert better_model(right) is right
    found = better_model(wrong)
    assert found.problem.odometry.model == true
    assert found.log_evidence > wrong.log_evidence + DECISIVE_LEAD
    for ours, theirs in zip(found.problem.accepted, wrong.problem.accepted):
        np.testing.assert_array_equal(ours.weight, theirs.weight)


def test_headings_are_continuous_where_frames_are_rounds_apart():
    """Markers at both ends of three rounds only: between two frames the vehicle turns by 6 pi."""
    dataset, truth = simulate("short", seed=5, rounds=3)
    last = len(dataset.ticks) - 1
    ends = (dataset.aruco.pose < 50) | (dataset.aruco.pose > last - 50)
    found = estimate(replace(dataset, uwb=None, aruco=dataset.aruco.select(ends)))
    assert abs(truth.poses[-1, 2]) > 18
    np.testing.assert_allclose(found.poses[:, 2], truth.poses[:, 2], atol=0.3)
    assert np.abs(np.diff(found.poses[:, 2])).max() < 0.1


def test_a_drive_of_one_pose_has_its_prior():
    dataset = simulate("short", seed=8)[0].first(1)
    found = estimate(dataset)
    sigma = np.array([1e-5, 1e-5, dataset.vehicle.sigma_heading])
    np.testing.assert_allclose(found.covariances, [np.diag(sigma**2)], atol=1e-18)
    assert not found.poses.any() and len(found.marker) == len(dataset.aruco.pose) > 0
    assert max(found.agreement) < 1e-6
