"""Errors with memory, ids that are several places: covariances are honest, the estimate holds."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from numeric import aligned_ate, aruco, mean_nees, short, sightings, uwb, vehicle, without_headings
from numpy.testing import assert_allclose, assert_array_equal

from slamlib import estimate
from slamlib.core.evaluation import ate, nees_band
from slamlib.core.vehicle import TABLE_2
from slamlib.robust import choices
from slamlib.robust.choices import SMALL_SLIP, _squared_distance, visits
from slamlib.robust.error_memory import error_memory, memory_of_each
from slamlib.robust.fit import (
    error_memories,
    narrow_kernels,
    refine,
    refine_without_memory,
    turns_by_slip,
)
from slamlib.robust.initialization import initial_state
from slamlib.robust.linear import build_problem
from slamlib.robust.measurements import Noise, measure
from slamlib.robust.noise import with_least_slip
from slamlib.robust.solution_doubts import solution_doubts
from slamlib.studies.montecarlo import antenna_error
from slamlib.studies.simulation import simulate

LANDMARKS, EACH = 40, 10


def tracks(error, changes=None):
    """Arguments of `error_memory` for residuals (LANDMARKS, EACH, 3), ten poses apart."""
    landmark, k = np.divmod(np.arange(LANDMARKS * EACH), EACH)
    u = error.reshape(-1, 3)
    if changes is None:
        changes = np.zeros((len(u), 3, 1))
    return landmark, 10 * k, u, changes, np.ones(len(u), bool)


def test_independent_errors_keep_all_their_information():
    """The landmark takes over their mean, without which they correlate by -1 / EACH.

    The posterior of the mean has the variance 1 / EACH, and gives back what is missing.
    """
    rng = np.random.default_rng(0)
    error = rng.standard_normal((LANDMARKS, EACH, 3))
    residual = error - error.mean(axis=1, keepdims=True)
    mean = rng.standard_normal((LANDMARKS, 1, 3, 30)) / np.sqrt(EACH)
    changes = np.repeat(mean, EACH, axis=1).reshape(-1, 3, 30)
    found = error_memory(*tracks(residual, changes))
    assert (found.share == 1).all() and abs(found.correlation) < 2 * found.sigma < 1 / EACH
    assert found.sigma == pytest.approx(1 / np.sqrt(LANDMARKS * (EACH - 1) * 3))
    assert error_memory(*tracks(residual)).correlation < -2 * found.sigma


@pytest.mark.parametrize("scatter, change, added", [(1.0, 0.15, 0.0225), (0.98, 0.1, 0.0396)])
def test_shares_by_hand(scatter, change, added):
    """Pairs of equal errors: neighbours correlate by 1, the fourth of four with two others not.

    The posterior adds 0.0225 to each product. In the other case the mean of squares lacks 0.0296 of
    1 beside the 0.01 that it adds.
    """
    error = np.repeat(np.random.default_rng(2).standard_normal((LANDMARKS, 5, 3)), 2, axis=1)
    of = error[:, 1:]                        # the first of each landmark stays alone
    of *= scatter / np.sqrt(np.mean(of**2))
    changes = np.full((LANDMARKS * EACH, 3, 4), change)
    landmark, pose, u, changes, used = tracks(error, changes)
    used[::EACH] = False
    product = np.array([np.mean(of[:, lag:] * of[:, :-lag]) for lag in (1, 2)])
    rho = product + added
    assert rho[0] > 0.3 and rho[1] < 0.05
    for each in (pose, pose // 10):          # also where every pose has a measurement
        memory = error_memory(landmark, each, u, changes, used)
        neighbours = product[0] + change**2
        assert memory.correlation == pytest.approx(neighbours / (scatter**2 + change**2))
        share = memory.share.reshape(LANDMARKS, EACH)
        assert_allclose(share[:, 0], share[:, 1:].mean())      # not used: as the others
        assert_allclose(share[:, [1, -1]], 1 / (1 + rho[0]))
        assert_allclose(share[:, 2:-1], 1 / (1 + 2 * rho[0]))


def test_memory_is_told_and_counted():
    dataset = short(3, memory=0.9)[0].without("uwb")
    result = estimate(dataset)
    assert result.correlation[0] > 0.4 and result.correlation[1] == 0
    assert result.share.sum() < len(dataset.aruco.pose) / 3
    assert result.noise.sightings == pytest.approx(1, abs=0.05)
    sentence, = (doubt.sentence for doubt in solution_doubts(result)
                 if doubt.what == "marker-memory")
    assert f"counts {len(result.share)} sightings as {result.share.sum():.0f}" in sentence


@pytest.mark.parametrize("weak, own", [(0.0, True), (0.2, False), (0.5, False)])
def test_an_antenna_has_its_own_memory_if_the_others_have_none(weak, own):
    """Beside one of correlation 0.8. Correlations of 0.2 show only in three antennas together."""
    count = 250
    rho = np.repeat([weak, weak, weak, 0.8], count)
    error = np.random.default_rng(3).standard_normal(4 * count)
    for k in range(1, 4 * count):
        error[k] = rho[k] * error[k - 1] + np.sqrt(1 - rho[k]**2) * error[k]
    antenna, pose = np.divmod(np.arange(4 * count), count)
    columns = antenna, pose, error[:, None], np.zeros((4 * count, 1, 1)), np.ones(4 * count, bool)
    share = memory_of_each(*columns).share
    expected = error_memory(*columns, adds_lack=False).share
    if own:
        last = antenna == 3
        of_last = error_memory(*(column[last] for column in columns), adds_lack=False)
        expected = np.where(last, np.append(np.ones(3 * count), of_last.share), 1)
    assert_allclose(share, expected)
    assert share[:-count].max() == 1 if own else share.max() < 0.7


@pytest.mark.parametrize("seed", [1, 4])
def test_a_wall_before_one_antenna_is_not_before_the_others(seed):
    """Its ranges are 0.4 m too long over 60 % of the drive; the others' errors are independent."""
    dataset, truth = short(seed)
    x = truth.poses[dataset.uwb.pose, 0]
    antenna = dataset.uwb.antenna
    hidden = (antenna == antenna.min()) & (x < np.quantile(x, 0.6))
    result = estimate(uwb(dataset.without("aruco"), range=dataset.uwb.range + 0.4 * hidden))
    assert aligned_ate(result, truth) < 0.01 and mean_nees(result, truth) < 4
    assert (result.share[antenna > antenna.min()] == 1).all()
    assert result.share[antenna == antenna.min()].mean() < 0.1 and result.correlation[1] > 0.4
    sentence, = (doubt.sentence for doubt in solution_doubts(result)
                 if doubt.what == "range-memory")
    assert f"ranges (antenna {antenna.min()}) are alike" in sentence


