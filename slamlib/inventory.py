"""Lists for the terminal what was read of a drive."""

import json
from dataclasses import asdict

import numpy as np

from slamlib.dataset import Vehicle


def all_notes(dataset, truth):
    """Notes (tuple of str) on what was mended or left out of a Dataset and its Truth or None.

    One says which kernel and gate are used, if they are not the default.
    """
    default = Vehicle()
    weighed = [f"Problems 3 and 4 are solved with {key} = {json.dumps(value)}."
               for key in ("kernel", "gate")
               if (value := getattr(dataset.vehicle, key)) != getattr(default, key)]
    return (*dataset.notes, *weighed, *(() if truth is None else truth.notes))


def inventory_lines(dataset, truth):
    """Lines (list of str) on each sensor, the vehicle, the truth, and the notes of both.

    Parameters
    ----------
    dataset : Dataset
    truth : Truth or None
    """
    aruco, uwb, default = dataset.aruco, dataset.uwb, asdict(Vehicle())
    changed = [f"{key} = {value:g}" if isinstance(value, float) else f"{key} = {json.dumps(value)}"
               for key, value in asdict(dataset.vehicle).items()
               if value != default[key]]
    right, left = abs(dataset.ticks).sum(axis=0)
    lines = [
        f"encoders: {len(dataset.ticks)} poses, {right} ticks right and {left} left",
        "markers: none, no ArucoReading.txt with rows" if aruco is None else
        f"markers: {len(aruco.pose)} sightings of {len(np.unique(aruco.marker))} markers at "
        f"{len(np.unique(aruco.pose))} poses",
        "ranges: none, no UwbReading.txt with rows" if uwb is None else
        f"ranges: {len(uwb.pose)} ranges to {len(np.unique(uwb.antenna))} antennas at "
        f"{len(np.unique(uwb.pose))} poses",
        f"vehicle.toml: {', '.join(changed)}" if changed else
        "vehicle.toml: none, or as the assignment's table 2",
        f"truth: {'no' if truth is None else 'yes'}"]
    notes = [f"note: {note}" for note in all_notes(dataset, truth)]
    return [f"{dataset.name}: {line}" for line in (*lines, *notes)]
