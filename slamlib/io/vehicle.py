"""Reads vehicle.toml, and mends the counts of encoders that wrap around."""

from pathlib import Path

import numpy as np

from slamlib.core.errors import require
from slamlib.core.vehicle import TABLE_2, VEHICLE_LIMITS, Vehicle, changed
from slamlib.io.formats import Check
from slamlib.io.tables import Table
from slamlib.io.textfile import read_toml

MAX_REVOLUTIONS = 10.0  # revolutions of a wheel in one step
MODULI = (2**16, 2**15)  # numbers of values of counters that wrap around
MIN_MODULUS_RATIO = 32.0  # ratio of a modulus to a large step of the drive, for a decision


def read_vehicle(path: Path | None, default: Vehicle = TABLE_2) -> Vehicle:
    """The Vehicle of a `vehicle.toml`, whose entries replace those of a default.

    Raises DatasetError if the file does not have the format.
    """
    if path is None:
        return default
    entries = read_toml(path, "wheelbase = 0.4", VEHICLE_LIMITS)
    return changed(default, entries, path)


def incremental_counts(table: Table, vehicle: Vehicle) -> tuple[Table, np.ndarray]:
    """The Table of the encoders, and its counts since the previous pose, (n, 2) int64.

    Those of a counter that wraps around are mended. Raises DatasetError if there is no row, the
    first is not 0, or a step exceeds MAX_REVOLUTIONS.
    """
    read = table.numbers[:, 1:]
    require(len(read), table.source, "at least the row '1 0 0', found no rows")
    counts = _unwrapped(read)
    mended = np.flatnonzero((counts != read).any(axis=1))
    if len(mended):
        table = table.noted(
            f": {len(mended)} rows were mended whose counts are 2^15 or 2^16 off, as of a counter "
            f"that wraps around, first {table.place(mended[0])}")
    limit = MAX_REVOLUTIONS * vehicle.ticks_per_revolution
    most = np.where(np.arange(len(read)) == 0, 0, limit)
    expected = (f"at most {MAX_REVOLUTIONS:g} wheel revolutions ({limit:g} ticks) since the pose "
                "before, not since the start, and none in the first row")
    right, left = abs(counts).T <= most
    table.require_rows([Check(right, expected, column=1), Check(left, expected, column=2)])
    return table, counts.astype(np.int64)


def _unwrapped(counts):
    """Counts (n, 2) less a modulus, where that makes them as small as most others."""
    moving = counts[counts != 0]
    if len(moving) == 0:
        return counts
    large = np.quantile(abs(moving), 0.9)
    for modulus in MODULI:
        less = counts - np.sign(counts) * modulus
        if MIN_MODULUS_RATIO * large < modulus:
            counts = np.where(abs(less) <= 2 * large, less, counts)
    return counts
