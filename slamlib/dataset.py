"""Datasets: the measurements of one drive, read from a folder of text files.

The folder holds `encoderReading.txt` and, where the vehicle has the sensors, `ArucoReading.txt` and
`UwbReading.txt` with `UwbAntennaGuess.txt`. Optional are `vehicle.toml`, with what differs from the
assignment's table 2, and the folder `truth`. Lengths are in metres, angles in radians. Pose ids
count from 1 in the files and from 0 in the arrays; marker and antenna ids stay unchanged. `tables`
finds and reads the files.
"""

import json
from dataclasses import dataclass, replace
from numbers import Integral
from os.path import abspath
from pathlib import Path

import numpy as np

from slamlib import se2, tables
from slamlib.doubt import Doubt
from slamlib.tables import ENCODER, TABLES, TRUTH_FILES, contents, datasets_in, read_table
from slamlib.textfile import DatasetError as DatasetError
from slamlib.textfile import require, require_type
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
        require_type(vehicle, Vehicle, "vehicle")
        stated = {key: value for key, value in vars(vehicle).items() if value is not None}
        arguments = zip(TABLES, ("ticks", "aruco", "uwb", "guess"), (ticks, aruco, uwb, guess))
        files = {file: tables.table_of_array(key, value, file, counted=key == "ticks")
                 for file, key, value in arguments if value is not None or key == "ticks"}
        return _dataset(files, changed(TABLE_2, stated, "vehicle"), name)

    @property
    def sightings(self):
        """The ArucoReadings, or None, as the vehicle's origin sees them by stated camera, size."""
        v, a = self.vehicle, self.aruco
        scale = np.array([v.marker_size, v.marker_size, 1])
        camera = [v.camera_x, v.camera_y, v.camera_turn]
        return a and replace(
            a, marker_in_vehicle=se2.compose(camera, scale * a.marker_in_vehicle),
            covariance=se2.rotate_covariance(scale[:, None] * a.covariance * scale, v.camera_turn))

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
    found = datasets_in(data)[0] if data.is_dir() else []
    require(found, data, f"this folder, with a sub-folder with an {ENCODER} for each dataset, "
            "found none")
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
    return _dataset(files, vehicle, Path(abspath(folder)).name, notes, MAX_BAD_SHARE)


def _dataset(files, vehicle, name, notes=(), share=0.0):
    """The Dataset by its Vehicle and the sources (dict) of its tables by name.

    A share of the rows of a sensor may be bad, and is left out.
    """
    encoders, ticks = incremental_counts(_table(files, ENCODER), vehicle)
    guess = _table(files, "UwbAntennaGuess.txt")
    seen, heard = (_table(files, each, share, len(ticks)) for each in TABLES[1:3])
    heard.kept(np.isin(heard.numbers[:, 1], guess.numbers[:, 0]), "an antenna id that the guesses "
               "have: UwbAntennaGuess.txt in the same folder, or guess")
    (*sighting, rows), (*measured, ranges) = map(_in_order, (seen.numbers, heard.numbers))
    return Dataset(
        name=name, vehicle=vehicle, ticks=ticks,
        aruco=ArucoReadings(*sighting, rows[:, 2:5], _covariances(rows)) if len(rows) else None,
        uwb=UwbReadings(*measured, *ranges[:, 2:].T) if len(ranges) else None,
        antenna_guess=AntennaGuess(*_by_id(guess)) if len(guess.numbers) else None,
        notes=(*notes, *encoders.notes, *seen.notes, *heard.notes, *guess.notes))


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
    files, notes = contents(drive["truth"], TRUTH_FILES, "vehiclePose.txt")
    path, *maps = read = [_table(files, name) for name in TRUTH_FILES[:3]]
    poses, count = path.numbers[:, 1:], len(_table(drive, ENCODER).numbers)
    require(len(poses) == count, path.source,
            f"{count} poses (encoder file), found {len(poses)}")
    (marker, marker_in_world), (antenna, antenna_in_world) = map(_by_id, maps)
    vehicle = read_vehicle(drive.get("vehicle.toml"), default=TABLE_2)
    return in_first_frame(Truth(
        poses=np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]),
        marker=marker, marker_in_world=marker_in_world,
        antenna=antenna, antenna_in_world=antenna_in_world,
        vehicle=read_vehicle(files.get("vehicle.toml"), default=vehicle),
        notes=tuple(f"In truth: {note}" for note in sum((each.notes for each in read), (*notes,)))))


def _covariances(rows):
    """Covariances (m, 3, 3) of rows (m, 11) of sightings."""
    return rows[:, 5:][:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


_COUNTED = (lambda x: x[:, 0] == np.arange(1, len(x) + 1), "pose ids 1, 2, 3, ... in order")
_UNIQUE = (lambda x: np.isin(np.arange(len(x)), np.unique(x[:, 0], return_index=True)[1]),
           "each id only once")
# By file, which rows of its numbers (m, c) are right, and what is expected of them. Covariances are
# scaled to correlations: s_thetatheta may be 1e4 rad^2 where s_xx is 1e-4 m^2.
CHECKS = {
    ENCODER: _COUNTED, "vehiclePose.txt": _COUNTED, "UwbAntennaGuess.txt": _UNIQUE,
    "ArucoMap.txt": _UNIQUE, "UwbMap.txt": _UNIQUE,
    "ArucoReading.txt": (
        lambda x: np.linalg.eigvalsh(se2.correlations(_covariances(x)))[:, 0] > MIN_EIGENVALUE,
        "a positive definite covariance (smallest eigenvalue of its correlation matrix above "
        f"{MIN_EIGENVALUE:g})"),
    "UwbReading.txt": (lambda x: x[:, 2] >= -MAX_NEGATIVE_SIGMAS * x[:, 3],
                       f"a range that is not below -{MAX_NEGATIVE_SIGMAS:g} sigma")}


def _table(files, name, share=0.0, pose_count=None):
    """The Table of a file whose rows have passed all checks."""
    table = read_table(files.get(name), name, share, pose_count)
    require(len(table.numbers) or name != ENCODER, table.source,
            "at least the row '1 0 0', found no rows")
    right, expected = CHECKS[name]
    return table.kept(right(table.numbers), expected, share)


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
