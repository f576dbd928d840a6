from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT

from slamlib.core import odometry, se2
from slamlib.core.vehicle import Vehicle
from slamlib.io.dataset import read_dataset, read_truth
from slamlib.studies.simulation import simulate, write_dataset

DATA = ROOT / "data"
RECIPES = {"short": dict(path="short", seed=1),
           "long": dict(path="long", seed=2, late_ranges=0.05, mislabelled=0.005)}


@pytest.mark.parametrize("name", RECIPES)
def test_committed_stand_ins_are_regenerated_to_the_byte(name, tmp_path):
    if not (DATA / name / "truth").exists():
        pytest.skip(f"data/{name} has no truth: it has been replaced by a real log")
    write_dataset(tmp_path / name, *simulate(**RECIPES[name]))
    made = {f.relative_to(tmp_path): f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()}
    committed = {f.relative_to(DATA): f.read_bytes()
                 for f in (DATA / name).rglob("*") if f.is_file()}
    assert made.keys() == committed.keys()
    assert [f for f in made if made[f] != committed[f]] == []


def errors(dataset, truth):
    """Errors of sightings (m, 3) and of ranges (r,)."""
    a, u = dataset.aruco, dataset.uwb
    marker = truth.marker_in_world[np.searchsorted(truth.marker, a.marker)]
    antenna = truth.antenna_in_world[np.searchsorted(truth.antenna, u.antenna)]
    off = a.marker_in_vehicle - se2.between(truth.poses[a.pose], marker)
    return np.column_stack([off[:, :2], se2.wrap(off[:, 2])]), u.range - np.hypot(
        *(truth.poses[u.pose, :2] - antenna).T)


def test_perfect_data_agrees_with_its_truth():
    dataset, truth = simulate("short", seed=4, noise=False)
    poses = odometry.dead_reckoning(dataset.ticks, dataset.vehicle, model="arc")
    for off in (poses - truth.poses, *errors(dataset, truth)):
        np.testing.assert_allclose(off, 0, atol=1e-10)
    np.testing.assert_array_equal(dataset.antenna_guess.position, truth.antenna_in_world)


def test_noise_has_the_covariances_that_the_files_state():
    """Mean squared Mahalanobis length of m whitened d-vectors: d +- 4 sqrt(2 d / m)."""
    dataset, truth = simulate("long", seed=6)
    a, (error, off) = dataset.aruco, errors(dataset, truth)
    chi2 = np.einsum("ni,ni->n", error, np.linalg.solve(a.covariance, error[..., None])[..., 0])
    assert abs(chi2.mean() - 3) < 4 * np.sqrt(6 / len(chi2))
    distance = np.linalg.norm(a.marker_in_vehicle[:, :2], axis=1)
    sigma = np.sqrt(np.trace(a.covariance, axis1=1, axis2=2))
    assert np.corrcoef(distance, sigma)[0, 1] > 0.99 and np.all(a.covariance[:, 0, 2] != 0)
    z = off / dataset.uwb.sigma
    assert abs(np.mean(z**2) - 1) < 4 * np.sqrt(2 / len(z)) and abs(z.mean()) < 4 / np.sqrt(len(z))
    off = np.linalg.norm(dataset.antenna_guess.position - truth.antenna_in_world, axis=1)
    assert 0.2 < np.sqrt(np.mean(off**2)) < 0.8


@pytest.mark.parametrize("slip", [0.0, 1e-3, 5e-3])
def test_encoder_error_is_rounding_and_a_random_walk(slip):
    """With the true wheels the travelled distance errs by at most a count, plus slip^2 a metre."""
    dataset, truth = simulate("long", seed=7, slip=slip)
    length = 2 * np.pi * truth.vehicle.wheel[:2] / truth.vehicle.ticks_per_revolution
    step = se2.between(truth.poses[:-1], truth.poses[1:])
    true_ds = np.hypot(step[:, 0], step[:, 1]) / np.sinc(step[:, 2] / (2 * np.pi))
    turn = truth.vehicle.wheelbase / 2 * step[:, 2]
    error = np.cumsum(length * dataset.ticks[1:] - np.stack([true_ds + turn, true_ds - turn], -1),
                      axis=0).T
    one_count = 2 * np.pi * 0.1 / 8000
    if slip == 0:
        assert np.abs(error).max() < 1.01 * one_count
    else:
        per_metre = np.diff(error[:, ::100], axis=1)              # about one metre each
        metres = np.add.reduceat(true_ds, np.arange(0, len(true_ds) // 100 * 100, 100))
        ratio = np.mean(per_metre**2) / (slip**2 * metres.mean())
        assert abs(ratio - 1) < 4 * np.sqrt(2 / per_metre.size)


def test_outliers_come_at_the_asked_rates_and_late_ranges_are_too_long():
    clean, truth = simulate("long", seed=8)
    dirty, same_truth = simulate("long", seed=8, late_ranges=0.15, mislabelled=0.03)
    np.testing.assert_array_equal(truth.poses, same_truth.poses)
    np.testing.assert_array_equal(clean.ticks, dirty.ticks)
    wrong = dirty.aruco.marker != clean.aruco.marker
    late = dirty.uwb.range - clean.uwb.range
    assert abs(wrong.mean() - 0.03) < 0.01 and abs(np.mean(late > 0) - 0.15) < 0.025
    assert (late >= 0).all() and 0.6 < late[late > 0].mean() < 1.0
    assert np.isin(dirty.aruco.marker, truth.marker).all()


def test_files_round_trip_through_the_reader(tmp_path):
    vehicle = replace(Vehicle(), right_radius=0.12, ticks_per_revolution=4096.0)
    dataset, truth = simulate("short", seed=9, vehicle=vehicle)
    write_dataset(tmp_path / "drive", dataset, truth)
    again, true_again = read_dataset(tmp_path / "drive"), read_truth(tmp_path / "drive")
    assert again.vehicle == vehicle and true_again.vehicle == truth.vehicle
    np.testing.assert_array_equal(again.ticks, dataset.ticks)
    for found, written in ((again.aruco, dataset.aruco), (again.uwb, dataset.uwb),
                           (again.antenna_guess, dataset.antenna_guess)):
        for got, expected in zip(vars(found).values(), vars(written).values()):
            np.testing.assert_allclose(got, expected, rtol=1e-4, atol=6e-4)
    for name in ("poses", "marker", "marker_in_world", "antenna", "antenna_in_world"):
        np.testing.assert_allclose(getattr(true_again, name), getattr(truth, name), atol=6e-7)
