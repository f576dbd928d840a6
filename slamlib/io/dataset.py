"""Datasets: the measurements of one drive, read from a folder of text files.

The folder holds `encoderReading.txt` and, where the vehicle has the sensors, `ArucoReading.txt` and
`UwbReading.txt` with `UwbAntennaGuess.txt`. Optional are `vehicle.toml`, with what differs from the
assignment's table 2, and the folder `truth`. Lengths are in metres, angles in radians. Pose ids
count from 1 in the files and from 0 in the arrays; marker and antenna ids stay unchanged.
"""

import json
from os.path import abspath
from pathlib import Path

import numpy as np

from slamlib.core import se2
from slamlib.core.errors import DatasetError as DatasetError
from slamlib.core.errors import require
from slamlib.core.records import AntennaGuess, ArucoReadings, Dataset, Truth, UwbReadings
from slamlib.core.vehicle import TABLE_2, Vehicle, changed
from slamlib.io import tables
from slamlib.io.tables import ENCODER, TABLES, TRUTH_FILES, contents, read_table
from slamlib.io.vehicle import incremental_counts, read_vehicle

ORIGIN_TOLERANCE = 1e-3  # m and rad; a first true pose within it is taken as the origin


def read_dataset(folder):
    """Measurements of one drive, a Dataset; sensors without a file or without rows are None.

    `Dataset.notes` state what was mended, left out or not read. Raises DatasetError if a file does
    not have the format.
    """
    files, notes = contents(folder, required=ENCODER)
    vehicle = read_vehicle(files.get("vehicle.toml"))
    return _dataset(files, vehicle, Path(abspath(folder)).name, notes)


def dataset_from_arrays(ticks, aruco=None, uwb=None, guess=None, vehicle=TABLE_2, name="arrays"):
    """The Dataset of arrays with the columns of the files (data/README.md), in m and rad.

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel since the previous pose; the first are 0.
    aruco : (m, 11) pose id from 1 to n, marker id, x, y, heading of the marker in the vehicle,
        and their covariances xx, xy, x heading, yy, y heading, heading heading; or None.
    uwb : (r, 4) pose id from 1 to n, antenna id, range, standard deviation; or None.
    guess : (a, 3) antenna id, x, y, of at least the antennas in `uwb`; or None.
    vehicle : Vehicle

    Rows are checked, and bad ones left out with a note, as those of files. Raises DatasetError,
    which names the argument and the row, from 1, where a file would be refused.

    >>> dataset = dataset_from_arrays(ticks=[[0, 0], [10, 12]], uwb=[[2, 7, 1.5, 0.1]],
    ...                               guess=[[7, 1.0, 1.0]])
    >>> len(dataset.ticks), dataset.uwb.antenna.tolist()
    (2, [7])
    """
    require(isinstance(vehicle, Vehicle), "vehicle", "a Vehicle", vehicle)
    arguments = ("ticks", ticks), ("aruco", aruco), ("uwb", uwb), ("guess", guess)
    files = {file: tables.table_of_array(key, value, file, counted=key == "ticks")
             for file, (key, value) in zip(TABLES, arguments)}
    return _dataset(files, changed(TABLE_2, vars(vehicle), "vehicle"), name)


def _dataset(files, vehicle, name, notes=()):
    """The Dataset by its Vehicle and the sources (dict) of its tables by name."""
    encoders, ticks = incremental_counts(read_table(files[ENCODER], ENCODER), vehicle)
    seen, heard = (read_table(files.get(each), each, len(ticks)) for each in TABLES[1:3])
    guess = read_table(files.get(TABLES[3]), TABLES[3])
    heard.kept(np.isin(heard.numbers[:, 1], guess.numbers[:, 0]), "an antenna id that the guesses "
               "have, which ranges need: UwbAntennaGuess.txt in the same folder, or guess")
    (*sighting, rows), (*measured, ranges) = map(_in_order, (seen.numbers, heard.numbers))
    return Dataset(
        name=name, vehicle=vehicle, ticks=ticks,
        aruco=ArucoReadings(*sighting, rows[:, 2:5], rows[:, tables.COVARIANCE]
                            ) if len(rows) else None,
        uwb=UwbReadings(*measured, *ranges[:, 2:].T) if len(ranges) else None,
        antenna_guess=AntennaGuess(*_by_id(guess)) if len(guess.numbers) else None,
        notes=(*notes, *encoders.notes, *seen.notes, *heard.notes, *guess.notes))


