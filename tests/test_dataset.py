"""A valid folder reads to exactly its numbers; anything else ends in one clear sentence."""

import dataclasses
import gzip
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

from slamlib.core import se2
from slamlib.core.errors import DatasetError
from slamlib.core.vehicle import VEHICLE_LIMITS, Limit, Vehicle
from slamlib.io import dataset
from slamlib.io.dataset import read_dataset, read_truth
from slamlib.io.tables import LIMITS
from slamlib.robust.file_doubts import doubts_before_solving
from slamlib.studies.simulation import simulate

FILES = {
    "encoderReading.txt": "1 0 0\n2 10 12\n3 -5 7\n4 0 32000\n",
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


@pytest.fixture
def folder(tmp_path):
    for name, text in FILES.items():
        write(tmp_path / "drive" / name, text)
    return tmp_path / "drive"


def write(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content.encode() if isinstance(content, str) else content)


def assert_same(found, clean, *notes):
    """Two records hold the same numbers, types and shapes; the first one has these notes."""
    with np.printoptions(threshold=sys.maxsize, floatmode="unique"):
        assert repr(found) == repr(dataclasses.replace(clean, notes=notes))


def error_of(read, *given):
    with pytest.raises(DatasetError) as caught:
        read(*given)
    message = str(caught.value)
    assert "\n" not in message and "expected" in message and len(message) < 400
    return message


# What a valid folder reads to.


def test_measurements_are_exactly_those_written(folder):
    assert_same(read_dataset(folder), dataset.Dataset(
        "drive", VEHICLE, np.array([[0, 0], [10, 12], [-5, 7], [0, 32000]]),
        dataset.ArucoReadings(
            np.array([1, 2, 2]), np.array([-7, 40, 40]),
            np.array([[0.1, 0.2, 4.0], [1.5, -2, 0.5], [1.6, -2.1, 0.6]]), np.array([
                [[1e-4, 0, 1e-5], [0, 1e-4, 2e-5], [1e-5, 2e-5, 1e4]],
                [[4e-4, 1e-4, 0], [1e-4, 9e-4, 0], [0, 0, 1e-4]],
                [[4e-4, 0, 0], [0, 4e-4, 0], [0, 0, 4e-4]]])),
        dataset.UwbReadings(np.array([0, 3]), np.array([3, 900]), np.array([1.25, 2.5]),
                            np.array([0.2, 0.1])),
        dataset.AntennaGuess(np.array([3, 900]), np.array([[-4, 5.5], [1, 2]]))))


def test_truth_is_exactly_that_written(folder):
    turn = 2 * np.pi
    assert_same(read_truth(folder), dataset.Truth(
        np.array([[0, 0, 0], [0.1, 0, 3], [0.2, 0.1, turn - 3], [0.3, 0.2, turn - 2.9]]),
        np.array([-7, 40]), np.array([[3, 4, -0.3], [1, 2, 0.3]]), np.array([3, 900]),
        np.array([[-4.1, 5.4], [1.1, 2.1]]), dataclasses.replace(VEHICLE, sigma_wheelbase=0.002)))


@pytest.mark.parametrize("start, moved", [
    ([12.5, -3.25, 2.8], 1), ([2e-3, 0, 0], 1), ([0, 0, np.pi], 1), ([0, -2e-3, 2 * np.pi], 1),
    ([9e-4, -9e-4, 9e-4], 0), ([0, 0, 2 * np.pi], 0), ([0, 0, -4 * np.pi + 5e-4], 0)])
def test_truth_in_another_frame_is_moved_to_its_first_pose_with_a_note(folder, start, moved):
    """Unless its first pose is rounded, or has full turns."""
    clean = read_truth(folder)
    antennas = np.pad(clean.antenna_in_world, ((0, 0), (0, 1)))
    places = {"poses": clean.poses, "marker_in_world": clean.marker_in_world,
              "antenna_in_world": antennas}
    written = {name: se2.compose(start, each) for name, each in places.items()}
    for name, ids, rows, columns in zip(
            ("vehiclePose", "ArucoMap", "UwbMap"), (np.arange(1, 5), clean.marker, clean.antenna),
            written.values(), (3, 3, 2)):
        np.savetxt(folder / f"truth/{name}.txt", np.c_[ids, rows[:, :columns]], fmt="%.17g")
    written["poses"] = written["poses"] - [0, 0, start[2] - se2.wrap(start[2])]
    found = read_truth(folder)
    for name, expected in (places if moved else written).items():
        array = getattr(found, name)
        np.testing.assert_allclose(array, expected[:, :array.shape[1]], atol=1e-12)
    assert len(found.notes) == moved
    assert start[0] < 1 or found.notes[0].startswith(
        "In truth: vehiclePose.txt begins at (12.500 m, -3.250 m, 2.8000 rad): poses and maps were")


def test_vehicle_defaults_are_table_2(folder):
    (folder / "vehicle.toml").unlink()
    stated = {name: value for name, value in vars(read_dataset(folder).vehicle).items() if value}
    assert stated == {
        "right_radius": 0.1, "left_radius": 0.1, "wheelbase": 0.4, "ticks_per_revolution": 8000,
        **dict.fromkeys(["sigma_right_radius", "sigma_left_radius", "sigma_wheelbase",
                         "sigma_heading"], 1e-4),
        "kernel": "asymmetric Tukey", "gate": True, "marker_size": 1, "range_scale": 1}


@pytest.mark.parametrize("content", [None, "", "\n\n", "# no rows\n  # none\n"])
def test_absent_or_empty_sensors_are_none(folder, content):
    for name in ("ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt"):
        (folder / name).unlink()
        if content is not None:
            write(folder / name, content)
    data = read_dataset(folder)
    assert data.aruco is None and data.uwb is None and data.antenna_guess is None


def test_absent_truth_is_none_and_absent_maps_are_empty(folder):
    truth, none = read_truth(folder), np.empty(0, int)
    for name in ("ArucoMap.txt", "UwbMap.txt", "vehicle.toml"):
        (folder / "truth" / name).unlink()
    assert_same(read_truth(folder), dataset.Truth(
        truth.poses, none, np.empty((0, 3)), none, np.empty((0, 2)), VEHICLE))
    (folder / "truth/vehiclePose.txt").unlink()
    (folder / "truth").rmdir()
    assert read_truth(folder) is None


def test_the_first_poses_have_the_readings_until_then(folder):
    data = read_dataset(folder)
    first = data.first(3)
    assert first.uwb.pose.tolist() == [0]
    assert_same(first, dataclasses.replace(data, ticks=data.ticks[:3], uwb=first.uwb))
    assert data.first(1).aruco is None and data.without("uwb").first(4).uwb is None
    assert_same(data.first(np.int64(4)), data)


def test_wheel_parameters_of_a_vehicle_have_one_order():
    vehicle = Vehicle(sigma_left_radius=2e-4).with_wheel([0.11, 0.12, 0.5])
    assert (vehicle.right_radius, vehicle.left_radius, vehicle.wheelbase) == (0.11, 0.12, 0.5)
    np.testing.assert_array_equal(vehicle.wheel, [0.11, 0.12, 0.5])
    np.testing.assert_array_equal(vehicle.sigma_wheel, [1e-4, 2e-4, 1e-4])


# Valid variants of the format; test_dialects.py has those of the text.


def test_numbers_in_other_spellings(folder):
    clean = read_dataset(folder)
    write(folder / "encoderReading.txt", "1.0 -0 0e5\n+2 1E1 12.\n3e0 -.5e1 7\n004 0 3.2e+4\n")
    assert_same(read_dataset(folder), clean)


def test_ids_may_be_negative_or_huge_and_covariances_of_any_scale(folder):
    huge = 999_999_999_999_999
    write(folder / "UwbReading.txt", f"1 {huge} 1 1\n1 {-huge} 1 1\n")
    write(folder / "UwbAntennaGuess.txt", f"{huge} 0 0\n{-huge} 1 1\n")
    row = "1e-17 0 5e-8 1e-17 0 1e4"  # a marker whose orientation is not seen
    write(folder / "ArucoReading.txt", f"1 40 0 0 0 {row}\n")
    data = read_dataset(folder)
    assert data.uwb.antenna.tolist() == [huge, -huge]
    assert data.antenna_guess.antenna.tolist() == [-huge, huge]
    np.testing.assert_array_equal(
        data.aruco.covariance, [[[1e-17, 0, 5e-8], [0, 1e-17, 0], [5e-8, 0, 1e4]]])


def test_rows_are_in_the_order_of_poses_and_of_the_file_and_count_once_if_they_repeat(folder):
    rows = [f"{4 - i % 4} {i} 0 0 0 1 0 0 1 0 1\n" for i in range(300)]
    write(folder / "ArucoReading.txt", "".join(rows + rows[::7]))
    aruco = read_dataset(folder).aruco
    np.testing.assert_array_equal(aruco.pose, np.repeat([0, 1, 2, 3], 75))
    np.testing.assert_array_equal(aruco.marker, np.arange(300).reshape(75, 4).T[::-1].ravel())
    write(folder / "UwbReading.txt", "2 3 1.5 0.1\n1 3 -0.05 0.1\n2 3 1.5 0.1\n2 3 1.2 0.1\n")
    uwb = read_dataset(folder).uwb
    assert uwb.pose.tolist() == [0, 1, 1]
    assert uwb.range.tolist() == [-0.05, 1.5, 1.2]                  # noise may make one negative


# Errors: (file, its whole content or its content as a function of the valid one, line, key word).


def third_row(row):
    """Two comment or blank lines, the valid rows 1 and 2, and this row: in line 5."""
    return lambda text: "# head\n\n" + "".join(text.splitlines(True)[:2]) + row + "\n"


def appended(row):
    return lambda text: text + row + "\n"


THIRD_ROWS = {  # rows by what is said of them
    "encoderReading.txt": {
        "3 numbers (pose id, right ticks, left ticks), found": [
            "3 5", "3 5 6 7", "3,5,6", "3 five 6", "3 " + "x" * 999 + " 6", "3, 5, 6", "3 1_000 6",
            "3 0x10 6", "3 \u0663 6", "3 1e 6", "3 . 6", "3 5 6 \0"],
        "right ticks, a whole number from -1e+15 to 1e+15, found": [
            "3 infinity 6", "3 -infinity 5", "3 1e999 5", "3 -2e15 5", "3 5.5 6"],
        "at most 10 wheel revolutions (80000 ticks)": ["3 5 80001", "3 -80001 5"],
        "in order": ["4 5 6", "2 5 6"], "pose id, a whole number": ["2.5 5 6"]},
    "UwbAntennaGuess.txt": {"each id only once": ["900 1 2"], "x, a finite number": ["9 inf 2"]},
    "truth/vehiclePose.txt": {"4 numbers (pose id, x, y, theta)": ["3 0 0"],
                              "in order": ["4 0 0 0"]},
    "truth/ArucoMap.txt": {"each id only once": ["40 0 0 0"]}}
VEHICLE_LINES = {
    "expected an entry such as wheelbase, ": ["wheel_base = 1", "[wheelbases]\nx = 1",
                                              "'wheel' = 1"],
    "a number from 0.001 to 2.5 m for left_radius, found": [f"left_radius = {value}" for value in (
        "'wide'", "[0.1]", "true", "nan", "inf")]}
TOML_LINES = ["left_radius = 0,1", "left_radius =", "wheelbase = 0.6", "left_radius = \0 1",
              "left_radius = " + "[" * 5000]
ENCODER_FILES = [  # text, line, what is said
    ("", None, "no rows"), ("# nothing\n\n", None, "no rows"), ("\n1 0\n2 0\n", 2, "3 numbers"),
    ("\r\r1 0 0\r\r2 0\r", 5, "3 numbers"), ("\r\n1 0 0\r\n2 0", 3, "3 numbers"),
    ("0 0 0\n1 5 6\n", 1, "in order"),
    ("# head\n1 0 1\n2 5 6\n3 5 6\n4 5 6\n", 2, "none in the first row"),
    (b"\x89\xf0\xff 0 0\n", 1, "3 numbers"), (gzip.compress(b"1 0 0\n", mtime=0), 1, "3 numbers"),
    ("1 0 0\n".encode("utf-16")[:-1], 1, "3 numbers"),
    ("1 0 0\n2 990 1,020", 2, "left ticks, a whole number from -1e+15 to 1e+15, found '1.02'"),
    ("pose;right;left\n1;0;0\n2;;12", 3, "right ticks, a number, found 'nan'"),
    ("pose right left\nid ticks ticks\n1 0 0", 2, "found 'id ticks ticks'")]
FOUR = "expected 4 numbers (pose id, antenna id, range, sigma), found "
TWO_READINGS = {  # texts of UwbReading.txt by the line that no dialect reads with those above
    1: ["1,3,1,5,0,1", "1;3;1,5;0.1", "1a 3b 1.5c 0.1d\n1 3 1.5 0.1"],
    2: ["1,3,1.5,0.1\n2 3 1.6 0.1", "1,3,1.5,0.1\n2,3 1.6,0.1", "1,3,1.5,0.1\n2,3 4,1.6,0.1",
        "1;3;1.5;0.1\n2;3;1.6;0.1,2"]}
ERRORS = [
    *[("UwbReading.txt", text, line, f"{FOUR}'{text.splitlines()[line - 1]}'")
      for line, texts in TWO_READINGS.items() for text in texts],
    *[(name, third_row(row), 5, said) for name, told in THIRD_ROWS.items()
      for said, rows in told.items() for row in rows],
    *[("vehicle.toml", appended(line), None, said) for said, lines in VEHICLE_LINES.items()
      for line in lines],
    *[("encoderReading.txt", *each) for each in ENCODER_FILES],
    *[("vehicle.toml", appended(line), None, "TOML") for line in TOML_LINES],
    ("UwbReading.txt", "pose;antenna\n\n1;3;nan;1\n1;3;2,5;1\n9;3;1,5;1\n", 5, "from 1 to 4"),
    ("UwbAntennaGuess.txt", "900 1 2\n3 nan 5.5\n", 2, "x, a number, found 'nan'"),
    ("UwbAntennaGuess.txt", "3 1 2 0.5\n900 1 2", 1, "expected 3 numbers (antenna id, x, y"),
    ("vehicle.toml", "# a\n\n\n  'wheel' = 1\n", None, "an entry such as wheelbase"),
    ("truth/vehiclePose.txt", third_row("3 0 0 0"), None, "4 poses (encoder file), found 3"),
    ("truth/vehiclePose.txt", "", None, "4 poses (encoder file), found 0"),
    ("truth/vehicle.toml", appended("wheelbase = 0"), None, "a number from 0.001 to 20 m")]


@pytest.mark.parametrize("name, content, line, said", ERRORS)
def test_faults_in_a_file_are_named_by_file_line_and_expectation(folder, name, content, line, said):
    write(folder / name, content(FILES[name]) if callable(content) else content)
    message = error_of(read_truth if name.startswith("truth/") else read_dataset, folder)
    place = f"{folder / name}: " if line is None else f"{folder / name}, line {line}: "
    assert message.startswith(place) and said in message


# Limits: of every file and column the number at the limit is read, the next one beyond refused.

ROWS = {
    "ArucoReading.txt": "1 40 0 0 0 1 0 0 1 0 1", "UwbReading.txt": "1 3 1 1e4",
    "UwbAntennaGuess.txt": "3 0 0", "truth/vehiclePose.txt": "1 0 0 0",
    "truth/ArucoMap.txt": "40 0 0 0", "truth/UwbMap.txt": "3 0 0"}
PLACES = [
    *[(name, column, limit) for name in ROWS for column, limit in LIMITS[Path(name).name].items()
      if limit.unit],
    *[("vehicle.toml", key, limit) for key, limit in VEHICLE_LIMITS.items()
      if isinstance(limit, Limit)]]


@pytest.mark.parametrize("name, column, limit", PLACES)
def test_numbers_at_the_limits_are_read_and_beyond_them_refused(tmp_path, name, column, limit):
    for other, row in {"encoderReading.txt": "1 0 0", "UwbAntennaGuess.txt": "3 0 0",
                       "truth/vehiclePose.txt": "1 0 0 0"}.items():
        write(tmp_path / other, row)
    read = read_truth if name.startswith("truth") else read_dataset

    def text(value):
        if name != "vehicle.toml":
            words = ROWS[name].split()
            words[list(LIMITS[Path(name).name]).index(column)] = repr(value)
            return " ".join(words)
        return f"{column} = {value!r}\n"

    for value, away in ((float(limit.minimum), -np.inf), (float(limit.maximum), np.inf)):
        write(tmp_path / name, text(value))
        found = read(tmp_path)
        assert name != "vehicle.toml" or getattr(found.vehicle, column) == value
        beyond = float(np.nextafter(value, away))
        write(tmp_path / name, text(beyond))
        message = error_of(read, tmp_path)
        line = ", line 1" if name.endswith(".txt") else ""
        assert message.startswith(f"{tmp_path / name}{line}: expected ") and str(limit) in message
        assert column in message and message.endswith(
            f"found '{beyond:.12g}'" if name != "vehicle.toml" else f"found '{beyond!r}'")


def test_the_limits_that_a_user_reads_are_those_of_the_reader():
    text = (ROOT / "data" / "README.md").read_text()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()
            if line.startswith("| `") and "| from " in line]
    told = {(file.strip("`"), column.strip("` ")): limit for file, columns, limit in rows
            for column in columns.split(",")}
    assert told == {(Path(name).name, column): str(limit) for name, column, limit in PLACES}


