"""Trajectories as text files: TUM format and comma-separated values.

A line of a TUM file is `timestamp x y z qx qy qz qw`, the format of the TUM RGB-D benchmark that
evo and others read. The measurements have no times, so the time stamps are pose numbers, from 1.
Poses without an estimate are left out. Lengths are in metres, angles in radians.
"""

from io import BytesIO
from pathlib import Path

import numpy as np

from slamlib import swap
from slamlib.dataset import read_truth
from slamlib.results import read_vehicle_poses
from slamlib.textfile import DatasetError

POSES = "vehiclePose.mat"
POSE_HEADER = "pose,x,y,theta"
COVARIANCE_HEADER = ",s_xx,s_xy,s_xtheta,s_yy,s_ytheta,s_thetatheta"


def write_tum(path, poses):
    """Write poses (n, 3), which are NaN without an estimate, as a TUM file; z is 0.

    >>> write_tum("line.tum", np.array([[0, 0, 0], [np.nan, np.nan, np.nan], [2.5, 0, 0]]))
    >>> print(Path("line.tum").read_text(), end="")
    1 0 0 0 0 0 0 1
    3 2.5 0 0 0 0 0 1
    """
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    x, y, heading = poses[known].T
    zero = np.zeros(len(known))
    _write_lines(path, [known + 1, x, y, zero, zero, zero, np.sin(heading / 2),
                        np.cos(heading / 2)], " ")


def write_csv(path, poses, covariances=None):
    """Write poses (n, 3), NaN without an estimate, as comma-separated values with a header.

    Their covariances (n, 3, 3) in world axes, if given, are further columns.
    """
    known = np.flatnonzero(np.isfinite(poses[:, 0]))
    columns, header = [known + 1, *poses[known].T], POSE_HEADER
    if covariances is not None:
        columns += [*covariances[known][:, *np.triu_indices(3)].T]
        header += COVARIANCE_HEADER
    _write_lines(path, columns, ",", header)


def export_trajectories(source, kind, out):
    """Write the trajectories in the folder `source` to the folder `out`; returns their Paths.

    Parameters
    ----------
    source : folder of a dataset's results, of one problem's, or `truth` of a dataset.
    kind : "tum" or "csv"; a file is named by its problem, as `problem3.tum`, or `truth.tum`.

    Raises
    ------
    DatasetError : there are no poses in the folder, or they cannot be read.
    """
    source, paths = Path(source), []
    for folder in _folders(source):
        path = Path(out) / f"{folder.resolve().name}.{kind}"
        if (folder / POSES).is_file():
            poses, covariances = _read_poses(folder)
        else:
            poses, covariances = read_truth(folder.resolve().parent).poses, None
        if kind == "tum":
            write_tum(path, poses)
        else:
            write_csv(path, poses, covariances)
        paths.append(path)
    return paths


def _folders(source):
    """The folders with poses: `source` itself, or those in it that have results."""
    is_truth = source.is_dir() and source.resolve().name.lower() == "truth"
    if is_truth or (source / POSES).is_file():
        return [source]
    folders = sorted(path.parent for path in source.glob(f"[!.]*/{POSES}"))
    if not folders:
        raise DatasetError(f"{source}: expected a folder with {POSES}, with sub-folders that have "
                           "one, or the folder truth of a dataset; found none of them")
    return folders


def _read_poses(folder):
    """Poses and covariances in a problem's folder."""
    try:
        return read_vehicle_poses(folder)
    except swap.UnfinishedError as error:
        raise DatasetError(str(error)) from None
    except Exception:  # scipy and numpy raise many kinds
        raise DatasetError(f"{folder / POSES}: expected poses and covariances as slamlib writes "
                           "them, found something else") from None


def _write_lines(path, columns, delimiter, header=""):
    """Write numbers with all their digits, the pose numbers first."""
    text = BytesIO()
    np.savetxt(text, np.column_stack(columns), header=header, comments="", delimiter=delimiter,
               fmt=["%d"] + ["%.17g"] * (len(columns) - 1))
    swap.write_atomically(Path(path), text.getvalue())
