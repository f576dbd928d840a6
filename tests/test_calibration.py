"""What sensors share: derivatives, posterior, decision, and drives whose files are wrong there."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from numeric import (
    aligned_ate,
    aruco,
    as_points,
    central_differences,
    counts,
    mean_nees,
    seen_from,
    short,
    uwb,
    vehicle,
)
from numpy.testing import assert_allclose

from slamlib import estimate, fuse, fuse_increments, localize
from slamlib.core import se2
from slamlib.core.odometry import dead_reckoning
from slamlib.core.vehicle import Vehicle
from slamlib.robust import calibration, choices
from slamlib.robust.calibration import (
    CAMERA,
    ENTRIES,
    HEIGHT,
    RANGE_LAG,
    SIGHTING_LAG,
    SIZE,
    TAG_PLACE,
)
from slamlib.robust.factors import sensor_poses
from slamlib.robust.file_doubts import common_divisor, doubts_before_solving
from slamlib.robust.initialization import odometry_state
from slamlib.robust.linear import NormalEquations, build_problem
from slamlib.robust.measurements import Noise, measure
from slamlib.robust.solution_doubts import solution_doubts
from slamlib.studies.montecarlo import antenna_error, problems_3_and_4

# Sensors of which every entry differs from its default.
MOUNTED = Vehicle(camera_x=0.15, camera_y=-0.08, camera_turn=0.3, marker_size=1.03,
                  sighting_lag=3.4, tag_x=0.2, tag_y=-0.1, antenna_height=2.0, range_offset=0.1,
                  range_scale=1.02, range_lag=-7.6)
DOUBTFUL = {f"sigma_{entry.name}": 0.01 for entry in ENTRIES if entry.group != "camera-bump"}


def test_derivatives_by_delays_hold_within_a_step():
    """Between two rows the path, whose counts are whole numbers, does not count."""
    dataset, _ = short(4, 400)
    points = np.isin(dataset.aruco.marker, dataset.aruco.marker[:3])
    dataset = replace(dataset, vehicle=replace(MOUNTED, **DOUBTFUL),
                      aruco=as_points(dataset.aruco, points, 4.0))
    problem = build_problem(measure(dataset), "arc", Noise(2e-3, 1.5, 0.7))
    m = problem.measurements
    state = odometry_state(m, "arc")

    def linearized(lags):
        c = state.c.copy()
        c[[SIGHTING_LAG, RANGE_LAG]] += lags
        return NormalEquations(problem, replace(state, c=c)).linearized

    for kind, entry in enumerate([SIGHTING_LAG, RANGE_LAG]):
        factors = linearized(0)[kind]
        column = problem.active[:entry].sum()
        J = factors.J_c[..., factors.columns == column] / problem.prior.root[entry, entry]
        numeric = central_differences(
            lambda lag, kind=kind: linearized(lag)[kind].e, np.zeros(1), 0.3)
        frame = m.frame[m.structure.variables[factors.index, 0]]
        inside = (frame > 20) & (frame < m.frame[-1] - 20)
        assert_allclose(J[inside], numeric[inside], atol=0.02 * np.abs(numeric).max())
        assert np.abs(J[inside]).max() > 0


def test_sensors_are_where_the_vehicle_was_by_their_delay():
    """On the path of odometry, a camera that is one encoder step and a tag that is seven late."""
    m = measure(short(4, 400)[0])
    path = dead_reckoning(m.dataset.ticks, m.dataset.vehicle, model="arc")
    c = calibration.stated_calibration(
        replace(MOUNTED, sighting_lag=1, range_lag=7), []).stated
    camera, tag = sensor_poses(m, path[m.frame], c)
    for found, row, late, place in ((camera, m.sightings.row, 1, [0.15, -0.08, 0.3]),
                                    (tag, m.ranges.row, 7, [0.2, -0.1, 0])):
        seen = m.frame[row]
        expected = se2.compose(path[seen[seen >= late] - late], place)
        assert_allclose(found[seen >= late], expected, atol=1e-9)


@pytest.mark.parametrize("height, sigma", [(0.0, 0.5), (2.0, 1e-3), (0.0, 0.0)])
def test_what_is_stated_is_what_the_table_says(height, sigma):
    """The vector has half the squared height h^2 / 2, whose sigma is h sigma, or sigma^2 / 2."""
    vehicle = replace(MOUNTED, **DOUBTFUL)
    vehicle = replace(vehicle, antenna_height=height, sigma_antenna_height=sigma)
    stated = calibration.stated_calibration(vehicle, [5, 7])
    assert stated.stated[HEIGHT] == height**2 / 2
    C = np.diag(stated.sigma**2)
    rows = calibration.calibration_table(stated, stated.stated, C, {"tag-offset"})
    assert [row["name"] for row in rows[-2:]] == ["offset of antenna 5", "offset of antenna 7"]
    assert [row["name"] for row in rows if row["released"]] == ["tag_x", "tag_y"]
    for row in rows:                                     # what no vehicle states is known to be 0
        of_vehicle = [getattr(vehicle, row["name"], 0), getattr(vehicle, f"sigma_{row['name']}", 0)]
        found = [row[key] for key in ("stated", "stated_sigma", "estimate", "sigma")]
        assert_allclose(found, 2 * of_vehicle, rtol=1e-6)


def proposed(monkeypatch, vehicle, entries, L, h, variance=1.0, weight=1.0):
    """The proposal for a drive that informs of the sum of these entries (list of int) only.

    The last one has a weight in it.
    """
    stated = calibration.stated_calibration(vehicle, [])
    of_sum = np.isin(np.arange(len(ENTRIES)), entries).astype(float)
    of_sum[entries[-1]] = weight
    likelihood = choices._Likelihood(
        L * np.outer(of_sum, of_sum), h * of_sum, variance, 0.1 * np.tile(of_sum, (2, 1)))
    monkeypatch.setattr(choices, "_likelihood", lambda fit: likelihood)
    problem = SimpleNamespace(measurements=SimpleNamespace(calibration=stated),
                              prior=stated.prior())
    return choices._proposal(SimpleNamespace(problem=problem))


@pytest.mark.parametrize("off, sigma, named", [
    (0.5, 0.0, {"tag-offset", "camera-offset"}), (0.5, 0.01, {"tag-offset"}), (0.3, 0.0, set())])
def test_what_a_drive_cannot_tell_apart_by_hand(monkeypatch, off, sigma, named):
    """L = 100 in camera_x + tag_x, which are `off`: evidence (100 off)^2 / 202 - log(101) / 2.

    The prior odds of the camera, with an entry more, are less by 0.5, and by 3 if it is stated.
    """
    found = proposed(monkeypatch, Vehicle(sigma_camera_x=sigma), [CAMERA.start, TAG_PLACE.start],
                     100, 100 * off)
    assert {*found.explanations} == ({frozenset([each]) for each in named} or {frozenset()})
    assert named <= found.prior.groups
    if sigma == 0 and named:
        assert found.lead == pytest.approx(2500 / 201 - np.log(201) / 2)


@pytest.mark.parametrize("weight, released", [
    (1.0, {"marker-size", "time-offset"}), (0.2, {"marker-size"})])
def test_what_is_stated_more_firmly_is_named_but_not_always_released(
        monkeypatch, weight, released):
    """L = 100 in the size, and 100 w^2 in a delay of a `weight` w: evidence 15.5, and 15.5 or 13.6.

    The delay is stated, so that its prior odds are less by 3: beyond AMBIGUOUS = 4.5 or not.
    """
    found = proposed(monkeypatch, Vehicle(sigma_sighting_lag=0.01), [SIZE, SIGHTING_LAG], 100, 60,
                     weight=weight)
    assert {*found.explanations} == {frozenset(["marker-size"]), frozenset(["time-offset"])}
    assert found.prior.groups == released


def test_what_is_not_worth_its_price_is_no_explanation_beside_another(monkeypatch):
    """Evidence 8.9 is enough for the size, not for a delay that is stated: by 6 and by 9."""
    found = proposed(monkeypatch, Vehicle(sigma_sighting_lag=0.01), [SIZE, SIGHTING_LAG], 100, 47.5)
    assert found.explanations == (frozenset(["marker-size"]),)
    assert found.prior.groups == {"marker-size"}


@pytest.mark.parametrize("h, variance, released", [
    (1.0, 1.0, set()), (2.0, 1.0, {"marker-size"}), (2.0, 7e-3, {"marker-size"}),
    (2.0, 6e-3, set())])
def test_what_raises_the_evidence_is_released_also_if_it_is_not_told(
        monkeypatch, h, variance, released):
    """L = 1.5 in the size: evidence h^2 / 5 - log(2.5) / 2, above 0 from h = 1.51 on.

    The last position has a lever of 0.1 m in x and y: its variance grows by 0.02 / 2.5, its sigma
    to less than 1.5 times its own from 0.0064 m^2 on.
    """
    found = proposed(monkeypatch, Vehicle(), [SIZE], 1.5, h, variance)
    assert found.explanations == (frozenset(),) and found.prior.groups == released


@pytest.mark.parametrize("times, groups", [(2.0, {"marker-size"}), (3.0, set())])
def test_what_cannot_be_is_not_proposed(monkeypatch, times, groups):
    """L = 100 in the size, which would be twice, or three times, what is stated."""
    off = (times - 1) / 0.05                             # wide sigmas
    found = proposed(monkeypatch, Vehicle(), [SIZE], 100, 100 * off)
    assert found.explanations == (frozenset(groups),) and found.prior.groups == groups


# The drive of a seed as sensors elsewhere would have logged it, with the same noise.

def ranged_from(dataset, truth, tag=(0.0, 0.0), height=0.0, offsets=(0, 0, 0, 0), late=0):
    """The dataset of a tag elsewhere, of antennas above it with offsets, whose ranges are late."""
    u = dataset.uwb
    antenna = np.searchsorted(truth.antenna, u.antenna)

    def distance(tag, height):
        place = se2.compose(truth.poses[u.pose], [*tag, 0.0])[:, :2]
        return np.hypot(np.hypot(*(truth.antenna_in_world[antenna] - place).T), height)

    longer = distance(tag, height) - distance((0.0, 0.0), 0.0) + np.array(offsets)[antenna]
    moved = replace(u, pose=u.pose + late, range=u.range + longer)
    return replace(dataset, uwb=moved.select(moved.pose < len(dataset.ticks)))


# What the one doubt names: seed, if markers alone tell it, the largest ratio of the ATE, the drive.
FAULTS = {
    "camera-offset": (1, True, 1.5, lambda d, t: seen_from(d, (0.1, 0.05, 0.03))),
    "tag-offset": (1, False, 1.5, lambda d, t: ranged_from(d, t, tag=(0.3, 0.0))),
    "antenna-height": (1, False, 1.5, lambda d, t: ranged_from(d, t, height=2.5)),
    "antenna-offsets": (1, False, 1.5, lambda d, t: ranged_from(d, t, offsets=[0.7, 0, 0, 0])),
    "range-delay": (1, False, 1.5, lambda d, t: ranged_from(d, t, late=30)),
    "wheelbase": (501, True, 1.3, lambda d, t: vehicle(wheelbase=0.2)(d)),
    "wheel-scale": (501, True, 1.3, lambda d, t: vehicle(
        right_radius=0.103, left_radius=0.103)(d)),
    "marker-noise": (61, True, 1.2, lambda d, t: aruco(d, covariance=d.aruco.covariance / 100)),
    "range-noise": (61, False, 1.2, lambda d, t: uwb(d, sigma=d.uwb.sigma / 2)),
    "range-offset": (61, False, 1.2, lambda d, t: uwb(d, range=d.uwb.range * 1.015))}


drive = cache(short)


@cache
def right(seed):
    """What problems 3 and 4 find on a drive whose files are right."""
    return problems_3_and_4(drive(seed)[0])


def right_ates(seed):
    """Aligned ATE in m of problems 3 and 4, of a drive whose files are right."""
    truth = drive(seed)[1]
    both = right(seed)
    assert not named(both[0]) and not named(both[1])
    return [aligned_ate(found, truth) for found in both]


def named(found):
    return {doubt.what for doubt in solution_doubts(found)}


def assert_right(found, truth, largest):
    """The covariances hold, and the aligned ATE is below the largest in m."""
    assert aligned_ate(found, truth) < largest
    assert mean_nees(found, truth) < 6


@pytest.mark.slow
@pytest.mark.parametrize("what", FAULTS)
def test_a_wrong_statement_is_named_alone_and_mended_and_not_taken_for_slip(what):
    """By markers alone larger wheels are smaller markers: one is named, the other beside it."""
    seed, markers_tell, most, spoil = FAULTS[what]
    dataset, truth = drive(seed)
    spoilt = spoil(dataset, truth)
    before = [doubt.what for doubt in doubts_before_solving(spoilt)]
    assert before == ["units"] * (what == "wheelbase")
    markers, both = problems_3_and_4(spoilt)
    assert named(both) == {what}
    assert named(markers) <= {what, "marker-size"} and bool(named(markers)) == markers_tell
    for found, right in zip((markers, both), right_ates(seed)):
        assert_right(found, truth, most * right)
        assert_allclose(found.wheel, [0.1, 0.1, 0.4], rtol=0.01)
        assert found.slip < 2e-3
    assert antenna_error(both, truth)[1].mean() < 8


@pytest.mark.slow
@pytest.mark.parametrize("seed, without", [(502, "uwb"), (505, "")])
def test_a_wheelbase_of_half_its_length_is_no_second_place_and_no_shaking_camera(seed, without):
    """The slip is learned again once the wheelbase has moved."""
    dataset, truth = short(seed)
    dataset = replace(dataset, vehicle=replace(dataset.vehicle, wheelbase=0.2))
    found = estimate(dataset.without(without) if without else dataset)
    assert named(found) - {"antenna"} == {"wheelbase"}
    assert mean_nees(found, truth) < 8 and 0.6e-3 < found.slip < 1.6e-3


@pytest.mark.slow
def test_wheels_that_only_ranges_contradict_are_told_from_the_scale_of_ranges():
    """The offset and scale of the ranges are two entries that nobody stated; turns tell them."""
    dataset, truth = drive(11)
    dataset = dataset.without("aruco")
    found = estimate(counts(slice(None), lambda ticks: np.rint(1.03 * ticks))(dataset))
    assert named(found) <= {"wheel-scale", "wheel-radii"} and named(found)
    assert_right(found, truth, 1.5 * aligned_ate(estimate(dataset), truth))


def test_wheels_that_drift_and_markers_are_as_likely_although_the_wheels_are_stated():
    dataset, truth = drive(13)
    grown = np.linspace(1, 1.02, len(dataset.ticks))[:, None]
    found = estimate(replace(dataset, uwb=None, ticks=np.rint(grown * dataset.ticks)))
    assert found.released == {"marker-size", "wheel-radii", "wheel-scale"}
    assert mean_nees(found, truth) < 8


def test_what_is_far_from_what_was_stated_must_be_certain():
    """A size that is off by more than its wide sigma, 5 %, costs its price, a nearer one none."""
    for sigma, size, groups, price in ((0.0, 1.04, {"marker-size"}, 0.0), (0.0, 1.06, {}, 0.0),
                                       (0.0, 0.94, {"marker-size", "time-offset"}, 6.0),
                                       (0.01, 1.06, {"marker-size"}, 9.0)):
        stated = calibration.stated_calibration(Vehicle(sigma_marker_size=sigma), ())
        c = stated.stated.copy()
        c[SIZE] = size
        fit = SimpleNamespace(state=SimpleNamespace(c=c), problem=SimpleNamespace(
            measurements=SimpleNamespace(calibration=stated)))
        assert choices._price_of_far(fit, groups) == price


def test_counts_that_were_cut_off_say_so_and_leave_the_metre_to_the_markers():
    """7 of 8 counts in 127 may be missing: 2.8 % of each distance."""
    dataset, truth = drive(12)
    cut = replace(dataset, ticks=np.sign(dataset.ticks) * (np.abs(dataset.ticks) // 8 * 8))
    doubt, = doubts_before_solving(cut)
    assert doubt.what == "encoder-counts" and "multiples of 8" in doubt.sentence
    found = estimate(cut.without("uwb"))
    sigma = found.calibration.sigma[calibration.WHEELS] / [0.1, 0.1, 0.4]
    assert_allclose(sigma, 3.5 / 127, rtol=0.1)
    assert not named(found)
    assert_right(found, truth, 0.004)


def test_few_different_counts_are_no_counts_that_were_cut_off():
    assert common_divisor(np.array([[127, 127], [254, 0], [-127, 127]])) == 1
    assert common_divisor(6.5 * np.arange(16).reshape(8, 2)) == 1


@pytest.mark.parametrize("spoil, is_recognised", [
    (lambda C: np.sqrt(C), True), (lambda C: C / 100, False)])
def test_standard_deviations_in_the_columns_of_variances_are_recognised(spoil, is_recognised):
    dataset = drive(11)[0].without("uwb")
    variance = np.diagonal(dataset.aruco.covariance, axis1=1, axis2=2)
    spoilt = aruco(dataset, covariance=spoil(variance)[:, :, None] * np.eye(3))
    doubt, = solution_doubts(estimate(spoilt))
    assert doubt.what == "marker-noise"
    assert ("held standard deviations" in doubt.sentence) == is_recognised


@pytest.mark.parametrize("stated, contradicted", [
    ({"slip": 3e-4}, ["slip"]), ({"slip": 3e-3}, ["slip"]),
    ({"marker_noise_factor": 0.5, "slip": 1e-3}, ["marker_noise_factor"]),
    ({"range_noise_factor": 3.0, "slip": 1e-3}, ["range_noise_factor"]),
    ({"slip": 1e-3, "marker_noise_factor": 1.0, "range_noise_factor": 1.0}, [])])
def test_stated_noise_is_doubted_where_the_drive_contradicts_it(stated, contradicted):
    """It is right by a slip of 1 mm after 1 m, and by factors of 1."""
    found = estimate(vehicle(**stated)(drive(11)[0]))
    told = {doubt.what: doubt.sentence for doubt in solution_doubts(found)}
    assert set(told) <= {"stated-noise", "sightings-rejected"}
    names = [name for name in sorted(stated) if f"{name} = " in told.get("stated-noise", "")]
    assert names == contradicted


def test_a_factor_on_both_radii_correlates_them():
    stated = calibration.stated_calibration(Vehicle(), [])
    prior = stated.prior(["wheel-scale"], width=2.0)
    expected = np.diag(stated.sigma**2)
    expected[:2, :2] += 0.1**2 * 0.1**2
    assert_allclose(prior.root @ prior.root.T, expected)
    u = np.array([0.3, -0.2, 0.5])
    assert_allclose(prior.unknowns(prior.of(slice(None)) @ u), u)


@pytest.mark.slow
def test_the_model_of_a_step_that_a_wrong_size_made_does_not_blame_the_wheels():
    """A camera 0.2 m ahead, as stated, and larger markers look like Euler's steps at first."""
    dataset = seen_from(drive(1)[0].without("uwb"), (0.2, 0.0, 0.0), size=1.04)
    found = estimate(vehicle(camera_x=0.2)(dataset))
    assert found.model == "arc" and found.released == {"marker-size"}
    assert [doubt.what for doubt in solution_doubts(found)] == ["marker-size"]
    assert found.c[SIZE] == pytest.approx(1.04, abs=0.004)


