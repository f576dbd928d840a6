"""The files to hand in: MATLAB struct arrays with the assignment's field names; the same as text.

Poses are [x, y, heading] and positions [x, y] in world axes, in m and rad. Covariances belong to
the same coordinates. A line of a TUM file is `timestamp x y z qx qy qz qw`, the format of the TUM
RGB-D benchmark that evo and others read. The measurements have no times, so the time stamps are
pose ids, from 1. Text files leave out poses without an estimate.
"""

import json
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

from slamlib.core.errors import require
from slamlib.io.files import write_file

SUMMARY = "summary.json"
# Fields of the structs in each file: places, covariances and, of maps, ids.
FIELDS = {"vehiclePose": ("pose", "covari"), "ArucoMap": ("pose", "covari", "id"),
          "UwbMap": ("position", "covariance", "id")}
RESULT_FILES = tuple(f"{name}.mat" for name in FIELDS)  # of a problem's folder
TEXT_FILES = tuple(f"{name}.csv" for name in FIELDS)
_HEADER = b"MATLAB 5.0 MAT-file, written by slamlib".ljust(116)  # scipy's contains the date
FIELD_HEADER = "V56"  # bytes before the numbers of a field of a struct
SIZE_OFFSET = 132  # bytes, to the size of the array of structs
COUNT_OFFSET = 164  # bytes, to its number of columns


def write_solution(folder: Path | str, solution, text: bool = False) -> Path:
    """Write the .mat files of a Solution into folder/<problem>/; returns that folder.

    With `text` it writes CSV files beside them, too, and folder/<problem>.tum.
    """
    own = Path(folder) / solution.problem
    poses = (_pose_ids(solution.poses), solution.poses, solution.covariances)
    for name, each in zip(FIELDS, (poses, solution.aruco_map, solution.uwb_map)):
        if each is None:
            continue
        ids, places, covariances = each
        write_structs(own, name, ids, places, covariances)
        if text:
            write_csv(own / f"{name}.csv", ids, places, covariances)
    if text:
        write_tum(own.with_suffix(".tum"), solution.poses)
    return own


def file_names(problem: str) -> list[str]:
    """Names of all files that a problem may have in a results folder."""
    return [f"{problem}.tum"] + [f"{problem}/{name}" for name in RESULT_FILES + TEXT_FILES]


def write_summary(folder: Path | str, summary: dict):
    """Write the summary of a results folder, which is whole from then on."""
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    write_file(Path(folder) / SUMMARY, f"{text}\n".encode(errors="backslashreplace"))


def read_summary(folder: Path | str) -> dict:
    """Return the summary of a results folder.

    Raises DatasetError if there is none, as of a run that was killed or has not ended.
    """
    path = Path(folder) / SUMMARY
    summary = None
    with suppress(OSError, ValueError):
        summary = json.loads(path.read_bytes())
    require(isinstance(summary, dict) and "problems" in summary, path, "this file, which a run "
            "writes last, found none that is whole: solve the dataset again")
    return summary


def _pose_ids(poses):
    return np.arange(1, len(poses) + 1)