def test_slow_errors_are_not_as_large_as_stated_if_they_are_smaller():
    """Three times their standard deviations are in the file; the path is nearly as right."""
    dataset, truth = short(3, memory=0.9)
    right = dataset.without("uwb")
    found = estimate(aruco(right, covariance=9 * right.aruco.covariance))
    assert 0.3 < found.noise.sightings < 0.7
    assert aligned_ate(found, truth) < 1.35 * aligned_ate(estimate(right), truth)
    assert mean_nees(found, truth) < 6


def test_beside_slow_errors_no_slip_below_the_typical_one_is_believed():
    low = Noise(1e-4, 1.0, 1.0)
    assert with_least_slip(low, True, TABLE_2).slip == 1e-3
    assert with_least_slip(low, False, TABLE_2) == low
    assert with_least_slip(low, True, replace(TABLE_2, slip=1e-4)) == low
    large = low._replace(sightings=2.0)              # errors that an image's markers may share
    assert with_least_slip(large, False, TABLE_2) == large._replace(slip=1e-3)


def test_slow_errors_of_a_sensor_are_no_slip():
    """Sightings whose distances are off by 1 % a metre across the room: a tilted ceiling."""
    dataset, truth = short(1)
    across = truth.poses[dataset.aruco.pose, :1] - truth.poses[:, 0].mean()
    tilted = dataset.aruco.marker_in_vehicle * (1 + 0.01 * across * [1, 1, 0])
    found = estimate(aruco(dataset.without("uwb"), marker_in_vehicle=tilted))
    assert found.fit.problem.memory_first and found.slip < 2e-3
    assert aligned_ate(found, truth) < 0.012     # 0.026 by slip


def shaken(dataset, sigma, poses):
    """The Dataset whose camera moves ahead and back by `sigma` m, alike for that many poses."""
    rng = np.random.default_rng(1)
    ahead = np.convolve(rng.standard_normal(len(dataset.ticks)), np.ones(poses), "same")
    off = np.outer(sigma / poses**0.5 * ahead[dataset.aruco.pose], [1, 0, 0])
    return aruco(dataset, marker_in_vehicle=dataset.aruco.marker_in_vehicle + off)


