"""Datasets of one drive each, read from a folder of text files.

The folder holds `encoderReading.txt` and, where the vehicle has the sensors, `ArucoReading.txt` and
`UwbReading.txt` with `UwbAntennaGuess.txt`. Optional are `vehicle.toml`, with what differs from the
assignment's table 2, and the folder `truth`. Lengths are in metres, angles in radians. Pose ids
count from 1 in the files and from 0 in the arrays; marker and antenna ids stay unchanged. Numbers
are within `limits.LIMITS`.
"""

from dataclasses import asdict, dataclass, replace
from os.path import abspath
from pathlib import Path

import numpy as np

from slamlib.doubt import Doubt
from slamlib.limits import LIMITS
from slamlib.textfile import DatasetError, error, find, quoted, read_table, read_toml, require
from slamlib.truth_frame import in_first_frame

SMALLEST_EIGENVALUE = 1e-12  # no unit; a correlation matrix with a smaller one counts as singular
MOST_NEGATIVE = 5.0  # sigmas, of a range at an antenna
MOST_REVOLUTIONS = 10  # revolutions of a wheel in one step
FILES = ("encoderReading.txt", "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt",
         "vehicle.toml", "truth")


@dataclass(frozen=True)
class Vehicle:
    """Wheel parameters, their standard deviations, and what is known of the noise.

    The defaults are the assignment's table 2, in which the noise is not known.
    """

    right_radius: float = 0.1  # m
    left_radius: float = 0.1  # m
    wheelbase: float = 0.4  # m
    ticks_per_revolution: float = 8000.0
    sigma_right_radius: float = 1e-4  # m
    sigma_left_radius: float = 1e-4  # m
    sigma_wheelbase: float = 1e-4  # m
    sigma_heading: float = 1e-4  # rad, of the heading at pose 1
    slip: float | None = None  # sqrt(m), sigma of a wheel's slip after 1 m; None: learned
    marker_noise_factor: float | None = None  # of the sigmas in ArucoReading.txt; None: learned
    range_noise_factor: float | None = None  # of the sigmas in UwbReading.txt; None: learned

    @property
    def wheel(self):
        """Wheel parameters [R_R, R_L, b], (3,) in m."""
        return np.array([self.right_radius, self.left_radius, self.wheelbase])

    @property
    def sigma_wheel(self):
        """Standard deviations of the wheel parameters, (3,) in m."""
        return np.array([self.sigma_right_radius, self.sigma_left_radius, self.sigma_wheelbase])

    def with_wheel(self, wheel):
        """The vehicle with other wheel parameters (3,) in m and the same standard deviations."""
        right, left, base = map(float, wheel)
        return replace(self, right_radius=right, left_radius=left, wheelbase=base)

    def with_deviation(self, w):
        """The vehicle with wheel parameters wheel + sigma_wheel * w, w (3,) without unit."""
        return self.with_wheel(self.wheel + self.sigma_wheel * w)


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

    def without(self, sensor):
        """The dataset without a sensor, "aruco" or "uwb"."""
        return replace(self, **{sensor: None})

    def first(self, count):
        """The dataset until encoder pose number `count`; sensors without readings are None."""
        def until(readings):
            early = readings and readings.select(readings.pose < count)
            return early if early and len(early.pose) else None
        return replace(self, ticks=self.ticks[:count], aruco=until(self.aruco), uwb=until(self.uwb))


@dataclass(frozen=True)
class Truth:
    """What the measurements would be without errors; known for simulated or surveyed drives."""

    poses: np.ndarray  # (n, 3) [x, y, heading] in m, m, rad; headings are continuous
    marker: np.ndarray  # (k,) int64, marker id, ascending
    marker_in_world: np.ndarray  # (k, 3) [x, y, heading] in m, m, rad
    antenna: np.ndarray  # (a,) int64, antenna id, ascending
    antenna_in_world: np.ndarray  # (a, 2) [x, y] in m
    vehicle: Vehicle
    doubts: tuple[Doubt, ...] = ()


