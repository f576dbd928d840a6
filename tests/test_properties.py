"""Properties of all legal input: files of any bytes, small drives of any kind, and changed drives.

`pytest --hypothesis-profile=long tests/test_properties.py` tries many more, other ones every time.
"""

import json
import tempfile
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_dataset import FILES, write

from slamlib.core import odometry, se2
from slamlib.core.errors import DatasetError
from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import dataset_from_arrays, read_dataset, read_truth
from slamlib.robust.file_doubts import doubts_before_solving
from slamlib.solve import Failure, solutions, summarize
from slamlib.studies.simulation import simulate

QUICK = settings(max_examples=3 * settings.default.max_examples)
HALF = settings(max_examples=settings.default.max_examples // 2)

# Drives.

COUNTS = st.one_of(st.just(0), st.sampled_from([127, -127, 1, 2000]), st.integers(-300, 300))
LEGS = st.one_of(                                  # (steps, right and left counts of each)
    st.tuples(st.integers(1, 30), COUNTS).map(lambda leg: (*leg, leg[1])),      # straight
    st.tuples(st.integers(1, 30), COUNTS).map(lambda leg: (*leg, -leg[1])),     # on the spot
    st.tuples(st.integers(1, 30), COUNTS, COUNTS))
IDS = st.one_of(st.integers(0, 50), st.sampled_from([-7, 10**12, -10**12, 10**12 + 1]))
VEHICLES = st.builds(Vehicle, **{name: st.sampled_from(values) for names, values in {
    "right_radius left_radius": [0.1, 0.101, 0.099, 0.02, 0.5], "wheelbase": [0.4, 0.05, 2.0],
    "sigma_right_radius sigma_left_radius": [1e-4, 1e-6, 5e-3],
    "sigma_wheelbase": [1e-4, 1e-6, 1e-2], "sigma_heading": [1e-4, 1e-6, 0.1, 1.0],
    "sigma_camera_x sigma_camera_y": [0.0, 0.0, 0.05], "sigma_camera_turn": [0.0, 0.0, 0.02],
    "sigma_marker_size sigma_range_scale": [0.0, 0.0, 0.01],
    "sigma_sighting_lag sigma_range_lag": [0.0, 0.0, 2.0], "sigma_antenna_height": [0.0, 0.0, 1.0],
    "sigma_tag_x sigma_range_offset": [0.0, 0.0, 0.1]}.items() for name in names.split()})


@st.composite
def drives(draw):
    """Rows of the files of a small legal drive, as a namespace."""
    vehicle = draw(VEHICLES)
    legs = draw(st.lists(LEGS, max_size=4))
    ticks = np.concatenate([[[0, 0]], *(np.tile(leg[1:], (leg[0], 1)) for leg in legs)])
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    path = odometry.dead_reckoning(
        ticks, vehicle.with_wheel(
            vehicle.wheel + rng.normal(size=3) * vehicle.sigma_wheel), model="arc")
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
    for record in (dataset, dataset.aruco, dataset.uwb, dataset.antenna_guess, truth):
        for array in vars(record).values() if record else ():
            assert not isinstance(array, np.ndarray) or np.isfinite(array).all()
    for readings in filter(None, (dataset.aruco, dataset.uwb)):
        poses = readings.pose.tolist()
        assert poses == sorted(poses) and set(poses) <= set(range(len(dataset.ticks)))


# All problems: estimates with covariances, or a reason that is true.

@pytest.mark.slow
@HALF
@given(drives())
def test_every_small_drive_is_solved(drive):
    """Estimates are finite with positive definite covariances; what fails, says truly why."""
    dataset = dataset_from_arrays(drive.ticks, drive.sightings, drive.ranges, drive.guesses,
                                  drive.vehicle)
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
# In sigmas. The search of the noise ends where it gains 0.01 in log density, 0.14 of its own sigma
# from the maximum. Rounding decides where, and so little of the noise changes a covariance by few
# percent.
LEARNED = 0.05


def estimates(dataset, numbers=None, factor=(1, 1, 1)):
    """Ids (m,), values (m, d) and covariances (m, d, d) of poses and maps, sorted by id.

    Ids become `numbers` (dict), and values [x, y, heading] are multiplied by `factor`.
    """
    for found in solutions(dataset):
        poses = np.arange(len(found.poses)), found.poses, found.covariances
        for kind, each in (("poses", poses), ("markers", found.aruco_map),
                           ("antennas", found.uwb_map)):
            if each is not None:
                ids, x, C = each
                ids = ids if numbers is None or kind == "poses" else np.array(
                    [numbers[i] for i in ids.tolist()])
                order, by = np.argsort(ids), np.array(factor[:x.shape[1]])
                yield f"{found.problem} {kind}", ids[order], by * x[order], (
                    C * np.outer(by, by))[order]


@pytest.mark.slow
def test_ids_the_order_of_rows_and_the_side_are_names_only():
    """Other ids in tables in the opposite order; and the same drive in a mirror."""
    dataset = simulate("short", 7, late_ranges=0.1, mislabelled=0.02)[0].first(1000)
    a, u, guess = dataset.aruco, dataset.uwb, dataset.antenna_guess
    C = a.covariance[:, *np.triu_indices(3)]
    rows = {"aruco": np.column_stack([a.pose + 1, a.marker, a.marker_in_vehicle, C]),
            "uwb": np.column_stack([u.pose + 1, u.antenna, u.range, u.sigma]),
            "guess": np.column_stack([guess.antenna, guess.position])}
    ids = np.unique(np.r_[a.marker, guess.antenna])
    new = np.random.default_rng(0).permutation(ids)
    renamed = {name: table[::-1].copy() for name, table in rows.items()}
    for name, column in (("aruco", 1), ("uwb", 1), ("guess", 0)):
        renamed[name][:, column] = new[np.searchsorted(ids, renamed[name][:, column])]
    side = {"aruco": [1, 1, 1, -1, -1, 1, -1, -1, 1, 1, 1], "uwb": 1, "guess": [1, 1, -1]}
    mirrored = {name: table * side[name] for name, table in rows.items()}
    numbers = dict(zip(ids.tolist(), new.tolist()))
    for ticks, tables, changes in (
            (dataset.ticks, renamed, {"numbers": numbers}),
            (dataset.ticks[:, ::-1], mirrored, {"factor": (1, -1, -1)})):
        others = estimates(dataset_from_arrays(ticks, **tables, vehicle=dataset.vehicle))
        for (name, expected, x, C), (_, found, other, other_C) in zip(
                estimates(dataset, **changes), others, strict=True):
            np.testing.assert_array_equal(found, expected, err_msg=name)
            off = other - x
            off[:, 2:] = se2.wrap(off[:, 2:])
            sigma = np.sqrt(np.diagonal(C, axis1=1, axis2=2)) + SMALLEST
            for share in (off / sigma, (other_C - C) / (sigma[:, :, None] * sigma[:, None])):
                np.testing.assert_allclose(share, 0 * share, 0, LEARNED, err_msg=name)
