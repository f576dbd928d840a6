"""Stage 3: the factor graph in GTSAM.

* a prior on pose 1, which fixes the world frame, and the prior of table 2 on w;
* a between factor for every sighting, Z_ij = X_i^-1 L_j;
* a range factor for every range, r_ik = |A_k - (x_i, y_i)|, and the guess as a prior on A_k;
* the odometry between consecutive frames, which depends on w. It is linearised in numpy: as a
  custom factor in Python it would be slow, because GTSAM copies all values for every call.

Two more kinds of factors are linearised in numpy, by `linear_factors.py`: sightings of points,
whose heading is unknown, and ranges whose offset and scale are variables.
"""

import re

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, L, P, W, X, Z

from slamlib.dataset import DatasetError
from slamlib.slam.linear_factors import point_factors, range_factors
from slamlib.slam.measurement_factors import GUESS_PRIOR_SIGMA, WEAK_SIGMA
from slamlib.slam.odometry_factors import odometry_error


def gtsam_step(problem, state):
    """The Gauss-Newton step (n,) of a Problem at a State, in the order of elimination, by GTSAM.

    Cholesky decomposition of the information is fast, but fails where it is ill-conditioned. QR
    decomposition of its root then decides whether the measurements determine every variable; it
    raises DatasetError if they do not.
    """
    linear, ordering = linearize(problem, state), problem.measurements.ordering
    try:
        solution = linear.eliminateMultifrontal(ordering).optimize()
    except RuntimeError:
        try:
            solution = linear.eliminateSequential(ordering, gtsam.EliminateQR).optimize()
        except RuntimeError as error:             # GTSAM's, with the variable and much advice
            m = problem.measurements
            raise DatasetError(
                f"{m.dataset.name}: expected measurements that determine every pose and landmark; "
                f"these do not determine {_variable(m, str(error))}") from None
    return solution.vector(gtsam.KeyVector([ordering.at(i) for i in range(ordering.size())]))


def linearize(problem, state):
    """The gtsam.GaussianFactorGraph of a Problem at a State."""
    graph = gtsam.GaussianFactorGraph()
    graph.push_back(nonlinear_graph(problem).linearize(values(problem.measurements, state)))
    e, *jacobians = odometry_error(problem.odometry, state.poses, state.w)
    U, _ = problem.odometry.whitening(problem.noise.slip)
    e, (first, second, by_w) = (U @ e[..., None])[..., 0], [U @ J for J in jacobians]
    for i in range(len(e)):
        graph.add(X(i), first[i], X(i + 1), second[i], W(0), by_w[i], -e[i])
    f = point_factors(problem.measured, problem.noise, state)
    for i, j, by_pose, by_point, error in zip(
            f.row.tolist(), f.landmark.tolist(), f.by_pose, f.by_landmark, f.e):
        graph.add(X(i), by_pose, P(j), by_point, -error)
    if problem.measurements.calibrated:
        f = range_factors(problem.measured, problem.noise, state)
        for i, k, by_pose, by_antenna, by_z, error in zip(
                f.row.tolist(), (f.landmark - len(problem.measurements.marker)).tolist(),
                f.by_pose, f.by_landmark, f.by_calibration, f.e):
            graph.add(X(i), by_pose, A(k), by_antenna, Z(0), by_z, -error)
    return graph


def nonlinear_graph(problem):
    """The gtsam.NonlinearFactorGraph of a Problem: sightings, ranges and priors, with kernels."""
    factors, noise, model = problem.measured, problem.noise, gtsam.noiseModel
    m, graph = problem.measurements, gtsam.NonlinearFactorGraph()
    s, weight = m.sightings, factors.sighting_weight * m.as_pose
    roots = m.sighting_roots[0] * (np.sqrt(weight) / noise.sightings)[:, None, None]
    used = np.flatnonzero(weight)
    for i, j, z, root in zip(s.row[used].tolist(), m.label[used].tolist(), s.z[used].tolist(),
                             roots[used]):
        graph.add(gtsam.BetweenFactorPose2(X(i), L(j), gtsam.Pose2(*z), _robust(
            factors.sighting_kernel, model.Gaussian.SqrtInformation(root, False))))
    if not m.calibrated:
        sigma = noise.ranges * m.ranges.sigma
        used, r = np.flatnonzero(factors.range_weight), m.ranges
        sigma = sigma[used] / np.sqrt(factors.range_weight[used])
        for i, k, distance, own in zip(r.row[used].tolist(), r.antenna[used].tolist(),
                                       r.distance[used].tolist(), sigma.tolist()):
            graph.add(gtsam.RangeFactor2D(X(i), A(k), distance, _robust(
                factors.range_kernel, model.Isotropic.Sigma(1, own))))
    _add_priors(graph, factors)
    return graph


def _add_priors(graph, factors):
    m, model = factors.measurements, gtsam.noiseModel
    graph.add(gtsam.PriorFactorPose2(
        X(0), gtsam.Pose2(), model.Diagonal.Sigmas(m.origin_sigma)))
    graph.add(gtsam.PriorFactorVector(W(0), np.zeros(3), model.Unit.Create(3)))
    for j in factors.unsupported:
        graph.add(gtsam.PriorFactorPose2(
            L(j), gtsam.Pose2(), model.Isotropic.Sigma(3, WEAK_SIGMA)) if m.oriented[j]
            else gtsam.PriorFactorPoint2(
                P(j), np.zeros(2), model.Isotropic.Sigma(2, WEAK_SIGMA)))
    for k, position in enumerate(m.guess):
        graph.add(gtsam.PriorFactorPoint2(
            A(k), position, model.Isotropic.Sigma(2, GUESS_PRIOR_SIGMA)))
    if m.calibrated:
        graph.add(gtsam.PriorFactorVector(Z(0), np.zeros(2), model.Unit.Create(2)))


def _robust(kernel, noise):
    return gtsam.noiseModel.Robust.Create(kernel, noise) if kernel else noise


def values(measurements, state):
    """The gtsam.Values of a State."""
    found = gtsam.Values()
    for i, pose in enumerate(state.poses.tolist()):
        found.insert(X(i), gtsam.Pose2(*pose))
    for j, (marker, oriented) in enumerate(zip(state.markers, measurements.oriented)):
        if oriented:
            found.insert(L(j), gtsam.Pose2(*marker))
        else:
            found.insert(P(j), gtsam.Point2(*marker[:2]))
    for k, antenna in enumerate(state.antennas):
        found.insert(A(k), gtsam.Point2(*antenna))
    found.insert(W(0), state.w)
    if measurements.calibrated:
        found.insert(Z(0), state.z)
    return found


def _variable(measurements, message):
    """What GTSAM's message about an undetermined variable names, in the words of the files."""
    m, found = measurements, re.search(r"Symbol: ([alpwxz])(\d+)", message)
    if found is None:
        return "one of them"
    if found[1] in "wz":
        return {"w": "the wheel parameters", "z": "the offset and scale of the ranges"}[found[1]]
    name, ids = {"x": ("pose", m.frame + 1), "l": ("the pose of marker", m.marker),
                 "p": ("the position of marker", m.marker),
                 "a": ("the position of antenna", m.antenna)}[found[1]]
    return f"{name} {ids[int(found[2])]}"
