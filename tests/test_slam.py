"""Problem 3: the factors, the posterior, and Monte Carlo consistency of the SLAM graph."""

from dataclasses import replace

import numpy as np
import pytest
from numeric import (
    aligned_ate,
    aruco,
    as_points,
    assert_consistent,
    central_differences,
    errors_of,
    known_noise,
    mean_nees,
    only,
    short,
    sightings,
    slam_trial,
    trials,
    true_markers,
    vehicle,
    without_headings,
)
from numpy.testing import assert_allclose, assert_array_equal

from slamlib import estimate
from slamlib.core import odometry, se2
from slamlib.core.errors import DatasetError
from slamlib.core.evaluation import ate
from slamlib.core.increments import preintegrate
from slamlib.core.kernels import KERNELS, ONE_SIDED_BIAS
from slamlib.core.records import AntennaGuess, Dataset, UwbReadings
from slamlib.core.sightings import sightings_by_frame
from slamlib.core.vehicle import Vehicle
from slamlib.robust import calibration, choices, factors, initialization
from slamlib.robust.calibration import POSITIVE
from slamlib.robust.choices import DECISIVE_LEAD, better_model, ids_of_places
from slamlib.robust.fit import accepted_measurements
from slamlib.robust.initialization import GROWTH, odometry_state, part_lengths
from slamlib.robust.linear import (
    NormalEquations,
    build_problem,
    laplace_approximation,
)
from slamlib.robust.measurements import NOISE_KEYS, Noise, measure
from slamlib.robust.noise import learn_noise
from slamlib.robust.optimize import optimize
from slamlib.robust.pipeline import fit_from_odometry
from slamlib.robust.result import slam_result
from slamlib.robust.solution_doubts import GROUPS, solution_doubts
from slamlib.studies import montecarlo, simulation

COUNT = 2 * np.pi * 0.1 / 8000                            # m


def test_odometry_derivatives_against_central_differences():
    """By both poses and by the wheels, off the optimum."""
    rng = np.random.default_rng(0)
    dataset, truth = short(3, 41)
    m = measure(dataset.without("aruco").without("uwb"), [0, 40])
    poses = truth.poses[m.frame] + rng.normal(0, 0.05, (2, 3))
    wheel = dataset.vehicle.wheel + rng.normal(0, 1, 3) * dataset.vehicle.sigma_wheel
    odometry = build_problem(m, "arc").odometry

    def error(x):
        moved = se2.compose(poses, x[:6].reshape(2, 3))
        return factors.odometry_error(odometry, moved, wheel + x[6:])[0][0]

    _, J, by_wheel = factors.odometry_error(odometry, poses, wheel)
    numeric = central_differences(error, np.zeros(9))
    assert_allclose(np.hstack([J[0], by_wheel[0]]), numeric, atol=1e-6)


def learned_noise(seed, slip):
    """NEES and aligned ATE in m of problems 3 and 4, and of problem 3 where the noise is known."""
    dataset, truth = short(seed, slip=slip)
    learned, both = montecarlo.problems_3_and_4(dataset)
    known = estimate(known_noise(dataset.without("uwb"), slip), model="arc")
    numbers = {"slip": learned.slip, "rejected": learned.rejected.sum(),
               "arc": learned.model == "arc",
               "doubts": len(solution_doubts(learned) + solution_doubts(both))}
    for name, found in (("learned", learned), ("known", known), ("both", both)):
        numbers |= montecarlo.judged(name, found.poses, found.covariances, truth.poses, True)
    return numbers