def test_a_camera_that_shakes_is_no_slip():
    """All markers move alike, as if the vehicle did: 0.08 m of slip would explain it."""
    dataset, truth = short(5)
    dataset = shaken(dataset, 0.03, poses=30)
    without = dataset.without("uwb")
    found = estimate(without)
    assert aligned_ate(found, truth) < 0.012     # 0.028 by slip
    assert mean_nees(found, truth) < 6           # 12 by slip
    assert "marker-memory" in [doubt.what for doubt in solution_doubts(found)]
    both = estimate(dataset, previous=found)
    assert both.fit.problem.max_slip == found.fit.problem.max_slip == SMALL_SLIP
    assert both.slip < 2e-3


@pytest.mark.parametrize("options, correlation, slip", [
    ({"slip": 0.02}, 0, 0.02), ({"memory": 0.9}, 0.87, 1e-3), ({"memory": 0.5}, 0.48, 1e-3)])
def test_slip_first_or_memory_first_end_alike(options, correlation, slip):
    """Starts are wrong for one of them; the errors that the posterior expects lead to the truth."""
    measurements = measure(short(2, **options)[0].without("uwb"))
    problem = build_problem(measurements, "arc")
    state = narrow_kernels(problem, initial_state(measurements, "arc")[0]).state
    either = [refine(replace(problem, memory_first=first), state) for first in (True, False)]
    for fit in either:
        found = error_memories(fit.problem, fit.state, fit.problem.accepted)[0]
        assert found.correlation == pytest.approx(correlation, abs=0.04)
        assert fit.problem.noise.slip == pytest.approx(slip, rel=0.1)
        assert fit.problem.noise.sightings == pytest.approx(1, abs=0.1)
    assert (either[0].problem.accepted.share == 1).all() == (correlation == 0)
    apart = either[0].state.poses - either[1].state.poses
    assert np.abs(apart).max() < 0.01        # m, rad, about their standard deviations


def test_a_large_slip_is_no_error_of_a_sensor():
    dataset, truth = short(1, slip=0.03)
    found = estimate(dataset.without("uwb"))
    assert [doubt.what for doubt in solution_doubts(found)] == ["wheel-slip"]
    assert found.noise.sightings == pytest.approx(1, abs=0.1)
    assert found.slip == pytest.approx(0.03, rel=0.2)
    assert aligned_ate(found, truth) < 0.008     # 0.08 by memory


def with_wrong_poses(dataset, seed, most):
    """The Dataset of whose images each is at most so many poses off, by chance."""
    pose, image = np.unique(dataset.aruco.pose, return_inverse=True)
    off = np.random.default_rng(1000 + seed).integers(-most, most + 1, len(pose))
    return aruco(dataset, pose=np.clip(pose + off, 0, len(dataset.ticks) - 1)[image])


def learned_by_slip(dataset, poses=()):
    """The slip that is learned if all errors are independent, and whether it turns the vehicle."""
    measurements = measure(dataset, poses)
    problem = build_problem(measurements, "arc")
    state = narrow_kernels(problem, initial_state(measurements, "arc")[0]).state
    fit = refine_without_memory(problem, state)
    return fit.problem.noise.slip, turns_by_slip(fit.problem, fit.state)


@pytest.mark.parametrize("poses", [100, 200, None])
@pytest.mark.parametrize("seed, slip", [(1, 0.03), (3, 0.03), (2, 0.006)])
def test_slip_turns_the_vehicle(seed, slip, poses):
    """Also where between images or ranges there are variables without measurements."""
    for without, variables in (("uwb", ()), ("uwb", range(0, poses or 2000, 2)), ("aruco", ())):
        dataset = short(seed, poses, slip=slip)[0].without(without)
        learned, turns = learned_by_slip(dataset, variables)
        assert learned < 2e-3 or turns
        if not poses and without == "uwb":
            assert learned == pytest.approx(slip, rel=0.25)


@pytest.mark.parametrize("poses", [100, 200, None])
@pytest.mark.parametrize("seed, most", [(3, 3), (2, 6), (7, 5)])
def test_errors_of_images_do_not_turn_the_vehicle(seed, most, poses):
    """In x, y they look like a slip of 30 to 100 mm, in the heading like a fraction of it."""
    drive = short(seed, poses)[0].without("uwb")
    learned, turns = learned_by_slip(with_wrong_poses(drive, seed, most))
    assert learned > 0.03 and not turns
    learned, turns = learned_by_slip(shaken(drive, 0.03, 30))
    assert learned < 3e-3 or not turns


