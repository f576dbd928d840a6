"""The files to hand in: MATLAB struct arrays with the assignment's field names.

Poses are [x, y, heading] and positions [x, y] in world axes, in m and rad. Covariances belong to
the same coordinates.
"""

import struct
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

from slamlib import swap

_HEADER = b"MATLAB 5.0 MAT-file, written by slamlib".ljust(116)  # scipy's contains the date
SIZE_OFFSET, COUNT_OFFSET = 132, 164  # bytes, to the array's size and its number of columns
# Fields of the structs in each file: places, covariances and, of maps, ids.
FIELDS = {"vehiclePose": ("pose", "covari"), "ArucoMap": ("pose", "covari", "id"),
          "UwbMap": ("position", "covariance", "id")}
RESULT_FILES = tuple(f"{name}.mat" for name in FIELDS)  # of a problem's folder


def write_vehicle_poses(folder, poses, covariances):
    """Write folder/vehiclePose.mat: vehiclePose(k).pose, .covari for pose k of the encoder file.

    `poses` (n, 3) and `covariances` (n, 3, 3) are NaN where there is no estimate.
    """
    _write_structs(Path(folder) / "vehiclePose.mat", poses, covariances)


def write_map(folder, name, ids, places, covariances):
    """Write folder/ArucoMap.mat or UwbMap.mat (`name` without .mat), in ascending id.

    The `ids` (k,) ascend; `places` are poses (k, 3) with headings in (-pi, pi] or positions (k, 2),
    and `covariances` (k, 3, 3) or (k, 2, 2).
    """
    _write_structs(Path(folder) / f"{name}.mat", places, covariances, ids)


def read_vehicle_poses(folder):
    """Poses (n, 3) and covariances (n, 3, 3) of folder/vehiclePose.mat.

    >>> write_vehicle_poses("problem1", np.zeros((2, 3)), np.zeros((2, 3, 3)))
    >>> poses, covariances = read_vehicle_poses("problem1")
    >>> poses.shape, covariances.shape
    ((2, 3), (2, 3, 3))
    """
    return read_structs(folder, "vehiclePose")[1:]


def read_structs(folder, name):
    """Ids (n,), poses (n, 3) or positions (n, 2), and covariances of a file in a folder.

    `name` is a key of FIELDS. The ids of vehicle poses are 1 to n.
    """
    structs, d = loadmat(Path(folder) / f"{name}.mat")[name], 2 if name == "UwbMap" else 3
    rows = [np.reshape([*structs[field].ravel()], (-1, *shape))
            for field, shape in zip(FIELDS[name], ((d,), (d, d), ()))]
    ids = rows[2].astype(int) if len(rows) > 2 else np.arange(1, len(rows[0]) + 1)
    return ids, rows[0], rows[1]


def _write_structs(path, *columns):
    """Write one (1, n) struct array, named like the file; equal input gives equal bytes.

    scipy writes many structs slowly, one by one. Here it writes the first one, whose bytes are
    repeated with the numbers of the others: each field is a header of 56 bytes and its numbers by
    columns. The array's size and number of columns are set (MAT-File Format, version 5).
    """
    rows = dict(zip(FIELDS[path.stem], map(_matrices, columns)))
    count = len(next(iter(rows.values())))
    first = np.empty((1, min(count, 1)), dtype=[(name, object) for name in rows])
    for name, values in rows.items():
        first[name][0, :] = list(values[:1])
    buffer = BytesIO()
    savemat(buffer, {path.stem: first})
    content = bytearray(_HEADER + buffer.getvalue()[len(_HEADER):])
    if count > 1:
        layout = np.dtype([entry for name, values in rows.items() for entry in (
            (f"header of {name}", "V56"), (name, "=f8", values.shape[:0:-1]))])
        structs = np.repeat(np.frombuffer(content[-layout.itemsize:], layout), count)
        for name, values in rows.items():
            structs[name] = np.swapaxes(values, 1, 2)
        size, = struct.unpack_from("=I", content, SIZE_OFFSET)
        struct.pack_into("=I", content, SIZE_OFFSET, size + (count - 1) * layout.itemsize)
        struct.pack_into("=i", content, COUNT_OFFSET, count)
        content[-layout.itemsize:] = structs.tobytes()
    swap.write_atomically(path, content)


def _matrices(values):
    """Scalars (n,), vectors (n, d) or matrices (n, c, d) as (n, c, d); vectors are 1 x d."""
    rows = np.asarray(values, dtype=float)
    return rows.reshape(len(rows), *(1,) * (3 - rows.ndim), *rows.shape[1:])
