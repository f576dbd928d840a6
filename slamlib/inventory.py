"""What was read of a drive, in lines for the terminal."""

from dataclasses import asdict

import numpy as np

from slamlib.dataset import Vehicle


def all_notes(dataset, truth):
    """What was mended or left out when a drive was read (tuple of str), its Truth or None included.
    """
    return (*dataset.notes, *(() if truth is None else truth.notes))


def found(dataset, truth):
    """Lines (list of str) on what was read of a drive, a Dataset and its Truth or None.

    There is a line on each sensor, the vehicle and the truth, then the notes of both.
    """
    seen, ranges, default = dataset.aruco, dataset.uwb, asdict(Vehicle())
    changed = [f"{key} = {value:g}" for key, value in asdict(dataset.vehicle).items()
               if value != default[key]]
    right, left = abs(dataset.ticks).sum(axis=0)
    lines = [
        f"encoders: {len(dataset.ticks)} poses, {right} ticks right and {left} left",
        "markers: none, no ArucoReading.txt with rows" if seen is None else
        f"markers: {len(seen.pose)} sightings of {len(np.unique(seen.marker))} markers at "
        f"{len(np.unique(seen.pose))} poses",
        "ranges: none, no UwbReading.txt with rows" if ranges is None else
        f"ranges: {len(ranges.pose)} ranges to {len(np.unique(ranges.antenna))} antennas at "
        f"{len(np.unique(ranges.pose))} poses",
        f"vehicle.toml: {', '.join(changed)}" if changed else
        "vehicle.toml: none, or as the assignment's table 2",
        f"truth: {'no' if truth is None else 'yes'}"]
    notes = [f"note: {note}" for note in all_notes(dataset, truth)]
    return [f"{dataset.name}: {line}" for line in (*lines, *notes)]