def test_variables_without_measurements_do_not_make_errors_of_images_a_slip():
    """Ten increments are then less than the way between two images, which say nothing of it."""
    drive = with_wrong_poses(short(1, 600)[0].without("uwb"), 1, 3)
    for poses in (), range(600):
        learned, turns = learned_by_slip(drive, poses)
        assert learned > 0.05 and not turns


@pytest.mark.parametrize("seed, most", [(3, 3), (7, 5)])
def test_images_with_wrong_poses_are_no_slip(seed, most):
    """16 and 380 mm where the size of the headings' errors did not count."""
    dataset, truth = short(seed)
    found = estimate(with_wrong_poses(dataset.without("uwb"), seed, most))
    assert found.slip < 2.1e-3 and found.noise.sightings > 1.5
    assert aligned_ate(found, truth) < 0.008


@pytest.mark.slow
@pytest.mark.parametrize("poses, headings", [(3000, True), (6000, True), (6000, False)])
def test_a_slip_of_centimetres_is_believed_and_solved_from_a_start_with_it(poses, headings):
    """Solved with 1 mm, the path ends at a wrong minimum: 0.35, 0.78 and 1.9 m."""
    dataset, truth = simulate("long", 1, slip=0.03)
    dataset = dataset.without("uwb").first(poses)
    if not headings:
        dataset = replace(dataset, aruco=without_headings(dataset.aruco))
    found = estimate(dataset)
    assert found.slip == pytest.approx(0.03, rel=0.05)
    assert found.noise.sightings == pytest.approx(1, abs=0.05)
    assert np.count_nonzero(found.rejected) < 8
    assert ate(found.poses, truth.poses[:poses], aligned=True) < 0.2


def test_covariances_are_honest():
    """Mean NEES of every method, 3 is expected; without memory of errors it is overconfident.

    On the drives of the study, whose rows test_studies confirms. Shares of information are
    conservative where the correlation is far from 0 and 1. Independent errors are in test_slam.
    """
    runs = pd.read_csv(ROOT / "notebooks" / "studies" / "memory_0.9.csv", comment="#")
    for method in ("markers", "problem 3", "problem 4"):
        assert 1 < runs[f"{method} nees"].mean() < 5
    assert (runs["share"] < 1).all() and abs(runs["correlation"].mean() - 0.9) < 0.02
    assert runs["independent nees"].mean() > nees_band(len(runs))[1]


@pytest.mark.slow
def test_antennas_with_echoes_that_stay_are_as_far_off_as_their_covariances_say():
    """Their errors have a mean in a drive as long as they last, which is an offset."""
    squared = []
    for seed in range(3):
        dataset, truth = short(seed)
        slow = 0.28 * np.sin(dataset.uwb.pose / 400 + dataset.uwb.antenna + seed)
        result = estimate(uwb(dataset, range=dataset.uwb.range + slow))
        squared.append(antenna_error(result, truth)[1])
        assert result.released <= {"range-delay", "antenna-offsets"}
    assert np.median(squared) < 8


# An id is one place until it is not.


@pytest.mark.parametrize("latest", [4, 6])
@pytest.mark.parametrize("seed", [2, 3])
def test_images_with_wrong_pose_ids_are_no_slip_and_do_not_hide_a_wrong_size(latest, seed):
    """Each is up to `latest` poses late, by chance: a slip of 50 to 90 mm, 65 mm off before."""
    dataset, truth = short(seed, rounds=2)
    pose, image = np.unique(dataset.aruco.pose, return_inverse=True)
    late = pose + np.random.default_rng(seed).integers(0, latest + 1, len(pose))
    readings = replace(dataset.aruco, pose=late[image])
    dataset = replace(dataset, aruco=readings.select(readings.pose < len(dataset.ticks)), uwb=None)
    found = estimate(vehicle(marker_size=0.98)(dataset))
    assert aligned_ate(found, truth) < 0.005 and mean_nees(found, truth) < 6
    assert found.released == {"marker-size", "time-offset"}


def test_a_slip_comes_within_its_bound_from_above():
    measurements = measure(short(2)[0].without("uwb"))                 # by a slip of 1 mm
    problem = replace(build_problem(measurements, "arc", Noise(1.2e-3)), max_slip=5e-4)
    state = narrow_kernels(problem, initial_state(measurements, "arc")[0]).state
    assert refine(problem, state).problem.noise.slip == pytest.approx(5e-4, rel=0.01)


