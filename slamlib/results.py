"""The deliverables: MATLAB files with struct arrays, as the assignment names their fields."""

import os
from io import BytesIO
from pathlib import Path

import numpy as np
from scipy.io import loadmat, savemat

_HEADER = b"MATLAB 5.0 MAT-file, written by slamlib".ljust(116)


def write_vehicle_poses(folder, poses, covariances):
    """Write folder/vehiclePose.mat: vehiclePose(k).pose, .covari for pose k of the encoder file.

    Parameters
    ----------
    folder : path, made if it does not exist.
    poses : (n, 3) [x, y, heading] in world axes, m and rad; NaN where there is no estimate.
    covariances : (n, 3, 3) of [x, y, heading] in world axes.
    """
    _write(Path(folder) / "vehiclePose.mat", pose=poses, covari=covariances)


def write_aruco_map(folder, ids, poses, covariances):
    """Write folder/ArucoMap.mat: ArucoMap(k).pose, .covari and .id, in ascending id.

    Parameters
    ----------
    folder : path, made if it does not exist.
    ids : (k,) marker ids, ascending.
    poses : (k, 3) [x, y, heading] in world axes, headings in (-pi, pi].
    covariances : (k, 3, 3) of [x, y, heading] in world axes.
    """
    _write(Path(folder) / "ArucoMap.mat", pose=poses, covari=covariances, id=ids)


def write_uwb_map(folder, ids, positions, covariances):
    """Write folder/UwbMap.mat: UwbMap(k).position, .covariance and .id, in ascending id.

    Parameters
    ----------
    folder : path, made if it does not exist.
    ids : (a,) antenna ids, ascending.
    positions : (a, 2) [x, y] in world axes, m.
    covariances : (a, 2, 2) of [x, y].
    """
    _write(Path(folder) / "UwbMap.mat", position=positions, covariance=covariances, id=ids)


def read_uwb_map(folder):
    """Ids (a,), positions (a, 2) and covariances (a, 2, 2) of a UwbMap.mat."""
    content = _read(Path(folder) / "UwbMap.mat")
    return (content["id"].astype(int).ravel(), content["position"].reshape(-1, 2),
            content["covariance"].reshape(-1, 2, 2))


def read_aruco_map(folder):
    """Ids (k,), poses (k, 3) and covariances (k, 3, 3) of an ArucoMap.mat."""
    content = _read(Path(folder) / "ArucoMap.mat")
    return content["id"].astype(int).ravel(), *_poses_and_covariances(content)


def read_vehicle_poses(folder):
    """Poses (n, 3) and covariances (n, 3, 3) of a vehiclePose.mat."""
    return _poses_and_covariances(_read(Path(folder) / "vehiclePose.mat"))


def _poses_and_covariances(content):
    return content["pose"].reshape(-1, 3), content["covari"].reshape(-1, 3, 3)


def write_atomically(path, content):
    """Write bytes to path so that it is the old file or the whole new one, never a part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_bytes(content)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def _write(path, **fields):
    """One (1, n) struct array, named like the file; equal input gives equal bytes."""
    length = len(next(iter(fields.values())))
    structs = np.empty((1, length), dtype=[(name, object) for name in fields])
    for name, values in fields.items():
        rows = np.asarray(values, dtype=float)
        while rows.ndim < 3:                                      # vectors are 1 x d in MATLAB
            rows = rows[:, None]
        structs[name][0, :] = list(rows)
    buffer = BytesIO()
    savemat(buffer, {path.stem: structs})
    content = buffer.getvalue()
    write_atomically(path, _HEADER + content[len(_HEADER):])      # scipy's header has the date


def _read(path):
    """Fields of a struct array, stacked: {name: (length, 1, d) or (length, d, d)}."""
    structs = loadmat(path)[path.stem]
    return {name: np.stack([*structs[name].ravel()]) if structs.size else np.zeros((0, 1, 0))
            for name in structs.dtype.names}
