"""A plain GTSAM script for problem 4, as the baseline of time.

A between factor for every encoder row, with the noise that table 2 gives a single step and a floor,
since that noise is singular. A between factor for every sighting and a range factor for every
range, both with a Huber kernel. Markers start at their first sighting, antennas at their guess. One
Levenberg-Marquardt optimisation, and the marginal covariance of every pose.
"""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, X

from slamlib.core import odometry, se2

FLOOR = np.array([1e-4, 1e-4, 1e-3])          # m, m, rad in one step


def plain(dataset):
    """Poses (n, 3), and covariances (n, 3, 3) in GTSAM's axes."""
    ticks, vehicle, aruco = dataset.ticks, dataset.vehicle, dataset.aruco
    uwb, guess = dataset.uwb, dataset.antenna_guess
    poses = odometry.dead_reckoning(ticks, vehicle)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.PriorFactorPose2(X(0), gtsam.Pose2(), gtsam.noiseModel.Diagonal.Sigmas(
        [1e-6, 1e-6, vehicle.sigma_heading])))
    ds, dtheta, ds_by_w, dtheta_by_w = odometry.steps(ticks, vehicle)
    sigma_w = vehicle.sigma_wheel
    sigmas = FLOOR + np.stack([np.linalg.norm(ds_by_w * sigma_w, axis=1), 0 * ds,
                               np.linalg.norm(dtheta_by_w * sigma_w, axis=1)], -1)
    for k in range(len(ds)):
        graph.add(gtsam.BetweenFactorPose2(X(k), X(k + 1), gtsam.Pose2(ds[k], 0.0, dtheta[k]),
                                           gtsam.noiseModel.Diagonal.Sigmas(sigmas[k])))
    for k, pose in enumerate(poses):
        values.insert(X(k), gtsam.Pose2(*pose))
    huber = gtsam.noiseModel.mEstimator.Huber.Create(1.345)
    for i, k, r, sigma in zip(uwb.pose.tolist(), uwb.antenna.tolist(), uwb.range, uwb.sigma):
        graph.add(gtsam.RangeFactor2D(X(i), A(k), r, gtsam.noiseModel.Robust.Create(
            huber, gtsam.noiseModel.Isotropic.Sigma(1, sigma))))
    for k, place in zip(guess.antenna.tolist(), guess.position):
        if k in uwb.antenna:
            values.insert(A(k), gtsam.Point2(*place))
    for i, j, z, C in zip(aruco.pose.tolist(), aruco.marker.tolist(), aruco.marker_in_vehicle,
                          aruco.covariance):
        noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(C))
        graph.add(gtsam.BetweenFactorPose2(X(i), L(j), gtsam.Pose2(*z), noise))
        if not values.exists(L(j)):
            values.insert(L(j), gtsam.Pose2(*se2.compose(poses[i], z)))
    values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    each = [values.atPose2(X(k)) for k in range(len(poses))]
    found = np.array([[p.x(), p.y(), p.theta()] for p in each])
    of = gtsam.Marginals(graph, values)
    return found, np.array([of.marginalCovariance(X(k)) for k in range(len(poses))])
