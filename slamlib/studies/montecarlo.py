"""Trials of the methods of problems 2 to 4: one simulated drive, judged against its truth.

`memory.run` runs a trial over many seeds.
"""

from dataclasses import replace

import numpy as np

from slamlib import localization, odometry, slam
from slamlib.evaluation import anees, ate, nees, position_sigmas
from slamlib.localization.hint import first_order_from
from slamlib.sightings import sightings_by_frame
from slamlib.simulation import simulate

PROBLEM2_METHODS = {
    "odometry": lambda dataset: odometry.dead_reckoning(dataset.ticks, dataset.vehicle),
    "ArUco": lambda dataset: localization.localize(dataset.aruco),
    "naive": lambda dataset: localization.localize(dataset.aruco, shared_errors=False),
    "hint": localization.fuse_increments,
    "exact hint": lambda dataset: localization.fuse_increments(dataset, first_order_from),
    "fused": localization.fuse}


def odometry_draws(ticks, vehicle, kept, rng, draws=400, model="euler"):
    """Dead-reckoned poses for random wheel parameters and initial headings.

    Parameters
    ----------
    ticks : (n, 2) counts of the right and left wheel, the same for every draw.
    vehicle : Vehicle, with means and standard deviations of the normal distributions.
    kept : (m,) indices from 0 of the poses to return.
    rng : numpy random generator.
    draws : number of draws.
    model : "euler" or "arc".

    Returns
    -------
    (draws, m, 3) poses [x, y, heading].
    """
    return np.stack([
        odometry.dead_reckoning(ticks, vehicle.with_deviation(z[:3]),
                       (0.0, 0.0, z[3] * vehicle.sigma_heading), model)[kept]
        for z in rng.standard_normal((draws, 4))])


def problem2_trial(seed, methods=tuple(PROBLEM2_METHODS), **options):
    """Methods of problem 2 on one drive of the short path, simulated with these options.

    Returns
    -------
    dict of numbers for each of `methods`: "nees", the mean over the measured poses, "last nees" and
    "ate" in m (of odometry the ATE only). With "ArUco" there is "map nees", with "fused" there are
    "wheel nees" and "slip" in sqrt(m).
    """
    dataset, truth = simulate("short", seed, **options)
    frame, numbers = sightings_by_frame(dataset.aruco).frame, {}
    for method in methods:
        found = PROBLEM2_METHODS[method](dataset)
        if method == "odometry":
            numbers["odometry ate"] = ate(found[frame], truth.poses[frame])
            continue
        measured = slice(None) if len(found.poses) == len(frame) else frame
        poses, covariances = found.poses[measured], found.covariances[measured]
        numbers |= {f"{method} nees": anees(poses, covariances, truth.poses[frame]),
                    f"{method} last nees": nees(poses, covariances, truth.poses[frame])[-1],
                    f"{method} ate": ate(poses, truth.poses[frame])}
        if method == "ArUco":
            numbers["map nees"] = _map_nees(found, truth).mean()
        if method == "fused":
            numbers |= {"wheel nees": _wheel_nees(found, truth), "slip": found.slip}
    return numbers


def ranges_added(seed, share=1.0, **options):
    """Problems 3 and 4 on one drive of the short path, for the information that ranges add.

    Parameters
    ----------
    share : the markers are seen over this first share of the drive only.

    Returns
    -------
    dict of numbers, "without" and "with" ranges: "ate without" and "aligned without", the ATE in m;
    "sigma without", the median over the poses of the larger sigma of x and y, in m; and so on. Also
    "moved", the median distance between the positions of both, over this sigma of each pose.
    """
    dataset, truth = simulate("short", seed, **options)
    dataset = replace(dataset, aruco=dataset.first(round(share * len(dataset.ticks))).aruco)
    without = slam.estimate(dataset.without("uwb"))
    solved, numbers = {"without": without, "with": slam.estimate(dataset, previous=without)}, {}
    for name, found in solved.items():
        numbers |= {f"ate {name}": ate(found.poses, truth.poses),
                    f"aligned {name}": ate(found.poses, truth.poses, aligned=True),
                    f"sigma {name}": np.median(position_sigmas(found.covariances[1:]))}
    distance = np.hypot(*(solved["with"].poses - without.poses)[1:, :2].T)
    return numbers | {"moved": np.median(distance / position_sigmas(without.covariances[1:]))}


