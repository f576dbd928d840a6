"""Datasets: the measurements of one drive, read from a folder of text files.

The folder holds `encoderReading.txt` and, where the vehicle has the sensors, `ArucoReading.txt` and
`UwbReading.txt` with `UwbAntennaGuess.txt`. Optional are `vehicle.toml`, with what differs from the
assignment's table 2, and the folder `truth`. Lengths are in metres, angles in radians. Pose ids
count from 1 in the files and from 0 in the arrays; marker and antenna ids stay unchanged. Numbers
are within `limits.LIMITS`. `folder` finds the files, `dialects` reads their numbers.
"""

import json
from dataclasses import dataclass, replace
from os.path import abspath
from pathlib import Path

import numpy as np

from slamlib import counts, se2
from slamlib.dialects import Variable, read_table
from slamlib.doubt import Doubt
from slamlib.folder import ENCODER, TABLES, TRUTH_FILES, Contents, contents, is_dataset
from slamlib.limits import LIMITS
from slamlib.textfile import DatasetError, error, quoted
from slamlib.truth_frame import in_first_frame
from slamlib.vehicle import Vehicle, changed, read_vehicle

MIN_EIGENVALUE = 1e-12  # of a correlation matrix; with a smaller one it counts as singular
MAX_NEGATIVE_SIGMAS = 5.0  # sigmas, by which noise may make a range negative
TABLE_2 = Vehicle()  # the assignment's nominal vehicle
MAX_BAD_SHARE = 0.1  # of the rows of a sensor, which are left out; with more a file is refused
MIN_EXCHANGED = 9  # ids in column 2 above which columns may look exchanged


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
    marker_in_vehicle: np.ndarray  # (m, 3) [x, y, heading] in m, m, rad
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
        name : str, for messages.

        Raises
        ------
        DatasetError : an argument does not pass the checks of its file. It names the argument and
            the row, from 1. No row is left out.

        >>> dataset = Dataset.from_arrays(ticks=[[0, 0], [10, 12]], uwb=[[2, 7, 1.5, 0.1]],
        ...                               guess=[[7, 1.0, 1.0]])
        >>> len(dataset.ticks), dataset.uwb.antenna.tolist()
        (2, [7])
        """
        if not isinstance(vehicle, Vehicle):
            raise error("vehicle", f"expected a Vehicle, found {quoted(vehicle)}")
        stated = {key: value for key, value in vars(vehicle).items() if value is not None}
        ticks = _array(ticks)
        if ticks.shape[1:] != (2,):
            raise error("ticks", "expected a matrix with the columns (right ticks, left ticks)")
        ticks = np.column_stack([np.arange(1, len(ticks) + 1), ticks])
        arguments = {"ticks": ticks, "aruco": aruco, "uwb": uwb, "guess": guess}
        files = {file: Variable(None, key, _array(value))
                 for file, (key, value) in zip(TABLES, arguments.items()) if value is not None}
        return _dataset(Contents(None, files, ()), changed(TABLE_2, stated, "vehicle"), name)

    @property
    def sightings(self):
        """The ArucoReadings as the vehicle's origin sees them, by the stated camera and size.

        Problem 2 and the checks of files use these. None without markers.
        """
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
        return replace(self, **{sensor: None})

    def first(self, count):
        """The Dataset of the first `count` poses; sensors without readings are None."""
        def until(readings):
            early = readings and readings.select(readings.pose < count)
            return early if early and len(early.pose) else None
        return replace(self, ticks=self.ticks[:count], aruco=until(self.aruco), uwb=until(self.uwb))


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
    selected = found if names is None else list(names)
    for name in selected:
        if not (data / name).is_dir():
            raise DatasetError(f"{data}: expected one of {', '.join(found)}, found {name!r}")
        contents(data / name).required(ENCODER)
    return selected


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
    files = contents(folder)
    return _dataset(files, read_vehicle(files, default=TABLE_2), Path(abspath(folder)).name)


def _array(value):
    """The np.ndarray of an argument, or one without dimensions if it makes none."""
    try:
        return np.asarray(value)
    except ValueError:                                       # rows of different lengths
        return np.asarray(None)


def _dataset(files, vehicle, name):
    """The Dataset of this name by its Vehicle and Contents."""
    notes = list(files.notes)
    table, ticks = counts.incremental_counts(_read_all_poses(files, ENCODER), vehicle)
    for key in ("sighting_lag", "range_lag"):
        if abs(getattr(vehicle, key)) >= len(ticks) > 1:
            raise error(files.files.get("vehicle.toml", "vehicle"), f"expected a {key} below the "
                        f"number of poses ({len(ticks)}) in size, found {getattr(vehicle, key):g}")
    notes += table.notes
    notes += [f"vehicle.toml sets {key} = {json.dumps(getattr(vehicle, key))} for problems 3 and 4."
              for key in ("kernel", "gate") if getattr(vehicle, key) != getattr(TABLE_2, key)]
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
    drive = contents(folder)
    if "truth" not in drive.files:
        return None
    files = contents(drive.files["truth"], TRUTH_FILES)
    vehicle = read_vehicle(drive, default=TABLE_2)
    pose_count = len(_read_all_poses(drive, ENCODER).numbers)
    table = _read_all_poses(files, "vehiclePose.txt")
    poses, notes = table.numbers[:, 1:], [*files.notes, *table.notes]
    if len(poses) != pose_count:
        raise error(table.source, f"expected {pose_count} poses (encoder file), found {len(poses)}")
    marker, marker_in_world = _read_map(files, "ArucoMap.txt", notes)
    antenna, antenna_in_world = _read_map(files, "UwbMap.txt", notes)
    truth = Truth(poses=np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]),
                  marker=marker, marker_in_world=marker_in_world,
                  antenna=antenna, antenna_in_world=antenna_in_world,
                  vehicle=read_vehicle(files, default=vehicle),
                  notes=tuple(f"In truth: {note}" for note in notes))
    return in_first_frame(truth)


def _read_all_poses(files, name):
    """The Table of a required file, with a row for each pose."""
    files.required(name)
    table = read_table(files.files.get(name), name)
    if len(table.numbers) == 0 and name == ENCODER:
        raise error(table.source, "expected at least the row '1 0 0', found no rows")
    ids = np.arange(1, len(table.numbers) + 1)
    return table.kept(table.numbers[:, 0] == ids, "pose ids 1, 2, 3, ... in order")


def _read_map(files, name, notes, optional=None):
    """Landmark ids (k,), ascending, and the further columns (k, c - 1)."""
    table = read_table(files.files.get(name), name, optional=optional,
                          settled=any("decimal commas" in note for note in notes))
    notes += table.notes
    ids, first_row = np.unique(table.numbers[:, 0], return_index=True)
    table.kept(np.isin(np.arange(len(table.numbers)), first_row), "each id only once")
    return ids.astype(np.int64), table.numbers[first_row, 1:]


def _read_aruco(files, pose_count, notes):
    """The ArucoReadings, or None without rows."""
    table = _read_readings(files, "ArucoReading.txt", pose_count)
    # Scaled to correlations: s_thetatheta may be 1e4 rad^2 where s_xx is 1e-4 m^2.
    smallest_eigenvalue = np.linalg.eigvalsh(se2.correlations(_covariances(table)))[:, 0]
    table = table.kept(smallest_eigenvalue > MIN_EIGENVALUE, "a positive definite covariance "
                       f"(smallest eigenvalue of its correlation matrix above {MIN_EIGENVALUE:g})",
                       MAX_BAD_SHARE)
    notes += table.notes
    return _in_order(table, ArucoReadings, table.numbers[:, 2:5], _covariances(table))


def _covariances(table):
    """Covariances (m, 3, 3) of a Table of sightings."""
    return table.numbers[:, 5:][:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def _read_uwb(files, pose_count, notes):
    """The UwbReadings, or None without rows, and the AntennaGuess, which has all of their ids."""
    table = _read_readings(files, "UwbReading.txt", pose_count)
    low = -MAX_NEGATIVE_SIGMAS * table.numbers[:, 3]
    table = table.kept(table.numbers[:, 2] >= low, "a range that is not below "
                       f"-{MAX_NEGATIVE_SIGMAS:g} sigma", MAX_BAD_SHARE)
    notes += table.notes
    guess = AntennaGuess(*_read_map(files, "UwbAntennaGuess.txt", notes, optional="z"))
    table.kept(np.isin(table.numbers[:, 1], guess.antenna), "an antenna id that the guesses have: "
               "UwbAntennaGuess.txt in the same folder, or guess")
    return _in_order(table, UwbReadings, *table.numbers[:, 2:].T), guess


def _read_readings(files, name, pose_count):
    """The Table of a sensor, with pose ids of the drive."""
    table = read_table(files.files.get(name), name, MAX_BAD_SHARE)
    pose, landmark = table.numbers[:, :2].T
    # Ids in column 2 ascend over most of the drive; those in column 1 do not, are fewer, and cover
    # less than half of it.
    if (len(np.unique(landmark)) > max(len(np.unique(pose)), MIN_EXCHANGED)
            and 1 <= landmark.min() and landmark.max() <= pose_count
            and (np.diff(landmark) >= 0).all() and not (np.diff(pose) >= 0).all()
            and np.ptp(landmark) > pose_count / 2 > np.ptp(pose)):
        raise error(table.source, f"expected the columns ({', '.join(LIMITS[name])}), but columns "
                    "1 and 2 look exchanged: column 2 has the pose ids of a drive")
    return table.kept((1 <= pose) & (pose <= pose_count), f"a pose id from 1 to {pose_count}",
                      MAX_BAD_SHARE)


def _in_order(table, make, *values):
    """Readings made of `values` in ascending order of pose, or None; rows that repeat count once.
    """
    pose, landmark = table.numbers[:, :2].astype(np.int64).T
    _, rows = np.unique(table.numbers, axis=0, return_index=True)
    rows = np.sort(rows)
    return make(pose - 1, landmark, *values).select(
        rows[np.argsort(pose[rows], kind="stable")]) if len(pose) else None
