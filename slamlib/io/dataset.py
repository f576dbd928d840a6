"""Datasets: the measurements of one drive, read from a folder of text files.

The folder holds `encoderReading.txt` and, where the vehicle has the sensors, `ArucoReading.txt` and
`UwbReading.txt` with `UwbAntennaGuess.txt`. Optional are `vehicle.toml`, with what differs from the
assignment's table 2, and the folder `truth`. Lengths are in metres, angles in radians. Pose ids
count from 1 in the files and from 0 in the arrays; marker and antenna ids stay unchanged.
"""

import json
from dataclasses import replace
from os.path import abspath
from pathlib import Path

import numpy as np

from slamlib.core import se2
from slamlib.core.errors import require
from slamlib.core.records import (
    AntennaGuess,
    ArucoReadings,
    Dataset,
    Truth,
    UwbReadings,
)
from slamlib.core.vehicle import TABLE_2, VEHICLE_LIMITS, Vehicle, changed
from slamlib.io.files import write_file
from slamlib.io.formats import (
    ARUCO,
    COVARIANCE,
    ENCODER,
    GUESS,
    LIMITS,
    TRUE_ANTENNAS,
    TRUE_MARKERS,
    TRUE_POSES,
    TRUTH_FILES,
    UWB,
    VEHICLE,
)
from slamlib.io.tables import contents, read_table, sentences, table_of_array
from slamlib.io.textfile import read_toml

MAX_REVOLUTIONS = 10.0  # revolutions of a wheel in one step
MODULUS = 2**16  # number of values of counters that wrap around
MIN_MODULUS_RATIO = 32.0  # ratio of the modulus to a large step of the drive, for a decision
WHEEL_ENTRIES = 8  # number of fields of a Vehicle that table 2 has
ORIGIN_TOLERANCE = 1e-3  # m and rad; a first true pose within it is taken as the origin


def read_dataset(folder: Path | str) -> Dataset:
    """Measurements of one drive; sensors without a file or without usable rows are None.

    `Dataset.notes` state what was mended, left out or not read. Raises DatasetError if a file does
    not have the format.
    """
    files, notes = contents(folder, ENCODER)
    vehicle = read_vehicle(files.get(VEHICLE), TABLE_2)
    name = Path(abspath(folder)).name
    return _dataset(files, vehicle, name, notes)


def dataset_from_arrays(ticks, aruco=None, uwb=None, guess=None, vehicle: Vehicle = TABLE_2,
                        name: str = "arrays") -> Dataset:
    """The Dataset of arrays with the columns of the files (data/README.md), in m and rad.

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel since the previous pose; the first are 0.
    aruco : (m, 11) pose id from 1 to n, marker id, x, y, heading of the marker in the vehicle,
        and their covariances xx, xy, x heading, yy, y heading, heading heading; or None.
    uwb : (r, 4) pose id from 1 to n, antenna id, range, standard deviation; or None.
    guess : (a, 3) antenna id, x, y; or None. Ranges to other antennas are left out.
    vehicle : Vehicle

    Rows are checked, and bad ones left out with a note, as those of files. Raises DatasetError,
    which names the argument and the row, from 1, where a file would be refused.

    >>> dataset = dataset_from_arrays(ticks=[[0, 0], [10, 12]], uwb=[[2, 7, 1.5, 0.1]],
    ...                               guess=[[7, 1.0, 1.0]])
    >>> len(dataset.ticks), dataset.uwb.antenna.tolist()
    (2, [7])
    """
    counts = table_of_array("ticks", ticks, ["right ticks", "left ticks"])
    numbered = np.column_stack([counts.lines, counts.numbers])
    files = {ENCODER: replace(counts, numbers=numbered)}
    for argument, rows, file in (
            ("aruco", aruco, ARUCO), ("uwb", uwb, UWB), ("guess", guess, GUESS)):
        if rows is not None:
            files[file] = table_of_array(argument, rows, LIMITS[file])
    stated = changed(TABLE_2, vars(vehicle), "vehicle")
    return _dataset(files, stated, name)


def _dataset(files, vehicle, name, notes=()):
    """The Dataset by its Vehicle and the sources (dict) of its tables by name."""
    if UWB in files and GUESS not in files:
        del files[UWB]
        notes += (f"{GUESS} is missing: the ranges are left out.",)
    encoders = read_table(files, ENCODER)
    encoders, ticks = _incremental_counts(encoders, vehicle)
    count = len(ticks)
    sightings = read_table(files, ARUCO, count)
    ranges = read_table(files, UWB, count)
    guesses = read_table(files, GUESS)
    is_guessed = np.isin(ranges.numbers[:, 1], guesses.numbers[:, 0])
    ranges = ranges.drop_rows({f"an antenna id of {guesses.name}": is_guessed})
    guess = None
    if len(guesses.numbers):
        guess = AntennaGuess(guesses.ids(0), guesses.numbers[:, 1:])
    aruco = ArucoReadings(
        pose=sightings.ids(0) - 1,
        marker=sightings.ids(1),
        marker_in_vehicle=sightings.numbers[:, 2:5],
        covariance=sightings.numbers[:, COVARIANCE])
    uwb = UwbReadings(
        pose=ranges.ids(0) - 1,
        antenna=ranges.ids(1),
        range=ranges.numbers[:, 2],
        sigma=ranges.numbers[:, 3])
    notes += sentences(encoders, sightings, ranges, guesses)
    dataset = Dataset(name, vehicle, ticks, aruco, uwb, guess, notes)
    return dataset.first(count)  # in which a sensor without readings is None


