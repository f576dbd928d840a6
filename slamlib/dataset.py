"""A folder of text files, read strictly into arrays.

One folder holds one drive of the vehicle: `encoderReading.txt` and, where the drive has them,
`ArucoReading.txt`, `UwbReading.txt` with `UwbAntennaGuess.txt`, a `vehicle.toml` with what differs
from table 2, and the `truth`. The columns stand at the call of `_read_table` for each file.

Lengths are metres, angles radians. Pose ids count from 1 in the files and from 0 in the arrays;
marker and antenna ids are labels and stay as they are. Blank lines and `#` comments are skipped.
Whatever else does not fit the format raises `DatasetError`, which says where and what was expected.
"""

import re
import tomllib
from dataclasses import dataclass, fields, replace
from difflib import get_close_matches
from itertools import islice
from os.path import abspath
from pathlib import Path

import numpy as np

ABSURD = 1e15  # no number of ours is this large, and below it float64 holds every integer
SMALLEST_SIGMA = 1e-9  # a standard deviation (or wheel parameter) below this counts as zero
SMALLEST_EIGENVALUE = 1e-12  # of a correlation matrix; below this it is singular
MOST_REVOLUTIONS = 10  # of a wheel, in one step
FILES = ("encoderReading.txt", "ArucoReading.txt", "UwbReading.txt", "UwbAntennaGuess.txt",
         "vehicle.toml", "truth")

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
CONTROL_BYTE = re.compile(rb"[\x00-\x08\x0e-\x1f]")


class DatasetError(ValueError):
    """A dataset does not follow the format; the message names file, line and expectation."""


@dataclass(frozen=True)
class Vehicle:
    """Wheel parameters and their standard deviations; the defaults are the assignment's table 2."""

    right_radius: float = 0.1  # m
    left_radius: float = 0.1  # m
    wheelbase: float = 0.4  # m
    ticks_per_revolution: float = 8000.0
    sigma_right_radius: float = 1e-4  # m
    sigma_left_radius: float = 1e-4  # m
    sigma_wheelbase: float = 1e-4  # m
    sigma_heading: float = 1e-4  # rad, of the heading at pose 1

    @property
    def wheel(self):
        """(3,) m, the wheel parameters R_R, R_L and b."""
        return np.array([self.right_radius, self.left_radius, self.wheelbase])

    @property
    def sigma_wheel(self):
        """(3,) m, their standard deviations."""
        return np.array([self.sigma_right_radius, self.sigma_left_radius, self.sigma_wheelbase])

    def with_wheel(self, wheel):
        """The vehicle with other wheel parameters (3,) in m, and the same standard deviations."""
        right, left, base = map(float, wheel)
        return replace(self, right_radius=right, left_radius=left, wheelbase=base)


@dataclass(frozen=True)
class ArucoReadings:
    """Sightings of markers, in ascending order of pose."""

    pose: np.ndarray  # (m,) int64, row of `Dataset.ticks`
    marker: np.ndarray  # (m,) int64, marker id
    marker_in_vehicle: np.ndarray  # (m, 3) [x, y, theta] in m, m, rad
    covariance: np.ndarray  # (m, 3, 3) of [x, y, theta] in the axes of the vehicle


@dataclass(frozen=True)
class UwbReadings:
    """Distances from antennas to the vehicle, in ascending order of pose."""

    pose: np.ndarray  # (m,) int64, row of `Dataset.ticks`
    antenna: np.ndarray  # (m,) int64, antenna id
    range: np.ndarray  # (m,) m
    sigma: np.ndarray  # (m,) m, standard deviation of the range


@dataclass(frozen=True)
class AntennaGuess:
    """Rough positions of the antennas, in ascending order of id."""

    antenna: np.ndarray  # (a,) int64, antenna id
    position: np.ndarray  # (a, 2) [x, y] in m


@dataclass(frozen=True)
class Dataset:
    """All that was measured on one drive."""

    name: str  # of the folder
    vehicle: Vehicle
    ticks: np.ndarray  # (n, 2) int64 [right, left]; row i leads from pose i-1 to pose i, row 0 is 0
    aruco: ArucoReadings | None
    uwb: UwbReadings | None
    antenna_guess: AntennaGuess | None

    def without(self, sensor):
        """The dataset without a sensor, "aruco" or "uwb"."""
        return replace(self, **{sensor: None})