@pytest.mark.slow
@pytest.mark.parametrize("slip", [0.0, 1e-2])
def test_a_slip_that_is_not_known_widens_the_covariance(slip):
    """No overconfidence, and nearly the accuracy of the graph that knows the slip.

    A usual slip is in `test_monte_carlo_is_consistent`. The mean NEES is at most 1.35 times that
    with the slip known or 3.6, whichever is larger, and no drive is above 16. With correct labels
    few sightings are rejected, nothing is doubted, and a large slip is learned from the typical
    one.
    """
    runs = trials(learned_noise, range(3000, 3008), slip=slip)
    most = max(1.35 * runs["known nees"].mean(), 3.6)
    for problem in ("learned nees", "both nees"):
        assert runs[problem].mean() < most and runs[problem].max() < 16
    assert runs["doubts"].sum() == 0
    squared = (runs[["learned ate", "known ate"]]**2).mean()
    assert squared["learned ate"] < 1.35**2 * squared["known ate"]
    if slip:
        assert runs["rejected"].mean() < 6                       # gate: 0.1 % of about 900
        assert 0.85 < np.exp(np.log(runs["slip"] / slip).mean()) < 1.15
        assert_consistent(runs["learned nees"], probability=0.999)
        assert runs["arc"].mean() > 0.8


@pytest.mark.parametrize("poses, slip", [(2000, 1e-3), (300, 0.0)])
def test_the_learned_noise_has_the_greatest_posterior(poses, slip):
    """Many and few measurements: derivatives at the mode, by small steps, are nearly zero."""
    fit = fit_from_odometry(measure(short(6, poses, slip=slip)[0]))
    equations = NormalEquations(fit.problem, fit.state)
    found = learn_noise(equations)
    mode = np.log(found.noise)

    def log_posterior(logarithms):
        prior = np.sum(((logarithms - np.log([1e-3, 1, 1])) / np.log([3, 2, 2]))**2) / 2
        return laplace_approximation(equations, Noise(*np.exp(logarithms)))[1] - prior

    for step in 0.1 * np.diag(np.sqrt(np.diag(found.covariance))):
        up = log_posterior(mode + step)
        down = log_posterior(mode - step)
        assert abs(up - down) / 0.2 < 0.2                       # for a step of one sigma
        curvature = (up + down - 2 * log_posterior(mode)) / 0.01
        assert -2 < curvature < -0.5                            # -1 without correlations


def test_two_poses_and_one_marker_by_hand():
    """Poses at 0 and x on a line, a marker at m seen from both, headings known.

    Odometry measures x as o with variance q; the sightings s_1 = m and s_2 = m - x have variance r.
    The information of (x, m) is [[1/q + 1/r, -1/r], [-1/r, 2/r]]. Hence

        x = (2 r o + q (s_1 - s_2)) / (2 r + q),
        var x = 2 r q / (2 r + q),  var m = r (r + q) / (2 r + q).

    Wheel errors are negligible, so q is the noise of rounding and slip.
    """
    r, slip, s_1, s_2 = 4e-4, 2e-2, 2.02, 0.99
    vehicle = Vehicle(sigma_right_radius=1e-7, sigma_left_radius=1e-7, sigma_wheelbase=1e-7,
                      sigma_heading=1e-7)
    ticks = np.full((101, 2), 127)
    ticks[0] = 0
    o = 100 * 127 * COUNT
    readings = sightings([0, 100], [9, 9], [[s_1, 0, 0], [s_2, 0, 0]], np.diag([r, 1e-10, 1e-12]))
    dataset = Dataset("line", vehicle, ticks, readings, None, None)
    found = estimate(known_noise(dataset, slip), model="arc")
    q = slip**2 * o / 2
    expected = (2 * r * o + q * (s_1 - s_2)) / (2 * r + q)
    assert_allclose(found.poses[100, 0], expected, atol=1e-5)
    assert_allclose(
        [found.covariances[100, 0, 0], found.marker_covariance[0, 0, 0]],
        [2 * r * q / (2 * r + q), r * (r + q) / (2 * r + q)], rtol=1e-3)