def test_missing_files(folder):
    for read, name in ((read_truth, "truth/vehiclePose.txt"), (read_dataset, "encoderReading.txt")):
        (folder / name).unlink()
        assert error_of(read, folder) == f"{folder / name}: expected this file, found none"


@pytest.mark.parametrize("name", ["nowhere", "vehicle.toml", "a\0b"])
@pytest.mark.parametrize("read", [read_dataset, read_truth])
def test_missing_folder_or_not_a_folder(folder, name, read):
    assert f"{name}: expected a folder" in error_of(read, folder / name)
    (folder / "truth").rename(folder / "true")
    write(folder / "truth", "1 0 0 0\n")
    assert "truth: expected a folder" in error_of(read_truth, folder)


@pytest.mark.parametrize("name", FILES)
def test_files_that_cannot_be_read_are_refused_and_not_waited_for(folder, name, monkeypatch):
    """As a broken link, a device or a pipe, and where reading fails, as without permission."""
    path, said = folder / name, ": expected a file that can be read"
    read = read_truth if name.startswith("truth/") else read_dataset
    os.mkfifo(folder / "pipe")
    for target in ("nothing", "/dev/zero", folder / "pipe"):
        path.unlink()
        path.symlink_to(target)
        assert error_of(read, folder) == f"{path}{said}"
    path.unlink()
    write(path, FILES[name])
    monkeypatch.setattr(Path, "read_bytes", Path.rmdir)     # of a file, an OSError
    assert error_of(read, folder).endswith(said)