@dataclass(frozen=True)
class Truth:
    """What the measurements would be without errors; known for simulated or surveyed drives."""

    poses: np.ndarray  # (n, 3) [x, y, theta] in m, m, rad; theta is continuous
    marker: np.ndarray  # (k,) int64, marker id, ascending
    marker_in_world: np.ndarray  # (k, 3) [x, y, theta] in m, m, rad
    antenna: np.ndarray  # (a,) int64, antenna id, ascending
    antenna_in_world: np.ndarray  # (a, 2) [x, y] in m
    vehicle: Vehicle


def dataset_names(data, names=None):
    """Names of the datasets in a folder: its sub-folders with any of FILES, or a selection.

    Parameters
    ----------
    data : str or Path
    names : list of str, optional
        The datasets wanted, all of them if None.

    Raises
    ------
    DatasetError
        There is no dataset, or none of a wanted name.
    """
    data = Path(data)
    known = {name.lower() for name in FILES}
    found = sorted(path.name for path in data.glob("[!.]*")
                   if path.is_dir() and any(file.name.lower() in known for file in path.iterdir()))
    if not found:
        raise DatasetError(f"{data}: expected a sub-folder with an encoderReading.txt, found none")
    for name in names or []:
        if name not in found and not (data / name).is_dir():
            raise DatasetError(f"{data}: expected one of {', '.join(found)}, found {_quote(name)}")
    for name in found if names is None else names:
        _find(data / name, "encoderReading.txt", required=True)
    return found if names is None else list(names)


def read_dataset(folder):
    """Read and check the measurements of one drive.

    Parameters
    ----------
    folder : str or Path
        Folder with the files named in the module's docstring; upper and lower case are the same.

    Returns
    -------
    Dataset
        Sensors without a file, or whose file has no rows, are None.

    Raises
    ------
    DatasetError
        At the first thing that does not follow the format.
    """
    vehicle = _read_vehicle(folder, default=Vehicle())
    ticks = _read_ticks(folder, vehicle)
    aruco = _read_aruco(folder, len(ticks))
    antenna_guess = _read_antenna_guess(folder)
    uwb = _read_uwb(folder, len(ticks), antenna_guess)
    return Dataset(Path(abspath(folder)).name, vehicle, ticks, aruco, uwb, antenna_guess)


def read_truth(folder):
    """Read and check the truth of one drive.

    Parameters
    ----------
    folder : str or Path
        Folder of the dataset; the truth is in its subfolder `truth`.

    Returns
    -------
    Truth or None
        None without such a subfolder. Maps without a file have length 0; wheel parameters not
        given in `truth/vehicle.toml` are those of the dataset.

    Raises
    ------
    DatasetError
        At the first thing that does not follow the format, and where the truth has not as many
        poses as the encoder file.
    """
    truth_folder = _find(folder, "truth")
    if truth_folder is None:
        return None
    vehicle = _read_vehicle(folder, default=Vehicle())
    pose_count = len(_read_ticks(folder, vehicle))
    path = _find(truth_folder, "vehiclePose.txt", required=True)
    table = _read_table(path, "pose id, x, y, theta")
    _require_pose_ids_in_order(table[:, 0], path)
    if len(table) != pose_count:
        raise _error(path, f"expected {pose_count} poses (encoder file), found {len(table)}")
    poses = np.column_stack([table[:, 1:3], np.unwrap(table[:, 3])])
    marker, marker_in_world = _read_map(truth_folder, "ArucoMap.txt", "marker id, x, y, theta")
    antenna, antenna_in_world = _read_map(truth_folder, "UwbMap.txt", "antenna id, x, y")
    vehicle = _read_vehicle(truth_folder, default=vehicle)
    return Truth(poses, marker, marker_in_world, antenna, antenna_in_world, vehicle)


# One function for each file.


def read_toml(path, example, known, encoding="ascii"):
    """The entries of a TOML file without tables.

    Parameters
    ----------
    path : Path
    example : str, an entry as it must be, for the message.
    known : list of str, the keys there may be.
    encoding : bytes of another one become '\\ufffd'.

    Returns
    -------
    dict from key to (value, line number or None).

    Raises
    ------
    DatasetError : not TOML, or another key.
    """
    text = _read_text(path, encoding)
    try:
        entries = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        reason, _, place = str(error).partition(" (at ")
        if at_line := re.match(r"line (\d+)", place):
            line = int(at_line[1])
        else:
            line = text.rstrip("\n").count("\n") + 1 if place == "end of document)" else None
        raise _error(path, f"expected TOML such as '{example}' ({reason})", line) from None
    for key, value in entries.items():
        at_key = re.search(rf"""^[\s\["']*{re.escape(key)}(?![\w-])""", text, re.MULTILINE)
        line = text.count("\n", 0, at_key.end()) + 1 if at_key else None
        if key not in known:
            raise _error(path, f"expected keys among {', '.join(known)}, found {_quote(key)}", line)
        entries[key] = value, line
    return entries


