"""A valid folder reads to exactly its numbers; anything else ends in one clear sentence."""

import dataclasses
import os
import sys
from pathlib import Path

import numpy as np
import pytest
from numeric import short
from numpy.testing import assert_allclose, assert_array_equal

from slamlib.core import se2
from slamlib.core.errors import DatasetError
from slamlib.core.vehicle import Vehicle
from slamlib.io import dataset
from slamlib.io.dataset import read_dataset, read_truth
from slamlib.io.formats import LIMITS, within
from slamlib.robust.file_doubts import doubts_before_solving

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


def array(rows):
    """The numbers of a text, in which semicolons end the rows."""
    return np.array([row.split() for row in rows.split(";")], float)


def test_measurements_are_exactly_those_written(folder):
    covariance = array("1e-4 0 1e-5; 0 1e-4 2e-5; 1e-5 2e-5 1e4;"
                       "4e-4 1e-4 0; 1e-4 9e-4 0; 0 0 1e-4;"
                       "4e-4 0 0; 0 4e-4 0; 0 0 4e-4").reshape(3, 3, 3)
    assert_same(read_dataset(folder), dataset.Dataset(
        "drive", VEHICLE, array("0 0; 10 12; -5 7; 0 32000").astype(int),
        dataset.ArucoReadings(np.array([1, 2, 2]), np.array([-7, 40, 40]),
                              array("0.1 0.2 4; 1.5 -2 0.5; 1.6 -2.1 0.6"), covariance),
        dataset.UwbReadings(np.array([0, 3]), np.array([3, 900]), np.array([1.25, 2.5]),
                            np.array([0.2, 0.1])),
        dataset.AntennaGuess(np.array([3, 900]), array("-4 5.5; 1 2"))))


def test_truth_is_exactly_that_written(folder):
    poses = array("0 0 0; 0.1 0 3; 0.2 0.1 -3; 0.3 0.2 -2.9")
    poses[2:, 2] += 2 * np.pi
    assert_same(read_truth(folder), dataset.Truth(
        poses, np.array([-7, 40]), array("3 4 -0.3; 1 2 0.3"), np.array([3, 900]),
        array("-4.1 5.4; 1.1 2.1"), dataclasses.replace(VEHICLE, sigma_wheelbase=0.002)))


def test_truth_in_another_frame_is_moved_to_its_first_pose_with_a_note(folder):
    clean = read_truth(folder)
    start = [12.5, -3.25, 2.8]
    poses = se2.compose(start, clean.poses)
    markers = se2.compose(start, clean.marker_in_world)
    antennas = se2.compose(start, np.pad(clean.antenna_in_world, ((0, 0), (0, 1))))
    write_rows(folder / "truth/vehiclePose.txt", [1, 2, 3, 4], poses)
    write_rows(folder / "truth/ArucoMap.txt", clean.marker, markers)
    write_rows(folder / "truth/UwbMap.txt", clean.antenna, antennas[:, :2])
    found = read_truth(folder)
    for name in ("poses", "marker_in_world", "antenna_in_world"):
        assert_allclose(getattr(found, name), getattr(clean, name), atol=1e-12)
    assert found.notes == (
        "In truth: vehiclePose.txt: it begins at (12.500 m, -3.250 m, 2.8000 rad), so poses and "
        "maps were moved into the frame of its first pose, in which the estimates are.",)


@pytest.mark.parametrize("start", ["9e-4 -9e-4 9e-4", "0 0 6.283185307", "0 0 -12.566"])
def test_truth_that_begins_at_the_origin_but_for_rounding_or_full_turns_stays(folder, start):
    moved = FILES["truth/vehiclePose.txt"].replace("1 0 0 0", f"1 {start}")
    write(folder / "truth/vehiclePose.txt", moved)
    found = read_truth(folder)
    assert found.notes == ()
    assert_array_equal(found.marker_in_world, array("3 4 -0.3; 1 2 0.3"))


def write_rows(path, ids, values):
    np.savetxt(path, np.column_stack([ids, values]), fmt="%.17g")


