"""Columns that look exchanged: the pose's id and the landmark's in a file of measurements."""

import numpy as np

MIN_PAIRS = 10  # pairs of readings that decide
MANY = 20_000  # readings; of more, the first in the file are looked at
SEEN = 3  # readings of a landmark on average, of which ids alone decide
FARTHER = 3.0  # ratio of their median distances by which the columns look exchanged


def look_exchanged(pose, landmark, place, pose_count):
    """True if the ids of poses (m,) and landmarks (m,), as a file has them, look exchanged.

    A landmark is measured from poses that follow each other at almost the same place (m, d) of the
    vehicle's frame, or at almost the same range; several landmarks measured at one pose are at
    different ones. So the columns look exchanged if measurements of one "landmark" from successive
    "poses" are FARTHER from each other than those of one "pose" of successive "landmarks". Where a
    pose has one landmark, the ids decide.
    """
    pose, landmark, place = pose[:MANY], landmark[:MANY], place[:MANY]
    whole = (landmark == np.rint(landmark)) & (pose == np.rint(pose))
    if not (whole & (1 <= landmark) & (landmark <= pose_count)).all():
        return False
    if len(landmark) - len(np.unique(landmark)) < MIN_PAIRS:
        return _ids_look_exchanged(pose, landmark, pose_count)
    medians = []
    for first, second in ((landmark, pose), (pose, landmark)):
        order = np.lexsort([second, first])
        same = np.diff(first[order]) == 0
        apart = np.linalg.norm(np.diff(place[order], axis=0), axis=1)[same]
        if len(apart) < MIN_PAIRS:
            return False
        medians.append(np.median(apart))
    return medians[0] > FARTHER * medians[1]


def _ids_look_exchanged(pose, landmark, pose_count):
    """True if "landmarks" that hardly repeat are in the order of a drive, and "poses" are not.

    The "landmarks" ascend over more than half of the drive's poses. The "poses" do not ascend, are
    few, and lie in less than half of the drive.
    """
    few = SEEN * len(np.unique(pose)) <= len(np.unique(landmark)) >= MIN_PAIRS
    ascend = (np.diff(landmark) >= 0).all() and not (np.diff(pose) >= 0).all()
    return bool(few and ascend and np.ptp(landmark) > pose_count / 2 > np.ptp(pose))
