"""Properties of all legal input: files of any bytes, small drives of any kind, and changed drives.

`pytest --hypothesis-profile=long tests/test_properties.py` tries many more, other ones every time.
"""

import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numeric import errors_of, short
from numpy.testing import assert_allclose, assert_array_equal
from test_dataset import FILES, write

from slamlib.core import odometry, se2
from slamlib.core.errors import DatasetError
from slamlib.core.records import AntennaGuess
from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import dataset_from_arrays, read_dataset, read_truth
from slamlib.robust.file_doubts import doubts_before_solving
from slamlib.solve import Failure, solutions, summarize

QUICK = settings(max_examples=3 * settings.default.max_examples)
HALF = settings(max_examples=settings.default.max_examples // 2)

# Drives.

COUNTS = st.sampled_from([0, 127, -127, 1, 2000, 55])
LEGS = st.tuples(st.integers(1, 30), COUNTS, COUNTS)        # steps, right and left counts of each
IDS = np.array([-7, 0, 10**12, -10**12, 10**12 + 1, *range(1, 296)])
VEHICLES = st.builds(Vehicle, **{name: st.sampled_from(values) for names, values in {
    "right_radius left_radius": [0.1, 0.101, 0.099, 0.02, 0.5], "wheelbase": [0.4, 0.05, 2.0],
    "sigma_right_radius sigma_left_radius": [1e-4, 1e-6, 5e-3],
    "sigma_wheelbase": [1e-4, 1e-6, 1e-2], "sigma_heading": [1e-4, 1e-6, 0.1, 1.0],
    "sigma_camera_x sigma_camera_y": [0.0, 0.0, 0.05], "sigma_camera_turn": [0.0, 0.0, 0.02],
    "sigma_marker_size sigma_range_scale": [0.0, 0.0, 0.01],
    "sigma_sighting_lag sigma_range_lag": [0.0, 0.0, 2.0], "sigma_antenna_height": [0.0, 0.0, 1.0],
    "sigma_tag_x sigma_range_offset": [0.0, 0.0, 0.1]}.items() for name in names.split()})


def chosen(draw, *values):
    return draw(st.sampled_from(values))


@st.composite
def drives(draw):
    """Arguments of `dataset_from_arrays` for a small legal drive."""
    vehicle = draw(VEHICLES)
    legs = draw(st.lists(LEGS, max_size=4))
    ticks = np.concatenate([[[0, 0]], *(np.tile(leg[1:], (leg[0], 1)) for leg in legs)])
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    true = vehicle.with_wheel(vehicle.wheel + rng.normal(size=3) * vehicle.sigma_wheel)
    path = odometry.dead_reckoning(ticks, true, model="arc")
    ranges, guesses = ranges_from(draw, path, rng)
    return {"ticks": ticks, "aruco": sightings_from(draw, path, rng), "uwb": ranges,
            "guess": guesses, "vehicle": vehicle}


def measured(draw, poses, landmarks, rng):
    """Poses (m,) that measure landmarks (m,): of every k-th pose from one on, a share of all."""
    frame = np.arange(draw(st.integers(0, poses)), poses, chosen(draw, 1, 3, 10, poses))
    share = chosen(draw, 1.0, 0.5, 0.05)
    row, landmark = np.nonzero(rng.uniform(size=(len(frame), landmarks)) < share)
    return frame[row], landmark


def sightings_from(draw, path, rng):
    """Rows (m, 11) of ArucoReading.txt from poses (n, 3)."""
    ids = IDS[:chosen(draw, 1, 3, 6, 20)]
    near = path[rng.integers(len(path), size=len(ids))]
    marker = near + rng.uniform(-3, 3, near.shape)
    pose, which = measured(draw, len(path), len(ids), rng)
    label = chosen(draw, which, rng.permuted(which))
    sigma = np.tile(chosen(draw, [0.005, 0.005, 0], [1e-4, 1e-2, 0], [0.5, 0.5, 0]), (len(pose), 1))
    sigma[:, 2] = rng.choice(chosen(draw, [0.01], [1e-3], [0.4], [100], [0.01, 100]), len(pose))
    rho = chosen(draw, 0, 0.9)
    C = (rho + (1 - rho) * np.eye(3)) * sigma[:, :, None] * sigma[:, None]
    z = se2.between(path[pose], marker[which]) + chosen(draw, 1, 0, 30) * errors_of(C, rng)
    z[:, 2] = se2.wrap(z[:, 2])
    return np.column_stack([pose + 1, ids[label], z, C[:, *np.triu_indices(3)]])


def ranges_from(draw, path, rng):
    """Rows (m, 4) of UwbReading.txt from poses (n, 3), and (a, 3) of UwbAntennaGuess.txt."""
    ids = IDS[:draw(st.integers(1, 4))]
    near = path[rng.integers(len(path), size=len(ids)), :2]
    antenna = near + chosen(draw, 0.0, 3.0, 50.0) * rng.normal(size=near.shape)
    guess = antenna + chosen(draw, 0.3, 0.0, 30.0) * rng.normal(size=near.shape)
    pose, which = measured(draw, len(path), len(ids), rng)
    sigma = np.full(len(pose), chosen(draw, 0.05, 1e-3, 1.0))
    late = chosen(draw, 0.0, 5.0) * (rng.uniform(size=len(pose)) < 0.3)
    noise = sigma * rng.normal(size=len(pose)).clip(-4, 4)
    distance = np.hypot(*(antenna[which] - path[pose, :2]).T)
    return (np.column_stack([pose + 1, ids[which], distance + late + noise, sigma]),
            np.column_stack([ids, guess]))


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
    dataset = dataset_from_arrays(**drive)
    for solution in solutions(dataset):
        if isinstance(solution, Failure):             # all sightings contradict each other
            _, count = np.unique(drive["aruco"][:, :2], axis=0, return_counts=True)
            assert solution.problem == "problem2" and (count > 1).all(), solution
            assert "contradict" in solution.reason
            continue
        json.dumps(summarize(solution, None), allow_nan=False)
        known = np.isfinite(solution.poses).all(axis=1)
        assert known.any() and (known.all() or solution.problem == "problem2")
        assert np.isnan(solution.covariances[~known]).all()
        least = 0 if solution.problem in ("problem3", "problem4") else -1e-9
        for C in (solution.covariances[known], *(each[2] for each in solution.maps.values())):
            assert_positive(C, least, solution.problem)
    for doubt in doubts_before_solving(dataset):
        assert doubt.sentence.endswith(".") and "nan" not in doubt.sentence


def assert_positive(covariances, least, problem):
    assert np.isfinite(covariances).all(), problem
    sigma = np.maximum(se2.sigmas(covariances), 1e-15)
    correlation = covariances / (sigma[:, :, None] * sigma[:, None])
    assert_allclose(correlation, correlation.mT, 0, 1e-9)
    if len(covariances):
        assert np.linalg.eigvalsh(correlation)[:, 0].min() > least, problem


# Changes of a drive that change nothing but what they must.

SMALLEST = 1e-9            # m and rad, sigma of what has none: position of pose 1 in problem 1
# In sigmas. The search of the noise ends where it gains 0.01 in log density, 0.14 of its own sigma
# from the maximum. Rounding decides where, and so little of the noise changes a covariance by few
# percent.
LEARNED = 0.05


def estimates(dataset):
    """Name, ids (m,), values (m, d) and covariances (m, d, d) of poses and maps."""
    for found in solutions(dataset):
        yield f"{found.problem} poses", np.zeros(0), found.poses, found.covariances
        for each in found.maps.values():
            yield f"{found.problem} map", *each


def backwards(readings):
    """Readings in the opposite order at each pose."""
    return readings.select(np.lexsort((-np.arange(len(readings.pose)), readings.pose)))


@pytest.mark.slow
def test_ids_the_order_of_rows_and_the_side_are_names_only():
    """Negative ids, and rows in the opposite order; and the same drive in a mirror."""
    dataset, _ = short(7, 1000, late_ranges=0.1, mislabelled=0.02)
    a = backwards(dataset.aruco)
    u = backwards(dataset.uwb)
    guess = dataset.antenna_guess
    straight = [*estimates(dataset)]
    for sign, side in ((-1, 1), (1, -1)):
        mirror = np.array([1, side, side])
        other = replace(
            dataset, ticks=dataset.ticks[:, ::side], uwb=replace(u, antenna=sign * u.antenna),
            aruco=replace(a, marker=sign * a.marker, covariance=np.outer(mirror, mirror) *
                          a.covariance, marker_in_vehicle=mirror * a.marker_in_vehicle),
            antenna_guess=AntennaGuess(sign * guess.antenna[::sign],
                                       mirror[:2] * guess.position[::sign]))
        for (name, ids, x, C), (_, found, y, C_y) in zip(straight, estimates(other), strict=True):
            assert_array_equal(found, sign * ids[::sign], err_msg=name)
            order = sign if len(ids) else 1
            by = mirror[:x.shape[1]]
            off = y - by * x[::order]
            off[:, 2:] = se2.wrap(off[:, 2:])
            change = C_y - np.outer(by, by) * C[::order]
            sigma = se2.sigmas(C_y) + SMALLEST
            for share in (off / sigma, change / (sigma[:, :, None] * sigma[:, None])):
                assert_allclose(share, 0 * share, 0, LEARNED, err_msg=name)