@pytest.mark.parametrize("every, sigma, off", [(10, 1e-4, 0.02), (100, 1e-3, 0.1)])
def test_interpolated_poses_equal_those_of_a_graph_with_all_poses(every, sigma, off):
    """Frames 10 rows apart, and frames a metre apart with wheel errors that matter in between."""
    dataset = vehicle(sigma_right_radius=sigma, sigma_left_radius=sigma)(short(2, 106)[0])
    keep = dataset.aruco.pose % every == 0
    dataset = known_noise(only(dataset.without("uwb"), keep), 3e-3)
    sparse = estimate(dataset, model="arc")
    dense = slam_result(fit_from_odometry(measure(dataset, range(106))))
    expected = se2.sigmas(dense.covariances)
    # The difference is of second order.
    assert (np.abs(sparse.poses - dense.poses) < 0.01 * expected + 2e-5).all()
    assert_allclose(se2.sigmas(sparse.covariances), expected, rtol=off, atol=2e-5)


@pytest.mark.slow
def test_monte_carlo_is_consistent():
    """24 drives with wrong labels; drives without are in test_uwb.

    NEES of graph poses, interpolated poses, markers and wheels: all four means are in their bands
    with probability 95 % (Bonferroni).
    """
    runs = trials(slam_trial, range(300, 324), ranges=False, mislabelled=0.03)
    for name in ("nees", "nees between", "map nees", "wheel nees"):
        assert_consistent(runs[name], probability=1 - 0.05 / 4)
    assert np.sqrt(np.mean(runs["ate"]**2)) < 0.015 and runs["ate"].max() < 0.05
    assert 0.8 < np.exp(np.mean(np.log(runs["slip"]))) / 1e-3 < 1.25
    assert 0.95 < runs["factor"].mean() < 1.03
    assert runs["arc"].mean() > 0.9                      # the evidence selects the true model
    assert (runs["share"] == 1).all()                    # no memory is found where there is none
    assert runs["map worst"].max() < 0.2                 # m: no marker is in a wrong minimum


def test_the_gate_rejects_wrong_labels_and_hardly_any_others():
    dataset, _ = short(6, mislabelled=0.03)
    wrong = dataset.aruco.marker != short(6)[0].aruco.marker
    wrong = wrong[sightings_by_frame(dataset.aruco).index]
    found = estimate(dataset.without("uwb"))
    assert found.rejected[wrong].all() and found.rejected[~wrong].mean() < 0.005
    assert not estimate(dataset.without("uwb"), gate=False).rejected.any()


def test_a_second_place_gets_a_readable_id_that_the_drive_does_not_have():
    """Marker 93 is -7 + 100."""
    found = ids_of_places(np.array([-7, 93, -7, 0, 0, 12, 12]), np.array([0, 0, 1, 0, 1, 0, 2]))
    assert_array_equal(found, [-7, 93, -107, 0, 100, 12, 212])


def drive_along(legs, monkeypatch, **layout):
    """Simulated drives follow these legs, "short" and, with this layout, "way"."""
    right, left = COUNT * simulation.manoeuvre(legs)[1:].T
    monkeypatch.setattr(simulation, "_driven_arcs",
                        lambda *_: ((right + left) / 2, (right - left) / 0.4))
    way = replace(simulation.PATHS["short"], **layout)
    monkeypatch.setitem(simulation.PATHS, "way", way)


@pytest.mark.parametrize("legs", [[(60, 0)], [(30, 0), (0.8, np.pi / 2), (30, 0)]])
def test_nothing_is_released_in_a_clean_corridor(legs, monkeypatch):
    """Without a loop only what is stated gives the metre.

    On a straight way nothing tells the wheelbase, nor both radii with the size of the markers: they
    stay near what is stated even if they are released.
    """
    drive_along(legs, monkeypatch)
    for seed in (0, 1):
        dataset, truth = simulation.simulate("short", seed, slip=3e-3)
        found = estimate(dataset.without("uwb"))
        assert not found.released and not solution_doubts(found)
        assert mean_nees(found, truth) < 8
        if len(legs) == 1:
            calibration = found.fit.problem.measurements.calibration
            for groups in (["wheelbase"], ["wheel-scale", "marker-size"]):
                wanted = choices._Proposal(
                    found.fit.explanations, calibration.prior(groups), -1e9)
                c = choices._released(found.fit, wanted).state.c[POSITIVE]
                assert_allclose(c, calibration.stated[POSITIVE], rtol=0.1)