def read_structs(folder: Path | str, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ids (n,), poses (n, 3) or positions (n, 2), and covariances of a file in a folder.

    `name` is a key of FIELDS. The ids of vehicle poses are 1 to n.

    >>> write_structs("problem1", "vehiclePose", None, np.zeros((2, 3)), np.zeros((2, 3, 3)))
    >>> ids, poses, covariances = read_structs("problem1", "vehiclePose")
    >>> ids.tolist(), poses.shape, covariances.shape
    ([1, 2], (2, 3), (2, 3, 3))
    """
    structs = loadmat(Path(folder) / f"{name}.mat")[name]
    values = [np.array(structs[field].ravel().tolist()) for field in FIELDS[name]]
    d = 2 if name == "UwbMap" else 3
    places = values[0].reshape(-1, d)
    covariances = values[1].reshape(-1, d, d)
    if "id" in FIELDS[name]:
        return values[2].ravel().astype(int), places, covariances
    return _pose_ids(places), places, covariances


def write_structs(folder: Path | str, name: str, ids: np.ndarray | None, places: np.ndarray,
                  covariances: np.ndarray):
    """Write folder/name.mat with one (1, n) struct array; equal input gives equal bytes.

    `name` is a key of FIELDS. The ids (n,) of maps ascend, those of vehicle poses are not written;
    `places` are poses (n, 3), of markers with headings in (-pi, pi], or positions (n, 2);
    `covariances` are (n, 3, 3) or (n, 2, 2). They are NaN where there is no estimate.

    scipy writes many structs slowly, one by one. Here it writes one of zeros, whose bytes are
    repeated with the numbers: each field is a header of 56 bytes and its numbers by columns. The
    array's size and number of columns are set (MAT-File Format, version 5).
    """
    count, d = np.shape(places)
    zeros = {}
    numbers = {}
    entries = []
    for field, values, shape in zip(
            FIELDS[name], (places, covariances, ids), ((1, d), (d, d), (1, 1))):
        zeros[field] = np.zeros(shape)
        numbers[field] = np.reshape(values, (count,) + shape)
        entries.append((f"header of {field}", FIELD_HEADER))
        entries.append((field, "=f8", shape[::-1]))            # by columns
    layout = np.dtype(entries)
    buffer = BytesIO()
    savemat(buffer, {name: zeros})
    content = bytearray(buffer.getvalue())
    content[:len(_HEADER)] = _HEADER
    structs = np.repeat(np.frombuffer(content[-layout.itemsize:], layout), count)
    for field, values in numbers.items():
        structs[field] = np.swapaxes(values, 1, 2)
    size = np.frombuffer(content, "=i4", 1, SIZE_OFFSET)
    size += (count - 1) * layout.itemsize
    columns = np.frombuffer(content, "=i4", 1, COUNT_OFFSET)
    columns[:] = count
    before = content[:-layout.itemsize]
    write_file(Path(folder) / f"{name}.mat", before + structs.tobytes())


def write_tum(path: Path | str, poses: np.ndarray):
    """Write poses (n, 3), which are NaN without an estimate, as a TUM file; z is 0.

    >>> write_tum("line.tum", np.array([[0, 0, 0], [np.nan, np.nan, np.nan], [2.5, 0, 0]]))
    >>> print(Path("line.tum").read_text(), end="")
    1 0 0 0 0 0 0 1
    3 2.5 0 0 0 0 0 1
    """
    half = poses[:, 2] / 2
    columns = {"x": poses[:, 0], "y": poses[:, 1], "z": 0, "qx": 0, "qy": 0, "qz": np.sin(half),
               "qw": np.cos(half)}
    _write_text(path, _pose_ids(poses), columns, sep=" ", header=False)


def write_csv(path: Path | str, ids: np.ndarray, places: np.ndarray, covariances: np.ndarray):
    """Write ids (n,), poses (n, 3) or positions (n, 2), NaN if unknown, and covariances as CSV.

    The columns are id, x, y, theta and the upper triangle of the covariance in world axes.
    """
    names = ["x", "y", "theta"][:places.shape[1]]
    columns = dict(zip(names, places.T))
    for i, j in zip(*np.triu_indices(len(names))):
        columns[f"s_{names[i]}{names[j]}"] = covariances[:, i, j]
    _write_text(path, ids, columns, index_label="id")


def _write_text(path, ids, columns, **form):
    """Write ids (n,) and columns (dict) with all their digits, without rows that have NaN."""
    from pandas import DataFrame  # here, because it is the slowest import of all
    rows = DataFrame(columns, index=ids).dropna()
    text = rows.to_csv(float_format="%.17g", lineterminator="\n", **form)
    write_file(Path(path), text.encode())