def test_a_pair_of_less_than_half_an_interval_leaves_no_negative_share():
    """The first two of four sightings of each marker have opposite errors, the others are alike."""
    marker = np.repeat(np.arange(400), 4)
    pose = np.tile([0, 1, 10, 19], 400)
    error = np.tile([3.0, -2.0, 1.0, 1.0], 400)[:, None]
    found = error_memory(marker, pose, error, np.zeros((1600, 1, 1)), np.ones(1600, bool))
    assert found.correlation > 0.1 and (found.share > 0).all() and (found.share <= 1).all()


def test_visits_end_with_a_long_break():
    """Sightings every 10 poses; breaks of 40 poses stay within a visit, of 1,000 they end it."""
    pose = np.r_[0:50:10, 80:120:10, 1120:1150:10, 5:35:10]
    order = np.argsort(pose, kind="stable")
    marker, expected = np.repeat([[3, 3, 3, 8], [0, 0, 1, 2]], [5, 4, 3, 3], axis=1)[:, order]
    found = visits(sightings(pose[order], marker, np.zeros((15, 3)), np.eye(3)))
    assert_array_equal(found, expected)


@pytest.mark.parametrize("off, P_1, P_2, squared", [
    ([0, 0.4, 0.2], 1, 5, 0.2**2 / 0.2**2), ([0.1, 0, 0], 2, 1, 0.1**2 / 0.02**2)])
def test_the_distance_of_two_visits_by_hand(off, P_1, P_2, squared):
    """Seen 2 m ahead of a pose of covariance 0.01 P_1, then 0.01 P_2: A's second row is [0, 1, 2].

    Of the growth A A^T x has the variance 1, and a = [0, 2, 1] = A e_3 has a^T (A A^T)^-1 a = 1.
    """
    second = np.array([2.0, 0.0, np.pi - 0.1])
    first = second - off + [0, 0, 2 * np.pi]
    C = 0.01 * np.array([P_1, P_2])[:, None, None] * np.eye(3)
    result = SimpleNamespace(marker=np.array([4, 6]), marker_in_world=np.array([first, second]),
                             poses=np.zeros((2, 3)), covariances=C)
    assert_allclose(_squared_distance(result, 4, 6, 0, 1), squared)


@pytest.mark.slow
def test_moved_markers_are_landmarks_of_their_own():
    """Three of four are moved by half a metre before the third round. In problem 4 as in 3."""
    dataset, truth = short(5, rounds=3)
    seen = dataset.aruco
    marker = truth.marker[truth.marker % 4 > 0]
    angle = 2.0 * seen.marker - truth.poses[seen.pose, 2]
    later = np.isin(seen.marker, marker) & (seen.pose >= len(dataset.ticks) * 2 // 3)
    step = 0.5 * later * np.array([np.cos(angle), np.sin(angle), 0 * angle])
    clean = estimate(dataset.without("uwb"))
    dataset = aruco(dataset, marker_in_vehicle=seen.marker_in_vehicle + step.T)
    result = estimate(dataset.without("uwb"))
    ids, places = result.places[result.places[:, 0] != result.places[:, 1]].T
    assert set(ids) == set(marker)
    assert np.isin(places, result.marker).all()
    assert aligned_ate(result, truth) < 2 * aligned_ate(clean, truth)
    assert mean_nees(result, truth) < 8
    told = {doubt.what: doubt.sentence for doubt in solution_doubts(result)}
    assert all(str(each) in told["places"] for each in set(places))
    assert clean.places is None
    both = estimate(dataset, previous=result)
    assert_array_equal(both.places, result.places)
    assert aligned_ate(both, truth) < 0.01


def test_places_must_spare_independent_sightings(monkeypatch):
    """Two for each of three new places; where errors have memory ten of the sightings are one."""
    places = np.array([[4, 4], [4, 104], [5, 105], [5, 105], [6, 206]])
    needed = []
    monkeypatch.setattr(choices, "spares_sightings", lambda *args: needed.append(args[-1]))
    for share in (1.0, 0.1):
        accepted = SimpleNamespace(sightings=SimpleNamespace(share=np.full(5, share)))
        fit = SimpleNamespace(problem=SimpleNamespace(accepted=accepted))
        choices._needs_places(fit, None, places)
    assert needed == pytest.approx([6, 60])
    assert not choices._needs_places(None, None, places)


def test_several_ranges_of_an_antenna_at_a_pose_have_no_lag():
    drive, truth = short(seed=21, poses=400)
    twice = drive.uwb.select(np.repeat(np.arange(len(drive.uwb.range)), 2))
    found = estimate(replace(drive, uwb=twice))
    assert ate(found.poses, truth.poses) < 0.05