def test_rounds_end_where_the_calibration_is_impossible(monkeypatch, caplog):
    """As where a clean corridor is explained by wheels and markers of a twentieth of their size."""
    caplog.set_level("INFO", logger="slamlib.robust.fit")
    dataset, _ = simulation.simulate("short", 1)
    longer = replace(dataset.vehicle, wheelbase=0.42)
    dataset = replace(dataset.without("uwb"), vehicle=longer)
    estimate(dataset)
    assert "round 2:" in caplog.text
    caplog.clear()
    monkeypatch.setattr(calibration, "MAX_RATIO", 1.0)
    estimate(dataset)
    assert "round 1:" in caplog.text and "round 2:" not in caplog.text


def test_a_wrong_size_in_a_corridor_is_told_with_the_metre_in_doubt(monkeypatch):
    """Wheels or markers: nothing else gives the metre, so the covariances include both."""
    drive_along([(60, 0)], monkeypatch)
    dataset, truth = simulation.simulate("short", 5, slip=3e-3)
    vehicle = replace(dataset.vehicle, marker_size=1.03)
    found = estimate(replace(dataset, vehicle=vehicle, uwb=None))
    assert [doubt.what for doubt in solution_doubts(found)] == ["marker-size"]
    assert mean_nees(found, truth) < 8 and 2e-3 < found.slip < 4e-3


def test_noise_of_turns_does_not_make_the_wheelbase_long(monkeypatch):
    """Stated to 5 % on a gently curved way: noise once made it ten sigmas too long, or more."""
    drive_along([(20, 1.2), (20, -2.0), (20, 0.8)], monkeypatch)
    for seed in (0, 1):
        dataset, truth = simulation.simulate("short", seed, slip=8e-3)
        vehicle = replace(dataset.vehicle, sigma_wheelbase=0.02)
        found = estimate(replace(dataset, vehicle=vehicle, uwb=None))
        off = found.wheel[2] - truth.vehicle.wheelbase
        assert abs(off) < 2.5 * found.wheel_covariance[2, 2]**0.5 < 0.06


@pytest.mark.slow
@pytest.mark.parametrize("legs, every, seed, radii, named", [
    ([(30, 0.6), (30, -1.0), (30, 0.5)], 10, 7116, (0.102, 0.102),
     {"wheel-scale", "wheel-radii", "marker-size"}),     # which the drive cannot tell apart
    ([(150, 0)], 24, 7110, (0.101, 0.1), {"wheel-radii"})])
def test_wrong_wheels_on_a_long_way_are_neither_jumps_nor_memory(
        legs, every, seed, radii, named, monkeypatch):
    """Odometry seems to have jumps, or the sightings slow errors; neither is believed."""
    drive_along(legs, monkeypatch, aruco_every=every, marker_spacing=1.5)
    dataset, truth = simulation.simulate("way", seed, slip=3e-3)
    wrong = vehicle(right_radius=radii[0], left_radius=radii[1])(dataset)
    found = estimate(replace(wrong, uwb=None))
    doubt, = solution_doubts(found)
    assert {group for group, (name, _) in GROUPS.items()
            if group == doubt.what or name in doubt.sentence} == named
    assert mean_nees(found, truth) < 6 and 2e-3 < found.slip < 4e-3


@pytest.mark.slow
@pytest.mark.parametrize("legs, every, seed, slip", [
    ([(30, 0), (0.8, np.pi / 2), (40, 0)], 10, 7128, 3e-3),
    ([(30, 0), (0.8, np.pi), (30, 0)], 31, 7135, 8e-3)])
