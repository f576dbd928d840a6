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
from slamlib.core.records import AntennaGuess, ArucoReadings, Dataset, Truth, UwbReadings
from slamlib.core.vehicle import TABLE_2, Vehicle, changed
from slamlib.io.formats import (
    ARUCO,
    COVARIANCE,
    ENCODER,
    GUESS,
    TRUTH_FILES,
    TRUTH_TABLES,
    UWB,
    VEHICLE,
    Check,
)
from slamlib.io.tables import contents, listed, read_table, table_of_array
from slamlib.io.vehicle import incremental_counts, read_vehicle

ORIGIN_TOLERANCE = 1e-3  # m and rad; a first true pose within it is taken as the origin


def read_dataset(folder: Path | str) -> Dataset:
    """Measurements of one drive; sensors without a file or without usable rows are None.

    `Dataset.notes` state what was mended, left out or not read. Raises DatasetError if a file does
    not have the format.
    """
    files, notes = contents(folder, required=ENCODER)
    vehicle = read_vehicle(files.get(VEHICLE))
    return _dataset(files, vehicle, Path(abspath(folder)).name, notes)


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
    require(isinstance(vehicle, Vehicle), "vehicle", "a Vehicle", vehicle)
    files = {
        ENCODER: table_of_array("ticks", ticks, ENCODER, counted=True),
        ARUCO: table_of_array("aruco", aruco, ARUCO),
        UWB: table_of_array("uwb", uwb, UWB),
        GUESS: table_of_array("guess", guess, GUESS)}
    return _dataset(files, changed(TABLE_2, vars(vehicle), "vehicle"), name)


def _dataset(files, vehicle, name, notes=()):
    """The Dataset by its Vehicle and the sources (dict) of its tables by name."""
    encoders, ticks = incremental_counts(read_table(files[ENCODER], ENCODER), vehicle)
    sightings = read_table(files.get(ARUCO), ARUCO, len(ticks))
    ranges = read_table(files.get(UWB), UWB, len(ticks))
    guesses = read_table(files.get(GUESS), GUESS)
    ranges = _of_guessed_antennas(ranges, guesses)
    pose, marker, seen = _in_order(sightings)
    aruco = ArucoReadings(pose, marker, seen[:, 2:5], seen[:, COVARIANCE])
    pose, antenna, heard = _in_order(ranges)
    uwb = UwbReadings(pose, antenna, heard[:, 2], heard[:, 3])
    guess = AntennaGuess(*_by_id(guesses))
    return Dataset(
        name=name, vehicle=vehicle, ticks=ticks, aruco=aruco if len(aruco.pose) else None,
        uwb=uwb if len(uwb.pose) else None, antenna_guess=guess if len(guess.antenna) else None,
        notes=notes + encoders.notes + sightings.notes + ranges.notes + guesses.notes)


def _of_guessed_antennas(ranges, guesses):
    """The ranges of antennas that have a guess, with a note on the others."""
    antenna = ranges.numbers[:, 1]
    known = np.isin(antenna, guesses.numbers[:, 0])
    if len(antenna) > 0 and len(guesses.numbers) == 0:
        lack = "is missing" if guesses.source == GUESS else "has no rows"
        note = f"{guesses.name} {lack}: problem 4 is left out."
        return replace(ranges, numbers=ranges.numbers[:0], notes=(*ranges.notes, note))
    unknown = listed([f"{each:.0f}" for each in np.unique(antenna[~known])])
    return ranges.drop_rows([Check(
        known, f"an antenna id of {guesses.name}, which lacks {unknown}", column=1)])


def _in_order(readings):
    """Poses from 0, ids (m,) and rows (m, c), in ascending order of pose; repeated rows once."""
    _, first = np.unique(readings.numbers, axis=0, return_index=True)
    rows = readings.numbers[np.sort(first)]
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return rows[:, 0].astype(np.int64) - 1, rows[:, 1].astype(np.int64), rows


def _by_id(landmarks):
    """Ids (k,), ascending, and places (k, d)."""
    rows = landmarks.numbers[np.argsort(landmarks.numbers[:, 0])]
    return rows[:, 0].astype(np.int64), rows[:, 1:]


