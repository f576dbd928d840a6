"""The truth of a drive in the frame of its first pose, in which the estimates are."""

from dataclasses import replace

import numpy as np

from slamlib import se2
from slamlib.doubt import Doubt

ORIGIN_TOLERANCE = 1e-3  # m and rad; a first true pose within it is taken as the origin


def in_first_frame(truth):
    """The Truth in the frame of its first pose T_w1; a Doubt says so if it had to be moved.

    Poses T_wv become T_1v = inverse(T_w1) T_wv; markers and antennas are transformed alike. Where
    the first pose is the origin within ORIGIN_TOLERANCE, only full turns of the headings change.
    """
    turns = 2 * np.pi * np.rint(truth.poses[0, 2] / (2 * np.pi))
    truth = replace(truth, poses=truth.poses - [0, 0, turns])
    first = truth.poses[0]
    if (abs(first) <= ORIGIN_TOLERANCE).all():
        return truth
    marker = se2.between(first, truth.marker_in_world)
    antenna = np.column_stack([truth.antenna_in_world, np.zeros(len(truth.antenna))])
    doubt = Doubt("truth-frame", (
        "In truth/vehiclePose.txt the drive begins at ({:.3f} m, {:.3f} m, {:.4f} rad), not at the "
        "origin. The true poses and maps were moved into the frame of the first true pose, in "
        "which the estimates are. If errors are large, check that all files in truth/ are in the "
        "same frame.").format(*first))
    return replace(
        truth, poses=se2.between(first, truth.poses),
        marker_in_world=np.column_stack([marker[:, :2], se2.wrap(marker[:, 2])]),
        antenna_in_world=se2.between(first, antenna)[:, :2], doubts=(*truth.doubts, doubt))
