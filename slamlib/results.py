"""The files to hand in: MATLAB struct arrays with the assignment's field names.

Poses are [x, y, heading] and positions [x, y] in world axes, in m and rad. Covariances belong to
the same coordinates. The folder of a file is made if it does not exist.
"""

import os
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

_HEADER = b"MATLAB 5.0 MAT-file, written by slamlib".ljust(116)  # scipy's contains the date


def write_vehicle_poses(folder, poses, covariances):
    """Write folder/vehiclePose.mat: vehiclePose(k).pose, .covari for pose k of the encoder file.

    `poses` (n, 3) and `covariances` (n, 3, 3) are NaN where there is no estimate.
    """
    _write(Path(folder) / "vehiclePose.mat", pose=poses, covari=covariances)


def write_aruco_map(folder, ids, poses, covariances):
    """Write folder/ArucoMap.mat: ArucoMap(k).pose, .covari and .id, in ascending id.

    The marker `ids` (k,) ascend; `poses` are (k, 3) with headings in (-pi, pi], and `covariances`
    (k, 3, 3).
    """
    _write(Path(folder) / "ArucoMap.mat", pose=poses, covari=covariances, id=ids)


def write_uwb_map(folder, ids, positions, covariances):
    """Write folder/UwbMap.mat: UwbMap(k).position, .covariance and .id, in ascending id.

    The antenna `ids` (a,) ascend; `positions` are (a, 2) and `covariances` (a, 2, 2).
    """
    _write(Path(folder) / "UwbMap.mat", position=positions, covariance=covariances, id=ids)


def read_vehicle_poses(folder):
    """Poses (n, 3) and covariances (n, 3, 3) of folder/vehiclePose.mat."""
    return _read(Path(folder) / "vehiclePose.mat", pose=(3,), covari=(3, 3))


def read_aruco_map(folder):
    """Ids (k,), poses (k, 3) and covariances (k, 3, 3) of folder/ArucoMap.mat."""
    ids, *rest = _read(Path(folder) / "ArucoMap.mat", id=(), pose=(3,), covari=(3, 3))
    return ids.astype(int), *rest


def read_uwb_map(folder):
    """Ids (a,), positions (a, 2) and covariances (a, 2, 2) of folder/UwbMap.mat."""
    ids, *rest = _read(Path(folder) / "UwbMap.mat", id=(), position=(2,), covariance=(2, 2))
    return ids.astype(int), *rest


def write_atomically(path, content):
    """Write bytes to a Path; a reader finds the old file or the whole new one, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _write(path, **fields):
    """Write one (1, n) struct array, named like the file; equal input gives equal bytes."""
    structs = np.empty((1, len(next(iter(fields.values())))), dtype=[(f, object) for f in fields])
    for name, values in fields.items():
        rows = np.asarray(values, dtype=float)
        while rows.ndim < 3:  # vectors are 1 x d in MATLAB
            rows = rows[:, None]
        structs[name][0, :] = list(rows)
    buffer = BytesIO()
    savemat(buffer, {path.stem: structs})
    write_atomically(path, _HEADER + buffer.getvalue()[len(_HEADER):])


def _read(path, **shapes):
    """Fields of a struct array with n elements: a tuple of arrays (n, *shape)."""
    structs = loadmat(path)[path.stem]
    return tuple(np.reshape([*structs[name].ravel()], (-1, *shape))
                 for name, shape in shapes.items())