def dataset_names(data, names=None):
    """Names of the datasets in a folder: of all sub-folders with any of FILES, or the list `names`.

    Raises DatasetError if there is no dataset, no sub-folder of a selected name, or no
    encoderReading.txt in a sub-folder.
    """
    data = Path(data)
    if not data.is_dir():
        raise DatasetError(f"{data}: expected this folder, with a sub-folder with an "
                           "encoderReading.txt for each dataset, found none")
    known = {name.lower() for name in FILES}
    found = sorted(path.name for path in data.glob("[!.]*")
                   if path.is_dir() and any(file.name.lower() in known for file in path.iterdir()))
    if not found:
        raise DatasetError(f"{data}: expected a sub-folder with an encoderReading.txt, found none")
    selected = found if names is None else list(names)
    for name in selected:
        if not (data / name).is_dir():
            raise DatasetError(f"{data}: expected one of {', '.join(found)}, found {name!r}")
        find(data / name, "encoderReading.txt", required=True)
    return selected


def read_dataset(folder):
    """Measurements of one drive, a Dataset; sensors without a file or without rows are None.

    The names of the files in `folder` may be in upper or lower case. Raises DatasetError if a file
    does not follow the format.

    >>> from slamlib.simulation import simulate, write_dataset
    >>> write_dataset("drive", *simulate("short", seed=1))
    >>> dataset = read_dataset("drive")
    >>> len(dataset.ticks), len(dataset.aruco.pose), dataset.antenna_guess.antenna.tolist()
    (2000, 894, [5, 13, 36, 46])
    """
    vehicle = _read_vehicle(folder, default=Vehicle())
    ticks = _read_ticks(folder, vehicle)
    aruco = _read_aruco(folder, len(ticks))
    antenna, position = _read_map(folder, "UwbAntennaGuess.txt", "antenna id, x, y")
    guess = AntennaGuess(antenna, position) if len(antenna) else None
    return Dataset(name=Path(abspath(folder)).name, vehicle=vehicle, ticks=ticks, aruco=aruco,
                   uwb=_read_uwb(folder, len(ticks), guess), antenna_guess=guess)


def read_truth(folder):
    """Truth of one drive, from the sub-folder `truth` of its folder, or None without it.

    Maps without a file have length 0. Wheel parameters that `truth/vehicle.toml` does not give are
    those of the dataset. Truth whose first pose is not the origin is moved there, and a doubt says
    so. Raises DatasetError if a file does not follow the format or has another number of poses than
    the drive.
    """
    truth_folder = find(folder, "truth")
    if truth_folder is None:
        return None
    vehicle = _read_vehicle(folder, default=Vehicle())
    pose_count = len(_read_ticks(folder, vehicle))
    path = find(truth_folder, "vehiclePose.txt", required=True)
    poses = _read_all_poses(path, "vehiclePose.txt", "pose id, x, y, theta")
    if len(poses) != pose_count:
        raise error(path, f"expected {pose_count} poses (encoder file), found {len(poses)}")
    marker, marker_in_world = _read_map(truth_folder, "ArucoMap.txt", "marker id, x, y, theta")
    antenna, antenna_in_world = _read_map(truth_folder, "UwbMap.txt", "antenna id, x, y")
    truth = Truth(poses=np.column_stack([poses[:, :2], np.unwrap(poses[:, 2])]),
                  marker=marker, marker_in_world=marker_in_world,
                  antenna=antenna, antenna_in_world=antenna_in_world,
                  vehicle=_read_vehicle(truth_folder, default=vehicle))
    return in_first_frame(truth)


def _read_vehicle(folder, default):
    path = find(folder, "vehicle.toml")
    if path is None:
        return default
    limits, values = LIMITS["vehicle.toml"], asdict(default)
    entries = read_toml(path, "wheelbase = 0.4", list(values))
    for key in sorted(entries, key=list(limits).index):    # a parameter before its sigma
        (value, line), limit = entries[key], limits[key]
        most = values.get(limit.most, limit.most)
        if type(value) not in (int, float) or not limit.least <= value <= most:
            raise error(path, f"expected {limit.expected(f'number for {key}')}, found "
                        f"{quoted(value)}", line)
        values[key] = float(value)
    return Vehicle(**values)


def _read_numbers(path, name, columns):
    """`read_table` of the file `name`, whose numbers are within LIMITS."""
    table, names = read_table(path, columns), columns.split(", ")
    for column, limit in LIMITS.get(name, {}).items():
        number = names.index(column)
        ok = (limit.least <= table[:, number]) & (table[:, number] <= limit.most)
        require(ok, path, limit.expected(column), number)
    return table