@pytest.mark.slow
def test_four_wrong_statements_at_once_are_all_found():
    dataset, truth = drive(1)
    spoilt = ranged_from(seen_from(dataset, (0.08, 0, 0), size=1.02), truth, (0.2, 0), height=1.5)
    found = problems_3_and_4(spoilt)[1]
    assert found.released == {"camera-offset", "marker-size", "tag-offset", "antenna-height"}
    assert aligned_ate(found, truth) < 0.005
    assert mean_nees(found, truth) < 6


@pytest.mark.slow
def test_what_is_stated_is_used():
    """A vehicle.toml that says where the sensors are: the same estimate, and nothing to doubt."""
    dataset, truth = drive(1)
    spoilt = ranged_from(seen_from(dataset, (0.15, -0.05, 0.1), size=1.03), truth, tag=(0.3, 0.1),
                         height=2.0)
    stated = vehicle(camera_x=0.15, camera_y=-0.05, camera_turn=0.1, marker_size=1.03, tag_x=0.3,
                     tag_y=0.1, antenna_height=2.0)(spoilt)
    found = estimate(stated)
    expected = right(1)[1]
    assert not solution_doubts(found) and not found.released
    assert np.abs(found.poses - expected.poses)[:, :2].max() < 2e-3
    assert np.abs(found.antenna_in_world - expected.antenna_in_world).max() < 0.03


def test_problem_2_and_the_checks_of_files_see_by_the_stated_camera():
    """A camera turned by a right angle is no flaw of the files if vehicle.toml says so."""
    dataset = drive(1, 500)[0].without("uwb")
    spoilt = seen_from(dataset, (0.15, -0.05, np.pi / 2), size=1.5)
    stated = vehicle(
        camera_x=0.15, camera_y=-0.05, camera_turn=np.pi / 2, marker_size=1.5)(spoilt)
    assert doubts_before_solving(spoilt) and not doubts_before_solving(stated)
    for solve in (lambda d: localize(d.sightings), fuse, fuse_increments):
        assert_allclose(solve(stated).poses, solve(dataset).poses, atol=1e-9)
