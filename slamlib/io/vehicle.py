"""Reads vehicle.toml, and mends the counts of encoders that wrap around."""

import numpy as np

from slamlib.core.errors import require
from slamlib.core.vehicle import TABLE_2, VEHICLE_LIMITS, changed
from slamlib.io.textfile import read_toml

MAX_REVOLUTIONS = 10.0  # revolutions of a wheel in one step
MODULI = 2**16, 2**15  # numbers of values of counters that wrap around
MIN_MODULUS_RATIO = 32.0  # ratio of a modulus to a large step of the drive, for a decision


def read_vehicle(path, default=TABLE_2):
    """The Vehicle of a `vehicle.toml` (Path or None), whose entries replace those of a default.

    Raises DatasetError if the file does not have the format.
    """
    entries = read_toml(path, "wheelbase = 0.4", VEHICLE_LIMITS) if path else {}
    return changed(default, entries, path)


def incremental_counts(table, vehicle):
    """The Table of the encoders, and its counts since the previous pose, (n, 2) int64.

    Those of a counter that wraps around are mended: counts less a modulus, where that makes them
    as small as most others. Raises DatasetError if there is no row, the first is not 0, or a step
    exceeds MAX_REVOLUTIONS.
    """
    read, limit = table.numbers[:, 1:], MAX_REVOLUTIONS * vehicle.ticks_per_revolution
    require(len(read), table.source, "at least the row '1 0 0', found no rows")
    counts, large = read, np.quantile(abs(read[read != 0]), 0.9) if read.any() else 0.0
    for modulus in MODULI:
        less = counts - np.sign(counts) * modulus
        if MIN_MODULUS_RATIO * large < modulus:
            counts = np.where(abs(less) <= 2 * large, less, counts)
    if len(mended := np.flatnonzero((counts != read).any(axis=1))):
        table = table.noted(
            f": {len(mended)} rows were mended whose counts are 2^15 or 2^16 off, as of a counter "
            f"that wraps around, first {table.place(mended[0])}")
    most = np.where(np.arange(len(read)) == 0, 0, limit)
    table.kept(np.insert(abs(counts) <= most[:, None], 0, True, axis=1), (
        f"at most {MAX_REVOLUTIONS:g} wheel revolutions ({limit:g} ticks) since the pose before, "
        "not since the start, and none in the first row"))
    return table, counts.astype(np.int64)
