"""Exchanged columns where each pose has one landmark; legal files of that kind are read."""

from functools import cache

import numpy as np
import pytest
from test_dataset import error_of, write

from slamlib.dataset import read_dataset
from slamlib.exchanged import look_exchanged
from slamlib.simulation import simulate, write_dataset

simulated = cache(simulate)


def one_landmark_a_pose(rows, seed):
    """A random one of the rows of each pose, in their order."""
    shuffled = np.random.default_rng(seed).permutation(len(rows))
    poses = [rows[k].split()[0] for k in shuffled]
    return [rows[k] for k in sorted(shuffled[poses.index(pose)] for pose in set(poses))]


def exchanged(row):
    pose, landmark, rest = row.split(" ", 2)
    return f"{landmark} {pose} {rest}"


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("name", ["ArucoReading.txt", "UwbReading.txt"])
def test_one_landmark_a_pose(seed, name, tmp_path):
    write_dataset(tmp_path, simulated("short", seed)[0])
    rows = one_landmark_a_pose((tmp_path / name).read_text().splitlines(), seed)
    shuffled = np.random.default_rng(seed).permutation(rows)
    for legal in (rows, rows[::-1], shuffled, sorted(rows, key=lambda row: int(row.split()[1]))):
        write(tmp_path / name, "\n".join(legal))
        assert read_dataset(tmp_path).notes == ()
    write(tmp_path / name, "\n".join(map(exchanged, rows)))
    assert "columns 1 and 2 look exchanged" in error_of(read_dataset, tmp_path)


K = np.arange(300)
LEGAL = {  # pose, marker, number of poses; each marker is seen once
    "corridor": (1 + 6 * K, 1 + K, 2000),
    "corridor as long as its markers": (1 + K, 1 + K, 300),
    "corridor driven backward": (300 - K, 1 + K, 300),
    "corridor, sorted by marker": (np.random.default_rng(0).permutation(300) + 1, 1 + K, 300),
    "one pose": (np.full(300, 7), 1 + K, 300),
    "few poses, sorted by marker": (np.array([10, 150, 290])[K % 3], 1 + K, 300),
    "few poses at the begin, sorted by marker": (1 + K % 3, 1 + K, 2000),
    "marker ids are large": (1 + K % 3, 5000 + K, 2000)}


@pytest.mark.parametrize("case", LEGAL)
def test_legal_files_where_markers_are_seen_once(case):
    pose, marker, pose_count = LEGAL[case]
    places = np.random.default_rng(1).uniform(-1, 1, (300, 2))
    assert not look_exchanged(pose, marker, places, pose_count)


def test_ids_alone_decide():
    """Random places; seventeen markers at two hundred poses."""
    marker, pose = np.random.default_rng(0).integers(1, 18, 200), 1 + 10 * np.arange(200)
    places = np.random.default_rng(1).uniform(-1, 1, (200, 2))
    assert look_exchanged(marker, pose, places, 2000)
    assert not look_exchanged(pose, marker, places, 2000)