def test_vehicle_defaults_are_table_2(folder):
    (folder / "vehicle.toml").unlink()
    vehicle = read_dataset(folder).vehicle
    assert vehicle == Vehicle() and vehicle.ticks_per_revolution == 8000
    assert (vehicle.wheel.tolist(), vehicle.sigma_wheel.tolist()) == ([0.1, 0.1, 0.4], [1e-4] * 3)


@pytest.mark.parametrize("content", [None, "", "\n\n", "# no rows\n  # none\n"])
def test_absent_or_empty_sensors_are_none_and_of_the_empty_ones_it_is_said(folder, content):
    names = "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt"
    for name in names:
        (folder / name).unlink()
        if content is not None:
            write(folder / name, content)
    data = read_dataset(folder)
    assert (data.aruco, data.uwb, data.antenna_guess) == (None, None, None)
    told = () if content is None else (f"{', '.join(names)}: no rows of numbers.",)
    assert data.notes == told


def test_absent_maps_are_empty_and_the_true_vehicle_that_of_the_drive(folder):
    for name in ("ArucoMap.txt", "UwbMap.txt", "vehicle.toml"):
        (folder / "truth" / name).unlink()
    truth = read_truth(folder)
    assert truth.marker_in_world.shape == (0, 3) and truth.antenna_in_world.shape == (0, 2)
    assert len(truth.marker) == len(truth.antenna) == 0 and truth.vehicle == VEHICLE


def test_the_first_poses_have_the_readings_until_then(folder):
    data = read_dataset(folder)
    assert data.first(3).uwb.pose.tolist() == [0] and len(data.first(3).aruco.pose) == 3
    assert data.first(1).aruco is None and data.without("uwb").first(4).uwb is None
    assert_same(data.first(np.int64(4)), data)


# Valid variants of the rows; test_dialects.py has those of the text.


def test_ids_may_be_negative_or_huge(folder):
    huge = 999_999_999_999_999
    write(folder / "UwbReading.txt", f"1 {huge} 1 1\n1 {-huge} 1 1\n")
    write(folder / "UwbAntennaGuess.txt", f"{huge} 0 0\n{-huge} 1 1\n")
    data = read_dataset(folder)
    assert data.uwb.antenna.tolist() == [huge, -huge]
    assert data.antenna_guess.antenna.tolist() == [-huge, huge]


def test_rows_are_in_the_order_of_poses_and_at_a_pose_in_that_of_the_file(folder):
    rows = [f"{2 - i % 2} {i} 0 0 0 1 0 0 1 0 1" for i in range(300)]
    write(folder / "ArucoReading.txt", "\n".join(rows))
    assert read_dataset(folder).aruco.marker.tolist() == [*range(1, 300, 2), *range(0, 300, 2)]


def test_rows_that_repeat_count_once_with_a_note(folder):
    write(folder / "UwbReading.txt", "2 3 1.5 0.1\n1 3 -0.05 0.1\n2 3 1.5 0.1\n2 3 1.2 0.1\n")
    found = read_dataset(folder)
    assert found.uwb.range.tolist() == [-0.05, 1.5, 1.2]            # noise may make one negative
    assert found.notes == ("UwbReading.txt: 1 of 4 rows left out, the first in line 3: expected "
                           "each reading only once, found '2 3 1.5 0.1'.",)


def test_a_sighting_that_a_detector_repeats_at_later_poses_counts_once_with_a_note(folder):
    seen = "0.4 0.1 0.2 1e-4 0 0 1e-4 0 1e-4"
    write(folder / "ArucoReading.txt", f"1 40 {seen}\n2 40 {seen}\n3 41 {seen}\n4 40 {seen}\n")
    found = read_dataset(folder)
    assert found.aruco.pose.tolist() == [0, 2]
    assert "2 of 4 rows left out, the first in line 2: expected each reading only" in found.notes[0]


# Limits; test_dialects.py has numbers beyond them.


