"""Properties of all legal input: files of any bytes, small drives of any kind, and changed drives.

`pytest --hypothesis-profile=long tests/test_properties.py` tries many more, other ones every time.
"""

import json
import tempfile
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numeric import known_noise
from test_dataset import FILES, write

from slamlib import localization, odometry, se2, slam
from slamlib.checks.files import doubts_before_solving
from slamlib.dataset import DatasetError, Vehicle, read_dataset, read_truth
from slamlib.simulation import simulate
from slamlib.solve import Failure, solutions
from slamlib.summary import summarize

QUICK = settings(max_examples=3 * settings.default.max_examples)
HALF, FEW = (settings(max_examples=settings.default.max_examples // by) for by in (2, 6))

# Drives.

COUNTS = st.one_of(st.just(0), st.sampled_from([127, -127, 1, 2000]), st.integers(-300, 300))
LEGS = st.one_of(                                  # (steps, right and left counts of each)
    st.tuples(st.integers(1, 30), COUNTS).map(lambda leg: (*leg, leg[1])),      # straight
    st.tuples(st.integers(1, 30), COUNTS).map(lambda leg: (*leg, -leg[1])),     # on the spot
    st.tuples(st.integers(1, 30), COUNTS, COUNTS))
IDS = st.one_of(st.integers(0, 50), st.sampled_from([-7, 10**12, -10**12, 10**12 + 1]))
VEHICLES = st.builds(
    Vehicle, right_radius=st.sampled_from([0.1, 0.101, 0.02, 0.5]),
    left_radius=st.sampled_from([0.1, 0.099, 0.02, 0.5]), wheelbase=st.sampled_from([0.4, 0.05, 2]),
    sigma_right_radius=st.sampled_from([1e-4, 1e-6, 5e-3]),
    sigma_left_radius=st.sampled_from([1e-4, 1e-6, 5e-3]),
    sigma_wheelbase=st.sampled_from([1e-4, 1e-6, 1e-2]),
    sigma_heading=st.sampled_from([1e-4, 1e-6, 0.1, 1.0]),
    sigma_camera_x=st.sampled_from([0.0, 0.0, 0.05]), sigma_camera_y=st.sampled_from([0.0, 0.02]),
    sigma_camera_turn=st.sampled_from([0.0, 0.0, 0.02]),
    sigma_marker_size=st.sampled_from([0.0, 0.0, 0.01]),
    sigma_sighting_lag=st.sampled_from([0.0, 0.0, 2.0]),
    sigma_tag_x=st.sampled_from([0.0, 0.0, 0.1]), sigma_antenna_height=st.sampled_from([0, 0, 1.0]),
    sigma_range_offset=st.sampled_from([0.0, 0.0, 0.1]),
    sigma_range_scale=st.sampled_from([0.0, 0.0, 0.01]),
    sigma_range_lag=st.sampled_from([0.0, 0.0, 2.0]))


@st.composite
def drives(draw):
    """Rows of the files of a small legal drive, as a namespace."""
    vehicle = draw(VEHICLES)
    legs = draw(st.lists(LEGS, max_size=4))
    ticks = np.concatenate([[[0, 0]], *(np.tile(leg[1:], (leg[0], 1)) for leg in legs)])
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    path = odometry.dead_reckoning(
        ticks, vehicle.with_deviation(rng.normal(size=3)), model="arc")
    return SimpleNamespace(
        vehicle=vehicle, ticks=ticks, sightings=draw(sightings(path, rng)),
        **dict(zip(("ranges", "guesses"), draw(ranges(path, rng)))))


def frames(draw, count):
    """Poses from 0 with measurements: none, one, every k-th."""
    every = draw(st.sampled_from([None, count, 1, 3, 10]))
    return np.arange(0 if every is None else count)[draw(st.integers(0, count - 1))::every or 1]


@st.composite
def sightings(draw, path, rng):
    """Rows (m, 11) of ArucoReading.txt from poses (n, 3)."""
    seen_from = frames(draw, len(path))
    many = draw(st.integers(0, 9)) == 9
    ids = np.arange(300) if many else np.array(
        draw(st.lists(IDS, min_size=1, max_size=6, unique=True)))
    marker = np.column_stack([rng.uniform(-3, 3, (len(ids), 2)),
                              rng.uniform(-np.pi, np.pi, len(ids))])
    marker[:, :2] += path[rng.integers(len(path), size=len(ids)), :2]
    share = 0.05 if many else draw(st.sampled_from([1.0, 0.5, 0.1]))
    frame, which = np.nonzero(rng.uniform(size=(len(seen_from), len(ids))) < share)
    pose, which = seen_from[frame], which if draw(st.booleans()) else rng.permuted(which)
    sigma = np.array([*draw(st.sampled_from([(0.005, 0.005), (1e-4, 1e-2), (0.5, 0.5)])), 0])
    sigma = np.tile(sigma, (len(pose), 1))
    sigma[:, 2] = rng.choice(draw(st.sampled_from([[0.01], [1e-3], [0.4], [100], [0.01, 100]])),
                             len(pose))
    root = np.linalg.cholesky(np.eye(3) + draw(st.sampled_from([0, 0.9])) * (
        np.ones((3, 3)) - np.eye(3))) * sigma[:, :, None]
    error = (root @ rng.normal(size=(len(pose), 3, 1)))[..., 0]
    z = se2.between(path[pose], marker[which]) + error * draw(st.sampled_from([1, 0, 30]))
    z[:, 2] = se2.wrap(z[:, 2])
    C = (root @ np.swapaxes(root, 1, 2))[:, *np.triu_indices(3)]
    return [(int(i) + 1, int(j), *row) for i, j, row in zip(
        pose, ids[which], np.column_stack([z, C]).tolist())]


@st.composite
def ranges(draw, path, rng):
    """Rows (m, 4) of UwbReading.txt from poses (n, 3), and (a, 3) of UwbAntennaGuess.txt."""
    seen_from = frames(draw, len(path))
    ids = draw(st.lists(IDS, min_size=1, max_size=4, unique=True))
    antenna = path[rng.integers(len(path), size=len(ids)), :2] + draw(
        st.sampled_from([0.0, 3.0, 50.0])) * rng.normal(size=(len(ids), 2))
    guess = antenna + draw(st.sampled_from([0.3, 0.0, 30.0])) * rng.normal(size=(len(ids), 2))
    frame, which = np.nonzero(rng.uniform(size=(len(seen_from), len(ids))) < draw(
        st.sampled_from([1.0, 0.3])))
    pose, sigma = seen_from[frame], draw(st.sampled_from([0.05, 1e-3, 1.0]))
    late = draw(st.sampled_from([0.0, 5.0])) * (rng.uniform(size=len(pose)) < 0.3)
    distance = np.hypot(*(antenna[which] - path[pose, :2]).T) + late + sigma * rng.normal(
        size=len(pose)).clip(-4, 4)
    return ([(int(i) + 1, ids[k], float(r), sigma) for i, k, r in zip(pose, which, distance)],
            [(k, *place) for k, place in zip(ids, guess.tolist())])


def read(drive):
    """The Dataset that is read from the files of a drive."""
    with tempfile.TemporaryDirectory() as folder:
        written = {"encoderReading.txt": [(i, *row) for i, row in enumerate(
                       drive.ticks.tolist(), start=1)],
                   "ArucoReading.txt": drive.sightings, "UwbReading.txt": drive.ranges,
                   "UwbAntennaGuess.txt": drive.guesses}
        for name, rows in written.items():
            Path(folder, name).write_text("".join(
                " ".join(map(repr, row)) + "\n" for row in rows))
        Path(folder, "vehicle.toml").write_text("".join(
            f"{name} = {json.dumps(value, default=float)}\n"
            for name, value in vars(drive.vehicle).items()
            if value is not None))
        return read_dataset(folder)


# The reader: whatever the bytes, a dataset or one sentence.

WORDS = st.one_of(
    st.integers(-2, 12).map(str), st.floats().map(repr), st.integers().map(str),
    st.sampled_from(["nan", "1e999", "-0", "1_0", "0x1", "\u0661", "#", "=", "[", "'", "1e-400",
                     "+1", ".5", "1e15", "1,5", "1;2,5;3", ";", ",", "//", "%", "pose", "\x1c",
                     "\u2028", "\x85", "wheelbase", "sigma_heading"]))
LINES = st.lists(WORDS, max_size=12).map(" ".join)
BYTES = st.one_of(st.binary(max_size=50), st.lists(LINES, max_size=5).map(
    lambda lines: "\n".join(lines).encode()))


@st.composite
def spoilt(draw, text):
    """The bytes of a text of which a part is replaced by any others."""
    content = text.encode()
    begin = draw(st.integers(0, len(content)))
    end = begin + draw(st.sampled_from([0, 1, 2, 20, len(content)]))
    return content[:begin] + draw(BYTES) + content[end:]


@QUICK
@given(st.fixed_dictionaries({}, optional={
    name: st.one_of(st.just(text.encode()), spoilt(text), BYTES) for name, text in FILES.items()}))
def test_files_of_any_bytes_are_read_or_refused_in_one_sentence(files):
    with tempfile.TemporaryDirectory() as folder:
        for name, content in files.items():
            write(Path(folder, name), content)
        try:
            dataset, truth = read_dataset(folder), read_truth(folder)
        except DatasetError as error:
            assert str(error).startswith(folder) and str(error).isprintable()
            assert ": expected " in str(error) and len(str(error)) < 400
            return
    arrays = [dataset.ticks, *(array for each in (
        dataset.aruco, dataset.uwb, dataset.antenna_guess, truth) if each
        for array in vars(each).values() if isinstance(array, np.ndarray))]
    assert all(np.isfinite(array).all() for array in arrays)
    for readings in filter(None, (dataset.aruco, dataset.uwb)):
        assert (np.diff(readings.pose) >= 0).all() and len(readings.pose)
        assert 0 <= readings.pose[0] and readings.pose[-1] < len(dataset.ticks)


# All problems: estimates with covariances, or a reason that is true.

@pytest.mark.slow
@HALF
@given(drives())
def test_every_small_drive_is_solved(drive):
    """Estimates are finite with positive definite covariances; what fails, says truly why."""
    dataset = read(drive)
    for solution in solutions(dataset):
        if isinstance(solution, Failure):
            assert is_true(solution, drive), solution
            continue
        json.dumps(summarize(solution, None), allow_nan=False)
        known = np.isfinite(solution.poses).all(axis=1)
        assert known.any() and (known.all() or solution.problem == "problem2")
        assert np.isnan(solution.covariances[~known]).all()
        least = 0 if solution.problem in ("problem3", "problem4") else -1e-9
        for C in (solution.covariances[known], *(
                each[2] for each in (solution.aruco_map, solution.uwb_map) if each is not None)):
            assert_positive(C, least, solution.problem)
    for doubt in doubts_before_solving(dataset):
        assert doubt.sentence.endswith(".") and "nan" not in doubt.sentence


def is_true(failure, drive):
    """True of what can be: all sightings contradict each other."""
    count = Counter(row[:2] for row in drive.sightings)
    return "contradict" in failure.reason and failure.problem == "problem2" and all(
        k > 1 for k in count.values())


def assert_positive(covariances, least, problem):
    assert np.isfinite(covariances).all(), problem
    sigma = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 1e-30))
    correlation = covariances / (sigma[:, :, None] * sigma[:, None, :])
    np.testing.assert_allclose(correlation, np.swapaxes(correlation, 1, 2), 0, 1e-9)
    if len(covariances):
        assert np.linalg.eigvalsh(correlation)[:, 0].min() > least, problem


