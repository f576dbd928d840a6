"""Stage 3: the factor graph in GTSAM.

`nonlinear_graph` has GTSAM's own factors:

* a prior on pose 1, which fixes the world frame, and one on the calibration c, in sigmas, by the
  Vehicle (of the wheel parameters the assignment's table 2);
* a between factor for every sighting of a marker with a heading, Z_ij = X_i^-1 L_j;
* a range factor for every range, r_ik = |A_k - (x_i, y_i)|, and the guess as a prior on A_k.

`linearize` adds those that are linearised in numpy: the odometry between consecutive frames, which
depends on the wheel parameters in c, sightings of points, whose heading is unknown, and all
sightings or ranges where an entry of c for them is unknown or not that of a sensor in the vehicle's
origin. Custom factors in Python would be slow: GTSAM copies all values for every call.
"""

import re

import gtsam
import numpy as np
from gtsam.symbol_shorthand import A, C, L, P, X

from slamlib.dataset import DatasetError, Vehicle
from slamlib.slam.calibration import RANGES, SIGHTINGS, WHEELS, stated_calibration
from slamlib.slam.factors import linearize_measurements, odometry_error
from slamlib.slam.measurements import GUESS_PRIOR_SIGMA, WEAK_SIGMA


def gtsam_step(problem, state):
    """The Gauss-Newton step delta (n + q,) by GTSAM of a Problem at a State, in sigmas of c.

    Cholesky decomposition of H is fast, but fails if H is ill-conditioned. QR decomposition of its
    root then decides whether the measurements determine every variable. Raises DatasetError if they
    do not.
    """
    linear, ordering = linearize(problem, state), gtsam.Ordering(problem.measurements.ordering)
    if problem.active.any():
        ordering.push_back(C(0))
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
    keys = [ordering.at(i) for i in range(ordering.size())]
    return solution.vector(gtsam.KeyVector(keys))


def linearize(problem, state):
    """The gtsam.GaussianFactorGraph of a Problem at a State."""
    m, graph = problem.measurements, gtsam.GaussianFactorGraph()
    graph.push_back(nonlinear_graph(problem).linearize(values(problem, state)))
    active = problem.active[WHEELS]
    e, J, J_c = odometry_error(problem.odometry, state.poses, state.c[WHEELS])
    U, _ = problem.odometry.whitening(problem.noise.slip)
    J_c = U @ (J_c[:, :, active] * problem.sigma[WHEELS][active])
    row, columns = np.arange(len(e)), np.arange(active.sum())
    _add(graph, problem, X, row, row + 1, (U @ e[..., None])[..., 0], U @ J, J_c, columns)
    for symbol, f, first in zip((L, P, A), linearize_measurements(problem, state),
                                (0, 0, len(m.marker))):
        if symbol is P or not _is_native(problem, RANGES if symbol is A else SIGHTINGS):
            _add(graph, problem, symbol, f.row, f.landmark - first, f.e, f.J, f.J_c, f.columns)
    return graph


def _add(graph, problem, symbol, row, other, e, J, J_c, columns):
    """Add factors of whitened errors e (m, d) to a gtsam.GaussianFactorGraph.

    They are between the frames `row` (m,) and variables `other` (m,) of a symbol, with derivatives
    J (m, d, p) by both and J_c (m, d, u) by the entries `columns` (u,) of the calibration.
    """
    by_c = np.zeros((*e.shape, problem.active.sum()))
    by_c[:, :, columns] = J_c
    for i, j, error, jacobian, last in zip(row.tolist(), other.tolist(), e, J, by_c):
        calibration = (C(0), last) if len(columns) else ()
        graph.add(X(i), jacobian[:, :3], symbol(j), jacobian[:, 3:], *calibration, -error)


def _is_native(problem, kind):
    """Whether the entries `kind`, a slice, of c are known to be those of Vehicle()."""
    ideal = stated_calibration(Vehicle(), problem.measurements.antenna).stated
    return not problem.active[kind].any() \
        and (problem.measurements.calibration.stated == ideal)[kind].all()