def test_a_delay_at_a_corner_is_neither_a_jump_nor_a_moved_camera(
        legs, every, seed, slip, monkeypatch):
    """Only there does it show; the solution without jumps must be free to find it."""
    drive_along(legs, monkeypatch, aruco_every=every, marker_spacing=1.5)
    dataset, truth = simulation.simulate("way", seed, slip=slip)
    found = estimate(replace(vehicle(sighting_lag=6.0)(dataset), uwb=None))
    assert [doubt.what for doubt in solution_doubts(found)] == ["time-offset"]
    assert mean_nees(found, truth) < 8


def test_a_ceiling_that_is_not_level_is_no_slip(monkeypatch):
    """By 0.3 % of its height a metre, on three rounds: 9.5 mm off, NEES 38, by a slip of 3 mm."""
    corner = (1.2, np.pi / 2)
    drive_along(6 * [(5, 0), corner, (3, 0), corner], monkeypatch, marker_spacing=1.5)
    dataset, truth = simulation.simulate("way", 1)
    x = truth.marker_in_world[np.searchsorted(truth.marker, dataset.aruco.marker), 0]
    scale = 1 + 0.003 * (x - x.mean())
    z = dataset.aruco.marker_in_vehicle * np.stack([scale, scale, np.ones_like(x)], axis=1)
    found = estimate(aruco(dataset, marker_in_vehicle=z).without("uwb"))
    assert [doubt.what for doubt in solution_doubts(found)] == ["marker-memory"]
    assert mean_nees(found, truth) < 6 and aligned_ate(found, truth) < 0.004


def test_what_is_not_told_does_not_cost_metres(monkeypatch):
    """A camera elsewhere looks like a wheelbase, by which the end would be 2.6 m off."""
    drive_along([(30, 0), (0.8, np.pi / 2), (40, 0)], monkeypatch, aruco_every=24,
                marker_spacing=1.5)
    dataset, truth = simulation.simulate("way", 7126, slip=8e-3)
    found = estimate(replace(vehicle(camera_x=0.15)(dataset), uwb=None))
    assert not found.released
    assert mean_nees(found, truth) < 6 and aligned_ate(found, truth) < 0.5


def test_derivatives_have_expected_turns_but_those_of_corners_as_counted():
    """All wheels larger by one factor lengthen an increment and turn nothing, as before."""
    corner = [(5, 0), (0, np.pi / 2), (5, 0)]
    rng = np.random.default_rng(0)
    ticks = np.rint(simulation.manoeuvre(corner) + rng.normal(0, 10, (1033, 2)))
    vehicle = short(1)[0].vehicle
    m = measure(Dataset("corner", vehicle, ticks, None, None, None), np.arange(0, 1033, 10))
    plain = preintegrate(m.dataset, m.frame)
    J = factors.preintegrate_odometry(m, "arc", slip=8e-3).J_wheel
    lengthened = np.column_stack([plain.increment[:, :2], np.zeros(len(J))])
    assert_allclose(J @ vehicle.wheel, lengthened, atol=1e-9)
    turn = plain.increment[:, 2]
    is_corner = turn > 0.2
    assert 3 <= is_corner.sum() < 20
    assert_allclose(J[is_corner, 2], plain.J_wheel[is_corner, 2], rtol=0.05)
    straight = slice(0, 25)
    assert J[straight, 2, 2].std() < 0.3 * plain.J_wheel[straight, 2, 2].std()


def test_the_noise_in_derivatives_is_that_of_the_learned_slip(monkeypatch):
    """Also if the first round is the last. By a third of the slip a half of it would remain."""
    drive_along([(60, 0)], monkeypatch)
    for seed in (2, 4):
        fit = fit_from_odometry(
            measure(simulation.simulate("short", seed, slip=3e-3)[0].without("uwb")))
        problem = fit.problem
        expected = factors.preintegrate_odometry(
            problem.measurements, "arc", problem.odometry.wheel, problem.noise.slip)
        assert problem.noise.slip > 2e-3
        assert_allclose(problem.odometry.J_wheel, expected.J_wheel, rtol=1e-9, atol=1e-12)


