"""A valid folder reads to exactly its numbers; anything else ends in one clear sentence."""

import dataclasses
import gzip
import os
import warnings
from pathlib import Path

import numpy as np
import pytest

from slamlib import se2
from slamlib.dataset import DatasetError, Vehicle, dataset_names, read_dataset, read_truth
from slamlib.limits import LIMITS

FILES = {
    "encoderReading.txt": "1 0 0\n2 10 12\n3 -5 7\n4 0 80000\n",
    # Out of order in pose, and marker 40 seen twice at pose 3.
    "ArucoReading.txt": (
        "3 40 1.5 -2 0.5 4e-4 1e-4 0 9e-4 0 1e-4\n"
        "2 -7 0.1 0.2 4.0 1e-4 0 1e-5 1e-4 2e-5 1e4\n"
        "3 40 1.6 -2.1 0.6 4e-4 0 0 4e-4 0 4e-4\n"
    ),
    "UwbReading.txt": "4 900 2.5 0.1\n1 3 1.25 0.2\n",
    "UwbAntennaGuess.txt": "900 1 2\n3 -4 5.5\n",
    "vehicle.toml": "wheelbase = 0.5\nticks_per_revolution = 8000\n",
    "truth/vehiclePose.txt": "1 0 0 0\n2 0.1 0 3.0\n3 0.2 0.1 -3.0\n4 0.3 0.2 -2.9\n",
    "truth/ArucoMap.txt": "40 1 2 0.3\n-7 3 4 -0.3\n",
    "truth/UwbMap.txt": "900 1.1 2.1\n3 -4.1 5.4\n",
    "truth/vehicle.toml": "sigma_wheelbase = 0.002\n",
}
VEHICLE = Vehicle(wheelbase=0.5)


@pytest.fixture(autouse=True)
def no_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.fixture
def folder(tmp_path):
    for name, text in FILES.items():
        write(tmp_path / "drive" / name, text)
    return tmp_path / "drive"


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)


