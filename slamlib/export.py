"""Results as text files: trajectories in TUM format, and all poses and maps as CSV.

A line of a TUM file is `timestamp x y z qx qy qz qw`, the format of the TUM RGB-D benchmark that
evo and others read. The measurements have no times, so the time stamps are pose numbers, from 1.
Poses without an estimate are left out. Lengths are in metres, angles in radians.
"""

from io import BytesIO
from pathlib import Path

import numpy as np

from slamlib import swap
from slamlib.dataset import read_truth
from slamlib.evaluation import checked_poses
from slamlib.results import FIELDS, read_structs
from slamlib.textfile import DatasetError

POSES = "vehiclePose.mat"


def write_tum(path, poses):
    """Write poses (n, 3), which are NaN without an estimate, as a TUM file; z is 0.

    >>> write_tum("line.tum", np.array([[0, 0, 0], [np.nan, np.nan, np.nan], [2.5, 0, 0]]))
    >>> print(Path("line.tum").read_text(), end="")
    1 0 0 0 0 0 0 1
    3 2.5 0 0 0 0 0 1
    """
    poses, = checked_poses("write_tum", poses)
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    x, y, heading = poses[known].T
    zero = np.zeros(len(known))
    _write_lines(path, [known + 1, x, y, zero, zero, zero, np.sin(heading / 2),
                        np.cos(heading / 2)], " ")


def write_csv(path, ids, places, covariances=None):
    """Write ids (n,), poses (n, 3) or positions (n, 2), NaN if unknown, and covariances as CSV.

    The columns are id, x, y, theta and the upper triangle of the covariance in world axes.
    """
    known, names = np.isfinite(places[:, 0]), ("x", "y", "theta")[:places.shape[1]]
    columns, header = [ids[known], *places[known].T], ["id", *names]
    if covariances is not None:
        upper = np.triu_indices(len(names))
        columns += [*covariances[known][:, *upper].T]
        header += [f"s_{names[i]}{names[j]}" for i, j in zip(*upper)]
    _write_lines(path, columns, ",", ",".join(header))


def export_results(source, kind, out):
    """Write the results in the folder `source` as text into the folder `out`; returns the Paths.

    Parameters
    ----------
    source : folder of a dataset's results, of one problem's, or `truth` of a dataset.
    kind : "tum" writes trajectories, named by their problems as `problem3.tum`; "csv" a file for
        each .mat file, as `problem3/ArucoMap.csv`, in which a pose has its number as id.

    Raises
    ------
    DatasetError : there are no poses in the folder, or they cannot be read.
    """
    paths = []
    for name, tables in _found(Path(source)).items():
        for file, (ids, places, *covariances) in tables.items():
            if kind == "csv":
                paths.append(Path(out, name, f"{file}.csv"))
                write_csv(paths[-1], ids, places, *covariances)
            elif file == "vehiclePose":
                paths.append(Path(out, f"{name}.tum"))
                write_tum(paths[-1], places)
    return paths


def _found(source):
    """{problem or "truth": {name of a struct: ids, places and, of results, covariances}}."""
    if source.is_dir() and source.resolve().name.lower() == "truth":
        truth = read_truth(source.resolve().parent)
        return {"truth": {"vehiclePose": (np.arange(1, len(truth.poses) + 1), truth.poses),
                          "ArucoMap": (truth.marker, truth.marker_in_world),
                          "UwbMap": (truth.antenna, truth.antenna_in_world)}}
    folders = [source] if (source / POSES).is_file() else sorted(
        path.parent for path in source.glob(f"[!.]*/{POSES}"))
    if not folders:
        raise DatasetError(f"{source}: expected a folder with {POSES}, with sub-folders that have "
                           "one, or the folder truth of a dataset; found none of them")
    try:
        return {folder.resolve().name: {name: read_structs(folder, name) for name in FIELDS
                                        if (folder / f"{name}.mat").is_file()}
                for folder in folders}
    except Exception:  # scipy and numpy raise many kinds
        raise DatasetError(f"{source}: expected .mat files as slamlib writes them, found something "
                           "else") from None


def _write_lines(path, columns, delimiter, header=""):
    """Write numbers with all their digits, the ids first."""
    text = BytesIO()
    np.savetxt(text, np.column_stack(columns), header=header, comments="", delimiter=delimiter,
               fmt=["%d"] + ["%.17g"] * (len(columns) - 1))
    swap.write_atomically(Path(path), text.getvalue())