def read_truth(folder: Path | str) -> Truth | None:
    """Truth of one drive, from the sub-folder `truth` of its folder, or None without it.

    Maps without a file have length 0. Wheel parameters that `truth/vehicle.toml` does not give are
    those of the dataset. Truth whose first pose is not the origin is moved there, with a note.
    Raises DatasetError if a file does not have the format or the number of poses is not that of the
    drive.
    """
    drive, _ = contents(folder, required=ENCODER)
    if "truth" not in drive:
        return None
    files, notes = contents(drive["truth"], TRUTH_FILES, required="vehiclePose.txt")
    path, markers, antennas = [read_table(files.get(name), name) for name in TRUTH_TABLES]
    count = len(read_table(drive[ENCODER], ENCODER).numbers)
    require(len(path.numbers) == count, path.source,
            f"{count} poses (encoder file), found {len(path.numbers)}")
    marker, marker_in_world = _by_id(markers)
    antenna, antenna_in_world = _by_id(antennas)
    poses = path.numbers[:, 1:].copy()
    poses[:, 2] = np.unwrap(np.r_[0, poses[:, 2]])[1:]
    vehicle = read_vehicle(files.get(VEHICLE), read_vehicle(drive.get(VEHICLE)))
    truth = Truth(poses, marker, marker_in_world, antenna, antenna_in_world, vehicle)
    x, y, heading = poses[0]
    if max(abs(x), abs(y), abs(heading)) > ORIGIN_TOLERANCE:
        truth = _in_the_frame_of(poses[0], truth)
        path = path.noted(
            f" begins at ({x:.3f} m, {y:.3f} m, {heading:.4f} rad): poses and maps were moved into "
            "the frame of its first pose, in which the estimates are")
    notes += path.notes + markers.notes + antennas.notes
    return replace(truth, notes=tuple(f"In truth: {note}" for note in notes))


def _in_the_frame_of(pose, truth):
    """The Truth in the frame of a pose T_wp: poses T_pv = inverse(T_wp) T_wv, maps as well."""
    markers = se2.between(pose, truth.marker_in_world)
    markers[:, 2] = se2.wrap(markers[:, 2])
    antennas = (truth.antenna_in_world - pose[:2]) @ se2.rotation(pose[2])
    return replace(truth, poses=se2.between(pose, truth.poses), marker_in_world=markers,
                   antenna_in_world=antennas)


def all_notes(dataset: Dataset, truth: Truth | None) -> tuple[str, ...]:
    """Notes on what was mended or left out of a Dataset and its Truth."""
    return dataset.notes if truth is None else dataset.notes + truth.notes


def inventory_lines(dataset: Dataset, truth: Truth | None) -> list[str]:
    """Lines on what was read of a Dataset and its Truth, with all notes."""
    aruco = dataset.aruco
    markers = "none, no ArucoReading.txt with usable rows"
    if aruco is not None:
        markers = (f"{len(aruco.pose)} sightings of {_distinct(aruco.marker)} markers at "
                   f"{_distinct(aruco.pose)} poses")
    uwb = dataset.uwb
    ranges = "none, no UwbReading.txt with usable rows"
    if uwb is not None:
        ranges = (f"{len(uwb.pose)} ranges to {_distinct(uwb.antenna)} antennas at "
                  f"{_distinct(uwb.pose)} poses")
    stated = [f"{key} = {json.dumps(value)}" for key, value in vars(dataset.vehicle).items()
              if value != getattr(TABLE_2, key)]
    vehicle = ", ".join(stated) or "none, or as the assignment's table 2"
    right, left = abs(dataset.ticks).sum(axis=0)
    lines = [f"encoders: {len(dataset.ticks)} poses, {right} ticks right and {left} left",
             f"markers: {markers}", f"ranges: {ranges}", f"vehicle.toml: {vehicle}",
             f"truth: {'no' if truth is None else 'yes'}"]
    lines += [f"note: {note}" for note in all_notes(dataset, truth)]
    return [f"{dataset.name}: {line}" for line in lines]


def _distinct(ids):
    return len(np.unique(ids))
