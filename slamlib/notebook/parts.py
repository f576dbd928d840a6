"""What the Explore sections draw: simulated drives, parts of datasets, and their comparison."""

import numpy as np

from slamlib import evaluation, odometry
from slamlib.dataset import DatasetError
from slamlib.notebook import plotting
from slamlib.notebook.show import Drive
from slamlib.simulation import CAMERA_REACH, simulate

MINIMUM_PATH = 1.0           # m, path length from which a drive is worth drawing
SMALLEST_ERROR = 1.0         # mm, lower limit of the axis of errors
MOST_POSES = 20_000          # poses of a dataset's first part, at most, and
MOST_FRAMES = 200            # of them with measurements: as many as a simulated drive has


def simulated(seed, **options):
    """A simulated Drive of the short path; `options` as of `simulation.simulate`."""
    return Drive("simulated", *simulate("short", seed, **options), made_up=True)


def moving_drive(drives):
    """The first Drive whose first part is a path of MINIMUM_PATH, or else a simulated one."""
    for drive in drives:
        d = first_part(drive.dataset)
        if evaluation.path_length(odometry.dead_reckoning(d.ticks, d.vehicle)) >= MINIMUM_PATH:
            return drive
    return simulated(1)


def farthest(drives):
    """The largest distance in m, rounded up, at which the camera of any of these Drives sees."""
    seen = [drive.dataset.aruco.marker_in_vehicle for drive in drives]
    return max(CAMERA_REACH, *(float(np.ceil(10 * np.hypot(*z[:, :2].T).max()) / 10)
                               for z in seen))


def first_part(dataset, sensor=None):
    """The dataset until MOST_POSES, or until MOST_FRAMES of a sensor, "aruco" or "uwb".

    Raises DatasetError if this part has no measurement of the sensor.
    """
    part = dataset.first(MOST_POSES)
    if sensor is None:
        return part
    readings = getattr(part, sensor)
    if readings is None:
        raise DatasetError(f"expected measurements in the first {len(part.ticks):,} poses of "
                           f"{dataset.name}, found none")
    frames = np.unique(readings.pose)
    return part.first(frames[MOST_FRAMES]) if len(frames) > MOST_FRAMES else part


def compared_with(drive, full, name):
    """What a Drive is compared with, its role and label: its Truth, or else full[drive.name]."""
    if drive.truth is not None:
        return drive.truth, "truth", "truth"
    return full[drive.name], "sample", name


def about(drive, part, label=None):
    """Sentences (str) on what of a recorded Drive is drawn, a Dataset, and on lost truth.

    `label` names what replaces the truth; None leaves the second sentence out.
    """
    if drive.made_up:
        return ""
    whole, count, said = len(drive.dataset.ticks), len(part.ticks), ""
    if count < whole:
        said = f" Only the first {count:,} of the {whole:,} poses of {drive.name} are used."
    if drive.truth is None and label is not None:
        said += (f" No truth comes with {drive.name}: distances are from {label}, by all its "
                 "measurements.")
    return said


def known_places(ids, known, places):
    """(k, 2) of the landmarks `ids` (k,), NaN for those without a row in `known` and `places`."""
    found, there = np.full((len(ids), 2), np.nan), np.isin(ids, known)
    found[there] = places[np.searchsorted(known, ids[there]), :2]
    return found


def reference(ax, true, role, label):
    """Draw the path that others are compared with; without truth it is wide, below the others."""
    plotting.trajectory(ax, true, role, label, **{} if role == "truth" else {"linewidth": 4.0})


def nees_text(found, true, role):
    """Text (str) with the average NEES of a SlamResult where its role says that truth is known."""
    if role != "truth":
        return ""
    return f", NEES {evaluation.anees(found.poses, found.covariances, true):.1f}"


def error_curve(ax, poses, true, role, label=None, **look):
    """Draw the distance in mm of poses (n, 3) from others over the pose number."""
    apart = np.hypot(*(poses - true)[:, :2].T)
    plotting.curve(ax, 1e3 * apart, role, label=label, **look)


def finished(fig, label):
    """The figure with a logarithmic axis of errors, the second one, and a legend."""
    side = fig.axes[1]
    side.set(yscale="log", ylabel="position error (mm)" if label == "truth"
             else f"distance from {label} (mm)")
    side.yaxis.set_major_formatter("{x:g}")
    side.set_ylim(SMALLEST_ERROR, max(2 * side.dataLim.y1, 10 * SMALLEST_ERROR))
    plotting.legend_below(fig)
    return fig