def read_vehicle(path: Path | None, default: Vehicle) -> Vehicle:
    """The Vehicle of a `vehicle.toml` or None, whose entries replace those of a default."""
    vehicle = default
    if path:
        entries, places = read_toml(path, "wheelbase = 0.4", VEHICLE_LIMITS)
        for key, value in entries.items():
            vehicle = changed(vehicle, {key: value}, places[key])
    return vehicle


def write_vehicle(path: Path, vehicle: Vehicle):
    """Write a vehicle.toml: eight entries of the wheels, and others that are not of table 2."""
    text = ""
    for number, (name, value) in enumerate(vars(vehicle).items()):
        if number < WHEEL_ENTRIES or value != getattr(TABLE_2, name):
            text += f"{name} = {json.dumps(value)}\n"
    write_file(path, text.encode())


def _incremental_counts(table, vehicle):
    """The Table of the encoders, and its counts since the previous pose, (n, 2) int64.

    Those of a counter that wraps around are mended. Raises DatasetError if there is no row, the
    first is not 0, or a step exceeds MAX_REVOLUTIONS.
    """
    read = table.numbers[:, 1:]
    require(len(read), table.source, "at least the row '1 0 0', found no rows")
    counts = _unwrapped(read)
    mended = table.lines[(counts != read).any(axis=1)]
    if len(mended):
        table = table.noted(
            f"{len(mended)} rows were mended whose counts are 2^16 off, as of a counter that "
            f"wraps around, first {table.kind} {mended[0]}")
    limit = MAX_REVOLUTIONS * vehicle.ticks_per_revolution
    ok = abs(counts) <= limit
    ok[0] = counts[0] == 0
    expected = (f"at most {MAX_REVOLUTIONS:g} wheel revolutions ({limit:g} ticks) since the pose "
                "before, not since the start, and none in the first row")
    table.drop_rows({expected: ok.all(axis=1)}, most=0)
    return table, counts.astype(np.int64)


def _unwrapped(counts):
    """Counts (n, 2) less the modulus, where that makes them as small as most others."""
    large = np.quantile(abs(counts), 0.9)
    less = counts - np.sign(counts) * MODULUS
    is_wrapped = (abs(less) <= 2 * large) & (MIN_MODULUS_RATIO * large < MODULUS)
    return np.where(is_wrapped, less, counts)


def read_truth(folder: Path | str) -> Truth | None:
    """Truth of one drive, from the sub-folder `truth` of its folder, or None without it.

    Maps without a file have length 0. Wheel parameters that `truth/vehicle.toml` does not give are
    those of the dataset. Truth whose first pose is not the origin is moved there, with a note.
    Raises DatasetError if a file does not have the format or the number of poses is not that of the
    drive.
    """
    drive = contents(folder, ENCODER)[0]
    if "truth" not in drive:
        return None
    files, notes = contents(drive["truth"], TRUE_POSES, TRUTH_FILES)
    path = read_table(files, TRUE_POSES)
    markers = read_table(files, TRUE_MARKERS)
    antennas = read_table(files, TRUE_ANTENNAS)
    encoders = read_table(drive, ENCODER)
    count = len(encoders.numbers)
    poses = path.numbers[:, 1:]
    require(len(poses) == count, path.source, f"{count} poses (encoder file), found {len(poses)}")
    headings = np.append(0, poses[:, 2])
    poses[:, 2] = np.unwrap(headings)[1:]
    marker_in_world = markers.numbers[:, 1:]
    antenna_in_world = antennas.numbers[:, 1:]
    origin = poses[0]
    if abs(origin).max() > ORIGIN_TOLERANCE:
        poses = se2.between(origin, poses)
        marker_in_world = se2.between(origin, marker_in_world)
        antenna_in_world = (antenna_in_world - origin[:2]) @ se2.rotation(origin[2])
        path = path.noted(
            "it begins at ({:.3f} m, {:.3f} m, {:.4f} rad), so poses and maps were moved into the "
            "frame of its first pose, in which the estimates are".format(*origin))
    stated = read_vehicle(drive.get(VEHICLE), TABLE_2)
    vehicle = read_vehicle(files.get(VEHICLE), stated)
    notes += sentences(path, markers, antennas)
    notes = tuple(f"In truth: {note}" for note in notes)
    return Truth(poses, markers.ids(0), marker_in_world, antennas.ids(0), antenna_in_world,
                 vehicle, notes)