def learned_noise(seed, slip=1e-3):
    """Problem 3 on one drive of the short path, its noise learned and known.

    `slip` in sqrt(m) as in `simulate`.

    Returns
    -------
    dict of numbers: the "slip" learned; "nees" of the poses and "aligned" ATE in m with it;
    "rejected" sightings; "arc", 1 where arcs were chosen; "known nees" and "known aligned", those
    of the graph that is given the noise and the arcs; "problem 4 nees", with ranges and the noise
    learned.
    """
    dataset, truth = simulate("short", seed, slip=slip)
    markers = dataset.without("uwb")
    learned = slam.estimate(markers)
    known = slam.estimate(markers, slip, "arc", marker_noise_factor=1.0)
    with_ranges = slam.estimate(dataset, previous=learned)
    numbers = {"slip": learned.slip, "rejected": np.count_nonzero(learned.rejected),
               "arc": float(learned.model == "arc"), "problem 4 nees": anees(
                   with_ranges.poses, with_ranges.covariances, truth.poses)}
    for name, found in (("", learned), ("known ", known)):
        numbers |= {f"{name}nees": anees(found.poses, found.covariances, truth.poses),
                    f"{name}aligned": ate(found.poses, truth.poses, aligned=True)}
    return numbers


def judge_slam(found, dataset, truth):
    """A SlamResult against the truth, as a dict of numbers.

    "nees" of the measured poses, "nees between" of the others, "last nees", "wheel nees"; "ate" and
    "aligned" in m; "rejected" sightings; "slip" in sqrt(m); "chi2" per degree of freedom; "arc", 1
    where arcs were chosen; with markers "map nees" and "map worst" error in m; with antennas
    "antenna nees", their rms "antenna error" in m, and the number in "doubts".
    """
    measured = [sensor.pose for sensor in (dataset.aruco, dataset.uwb) if sensor is not None]
    frames = np.isin(np.arange(len(truth.poses)), np.concatenate(measured))
    values = nees(found.poses, found.covariances, truth.poses)
    numbers = {"nees": np.nanmean(values[frames]), "nees between": np.nanmean(values[~frames]),
               "last nees": values[-1], "wheel nees": _wheel_nees(found, truth),
               "ate": ate(found.poses, truth.poses),
               "aligned": ate(found.poses, truth.poses, aligned=True),
               "rejected": np.count_nonzero(found.rejected), "slip": found.slip,
               "chi2": found.chi2_per_dof, "arc": float(found.model == "arc")}
    if len(found.marker):
        true_map = truth.marker_in_world[np.searchsorted(truth.marker, found.marker)]
        numbers |= {"map nees": _map_nees(found, truth).mean(),
                    "map worst": np.abs(found.marker_in_world - true_map)[:, :2].max()}
    if len(found.antenna):
        error, squared = antenna_error(found, truth)
        numbers |= {"antenna nees": np.mean(squared), "antenna error": np.sqrt(np.mean(error**2)),
                    "doubts": len(found.doubts)}
    return numbers


def antenna_error(found, truth):
    """Distances (a,) in m of a SlamResult's antennas from the truth, and their NEES (a,)."""
    error = found.antenna_in_world - truth.antenna_in_world[
        np.searchsorted(truth.antenna, found.antenna)]
    return np.hypot(*error.T), np.einsum(
        "ni,nij,nj->n", error, np.linalg.inv(found.antenna_covariance), error)


def _map_nees(found, truth):
    """NEES (k,) of the markers of a SlamResult or a Localization."""
    true_map = truth.marker_in_world[np.searchsorted(truth.marker, found.marker)]
    return nees(found.marker_in_world, found.marker_covariance, true_map)


def _wheel_nees(found, truth):
    """Squared error of the wheel parameters over their covariance."""
    error = found.wheel - truth.vehicle.wheel
    return error @ np.linalg.solve(found.wheel_covariance, error)
