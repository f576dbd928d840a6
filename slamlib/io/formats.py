"""What the files of a dataset hold: their columns, the limits of numbers, and checks of rows.

The limits are far wider than vehicles, cameras and antennas need: a number beyond them has another
unit, or float64 loses digits beside it. data/README.md lists them.
"""

from dataclasses import dataclass

import numpy as np

from slamlib.core import se2
from slamlib.core.vehicle import Limit

ENCODER = "encoderReading.txt"
ARUCO = "ArucoReading.txt"
UWB = "UwbReading.txt"
GUESS = "UwbAntennaGuess.txt"
TABLES = (ENCODER, ARUCO, UWB, GUESS)
TRUTH_TABLES = ("vehiclePose.txt", "ArucoMap.txt", "UwbMap.txt")
VEHICLE = "vehicle.toml"
DATASET_FILES = (*TABLES, VEHICLE, "truth")
TRUTH_FILES = (*TRUTH_TABLES, VEHICLE)

MIN_EIGENVALUE = 1e-12  # of a correlation matrix; with a smaller one it counts as singular
MAX_NEGATIVE_SIGMAS = 5.0  # sigmas, by which noise may make a range negative
COVARIANCE = [[5, 6, 7], [6, 8, 9], [7, 9, 10]]  # columns of the covariance of a sighting

_ANY = Limit(-1e15, 1e15)               # float64 represents whole numbers up to there exactly
_WHOLE = Limit(-1e15, 1e15, whole=True)  # ids and counts
_VARIANCE = Limit(1e-18, 1e8, "m^2")
_IN_VEHICLE = Limit(-1e4, 1e4, "m")
_GUESS = Limit(-1e6, 1e6, "m")
_TRUE = Limit(-1e9, 1e9, "m")
_TRUE_ANGLE = Limit(-1e9, 1e9, "rad")
# Limits by the name of a file and by its column, in the order of the file.
LIMITS = {
    ENCODER: {"pose id": _WHOLE, "right ticks": _WHOLE, "left ticks": _WHOLE},
    ARUCO: {
        "pose id": _WHOLE, "marker id": _WHOLE,
        "x": _IN_VEHICLE, "y": _IN_VEHICLE, "theta": Limit(-6.3, 6.3, "rad"),
        "s_xx": _VARIANCE, "s_xy": _ANY, "s_xtheta": _ANY,
        "s_yy": _VARIANCE, "s_ytheta": _ANY, "s_thetatheta": Limit(1e-18, 1e14, "rad^2")},
    UWB: {"pose id": _WHOLE, "antenna id": _WHOLE, "range": Limit(-5e4, 1e5, "m"),
          "sigma": Limit(1e-9, 1e4, "m")},
    GUESS: {"antenna id": _WHOLE, "x": _GUESS, "y": _GUESS},
    "vehiclePose.txt": {"pose id": _WHOLE, "x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "ArucoMap.txt": {"marker id": _WHOLE, "x": _TRUE, "y": _TRUE, "theta": _TRUE_ANGLE},
    "UwbMap.txt": {"antenna id": _WHOLE, "x": _TRUE, "y": _TRUE}}


@dataclass(frozen=True)
class Check:
    """Which rows of a table are right, and what is expected of them, or of one of their columns."""

    ok: np.ndarray  # (m,) bool
    expected: str
    column: int | None = None


def given(numbers: np.ndarray, columns) -> list[Check]:
    """Checks that no number (m, c) is missing: none is NaN, and no range is 0."""
    checks = []
    for k, column in enumerate(columns):
        ok = ~np.isnan(numbers[:, k])
        expected = f"{column}, a number"
        if column == "range":
            ok &= numbers[:, k] != 0
            expected += " (0 is no reception)"
        checks.append(Check(ok, expected, k))
    return checks


def within(numbers: np.ndarray, limits: dict[str, Limit]) -> list[Check]:
    """Checks that numbers (m, c) are within the limits of their columns."""
    checks = []
    for k, (column, limit) in enumerate(limits.items()):
        kind = "whole" if limit.whole else "finite"
        expected = f"{column}, a {kind} number {limit}"
        checks.append(Check(limit.holds(numbers[:, k]), expected, k))
    return checks


def _counted(numbers):
    rows = np.arange(1, len(numbers) + 1)
    return [Check(numbers[:, 0] == rows, "pose ids 1, 2, 3, ... in order")]


def _unique(numbers):
    _, first = np.unique(numbers[:, 0], return_index=True)
    return [Check(np.isin(np.arange(len(numbers)), first), "each id only once")]


def _positive_definite(numbers):
    """Judged as a correlation matrix: s_thetatheta may be 1e4 rad^2 where s_xx is 1e-4 m^2."""
    correlations = se2.correlations(numbers[:, COVARIANCE])
    smallest = np.linalg.eigvalsh(correlations)[:, 0]
    return [Check(smallest > MIN_EIGENVALUE, "a positive definite covariance (smallest eigenvalue "
                  f"of its correlation matrix above {MIN_EIGENVALUE:g})")]


def _hardly_negative(numbers):
    distance = numbers[:, 2]
    sigma = numbers[:, 3]
    return [Check(distance >= -MAX_NEGATIVE_SIGMAS * sigma,
                  f"a range that is not below -{MAX_NEGATIVE_SIGMAS:g} sigma")]


# What the numbers (m, c) of a row must be together: functions that return Checks.
CHECKS = {
    ENCODER: _counted, ARUCO: _positive_definite, UWB: _hardly_negative, GUESS: _unique,
    "vehiclePose.txt": _counted, "ArucoMap.txt": _unique, "UwbMap.txt": _unique}