def _read_vehicle(folder, default):
    path = _find(folder, "vehicle.toml")
    if path is None:
        return default
    entries = read_toml(path, "wheelbase = 0.4", [field.name for field in fields(Vehicle)])
    for key, (value, line) in entries.items():
        if type(value) not in (int, float) or not SMALLEST_SIGMA <= value < ABSURD:
            raise _error(path, f"expected a positive number for {key}", line)
    return replace(default, **{key: float(value) for key, (value, _) in entries.items()})


def _read_ticks(folder, vehicle):
    path = _find(folder, "encoderReading.txt", required=True)
    table = _read_table(path, "pose id, right ticks, left ticks")
    if len(table) == 0:
        raise _error(path, "expected at least the row '1 0 0', found no rows")
    _require_pose_ids_in_order(table[:, 0], path)
    ticks = table[:, 1:]
    _require((ticks == np.rint(ticks)).all(axis=1), path, "whole numbers of ticks")
    _require(~ticks[:1].any(axis=1), path, "'1 0 0' as the first row (nothing leads to pose 1)")
    most = MOST_REVOLUTIONS * vehicle.ticks_per_revolution
    expected = (f"at most {MOST_REVOLUTIONS} wheel revolutions ({most:g} ticks) in one step (counts "
                "since the pose before, not since the start)")
    _require((abs(ticks) <= most).all(axis=1), path, expected)
    return ticks.astype(np.int64)


def _read_aruco(folder, pose_count):
    path = _find(folder, "ArucoReading.txt")
    columns = "pose id, marker id, x, y, theta, s_xx, s_xy, s_xtheta, s_yy, s_ytheta, s_thetatheta"
    table = _read_table(path, columns)
    if len(table) == 0:
        return None
    pose = _pose_rows(table[:, 0], pose_count, path)
    marker = _ids(table[:, 1], path)
    _require(abs(table[:, 4]) < 2 * np.pi + 1e-3, path, "an angle theta in radians (below 2 pi)")
    covariance = table[:, [[5, 6, 7], [6, 8, 9], [7, 9, 10]]]
    variance = table[:, [5, 8, 10]]
    is_positive = variance >= SMALLEST_SIGMA**2
    _require(is_positive.all(axis=1), path, "positive variances s_xx, s_yy and s_thetatheta")
    # Scaled to correlations, since s_thetatheta may be 1e4 rad^2 beside an s_xx of 1e-4 m^2.
    sigma = np.sqrt(variance)
    correlation = covariance / (sigma[:, :, None] * sigma[:, None, :])
    smallest_eigenvalue = np.linalg.eigvalsh(correlation)[:, 0]
    _require(smallest_eigenvalue > SMALLEST_EIGENVALUE, path, "a positive definite covariance")
    order = np.argsort(pose, kind="stable")
    return ArucoReadings(pose[order], marker[order], table[order, 2:5], covariance[order])


def _read_uwb(folder, pose_count, antenna_guess):
    path = _find(folder, "UwbReading.txt")
    table = _read_table(path, "pose id, antenna id, range, sigma")
    if len(table) == 0:
        return None
    pose = _pose_rows(table[:, 0], pose_count, path)
    antenna = _ids(table[:, 1], path)
    _require(table[:, 2] > 0, path, "a positive range")
    _require(table[:, 3] >= SMALLEST_SIGMA, path, "a positive sigma")
    if antenna_guess is None:
        raise _error(path, "expected a UwbAntennaGuess.txt beside it that has every antenna")
    _require(np.isin(antenna, antenna_guess.antenna), path, "an antenna id of UwbAntennaGuess.txt")
    order = np.argsort(pose, kind="stable")
    return UwbReadings(pose[order], antenna[order], table[order, 2], table[order, 3])


def _read_antenna_guess(folder):
    antenna, position = _read_map(folder, "UwbAntennaGuess.txt", "antenna id, x, y")
    return AntennaGuess(antenna, position) if len(antenna) else None


