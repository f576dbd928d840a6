"""Drives that are not as their files say: what each of them does to the plain graph.

A case is the options of `simulate`, or with `change` a function that spoils a Dataset.
"""

from dataclasses import replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import X

from slamlib import build_graph, count_everything, estimate, initial_values, solve_graph
from slamlib.core import se2
from slamlib.core.graph import add_priors, add_sightings
from slamlib.core.records import Dataset
from slamlib.studies.montecarlo import drive, judged, plain_graph

CAMERA = np.array([0.10, 0.05, 0.03])     # m, m, rad, of the camera in the vehicle
SPIN = 1273                               # counts of each wheel, which turn the vehicle by 0.5 rad


def camera_elsewhere(dataset: Dataset) -> Dataset:
    """The Dataset of a camera at CAMERA, of which vehicle.toml says nothing."""
    aruco = dataset.aruco
    seen = se2.between(CAMERA, aruco.marker_in_vehicle)
    covariance = se2.rotate_covariance(aruco.covariance, -CAMERA[2])
    return replace(dataset, aruco=replace(
        aruco, marker_in_vehicle=seen, covariance=covariance))


def wheels_spin(dataset: Dataset) -> Dataset:
    """The Dataset with counts of a turn by SPIN that the vehicle did not make, midway."""
    ticks = dataset.ticks.copy()
    ticks[len(ticks) // 2] += [SPIN, -SPIN]
    return replace(dataset, ticks=ticks)


CASES = {
    "as stated": {},
    "slip of 3 mm": {"slip": 3e-3},
    "3 % wrong labels": {"mislabelled": 0.03},
    "camera elsewhere": {"change": camera_elsewhere},
    "errors with memory": {"memory": 0.9},
    "wheels spin once": {"change": wheels_spin},
}


def needs(seed: int) -> dict:
    """The plain graph and `estimate` in each of CASES, problem 3 on one `drive`.

    Returns
    -------
    dict of numbers, as "slip of 3 mm, plain ate" and "slip of 3 mm, delivered nees", of the poses
    with a sighting; the ATE in m, the NEES is the mean.
    """
    numbers = {}
    for case, options in CASES.items():
        changed = dict(options)
        change = changed.pop("change", None)
        dataset, truth = drive(seed, **changed)
        dataset = dataset.without("uwb")
        if change is not None:
            dataset = change(dataset)
        plain = plain_graph(dataset)
        at = plain.pose
        found = estimate(dataset)
        numbers |= judged(f"{case}, plain", plain.poses, plain.covariances, truth.poses[at])
        numbers |= judged(f"{case}, delivered", found.poses[at], found.covariances[at],
                          truth.poses[at])
    return numbers


def wheels(seed: int, slip: float) -> dict:
    """Wheel errors as one variable and as noise of each increment, on one `drive` of known slip.

    Returns
    -------
    dict of numbers "variable ate" and "noise ate" in m, and "nees" likewise, of problem 3.
    """
    dataset, truth = drive(seed, slip=slip)
    dataset = dataset.without("uwb")
    decisions = count_everything(dataset, slip=slip)
    values = initial_values(dataset, decisions)
    chain = gtsam.NonlinearFactorGraph()
    add_priors(chain, decisions)
    add_sightings(chain, decisions)
    increments = decisions.odometry
    by_sigma = increments.J_wheel @ decisions.root_wheel
    C = increments.covariance(slip) + se2.rotate_covariance(
        by_sigma @ by_sigma.mT, -increments.increment[:, 2])
    frames = increments.frame.tolist()
    for k, delta in enumerate(increments.increment):
        chain.add(gtsam.BetweenFactorPose2(X(frames[k]), X(frames[k + 1]), gtsam.Pose2(*delta),
                                           gtsam.noiseModel.Gaussian.Covariance(C[k])))
    numbers = {}
    for name, graph in (("variable", build_graph(decisions)), ("noise", chain)):
        found = solve_graph(graph, values)
        numbers |= judged(name, found.poses, found.covariances, truth.poses[found.pose])
    return numbers