def nonlinear_graph(problem):
    """The gtsam.NonlinearFactorGraph of a Problem: sightings, ranges and priors, with kernels."""
    accepted, noise, model = problem.accepted, problem.noise, gtsam.noiseModel
    m, graph = problem.measurements, gtsam.NonlinearFactorGraph()
    s, weight = m.sightings, accepted.sighting_weight * m.as_pose
    roots = m.sighting_roots[0] * (np.sqrt(weight) / noise.sightings)[:, None, None]
    used = np.flatnonzero(weight) if _is_native(problem, SIGHTINGS) else []
    for i, j, z, root in zip(s.row[used].tolist(), m.marker_row[used].tolist(), s.z[used].tolist(),
                             roots[used]):
        graph.add(gtsam.BetweenFactorPose2(X(i), L(j), gtsam.Pose2(*z), _robust(
            accepted.sighting_kernel, model.Gaussian.SqrtInformation(root, False))))
    if _is_native(problem, RANGES):
        r, used, kernel = m.ranges, np.flatnonzero(accepted.range_weight), accepted.range_kernel
        sigmas = noise.ranges * r.sigma[used] / np.sqrt(accepted.range_weight[used])
        distances = r.distance[used] - accepted.range_bias * sigmas
        for i, k, distance, sigma in zip(r.row[used].tolist(), r.antenna[used].tolist(),
                                         distances.tolist(), sigmas.tolist()):
            graph.add(gtsam.RangeFactor2D(
                X(i), A(k), distance, _robust(kernel, model.Isotropic.Sigma(1, sigma))))
    _add_priors(graph, problem)
    return graph


def _add_priors(graph, problem):
    """Add the priors of all variables of a Problem to a gtsam.NonlinearFactorGraph."""
    m, model, q = problem.measurements, gtsam.noiseModel, int(problem.active.sum())
    graph.add(gtsam.PriorFactorPose2(
        X(0), gtsam.Pose2(), model.Diagonal.Sigmas(m.origin_sigma)))
    if q:
        graph.add(gtsam.PriorFactorVector(C(0), np.zeros(q), model.Unit.Create(q)))
    for j in problem.accepted.unsupported:
        graph.add(gtsam.PriorFactorPose2(
            L(j), gtsam.Pose2(), model.Isotropic.Sigma(3, WEAK_SIGMA)) if m.oriented[j]
            else gtsam.PriorFactorPoint2(
                P(j), np.zeros(2), model.Isotropic.Sigma(2, WEAK_SIGMA)))
    for k, position in enumerate(m.guess):
        graph.add(gtsam.PriorFactorPoint2(
            A(k), position, model.Isotropic.Sigma(2, GUESS_PRIOR_SIGMA)))


def _robust(kernel, noise):
    """The gtsam noise model `noise` with a robust kernel, if it is not None."""
    return gtsam.noiseModel.Robust.Create(kernel, noise) if kernel else noise


def values(problem, state):
    """The gtsam.Values of a State, the calibration in sigmas from what is stated."""
    measurements, active, entries = problem.measurements, problem.active, gtsam.Values()
    for i, pose in enumerate(state.poses.tolist()):
        entries.insert(X(i), gtsam.Pose2(*pose))
    for j, (marker, oriented) in enumerate(zip(state.markers, measurements.oriented)):
        if oriented:
            entries.insert(L(j), gtsam.Pose2(*marker))
        else:
            entries.insert(P(j), gtsam.Point2(*marker[:2]))
    for k, antenna in enumerate(state.antennas):
        entries.insert(A(k), gtsam.Point2(*antenna))
    if active.any():
        difference = state.c - measurements.calibration.stated
        entries.insert(C(0), difference[active] / problem.sigma[active])
    return entries


def _variable(measurements, message):
    """The undetermined variable that GTSAM's message names, in the words of the files."""
    m, symbol = measurements, re.search(r"Symbol: ([aclpx])(\d+)", message)
    if symbol is None:
        return "one of them"
    if symbol[1] == "c":
        return "the calibration of the sensors"
    name, ids = {"x": ("pose", m.frame + 1), "l": ("the pose of marker", m.marker),
                 "p": ("the position of marker", m.marker),
                 "a": ("the position of antenna", m.antenna)}[symbol[1]]
    return f"{name} {ids[int(symbol[2])]}"
