"""Detects exchanged columns: the pose's id and the landmark's in a file of measurements."""

import numpy as np

MIN_READING_PAIRS = 10  # pairs of readings, for a decision
MAX_READINGS = 20_000  # readings; of more, the first ones decide
MIN_READINGS_PER_LANDMARK = 3  # mean of readings of a landmark, where only ids decide
MIN_DISTANCE_RATIO = 3.0  # ratio of median distances from which columns look exchanged


def look_exchanged(pose, landmark, measured, pose_count):
    """True if the ids of poses (m,) and landmarks (m,) in a file look exchanged.

    Consecutive ones of the measurements `measured` (m, d) of a landmark are similar, and those of a
    pose differ. Columns look exchanged if the median distance between consecutive measurements of
    one "landmark" exceeds that between those of one "pose" MIN_DISTANCE_RATIO times. With one
    landmark a pose, the ids decide.
    """
    pose, landmark, measured = (each[:MAX_READINGS] for each in (pose, landmark, measured))
    whole = (landmark == np.rint(landmark)) & (pose == np.rint(pose))
    if not (whole & (1 <= landmark) & (landmark <= pose_count)).all():
        return False
    if len(landmark) - len(np.unique(landmark)) < MIN_READING_PAIRS:
        return _ids_look_exchanged(pose, landmark, pose_count)
    medians = []
    for first, second in ((landmark, pose), (pose, landmark)):
        order = np.lexsort([second, first])
        same = np.diff(first[order]) == 0
        distance = np.linalg.norm(np.diff(measured[order], axis=0), axis=1)[same]
        if len(distance) < MIN_READING_PAIRS:
            return False
        medians.append(np.median(distance))
    return medians[0] > MIN_DISTANCE_RATIO * medians[1]


def _ids_look_exchanged(pose, landmark, pose_count):
    """True if "landmarks" that hardly repeat ascend as the poses of a drive do.

    They ascend over more than half of the drive's poses. The "poses" do not ascend, are few, and
    cover less than half of the drive.
    """
    poses, landmarks = len(np.unique(pose)), len(np.unique(landmark))
    few = landmarks >= max(MIN_READING_PAIRS, MIN_READINGS_PER_LANDMARK * poses)
    ascend = (np.diff(landmark) >= 0).all() and not (np.diff(pose) >= 0).all()
    return bool(few and ascend and np.ptp(landmark) > pose_count / 2 > np.ptp(pose))
