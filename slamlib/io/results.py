"""The files to hand in: MATLAB struct arrays with the assignment's field names; TUM files for evo.

Poses are [x, y, heading] and positions [x, y] in world axes, in m and rad. Covariances belong to
the same coordinates. A line of a TUM file is `timestamp x y z qx qy qz qw`, the format of the TUM
RGB-D benchmark. The measurements have no times, so the time stamps are pose ids, from 1.
"""

import json
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
_HEADER = b"MATLAB 5.0 MAT-file, written by slamlib".ljust(116)  # scipy's contains the date
FIELD_HEADER = "V56"  # bytes before the numbers of a field of a struct
SIZE_WORD = 33  # of 4 bytes: the size of the array of structs
COUNT_WORD = 41  # its number of columns


def write_solution(folder: Path, solution) -> list[Path]:
    """Write the .mat files of a Solution into folder/<problem>/, and return their paths."""
    own = folder / solution.problem
    poses = None, solution.poses, solution.covariances
    structs = {"vehiclePose": poses} | solution.maps
    for name, values in structs.items():
        write_structs(own, name, *values)
    return [own / f"{name}.mat" for name in structs]


def write_summary(folder: Path, summary: dict):
    """Write the summary of a results folder, which is whole from then on."""
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    write_file(folder / SUMMARY, f"{text}\n".encode(errors="backslashreplace"))


def read_summary(folder: Path | str) -> dict:
    """Return the summary of a results folder.

    Raises DatasetError if there is none, as of a run that was killed or has not ended.
    """
    path = Path(folder) / SUMMARY
    require(path.is_file(), path,
            "this file, which a run writes last, found none: solve the dataset again")
    return json.loads(path.read_bytes())


def read_structs(folder: Path | str, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ids (n,), poses (n, 3) or positions (n, 2), and covariances of a file in a folder.

    `name` is a key of FIELDS. The ids of vehicle poses are 1 to n.

    >>> write_structs("problem1", "vehiclePose", None, np.zeros((2, 3)), np.zeros((2, 3, 3)))
    >>> ids, poses, covariances = read_structs("problem1", "vehiclePose")
    >>> ids.tolist(), poses.shape, covariances.shape
    ([1, 2], (2, 3), (2, 3, 3))
    """
    file = Path(folder) / f"{name}.mat"
    structs = loadmat(file)[name].ravel()
    place, covariance, *label = FIELDS[name]
    places = np.concatenate(structs[place])
    ids = np.arange(1, len(places) + 1)
    if label:
        ids = np.concatenate(structs["id"]).ravel().astype(int)
    return ids, places, np.stack(structs[covariance])


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
        numbers[field] = np.reshape(values, (count, *shape))
        entries += [(f"header of {field}", FIELD_HEADER), (field, "=f8", shape[::-1])]  # by columns
    layout = np.dtype(entries)
    buffer = BytesIO()
    savemat(buffer, {name: zeros})
    content = bytearray(buffer.getvalue())
    content[:len(_HEADER)] = _HEADER
    structs = np.repeat(np.frombuffer(content[-layout.itemsize:], layout), count)
    for field, values in numbers.items():
        structs[field] = np.swapaxes(values, 1, 2)
    words = np.frombuffer(content, "=i4", COUNT_WORD + 1)
    words[SIZE_WORD] += (count - 1) * layout.itemsize
    words[COUNT_WORD] = count
    write_file(Path(folder) / f"{name}.mat", content[:-layout.itemsize] + structs.tobytes())


def write_tum(path: Path | str, poses: np.ndarray):
    """Write poses (n, 3), of which those with NaN are left out, as a TUM file; z is 0.

    >>> write_tum("line.tum", np.array([[0, 0, 0], [np.nan, np.nan, np.nan], [2.5, 0, 0]]))
    >>> print(Path("line.tum").read_text(), end="")
    1 0 0 0 0 0 0 1
    3 2.5 0 0 0 0 0 1
    """
    ids = np.arange(1, len(poses) + 1)
    no_z_qx_qy = np.zeros_like(poses)
    half = poses[:, 2] / 2
    rows = np.column_stack([ids, poses[:, :2], no_z_qx_qy, np.sin(half), np.cos(half)])
    text = BytesIO()
    np.savetxt(text, rows[np.isfinite(half)], fmt="%.17g")
    write_file(Path(path), text.getvalue())
