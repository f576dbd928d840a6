"""What the files of a dataset hold: their columns, the limits of numbers, and checks of rows.

The limits are far wider than vehicles, cameras and antennas need: a number beyond them has another
unit, or float64 loses digits beside it. data/README.md lists them.
"""

import numpy as np

from slamlib.core import se2
from slamlib.core.vehicle import Limit

ENCODER = "encoderReading.txt"
ARUCO = "ArucoReading.txt"
UWB = "UwbReading.txt"
GUESS = "UwbAntennaGuess.txt"
VEHICLE = "vehicle.toml"
DATASET_FILES = (ENCODER, ARUCO, UWB, GUESS, VEHICLE, "truth")
TRUE_POSES = "vehiclePose.txt"
TRUE_MARKERS = "ArucoMap.txt"
TRUE_ANTENNAS = "UwbMap.txt"
TRUTH_FILES = (TRUE_POSES, TRUE_MARKERS, TRUE_ANTENNAS, VEHICLE)

MIN_EIGENVALUE = 1e-12  # of a correlation matrix; with a smaller one it counts as singular
MAX_NEGATIVE_SIGMAS = 5.0  # sigmas, by which noise may make a range negative
COVARIANCE = [[5, 6, 7], [6, 8, 9], [7, 9, 10]]  # columns of the covariance of a sighting

_WHOLE = Limit(-1e15, 1e15, whole=True)  # float64 represents whole numbers up to there exactly
_ANY = Limit(-1e15, 1e15)
_VARIANCE = Limit(1e-18, 1e8, "m^2")
_IN_VEHICLE = Limit(-1e4, 1e4, "m")
_IN_WORLD = Limit(-1e7, 1e7, "m")
_POSE = {"x": _IN_WORLD, "y": _IN_WORLD, "theta": Limit(-1e9, 1e9, "rad")}
_ANTENNA = {"antenna id": _WHOLE, "x": _IN_WORLD, "y": _IN_WORLD}
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
    GUESS: _ANTENNA,
    TRUE_POSES: {"pose id": _WHOLE} | _POSE,
    TRUE_MARKERS: {"marker id": _WHOLE} | _POSE,
    TRUE_ANTENNAS: _ANTENNA}


def within(numbers: np.ndarray, limits: dict[str, Limit]) -> dict[str, np.ndarray]:
    """Which rows (m,) of numbers (m, c) are within the limits of a column, by what is expected."""
    checks = {}
    for (column, limit), values in zip(limits.items(), numbers.T):
        kind = "whole" if limit.whole else "finite"
        checks[f"{column}, a {kind} number {limit}"] = limit.holds(values)
    return checks


def together(numbers: np.ndarray, name: str) -> dict[str, np.ndarray]:
    """Which rows (m,) of numbers (m, c) are right as a whole, by what is expected in a file."""
    if name == ARUCO:
        # s_thetatheta may be 1e4 rad^2 where s_xx is 1e-4 m^2, so the correlations are judged.
        smallest = np.linalg.eigvalsh(se2.correlations(numbers[:, COVARIANCE]))[:, 0]
        return {"a positive definite covariance (smallest eigenvalue of its correlation matrix "
                f"above {MIN_EIGENVALUE:g})": smallest > MIN_EIGENVALUE}
    if name == UWB:
        lowest = -MAX_NEGATIVE_SIGMAS * numbers[:, 3]
        return {f"a range that is not below -{MAX_NEGATIVE_SIGMAS:g} sigma":
                numbers[:, 2] >= lowest}
    if name in (ENCODER, TRUE_POSES):
        poses = np.arange(1, len(numbers) + 1)
        return {"pose ids 1, 2, 3, ... in order": numbers[:, 0] == poses}
    return {"each id only once": unrepeated(numbers[:, :1])}


def unrepeated(rows: np.ndarray) -> np.ndarray:
    """True of the rows (m, c) that no row before them equals, (m,) bool."""
    first = np.unique(rows, axis=0, return_index=True)[1]
    return np.isin(np.arange(len(rows)), first)