def test_a_relative_path_names_the_dataset_and_stands_in_messages(folder, monkeypatch):
    monkeypatch.chdir(folder / "truth")
    assert read_dataset("..").name == "drive"
    write(folder / "encoderReading.txt", "1 0\n")
    assert error_of(read_dataset, "..").startswith(f"{Path('..', 'encoderReading.txt')}, line 1: ")
    assert error_of(read_dataset, "a/b") == (
        f"a/b: expected a folder that can be read (paths are relative to {folder / 'truth'})")


# Counts of the encoders: those of wrapped counters are mended, those since the start refused.


def write_counts(folder, ticks):
    np.savetxt(folder / "encoderReading.txt", np.c_[1:len(ticks) + 1, ticks], fmt="%d")


DRIVES = {
    "at constant speed": np.full((100, 2), 132), "on the spot": np.tile([50, -50], (100, 1)),
    "with one wheel still": np.tile([0, 132], (100, 1)), "not at all": np.zeros((100, 2)),
    "from rest to constant speed": np.minimum(np.arange(100), 40)[:, None] * [3, 3],
    "after a rest": np.repeat([[0, 0], [132, 90]], 50, axis=0),
    "to and fro": np.repeat([[132, 132], [-132, -132]], 50, axis=0),
    "fast": np.full((100, 2), 31_999),
    **{f"with {wrong} once": np.where(np.arange(100)[:, None] == [50, -1], wrong, 132)
       for wrong in (3000, -16_000, 30_000, 31_999, 40_000, 62_000, 70_000)}}