def test_the_evidence_is_the_same_by_odometry_linearised_at_other_wheels():
    """For a released wheelbase, of which a longer one makes the noise of turns no smaller."""
    m = measure(simulation.simulate("long", 1)[0].without("uwb"))
    noise = Noise(2e-3)
    problem = replace(build_problem(m, "arc", noise), prior=m.calibration.prior({"wheelbase"}))
    state = optimize(problem, initialization.initial_state(m, "arc")[0]).state

    def log_evidence(factor):
        wheel = m.dataset.vehicle.wheel * [1, 1, factor]
        odometry = factors.preintegrate_odometry(m, "arc", wheel, noise.slip)
        elsewhere = replace(problem, odometry=odometry)
        return laplace_approximation(optimize(elsewhere, state).equations, noise)[1]

    assert_allclose([log_evidence(0.97), log_evidence(1.03)], log_evidence(1.0), atol=0.5)


@pytest.mark.parametrize("times", [(1.1, 1.1, 1.0), (1.0, 1.0, 1.2), (1.1, 1.1, 1.1)])
def test_odometry_alone_says_nothing_about_the_wheels(times):
    """On the path that they make of the counts any wheels have the same evidence."""
    dataset, _ = short(1, 200)
    m = measure(dataset.without("aruco").without("uwb"), np.arange(0, 200, 10))

    def evidence(wheel):
        problem = build_problem(m, "arc", wheel=wheel)
        known = replace(problem.prior, root=0 * problem.prior.root)
        vehicle = dataset.vehicle.with_wheel(wheel)
        poses = odometry.dead_reckoning(dataset.ticks, vehicle, model="arc")[m.frame]
        c = m.calibration.stated.copy()
        c[calibration.WHEELS] = wheel
        state = replace(odometry_state(m, "arc"), poses=poses, c=c)
        equations = NormalEquations(replace(problem, prior=known), state)
        return laplace_approximation(equations, problem.noise)[1]

    stated = dataset.vehicle.wheel
    assert_allclose(evidence(stated * times), evidence(stated), atol=1e-6)


def test_parts_of_a_drive_grow_at_most_fourfold_from_where_the_heading_is_lost():
    """A turn of one rad a metre: a wheelbase known to 5 % loses 0.5 rad after ten metres."""
    ticks = np.rint(simulation.manoeuvre(300 * [(1.0, 1.0)]))
    drive = Dataset("turns", Vehicle(sigma_wheelbase=0.02), ticks, None, None, None)
    lost = len(ticks) / 30
    ends = part_lengths(drive)
    assert len(ends) == 4 and ends[-1] == len(ticks) and 0.9 * lost < ends[0] < 1.6 * lost
    assert all(later <= GROWTH * end + 1 for end, later in zip(ends, ends[1:]))
    sure = Vehicle(sigma_wheelbase=1e-6, sigma_right_radius=1e-6, sigma_left_radius=1e-6)
    assert part_lengths(replace(drive, vehicle=sure)) == [len(ticks)]
    ends = part_lengths(replace(drive, vehicle=sure), slip=0.03)
    metres = 0.5**2 / (2 * 0.03**2 / 0.4**2)         # where both wheels' slip has turned it by 0.5
    assert ends[0] == pytest.approx(len(ticks) * metres / 300, rel=0.02)


