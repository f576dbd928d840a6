"""Datasets: the measurements of one drive, read from a folder of text files.

The folder holds `encoderReading.txt` and, where the vehicle has the sensors, `ArucoReading.txt` and
`UwbReading.txt` with `UwbAntennaGuess.txt`. Optional are `vehicle.toml`, with what differs from the
assignment's table 2, and the folder `truth`. Lengths are in metres, angles in radians. Pose ids
count from 1 in the files and from 0 in the arrays; marker and antenna ids stay unchanged. `folder`
finds the files, `dialects` reads their numbers.
"""

import json
from dataclasses import dataclass, replace
from numbers import Integral
from os.path import abspath
from pathlib import Path

import numpy as np

from slamlib import se2
from slamlib.dialects import LIMITS, matrix, read_table
from slamlib.doubt import Doubt
from slamlib.folder import ENCODER, TABLES, TRUTH_FILES, Variable, contents, is_dataset
from slamlib.textfile import DatasetError as DatasetError
from slamlib.textfile import error, require
from slamlib.truth_frame import in_first_frame
from slamlib.vehicle import Vehicle, changed, incremental_counts, read_vehicle

MIN_EIGENVALUE = 1e-12  # of a correlation matrix; with a smaller one it counts as singular
MAX_NEGATIVE_SIGMAS = 5.0  # sigmas, by which noise may make a range negative
TABLE_2 = Vehicle()  # the assignment's nominal vehicle
MAX_BAD_SHARE = 0.1  # of the rows of a sensor, which are left out; with more a file is refused


class _Readings:
    """Readings of one sensor: arrays with a row for each reading."""

    def select(self, keep):
        """The readings that `keep` selects: a mask (m,) of bool or an array of row indices."""
        return replace(self, **{name: values[keep] for name, values in vars(self).items()})


@dataclass(frozen=True)
class ArucoReadings(_Readings):
    """Sightings of markers, in ascending order of pose."""

    pose: np.ndarray  # (m,) int64, row of `Dataset.ticks`
    marker: np.ndarray  # (m,) int64, marker id
    marker_in_vehicle: np.ndarray  # (m, 3) [x, y, heading] in m, m, rad; as a camera at its origin
    covariance: np.ndarray  # (m, 3, 3) of [x, y, heading] in the axes of the vehicle


@dataclass(frozen=True)
class UwbReadings(_Readings):
    """Ranges between the antennas and the vehicle, in ascending order of pose."""

    pose: np.ndarray  # (m,) int64, row of `Dataset.ticks`
    antenna: np.ndarray  # (m,) int64, antenna id
    range: np.ndarray  # (m,) m
    sigma: np.ndarray  # (m,) m, standard deviation of the range


@dataclass(frozen=True)
class AntennaGuess:
    """Guessed positions of the antennas, in ascending order of id."""

    antenna: np.ndarray  # (a,) int64, antenna id
    position: np.ndarray  # (a, 2) [x, y] in m


@dataclass(frozen=True)
class Dataset:
    """All measurements of one drive."""

    name: str  # of the folder
    vehicle: Vehicle
    ticks: np.ndarray  # (n, 2) int64 [right, left]; row i leads from pose i-1 to pose i, row 0 is 0
    aruco: ArucoReadings | None
    uwb: UwbReadings | None
    antenna_guess: AntennaGuess | None
    notes: tuple[str, ...] = ()  # what was mended or left out while reading, a sentence each

    @classmethod
    def from_arrays(cls, ticks, aruco=None, uwb=None, guess=None, vehicle=TABLE_2, name="arrays"):
        """The Dataset of arrays with the columns of the files (data/README.md), in m and rad.

        Parameters
        ----------
        ticks : (n, 2) counts of the right and left wheel since the previous pose; the first are 0.
        aruco : (m, 11) pose from 1 to n, marker id, x, y, heading of the marker in the vehicle, and
            their covariances xx, xy, x heading, yy, y heading, heading heading; or None.
        uwb : (r, 4) pose from 1 to n, antenna id, range, standard deviation; or None.
        guess : (a, 3) antenna id, x, y; or None without `uwb`.
        vehicle : Vehicle

        Raises DatasetError, which names the argument and the row, from 1, if an argument does not
        pass the checks of its file: no row is left out.

        >>> dataset = Dataset.from_arrays(ticks=[[0, 0], [10, 12]], uwb=[[2, 7, 1.5, 0.1]],
        ...                               guess=[[7, 1.0, 1.0]])
        >>> len(dataset.ticks), dataset.uwb.antenna.tolist()
        (2, [7])
        """
        require(isinstance(vehicle, Vehicle), "vehicle", "a Vehicle", vehicle)
        stated = {key: value for key, value in vars(vehicle).items() if value is not None}
        ticks = matrix("ticks", ticks, list(LIMITS[ENCODER])[1:])
        ticks = np.column_stack([np.arange(1, len(ticks) + 1), ticks])
        arguments = {"ticks": ticks, "aruco": aruco, "uwb": uwb, "guess": guess}
        files = {file: Variable(key, value, exact=True)
                 for file, (key, value) in zip(TABLES, arguments.items()) if value is not None}
        return _dataset(files, changed(TABLE_2, stated, "vehicle"), name)

    @property
    def sightings(self):
        """The ArucoReadings, or None, as the vehicle's origin sees them by stated camera, size."""
        v, a = self.vehicle, self.aruco
        if a is None or (v.camera_x, v.camera_y, v.camera_turn, v.marker_size) == (0, 0, 0, 1):
            return a
        scale = np.array([v.marker_size, v.marker_size, 1])
        camera = [v.camera_x, v.camera_y, v.camera_turn]
        return replace(a, marker_in_vehicle=se2.compose(camera, scale * a.marker_in_vehicle),
                       covariance=se2.rotate_covariance(
                           scale[:, None] * a.covariance * scale, v.camera_turn))

    def without(self, sensor):
        """The Dataset without a sensor, "aruco" or "uwb"."""
        require(sensor in ("aruco", "uwb"), "without", '"aruco" or "uwb"', sensor)
        return replace(self, **{sensor: None})

    def first(self, count):
        """The Dataset of the first `count` poses; sensors without readings are None."""
        require(isinstance(count, Integral) and count > 0, "first", "a number of poses", count)
        early = {sensor: readings.select(readings.pose < count) for sensor in ("aruco", "uwb")
                 if (readings := getattr(self, sensor)) and (readings.pose < count).any()}
        return replace(self, ticks=self.ticks[:count], **{"aruco": None, "uwb": None} | early)


