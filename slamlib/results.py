"""The files to hand in: MATLAB struct arrays with the assignment's field names.

Poses are [x, y, heading] and positions [x, y] in world axes, in m and rad. Covariances belong to
the same coordinates. Writing makes the folder of a file. Reading raises `swap.UnfinishedError` if a
run ended while it wrote the files of the folder or of its parent.
"""

import struct
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

from slamlib import swap

_HEADER = b"MATLAB 5.0 MAT-file, written by slamlib".ljust(116)  # scipy's contains the date
SIZE_OFFSET, COUNT_OFFSET = 132, 164  # bytes, to the array's size and its number of columns
RESULT_FILES = ("vehiclePose.mat", "ArucoMap.mat", "UwbMap.mat")  # of a problem's folder
MAX_STRUCTS_BY_SCIPY = 100  # number of structs above which `_tiled` writes them


def write_vehicle_poses(folder, poses, covariances):
    """Write folder/vehiclePose.mat: vehiclePose(k).pose, .covari for pose k of the encoder file.

    `poses` (n, 3) and `covariances` (n, 3, 3) are NaN where there is no estimate.
    """
    _write_structs(Path(folder) / "vehiclePose.mat", pose=poses, covari=covariances)


def write_aruco_map(folder, ids, poses, covariances):
    """Write folder/ArucoMap.mat: ArucoMap(k).pose, .covari and .id, in ascending id.

    The marker `ids` (k,) ascend; `poses` are (k, 3) with headings in (-pi, pi], and `covariances`
    (k, 3, 3).
    """
    _write_structs(Path(folder) / "ArucoMap.mat", pose=poses, covari=covariances, id=ids)


def write_uwb_map(folder, ids, positions, covariances):
    """Write folder/UwbMap.mat: UwbMap(k).position, .covariance and .id, in ascending id.

    The antenna `ids` (a,) ascend; `positions` are (a, 2) and `covariances` (a, 2, 2).
    """
    _write_structs(Path(folder) / "UwbMap.mat", position=positions, covariance=covariances, id=ids)


def read_vehicle_poses(folder):
    """Poses (n, 3) and covariances (n, 3, 3) of folder/vehiclePose.mat.

    >>> write_vehicle_poses("problem1", np.zeros((2, 3)), np.zeros((2, 3, 3)))
    >>> poses, covariances = read_vehicle_poses("problem1")
    >>> poses.shape, covariances.shape
    ((2, 3), (2, 3, 3))
    """
    return _read_structs(Path(folder) / "vehiclePose.mat", pose=(3,), covari=(3, 3))


def read_aruco_map(folder):
    """Ids (k,), poses (k, 3) in m and rad, and covariances (k, 3, 3) of folder/ArucoMap.mat."""
    ids, *rest = _read_structs(Path(folder) / "ArucoMap.mat", id=(), pose=(3,), covari=(3, 3))
    return ids.astype(int), *rest


def read_uwb_map(folder):
    """Ids (a,), positions (a, 2) in m and covariances (a, 2, 2) of folder/UwbMap.mat."""
    ids, *rest = _read_structs(Path(folder) / "UwbMap.mat", id=(), position=(2,), covariance=(2, 2))
    return ids.astype(int), *rest


def _write_structs(path, **fields):
    """Write one (1, n) struct array, named like the file; equal input gives equal bytes."""
    rows = {name: _matrices(values) for name, values in fields.items()}
    count = len(next(iter(rows.values())))
    content = _tiled(path.stem, rows) if count > MAX_STRUCTS_BY_SCIPY else _saved(path.stem, rows)
    swap.write_atomically(path, _HEADER + content[len(_HEADER):])


def _matrices(values):
    """Scalars (n,), vectors (n, d) or matrices (n, c, d) as (n, c, d); vectors are 1 x d."""
    rows = np.asarray(values, dtype=float)
    while rows.ndim < 3:
        rows = rows[:, None]
    return rows


def _saved(name, rows):
    """The bytes that scipy writes for a struct array."""
    count = len(next(iter(rows.values())))
    structs = np.empty((1, count), dtype=[(field, object) for field in rows])
    for field, values in rows.items():
        structs[field][0, :] = list(values)
    buffer = BytesIO()
    savemat(buffer, {name: structs})
    return buffer.getvalue()


def _tiled(name, rows):
    """The bytes of `_saved` for many structs; scipy writes these slowly, one by one.

    All elements of the array have the same layout. Files by scipy with one and two of them give the
    length of an element, and known numbers in them the offset of each number. The array's
    dimensions and size contain the count (MAT-File Format, version 5).
    """
    count = len(next(iter(rows.values())))
    known = iter(np.pi * np.arange(1, 1000))
    one = {field: np.reshape([next(known) for _ in values[0].flat], (1, *values.shape[1:]))
           for field, values in rows.items()}
    first, second = _saved(name, one), _saved(
        name, {field: np.repeat(values, 2, axis=0) for field, values in one.items()})
    length = len(second) - len(first)
    head, element = bytearray(first[:-length]), first[-length:]
    size, = struct.unpack_from("=I", head, SIZE_OFFSET)
    struct.pack_into("=I", head, SIZE_OFFSET, size + (count - 1) * length)
    struct.pack_into("=i", head, COUNT_OFFSET, count)
    elements = np.tile(np.frombuffer(element, np.uint8), (count, 1))
    for field, values in rows.items():
        for number, column in zip(one[field].flat, values.reshape(count, -1).T):
            offset = element.index(struct.pack("=d", number))
            elements[:, offset:offset + 8] = np.ascontiguousarray(column)[:, None].view(np.uint8)
    return bytes(head) + elements.tobytes()


def _read_structs(path, **shapes):
    """Fields of a struct array with n elements: a tuple of arrays (n, *shape)."""
    for folder in (path.parent, path.parent.parent):
        swap.require_finished(folder)
    structs = loadmat(path)[path.stem]
    return tuple(np.reshape([*structs[name].ravel()], (-1, *shape))
                 for name, shape in shapes.items())