@pytest.mark.slow
def test_parts_of_a_drive_tell_a_large_slip():
    """3 cm after one metre; markers are points, wheels known to 3 %.

    With the typical slip the wheels of each part predict the next one badly.
    """
    stated = Vehicle(sigma_right_radius=3e-3, sigma_left_radius=3e-3, sigma_wheelbase=1.2e-2)
    dataset, truth = simulation.simulate("long", 2, slip=0.03, vehicle=stated, poses=9000)
    dataset = replace(dataset, aruco=without_headings(dataset.aruco)).without("uwb")
    result = estimate(dataset)
    assert 0.027 < result.noise.slip < 0.033
    assert 0.95 < result.noise.sightings < 1.05
    assert aligned_ate(result, truth) < 0.03
    known = measure(dataset.stating({"slip": 0.02}, "test"))
    assert initialization.initial_state(known, "arc")[1].slip == 0.02


def test_all_parts_of_a_drive_are_solved_one_after_the_other(monkeypatch):
    """Twice, with the slip of the one before and its own. The whole drive is left to the rounds."""
    solved = []

    def narrow_kernels(problem, state, scales=()):
        solved.append(len(problem.measurements.dataset.ticks))
        return optimize(problem, state, max_steps=1)

    monkeypatch.setattr(initialization, "part_lengths", lambda *_: [200, 400, 600])
    monkeypatch.setattr(initialization, "narrow_kernels", narrow_kernels)
    initialization.initial_state(measure(short(4, 600)[0]), "arc")
    assert solved == [200, 200, 400, 400]


@pytest.mark.slow
@pytest.mark.parametrize("name, known", [
    ("slip", 2e-3), ("marker_noise_factor", 1.3), ("range_noise_factor", 0.8)])
def test_noise_that_is_known_is_not_learned_and_the_rest_is(name, known):
    """From odometry and from a result; sigmas say which."""
    dataset, _ = short(4, 400)
    is_known = np.isin(NOISE_KEYS, name)
    for before in (None, estimate(dataset.without("uwb"))):
        found = estimate(dataset, previous=before, **{name: known})
        assert_array_equal(found.noise_sigma == 0, is_known)
        values = np.array(found.noise)
        assert_allclose(values[is_known], known, rtol=1e-12)
        assert (values != [1e-3, 1, 1]).all()


@pytest.mark.parametrize("name, value, other", [
    ("slip", 2e-3, 1e-3), ("marker_noise_factor", 1.3, 1.0), ("range_noise_factor", 0.8, 1.0),
    ("kernel", "Huber", "Tukey"), ("gate", False, True)])
def test_options_are_those_of_the_vehicle_and_decide_where_both_are_given(name, value, other):
    dataset, _ = short(4, 300, late_ranges=0.05, mislabelled=0.1)
    found = estimate(vehicle(**{name: other})(dataset), **{name: value})
    assert_array_equal(found.poses, estimate(vehicle(**{name: value})(dataset)).poses)
    assert (found.poses != estimate(dataset, **{name: other}).poses).any()


@pytest.mark.parametrize("options, told", [
    ({"kernel": "huber"}, 'estimate: expected "asymmetric Tukey" or .* for kernel, found .huber'),
    ({"model": "line"}, "estimate: expected euler or arc for model, found 'line'"),
    ({"marker_noise_factor": 0.0}, "expected a number from 0.01 to 100 for marker_noise_factor"),
    ({"gate": "no"}, "expected true or false for gate, found 'no'"),
    ({"dataset": "data/short"}, "estimate: expected a Dataset, found .data/short.")])
def test_an_option_with_a_wrong_name_or_value_is_told_with_what_there_is(options, told):
    with pytest.raises(DatasetError, match=told):
        estimate(**{"dataset": short(4, 50)[0]} | options)


@pytest.mark.slow
@pytest.mark.parametrize("kernel", KERNELS)
def test_every_kernel_solves_a_drive_with_wrong_labels_and_late_ranges(kernel):
    """Without gates, too, but for quadratic errors, which follow the wrong labels.

    Kernels take part of the variance of good measurements, too, which the learned factors contain.
    """
    dataset, truth = short(4, 800, mislabelled=0.01, late_ranges=0.05)
    gated = estimate(dataset, kernel=kernel, model="arc")
    assert gated.rejected.any() and ate(gated.poses, truth.poses) < 0.02
    assert_allclose(gated.noise.sightings, 1, atol=0.05)
    if kernel not in ONE_SIDED_BIAS:                # those leave the errors of sightings quadratic
        found = estimate(dataset, kernel=kernel, model="arc", gate=False)
        assert (ate(found.poses, truth.poses) < 0.03) == (kernel != "quadratic")