# Changes of a drive that change nothing but what they must.

SMALLEST = 1e-9            # m and rad, sigma of what has none: position of pose 1 in problem 1
# Tolerances are in sigmas. Rounding is 1e-16 of the information, which reaches 1e10 / m^2 (by
# MINIMUM_SIGMA of the odometry) beside the 1 / rad^2 of the first heading: 1e-6, here times 100.
ROUNDING = 1e-4
# The search of the noise ends where it gains 0.01 in log density, 0.14 of its own sigma from the
# maximum. Rounding decides where, and so little of the noise changes a covariance by few percent.
LEARNED = 0.05


def solved(dataset, slip=None):
    """By problem, a list of what was estimated: ids (m,), values (m, d), covariances (m, d, d).

    Poses, markers and antennas. Not problem 4 with an antenna in doubt: beside the antenna, the
    direction of a range is that of rounding, and few ranges may leave Gauss-Newton in a valley in
    which it ends by its number of steps.
    """
    pose, found = np.arange(len(dataset.ticks)), {}
    found["problem1"] = [(pose, *odometry.equation2(dataset.ticks, dataset.vehicle))]
    if dataset.aruco is not None:
        with suppress(DatasetError):                        # all sightings contradict each other
            each = localization.localize(dataset.aruco)
            found["problem2"] = [(each.frame, each.poses, each.covariances),
                                 (each.marker, each.marker_in_world, each.marker_covariance)]
        for name, each in (("problem2_hint", localization.fuse_increments(dataset)),
                           ("problem2_fused", localization.fuse(dataset, slip))):
            found[name] = [(pose, each.poses, each.covariances)]
    for name, sensors in (("problem3", dataset.without("uwb")), ("problem4", dataset)):
        if sensors.aruco is not None or sensors.uwb is not None:
            each = slam.estimate(sensors if slip is None else known_noise(sensors, slip))
            if each.doubts:
                continue
            found[name] = [(pose, each.poses, each.covariances),
                           (each.marker, each.marker_in_world, each.marker_covariance),
                           (each.antenna, each.antenna_in_world, each.antenna_covariance)]
    return found