@dataclass(frozen=True)
class Truth:
    """True poses, maps and wheel parameters of a simulated or surveyed drive."""

    poses: np.ndarray  # (n, 3) [x, y, heading] in m, m, rad; headings are continuous
    marker: np.ndarray  # (k,) int64, marker id, ascending
    marker_in_world: np.ndarray  # (k, 3) [x, y, heading] in m, m, rad
    antenna: np.ndarray  # (a,) int64, antenna id, ascending
    antenna_in_world: np.ndarray  # (a, 2) [x, y] in m
    vehicle: Vehicle
    doubts: tuple[Doubt, ...] = ()
    notes: tuple[str, ...] = ()  # as those of a Dataset


def dataset_names(data, names=None):
    """Names of the datasets in a folder: all sub-folders with files of one, or the list `names`.

    Raises DatasetError if there is no dataset, no sub-folder of a selected name, or no
    encoderReading.txt in a sub-folder.
    """
    data = Path(data)
    found = sorted(path.name for path in data.glob("[!.]*") if path.is_dir() and is_dataset(path))
    if not found:
        raise error(data, f"expected this folder, with a sub-folder with an {ENCODER} for each "
                    "dataset, found none")
    names = found if names is None else list(names)
    for name in names:
        require((data / name).is_dir(), data, f"one of {', '.join(found)}", name)
        contents(data / name, required=ENCODER)
    return names


def read_dataset(folder):
    """Measurements of one drive, a Dataset; sensors without a file or without rows are None.

    `Dataset.notes` state what was mended, left out or not read. Raises DatasetError if a file does
    not have the format.

    >>> from slamlib.simulation import simulate, write_dataset
    >>> write_dataset("drive", *simulate("short", seed=1))
    >>> dataset = read_dataset("drive")
    >>> len(dataset.ticks), len(dataset.aruco.pose), dataset.antenna_guess.antenna.tolist()
    (2000, 894, [5, 13, 36, 46])
    """
    files, notes = contents(folder, required=ENCODER)
    vehicle = read_vehicle(files.get("vehicle.toml"), default=TABLE_2)
    return _dataset(files, vehicle, Path(abspath(folder)).name, notes)


def _dataset(files, vehicle, name, notes=()):
    """The Dataset of this name by its Vehicle and the sources (dict) of its tables by name."""
    ticks, encoder_notes = incremental_counts(_read_all_poses(files, ENCODER), vehicle)
    notes = [*notes, *encoder_notes]
    aruco = _read_aruco(files, len(ticks), notes)
    uwb, guess = _read_uwb(files, len(ticks), notes)
    return Dataset(name=name, vehicle=vehicle, ticks=ticks, aruco=aruco, uwb=uwb,
                   antenna_guess=guess if len(guess.antenna) else None, notes=tuple(notes))