@pytest.mark.parametrize("drive", DRIVES)
def test_increments_of_any_drive_are_taken_as_such(drive, tmp_path):
    ticks = np.r_[np.zeros((1, 2)), DRIVES[drive]].astype(int)
    write_counts(tmp_path, ticks)
    found = read_dataset(tmp_path)
    np.testing.assert_array_equal(found.ticks, ticks)
    assert found.notes == () and doubts_before_solving(found) == []


@pytest.mark.parametrize("begin", [[123456, -7], [0, 0]])
def test_counts_since_the_start_are_refused(begin, tmp_path):
    write_counts(tmp_path, simulate("short", 0)[0].ticks.cumsum(axis=0) + np.array(begin))
    assert "wheel revolutions (80000 ticks) since the pose before, not since the start" in error_of(
        read_dataset, tmp_path)


@pytest.mark.parametrize("modulus", [2**15, 2**16])
@pytest.mark.parametrize("begin, low", [(60_000, 0), (30_000, -1), (3000, 0)])
@pytest.mark.parametrize("sign", [1, -1])
def test_counters_that_wrap_around_are_mended(modulus, begin, low, sign, tmp_path):
    """Differenced by who wrote the file, as wrapped."""
    ticks = sign * simulate("short", 0)[0].ticks[:1000]
    counter = (ticks.cumsum(axis=0) + begin - low * modulus // 2) % modulus + low * modulus // 2
    steps = np.diff(counter, axis=0, prepend=counter[:1])
    wraps = np.flatnonzero((steps != ticks).any(axis=1))
    assert len(wraps)
    write_counts(tmp_path, steps)
    found = read_dataset(tmp_path)
    np.testing.assert_array_equal(found.ticks, ticks)
    assert found.notes == (
        f"encoderReading.txt: {len(wraps)} rows were mended whose counts are 2^15 or 2^16 off, as "
        f"of a counter that wraps around, first line {wraps[0] + 1}.",)