def assert_same(before, after, tolerance, numbers=None, factor=(1, 1, 1)):
    """Estimates differ by `tolerance` sigmas, covariances by as much of a product of sigmas.

    After the change, what had the id `i` has the id `numbers[i]`, and values [x, y, heading] are
    multiplied by `factor`.
    """
    assert before.keys() == after.keys()
    for problem, kinds in before.items():
        for k, ((ids, x, C), (other_ids, other, other_C)) in enumerate(
                zip(kinds, after[problem], strict=True)):
            expected = ids if k == 0 or numbers is None else np.array([*map(numbers.get, ids)], int)
            order = np.argsort(expected)
            np.testing.assert_array_equal(expected[order], other_ids)
            by = np.array(factor[:x.shape[1]])
            off = other / by - x[order]
            off[:, 2:] = se2.wrap(off[:, 2:])
            sigma = np.sqrt(np.diagonal(C[order], axis1=1, axis2=2)) + SMALLEST
            products = sigma[:, :, None] * sigma[:, None, :]
            for share in (off / sigma, (other_C / np.outer(by, by) - C[order]) / products):
                np.testing.assert_allclose(share, 0 * share, 0, tolerance, err_msg=problem)


def renumbered(drive, ids):
    """The drive with other ids, from a dict."""
    return SimpleNamespace(**{**vars(drive), **{
        name: [(row[0], ids[row[1]], *row[2:]) for row in getattr(drive, name)]
        for name in ("sightings", "ranges")},
        "guesses": [(ids[row[0]], *row[1:]) for row in drive.guesses]})