@pytest.mark.parametrize("noise, gates, weights", [
    (Noise(), (), [1, 0, 1, 0, 1, 0, 1]), (Noise(sightings=1.1, ranges=1.1), (), 7 * [1]),
    (Noise(), (("quadratic", True), ("Huber", True)), [1, 0, 1, 0, 1, 0, 0])])
def test_gates_of_poses_points_and_ranges(noise, gates, weights):
    """Residuals just below and above the gates; a range may be too long by any number of sigmas."""
    z = 0.01 * np.outer(np.sqrt([16.2, 16.3, 13.8, 13.9]), [1, 0, 0])
    readings = as_points(sightings(4 * [0], range(4), z, 1e-4 * np.eye(3)), slice(2, None))
    at = np.zeros(3, int)
    ranges = UwbReadings(at, at, np.array([4.68, 4.66, 10]), np.full(3, 0.1))
    place = np.array([[3.0, 4.0]])
    m = measure(Dataset("still", Vehicle(), np.zeros((1, 2), int), readings, ranges,
                        AntennaGuess(at[:1], place)))
    problem = build_problem(m, "arc", noise)
    there = replace(odometry_state(m, "arc"), markers=0 * z, antennas=place)
    found = accepted_measurements(problem, there, *gates)
    assert_array_equal(np.r_[found.sightings.weight, found.ranges.weight], weights)


@pytest.mark.parametrize("true, other", [("arc", "euler"), ("euler", "arc")])
def test_the_evidence_chooses_the_steps_that_the_vehicle_drives(true, other):
    """Without slip; the measurements and their weights stay those of the fit."""
    dataset, truth = short(3, 1000, noise=False)
    a = dataset.aruco
    poses = odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model=true)
    z = se2.between(poses[a.pose], true_markers(truth, a.marker))
    z += errors_of(a.covariance, np.random.default_rng(0))
    m = measure(known_noise(aruco(dataset.without("uwb"), marker_in_vehicle=z), 1e-4))
    right, wrong = fit_from_odometry(m, true), fit_from_odometry(m, other)
    assert better_model(right) is right
    found = better_model(wrong)
    assert found.problem.odometry.model == true
    assert found.log_evidence > wrong.log_evidence + DECISIVE_LEAD
    for ours, theirs in zip(found.problem.accepted, wrong.problem.accepted):
        assert_array_equal(ours.weight, theirs.weight)


def test_headings_are_continuous_where_frames_are_rounds_apart():
    """Markers at both ends of three rounds only: between two frames the vehicle turns by 6 pi."""
    dataset, truth = short(5, rounds=3)
    ends = np.abs(dataset.aruco.pose - len(dataset.ticks) / 2) > len(dataset.ticks) / 2 - 50
    found = estimate(only(dataset.without("uwb"), ends))
    assert abs(truth.poses[-1, 2]) > 18
    assert_allclose(found.poses[:, 2], truth.poses[:, 2], atol=0.3)
    assert np.abs(np.diff(found.poses[:, 2])).max() < 0.1


def test_a_drive_of_one_pose_has_its_prior():
    dataset, _ = short(8, 1)
    found = estimate(dataset)
    sigma = np.array([1e-5, 1e-5, dataset.vehicle.sigma_heading])
    assert_allclose(found.covariances, [np.diag(sigma**2)], atol=1e-18)
    assert not found.poses.any() and len(found.marker) == len(dataset.aruco.pose) > 0
    assert repr(found).startswith("SlamResult of 1 poses, mean sigma ")
    assert found.disagreement < 1e-6