@pytest.mark.parametrize("name", LIMITS)
def test_rows_at_the_limits_are_right_and_beyond_them_wrong(name):
    for k, limit in enumerate(LIMITS[name].values()):
        rows = np.zeros((4, len(LIMITS[name])))
        rows[:, k] = limit.minimum, limit.maximum, np.nextafter(limit.maximum, np.inf), np.nan
        right = list(within(rows, LIMITS[name]).values())[k]
        assert right.tolist() == [True, True, False, False]


# Files and folders that are not there, or cannot be read.


@pytest.mark.parametrize("read, name", [
    (read_dataset, "encoderReading.txt"), (read_truth, "truth/vehiclePose.txt")])
def test_a_missing_file_that_must_be_there_is_named(folder, read, name):
    (folder / name).unlink()
    assert error_of(read, folder) == f"{folder / name}: expected this file, found none."


@pytest.mark.parametrize("target", ["nothing", "/dev/zero", "pipe"])
@pytest.mark.parametrize("name", ["ArucoReading.txt", "vehicle.toml"])
def test_files_that_cannot_be_read_are_refused_and_not_waited_for(folder, name, target):
    """As a broken link, a device or a pipe."""
    os.mkfifo(folder / "pipe")
    (folder / name).unlink()
    (folder / name).symlink_to(target)
    assert error_of(read_dataset, folder) == f"{folder / name}: expected a file that can be read"


def test_a_relative_path_names_the_dataset_and_stands_in_messages(folder, monkeypatch):
    monkeypatch.chdir(folder / "truth")
    assert read_dataset("..").name == "drive"
    write(folder / "encoderReading.txt", "1 0\n")
    assert error_of(read_dataset, "..").startswith(f"{Path('..', 'encoderReading.txt')}, line 1: ")
    assert error_of(read_dataset, "a/b") == (
        f"{folder / 'truth/a/b'}: expected a folder that can be read")


# Counts of the encoders: those of wrapped counters are mended, those since the start refused.


def write_counts(folder, ticks):
    np.savetxt(folder / "encoderReading.txt", np.c_[1:len(ticks) + 1, ticks], fmt="%d")


@pytest.mark.parametrize("first, second, wrong", [
    (0, 132, 132), (132, -132, 132), (31_999, 31_999, 31_999), (132, 132, -16_000),
    (132, 132, 62_000), (132, 132, 70_000)])
def test_increments_of_any_drive_are_taken_as_such(first, second, wrong, tmp_path):
    """Fifty of one kind, fifty of another, and one in between that may be wrong."""
    ticks = np.repeat([[0, 0], [first, first], [wrong, 90], [second, second]], [1, 50, 1, 50], 0)
    write_counts(tmp_path, ticks)
    found = read_dataset(tmp_path)
    assert_array_equal(found.ticks, ticks)
    assert found.notes == () and doubts_before_solving(found) == []


@pytest.mark.parametrize("begin", [[123456, -7], [0, 0]])
def test_counts_since_the_start_are_refused(begin, tmp_path):
    write_counts(tmp_path, short(0)[0].ticks.cumsum(axis=0) + begin)
    assert "wheel revolutions (80000 ticks) since the pose before, not since the start" in error_of(
        read_dataset, tmp_path)


@pytest.mark.parametrize("begin, lowest", [(60_000, 0), (30_000, 0.5)])
@pytest.mark.parametrize("sign", [1, -1])
def test_counters_that_wrap_around_are_mended(begin, lowest, sign, tmp_path):
    """Differenced by who wrote the file, as wrapped."""
    ticks = sign * short(0, 1000)[0].ticks
    counter = (ticks.cumsum(axis=0) + begin + lowest * 2**16) % 2**16
    steps = np.diff(counter, axis=0, prepend=counter[:1])
    wraps = np.flatnonzero((steps != ticks).any(axis=1))
    write_counts(tmp_path, steps)
    found = read_dataset(tmp_path)
    assert_array_equal(found.ticks, ticks)
    assert found.notes == (
        f"encoderReading.txt: {len(wraps)} rows were mended whose counts are 2^16 off, as of a "
        f"counter that wraps around, first line {wraps[0] + 1}.",)