def _read_map(folder, name, columns):
    """Landmark ids (k,), ascending, and what stands beside them (k, c - 1)."""
    path = _find(folder, name)
    table = _read_table(path, columns)
    ids, first_row = np.unique(_ids(table[:, 0], path), return_index=True)
    _require(np.isin(np.arange(len(table)), first_row), path, "each id only once")
    return ids, table[first_row, 1:]


# Checks of whole columns. A file is read again for the line only when a check has failed.


def _require(ok, path, expected):
    """Raise DatasetError for the first row where ok (m,) is False."""
    if not ok.all():
        line, words = next(islice(_rows(_read_text(path)), int(np.argmin(ok)), None))
        raise _error(path, f"expected {expected}, found {_quote(' '.join(words))}", line)


def _require_pose_ids_in_order(pose_id, path):
    _require(pose_id == np.arange(1, len(pose_id) + 1), path, "pose ids 1, 2, 3, ... in order")


def _ids(values, path):
    _require(values == np.rint(values), path, "ids that are whole numbers")
    return values.astype(np.int64)


def _pose_rows(values, pose_count, path):
    pose_id = _ids(values, path)
    _require((1 <= pose_id) & (pose_id <= pose_count), path, f"a pose id from 1 to {pose_count}")
    return pose_id - 1


# From a folder to text, and from text to numbers.


def _find(folder, name, required=False):
    """Path of a file in the folder, whatever the case of its name; None if there is none.

    A name that is almost right is an error: the file would be silently left out.
    """
    try:
        there = {path: path.name.lower() for path in Path(folder).iterdir()}
    except (OSError, ValueError):  # ValueError: a NUL character in the folder's name
        raise _error(folder, "expected a folder that can be read") from None
    paths = [path for path, lower in there.items() if lower == name.lower()]
    if len(paths) > 1:
        names = " and ".join(sorted(path.name for path in paths))
        raise _error(Path(folder) / name, f"expected one file of this name, found {names}")
    if not paths and (almost := get_close_matches(name.lower(), there.values(), 1, cutoff=0.9)):
        wrong = next(path for path, lower in there.items() if lower == almost[0])
        raise _error(wrong, f"expected the name {name}")
    if required and not paths:
        raise _error(Path(folder) / name, "expected this file, found none")
    return paths[0] if paths else None


def _read_text(path, encoding="ascii"):
    """Text with line ends '\\n', and '\\ufffd' for every byte that is not of this encoding."""
    try:
        if not path.is_file():  # a folder, or a pipe that would wait for ever
            raise OSError
        data = path.read_bytes()
    except OSError:
        raise _error(path, "expected a file that can be read") from None
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if control := CONTROL_BYTE.search(data):
        line = data.count(b"\n", 0, control.start()) + 1
        raise _error(path, f"expected plain text, found the byte 0x{control[0].hex()}", line)
    return data.decode(encoding, errors="replace")


def _read_table(path, columns):
    """Numbers (m, c) of a file with c named columns; no rows if path is None."""
    columns = columns.split(", ")
    text = "" if path is None else _read_text(path)
    if not re.search(r"^[ \t\v\f]*[^#\s]", text, re.MULTILINE):
        return np.empty((0, len(columns)))
    try:
        table = np.loadtxt(text.split("\n"), comments="#", ndmin=2)
    except ValueError:
        table = np.full((1, 1), np.nan)
    if table.shape[1] != len(columns) or not (abs(table) < ABSURD).all():
        raise _table_error(path, text, columns)
    return table


def _table_error(path, text, columns):
    expected = f"expected {len(columns)} columns ({', '.join(columns)})"
    for line, words in _rows(text):
        if len(words) != len(columns):
            return _error(path, f"{expected}, found {len(words)}", line)
        for word in words:
            if not NUMBER.fullmatch(word) or abs(float(word)) >= ABSURD:
                what = f"expected finite numbers (below {ABSURD:g} in size), found {_quote(word)}"
                return _error(path, what, line)
    return _error(path, expected)  # numpy refuses what `NUMBER` accepts: never seen


def _rows(text):
    """Line number and words of every line that has more than a comment."""
    for line, content in enumerate(text.split("\n"), start=1):
        if words := content.partition("#")[0].split():
            yield line, words


def _error(path, what, line=None):
    return DatasetError(f"{path}{'' if line is None else f', line {line}'}: {what}")


def _quote(text, longest=60):
    return repr(text if len(text) <= longest else text[:longest] + "...")