def read_truth(folder):
    """Truth of one drive, from the sub-folder `truth` of its folder, or None without it.

    Maps without a file have length 0. Wheel parameters that `truth/vehicle.toml` does not give are
    those of the dataset. Truth whose first pose T_w1 is not the origin is moved there, T_1v =
    inverse(T_w1) T_wv, with a note. Raises DatasetError if a file does not have the format or the
    number of poses is not that of the drive.
    """
    drive, _ = contents(folder, required=ENCODER)
    if "truth" not in drive:
        return None
    files, notes = contents(drive["truth"], TRUTH_FILES, "vehiclePose.txt")
    path, *maps = (read_table(files.get(name), name) for name in TRUTH_FILES[:3])
    poses, count = path.numbers[:, 1:], len(read_table(drive[ENCODER], ENCODER).numbers)
    require(len(poses) == count, path.source,
            f"{count} poses (encoder file), found {len(poses)}")
    turns = 2 * np.pi * np.rint(poses[0, 2] / (2 * np.pi))
    poses = np.column_stack([poses[:, :2], np.unwrap(poses[:, 2]) - turns])
    (marker, marker_in_world), (antenna, antenna_in_world) = map(_by_id, maps)
    if (abs(first := poses[0]) > ORIGIN_TOLERANCE).any():
        poses = se2.between(first, poses)
        marker_in_world = se2.difference(se2.between(first, marker_in_world), np.zeros(3))
        antenna_in_world = se2.between(first, np.pad(antenna_in_world, ((0, 0), (0, 1))))[:, :2]
        path = path.noted((
            " begins at ({:.3f} m, {:.3f} m, {:.4f} rad): poses and maps were moved into the frame "
            "of its first pose, in which the estimates are").format(*first))
    return Truth(
        poses, marker, marker_in_world, antenna, antenna_in_world,
        read_vehicle(files.get("vehicle.toml"), read_vehicle(drive.get("vehicle.toml"))),
        tuple(f"In truth: {note}" for note in sum((e.notes for e in (path, *maps)), (*notes,))))


def _by_id(table):
    """Landmark ids (k,), ascending, and the further columns (k, c - 1)."""
    rows = table.numbers[np.argsort(table.numbers[:, 0])]
    return rows[:, 0].astype(np.int64), rows[:, 1:]


def _in_order(rows):
    """Poses from 0, ids (m,) int64, rows (m, c), in ascending order of pose; repeated rows once."""
    rows = rows[np.sort(np.unique(rows, axis=0, return_index=True)[1])]
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return rows[:, 0].astype(np.int64) - 1, rows[:, 1].astype(np.int64), rows


def all_notes(dataset, truth):
    """Notes (tuple of str) on what was mended or left out of a Dataset and its Truth or None."""
    return dataset.notes + (truth.notes if truth else ())


def inventory_lines(dataset, truth):
    """Lines (list of str) on what was read of a Dataset and its Truth or None, with all notes."""
    aruco, uwb = dataset.aruco, dataset.uwb
    stated = [f"{key} = {json.dumps(value)}" for key, value in vars(dataset.vehicle).items()
              if value != getattr(TABLE_2, key)]
    right, left = abs(dataset.ticks).sum(axis=0)
    return [f"{dataset.name}: {line}" for line in (
        f"encoders: {len(dataset.ticks)} poses, {right} ticks right and {left} left",
        "markers: none, no ArucoReading.txt with rows" if aruco is None else
        f"markers: {len(aruco.pose)} sightings of {len(np.unique(aruco.marker))} markers at "
        f"{len(np.unique(aruco.pose))} poses",
        "ranges: none, no UwbReading.txt with rows" if uwb is None else
        f"ranges: {len(uwb.pose)} ranges to {len(np.unique(uwb.antenna))} antennas at "
        f"{len(np.unique(uwb.pose))} poses",
        "vehicle.toml: " + (", ".join(stated) or "none, or as the assignment's table 2"),
        f"truth: {'no' if truth is None else 'yes'}",
        *(f"note: {note}" for note in all_notes(dataset, truth)))]