def read_truth(folder):
    """Truth of one drive, from the sub-folder `truth` of its folder, or None without it.

    Maps without a file have length 0. Wheel parameters that `truth/vehicle.toml` does not give are
    those of the dataset. Truth whose first pose is not the origin is moved there, and a doubt says
    so. Raises DatasetError if a file does not have the format or the number of poses is not that of
    the drive.
    """
    drive, _ = contents(folder, required=ENCODER)
    if "truth" not in drive:
        return None
    files, notes = contents(drive["truth"], TRUTH_FILES, required="vehiclePose.txt")
    pose_count = len(_read_all_poses(drive, ENCODER).numbers)
    table = _read_all_poses(files, "vehiclePose.txt")
    poses, notes = table.numbers[:, 1:], [*notes, *table.notes]
    if len(poses) != pose_count:
        raise error(table.source, f"expected {pose_count} poses (encoder file), found {len(poses)}")
    marker, marker_in_world = _read_map(files, "ArucoMap.txt", notes)
    antenna, antenna_in_world = _read_map(files, "UwbMap.txt", notes)
    vehicle = read_vehicle(drive.get("vehicle.toml"), default=TABLE_2)
    return in_first_frame(Truth(
        poses=np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]),
        marker=marker, marker_in_world=marker_in_world,
        antenna=antenna, antenna_in_world=antenna_in_world,
        vehicle=read_vehicle(files.get("vehicle.toml"), default=vehicle),
        notes=tuple(f"In truth: {note}" for note in notes)))


def _read_all_poses(files, name):
    """The Table of a file with a row for each pose."""
    table = read_table(files[name], name)
    if len(table.numbers) == 0 and name == ENCODER:
        raise error(table.source, "expected at least the row '1 0 0', found no rows")
    ids = np.arange(1, len(table.numbers) + 1)
    return table.kept(table.numbers[:, 0] == ids, "pose ids 1, 2, 3, ... in order")


def _read_map(files, name, notes):
    """Landmark ids (k,), ascending, and the further columns (k, c - 1)."""
    table = read_table(files.get(name), name)
    notes += table.notes
    ids, first_row = np.unique(table.numbers[:, 0], return_index=True)
    table.kept(np.isin(np.arange(len(table.numbers)), first_row), "each id only once")
    return ids.astype(np.int64), table.numbers[first_row, 1:]


def _read_aruco(files, pose_count, notes):
    """The ArucoReadings, or None without rows."""
    table = read_table(files.get("ArucoReading.txt"), "ArucoReading.txt", MAX_BAD_SHARE, pose_count)
    # Scaled to correlations: s_thetatheta may be 1e4 rad^2 where s_xx is 1e-4 m^2.
    smallest = np.linalg.eigvalsh(se2.correlations(_covariances(table.numbers)))[:, 0]
    table = table.kept(smallest > MIN_EIGENVALUE, "a positive definite covariance (smallest "
                       f"eigenvalue of its correlation matrix above {MIN_EIGENVALUE:g})",
                       MAX_BAD_SHARE)
    notes += table.notes
    pose, marker, rows = _in_order(table.numbers)
    return ArucoReadings(pose, marker, rows[:, 2:5], _covariances(rows)) if len(rows) else None


def _covariances(rows):
    """Covariances (m, 3, 3) of rows (m, 11) of sightings."""
    return rows[:, 5:][:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def _read_uwb(files, pose_count, notes):
    """The UwbReadings, or None without rows, and the AntennaGuess, which has all of their ids."""
    table = read_table(files.get("UwbReading.txt"), "UwbReading.txt", MAX_BAD_SHARE, pose_count)
    table = table.kept(table.numbers[:, 2] >= -MAX_NEGATIVE_SIGMAS * table.numbers[:, 3],
                       f"a range that is not below -{MAX_NEGATIVE_SIGMAS:g} sigma", MAX_BAD_SHARE)
    notes += table.notes
    guess = AntennaGuess(*_read_map(files, "UwbAntennaGuess.txt", notes))
    table.kept(np.isin(table.numbers[:, 1], guess.antenna), "an antenna id that the guesses have: "
               "UwbAntennaGuess.txt in the same folder, or guess")
    pose, antenna, rows = _in_order(table.numbers)
    return UwbReadings(pose, antenna, *rows[:, 2:].T) if len(rows) else None, guess


def _in_order(rows):
    """Poses from 0, ids (m,) int64, rows (m, c), in ascending order of pose; repeated rows once."""
    rows = rows[np.sort(np.unique(rows, axis=0, return_index=True)[1])]
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    return rows[:, 0].astype(np.int64) - 1, rows[:, 1].astype(np.int64), rows


def all_notes(dataset, truth):
    """Notes (tuple of str) on what was mended or left out, and on another kernel or gate."""
    weighed = [f"Problems 3 and 4 are solved with {key} = {json.dumps(value)}."
               for key in ("kernel", "gate")
               if (value := getattr(dataset.vehicle, key)) != getattr(TABLE_2, key)]
    return (*dataset.notes, *weighed, *(() if truth is None else truth.notes))


def inventory_lines(dataset, truth):
    """Lines (list of str) on what was read of a Dataset and its Truth or None, with all notes."""
    aruco, uwb = dataset.aruco, dataset.uwb
    stated = [f"{key} = {value:g}" if isinstance(value, float) else f"{key} = {json.dumps(value)}"
              for key, value in vars(dataset.vehicle).items() if value != getattr(TABLE_2, key)]
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