def reversed_rows(drive):
    """The drive with the rows of its sensors in the opposite order."""
    return SimpleNamespace(**{**vars(drive), **{
        name: getattr(drive, name)[::-1] for name in ("sightings", "ranges", "guesses")}})


def mirrored(dataset):
    """The Dataset of the drive seen in a mirror: y and headings have the other sign."""
    sign, v = np.array([1, -1, -1]), dataset.vehicle
    aruco, uwb, guess = dataset.aruco, dataset.uwb, dataset.antenna_guess
    return replace(
        dataset, ticks=dataset.ticks[:, ::-1].copy(), vehicle=replace(
            v, right_radius=v.left_radius, left_radius=v.right_radius,
            sigma_right_radius=v.sigma_left_radius, sigma_left_radius=v.sigma_right_radius),
        aruco=aruco and replace(aruco, marker_in_vehicle=aruco.marker_in_vehicle * sign,
                                covariance=aruco.covariance * np.outer(sign, sign)),
        uwb=uwb, antenna_guess=guess and replace(guess, position=guess.position * sign[:2]))


def simulated():
    """Rows of the files of a simulated drive, whose problem 4 leaves no antenna in doubt."""
    dataset, _ = simulate("short", 7, late_ranges=0.1, mislabelled=0.02)
    a, u, guess = dataset.aruco, dataset.uwb, dataset.antenna_guess
    sightings = np.column_stack([a.marker_in_vehicle, a.covariance[:, *np.triu_indices(3)]])

    def rows(pose, ids, values):
        return [(int(i) + 1, int(k), *row) for i, k, row in zip(pose, ids, values.tolist())]

    return SimpleNamespace(
        vehicle=dataset.vehicle, ticks=dataset.ticks, sightings=rows(a.pose, a.marker, sightings),
        ranges=rows(u.pose, u.antenna, np.column_stack([u.range, u.sigma])),
        guesses=[(int(k), *row) for k, row in zip(guess.antenna, guess.position.tolist())])


SIMULATED = simulated()


@pytest.mark.slow
@FEW
@example(SIMULATED, 1, 1e-3)
@given(drives(), st.integers(0, 2**32 - 1), st.sampled_from([1e-3, None]))
def test_ids_the_order_of_rows_and_the_side_are_names_only(drive, seed, slip):
    """Other ids in files in the opposite order; and the same drive in a mirror."""
    ids = sorted({row[1] for row in drive.sightings} | {row[0] for row in drive.guesses})
    numbers = dict(zip(ids, np.random.default_rng(seed).permutation(ids).tolist()))
    dataset, other = read(drive), read(reversed_rows(renumbered(drive, numbers)))
    before = solved(dataset, slip)
    assert drive is not SIMULATED or {"problem2_fused", "problem3", "problem4"} <= before.keys()
    tolerance = ROUNDING if slip else LEARNED
    assert_same(before, solved(other, slip), tolerance, numbers)
    assert_same(before, solved(mirrored(dataset), slip), tolerance, factor=(1, -1, -1))
