"""Datasets: the measurements of one drive, read from a folder of text files.

The folder holds `encoderReading.txt` and, where the vehicle has the sensors, `ArucoReading.txt` and
`UwbReading.txt` with `UwbAntennaGuess.txt`. Optional are `vehicle.toml`, with what differs from the
assignment's table 2, and the folder `truth`. Lengths are in metres, angles in radians. Pose ids
count from 1 in the files and from 0 in the arrays; marker and antenna ids stay unchanged. Numbers
are within `limits.LIMITS`. `folder` finds the files, `dialects` reads their numbers.
"""

from dataclasses import dataclass, replace
from os.path import abspath
from pathlib import Path

import numpy as np

from slamlib import counts, se2
from slamlib.covariance import correlations
from slamlib.dialects import read_table
from slamlib.doubt import Doubt
from slamlib.exchanged import look_exchanged
from slamlib.filenames import ENCODER, TRUTH_FILES
from slamlib.folder import contents, is_dataset
from slamlib.limits import LIMITS
from slamlib.textfile import DatasetError, error
from slamlib.truth_frame import in_first_frame
from slamlib.vehicle import Vehicle, read_vehicle

MIN_EIGENVALUE = 1e-12  # of a correlation matrix; with a smaller one it counts as singular
MAX_NEGATIVE_SIGMAS = 5.0  # sigmas, by which noise may make a range negative


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
    """Names of the datasets in a folder: all sub-folders that look like one, or the list `names`.

    Raises DatasetError if there is no dataset, no sub-folder of a selected name, or no
    encoderReading.txt in a sub-folder.
    """
    data = Path(data)
    if not data.is_dir():
        raise DatasetError(f"{data}: expected this folder, with a sub-folder with an {ENCODER} for "
                           "each dataset, found none")
    found = sorted(path.name for path in data.glob("[!.]*") if path.is_dir() and is_dataset(path))
    if not found:
        raise DatasetError(f"{data}: expected a sub-folder with an {ENCODER}, found none")
    selected = found if names is None else list(names)
    for name in selected:
        if not (data / name).is_dir():
            raise DatasetError(f"{data}: expected one of {', '.join(found)}, found {name!r}")
        contents(data / name).required(ENCODER)
    return selected


def read_dataset(folder):
    """Measurements of one drive, a Dataset; sensors without a file or without rows are None.

    The names of the files in `folder` may be in upper or lower case, and the files in any of the
    `dialects`; `Dataset.notes` state what was mended or left out. Raises DatasetError if a file
    does not have the format.

    >>> from slamlib.simulation import simulate, write_dataset
    >>> write_dataset("drive", *simulate("short", seed=1))
    >>> dataset = read_dataset("drive")
    >>> len(dataset.ticks), len(dataset.aruco.pose), dataset.antenna_guess.antenna.tolist()
    (2000, 894, [5, 13, 36, 46])
    """
    files = contents(folder)
    notes = list(files.notes)
    vehicle = read_vehicle(files, default=Vehicle())
    table = _read_encoder(files, notes)
    aruco = _read_aruco(files, len(table.numbers), notes)
    ticks, more = counts.incremental_counts(table, vehicle, aruco)
    notes += more
    antenna, position = _read_map(
        files, "UwbAntennaGuess.txt", "antenna id, x, y", notes, optional="z")
    guess = AntennaGuess(antenna, position) if len(antenna) else None
    uwb = _read_uwb(files, len(ticks), guess, notes)
    return Dataset(name=Path(abspath(folder)).name, vehicle=vehicle, ticks=ticks, aruco=aruco,
                   uwb=uwb, antenna_guess=guess, notes=tuple(notes))


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
    notes = [f"In truth: {note}" for note in files.notes]
    vehicle = read_vehicle(drive, default=Vehicle())
    pose_count = len(_read_encoder(drive, []).numbers)
    table = _read_all_poses(files, "vehiclePose.txt", "pose id, x, y, theta", notes)
    poses = table.numbers[:, 1:]
    if len(poses) != pose_count:
        raise error(table.source, f"expected {pose_count} poses (encoder file), found {len(poses)}")
    marker, marker_in_world = _read_map(files, "ArucoMap.txt", "marker id, x, y, theta", notes)
    antenna, antenna_in_world = _read_map(files, "UwbMap.txt", "antenna id, x, y", notes)
    truth = Truth(poses=np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]),
                  marker=marker, marker_in_world=marker_in_world,
                  antenna=antenna, antenna_in_world=antenna_in_world,
                  vehicle=read_vehicle(files, default=vehicle), notes=tuple(notes))
    return in_first_frame(truth)


