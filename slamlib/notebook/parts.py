"""Draws what the Explore figures have in common: drives or parts of them, and their reference."""

from dataclasses import dataclass

import numpy as np

from slamlib import evaluation, odometry
from slamlib.dataset import DatasetError, Truth
from slamlib.notebook import plotting
from slamlib.notebook.show import Drive
from slamlib.simulation import CAMERA_REACH, simulate

MIN_PATH_LENGTH = 1.0           # m, path length of a drive that is drawn
MIN_SHOWN_ERROR = 1.0         # mm, lower limit of the axis of errors
MAX_PART_POSES = 20_000      # poses of a dataset's first part
MAX_PART_FRAMES = 200        # poses with measurements in it, as many as a simulated drive has


@dataclass(frozen=True)
class Reference:
    """The solution that an Explore figure is compared with."""

    solution: object  # Truth, or a Fusion or SlamResult of all measurements
    poses: np.ndarray  # (n, 3), of the part that is drawn
    label: str  # "truth", or the name of the solution

    @property
    def is_truth(self):
        """True if the figure shows errors, False if distances."""
        return isinstance(self.solution, Truth)


def simulated(seed, **options):
    """A simulated Drive of the short path; `options` as of `simulation.simulate`."""
    return Drive("simulated", *simulate("short", seed, **options), made_up=True)


def moving_drive(drives):
    """The first Drive whose first part is a path of MIN_PATH_LENGTH, or else a simulated one."""
    for drive in drives:
        d = first_part(drive.dataset)
        if evaluation.path_length(odometry.dead_reckoning(d.ticks, d.vehicle)) >= MIN_PATH_LENGTH:
            return drive
    return simulated(1)


def camera_reach(drives):
    """The largest distance of a sighting of these Drives in m, rounded up to decimetres."""
    largest = max(np.hypot(*drive.dataset.aruco.marker_in_vehicle[:, :2].T).max()
                  for drive in drives)
    return max(CAMERA_REACH, float(np.ceil(10 * largest) / 10))


def first_part(dataset, sensor=None):
    """The first MAX_PART_POSES of a Dataset, or MAX_PART_FRAMES of a sensor, "aruco" or "uwb".

    Raises DatasetError if this part has no measurement of the sensor.
    """
    part = dataset.first(MAX_PART_POSES)
    if sensor is None:
        return part
    readings = getattr(part, sensor)
    if readings is None:
        raise DatasetError(f"expected measurements in the first {len(part.ticks):,} poses of "
                           f"{dataset.name}, found none")
    frames = np.unique(readings.pose)
    return part.first(frames[MAX_PART_FRAMES]) if len(frames) > MAX_PART_FRAMES else part


def reference_of(drive, full, name, count):
    """The Reference of the first `count` poses of a Drive: its Truth, else full[drive.name]."""
    solution = full[drive.name] if drive.truth is None else drive.truth
    return Reference(solution, solution.poses[:count], name if drive.truth is None else "truth")


def data_sentences(drive, part, label=None):
    """Sentences (str) on the part of a recorded Drive that is drawn, a Dataset, and missing truth.

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


def figure_with_reference(reference):
    """A figure, and its axes of the plan, with the reference, and of the errors.

    A reference that is not the truth is drawn wide, below the other paths.
    """
    fig, ((plan,), (side,)) = plotting.panels(2, height=3.6)
    if reference.is_truth:
        plotting.trajectory(plan, reference.poses, "truth")
    else:
        plotting.trajectory(plan, reference.poses, "sample", reference.label, linewidth=4.0)
    return fig, plan, side


def nees_text(found, reference):
    """Text (str) with the average NEES of a SlamResult, empty without truth."""
    if not reference.is_truth:
        return ""
    return f", NEES {evaluation.anees(found.poses, found.covariances, reference.poses):.1f}"


def error_curve(ax, poses, reference, role, label=None, frame=None):
    """Draw distances in mm of poses (n, 3) from the reference; `frame` (n,) are their indices."""
    true = reference.poses if frame is None else reference.poses[frame]
    plotting.curve(ax, 1e3 * np.hypot(*(poses - true)[:, :2].T), role, frame, label)


def finished(fig, drive, part, reference):
    """The figure with a logarithmic axis of errors, a legend, and sentences on its data."""
    label, side = reference.label, fig.axes[1]
    side.set(yscale="log", ylabel="position error (mm)" if reference.is_truth
             else f"distance from {label} (mm)")
    side.yaxis.set_major_formatter("{x:g}")
    side.set_ylim(MIN_SHOWN_ERROR, max(2 * side.dataLim.y1, 10 * MIN_SHOWN_ERROR))
    plotting.legend_below(fig)
    fig.said += data_sentences(drive, part, label)
    return fig
