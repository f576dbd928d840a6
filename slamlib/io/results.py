"""The files to hand in: MATLAB struct arrays with the assignment's field names; the same as text.

Poses are [x, y, heading] and positions [x, y] in world axes, in m and rad. Covariances belong to
the same coordinates. A line of a TUM file is `timestamp x y z qx qy qz qw`, the format of the TUM
RGB-D benchmark that evo and others read. The measurements have no times, so the time stamps are
pose ids, from 1. Text files leave out poses without an estimate.
"""

from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

from slamlib.io import swap

_HEADER = b"MATLAB 5.0 MAT-file, written by slamlib".ljust(116)  # scipy's contains the date
SIZE_OFFSET, COUNT_OFFSET = 132, 164  # bytes, to the array's size and its number of columns
# Fields of the structs in each file: places, covariances and, of maps, ids.
FIELDS = {"vehiclePose": ("pose", "covari"), "ArucoMap": ("pose", "covari", "id"),
          "UwbMap": ("position", "covariance", "id")}
RESULT_FILES = tuple(f"{name}.mat" for name in FIELDS)  # of a problem's folder
SUMMARY = "summary.json"


def write_solution(folder, solution, text=False):
    """Write the .mat files of a Solution into folder/<problem>/; returns the Path of that folder.

    With `text` it writes CSV files beside them, too, and folder/<problem>.tum. A summary in
    `folder` is removed, because it belongs to other files.
    """
    (Path(folder) / SUMMARY).unlink(missing_ok=True)
    own = Path(folder) / solution.problem
    poses = np.arange(1, len(solution.poses) + 1), solution.poses, solution.covariances
    for name, each in zip(FIELDS, (poses, solution.aruco_map, solution.uwb_map)):
        if each is not None:
            write_structs(own, name, *each)
            if text:
                write_csv(own / f"{name}.csv", *each)
    if text:
        write_tum(own.with_suffix(".tum"), solution.poses)
    return own


def read_structs(folder, name):
    """Ids (n,), poses (n, 3) or positions (n, 2), and covariances of a file in a folder.

    `name` is a key of FIELDS. The ids of vehicle poses are 1 to n.

    >>> write_structs("problem1", "vehiclePose", None, np.zeros((2, 3)), np.zeros((2, 3, 3)))
    >>> ids, poses, covariances = read_structs("problem1", "vehiclePose")
    >>> ids.tolist(), poses.shape, covariances.shape
    ([1, 2], (2, 3), (2, 3, 3))
    """
    structs, d = loadmat(Path(folder) / f"{name}.mat")[name], 2 if name == "UwbMap" else 3
    rows = [np.reshape([*structs[field].ravel()], (-1, *shape))
            for field, shape in zip(FIELDS[name], ((d,), (d, d), ()))]
    ids = rows[2].astype(int) if len(rows) > 2 else np.arange(1, len(rows[0]) + 1)
    return ids, rows[0], rows[1]


def write_structs(folder, name, ids, places, covariances):
    """Write folder/name.mat with one (1, n) struct array; equal input gives equal bytes.

    `name` is a key of FIELDS. The ids (n,) of maps ascend, those of vehicle poses are not written;
    `places` are poses (n, 3), of markers with headings in (-pi, pi], or positions (n, 2);
    `covariances` are (n, 3, 3) or (n, 2, 2). They are NaN where there is no estimate.

    scipy writes many structs slowly, one by one. Here it writes one of zeros, whose bytes are
    repeated with the numbers: each field is a header of 56 bytes and its numbers by columns. The
    array's size and number of columns are set (MAT-File Format, version 5).
    """
    buffer, (count, d) = BytesIO(), np.shape(places)
    columns = zip(FIELDS[name], (places, covariances, ids), ((1, d), (d, d), (1, 1)))
    rows = {field: np.reshape(values, (count, *shape)).astype(float)
            for field, values, shape in columns}
    savemat(buffer, {name: {field: np.zeros(values.shape[1:]) for field, values in rows.items()}})
    content = bytearray(_HEADER + buffer.getvalue()[len(_HEADER):])
    layout = np.dtype([entry for field, values in rows.items() for entry in (
        (f"header of {field}", "V56"), (field, "=f8", values.shape[:0:-1]))])
    structs = np.repeat(np.frombuffer(content[-layout.itemsize:], layout), count)
    for field, values in rows.items():
        structs[field] = np.swapaxes(values, 1, 2)
    np.frombuffer(content, "=i4", 1, SIZE_OFFSET)[0] += (count - 1) * layout.itemsize
    np.frombuffer(content, "=i4", 1, COUNT_OFFSET)[0] = count
    swap.write_atomically(Path(folder) / f"{name}.mat",
                          content[:-layout.itemsize] + structs.tobytes())


def write_tum(path, poses):
    """Write poses (n, 3), which are NaN without an estimate, as a TUM file; z is 0.

    >>> write_tum("line.tum", np.array([[0, 0, 0], [np.nan, np.nan, np.nan], [2.5, 0, 0]]))
    >>> print(Path("line.tum").read_text(), end="")
    1 0 0 0 0 0 0 1
    3 2.5 0 0 0 0 0 1
    """
    x, y, heading = np.transpose(poses)
    zero = np.zeros(len(poses))
    _write_text(path, np.arange(1, len(poses) + 1), [
        x, y, zero, zero, zero, np.sin(heading / 2), np.cos(heading / 2)], " ")


def write_csv(path, ids, places, covariances):
    """Write ids (n,), poses (n, 3) or positions (n, 2), NaN if unknown, and covariances as CSV.

    The columns are id, x, y, theta and the upper triangle of the covariance in world axes.
    """
    names, upper = ("x", "y", "theta")[:places.shape[1]], np.triu_indices(places.shape[1])
    header = ["id", *names, *(f"s_{names[i]}{names[j]}" for i, j in zip(*upper))]
    _write_text(path, ids, [*places.T, *covariances[:, *upper].T], ",", ",".join(header))


def _write_text(path, ids, columns, delimiter, header=""):
    """Write ids (n,) and columns, numbers (n,) with all their digits, without rows of NaN."""
    text, known = BytesIO(), np.isfinite(columns[0])
    np.savetxt(text, np.column_stack([ids, *columns])[known], header=header, comments="",
               delimiter=delimiter, fmt=["%d"] + ["%.17g"] * len(columns))
    swap.write_atomically(Path(path), text.getvalue())
