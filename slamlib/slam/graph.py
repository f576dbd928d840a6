"""Stage 3: the factor graph in GTSAM.

`nonlinear_graph` has GTSAM's own factors:

* a prior on pose 1, which fixes the world frame, and one on w, by the Vehicle's sigmas of the wheel
  parameters (the assignment's table 2);
* a between factor for every sighting of a marker with a heading, Z_ij = X_i^-1 L_j;
* a range factor for every range, r_ik = |A_k - (x_i, y_i)|, unless the ranges are calibrated, and
  the guess as a prior on A_k.

`linearize` adds those that are linearised in numpy: the odometry between consecutive frames, which
depends on w, sightings of points, whose heading is unknown, and ranges whose offset and scale c are
variables. Custom factors in Python would be slow: GTSAM copies all values for every call.
"""

import re

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, C, L, P, W, X

from slamlib.dataset import DatasetError
from slamlib.slam.factors import linearize_ranges, linearize_sightings, odometry_error
from slamlib.slam.measurements import GUESS_PRIOR_SIGMA, WEAK_SIGMA


def gtsam_step(problem, state):
    """The Gauss-Newton step delta (n,) by GTSAM of a Problem at a State, in elimination ordering.

    Cholesky decomposition of H is fast, but fails if H is ill-conditioned. QR decomposition of its
    root then decides whether the measurements determine every variable. Raises DatasetError if they
    do not.
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
    errors, jacobians = odometry_error(problem.odometry, state.poses, state.w)
    U, _ = problem.odometry.whitening(problem.noise.slip)
    for i, (e, J) in enumerate(zip((U @ errors[..., None])[..., 0], U @ jacobians)):
        graph.add(X(i), J[:, :3], X(i + 1), J[:, 3:6], W(0), J[:, 6:], -e)
    f = linearize_sightings(problem.accepted, problem.noise, state, as_pose=False)
    for i, j, e, J in zip(f.row.tolist(), f.landmark.tolist(), f.e, f.J):
        graph.add(X(i), J[:, :3], P(j), J[:, 3:], -e)
    if problem.measurements.calibrated:
        f = linearize_ranges(problem.accepted, problem.noise, state)
        antennas = f.landmark - len(problem.measurements.marker)
        for i, k, e, J in zip(f.row.tolist(), antennas.tolist(), f.e, f.J):
            graph.add(X(i), J[:, :3], A(k), J[:, 3:5], C(0), J[:, 5:], -e)
    return graph


def nonlinear_graph(problem):
    """The gtsam.NonlinearFactorGraph of a Problem: sightings, ranges and priors, with kernels."""
    accepted, noise, model = problem.accepted, problem.noise, gtsam.noiseModel
    m, graph = problem.measurements, gtsam.NonlinearFactorGraph()
    s, weight = m.sightings, accepted.sighting_weight * m.as_pose
    roots = m.sighting_roots[0] * (np.sqrt(weight) / noise.sightings)[:, None, None]
    used = np.flatnonzero(weight)
    for i, j, z, root in zip(s.row[used].tolist(), m.marker_row[used].tolist(), s.z[used].tolist(),
                             roots[used]):
        graph.add(gtsam.BetweenFactorPose2(X(i), L(j), gtsam.Pose2(*z), _robust(
            accepted.sighting_kernel, model.Gaussian.SqrtInformation(root, False))))
    if not m.calibrated:
        r, used = m.ranges, np.flatnonzero(accepted.range_weight)
        sigmas = noise.ranges * r.sigma[used] / np.sqrt(accepted.range_weight[used])
        for i, k, distance, sigma in zip(r.row[used].tolist(), r.antenna[used].tolist(),
                                         r.distance[used].tolist(), sigmas.tolist()):
            graph.add(gtsam.RangeFactor2D(X(i), A(k), distance, _robust(
                accepted.range_kernel, model.Isotropic.Sigma(1, sigma))))
    _add_priors(graph, accepted)
    return graph


def _add_priors(graph, accepted):
    """Add the priors of all variables of AcceptedMeasurements to a gtsam.NonlinearFactorGraph."""
    m, model = accepted.measurements, gtsam.noiseModel
    graph.add(gtsam.PriorFactorPose2(
        X(0), gtsam.Pose2(), model.Diagonal.Sigmas(m.origin_sigma)))
    graph.add(gtsam.PriorFactorVector(W(0), np.zeros(3), model.Unit.Create(3)))
    for j in accepted.unsupported:
        graph.add(gtsam.PriorFactorPose2(
            L(j), gtsam.Pose2(), model.Isotropic.Sigma(3, WEAK_SIGMA)) if m.oriented[j]
            else gtsam.PriorFactorPoint2(
                P(j), np.zeros(2), model.Isotropic.Sigma(2, WEAK_SIGMA)))
    for k, position in enumerate(m.guess):
        graph.add(gtsam.PriorFactorPoint2(
            A(k), position, model.Isotropic.Sigma(2, GUESS_PRIOR_SIGMA)))
    if m.calibrated:
        graph.add(gtsam.PriorFactorVector(C(0), np.zeros(2), model.Unit.Create(2)))


def _robust(kernel, noise):
    """The gtsam noise model `noise` with a robust kernel, if it is not None."""
    return gtsam.noiseModel.Robust.Create(kernel, noise) if kernel else noise


def values(measurements, state):
    """The gtsam.Values of a State."""
    entries = gtsam.Values()
    for i, pose in enumerate(state.poses.tolist()):
        entries.insert(X(i), gtsam.Pose2(*pose))
    for j, (marker, oriented) in enumerate(zip(state.markers, measurements.oriented)):
        if oriented:
            entries.insert(L(j), gtsam.Pose2(*marker))
        else:
            entries.insert(P(j), gtsam.Point2(*marker[:2]))
    for k, antenna in enumerate(state.antennas):
        entries.insert(A(k), gtsam.Point2(*antenna))
    entries.insert(W(0), state.w)
    if measurements.calibrated:
        entries.insert(C(0), state.c)
    return entries


def _variable(measurements, message):
    """The undetermined variable that GTSAM's message names, in the words of the files."""
    m, symbol = measurements, re.search(r"Symbol: ([aclpwx])(\d+)", message)
    if symbol is None:
        return "one of them"
    if symbol[1] in "wc":
        return {"w": "the wheel parameters", "c": "the offset and scale of the ranges"}[symbol[1]]
    name, ids = {"x": ("pose", m.frame + 1), "l": ("the pose of marker", m.marker),
                 "p": ("the position of marker", m.marker),
                 "a": ("the position of antenna", m.antenna)}[symbol[1]]
    return f"{name} {ids[int(symbol[2])]}"