def _read_ticks(folder, vehicle):
    path = find(folder, "encoderReading.txt", required=True)
    ticks = _read_all_poses(path, "encoderReading.txt", "pose id, right ticks, left ticks")
    if len(ticks) == 0:
        raise error(path, "expected at least the row '1 0 0', found no rows")
    require((ticks == np.rint(ticks)).all(axis=1), path, "whole numbers of ticks")
    require(~ticks[:1].any(axis=1), path, "'1 0 0' as the first row (no step leads to pose 1)")
    most = MOST_REVOLUTIONS * vehicle.ticks_per_revolution
    require((abs(ticks) <= most).all(axis=1), path,
            f"at most {MOST_REVOLUTIONS} wheel revolutions ({most:g} ticks) in one step (counts "
            "since the previous pose, not since the start)")
    return ticks.astype(np.int64)


def _read_aruco(folder, pose_count):
    path, pose, marker, table = _read_readings(
        folder, "ArucoReading.txt", "pose id, marker id, x, y, theta, "
        "s_xx, s_xy, s_xtheta, s_yy, s_ytheta, s_thetatheta", pose_count)
    if len(table) == 0:
        return None
    covariance = table[:, [[3, 4, 5], [4, 6, 7], [5, 7, 8]]]
    # Scaled to correlations: s_thetatheta may be 1e4 rad^2 where s_xx is 1e-4 m^2.
    sigma = np.sqrt(table[:, [3, 6, 8]])
    correlation = covariance / (sigma[:, :, None] * sigma[:, None, :])
    smallest_eigenvalue = np.linalg.eigvalsh(correlation)[:, 0]
    require(smallest_eigenvalue > SMALLEST_EIGENVALUE, path, "a positive definite covariance "
            f"(smallest eigenvalue of its correlation matrix above {SMALLEST_EIGENVALUE:g})")
    return _in_order(ArucoReadings(pose, marker, table[:, :3], covariance), pose, marker, table)


def _read_uwb(folder, pose_count, antenna_guess):
    path, pose, antenna, table = _read_readings(
        folder, "UwbReading.txt", "pose id, antenna id, range, sigma", pose_count)
    if len(table) == 0:
        return None
    require(table[:, 0] >= -MOST_NEGATIVE * table[:, 1], path,
            f"a range that is not below -{MOST_NEGATIVE:g} sigma")
    if antenna_guess is None:
        raise error(path, "expected a UwbAntennaGuess.txt in the same folder, with every antenna")
    require(np.isin(antenna, antenna_guess.antenna), path, "an antenna id of UwbAntennaGuess.txt")
    return _in_order(UwbReadings(pose, antenna, table[:, 0], table[:, 1]), pose, antenna, table)


def _in_order(readings, pose, landmark, table):
    """The readings in ascending order of pose; rows of a file that repeat exactly count once."""
    _, rows = np.unique(np.column_stack([pose, landmark, table]), axis=0, return_index=True)
    rows = np.sort(rows)
    return readings.select(rows[np.argsort(pose[rows], kind="stable")])


def _read_all_poses(path, name, columns):
    """Columns (n, c - 1) beside the ids of all poses."""
    table = _read_numbers(path, name, columns)
    ids = np.arange(1, len(table) + 1)
    require(table[:, 0] == ids, path, "pose ids 1, 2, 3, ... in order")
    return table[:, 1:]


def _read_readings(folder, name, columns, pose_count):
    """Path, rows of poses (m,), landmark ids (m,) and the other columns (m, c - 2)."""
    path = find(folder, name)
    table = _read_numbers(path, name, columns)
    pose_id = _ids(table[:, 0], path)
    require((1 <= pose_id) & (pose_id <= pose_count), path, f"a pose id from 1 to {pose_count}")
    return path, pose_id - 1, _ids(table[:, 1], path), table[:, 2:]


def _read_map(folder, name, columns):
    """Landmark ids (k,), ascending, and the other columns (k, c - 1)."""
    path = find(folder, name)
    table = _read_numbers(path, name, columns)
    ids, first_row = np.unique(_ids(table[:, 0], path), return_index=True)
    require(np.isin(np.arange(len(table)), first_row), path, "each id only once")
    return ids, table[first_row, 1:]


def _ids(values, path):
    require(values == np.rint(values), path, "ids that are whole numbers")
    return values.astype(np.int64)