def _read_numbers(files, name, columns, notes, **options):
    """The Table of the file `name`, with numbers within LIMITS; its notes are added to `notes`."""
    table, names = read_table(files.files.get(name), columns, **options), columns.split(", ")
    for column, limit in LIMITS.get(name, {}).items():
        values = table.numbers[:, names.index(column)]
        table.require((limit.minimum <= values) & (values <= limit.maximum), limit.expected(column),
                      names.index(column))
    notes += table.notes
    if table.source is not None and len(table.numbers) == 0:
        notes.append(f"{table.source.name} holds no rows.")
    return table


def _read_encoder(files, notes):
    """The Table of the encoders, with whole numbers."""
    table = _read_all_poses(files, ENCODER, "pose id, right ticks, left ticks", notes)
    if len(table.numbers) == 0:
        raise error(table.source, "expected at least the row '1 0 0', found no rows")
    table.require((table.numbers == np.rint(table.numbers)).all(axis=1), "whole numbers of ticks")
    return table


def _read_aruco(files, pose_count, notes):
    """The ArucoReadings, or None without rows."""
    table, pose, marker = _read_readings(
        files, "ArucoReading.txt", "pose id, marker id, x, y, theta, "
        "s_xx, s_xy, s_xtheta, s_yy, s_ytheta, s_thetatheta", pose_count, notes)
    if len(pose) == 0:
        return None
    values = table.numbers[:, 2:]
    covariance = values[:, [[3, 4, 5], [4, 6, 7], [5, 7, 8]]]
    # Scaled to correlations: s_thetatheta may be 1e4 rad^2 where s_xx is 1e-4 m^2.
    smallest_eigenvalue = np.linalg.eigvalsh(correlations(covariance))[:, 0]
    table.require(smallest_eigenvalue > MIN_EIGENVALUE, "a positive definite covariance "
                  f"(smallest eigenvalue of its correlation matrix above {MIN_EIGENVALUE:g})")
    return _in_order(ArucoReadings(pose, marker, values[:, :3], covariance), table)


def _read_uwb(files, pose_count, antenna_guess, notes):
    """The UwbReadings of antennas with a guess, or None without rows."""
    table, pose, antenna = _read_readings(
        files, "UwbReading.txt", "pose id, antenna id, range, sigma", pose_count, notes)
    if len(pose) == 0:
        return None
    ranges, sigma = table.numbers[:, 2:].T
    table.require(ranges >= -MAX_NEGATIVE_SIGMAS * sigma,
                  f"a range that is not below -{MAX_NEGATIVE_SIGMAS:g} sigma")
    if antenna_guess is None:
        raise error(table.source,
                    "expected a UwbAntennaGuess.txt in the same folder, with every antenna")
    table.require(np.isin(antenna, antenna_guess.antenna), "an antenna id of UwbAntennaGuess.txt")
    return _in_order(UwbReadings(pose, antenna, ranges, sigma), table)


def _in_order(readings, table):
    """The readings in ascending order of pose; rows of a file that repeat exactly count once."""
    _, rows = np.unique(table.numbers, axis=0, return_index=True)
    rows = np.sort(rows)
    return readings.select(rows[np.argsort(readings.pose[rows], kind="stable")])


def _read_all_poses(files, name, columns, notes):
    """The Table of a required file, with a row for each pose."""
    files.required(name)
    table = _read_numbers(files, name, columns, notes)
    ids = np.arange(1, len(table.numbers) + 1)
    table.require(table.numbers[:, 0] == ids, "pose ids 1, 2, 3, ... in order")
    return table


def _read_readings(files, name, columns, pose_count, notes):
    """The Table of a sensor, pose indices (m,) from 0 and landmark ids (m,)."""
    table = _read_numbers(files, name, columns, notes, gaps=True)
    pose, landmark = table.numbers[:, :2].T
    place = table.numbers[:, 2:4] if name.startswith("Aruco") else table.numbers[:, 2:3]
    if look_exchanged(pose, landmark, place, pose_count):
        raise error(table.source, f"expected the columns ({columns}), but columns 1 and 2 look "
                    "exchanged: successive measurements of one landmark agree only if column 2 has "
                    "the pose ids")
    pose, landmark = _ids(table, 0), _ids(table, 1)
    table.require((1 <= pose) & (pose <= pose_count), f"a pose id from 1 to {pose_count}")
    return table, pose - 1, landmark


def _read_map(files, name, columns, notes, **options):
    """Landmark ids (k,), ascending, and the further columns (k, c - 1)."""
    table = _read_numbers(files, name, columns, notes, **options)
    ids, first_row = np.unique(_ids(table, 0), return_index=True)
    table.require(np.isin(np.arange(len(table.numbers)), first_row), "each id only once")
    return ids, table.numbers[first_row, 1:]


def _ids(table, column):
    """Ids (m,) in a column, whole numbers, as int64."""
    values = table.numbers[:, column]
    table.require(values == np.rint(values), "ids that are whole numbers")
    return values.astype(np.int64)