def assert_same(a, b):
    """Two records hold the same arrays, with the same shapes and dtypes."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b)
        for field in dataclasses.fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b


def assert_ints(array, expected):
    assert array.dtype == np.int64
    np.testing.assert_array_equal(array, expected)


def error_of(read, folder):
    with pytest.raises(DatasetError) as caught:
        read(folder)
    message = str(caught.value)
    assert "\n" not in message and "expected" in message and len(message) < 400
    return message


# What a valid folder reads to.


def test_measurements_are_exactly_those_written(folder):
    data = read_dataset(folder)
    assert data.name == "drive"
    assert data.vehicle == VEHICLE
    assert isinstance(data.vehicle.ticks_per_revolution, float)
    assert_ints(data.ticks, [[0, 0], [10, 12], [-5, 7], [0, 80000]])
    assert_ints(data.aruco.pose, [1, 2, 2])
    assert_ints(data.aruco.marker, [-7, 40, 40])
    np.testing.assert_array_equal(
        data.aruco.marker_in_vehicle, [[0.1, 0.2, 4.0], [1.5, -2, 0.5], [1.6, -2.1, 0.6]]
    )
    np.testing.assert_array_equal(
        data.aruco.covariance,
        [
            [[1e-4, 0, 1e-5], [0, 1e-4, 2e-5], [1e-5, 2e-5, 1e4]],
            [[4e-4, 1e-4, 0], [1e-4, 9e-4, 0], [0, 0, 1e-4]],
            [[4e-4, 0, 0], [0, 4e-4, 0], [0, 0, 4e-4]],
        ],
    )
    assert_ints(data.uwb.pose, [0, 3])
    assert_ints(data.uwb.antenna, [3, 900])
    np.testing.assert_array_equal(data.uwb.range, [1.25, 2.5])
    np.testing.assert_array_equal(data.uwb.sigma, [0.2, 0.1])
    assert_ints(data.antenna_guess.antenna, [3, 900])
    np.testing.assert_array_equal(data.antenna_guess.position, [[-4, 5.5], [1, 2]])


def test_truth_is_exactly_that_written(folder):
    truth = read_truth(folder)
    np.testing.assert_array_equal(truth.poses[:, :2], [[0, 0], [0.1, 0], [0.2, 0.1], [0.3, 0.2]])
    turn = 2 * np.pi
    np.testing.assert_allclose(truth.poses[:, 2], [0, 3, turn - 3, turn - 2.9], rtol=1e-15)
    assert_ints(truth.marker, [-7, 40])
    np.testing.assert_array_equal(truth.marker_in_world, [[3, 4, -0.3], [1, 2, 0.3]])
    assert_ints(truth.antenna, [3, 900])
    np.testing.assert_array_equal(truth.antenna_in_world, [[-4.1, 5.4], [1.1, 2.1]])
    assert truth.vehicle == dataclasses.replace(VEHICLE, sigma_wheelbase=0.002)


def test_continuous_heading_is_kept_to_the_bit(folder):
    heading = [0, 3.1, 6.123456789, 9.2]
    rows = [f"{i} 0 0 {h}" for i, h in enumerate(heading, start=1)]
    write(folder / "truth/vehiclePose.txt", "\n".join(rows))
    np.testing.assert_array_equal(read_truth(folder).poses[:, 2], heading)


def test_truth_in_another_frame_is_moved_to_its_first_pose_and_said(folder):
    """Moved out of its frame and read again, the truth is the same, and one doubt says it."""
    clean = read_truth(folder)
    assert clean.doubts == ()
    first = np.array([12.5, -3.25, 2.8])
    poses, markers = (se2.compose(first, p) for p in (clean.poses, clean.marker_in_world))
    antennas = se2.compose(first, np.pad(clean.antenna_in_world, ((0, 0), (0, 1))))[:, :2]
    for name, ids, rows in (
            ("vehiclePose", np.arange(1, 5), poses), ("ArucoMap", clean.marker, markers),
            ("UwbMap", clean.antenna, antennas)):
        rows = np.column_stack([ids, rows]).tolist()
        write(folder / f"truth/{name}.txt",
              "\n".join(" ".join([f"{row[0]:.0f}", *map(repr, row[1:])]) for row in rows))
    moved = read_truth(folder)
    for name in ("poses", "marker_in_world", "antenna_in_world"):
        np.testing.assert_allclose(getattr(moved, name), getattr(clean, name), atol=1e-14)
    assert (abs(moved.marker_in_world[:, 2]) <= np.pi).all() and (abs(markers[:, 2]) > 2).any()
    doubt, = moved.doubts
    assert doubt.what == "truth-frame"
    assert "(12.500 m, -3.250 m, 2.8000 rad)" in doubt.sentence


@pytest.mark.parametrize("start, doubts", [
    ([9e-4, -9e-4, 9e-4], 0), ([0, 0, 2 * np.pi], 0), ([0, 0, -4 * np.pi + 5e-4], 0),
    ([2e-3, 0, 0], 1), ([0, 0, np.pi], 1), ([0, -2e-3, 2 * np.pi], 1)])
def test_truth_that_is_rounded_or_begins_with_full_turns_is_no_doubt(folder, start, doubts):
    path = np.add(start, [[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]])
    write(folder / "truth/vehiclePose.txt",
          "\n".join(f"{i} {x!r} {y!r} {h!r}" for i, (x, y, h) in enumerate(path.tolist(), start=1)))
    truth = read_truth(folder)
    assert len(truth.doubts) == doubts
    assert abs(truth.poses[0]).max() < (1e-12 if doubts else 1e-3)
    expected = se2.between(path[0], path) if doubts else path - [0, 0, 2 * np.pi * round(
        start[2] / (2 * np.pi))]
    np.testing.assert_allclose(truth.poses, expected, atol=1e-12)


def test_vehicle_defaults_are_table_2(folder):
    (folder / "vehicle.toml").unlink()
    vehicle = read_dataset(folder).vehicle
    assert dataclasses.astuple(vehicle)[:11] == (0.1, 0.1, 0.4, 8000.0, 1e-4, 1e-4, 1e-4, 1e-4,
                                                 None, None, None)
    others = [*dataclasses.asdict(vehicle).items()][11:]
    assert {name: value for name, value in others if value} == {"marker_size": 1, "range_scale": 1}
    assert len(others) == 22


def test_name_of_the_folder_given_by_a_relative_path(folder, monkeypatch):
    monkeypatch.chdir(folder / "truth")
    assert read_dataset("..").name == "drive"


@pytest.mark.parametrize("content", [None, "", "\n\n", "# no rows\n  # none\n"])
def test_absent_or_empty_sensors_are_none(folder, content):
    for name in ("ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt"):
        (folder / name).unlink()
        if content is not None:
            write(folder / name, content)
    data = read_dataset(folder)
    assert data.aruco is None and data.uwb is None and data.antenna_guess is None


def test_absent_truth_is_none_and_absent_maps_are_empty(folder):
    for name in ("ArucoMap.txt", "UwbMap.txt", "vehicle.toml"):
        (folder / "truth" / name).unlink()
    truth = read_truth(folder)
    assert_ints(truth.marker, np.empty(0))
    assert_ints(truth.antenna, np.empty(0))
    assert truth.marker_in_world.shape == (0, 3) and truth.antenna_in_world.shape == (0, 2)
    assert truth.vehicle == VEHICLE
    (folder / "truth/vehiclePose.txt").unlink()
    (folder / "truth").rmdir()
    assert read_truth(folder) is None


def test_one_pose_is_a_dataset(tmp_path):
    write(tmp_path / "encoderReading.txt", "1 0 0")
    assert_ints(read_dataset(tmp_path).ticks, [[0, 0]])


def test_readings_are_selected_by_mask_and_by_index(folder):
    data = read_dataset(folder)
    for readings in (data.aruco, data.uwb):
        mask = readings.pose != 1
        kept = readings.select(mask)
        assert_same(kept, readings.select(np.flatnonzero(mask)))
        assert_same(kept, type(readings)(*(v[mask] for v in vars(readings).values())))
        assert len(kept.pose) == np.count_nonzero(mask) > 0
    assert_ints(data.aruco.select([2, 0]).marker, [40, -7])


def test_the_first_poses_have_the_readings_until_then(folder):
    data = read_dataset(folder)
    first = data.first(3)
    assert_ints(first.ticks, data.ticks[:3])
    assert_same(first.aruco, data.aruco)
    assert_ints(first.uwb.pose, [0])
    assert_same(dataclasses.replace(first, ticks=data.ticks, aruco=data.aruco, uwb=data.uwb), data)
    assert data.first(1).aruco is None and data.without("uwb").first(4).uwb is None
    assert_same(data.first(4), data)


def test_a_vehicle_by_its_deviation():
    vehicle = Vehicle(sigma_left_radius=2e-4).with_deviation(np.array([1.0, -2.0, 3.0]))
    np.testing.assert_allclose(vehicle.wheel, [0.1001, 0.0996, 0.4003], rtol=1e-15)
    np.testing.assert_array_equal(vehicle.sigma_wheel, [1e-4, 2e-4, 1e-4])


# Valid variants of the format.


def with_comments(text):
    lines = text.splitlines()
    return "# caf\u00e9 12\n\n \t\n" + "\n\n".join(f"{line} # 1 2, \u00b5m" for line in lines)


ODDITIES = {
    "CRLF": lambda text: text.replace("\n", "\r\n").encode(),
    "lone CR": lambda text: text.replace("\n", "\r").encode(),
    "no last line end": lambda text: text.rstrip("\n").encode(),
    "tabs": lambda text: text.replace(" ", "\t").encode(),
    "indented": lambda text: ("  " + text.replace("\n", " \t \n   ")).encode(),
    "UTF-8 comments": lambda text: with_comments(text).encode("utf-8"),
    "Latin-1 comments": lambda text: with_comments(text).encode("latin-1"),
    "byte-order mark": lambda text: text.encode("utf-8-sig"),
}


@pytest.mark.parametrize("oddity", ODDITIES)
def test_oddities_of_text_change_nothing(folder, oddity):
    clean = read_dataset(folder), read_truth(folder)
    for name, text in FILES.items():
        write(folder / name, ODDITIES[oddity](text))
    assert_same(read_dataset(folder), clean[0])
    assert_same(read_truth(folder), clean[1])


@pytest.mark.parametrize("change", [str.upper, str.lower])
def test_names_in_another_case_are_found(folder, change):
    clean = read_dataset(folder), read_truth(folder)
    for name in FILES:
        path = folder / name
        path.rename(path.with_name(change(path.name)))
    (folder / "truth").rename(folder / change("truth"))
    assert_same(read_dataset(folder), clean[0])
    assert_same(read_truth(folder), clean[1])


def test_numbers_in_other_spellings(folder):
    clean = read_dataset(folder)
    write(folder / "encoderReading.txt", "1.0 -0 0e5\n+2 1E1 12.\n3e0 -.5e1 7\n004 0 8e+4\n")
    assert_same(read_dataset(folder), clean)


def test_ids_are_labels_negative_or_huge(folder):
    huge = 999_999_999_999_999
    write(folder / "UwbReading.txt", f"1 {huge} 1 1\n1 {-huge} 1 1\n")
    write(folder / "UwbAntennaGuess.txt", f"{huge} 0 0\n{-huge} 1 1\n")
    data = read_dataset(folder)
    assert_ints(data.uwb.antenna, [huge, -huge])
    assert_ints(data.antenna_guess.antenna, [-huge, huge])


def test_covariances_of_very_different_scales(folder):
    row = "1e-17 0 5e-8 1e-17 0 1e4"  # a marker whose orientation is not seen
    write(folder / "ArucoReading.txt", f"1 40 0 0 0 {row}\n")
    np.testing.assert_array_equal(
        read_dataset(folder).aruco.covariance, [[[1e-17, 0, 5e-8], [0, 1e-17, 0], [5e-8, 0, 1e4]]]
    )


def test_sightings_at_one_pose_keep_their_order(folder):
    rows = [f"{4 - i % 4} {i} 0 0 0 1 0 0 1 0 1" for i in range(300)]
    write(folder / "ArucoReading.txt", "\n".join(rows))
    aruco = read_dataset(folder).aruco
    assert_ints(aruco.pose, np.repeat([0, 1, 2, 3], 75))
    assert_ints(aruco.marker, np.arange(300).reshape(75, 4).T[::-1].ravel())
    write(folder / "UwbReading.txt", "\n".join(f"{4 - i % 4} 3 {i + 1} 1" for i in range(300)))
    uwb = read_dataset(folder).uwb
    assert_ints(uwb.pose, aruco.pose)
    np.testing.assert_array_equal(uwb.range, aruco.marker + 1)


# Errors: (file, its whole content or its content as a function of the valid one, line, key word).


def third_row(row):
    """Two comment or blank lines, the valid rows 1 and 2, and this row: in line 5."""
    return lambda text: "# head\n\n" + "".join(text.splitlines(True)[:2]) + row + "\n"


def appended(row):
    return lambda text: text + row + "\n"


ARUCO_ROW = "1 40 0 0 0 "
ERRORS = [
    ("encoderReading.txt", "", None, "no rows"),
    ("encoderReading.txt", "# nothing\n\n", None, "no rows"),
    ("encoderReading.txt", third_row("3 5"), 5, "(pose id, right ticks, left ticks), found 2"),
    ("encoderReading.txt", third_row("3 5 6 7"), 5, "3 columns"),
    ("encoderReading.txt", "\n1 0\n2 0\n", 2, "3 columns"),
    ("encoderReading.txt", "\r\r1 0 0\r\r2 0\r", 5, "3 columns"),
    ("encoderReading.txt", "\r\n1 0 0\r\n2 0", 3, "3 columns"),
    ("encoderReading.txt", third_row("3 five 6"), 5, "found 'five'"),
    ("encoderReading.txt", third_row("3 " + "x" * 999 + " 6"), 5, "finite number"),
    ("encoderReading.txt", third_row("3,5,6"), 5, "3 columns"),
    ("encoderReading.txt", third_row("3, 5, 6"), 5, "finite number"),
    ("encoderReading.txt", third_row("3 1_000 6"), 5, "finite number"),
    ("encoderReading.txt", third_row("3 0x10 6"), 5, "finite number"),
    ("encoderReading.txt", third_row("3 \u0663 6"), 5, "finite number"),
    ("encoderReading.txt", third_row("3\u00a05 6"), 5, "3 columns"),
    ("encoderReading.txt", third_row("3 nan 6"), 5, "finite number"),
    ("encoderReading.txt", third_row("3 5 -inf"), 5, "finite number"),
    ("encoderReading.txt", third_row("3 5 infinity"), 5, "finite number"),
    ("encoderReading.txt", third_row("3 5 1e999"), 5, "finite number"),
    ("encoderReading.txt", third_row("3 5 1e15"), 5, "1e+15"),
    ("encoderReading.txt", third_row("3 -1e15 5"), 5, "1e+15"),
    ("encoderReading.txt", third_row("3 5.5 6"), 5, "whole number"),
    ("encoderReading.txt", third_row("3 5 80001"), 5, "10 wheel revolutions"),
    ("encoderReading.txt", third_row("3 -80001 5"), 5, "10 wheel revolutions"),
    ("encoderReading.txt", third_row("4 5 6"), 5, "in order"),
    ("encoderReading.txt", third_row("2 5 6"), 5, "in order"),
    ("encoderReading.txt", third_row("2.5 5 6"), 5, "in order"),
    ("encoderReading.txt", "0 0 0\n1 5 6\n", 1, "in order"),
    ("encoderReading.txt", "# head\n1 0 1\n2 5 6\n3 5 6\n4 5 6\n", 2, "'1 0 0'"),
    ("encoderReading.txt", b"1 0 0\n2 5\x00 6\n", 2, "plain text"),
    ("encoderReading.txt", b"1 0 0\r\n2 5 6 # \x00\r\n", 2, "plain text"),
    ("encoderReading.txt", b"1 0 0\n2 5\x1c6\n", 2, "plain text"),
    ("encoderReading.txt", b"\x89\xf0\xff 0 0\n", 1, "finite number"),
    ("encoderReading.txt", gzip.compress(b"1 0 0\n", mtime=0), 1, "plain text"),
    ("encoderReading.txt", "1 0 0\n".encode("utf-16")[:-1], None, "UTF-16 that breaks off"),
    ("encoderReading.txt", "1 0 0\n".encode("utf-32"), 1, "plain text"),
    ("ArucoReading.txt", third_row("1 40 0 0 0 1 0 0 1 0"), 5, "11 columns (pose id, marker id, x"),
    ("ArucoReading.txt", third_row("5 40 0 0 0 1 0 0 1 0 1"), 5, "pose id from 1 to 4"),
    ("ArucoReading.txt", third_row("0 40 0 0 0 1 0 0 1 0 1"), 5, "pose id from 1 to 4"),
    ("ArucoReading.txt", third_row("1.5 40 0 0 0 1 0 0 1 0 1"), 5, "whole number"),
    ("ArucoReading.txt", third_row("1 4.5 0 0 0 1 0 0 1 0 1"), 5, "whole number"),
    ("ArucoReading.txt", third_row("1 40 0 inf 0 1 0 0 1 0 1"), 5, "finite number"),
    ("ArucoReading.txt", third_row("1 40 0 0 90 1 0 0 1 0 1"), 5, "in radians"),
    ("ArucoReading.txt", third_row(ARUCO_ROW + "0 0 0 1 0 1"), 5, "positive s_xx from 1e-18"),
    ("ArucoReading.txt", third_row(ARUCO_ROW + "1 0 0 -1 0 1"), 5, "positive s_yy"),
    ("ArucoReading.txt", third_row(ARUCO_ROW + "1 0 0 1 0 9e-19"), 5, "positive s_thetatheta"),
    ("ArucoReading.txt", third_row(ARUCO_ROW + "1 1 0 1 0 1"), 5, "positive definite"),
    ("ArucoReading.txt", third_row(ARUCO_ROW + "1e-4 2e-4 0 1e-4 0 1e4"), 5, "positive definite"),
    ("ArucoReading.txt", third_row(ARUCO_ROW + "1 .9 -.9 1 .9 1"), 5, "positive definite"),
    ("ArucoReading.txt", third_row(ARUCO_ROW + "1 9e14 0 1 0 1e-18"), 5, "positive definite"),
    ("UwbReading.txt", third_row("1 3 1"), 5, "4 columns (pose id, antenna id, range, sigma)"),
    ("UwbReading.txt", third_row("5 3 1 1"), 5, "pose id from 1 to 4"),
    ("UwbReading.txt", third_row("1 3.5 1 1"), 5, "whole number"),
    ("UwbReading.txt", third_row("1 3 -5.1 1"), 5, "a range that is not below -5 sigma"),
    ("UwbReading.txt", third_row("1 3 1 0"), 5, "positive sigma"),
    ("UwbReading.txt", third_row("1 3 1 9e-10"), 5, "positive sigma"),
    ("UwbReading.txt", third_row("1 4 1 1"), 5, "UwbAntennaGuess.txt"),
    ("UwbAntennaGuess.txt", third_row("1 3"), 5, "3 columns (antenna id, x, y)"),
    ("UwbAntennaGuess.txt", third_row("900 1 2"), 5, "only once"),
    ("UwbAntennaGuess.txt", third_row("9.5 1 2"), 5, "whole number"),
    ("UwbAntennaGuess.txt", third_row("9 inf 2"), 5, "finite number"),
    ("vehicle.toml", appended("wheel_base = 1"), 3, "keys among right_radius"),
    ("vehicle.toml", appended("[wheelbases]\nx = 1"), 3, "keys among right_radius"),
    ("vehicle.toml", "# wheel\nwheelbase = 1\nwheel = 1\n", 3, "found 'wheel'"),
    ("vehicle.toml", "wheelbase = 1\n\n\n  'wheel' = 1\n", 4, "keys among"),
    ("vehicle.toml", "wheelbase = 1\n'' = 1\n", 2, "keys among"),
    ("vehicle.toml", appended("left_radius = 'wide'"), 3, "positive number for left_radius"),
    ("vehicle.toml", appended("left_radius = [0.1]"), 3, "positive number"),
    ("vehicle.toml", appended("left_radius = true"), 3, "positive number"),
    ("vehicle.toml", appended("left_radius = 0"), 3, "positive number"),
    ("vehicle.toml", appended("left_radius = -0.1"), 3, "positive number"),
    ("vehicle.toml", appended("left_radius = nan"), 3, "positive number"),
    ("vehicle.toml", appended("left_radius = inf"), 3, "positive number"),
    ("vehicle.toml", appended("left_radius = 1e15"), 3, "positive number"),
    ("vehicle.toml", appended("left_radius = 0x" + "f" * 5000), 3, "positive number"),
    ("vehicle.toml", appended("sigma_heading = 0.0"), 3, "positive number for sigma_heading"),
    ("vehicle.toml", appended("left_radius = 0,1"), 3, "TOML"),
    ("vehicle.toml", appended("left_radius ="), 3, "TOML"),
    ("vehicle.toml", "left_radius = [1,\n2\n\n", 2, "TOML"),
    ("vehicle.toml", appended("wheelbase = 0.6"), 3, "TOML"),
    ("vehicle.toml", appended("left_radius = " + "[" * 5000), None, "TOML"),
    ("vehicle.toml", appended("left_radius = " + "1" * 5000), None, "TOML"),
    ("vehicle.toml", "wheelbase = \0 1\n".encode("utf-16"), 1, "plain text"),
    ("truth/vehiclePose.txt", third_row("3 0 0"), 5, "4 columns (pose id, x, y, theta)"),
    ("truth/vehiclePose.txt", third_row("4 0 0 0"), 5, "in order"),
    ("truth/vehiclePose.txt", third_row("3 0 0 0"), None, "4 poses (encoder file), found 3"),
    ("truth/vehiclePose.txt", appended("5 0 0 0"), None, "4 poses (encoder file), found 5"),
    ("truth/vehiclePose.txt", "", None, "4 poses (encoder file), found 0"),
    ("truth/ArucoMap.txt", appended("40 0 0 0"), 3, "only once"),
    ("truth/ArucoMap.txt", appended("41 0 0"), 3, "4 columns (marker id, x, y, theta)"),
    ("truth/UwbMap.txt", appended("900 0 0"), 3, "only once"),
    ("truth/UwbMap.txt", appended("9.5 0 0"), 3, "whole number"),
    ("truth/vehicle.toml", appended("wheelbase = 0"), 2, "positive number"),
]


@pytest.mark.parametrize(("name", "content", "line", "key_word"), ERRORS)
def test_faults_in_a_file_are_named_by_file_line_and_expectation(
    folder, name, content, line, key_word
):
    write(folder / name, content(FILES[name]) if callable(content) else content)
    message = error_of(read_truth if name.startswith("truth/") else read_dataset, folder)
    place = f"{folder / name}: " if line is None else f"{folder / name}, line {line}: "
    assert message.startswith(place)
    assert key_word in message


# Limits: of every file and column the number at the limit is read, the next one beyond refused.

ROWS = {
    "ArucoReading.txt": "1 40 0 0 0 1 0 0 1 0 1", "UwbReading.txt": "1 3 1 1e4",
    "UwbAntennaGuess.txt": "3 0 0", "vehiclePose.txt": "1 0 0 0", "ArucoMap.txt": "40 0 0 0",
    "UwbMap.txt": "3 0 0"}
COLUMNS = {
    "ArucoReading.txt": ["", "", "x", "y", "theta", "s_xx", "", "", "s_yy", "", "s_thetatheta"],
    "UwbReading.txt": ["", "", "range", "sigma"], "UwbAntennaGuess.txt": ["", "x", "y"],
    "vehiclePose.txt": ["", "x", "y", "theta"], "ArucoMap.txt": ["", "x", "y", "theta"],
    "UwbMap.txt": ["", "x", "y"]}
PLACES = [(name, column) for name in ROWS for column in LIMITS[name]]


def write_number(folder, name, column, value):
    """Write a folder of one pose with this number in a file; path and reader of the file."""
    words = ROWS[name].split()
    words[COLUMNS[name].index(column)] = repr(value)
    write(folder / "encoderReading.txt", "1 0 0\n")
    path = folder / ("truth" if name in ("vehiclePose.txt", "ArucoMap.txt", "UwbMap.txt") else "") \
        / name
    if name.startswith("Uwb"):
        write(folder / "UwbAntennaGuess.txt", "3 0 0\n")
    if path.parent.name == "truth":
        write(path.parent / "vehiclePose.txt", "1 0 0 0\n")
    write(path, " ".join(words) + "\n")
    return path, read_truth if path.parent.name == "truth" else read_dataset


@pytest.mark.parametrize("name, column", PLACES)
def test_numbers_at_the_limits_are_read_and_beyond_them_refused(tmp_path, name, column):
    limit = LIMITS[name][column]
    for most, away in ((limit.minimum, -np.inf), (limit.maximum, np.inf)):
        path, read = write_number(tmp_path, name, column, float(most))
        read(tmp_path)
        beyond = float(np.nextafter(most, away))
        write_number(tmp_path, name, column, beyond)
        message = error_of(read, tmp_path)
        assert message.startswith(f"{path}, line 1: expected ") and str(limit) in message
        assert message.endswith(f"found '{beyond!r}'")


@pytest.mark.parametrize("key", LIMITS["vehicle.toml"])
def test_a_vehicle_at_the_limits_is_read_and_beyond_them_refused(tmp_path, key):
    limit, parameter = LIMITS["vehicle.toml"][key], key.removeprefix("sigma_")
    write(tmp_path / "encoderReading.txt", "1 0 0\n")
    most = 2.0 if isinstance(limit.maximum, str) else limit.maximum
    other = f"{parameter} = 2\n" if isinstance(limit.maximum, str) else ""
    for value, away in ((limit.minimum, -np.inf), (most, np.inf)):
        write(tmp_path / "vehicle.toml", f"{key} = {float(value)!r}\n{other}")
        assert getattr(read_dataset(tmp_path).vehicle, key) == value
        beyond = float(np.nextafter(value, away))
        write(tmp_path / "vehicle.toml", f"{key} = {beyond!r}\n{other}")
        message = error_of(read_dataset, tmp_path)
        assert f"line 1: expected {limit.expected(f'number for {key}')}, found" in message
        assert message.endswith(f"found '{beyond!r}'")


def test_the_limits_that_a_user_reads_are_those_of_the_reader():
    text = (Path(__file__).parents[1] / "data" / "README.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()
            if line.startswith("| `") and "| from " in line]
    told = {(file.strip("`"), column.strip("` ")): limit for file, columns, limit in rows
            for column in columns.split(",")}
    assert told == {(file, column): str(limit) for file, columns in LIMITS.items()
                    for column, limit in columns.items()}


def test_ranges_without_a_guess_file(folder):
    (folder / "UwbAntennaGuess.txt").unlink()
    message = error_of(read_dataset, folder)
    assert message.startswith(f"{folder / 'UwbReading.txt'}: expected a UwbAntennaGuess.txt")


def test_missing_files(folder):
    (folder / "truth/vehiclePose.txt").unlink()
    message = error_of(read_truth, folder)
    assert message == f"{folder / 'truth/vehiclePose.txt'}: expected this file, found none"
    (folder / "encoderReading.txt").unlink()
    message = error_of(read_dataset, folder)
    assert message == f"{folder / 'encoderReading.txt'}: expected this file, found none"


@pytest.mark.parametrize("name", ["nowhere", "vehicle.toml", "a\0b"])
@pytest.mark.parametrize("read", [read_dataset, read_truth])
def test_missing_folder_or_not_a_folder(folder, name, read):
    assert f"{name}: expected a folder" in error_of(read, folder / name)


def test_truth_that_is_a_file(tmp_path):
    write(tmp_path / "truth", "1 0 0 0\n")
    write(tmp_path / "encoderReading.txt", "1 0 0\n")
    assert "truth: expected a folder" in error_of(read_truth, tmp_path)


def test_the_same_name_in_two_cases(folder):
    write(folder / "ARUCOREADING.txt", "")
    if len([p for p in folder.iterdir() if p.name.lower() == "arucoreading.txt"]) == 1:
        pytest.skip("this file system does not tell upper from lower case")
    message = error_of(read_dataset, folder)
    assert "ARUCOREADING.txt and ArucoReading.txt" in message


@pytest.mark.parametrize("name", FILES)
def test_files_that_cannot_be_read(folder, name, monkeypatch):
    place = f"{folder / name}: expected a file that can be read"
    read = read_truth if name.startswith("truth/") else read_dataset
    with monkeypatch.context() as patch:
        patch.setattr(Path, "read_bytes", refuse_only(folder / name))
        assert error_of(read, folder) == place
    (folder / name).unlink()
    (folder / name).symlink_to("nothing")
    assert error_of(read, folder) == place
    (folder / name).unlink()
    (folder / name).mkdir()
    assert error_of(read, folder) == f"{place}, found a folder"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes on this system")
@pytest.mark.parametrize("name", FILES)
def test_pipes_and_devices_are_refused_and_not_waited_for(folder, name):
    place = f"{folder / name}: expected a file that can be read"
    read = read_truth if name.startswith("truth/") else read_dataset
    (folder / name).unlink()
    (folder / name).symlink_to("/dev/zero")
    assert error_of(read, folder) == f"{place}, found a device"
    (folder / name).unlink()
    os.mkfifo(folder / "pipe")
    (folder / name).symlink_to(folder / "pipe")
    assert error_of(read, folder) == f"{place}, found a pipe"


def refuse_only(name):
    """A `Path.read_bytes` without permission to read this file (tests may run as root)."""
    read_bytes = Path.read_bytes

    def refusing(path):
        if path == name:
            raise PermissionError(13, "Permission denied")
        return read_bytes(path)

    return refusing


def test_the_path_is_written_as_the_user_gave_it(folder, monkeypatch):
    monkeypatch.chdir(folder.parent)
    write(folder / "encoderReading.txt", "1 0\n")
    message = error_of(read_dataset, "drive")
    assert message.startswith(f"{Path('drive', 'encoderReading.txt')}, line 1: ")


# Corruption: either a dataset or a DatasetError of one line, whatever the bytes.


def corrupt(data, rng):
    """Change, insert, delete, repeat or cut bytes of a file; some are likely ones, some any."""
    data = bytearray(data)
    for _ in range(rng.integers(1, 3)):
        at, to = np.sort(rng.integers(0, len(data) + 1, 2))
        likely = b"0123456789+-.eE \t\r\n#_,'\"[]={}nainf"
        byte = likely[rng.integers(len(likely))] if rng.random() < 0.7 else rng.integers(256)
        match rng.integers(6):
            case 0 | 1:
                data[at : at + 1] = bytes([byte])
            case 2:
                data[at:at] = bytes([byte])
            case 3:
                del data[at : at + rng.integers(1, 4)]
            case 4:
                data[at:at] = data[at:to]
            case 5:
                data[at:] = data[to:]
    return bytes(data)


@pytest.mark.parametrize("name", FILES)
def test_corrupted_files_never_end_in_a_traceback(folder, name):
    rng = np.random.default_rng(list(FILES).index(name))
    outcomes = set()
    for _ in range(100):
        write(folder / name, corrupt(FILES[name].encode(), rng))
        try:
            data, truth = read_dataset(folder), read_truth(folder)
            numbers = [data.ticks, truth.poses, truth.marker_in_world, truth.antenna_in_world]
            assert all(np.isfinite(array).all() for array in numbers)
            outcomes.add("read")
        except DatasetError as error:
            message = str(error)
            assert message.startswith(str(folder)) and message.isprintable()
            assert ": expected " in message
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


@pytest.mark.parametrize("wrong, right", [
    ("ArucoReadings.txt", "ArucoReading.txt"), ("uwbreadng.txt", "UwbReading.txt"),
    ("vehicles.toml", "vehicle.toml"), ("UwbAntenaGuess.txt", "UwbAntennaGuess.txt")])
def test_a_name_that_is_almost_right_is_not_left_out_silently(folder, wrong, right):
    for path in folder.glob(right):
        path.unlink()
    write(folder / wrong, "")
    with pytest.raises(DatasetError, match=f"{wrong}: expected the name {right}: rename it, or "):
        read_dataset(folder)


def test_dataset_names_are_those_of_folders_with_any_file_of_a_dataset(tmp_path):
    for name, file in (("b", "encoderReading.txt"), ("a", "ENCODERREADING.TXT"),
                       (".hidden", "encoderReading.txt"), ("notes", "notes.txt")):
        (tmp_path / name).mkdir()
        write(tmp_path / name / file, "1 0 0\n")
    assert dataset_names(tmp_path) == ["a", "b"] and dataset_names(tmp_path, ["b"]) == ["b"]
    with pytest.raises(DatasetError, match="expected one of a, b, found 'c'"):
        dataset_names(tmp_path, ["c"])
    absent = "encoderReading.txt: expected this file, found none"
    with pytest.raises(DatasetError, match=f"notes.{absent}"):
        dataset_names(tmp_path, ["notes"])
    (tmp_path / "half").mkdir()
    write(tmp_path / "half" / "UwbReading.txt", "")
    with pytest.raises(DatasetError, match=f"half.{absent}"):
        dataset_names(tmp_path)


def test_rows_that_repeat_exactly_count_once(folder):
    write(folder / "UwbReading.txt", "2 3 1.5 0.1\n1 3 1.4 0.1\n2 3 1.5 0.1\n2 3 1.6 0.1\n")
    write(folder / "ArucoReading.txt", 2 * FILES["ArucoReading.txt"])
    dataset = read_dataset(folder)
    assert dataset.uwb.pose.tolist() == [0, 1, 1] and dataset.uwb.range.tolist() == [1.4, 1.5, 1.6]
    assert dataset.aruco.marker.tolist() == [-7, 40, 40]


def test_a_range_is_negative_by_its_noise_at_most(folder):
    write(folder / "UwbReading.txt", "1 3 -0.05 0.1\n")
    assert read_dataset(folder).uwb.range.tolist() == [-0.05]
